"""People of USD: skeletons with animation where the parameters are known, else moving meshes."""

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mover.core.colours import person_colour
from mover.core.types import Bodies
from mover.geometry.mesh import vertex_normals
from mover.io.export.people import FPS, Track, keyframes, seen_from_to
from mover.io.export.posed import Skin, all_angles, quaternions, rest_of
from mover.io.export.usd_mesh import Prim, Stage, add_mesh, free_path, pxr, set_points

TOLERANCE = 0.002  # [m], of the straight lines between two samples of time
MOST = 100_000
INFLUENCES = 8  # joints that may move a vertex


def add_moving_mesh(stage: Stage, bodies: Bodies, track: Track) -> None:
    """One person as a mesh with samples of time; they are straight lines between, 2 mm off."""
    verts = bodies.verts[track.rows].detach().cpu().float()
    keys, _ = keyframes(verts, track.time, TOLERANCE, MOST)
    path = free_path(stage, "/room", f"person_{track.person}")
    tint = person_colour(track.person)
    mesh = add_mesh(stage, path, verts[0].numpy(), bodies.faces.cpu().numpy(), tint)
    for key in keys:
        set_points(mesh, verts[key].numpy(), float(track.frame[key]))
    _show(mesh, bodies, track)


def _show(what: Prim, bodies: Bodies, track: Track) -> None:
    """Hide a person while nobody sees them."""
    UsdGeom = pxr("UsdGeom")

    seen = what.CreateVisibilityAttr()
    first, fps = int(bodies.frame.min()), bodies.fps or FPS
    for start, end in seen_from_to(track):
        if start > 0:
            seen.Set(UsdGeom.Tokens.invisible, float(first))
        seen.Set(UsdGeom.Tokens.inherited, first + round(start * fps))
        if end < track.last:
            seen.Set(UsdGeom.Tokens.invisible, first + round(end * fps) + 1)


def add_skeleton(stage: Stage, skin: Skin, bodies: Bodies, track: Track) -> None:
    """One person as a skinned mesh on a skeleton, with one sample a frame."""
    UsdGeom, UsdSkel = pxr("UsdGeom"), pxr("UsdSkel")

    path = free_path(stage, "/room", f"person_{track.person}")
    root = UsdSkel.Root.Define(stage, path)
    skeleton = UsdSkel.Skeleton.Define(stage, f"{path}/skeleton")
    _, joints = rest_of(skin, int(track.rows[0]))
    names = _tokens(skin)
    bind = _bind_matrices(skin, joints)
    skeleton.CreateJointsAttr(names)
    skeleton.CreateJointNamesAttr([str(name) for name in skin.model.joint_names])
    skeleton.CreateBindTransformsAttr(_matrices(bind))
    skeleton.CreateRestTransformsAttr(_matrices(_local(skin, bind)))
    motion = UsdSkel.Animation.Define(stage, f"{path}/skeleton/motion")
    motion.CreateJointsAttr(names)
    _move(motion, skin, track, joints)
    UsdSkel.BindingAPI.Apply(skeleton.GetPrim()).CreateAnimationSourceRel().SetTargets(
        [motion.GetPath()]
    )
    mesh = _add_skin(stage, skin, track, path)
    UsdSkel.BindingAPI(mesh).CreateSkeletonRel().SetTargets([skeleton.GetPath()])
    places = bodies.verts[track.rows]
    whole = torch.stack([places.amin((0, 1)), places.amax((0, 1))]).double().tolist()
    hint = UsdGeom.ModelAPI.Apply(root.GetPrim())
    hint.SetExtentsHint([tuple(corner) for corner in whole])
    _show(UsdGeom.Imageable(root), bodies, track)


def _tokens(skin: Skin) -> list[str]:
    """Paths of the joints, as USD tells parents: pelvis/left_hip/left_knee."""
    Tf = pxr("Tf")

    names: list[str] = []
    for name, parent in zip(skin.model.joint_names, skin.model.parents, strict=True):
        own = Tf.MakeValidIdentifier(name)
        names.append(own if parent < 0 else f"{names[parent]}/{own}")
    return names


def _bind_matrices(skin: Skin, joints: Float[Tensor, "joints 3"]) -> Float[Tensor, "joints 4 4"]:
    """From the axes of each joint to the rest shape, for columns."""
    matrix = torch.eye(4, dtype=torch.float64).repeat(len(joints), 1, 1)
    matrix[:, :3, :3] = skin.model.tpose.mT.double()
    matrix[:, :3, 3] = joints.double()
    return matrix


def _local(skin: Skin, bind: Float[Tensor, "joints 4 4"]) -> Float[Tensor, "joints 4 4"]:
    """The same in the axes of each joint's parent."""
    found = [
        here if parent < 0 else torch.linalg.inv(bind[parent]) @ here
        for here, parent in zip(bind, skin.model.parents, strict=True)
    ]
    return torch.stack(found)


def _matrices(values: Float[Tensor, "joints 4 4"]) -> Prim:
    """As USD has them, for rows."""
    Gf, Vt = pxr("Gf"), pxr("Vt")

    return Vt.Matrix4dArray([Gf.Matrix4d(value.T.tolist()) for value in values])


def _move(motion: Prim, skin: Skin, track: Track, joints: Float[Tensor, "joints 3"]) -> None:
    """Place, turn and size of every joint in its parent, frame by frame."""
    Gf, Vt = pxr("Gf"), pxr("Vt")

    pose, parents = skin.motion.pose, skin.model.parents
    above = torch.tensor([max(parent, 0) for parent in parents])
    bones = (skin.model.tpose[above] @ (joints - joints[above])[..., None])[..., 0]
    turns = quaternions(all_angles(pose)[track.rows])
    moved = [attr() for attr in (
        motion.CreateTranslationsAttr, motion.CreateRotationsAttr, motion.CreateScalesAttr,
    )]  # fmt: skip
    for k, row in enumerate(track.rows.tolist()):
        places = bones.clone()
        places[0] = pose.transl[row] + joints[0]
        size = np.ones((len(parents), 3), np.float16)
        size[0] = float(skin.motion.size[row])
        quats = [Gf.Quatf(float(w), float(x), float(y), float(z)) for x, y, z, w in turns[k]]
        values = (
            Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(places.numpy(), np.float32)),
            Vt.QuatfArray(quats),
            Vt.Vec3hArray.FromNumpy(size),
        )
        for attr, value in zip(moved, values, strict=True):
            attr.Set(value, float(track.frame[k]))


def _add_skin(stage: Stage, skin: Skin, track: Track, path: str) -> Prim:
    """The rest shape with the share of each joint in its vertices."""
    Gf, UsdGeom, UsdSkel, Vt = pxr("Gf"), pxr("UsdGeom"), pxr("UsdSkel"), pxr("Vt")

    rest, _ = rest_of(skin, int(track.rows[0]))
    model, tint = skin.model, person_colour(track.person)
    mesh = add_mesh(stage, f"{path}/body", rest.numpy(), model.faces.numpy(), tint)
    normals = np.ascontiguousarray(vertex_normals(rest, model.faces).numpy(), np.float32)
    mesh.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(normals))
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    share, joint = model.weights.topk(INFLUENCES, dim=1)
    joint = torch.where(share > 0, joint, 0)
    share = share / share.sum(1, keepdim=True)
    binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    indices = Vt.IntArray.FromNumpy(joint.numpy().astype(np.int32).reshape(-1))
    binding.CreateJointIndicesPrimvar(False, INFLUENCES).Set(indices)
    weights = Vt.FloatArray.FromNumpy(share.numpy().astype(np.float32).reshape(-1))
    binding.CreateJointWeightsPrimvar(False, INFLUENCES).Set(weights)
    binding.CreateGeomBindTransformAttr(Gf.Matrix4d(1.0))
    return mesh.GetPrim()
