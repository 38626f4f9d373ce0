"""People of USD: skeletons with animation where the parameters are known, else moving meshes."""

from typing import Any

import numpy as np
import torch

from mover.core.colours import person_colour
from mover.core.types import Bodies
from mover.geometry.mesh import vertex_normals
from mover.io.export.people import FPS, Track, keyframes, seen_from_to
from mover.io.export.posed import Skinned, all_angles, quaternions, rest_of
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
        set_points(mesh, verts[key].numpy(), pxr("Usd").TimeCode(float(track.frame[key])))
    _show(mesh, bodies, track)


def _show(what: Prim, bodies: Bodies, track: Track) -> None:
    """Hide a person while they are not seen."""
    UsdGeom, seen = pxr("UsdGeom"), what.CreateVisibilityAttr()
    first, fps = int(bodies.frame.min()), bodies.fps or FPS
    for start, end in seen_from_to(track):
        if start > 0:
            seen.Set(UsdGeom.Tokens.invisible, float(first))
        seen.Set(UsdGeom.Tokens.inherited, first + round(start * fps))
        if end < track.last:
            seen.Set(UsdGeom.Tokens.invisible, first + round(end * fps) + 1)


def add_skeleton(stage: Stage, skin: Skinned, bodies: Bodies, track: Track) -> None:
    """One person as a skinned mesh on a skeleton, with one sample a frame."""
    Gf, Tf, UsdGeom, UsdSkel, Vt = (
        pxr(name) for name in ("Gf", "Tf", "UsdGeom", "UsdSkel", "Vt")
    )  # fmt: skip
    model, path = skin.model, free_path(stage, "/room", f"person_{track.person}")
    rest, joints = rest_of(skin, int(track.rows[0]))
    names: list[str] = []  # paths of the joints: pelvis/left_hip/left_knee
    for name, parent in zip(model.joint_names, model.parents, strict=True):
        own = Tf.MakeValidIdentifier(name)
        names.append(own if parent < 0 else f"{names[parent]}/{own}")
    bind = torch.eye(4, dtype=torch.float64).repeat(len(joints), 1, 1)
    bind[:, :3, :3], bind[:, :3, 3] = model.tpose.mT.double(), joints.double()
    local = [
        here if parent < 0 else torch.linalg.inv(bind[parent]) @ here
        for here, parent in zip(bind, model.parents, strict=True)
    ]

    def matrices(values: Any) -> Any:  # noqa: ANN401
        """As USD has them, for rows."""
        return Vt.Matrix4dArray([Gf.Matrix4d(value.T.tolist()) for value in values])

    root = UsdSkel.Root.Define(stage, path)
    skeleton = UsdSkel.Skeleton.Define(stage, f"{path}/skeleton")
    skeleton.CreateJointsAttr(names)
    skeleton.CreateJointNamesAttr([str(name) for name in model.joint_names])
    skeleton.CreateBindTransformsAttr(matrices(bind))
    skeleton.CreateRestTransformsAttr(matrices(local))
    motion = UsdSkel.Animation.Define(stage, f"{path}/skeleton/motion")
    motion.CreateJointsAttr(names)
    _move(motion, skin, track, joints)
    source = UsdSkel.BindingAPI.Apply(skeleton.GetPrim()).CreateAnimationSourceRel()
    source.SetTargets([motion.GetPath()])
    tint = person_colour(track.person)
    mesh = add_mesh(stage, f"{path}/body", rest.numpy(), model.faces.numpy(), tint)
    _bind(mesh, skin, rest)
    UsdSkel.BindingAPI(mesh.GetPrim()).CreateSkeletonRel().SetTargets([skeleton.GetPath()])
    verts = bodies.verts[track.rows]
    whole = torch.stack([verts.amin((0, 1)), verts.amax((0, 1))]).double().tolist()
    UsdGeom.ModelAPI.Apply(root.GetPrim()).SetExtentsHint([tuple(corner) for corner in whole])
    _show(UsdGeom.Imageable(root), bodies, track)


def _move(motion: Prim, skin: Skinned, track: Track, joints: torch.Tensor) -> None:
    """Translation, turn and size of every joint in its parent, frame by frame."""
    Gf, Vt = pxr("Gf"), pxr("Vt")
    pose, parents = skin.motion.pose, skin.model.parents
    above = torch.tensor([max(parent, 0) for parent in parents])
    bones = (skin.model.tpose[above] @ (joints - joints[above])[..., None])[..., 0]
    turns = quaternions(all_angles(pose)[track.rows])
    moved = [motion.CreateTranslationsAttr(), motion.CreateRotationsAttr()]
    moved.append(motion.CreateScalesAttr())
    for k, row in enumerate(track.rows.tolist()):
        places, size = bones.clone(), np.ones((len(parents), 3), np.float16)
        places[0] = pose.transl[row] + joints[0]
        size[0] = float(skin.motion.size[row])
        values = (
            Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(places.numpy(), np.float32)),
            Vt.QuatfArray([Gf.Quatf(w, x, y, z) for x, y, z, w in turns[k].tolist()]),
            Vt.Vec3hArray.FromNumpy(size),
        )
        for attr, value in zip(moved, values, strict=True):
            attr.Set(value, float(track.frame[k]))


def _bind(mesh: Prim, skin: Skinned, rest: torch.Tensor) -> None:
    """Normals of the rest shape, and the share of each joint in its vertices."""
    UsdGeom, UsdSkel, Vt = pxr("UsdGeom"), pxr("UsdSkel"), pxr("Vt")
    model = skin.model
    normals = np.ascontiguousarray(vertex_normals(rest, model.faces).numpy(), np.float32)
    mesh.CreateNormalsAttr(Vt.Vec3fArray.FromNumpy(normals))
    mesh.SetNormalsInterpolation(UsdGeom.Tokens.vertex)
    share, joint = model.weights.topk(INFLUENCES, dim=1)
    joint = torch.where(share > 0, joint, 0).to(torch.int32)
    share = (share / share.sum(1, keepdim=True)).float()
    binding = UsdSkel.BindingAPI.Apply(mesh.GetPrim())
    indices = binding.CreateJointIndicesPrimvar(False, INFLUENCES)
    indices.Set(Vt.IntArray.FromNumpy(joint.flatten().numpy()))
    weights = binding.CreateJointWeightsPrimvar(False, INFLUENCES)
    weights.Set(Vt.FloatArray.FromNumpy(share.flatten().numpy()))
    binding.CreateGeomBindTransformAttr(pxr("Gf").Matrix4d(1.0))
