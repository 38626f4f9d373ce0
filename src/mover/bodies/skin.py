"""The parts of a body that touch things, and the joints that are found on any body."""

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.bodies.skeleton import FINGERS, SIDES
from mover.bodies.skinning import SkinnedBody, zero_pose
from mover.geometry.mesh import vertex_normals

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


# Soles of a mesh of unknown topology without joints: what lies lowest and faces down.


HEIGHT = 0.03
"""A sole is that near the lowest point [heights of the mesh]."""


def lowest_soles(
    meshes: Float[Tensor, "meshes verts 3"], faces: Int[Tensor, "faces 3"], up: Float[Tensor, "3"]
) -> Int[Tensor, " verts"]:
    """Index into `PARTS` (a sole) or -1 of each vertex; sides by position only."""
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


# Parts of a skinned body, from its weights and from normals and heights in the zero pose.


SOLE_HEIGHT = 0.025
"""A sole is that near the lowest point [statures]: 4 cm of an adult."""


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
