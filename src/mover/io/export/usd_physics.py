"""Physics of USD: rigid bodies of convex pieces with their mass, on a floor that stays."""

import math
from typing import Any

import numpy as np
import torch

from mover.io.export.shell import HEIGHT, Wall, slab
from mover.io.export.solids import AXES, FRICTION, Solid
from mover.io.export.usd_mesh import add_mesh, free_path, pxr

GRAVITY = 9.81  # [m/s²]
PIECE = (0.55, 0.75, 0.9)
"""Colour of convex pieces, which are drawn only where guides are asked for."""
WALL = (0.9, 0.89, 0.86)


def add_laws(stage: Any) -> Any:  # noqa: ANN401
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


def add_floor(stage: Any, height: float, wood: Any) -> None:  # noqa: ANN401
    """A plane without end that nothing falls through; it is not drawn."""
    Gf, UsdGeom, UsdPhysics = pxr("Gf"), pxr("UsdGeom"), pxr("UsdPhysics")

    plane = UsdGeom.Plane.Define(stage, free_path(stage, "/room", "floor_collision"))
    plane.CreateAxisAttr(UsdGeom.Tokens.y)
    plane.CreatePurposeAttr(UsdGeom.Tokens.guide)
    plane.CreateExtentAttr(plane.ComputeExtentFromPlugins(plane, pxr("Usd").TimeCode.Default()))
    plane.AddTranslateOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Vec3d(0, height, 0))
    UsdPhysics.CollisionAPI.Apply(plane.GetPrim())
    _bind(plane.GetPrim(), wood)


def add_walls(stage: Any, walls: tuple[Wall, ...], floor: float, wood: Any) -> None:  # noqa: ANN401
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


def add_solid(stage: Any, body: Any, solid: Solid, wood: Any) -> None:  # noqa: ANN401
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


def _weigh(body: Any, solid: Solid) -> None:  # noqa: ANN401
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


def _bind(prim: Any, wood: Any) -> None:  # noqa: ANN401
    UsdShade = pxr("UsdShade")

    UsdShade.MaterialBindingAPI.Apply(prim).Bind(
        wood, UsdShade.Tokens.weakerThanDescendants, "physics"
    )
