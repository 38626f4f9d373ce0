"""The open body as plain arrays: joints, weights, T-pose and shape directions of the CC0 human."""

import zipfile

import numpy as np
from jaxtyping import Float, Int
from makehuman import (
    Human,
    Traits,
    cube,
    read_human,
    read_rig,
    read_target,
    read_weights,
    shape_of,
)

from mover.bodies.skeleton import FINGERS, JOINTS, PARENTS, SIDES

Array = np.ndarray

RIG = "game_engine"
NEUTRAL = Traits(height=0.528)
"""Halfway between man and woman, 1.70 m tall."""
ADULTS = 300
"""Random adults from whom the shape directions are learnt."""
DIRECTIONS = 10
INFLUENCES = 6
"""Joints that move one vertex, at most."""

LIMBS = {"hip": "thigh", "knee": "calf", "ankle": "foot", "foot": "ball", "collar": "clavicle",
         "shoulder": "upperarm", "elbow": "lowerarm", "wrist": "hand"}  # fmt: skip
BONES = {
    **{"pelvis": "pelvis", "neck": "neck_01", "head": "head"},
    **{f"spine{k}": f"spine_0{k}" for k in (1, 2, 3)},
    **{f"{s}_{joint}": f"{bone}_{s[0]}" for s in SIDES for joint, bone in LIMBS.items()},
    **{f"{s}_{f}{k}": f"{f}_0{k}_{s[0]}" for s in SIDES for f in FINGERS for k in (1, 2, 3)},
}
"""The bone of the rig at each joint; jaw and eyes have none and move nothing."""
CUBES = {"jaw": "joint-jaw", "left_eye_smplhf": "joint-l-eye", "right_eye_smplhf": "joint-r-eye"}


def full_body(archive: zipfile.ZipFile) -> dict[str, Array]:
    """All arrays of the body at MakeHuman's own resolution, +y up, +z front, metres.

    The origin is the pelvis joint, whatever the shape. `tpose` turns the parts of the rest pose
    (arms lowered, legs apart) into the T-pose, which is the zero pose.
    """
    human = read_human(archive)
    quads = human.groups["body"]
    used = np.unique(quads)
    rig = read_rig(archive, RIG)
    _check_tree({name: bone["parent"] for name, bone in rig.items()})
    places = {**{j: rig[b]["head"]["cube_name"] for j, b in BONES.items()}, **CUBES}
    marks = [places[name] for name in JOINTS]
    verts, joints = _adult(human, NEUTRAL, used, marks)
    vert_dirs, joint_dirs = _directions(human, used, marks)
    shape = read_target(archive, "buttocks/buttocks-volume-incr", len(human.base))[used]
    swell = np.linalg.norm(shape, axis=1)
    return {
        "verts": verts,
        "faces": _triangles(np.searchsorted(used, quads)),
        "weights": _weights(read_weights(archive, RIG), used),
        "shape_dirs": vert_dirs,
        "joints": joints,
        "joint_dirs": joint_dirs,
        "tpose": tpose(joints),
        "buttocks": swell / swell.max(),
    }


def _check_tree(parent: dict[str, str]) -> None:
    """The rig must hang together as SMPL-X's skeleton does."""
    for name, up in zip(JOINTS, PARENTS, strict=True):
        if name in BONES and up >= 0 and parent[BONES[name]] != BONES[JOINTS[up]]:
            raise ValueError(f"bone '{BONES[name]}' hangs at '{parent[BONES[name]]}'")


def _triangles(quads: Int[Array, "quads 4"]) -> Int[Array, "faces 3"]:
    return quads[:, [[0, 1, 2], [0, 2, 3]]].reshape(-1, 3)


def _adult(
    human: Human, traits: Traits, used: Int[Array, " verts"], marks: list[str]
) -> tuple[Float[Array, "verts 3"], Float[Array, "joints 3"]]:
    """Vertices and joints of one adult, about the pelvis joint [m]."""
    every = shape_of(human, traits)
    joints = np.stack([cube(human, every, mark) for mark in marks])
    return every[used] - joints[0], joints - joints[0]


def _weights(
    lists: dict[str, list[tuple[int, float]]], used: Int[Array, " verts"]
) -> Float[Array, "verts joints"]:
    dense = np.zeros((int(used.max()) + 1, len(JOINTS)))
    for joint, name in enumerate(JOINTS):
        for vert, weight in lists.get(BONES.get(name, ""), []):
            if vert < len(dense):
                dense[vert, joint] = weight
    return keep_largest(dense[used])


def keep_largest(weights: Float[Array, "verts joints"]) -> Float[Array, "verts joints"]:
    """The `INFLUENCES` largest weights of each vertex, with sum 1."""
    order = np.argsort(-weights, axis=1, kind="stable")[:, INFLUENCES:]
    kept = weights.copy()
    np.put_along_axis(kept, order, 0.0, axis=1)
    return kept / kept.sum(1, keepdims=True)


def _draw(rng: np.random.Generator) -> Traits:
    tall = rng.normal()
    return Traits(
        gender=rng.uniform(),
        age=rng.uniform(0, 0.7),
        muscle=rng.uniform(0.2, 0.8),
        weight=rng.beta(2, 2),
        height=float(np.clip(NEUTRAL.height + tall * (0.045 if tall > 0 else 0.085), 0.2, 0.75)),
        proportions=rng.uniform(0.2, 0.8),
    )


def _directions(
    human: Human, used: Int[Array, " verts"], marks: list[str]
) -> tuple[Float[Array, "verts 3 shape"], Float[Array, "joints 3 shape"]]:
    """Principal directions from the neutral to random adults, one standard deviation long."""
    rng = np.random.default_rng(0)
    middle = np.concatenate(_adult(human, NEUTRAL, used, marks))
    adults = [np.concatenate(_adult(human, _draw(rng), used, marks)) for _ in range(ADULTS)]
    moved = (np.stack(adults) - middle).reshape(ADULTS, -1)
    power, mixes = np.linalg.eigh(moved @ moved.T / ADULTS)
    first = np.argsort(-power)[:DIRECTIONS]
    along = (mixes[:, first].T @ moved / np.sqrt(ADULTS)).reshape(DIRECTIONS, -1, 3)
    top = int(np.argmax(middle[: len(used), 1]))
    taller = np.where(along[:, top, 1] < 0, -1.0, 1.0)[:, None, None]
    both = (along * taller).transpose(1, 2, 0)
    return both[: len(used)], both[len(used) :]


def tpose(joints: Float[Array, "joints 3"]) -> Float[Array, "joints 3 3"]:
    """World rotation of each joint that turns the rest pose into the T-pose."""
    place = dict(zip(JOINTS, joints, strict=True))
    turn = {name: np.eye(3) for name in JOINTS}
    for side, sign in zip(SIDES, (1.0, -1.0), strict=True):
        out, down = np.array([sign, 0, 0]), np.array([0.0, -1, 0])
        for above, below, along in (
            ("shoulder", "elbow", out),
            ("elbow", "wrist", out),
            ("hip", "knee", down),
            ("knee", "ankle", down),
        ):
            bone = place[f"{side}_{below}"] - place[f"{side}_{above}"]
            turn[f"{side}_{above}"] = _shortest(bone, along)
        hand = _frame(
            place[f"{side}_middle1"] - place[f"{side}_wrist"],
            place[f"{side}_index1"] - place[f"{side}_pinky1"],
        )
        flat = _frame(out, np.array([0.0, 0, 1])) @ hand.T
        for name in (f"{side}_wrist", *(f"{side}_{f}{k}" for f in FINGERS for k in (1, 2, 3))):
            turn[name] = flat
    return np.stack([turn[name] for name in JOINTS])


def _frame(first: Float[Array, "3"], second: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Columns: the direction `first`, the part of `second` square to it, and their normal."""
    x = first / np.linalg.norm(first)
    y = second - x * (x @ second)
    y = y / np.linalg.norm(y)
    return np.stack([x, y, np.cross(x, y)], axis=1)


def _shortest(start: Float[Array, "3"], end: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """The rotation by the least angle that turns one direction into another."""
    a, b = start / np.linalg.norm(start), end / np.linalg.norm(end)
    x, y, z = np.cross(a, b)
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + skew + skew @ skew / (1 + a @ b)
