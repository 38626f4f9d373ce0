"""Writes synthetic files in the true format of SMPL, SMPL-H and SMPL-X; imports nothing of mover.

The person is the open body (CC0), laid into the T-pose, with as many vertices as the true models
have (edges are split) and with the numbered vertices of nose, eyes, toes ... where they belong.
Correctives, expressions and hand spaces are random. No number comes from a licensed file.
"""

import pickle
import sys
import types
from functools import cache
from pathlib import Path
from unittest.mock import patch

import numpy as np

OPEN = Path(__file__).parents[1] / "src" / "mover" / "bodies" / "assets" / "open_body_small.npz"
NUMBERED = {
    "smplx": {
        "nose": 9120, "reye": 9929, "leye": 9448, "rear": 616, "lear": 6, "LBigToe": 5770,
        "LSmallToe": 5780, "LHeel": 8846, "RBigToe": 8463, "RSmallToe": 8474, "RHeel": 8635,
        "lthumb": 5361, "lindex": 4933, "lmiddle": 5058, "lring": 5169, "lpinky": 5286,
        "rthumb": 8079, "rindex": 7669, "rmiddle": 7794, "rring": 7905, "rpinky": 8022,
    },
    "smplh": {
        "nose": 332, "reye": 6260, "leye": 2800, "rear": 4071, "lear": 583, "LBigToe": 3216,
        "LSmallToe": 3226, "LHeel": 3387, "RBigToe": 6617, "RSmallToe": 6624, "RHeel": 6787,
        "lthumb": 2746, "lindex": 2319, "lmiddle": 2445, "lring": 2556, "lpinky": 2673,
        "rthumb": 6191, "rindex": 5782, "rmiddle": 5905, "rring": 6016, "rpinky": 6133,
    },
}  # fmt: skip
VERTS = {"smplx": 10475, "smplh": 6890, "smpl": 6890}
FINGERS = ("index", "middle", "pinky", "ring", "thumb")


def open_person():
    """Vertices and joints in the T-pose, weights, shape directions, faces and parents."""
    with np.load(OPEN) as data:
        d = {k: data[k] for k in data.files}
    weights = np.zeros((len(d["verts"]), len(d["joints"])))
    np.put_along_axis(weights, d["weight_joint"].astype(int), d["weight"].astype(float), 1)
    weights /= weights.sum(1, keepdims=True)
    turn, home, parents = d["tpose"].astype(float), d["joints"].astype(float), d["parents"]
    place, dirs = home.copy(), d["joint_dirs"].astype(float).copy()
    for j, p in enumerate(parents):
        if p >= 0:
            place[j] = place[p] + turn[p] @ (home[j] - home[p])
    mixed = np.einsum("vj,jik->vik", weights, turn)
    verts = np.einsum("vik,vk->vi", mixed, d["verts"]) + weights @ (
        place - np.einsum("jik,jk->ji", turn, home)
    )
    moved = np.einsum("vik,vkn->vin", mixed, d["shape_dirs"]) - np.einsum(
        "vj,jik,jkn->vin", weights, turn, dirs
    )
    for j, p in enumerate(parents):
        if p >= 0:
            dirs[j] = dirs[p] + turn[p] @ (d["joint_dirs"][j] - d["joint_dirs"][p])
    moved += np.einsum("vj,jin->vin", weights, dirs)
    return verts, place, weights, moved, d["faces"].astype(int), parents.astype(int)


def split_edges(faces, count, wanted):
    """Faces with edges split until there are `wanted` vertices; and each new vertex's two ends."""
    faces, ends = [tuple(f) for f in faces], []
    while count < wanted:
        used, result = set(), []
        owner = {}
        for k, f in enumerate(faces):
            for a, b in ((f[0], f[1]), (f[1], f[2]), (f[2], f[0])):
                owner.setdefault((min(a, b), max(a, b)), []).append(k)
        for (a, b), (k, m) in owner.items():
            if count == wanted or k in used or m in used:
                continue
            used |= {k, m}
            for f in (faces[k], faces[m]):
                (c,) = set(f) - {a, b}
                i = f.index(c)
                p, q = f[(i + 1) % 3], f[(i + 2) % 3]
                result += [(c, p, count), (c, count, q)]
            ends.append((a, b))
            count += 1
        faces = result + [f for k, f in enumerate(faces) if k not in used]
    return np.array(faces), np.array(ends)


def marks(verts, place, names, main):
    """Vertices of nose, eyes, ears, toes, heels and tips, by simple rules in the T-pose."""
    at = dict(zip(names, place, strict=True))
    x, y, z = verts.T

    def best(score, among):
        return int(np.where(among, score, -np.inf).argmax())

    head = y > at["neck"][1] + 0.05
    found = {"nose": best(z, head & (abs(x) < 0.01) & (y < at["left_eye"][1]) & (y > at["jaw"][1]))}
    for side, s in (("left", 1), ("right", -1)):
        c = side[0]
        near = np.linalg.norm((verts - at[f"{side}_eye"])[:, :2], axis=1)
        found[f"{c}eye"] = best(-near, head & (z > at[f"{side}_eye"][2]))
        found[f"{c}ear"] = best(s * x, head)
        foot = (s * x > 0) & (y < at["left_ankle"][1])
        toes = foot & (z > at[f"{side}_foot"][2])
        found[f"{c.upper()}BigToe"] = best(z, toes & (s * x < s * at[f"{side}_foot"][0]))
        found[f"{c.upper()}SmallToe"] = best(s * x + z / 2, toes)
        found[f"{c.upper()}Heel"] = best(-z, foot & (y < y.min() + 0.04))
        for finger in FINGERS:
            end = at[f"{side}_{finger}3"]
            along = (verts - end) @ (end - at[f"{side}_{finger}2"])
            found[f"{c}{finger}"] = best(along, main == names.index(f"{side}_{finger}3"))
    return found


BODY = (
    "pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee", "spine2",
    "left_ankle", "right_ankle", "spine3", "left_foot", "right_foot", "neck", "left_collar",
    "right_collar", "head", "left_shoulder", "right_shoulder", "left_elbow", "right_elbow",
    "left_wrist", "right_wrist", "jaw", "left_eye", "right_eye",
)  # fmt: skip
NAMES = [*BODY, *(f"{s}_{f}{k}" for s in ("left", "right") for f in FINGERS for k in (1, 2, 3))]


def regressor(verts, place):
    """Rows that sum to 1 and give the joints from the vertices near them."""
    rows = np.zeros((len(place), len(verts)))
    for j, p in enumerate(place):
        near = np.argsort(np.linalg.norm(verts - p, axis=1))[:60]
        system = np.concatenate([verts[near] - p, np.ones((60, 1))], 1).T
        rows[j, near] = np.linalg.lstsq(system, np.array([0, 0, 0, 1.0]), rcond=None)[0]
    return rows


def full_person(name):
    """The open person with as many vertices as the model has, numbered where it matters."""
    verts, place, weights, dirs, faces, parents = open_person()
    count, first = VERTS[name], len(verts)
    faces, ends = split_edges(faces, first, count)
    verts, weights, dirs = (
        np.concatenate([v, np.zeros((count - first, *v.shape[1:]))]) for v in (verts, weights, dirs)
    )
    for k, (a, b) in enumerate(ends, start=first):  # in order, since new vertices split again
        for v in (verts, weights, dirs):
            v[k] = (v[a] + v[b]) / 2
    order = np.arange(count)
    for mark, index in marks(verts, place, NAMES, weights.argmax(1)).items():
        wanted = NUMBERED["smplx" if name == "smplx" else "smplh"][mark]
        at = int(np.nonzero(order == index)[0][0])
        order[[at, wanted]] = order[[wanted, at]]
    return verts[order], place, weights[order], dirs[order], np.argsort(order)[faces], parents


def fewer_joints(name, weights, rows, parents):
    """Without jaw and eyes, whose share goes to the head; SMPL's hands are one joint each."""
    if name == "smplx":
        return weights, rows, parents
    weights[:, 15] += weights[:, 22:25].sum(1)
    keep = [*range(22), *range(25, 55)]
    if name == "smpl":
        for hand in (25, 40):
            weights[:, hand] = weights[:, hand : hand + 15].sum(1)
        keep = [*range(22), 25, 40]
    new = {old: k for k, old in enumerate(keep)}
    return weights[:, keep], rows[keep], np.array([new.get(parents[k], -1) for k in keep])


def hands_and_face(name, rng, face, faces):
    """Random spaces of hands, and points on triangles near the nose."""
    model = {}
    if name != "smpl":
        for side in "lr":
            model[f"hands_components{side}"] = np.linalg.qr(rng.normal(size=(45, 45)))[0]
            model[f"hands_mean{side}"] = 0.15 * rng.normal(size=45)
    if name == "smplx":
        model["lmk_faces_idx"] = np.argsort(-face[faces].sum(1))[:51].astype(np.int64)
        model["lmk_bary_coords"] = rng.dirichlet((1, 1, 1), 51)
    return model


@cache
def make_model(name, version="1.0", seed=0, shift=(0.02, 0.31, -0.05)):
    """The arrays of a synthetic file; the template is off the origin, as the true ones are."""
    rng = np.random.default_rng(seed)
    verts, place, weights, dirs, faces, parents = full_person(name)
    verts, place = verts + shift, place + shift
    weights, rows, parents = fewer_joints(name, weights, regressor(verts, place), parents)
    count, joints = weights.shape
    shape = {"1.0": 10, "1.1": 300}[version]
    extra = {"1.0": 10, "1.1": 100}[version] if name == "smplx" else 0
    full = np.zeros((count, 3, shape + extra), np.float32)
    full[..., :10] = dirs[..., :10]
    nose = verts[NUMBERED["smplx" if name == "smplx" else "smplh"]["nose"]]
    face = np.exp(-np.square(verts - nose).sum(1) / 0.05**2)
    full[..., shape:] = 0.004 * rng.normal(size=(1, 3, extra)) * face[:, None, None]
    waves = np.sin(verts @ rng.normal(size=(3, 6)) * 6 + 3 * rng.normal(size=6))  # smooth skin
    mixing = 4e-4 * rng.normal(size=(6, 3, 9 * (joints - 1)))
    model = {
        "v_template": verts, "shapedirs": full, "J_regressor": rows, "weights": weights,
        "posedirs": np.einsum("vm,mik->vik", waves, mixing).astype(np.float32),
        "kintree_table": np.stack([parents.astype(np.uint32), np.arange(joints, dtype=np.uint32)]),
        "f": faces.astype(np.uint32),
    }  # fmt: skip
    return model | hands_and_face(name, rng, face, faces)


def write_models(root, names=("smplh", "smplx")):
    """Files of neutral models as in the usual folder, which is returned."""
    for name in names:
        write_npz(make_model(name), root / name / f"{name.upper()}_NEUTRAL.npz")
    return root


def write_npz(model, path):
    """As SMPL-X's own: also with members that are pickled objects, which are not needed."""
    path.parent.mkdir(parents=True, exist_ok=True)
    np.savez(path, joint2num=np.array({"Pelvis": 0}, dtype=object), **model)
    return path


class Ch:
    """Stands for chumpy's array while a file is written."""


Ch.__module__ = "chumpy.ch"


def write_old_pickle(model, path):
    """As SMPL's own of version 1.0: Python 2, chumpy arrays, a sparse regressor."""
    from scipy import sparse

    path.parent.mkdir(parents=True, exist_ok=True)
    packed = dict(model, J_regressor=sparse.csc_matrix(model["J_regressor"]), bs_type="lrotmin")
    for key in ("v_template", "shapedirs", "posedirs", "weights"):
        value = Ch()
        value.__dict__ |= {"x": np.asarray(packed[key]), "_dirty_vars": {"x"}, "_itr": None}
        packed[key] = value
    module = types.ModuleType("chumpy.ch")
    module.Ch = Ch
    stand_ins = {"chumpy": types.ModuleType("chumpy"), "chumpy.ch": module}
    with patch.dict(sys.modules, stand_ins):
        path.write_bytes(pickle.dumps(packed, protocol=2))
    return path
