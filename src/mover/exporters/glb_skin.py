"""A body that moves on the bones of its model."""

import dataclasses
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from ..bodies.skinning import SkinnedBody
from ..geometry.mesh import vertex_normals
from ..records import record
from ..report_colours import Colour
from ..types import Bodies
from .glb_motion import Channel, add_material, add_presence, add_sampler
from .gltf import INDICES, VERTICES, Document
from .people import Track, tracks_of
from .posed import Motion, all_angles, misses

INFLUENCES = 4  # joints that move a vertex: what every viewer draws
STILL = 1e-6  # [rad], [m]; what moves less is not animated


@record
class Skin:
    """Bones of everybody, each person with one shape."""

    motion: Motion
    model: SkinnedBody
    """With four weights a vertex."""
    miss: float
    """How far the skin is off the meshes of the result at most [m]."""


def fit_skin(motion: Motion, model: SkinnedBody, bodies: Bodies) -> Skin:
    """One shape for each person, four weights for each vertex, and what they cost."""
    share, joint = model.weights.topk(INFLUENCES, dim=1)
    weights = torch.zeros_like(model.weights).scatter(1, joint, share / share.sum(1, keepdim=True))
    simple = dataclasses.replace(model, weights=weights)
    betas = motion.pose.betas.clone()
    for track in tracks_of(bodies):
        betas[track.rows] = betas[track.rows].mean(0)
    posed = Motion(dataclasses.replace(motion.pose, betas=betas), motion.size)
    return Skin(posed, simple, misses(posed, simple, bodies))


def add_skinned(
    document: Document, animation: int, skin: Skin, track: Track, tint: Colour
) -> list[Channel]:
    """Append a person: mesh, bones and their motion; what moves."""
    pose, model, name = skin.motion.pose, skin.model, f"person_{track.person}"
    betas = pose.betas[track.rows[0]]
    count = len(betas)
    rest = model.verts + model.shape_dirs[..., :count] @ betas
    joints = model.joints + model.joint_dirs[..., :count] @ betas
    bones = _add_bones(document, model, joints)
    top = document.add("nodes", {"name": name, "children": [bones[0]]})
    document.add_root(top)
    mesh = _add_mesh(document, model, rest, add_material(document, tint, name), name)
    inverse = document.add_array(_inverse_bind(model, joints))
    bind = document.add("skins", {"joints": bones, "inverseBindMatrices": inverse, "name": name})
    document.add_root(document.add("nodes", {"name": f"{name}_body", "mesh": mesh, "skin": bind}))
    channels = add_presence(document, animation, top, track)
    return channels + _move(document, animation, skin, track, (bones, joints[0]))


def _add_bones(
    document: Document, model: SkinnedBody, joints: Float[Tensor, "joints 3"]
) -> list[int]:
    """A node for each joint, at its place in its parent; the indices."""
    first = len(document.tree["nodes"])
    for joint, parent in enumerate(model.parents):
        node: dict[str, Any] = {"name": model.joint_names[joint]}
        below = [first + k for k, p in enumerate(model.parents) if p == joint]
        if below:
            node["children"] = below
        if parent >= 0:
            bone = model.tpose[parent] @ (joints[joint] - joints[parent])
            node["translation"] = bone.tolist()
        document.add("nodes", node)
    return list(range(first, first + len(model.parents)))


def _inverse_bind(model: SkinnedBody, joints: Float[Tensor, "joints 3"]) -> NDArray[np.float32]:
    """From the rest shape to the axes of each joint, by columns."""
    matrix = torch.eye(4).repeat(len(joints), 1, 1)
    matrix[:, :3, :3] = model.tpose
    matrix[:, :3, 3] = -(model.tpose @ joints[..., None])[..., 0]
    return matrix.mT.contiguous().numpy()


def _add_mesh(
    document: Document,
    model: SkinnedBody,
    rest: Float[Tensor, "verts 3"],
    material: int,
    name: str,
) -> int:
    """The rest shape with its weights; joints without a share are number 0."""
    share, joint = model.weights.topk(INFLUENCES, dim=1)
    joint = torch.where(share > 0, joint, 0)
    normals = vertex_normals(rest, model.faces)
    faces = model.faces.numpy().astype(np.uint32).reshape(-1)
    attributes = {
        "POSITION": document.add_array(rest.numpy(), VERTICES, bounds=True),
        "NORMAL": document.add_array(normals.numpy(), VERTICES),
        "JOINTS_0": document.add_array(joint.numpy().astype(np.uint8), VERTICES),
        "WEIGHTS_0": document.add_array(share.numpy(), VERTICES),
    }
    primitive = {
        "attributes": attributes,
        "indices": document.add_array(faces, INDICES),
        "material": material,
    }
    return document.add("meshes", {"name": name, "primitives": [primitive]})


def _move(
    document: Document,
    animation: int,
    skin: Skin,
    track: Track,
    root: tuple[list[int], Float[Tensor, "3"]],
) -> list[Channel]:
    """Turns of all joints, and the place and size of the pelvis."""
    bones, pelvis = root
    times = document.add_array(track.time.numpy().astype(np.float32), bounds=True)
    place = (skin.motion.pose.transl[track.rows] + pelvis).numpy()
    size = skin.motion.size[track.rows, None].expand(-1, 3).contiguous().numpy()
    turns = quaternions(all_angles(skin.motion.pose)[track.rows])
    moving = [(bones[0], "translation", place), (bones[0], "scale", size)]
    moving += [(bone, "rotation", turns[:, k]) for k, bone in enumerate(bones)]
    channels: list[Channel] = []
    for node, path, values in moving:
        if np.ptp(values, axis=0).max() < STILL:
            document.tree["nodes"][node][path] = values[0].tolist()
        else:
            values = np.ascontiguousarray(values, dtype=np.float32)
            channels.append((add_sampler(document, animation, times, values), node, path))
    return channels


def quaternions(vectors: Float[Tensor, "frames joints 3"]) -> NDArray[np.float32]:
    """Rotations (x, y, z, w) of axis-angle vectors; neighbours in time are on one side."""
    angle = vectors.double().norm(dim=-1, keepdim=True)
    half = torch.where(angle > 1e-9, (angle / 2).sin() / angle.clamp_min(1e-9), 0.5)
    found = torch.cat([vectors.double() * half, (angle / 2).cos()], -1)
    dots = (found[1:] * found[:-1]).sum(-1)
    side = torch.where(dots < 0, -1.0, 1.0).cumprod(0)
    return torch.cat([found[:1], found[1:] * side[..., None]]).float().numpy()
