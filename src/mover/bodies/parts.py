"""Which vertices of a body touch things: soles, seat, thighs, back, palms, forearms.

Of a skinned body they follow from the weights and from normals and heights in the zero pose; for
MHR's topology they are an asset. A mesh of another topology that comes with joints takes them from
the nearest vertices of the open body in the same pose; without joints only its soles are found.
"""

import hashlib
import logging
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.bodies.skeleton import BODY, FINGERS, SIDES
from mover.bodies.skinning import ASSETS, SkinnedBody, open_body, vertex_subset, zero_pose
from mover.bodies.smpl_files import KINDS, load_smpl, solved
from mover.core.errors import InputError
from mover.core.records import record, to_device
from mover.core.types import Bodies
from mover.geometry.mesh import vertex_normals
from mover.geometry.rotations import rotation_vectors

log = logging.getLogger(__name__)
PARTS = (
    "left_sole", "right_sole", "seat", "left_thigh", "right_thigh", "back",
    "left_palm", "right_palm", "left_forearm", "right_forearm",
)  # fmt: skip
"""Patches of skin; of thighs and forearms only the undersides."""
SOLES = PARTS[:2]
LANDMARKS = (
    "left_hip", "right_hip", "left_knee", "right_knee", "left_ankle", "right_ankle", "neck",
    "left_shoulder", "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist",
)  # fmt: skip
"""Joints that are found on any body."""
ABOVE = {
    "hip": "pelvis", "knee": "hip", "ankle": "knee", "neck": "spine3",
    "shoulder": "collar", "elbow": "shoulder", "wrist": "elbow",
}  # fmt: skip
"""The joint whose skin blends with that of each landmark."""
BLEND = 0.12  # product of the weights of both, at least, around a landmark
MEMBERS = 24  # vertices of a ring
HEIGHT = 0.03  # [heights of the mesh] from its lowest point, at most, of a sole of an unknown mesh
SOLE_HEIGHT = 0.025  # [statures], the same of a skinned body: 4 cm of an adult
POSES = 4  # rows that show where the soles of an unknown mesh are
STEPS = 60  # of L-BFGS, of the open body's pose
SIGMA_JOINT, SIGMA_ANGLE, SIGMA_SHAPE = 0.01, 1.0, 2.0  # [m], [rad] and coefficients
NORMAL = 0.05  # a normal counts as much as a position that far away [m]
FAR = 0.15  # [m], a vertex that is farther from the open body belongs to no part


@record
class BodyParts:
    """Which part of the body each vertex belongs to."""

    part_of: Int[Tensor, " verts"]  #: index into `PARTS`; -1: none
    rings: Int[Tensor, "landmarks members"]
    """Vertices around each of `LANDMARKS`: their mean is about where the joint is. Empty where the
    topology is unknown."""


def members(parts: BodyParts, *names: str) -> Bool[Tensor, " verts"]:
    """Which vertices belong to one of these parts."""
    wanted = torch.tensor([PARTS.index(n) for n in names], device=parts.part_of.device)
    return torch.isin(parts.part_of, wanted)


def parts_of(bodies: Bodies, up_cam: Float[Tensor, "3"] | None = None) -> BodyParts:
    """Parts of these bodies: by the model's skin or lists where it is known, else by geometry.

    Args:
        bodies: People with one topology, in any poses.
        up_cam: Direction of up in the frame of `bodies`; a level camera or +y of the world if not
            given. Used only for a mesh of unknown topology without joints: its soles lie lowest.
    """
    return to_device(_find(bodies, up_cam), bodies.verts.device)


def _find(bodies: Bodies, up_cam: Float[Tensor, "3"] | None) -> BodyParts:
    model = _model_of(bodies)
    if model is not None:
        return BodyParts(model_parts(model), landmark_rings(model))
    listed = _listed(bodies)
    if listed is not None:
        return listed
    none = torch.zeros((0, 0), dtype=torch.long)
    if len(bodies.verts) == 0:
        return BodyParts(torch.full((bodies.verts.shape[1],), -1), none)
    if bodies.joints is not None and set(LANDMARKS) <= set(bodies.joint_names):
        return BodyParts(_of_open_body(bodies), none)
    log.warning(
        "the bodies' mesh has an unknown topology and no joints by name (%s): only its soles are "
        "looked for", ", ".join(LANDMARKS[:3]) + ", ...",
    )  # fmt: skip
    rows = torch.linspace(0, len(bodies.verts) - 1, POSES).round().long().unique()
    meshes, faces = bodies.verts[rows].detach().cpu().double(), bodies.faces.detach().cpu()
    default = (0.0, -1.0, 0.0) if bodies.space == "camera" else (0.0, 1.0, 0.0)
    up = torch.tensor(default) if up_cam is None else up_cam.detach().cpu()
    return BodyParts(lowest_soles(meshes, faces, up.to(meshes)), none)


def _of_open_body(bodies: Bodies) -> Int[Tensor, " verts"]:
    """Part of each vertex of the first body: that of the nearest vertex of the open body.

    The open body is posed by L-BFGS so that its joints lie where those of the mesh do; vertices
    are near by position and normal.
    """
    from scipy.spatial import KDTree

    assert bodies.joints is not None
    model = open_body()
    names = [name for name in BODY if name in bodies.joint_names]
    goal = bodies.joints[0, [bodies.joint_names.index(n) for n in names]].detach().cpu().float()
    known = torch.tensor([model.joint_names.index(n) for n in names])
    bones, straight = vertex_subset(model, torch.zeros(1, dtype=torch.long)), zero_pose(1, model)
    rest = bones.posed(straight)[1][0, known]
    u, _, vt = torch.linalg.svd((rest - rest.mean(0)).T @ (goal - goal.mean(0)))
    side = torch.diag(torch.tensor([1.0, 1.0, float(torch.sign(torch.det(vt.T @ u.T)))]))
    start = {
        "global_orient": rotation_vectors((vt.T @ side @ u.T)[None]),
        "body_pose": straight.body_pose, "betas": straight.betas,
        "transl": (goal.mean(0) - rest.mean(0))[None],
    }  # fmt: skip

    def energy(at: dict[str, Tensor]) -> Float[Tensor, ""]:
        miss = bones.posed(replace(straight, **at))[1][0, known] - goal
        bent = at["body_pose"].square().sum() / SIGMA_ANGLE**2
        odd = at["betas"].square().sum() / SIGMA_SHAPE**2
        return miss.square().sum() / SIGMA_JOINT**2 + bent + odd

    at = solved(start, energy, STEPS)
    with torch.no_grad():
        posed = model.posed(replace(straight, **at))[0][0]
    mesh = bodies.verts[0].detach().cpu().float()
    normals = [vertex_normals(v, f.cpu()) for v, f in ((posed, model.faces), (mesh, bodies.faces))]
    tree = KDTree(torch.cat([posed, NORMAL * normals[0]], 1).numpy())
    far, index = tree.query(torch.cat([mesh, NORMAL * normals[1]], 1).numpy())
    part = model_parts(model)[torch.from_numpy(index)]
    return torch.where(torch.from_numpy(far) < FAR, part, -1)


def _model_of(bodies: Bodies) -> SkinnedBody | None:
    """The shipped body with exactly this topology, or the user's licensed one where it is there."""
    count, faces = bodies.verts.shape[1], bodies.faces.cpu()
    for model in (open_body("small"), open_body("full")):
        if len(model.verts) == count and torch.equal(model.faces, faces):
            return model
    named = [] if bodies.pose is None else [(bodies.pose.model, bodies.pose.gender)]
    for name, gender in [*named, *((n, "neutral") for n, k in KINDS.items() if k.verts == count)]:
        try:
            model = load_smpl(name, gender) if name in KINDS else None
        except InputError:
            continue
        if model is not None and torch.equal(model.faces, faces):
            return model
    return None


def _listed(bodies: Bodies) -> BodyParts | None:
    """The parts of MHR, the body of SAM 3D Body, if the faces have its digest."""
    with np.load(ASSETS / "mhr_parts.npz") as data:
        part_of, rings, digest = data["part_of"], data["rings"], str(data["digest"])
    faces = np.ascontiguousarray(bodies.faces.cpu().numpy(), dtype="<i8").tobytes()
    if bodies.verts.shape[1] != len(part_of) or hashlib.sha256(faces).hexdigest() != digest:
        return None
    return BodyParts(torch.from_numpy(part_of).long(), torch.from_numpy(rings).long())


def landmark_rings(model: SkinnedBody) -> Int[Tensor, "landmarks members"]:
    """Vertices around each of `LANDMARKS`, far from each other: their mean is its middle."""
    weight = dict(zip(model.joint_names, model.weights.T.numpy(), strict=True))
    mesh, rows = model.verts.numpy(), list[np.ndarray]()
    for name in LANDMARKS:
        side, _, joint = name.rpartition("_")
        above = weight.get(f"{side}_{ABOVE[joint]}", weight.get(ABOVE[joint]))
        ring = np.nonzero(above * weight[name] > BLEND)[0]
        index = ring if len(ring) else np.arange(len(mesh))
        points = mesh[index]
        far = np.linalg.norm(points - points.mean(0), axis=1)
        chosen: list[int] = []
        for _ in range(MEMBERS):
            chosen.append(int(far.argmax()))
            far = np.minimum(far, np.linalg.norm(points - points[chosen[-1]], axis=1))
        rows.append(index[chosen])
    return torch.from_numpy(np.stack(rows))


def lowest_soles(
    meshes: Float[Tensor, "meshes verts 3"], faces: Int[Tensor, "faces 3"], up: Float[Tensor, "3"]
) -> Int[Tensor, " verts"]:
    """Index into `PARTS` (a sole) or -1 of each vertex: what lies lowest and faces down.

    For meshes of unknown topology without joints; sides by position only.
    """
    height = meshes @ up
    low, high = height.amin(1, keepdim=True), height.amax(1, keepdim=True)
    near = height < low + HEIGHT * (high - low)
    down = vertex_normals(meshes, faces) @ up < -0.6
    sole = (near & down).double().mean(0) >= 0.5
    part = torch.full((meshes.shape[1],), -1)
    if sole.any():
        points = meshes[0, sole] - up * (meshes[0, sole] @ up)[:, None]
        points = points - (points.amax(0) + points.amin(0)) / 2
        widest = torch.linalg.eigh(points.T @ points).eigenvectors[:, -1]
        first, second = PARTS.index("left_sole"), PARTS.index("right_sole")
        part[sole] = torch.where(points @ widest > 0, first, second)
    return part


def model_parts(model: SkinnedBody) -> Int[Tensor, " verts"]:
    """Index of each vertex of `model` into `PARTS`, -1 for none; the first of several."""
    part = torch.full((len(model.verts),), -1, dtype=torch.long, device=model.verts.device)
    for name, inside in _patches(model).items():
        part[inside & (part < 0)] = PARTS.index(name)
    return part


def _patches(model: SkinnedBody) -> dict[str, Bool[Tensor, " verts"]]:
    """Where each part is in the zero pose (T-pose, +y up, +z front)."""
    verts, joints = (x[0] for x in model.posed(zero_pose(1, model)))
    dominant = [model.joint_names[j] for j in model.weights.argmax(1).tolist()]
    place = dict(zip(model.joint_names, joints, strict=True))
    _, ny, nz = vertex_normals(verts, model.faces).unbind(-1)

    def of(*joints: str) -> Bool[Tensor, " verts"]:
        known = frozenset(joints)
        return torch.tensor([name in known for name in dominant], device=verts.device)

    height = verts[:, 1]
    low, stature = height.min(), height.max() - height.min()
    hip = (place["left_hip"][1] + place["right_hip"][1]) / 2
    thigh = hip - (place["left_knee"][1] + place["right_knee"][1]) / 2
    patches: dict[str, Bool[Tensor, " verts"]] = {}
    for side in SIDES:
        near_floor = height < low + SOLE_HEIGHT * stature
        patches[f"{side}_sole"] = of(f"{side}_ankle", f"{side}_foot") & (ny < -0.6) & near_floor
    trunk = of("pelvis", "spine1", "left_hip", "right_hip")
    level = (height > hip - 0.34 * thigh) & (height < hip + 0.24 * thigh)
    behind = verts[:, 2] < (place["left_hip"][2] + place["right_hip"][2]) / 2
    patches["seat"] = trunk & level & behind & (nz < 0.3)
    for side in SIDES:
        patches[f"{side}_thigh"] = of(f"{side}_hip") & (nz < -0.2)
    spine = of("pelvis", "spine1", "spine2", "spine3", "left_collar", "right_collar")
    patches["back"] = spine & (nz < -0.45) & (height > hip)
    for side in SIDES:
        fingers = [f"{side}_{f}{k}" for f in FINGERS for k in (1, 2, 3)]
        patches[f"{side}_palm"] = of(f"{side}_wrist", f"{side}_hand", *fingers) & (ny < -0.3)
        patches[f"{side}_forearm"] = of(f"{side}_elbow") & (ny < -0.3)
    return patches
