"""Bodies that are moved: into the world, as a whole about the pelvis, by a model joint by joint."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mover.bodies import BodyModel, load_model, run_model
from mover.bodies.skeleton import BODY
from mover.bodies.skinning import SkinnedBody, growth_of, heights_of, shaped, vertex_subset
from mover.core.errors import InputError
from mover.core.records import map_tensors, record
from mover.core.types import Bodies, BodyPose, Camera
from mover.geometry.camera import to_world
from mover.geometry.mesh import farthest_first, vertex_normals
from mover.geometry.rotations import axis_angle, rotation_vectors

MEAN_SHAPE = 0.05  # shape coefficients below it are the mean shape
LOOSE_POINTS = 16  # vertices that stand for the joints of a body without any
CHUNK = 64  # bodies posed at once


def has_mean_shape(pose: BodyPose) -> bool:
    """Whether all bodies have the mean shape of their model: then nothing observed their height."""
    return float(pose.betas.abs().max()) < MEAN_SHAPE


@record
class Correction:
    """How bodies are moved; zero leaves them where they are."""

    shift: Float[Tensor, "bodies 3"]  #: of the pelvis [m]
    turn: Float[Tensor, "bodies 3"]
    """Of the whole body about its pelvis, an axis-angle vector in the world [rad]."""
    angles: Float[Tensor, "bodies angles"]
    """Added to `body_pose` [rad]; no columns where bodies move rigidly."""


@dataclass(frozen=True)
class Puppet:
    """Some rows of the bodies, ready to be moved."""

    model: BodyModel | None  #: of the picked vertices only; None: rigid
    pose: BodyPose | None
    skin: Float[Tensor, "bodies picked 3"]  #: picked vertices as they were given [m]
    normals: Float[Tensor, "bodies picked 3"]
    points: Float[Tensor, "bodies points 3"]
    """Joints as they were given, or vertices that stand for them [m]; the first is the pivot."""
    joints: Int[Tensor, " known"]  #: which joints of the model they are; none of a bare mesh


@record
class MovedSkin:
    """Where picked vertices and joints have gone."""

    skin: Float[Tensor, "bodies picked 3"]
    points: Float[Tensor, "bodies points 3"]


def puppet_of(bodies: Bodies, picked: Int[Tensor, " picked"]) -> Puppet:
    """The bodies, in the world, seen through a few of their vertices."""
    normals = vertex_normals(bodies.verts, bodies.faces)[:, picked]
    skin, pose = bodies.verts[:, picked], bodies.pose
    joints = torch.zeros(0, dtype=torch.long)
    if pose is None:
        return Puppet(None, None, skin, normals, _loose_points(bodies), joints)
    full = load_model(pose.model, pose.gender)
    joints = torch.tensor([full.joint_names.index(n) for n in BODY if n in full.joint_names])
    model = vertex_subset(full, picked)
    with torch.no_grad():
        skin, places = model.posed(pose)
    return Puppet(model, pose, skin, normals, places[:, joints], joints)


def _loose_points(bodies: Bodies) -> Float[Tensor, "bodies points 3"]:
    """Joints of a body without a model, or vertices; the pivot first."""
    names = bodies.joint_names
    if bodies.joints is not None and "pelvis" in names:
        kept = ["pelvis", *(n for n in names if n in BODY and n != "pelvis")]
        return bodies.joints[:, [names.index(n) for n in kept]]
    some = spread(bodies.verts[0], LOOSE_POINTS)
    return torch.cat([bodies.verts.mean(1, keepdim=True), bodies.verts[:, some]], 1)


def no_correction(of: Puppet | Bodies) -> Correction:
    """Leave all bodies where they are."""
    zero = torch.zeros_like((of.points if isinstance(of, Puppet) else of.verts)[:, 0])
    width = 0 if of.pose is None else of.pose.body_pose.shape[-1]
    return Correction(zero, zero, zero.new_zeros(len(zero), width))


def moved(puppet: Puppet, by: Correction) -> MovedSkin:
    """The picked vertices and the joints after a correction, differentiable in it."""
    skin, points = puppet.skin, puppet.points
    if puppet.model is not None and puppet.pose is not None:
        bent = dataclasses.replace(puppet.pose, body_pose=puppet.pose.body_pose + by.angles)
        skin, joints = puppet.model.posed(bent)
        points = joints[:, puppet.joints]
    carry = _rigidly(puppet.points[:, :1], by)
    return MovedSkin(carry(skin), carry(points))


def _rigidly(pivot: Float[Tensor, "bodies 1 3"], by: Correction) -> Callable[[Tensor], Tensor]:
    """Moves points of bodies as a whole about a pivot."""
    turn, goal = axis_angle(by.turn).mT, pivot + by.shift[:, None]
    return lambda points: (points - pivot) @ turn + goal


def normals_after(puppet: Puppet, by: Correction) -> Float[Tensor, "bodies picked 3"]:
    """Normals of the picked vertices; they follow the whole body, not its joints."""
    return puppet.normals @ axis_angle(by.turn).mT


def corrected(bodies: Bodies, by: Correction) -> Bodies:
    """Bodies of the world after a correction (a row for each); parameters are posed again."""
    pose = bodies.pose
    if pose is None:
        carry = _rigidly(_loose_points(bodies)[:, :1], by)
        joints = None if bodies.joints is None else carry(bodies.joints)
        return dataclasses.replace(bodies, verts=carry(bodies.verts), joints=joints)
    turned = axis_angle(by.turn.double()) @ axis_angle(pose.global_orient.double())  # at the pelvis
    pose = map_tensors(lambda x: x.detach(), dataclasses.replace(
        pose, global_orient=rotation_vectors(turned).to(pose.global_orient),
        transl=pose.transl + by.shift, body_pose=pose.body_pose + by.angles,
    ))  # fmt: skip
    model = load_model(pose.model, pose.gender)
    verts, joints = (x.to(bodies.verts) for x in run_model(model, pose, CHUNK))
    return dataclasses.replace(
        bodies, verts=verts, joints=joints, joint_names=model.joint_names, pose=pose
    )


def larger(bodies: Bodies, factor: Float[Tensor, " bodies"]) -> Bodies:
    """Bodies in camera axes as if the whole room were larger: the camera sees the same.

    With parameters their shapes grow, as people of that height are; where these cannot, since the
    model is not there or has no shapes, bodies become meshes.
    """
    wide = factor.to(bodies.verts)[:, None, None]
    joints = None if bodies.joints is None else wide * bodies.joints
    meshes = dataclasses.replace(bodies, verts=wide * bodies.verts, joints=joints, pose=None)
    pose = bodies.pose
    if pose is None or not pose.betas.shape[1] or (model := _skinned(pose)) is None:
        return meshes
    betas, wide = pose.betas, factor.to(pose.betas)[:, None]
    growth = growth_of(model)[: betas.shape[1]].to(betas)
    grown = betas + wide.log() * growth / growth.square().sum()
    before, after = (shaped(model, some)[1][:, 0].to(pose.transl) for some in (betas, grown))
    pose = dataclasses.replace(pose, betas=grown, transl=wide * (pose.transl + before) - after)
    taller = dataclasses.replace(bodies, pose=pose)
    return corrected(taller, no_correction(taller))


def _skinned(pose: BodyPose) -> SkinnedBody | None:
    """The model of the parameters, where it is there and has shapes."""
    try:
        model = load_model(pose.model, pose.gender)
    except InputError:
        return None
    return model if isinstance(model, SkinnedBody) else None


def statures(pose: BodyPose) -> Float[Tensor, " bodies"] | None:
    """How tall bodies are upright [m]; None where their model is not there."""
    if (model := _skinned(pose)) is None:
        return None
    usual, dirs = heights_of(model)
    count = min(pose.betas.shape[1], len(dirs))
    return usual + pose.betas[:, :count] @ dirs[:count].to(pose.betas)


def spread(verts: Float[Tensor, "verts 3"], count: int) -> Int[Tensor, " picked"]:
    """Vertices that lie evenly over a mesh."""
    return farthest_first(verts, min(count, len(verts))).sort().values


def in_world(bodies: Bodies, camera: Camera) -> Bodies:
    """Bodies from camera axes into the world (vertices and joints; parameters stay behind)."""
    verts, joints = bodies.verts, bodies.joints
    if bodies.space == "camera":
        R = camera.R_cam_world.to(verts)
        verts = to_world(verts, R)
        joints = None if joints is None else to_world(joints, R.to(joints))
    return dataclasses.replace(bodies, verts=verts, joints=joints, space="world", pose=None)
