"""scene.usdc: metres, objects with looks and physics, floor, camera, people over time."""

from itertools import zip_longest
from pathlib import Path

import numpy as np
import torch

from mover.core.colours import Colour, colour
from mover.core.files import replacing
from mover.core.run import Run
from mover.core.types import Camera, SceneObject
from mover.geometry.camera import NEAR
from mover.io.export.finished import BodyForm, Exported, Finished, Up
from mover.io.export.people import FPS, tracks_of
from mover.io.export.posed import Skinned, bones_for
from mover.io.export.scene_glb import FLOOR_COLOUR, floor_of, parts_of, view_matrix
from mover.io.export.solids import AXES, FRICTION, Solid, floor_height, solids_of
from mover.io.export.usd_mesh import Prim, Stage, add_look, add_mesh, free_path, pxr
from mover.io.export.usd_people import INFLUENCES, add_moving_mesh, add_skeleton

GRAVITY = 9.81  # [m/s²]
CONVEX = (0.55, 0.75, 0.9)
"""Colour of convex parts, which are drawn only where guides are asked for."""
APERTURE = 20.955  # width of the film [tenths of a scene unit by USD's custom: mm]
FAR = 1000.0  # [m]


def export_usd(finished: Finished, folder: Path, body: BodyForm = "auto", up: Up = "y") -> Exported:
    """Write the room as one binary USD file.

    Each object is a rigid body (translation and turn) with two children: `visual`, the meshes of
    the user's file at their size, and `collision`, convex parts. People are skeletons with
    animation where the parameters of their bodies are known, else meshes with samples of time.

    Args:
        finished: The result; its folder keeps the convex parts.
        folder: Where `scene.usdc` goes.
        body: How people move: on bones (skin), as meshes (morph), not at all (none), or on bones
            where the parameters are known (auto).
        up: y: the world of scene.json; z: turned, with the floor at 0, as simulators have it.

    Raises:
        InputError: If usd-core is not installed, or bones are asked for and there are none.
    """
    skin, bodies = bones_for(finished, body, INFLUENCES), finished.bodies
    path = folder / "scene.usdc"
    with replacing(path) as part:
        part.unlink()
        stage = pxr("Usd").Stage.CreateNew(str(part))
        _head(stage, finished, up)
        _add_scene(stage, finished, folder)
        for track in () if bodies is None or body == "none" else tracks_of(bodies):
            assert bodies is not None
            if isinstance(skin, Skinned):
                add_skeleton(stage, skin, bodies, track)
            else:
                add_moving_mesh(stage, bodies, track)
        stage.GetRootLayer().Save()
    if bodies is None or body == "none":
        return Exported((path,), ("no people",))
    if isinstance(skin, Skinned):
        said = f"people are skeletons, at most {1e3 * skin.miss:.0f} mm off the result"
        return Exported((path,), (said,))
    why = () if body == "morph" else (f"people are moving meshes, not skeletons: {skin}",)
    said = "people's meshes move in straight lines between samples, 2 mm off"
    return Exported((path,), (*why, said))


def _head(stage: Stage, finished: Finished, up: Up) -> None:
    """Units, axes, time, and the one root below which everything is."""
    Gf, UsdGeom = pxr("Gf"), pxr("UsdGeom")
    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    pxr("UsdPhysics").SetStageKilogramsPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y if up == "y" else UsdGeom.Tokens.z)
    room = UsdGeom.Xform.Define(stage, "/room")
    pxr("Usd").ModelAPI(room.GetPrim()).SetKind("group")
    stage.SetDefaultPrim(room.GetPrim())
    if up == "z":
        double = UsdGeom.XformOp.PrecisionDouble
        room.AddTranslateOp(double).Set(Gf.Vec3d(0, 0, -floor_height(finished.scene)))
        room.AddRotateXOp(double).Set(90.0)
    bodies = finished.bodies
    if bodies is not None:
        stage.SetTimeCodesPerSecond(bodies.fps or FPS)
        stage.SetFramesPerSecond(bodies.fps or FPS)
        stage.SetStartTimeCode(int(bodies.frame.min()))
        stage.SetEndTimeCode(int(bodies.frame.max()))


def _add_scene(stage: Stage, finished: Finished, folder: Path) -> None:
    scene, wood = finished.scene, _add_laws(stage)
    solids = solids_of(scene, Run(finished.out))
    for index, (item, solid) in enumerate(zip(scene.objects, solids, strict=True)):
        _add_solid(stage, _add_object(stage, item, colour(index), folder), solid, wood)
    if scene.ground is not None:
        floor, path = floor_of(scene, scene.ground), free_path(stage, "/room", "ground")
        add_mesh(stage, path, floor.verts.numpy(), floor.faces.numpy(), FLOOR_COLOUR)
    _add_floor(stage, floor_height(scene), wood)
    _add_camera(stage, scene.camera)


def _add_object(stage: Stage, item: SceneObject, tint: Colour, folder: Path) -> Prim:
    """A translation and a turn, and below them the looks at their size; the transform."""
    Gf, UsdGeom = pxr("Gf"), pxr("UsdGeom")
    node = UsdGeom.Xform.Define(stage, free_path(stage, "/room", item.id))
    prim, double = node.GetPrim(), UsdGeom.XformOp.PrecisionDouble
    pxr("Usd").ModelAPI(prim).SetKind("component")
    prim.SetCustomDataByKey("mover:id", item.id)
    prim.SetCustomDataByKey("mover:category", item.category)
    move, turn = node.AddTranslateOp(double), node.AddRotateYOp(double)
    move.Set(Gf.Vec3d(*item.t_world_object.tolist()))
    turn.Set(float(np.degrees(float(item.yaw))))
    for segment, after in zip_longest(item.segments, item.segments[1:]):
        moments = [segment.frame]  # and the last frame: USD would let it glide to the next
        if after is not None and after.frame > segment.frame + 1:
            moments.append(after.frame - 1)
        for moment in moments:
            move.Set(Gf.Vec3d(*segment.t_world_object.tolist()), moment)
            turn.Set(float(np.degrees(float(segment.yaw))), moment)
    looks = UsdGeom.Xform.Define(stage, node.GetPath().AppendChild("visual"))
    looks.AddScaleOp(double).Set(Gf.Vec3d(*item.scale.tolist()))
    for part, transform in parts_of(item, tint):
        path = free_path(stage, str(looks.GetPath()), "mesh")
        mesh = add_mesh(stage, path, np.asarray(part.vertices), np.asarray(part.faces), tint)
        mesh.AddTransformOp(double).Set(Gf.Matrix4d(transform.T.tolist()))
        add_look(stage, mesh, part, folder)
    return prim


def _add_camera(stage: Stage, camera: Camera) -> None:
    """USD's cameras look along -z with +y up; the film is moved for the principal point."""
    Gf, UsdGeom = pxr("Gf"), pxr("UsdGeom")
    lens = UsdGeom.Camera.Define(stage, free_path(stage, "/room", "camera"))
    fx, fy = float(camera.K[0, 0]), float(camera.K[1, 1])
    cx, cy = float(camera.K[0, 2]), float(camera.K[1, 2])
    focal = fx / camera.width * APERTURE
    height = camera.height / fy * focal
    lens.CreateFocalLengthAttr(focal)
    lens.CreateHorizontalApertureAttr(APERTURE)
    lens.CreateVerticalApertureAttr(height)
    lens.CreateHorizontalApertureOffsetAttr(APERTURE * (0.5 - cx / camera.width))
    lens.CreateVerticalApertureOffsetAttr(height * (cy / camera.height - 0.5))
    lens.CreateClippingRangeAttr(Gf.Vec2f(NEAR, FAR))
    view = lens.AddTransformOp(UsdGeom.XformOp.PrecisionDouble)
    view.Set(Gf.Matrix4d(view_matrix(camera).T.tolist()))


# Physics.


def _add_laws(stage: Stage) -> Prim:
    """Gravity and the friction of wood; the material of all colliding parts."""
    Gf, UsdPhysics = pxr("Gf"), pxr("UsdPhysics")
    laws = UsdPhysics.Scene.Define(stage, "/room/physics")
    up = pxr("UsdGeom").GetStageUpAxis(stage)
    laws.CreateGravityDirectionAttr(Gf.Vec3f(0, -1, 0) if up == "Y" else Gf.Vec3f(0, 0, -1))
    laws.CreateGravityMagnitudeAttr(GRAVITY)
    wood = pxr("UsdShade").Material.Define(stage, "/room/wood")
    slip = UsdPhysics.MaterialAPI.Apply(wood.GetPrim())
    slip.CreateStaticFrictionAttr(FRICTION[0])
    slip.CreateDynamicFrictionAttr(FRICTION[0])
    slip.CreateRestitutionAttr(0.0)
    return wood


def _collide(prim: Prim, wood: Prim) -> None:
    """Let a shape collide with a material's friction."""
    UsdShade = pxr("UsdShade")
    pxr("UsdPhysics").CollisionAPI.Apply(prim)
    weak = UsdShade.Tokens.weakerThanDescendants
    UsdShade.MaterialBindingAPI.Apply(prim).Bind(wood, weak, "physics")


def _add_floor(stage: Stage, height: float, wood: Prim) -> None:
    """A plane without end that nothing falls through; it is not drawn."""
    UsdGeom = pxr("UsdGeom")
    plane = UsdGeom.Plane.Define(stage, free_path(stage, "/room", "floor_collision"))
    plane.CreateAxisAttr(UsdGeom.Tokens.y)
    plane.CreatePurposeAttr(UsdGeom.Tokens.guide)
    plane.CreateExtentAttr(plane.ComputeExtentFromPlugins(plane, pxr("Usd").TimeCode.Default()))
    move = plane.AddTranslateOp(UsdGeom.XformOp.PrecisionDouble)
    move.Set(pxr("Gf").Vec3d(0, height, 0))
    _collide(plane.GetPrim(), wood)


def _add_solid(stage: Stage, body: Prim, solid: Solid, wood: Prim) -> None:
    """Make a transform a rigid body with convex parts, apart from what is drawn.

    Args:
        stage: The file.
        body: Its transform: a translation and a turn, so that the parts have no scale of their own.
        solid: Its parts in the simulator's axes.
        wood: The material of their surfaces.
    """
    Gf, UsdGeom, UsdPhysics = pxr("Gf"), pxr("UsdGeom"), pxr("UsdPhysics")
    if solid.free:
        UsdPhysics.RigidBodyAPI.Apply(body)
        mass = UsdPhysics.MassAPI.Apply(body)
        mass.CreateMassAttr(solid.mass)
        mass.CreateCenterOfMassAttr(Gf.Vec3f(*(AXES.mT @ solid.centre).tolist()))
        moments, axes = torch.linalg.eigh(AXES.mT @ solid.inertia @ AXES)
        axes = axes * torch.linalg.det(axes).sign()
        mass.CreateDiagonalInertiaAttr(Gf.Vec3f(*moments.tolist()))
        turn = Gf.Matrix3d(*axes.mT.flatten().tolist())
        mass.CreatePrincipalAxesAttr(Gf.Quatf(turn.ExtractRotation().GetQuat()))
    parts = UsdGeom.Xform.Define(stage, body.GetPath().AppendChild("collision"))
    parts.CreatePurposeAttr(UsdGeom.Tokens.guide)
    for k, hull in enumerate(solid.hulls):
        path = str(parts.GetPath().AppendChild(f"piece_{k}"))
        verts = (hull.verts @ AXES).numpy()
        part = add_mesh(stage, path, verts, hull.faces.numpy(), CONVEX).GetPrim()
        shape = UsdPhysics.MeshCollisionAPI.Apply(part)
        shape.CreateApproximationAttr(UsdPhysics.Tokens.convexHull)
        _collide(part, wood)
