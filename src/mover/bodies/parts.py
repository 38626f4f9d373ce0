"""Parts of a body that touch things: soles, seat, thighs, back, palms, forearms.

Of a skinned body they follow from the weights and from normals and heights in the zero pose; for
MHR's topology their indices are an asset (made by `tools/body_parts`). The vertices of another mesh
whose pose is given take those of the nearest vertices of the open body in the same pose.
"""

import hashlib
import logging
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.bodies.skin import PARTS, lowest_soles, model_parts
from mover.bodies.skinning import ASSETS, SkinnedBody, open_body, zero_pose
from mover.bodies.smpl_files import KINDS, load_smpl
from mover.bodies.smpl_model import skin_of_model
from mover.core.errors import InputError
from mover.core.records import record
from mover.core.types import Bodies
from mover.geometry.mesh import vertex_normals

Array = np.ndarray
log = logging.getLogger(__name__)

LANDMARKS = (
    "left_hip", "right_hip", "left_knee", "right_knee", "left_ankle", "right_ankle", "neck",
    "left_shoulder", "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist",
)  # fmt: skip
"""Joints that are found on any body."""

ABOVE = {
    "hip": ("pelvis",), "knee": ("hip",), "ankle": ("knee",), "neck": ("spine3",),
    "shoulder": ("collar",), "elbow": ("shoulder",), "wrist": ("elbow",),
}  # fmt: skip
"""The joint whose skin blends with that of each landmark."""
POSES = 4
"""Poses that vote on the parts of an unknown mesh."""
ROUNDS = 4
"""How often the open body is laid over an unknown mesh."""
REACH = 0.05
"""A normal counts as much as a position that far away [m]."""
FAR = 0.1
"""A vertex further than that from the open body has no part [m]; also the median, of a person."""


@record
class Parts:
    """Which part of the body each vertex belongs to."""

    part_of: Int[Tensor, " verts"]
    """Index into `PARTS`; -1: none."""
    rings: Int[Tensor, "landmarks members"]
    """Vertices around each of `LANDMARKS`: their mean is about where the joint is. Empty where the
    mesh could not be matched to a human body."""


def members(parts: Parts, *names: str) -> Bool[Tensor, " verts"]:
    """Which vertices belong to one of these parts."""
    wanted = torch.tensor([PARTS.index(n) for n in names], device=parts.part_of.device)
    return torch.isin(parts.part_of, wanted)


def parts_of(bodies: Bodies, up_cam: Float[Tensor, "3"] | None = None) -> Parts:
    """Parts of these bodies: by the model's skin or lists where it is known, else by geometry.

    Args:
        bodies: People with one topology, in any poses.
        up_cam: Direction of up in the frame of `bodies`; a level camera or +y of the world if not
            given. Asked only of a mesh that cannot be matched to a human body: its soles are what
            lies lowest.
    """
    found = _find(bodies, up_cam)
    device = bodies.verts.device
    return Parts(found.part_of.to(device), found.rings.to(device))


def _find(bodies: Bodies, up_cam: Float[Tensor, "3"] | None) -> Parts:
    model = known_model(bodies.faces, bodies.verts.shape[1]) or _users_model(bodies)
    if model is not None:
        rings = thin(model.verts.numpy(), landmark_rings(model))
        return Parts(model_parts(model), torch.from_numpy(rings))
    found = _listed(bodies) or _from_pose(bodies)
    if found is not None:
        return found
    none = torch.zeros((0, 0), dtype=torch.long)
    if len(bodies.verts) == 0:
        return Parts(torch.full((bodies.verts.shape[1],), -1), none)
    log.warning(
        "the bodies' mesh is not known to be a whole person (its topology is unknown, and no pose "
        "that fits is given): only its soles are looked for"
    )
    default = (0.0, -1.0, 0.0) if bodies.space == "camera" else (0.0, 1.0, 0.0)
    up = torch.tensor(default) if up_cam is None else up_cam.detach().cpu()
    meshes = bodies.verts[_some_rows(bodies)].detach().cpu().double()
    return Parts(lowest_soles(meshes, bodies.faces.cpu(), up.to(meshes)), none)


def _some_rows(bodies: Bodies) -> Int[Tensor, " rows"]:
    return torch.linspace(0, len(bodies.verts) - 1, POSES).round().long().unique()


def known_model(faces: Int[Tensor, "faces 3"], verts: int) -> SkinnedBody | None:
    """The shipped body with exactly this topology, if there is one."""
    for model in (open_body("small"), open_body("full")):
        if model.verts.shape[0] == verts and torch.equal(model.faces, faces.cpu()):
            return model
    return None


def _users_model(bodies: Bodies) -> SkinnedBody | None:
    """The skin of the user's licensed model, where its files are there and fit these bodies."""
    named = [] if bodies.pose is None else [(bodies.pose.model, bodies.pose.gender)]
    count = bodies.verts.shape[1]
    for name, gender in [*named, *((n, "neutral") for n, k in KINDS.items() if k.verts == count)]:
        try:
            skin = skin_of_model(load_smpl(name, gender)) if name in KINDS else None
        except InputError:
            continue
        if skin is not None and torch.equal(skin.faces, bodies.faces.cpu()):
            return skin
    return None


def digest_of(faces: Int[Array, "faces 3"]) -> str:
    """What distinguishes one topology from others."""
    return hashlib.sha256(np.ascontiguousarray(faces, dtype="<i8").tobytes()).hexdigest()


def _listed(bodies: Bodies) -> Parts | None:
    """The parts of MHR, the body of SAM 3D Body, if this is its topology."""
    with np.load(ASSETS / "mhr_parts.npz") as data:
        part_of, rings, digest = data["part_of"], data["rings"], str(data["digest"])
    if bodies.verts.shape[1] != len(part_of) or digest_of(bodies.faces.cpu().numpy()) != digest:
        return None
    return Parts(torch.from_numpy(part_of).long(), torch.from_numpy(rings).long())


def _from_pose(bodies: Bodies) -> Parts | None:
    """Parts of the nearest vertices of the open body in the same poses; None: it does not fit."""
    pose, model = bodies.pose, open_body()
    if pose is None or pose.body_pose.shape[-1] < 63 or len(bodies.verts) == 0:
        return None
    rows = _some_rows(bodies)
    angles = {"global_orient": pose.global_orient[rows], "body_pose": pose.body_pose[rows, :63]}
    known = {name: x.detach().cpu().float() for name, x in angles.items()}
    with torch.no_grad():
        posed, _ = model.posed(replace(zero_pose(len(rows), model), **known))
    here = bodies.verts[rows].detach().cpu().double()
    both = zip(_featured(here, bodies.faces.cpu()), _featured(posed, model.faces), strict=True)
    laid = [_nearest_after_fit(mesh, other) for mesh, other in both]
    chosen, near = (torch.from_numpy(np.stack(x)) for x in zip(*laid, strict=True))
    if float(near.median()) > FAR:
        return None
    part_of = torch.where(near < FAR, model_parts(model)[chosen], -1).mode(0).values
    part_of[~_linked(bodies)] = -1  # eyes, teeth
    rings = landmark_rings(model)[chosen.numpy()].mean(0)
    return Parts(part_of, torch.from_numpy(thin(here[0].numpy(), rings)))


def _linked(bodies: Bodies) -> Bool[Tensor, " verts"]:
    """Which vertices hang together with most others."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    count, (a, b, c) = bodies.verts.shape[1], bodies.faces.cpu().numpy().T
    ends = np.concatenate([a, b]), np.concatenate([b, c])
    links = coo_matrix((np.ones(len(ends[0])), ends), shape=(count, count))
    _, label = connected_components(links, directed=False)
    return torch.from_numpy(label == np.bincount(label).argmax())


def _featured(verts: Tensor, faces: Tensor) -> Float[Array, "meshes verts 6"]:
    """Positions and normals [m]."""
    return torch.cat([verts, REACH * vertex_normals(verts, faces)], -1).double().numpy()


def _nearest_after_fit(
    mesh: Float[Array, "verts 6"], other: Float[Array, "others 6"]
) -> tuple[Int[Array, " verts"], Float[Array, " verts"]]:
    """The nearest vertex of another mesh once that is scaled and moved, and its distance [m]."""
    from scipy.spatial import KDTree

    low, high = mesh[:, :3].min(0), mesh[:, :3].max(0)
    start, end = other[:, :3].min(0), other[:, :3].max(0)
    scale = np.linalg.norm(high - low) / np.linalg.norm(end - start)
    shift = (low + high) / 2 - scale * (start + end) / 2
    for _ in range(ROUNDS):
        placed = np.concatenate([scale * other[:, :3] + shift, other[:, 3:]], 1)
        distance, chosen = KDTree(placed).query(mesh)
        matched = other[chosen, :3]
        away, back = mesh[:, :3] - mesh[:, :3].mean(0), matched - matched.mean(0)
        scale = (away * back).sum() / np.square(back).sum()
        shift = mesh[:, :3].mean(0) - scale * matched.mean(0)
    return np.asarray(chosen), np.asarray(distance)


def landmark_rings(model: SkinnedBody) -> Float[Array, "verts landmarks"]:
    """1 where the skin of a landmark blends with the skin above it."""
    weight = dict(zip(model.joint_names, model.weights.T.numpy(), strict=True))
    rings: list[Array] = []
    for name in LANDMARKS:
        side, _, joint = name.rpartition("_")
        above = [f"{side}_{n}" if f"{side}_{n}" in weight else n for n in ABOVE[joint]]
        rings.append(sum(weight[n] for n in above) * weight[name] > 0.12)
    return np.stack(rings, axis=1).astype(float)


def thin(
    mesh: Float[Array, "verts 3"], rings: Float[Array, "verts landmarks"], members: int = 24
) -> Int[Array, "landmarks members"]:
    """So many vertices of each ring, far from each other, so that their mean is its middle."""
    rows: list[Array] = []
    for ring in (rings > 0).T:
        index = np.nonzero(ring)[0] if ring.any() else np.arange(len(mesh))
        points = mesh[index]
        far = np.linalg.norm(points - points.mean(0), axis=1)
        chosen: list[int] = []
        for _ in range(members):
            chosen.append(int(far.argmax()))
            far = np.minimum(far, np.linalg.norm(points - points[chosen[-1]], axis=1))
        rows.append(index[chosen])
    return np.stack(rows)
