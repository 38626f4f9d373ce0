"""scene.usdc: metres, objects with looks and physics, floor, camera, people over time."""

import math
from collections.abc import Iterator
from itertools import zip_longest
from pathlib import Path

import numpy as np
import torch

from mover.core.colours import Colour, colour
from mover.core.files import replacing
from mover.core.run import Run
from mover.core.types import Bodies, Camera, SceneObject, Segment
from mover.geometry.camera import NEAR
from mover.io.export.finished import BodyForm, Exported, Finished, Up
from mover.io.export.people import FPS, tracks_of
from mover.io.export.posed import Skin, bones_for
from mover.io.export.scene_glb import floor_of, parts_of, view_matrix
from mover.io.export.shell import HEIGHT, Wall, Walls, slab, wall_notes
from mover.io.export.solids import AXES, FRICTION, Solid, floor_height, solids_of
from mover.io.export.usd_mesh import Prim, Stage, add_look, add_mesh, free_path, pxr
from mover.io.export.usd_people import INFLUENCES, add_moving_mesh, add_skeleton

GRAVITY = 9.81  # [m/s²]
PIECE = (0.55, 0.75, 0.9)
"""Colour of convex pieces, which are drawn only where guides are asked for."""
WALL = (0.9, 0.89, 0.86)


def add_laws(stage: Stage) -> Prim:
    """Gravity and the friction of wood; the material that all pieces take."""
    Gf, UsdPhysics, UsdShade = pxr("Gf"), pxr("UsdPhysics"), pxr("UsdShade")

    laws = UsdPhysics.Scene.Define(stage, "/room/physics")
    up = pxr("UsdGeom").GetStageUpAxis(stage)
    laws.CreateGravityDirectionAttr(Gf.Vec3f(0, -1, 0) if up == "Y" else Gf.Vec3f(0, 0, -1))
    laws.CreateGravityMagnitudeAttr(GRAVITY)
    wood = UsdShade.Material.Define(stage, "/room/wood")
    slip = UsdPhysics.MaterialAPI.Apply(wood.GetPrim())
    slip.CreateStaticFrictionAttr(FRICTION[0])
    slip.CreateDynamicFrictionAttr(FRICTION[0])
    slip.CreateRestitutionAttr(0.0)
    return wood


def add_floor(stage: Stage, height: float, wood: Prim) -> None:
    """A plane without end that nothing falls through; it is not drawn."""
    Gf, UsdGeom, UsdPhysics = pxr("Gf"), pxr("UsdGeom"), pxr("UsdPhysics")

    plane = UsdGeom.Plane.Define(stage, free_path(stage, "/room", "floor_collision"))
    plane.CreateAxisAttr(UsdGeom.Tokens.y)
    plane.CreatePurposeAttr(UsdGeom.Tokens.guide)
    plane.CreateExtentAttr(plane.ComputeExtentFromPlugins(plane, pxr("Usd").TimeCode.Default()))
    plane.AddTranslateOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Vec3d(0, height, 0))
    UsdPhysics.CollisionAPI.Apply(plane.GetPrim())
    _bind(plane.GetPrim(), wood)


def add_walls(stage: Stage, walls: tuple[Wall, ...], floor: float, wood: Prim) -> None:
    """Boxes that stand still, marked as guessed."""
    Gf, UsdGeom, UsdPhysics = pxr("Gf"), pxr("UsdGeom"), pxr("UsdPhysics")

    double = UsdGeom.XformOp.PrecisionDouble
    for k, wall in enumerate(walls):
        (x, z), (length, thick), yaw = slab(wall)
        cube = UsdGeom.Cube.Define(stage, free_path(stage, "/room", f"guessed_wall_{k}"))
        cube.CreateSizeAttr(1.0)
        cube.CreateExtentAttr([(-0.5, -0.5, -0.5), (0.5, 0.5, 0.5)])
        cube.CreateDisplayColorAttr([WALL])
        cube.AddTranslateOp(double).Set(Gf.Vec3d(x, floor + HEIGHT / 2, z))
        cube.AddRotateYOp(double).Set(math.degrees(yaw))
        cube.AddScaleOp(double).Set(Gf.Vec3d(length, HEIGHT, thick))
        cube.GetPrim().SetCustomDataByKey("mover:guessed_from", wall.source)
        UsdPhysics.CollisionAPI.Apply(cube.GetPrim())
        _bind(cube.GetPrim(), wood)


def add_solid(stage: Stage, body: Prim, solid: Solid, wood: Prim) -> None:
    """Make a transform a rigid body and give it convex pieces, apart from what is drawn.

    Args:
        stage: The file.
        body: Its transform: a place and a turn, so that the pieces have no scale of their own.
        solid: Its pieces in the simulator's axes.
        wood: The material of their surfaces.
    """
    UsdGeom, UsdPhysics = pxr("UsdGeom"), pxr("UsdPhysics")

    if solid.free:
        UsdPhysics.RigidBodyAPI.Apply(body)
        _weigh(body, solid)
    pieces = UsdGeom.Xform.Define(stage, body.GetPath().AppendChild("collision"))
    pieces.CreatePurposeAttr(UsdGeom.Tokens.guide)
    for k, hull in enumerate(solid.hulls):
        path = str(pieces.GetPath().AppendChild(f"piece_{k}"))
        verts = hull.verts @ AXES
        piece = add_mesh(stage, path, verts.numpy(), hull.faces.numpy(), PIECE).GetPrim()
        UsdPhysics.CollisionAPI.Apply(piece)
        shape = UsdPhysics.MeshCollisionAPI.Apply(piece)
        shape.CreateApproximationAttr(UsdPhysics.Tokens.convexHull)
        _bind(piece, wood)


def _weigh(body: Prim, solid: Solid) -> None:
    """Mass, its centre, and the moments about the axes of inertia."""
    Gf, UsdPhysics = pxr("Gf"), pxr("UsdPhysics")

    mass = UsdPhysics.MassAPI.Apply(body)
    mass.CreateMassAttr(solid.mass)
    mass.CreateCenterOfMassAttr(Gf.Vec3f(*(AXES.mT @ solid.centre).tolist()))
    moments, axes = torch.linalg.eigh(AXES.mT @ solid.inertia @ AXES)
    axes = axes * torch.linalg.det(axes).sign()
    mass.CreateDiagonalInertiaAttr(Gf.Vec3f(*moments.tolist()))
    turn = Gf.Matrix3d(*np.ascontiguousarray(axes.mT.numpy()).reshape(-1).tolist())
    mass.CreatePrincipalAxesAttr(Gf.Quatf(turn.ExtractRotation().GetQuat()))


def _bind(prim: Prim, wood: Prim) -> None:
    UsdShade = pxr("UsdShade")

    UsdShade.MaterialBindingAPI.Apply(prim).Bind(
        wood, UsdShade.Tokens.weakerThanDescendants, "physics"
    )


# The file.


APERTURE = 20.955  # width of the film [tenths of a scene unit by USD's custom: mm]
FAR = 1000.0  # [m]


def export_usd(
    finished: Finished,
    folder: Path,
    body: BodyForm = "auto",
    up: Up = "y",
    walls: Walls = "none",
) -> Exported:
    """Write the room as one binary USD file.

    Each object is a rigid body (place and turn) with two children: `visual`, the meshes of the
    user's file at their size, and `collision`, convex pieces. People are skeletons with animation
    where the parameters of their bodies are known, else meshes with samples of time.

    Args:
        finished: The result; its folder keeps the convex pieces.
        folder: Where `scene.usdc` goes.
        body: How people move: on bones (skin), as meshes (morph), not at all (none), or on bones
            where the parameters are known (auto).
        up: y: the world of scene.json; z: turned, with the floor at 0, as simulators have it.
        walls: Whether walls are guessed from furniture and people.

    Raises:
        InputError: If usd-core is not installed, or bones are asked for and there are none.
    """
    skin, shell = bones_for(finished, body, INFLUENCES), ()
    if walls == "guess":
        shell = finished.shell()
    path = folder / "scene.usdc"
    with replacing(path) as part:
        part.unlink()
        stage = pxr("Usd").Stage.CreateNew(str(part))
        _head(stage, finished, up)
        _add_scene(stage, finished, folder, shell)
        if body != "none":
            _add_people(stage, finished.bodies, skin)
        stage.GetRootLayer().Save()
    notes = _notes(finished, skin, body)
    return Exported((path,), (*notes, *(wall_notes(shell) if walls == "guess" else ())))


def _add_people(stage: Stage, bodies: Bodies | None, skin: Skin | str) -> None:
    for track in () if bodies is None else tracks_of(bodies):
        assert bodies is not None
        if isinstance(skin, Skin):
            add_skeleton(stage, skin, bodies, track)
        else:
            add_moving_mesh(stage, bodies, track)


def _notes(finished: Finished, skin: Skin | str, body: BodyForm) -> tuple[str, ...]:
    if finished.bodies is None or body == "none":
        return ("no people",)
    if isinstance(skin, Skin):
        return (f"people are skeletons, at most {1e3 * skin.miss:.0f} mm off the result",)
    why = [] if body == "morph" else [f"people are moving meshes, not skeletons: {skin}"]
    return (*why, "people's meshes move in straight lines between samples, 2 mm off")


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


def _add_scene(stage: Stage, finished: Finished, folder: Path, shell: tuple[Wall, ...]) -> None:
    scene, wood = finished.scene, add_laws(stage)
    solids = solids_of(scene, Run(finished.out))
    for index, (piece, solid) in enumerate(zip(scene.objects, solids, strict=True)):
        body = _add_object(stage, piece, colour(index), folder)
        add_solid(stage, body, solid, wood)
    if scene.ground is not None:
        floor = floor_of(scene, scene.ground)
        verts, faces = floor.verts.double().numpy(), floor.faces.numpy()
        path = free_path(stage, "/room", "ground")
        add_mesh(stage, path, verts, faces, (0.86, 0.85, 0.83))
    add_floor(stage, floor_height(scene), wood)
    add_walls(stage, shell, floor_height(scene), wood)
    _add_camera(stage, scene.camera)


def _add_object(stage: Stage, piece: SceneObject, tint: Colour, folder: Path) -> Prim:
    """A place and a turn, and below them the looks at their size; the transform."""
    Gf, UsdGeom = pxr("Gf"), pxr("UsdGeom")

    node = UsdGeom.Xform.Define(stage, free_path(stage, "/room", piece.id))
    prim, double = node.GetPrim(), UsdGeom.XformOp.PrecisionDouble
    pxr("Usd").ModelAPI(prim).SetKind("component")
    prim.SetCustomDataByKey("mover:id", piece.id)
    prim.SetCustomDataByKey("mover:category", piece.category)
    move, turn = node.AddTranslateOp(double), node.AddRotateYOp(double)
    move.Set(Gf.Vec3d(*piece.t_world_object.tolist()))
    turn.Set(float(np.degrees(float(piece.yaw))))
    for moment, place in _held(piece):
        move.Set(Gf.Vec3d(*place.t_world_object.tolist()), moment)
        turn.Set(float(np.degrees(float(place.yaw))), moment)
    looks = UsdGeom.Xform.Define(stage, node.GetPath().AppendChild("visual"))
    looks.AddScaleOp(double).Set(Gf.Vec3d(*piece.scale.tolist()))
    for part, transform in parts_of(piece, tint):
        path = free_path(stage, str(looks.GetPath()), "mesh")
        mesh = add_mesh(stage, path, np.asarray(part.vertices), np.asarray(part.faces), tint)
        mesh.AddTransformOp(double).Set(Gf.Matrix4d(transform.T.tolist()))
        add_look(stage, mesh, part, folder)
    return prim


def _held(piece: SceneObject) -> Iterator[tuple[int, Segment]]:
    """The first and the last frame of each segment: between samples, USD would let it glide."""
    for segment, after in zip_longest(piece.segments, piece.segments[1:]):
        yield segment.frame, segment
        if after is not None and after.frame > segment.frame + 1:
            yield after.frame - 1, segment


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
    lens.AddTransformOp(UsdGeom.XformOp.PrecisionDouble).Set(
        Gf.Matrix4d(view_matrix(camera).T.tolist())
    )
