"""scene.usdc: metres, objects with looks and physics, floor, camera, people over time."""

from hashlib import sha256
from importlib import import_module
from importlib.util import find_spec
from io import BytesIO
from itertools import zip_longest
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from mover.core.colours import Colour, colour, person_colour
from mover.core.errors import InputError
from mover.core.files import replacing
from mover.core.run import Run
from mover.core.types import Bodies, Camera, SceneObject
from mover.geometry.camera import NEAR
from mover.io.export import scene_glb
from mover.io.export.finished import BodyForm, Exported, Finished, Track, Up, keyframes, tracks_of
from mover.io.export.solids import AXES, FRICTION, Solid, floor_height, solids_of

GRAVITY = 9.81  # [m/s²]
CONVEX = (0.55, 0.75, 0.9)
"""Colour of convex parts, which are drawn only where guides are asked for."""
APERTURE = 20.955  # width of the film [tenths of a scene unit by USD's custom: mm]
FAR = 1000.0  # [m]
TOLERANCE = 0.002  # [m], of the straight lines between two samples of time
MOST = 100_000  # samples of time
Stage = Any
"""A file of OpenUSD, whose Python modules have no types and fill themselves when imported."""
Prim = Any
"""A node in it, or the schema that defines it."""


def pxr(name: str) -> Any:  # noqa: ANN401
    """The module `pxr.<name>`.

    Raises:
        InputError: If usd-core is not installed.
    """
    if find_spec("pxr") is None:
        cure = "pip install -e '.[usd]' in mover's folder"
        raise InputError(f"--to usd: usd-core is not installed; {cure}")
    return import_module(f"pxr.{name}")


def export_usd(finished: Finished, folder: Path, body: BodyForm = "auto", up: Up = "y") -> Exported:
    """Write the room as `scene.usdc`; with z up the floor is at 0, as simulators have it.

    Each object is a rigid body (translation and turn) with two children: `visual`, the meshes of
    the user's file at their size, and `collision`, convex parts. People are meshes with samples of
    time.

    Raises:
        InputError: If usd-core is not installed.
    """
    bodies = None if body == "none" else finished.bodies
    path = folder / "scene.usdc"
    with replacing(path) as part:
        part.unlink()
        stage = pxr("Usd").Stage.CreateNew(str(part))
        _head(stage, finished, up)
        _add_scene(stage, finished, folder)
        if bodies is not None:
            for track in tracks_of(bodies):
                _add_person(stage, bodies, track, finished.clock)
        stage.GetRootLayer().Save()
    moving = "people's meshes move in straight lines between samples, 2 mm off"
    notes = ("no people" if bodies is None else moving, *scene_glb.losses_of(finished.scene))
    return Exported((path,), notes)


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
        first, fps = finished.clock
        stage.SetTimeCodesPerSecond(fps)
        stage.SetFramesPerSecond(fps)
        stage.SetStartTimeCode(first)
        stage.SetEndTimeCode(int(bodies.frame.max()))


def _add_scene(stage: Stage, finished: Finished, folder: Path) -> None:
    scene, wood, UsdGeom = finished.scene, _add_laws(stage), pxr("UsdGeom")
    solids = solids_of(scene, Run(finished.out))
    for index, (item, solid) in enumerate(zip(scene.objects, solids, strict=True)):
        _add_solid(stage, _add_object(stage, item, colour(index), folder), solid, wood)
    if scene.ground is not None:
        floor, path = scene_glb.floor_of(scene, scene.ground), free_path(stage, "/room", "ground")
        add_mesh(stage, path, floor.verts.numpy(), floor.faces.numpy(), scene_glb.FLOOR_COLOUR)
    plane = UsdGeom.Plane.Define(stage, free_path(stage, "/room", "floor_collision"))
    plane.CreateAxisAttr(UsdGeom.Tokens.y)  # without end, for nothing to fall through; not drawn
    plane.CreatePurposeAttr(UsdGeom.Tokens.guide)
    plane.CreateExtentAttr(plane.ComputeExtentFromPlugins(plane, pxr("Usd").TimeCode.Default()))
    move = plane.AddTranslateOp(UsdGeom.XformOp.PrecisionDouble)
    move.Set(pxr("Gf").Vec3d(0, floor_height(scene), 0))
    _collide(plane.GetPrim(), wood)
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
    for part, transform in scene_glb.parts_of(item, tint):
        path = free_path(stage, str(looks.GetPath()), "mesh")
        mesh = add_mesh(stage, path, np.asarray(part.vertices), np.asarray(part.faces), tint)
        mesh.AddTransformOp(double).Set(Gf.Matrix4d(transform.T.tolist()))
        add_look(stage, mesh, part, folder)
    return prim


def _add_camera(stage: Stage, camera: Camera) -> None:
    """USD's cameras look along -z with +y up; the film is moved for the principal point."""
    Gf, UsdGeom = pxr("Gf"), pxr("UsdGeom")
    lens = UsdGeom.Camera.Define(stage, free_path(stage, "/room", "camera"))
    (fx, _, cx), (_, fy, cy), _ = camera.K.tolist()
    focal = fx / camera.width * APERTURE
    height = camera.height / fy * focal
    lens.CreateFocalLengthAttr(focal)
    lens.CreateHorizontalApertureAttr(APERTURE)
    lens.CreateVerticalApertureAttr(height)
    lens.CreateHorizontalApertureOffsetAttr(APERTURE * (0.5 - cx / camera.width))
    lens.CreateVerticalApertureOffsetAttr(height * (cy / camera.height - 0.5))
    lens.CreateClippingRangeAttr(Gf.Vec2f(NEAR, FAR))
    view = lens.AddTransformOp(UsdGeom.XformOp.PrecisionDouble)
    view.Set(Gf.Matrix4d(scene_glb.view_matrix(camera).T.tolist()))


def _add_person(stage: Stage, bodies: Bodies, track: Track, clock: tuple[int, float]) -> None:
    """A mesh with samples of time, straight lines between them, hidden where not visible."""
    UsdGeom, TimeCode = pxr("UsdGeom"), pxr("Usd").TimeCode
    verts = bodies.verts[track.rows].detach().cpu().float()
    path = free_path(stage, "/room", f"person_{track.person}")
    tint = person_colour(track.person)
    mesh = add_mesh(stage, path, verts[0].numpy(), bodies.faces.cpu().numpy(), tint)
    for key in keyframes(verts, track.time, TOLERANCE, MOST)[0]:
        set_points(mesh, verts[key].numpy(), TimeCode(float(track.frame[key])))
    visible, (first, fps) = mesh.CreateVisibilityAttr(), clock
    for start, end in track.spans():
        if start > 0:
            visible.Set(UsdGeom.Tokens.invisible, float(first))
        visible.Set(UsdGeom.Tokens.inherited, first + round(start * fps))
        if end < track.last:
            visible.Set(UsdGeom.Tokens.invisible, first + round(end * fps) + 1)


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


def _add_solid(stage: Stage, body: Prim, solid: Solid, wood: Prim) -> None:
    """Make a transform without scale a rigid body with convex parts, apart from what is drawn."""
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


def free_path(stage: Stage, parent: str, name: str) -> str:
    """A path that USD allows and that nothing has yet."""
    path = f"{parent}/{pxr('Tf').MakeValidIdentifier(name)}"
    while stage.GetPrimAtPath(path):
        path += "_"
    return path


def add_mesh(
    stage: Stage, path: str, verts: NDArray[Any], faces: NDArray[Any], tint: Colour
) -> Prim:
    """Triangles of one colour, without a subdivision."""
    UsdGeom, Vt = pxr("UsdGeom"), pxr("Vt")
    mesh = UsdGeom.Mesh.Define(stage, path)
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateDoubleSidedAttr(True)
    flat = np.ascontiguousarray(faces, np.int32).reshape(-1)
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(faces), 3, np.int32)))
    mesh.CreateFaceVertexIndicesAttr(Vt.IntArray.FromNumpy(flat))
    set_points(mesh, verts, pxr("Usd").TimeCode.Default())
    mesh.CreateDisplayColorAttr([tint])
    return mesh


def set_points(mesh: Prim, points: NDArray[Any], time: Any) -> None:  # noqa: ANN401
    """Vertices and extent at a time of USD."""
    Vt, points = pxr("Vt"), np.ascontiguousarray(points, np.float32)
    mesh.CreatePointsAttr().Set(Vt.Vec3fArray.FromNumpy(points), time)
    extent = np.stack([points.min(0), points.max(0)])
    mesh.CreateExtentAttr().Set(Vt.Vec3fArray.FromNumpy(extent), time)


def add_look(stage: Stage, mesh: Prim, part: Any, folder: Path) -> None:  # noqa: ANN401
    """Give a mesh the material of a trimesh part: its texture or colour, or colours of vertices."""
    from trimesh.visual import ColorVisuals
    from trimesh.visual.material import PBRMaterial

    Gf, Sdf, UsdShade, UsdGeom, Vt = (
        pxr(name) for name in ("Gf", "Sdf", "UsdShade", "UsdGeom", "Vt")
    )
    kinds, vertex = Sdf.ValueTypeNames, UsdGeom.Tokens.vertex
    if isinstance(part.visual, ColorVisuals):
        share = np.asarray(part.visual.vertex_colors)[:, :3] / 255
        light = np.array([scene_glb.linear((r, g, b)) for r, g, b in share.tolist()], np.float32)
        mesh.CreateDisplayColorPrimvar(vertex).Set(Vt.Vec3fArray.FromNumpy(light))
        return
    material, uv = part.visual.material, part.visual.uv
    plain = material if isinstance(material, PBRMaterial) else material.to_pbr()
    rgba = plain.baseColorFactor
    tint = [1.0, 1.0, 1.0] if rgba is None else [float(c) / 255 for c in np.asarray(rgba)[:3]]
    home = mesh.GetPath().AppendChild("look")
    look = UsdShade.Material.Define(stage, home)

    def shader(name: str, kind: str, **inputs: tuple[Any, Any]) -> Prim:
        made = UsdShade.Shader.Define(stage, home.AppendChild(name))
        made.CreateIdAttr(kind)
        for key, (form, value) in inputs.items():
            made.CreateInput(key, form).Set(value)
        return made

    surface = shader(
        "surface", "UsdPreviewSurface", diffuseColor=(kinds.Color3f, Gf.Vec3f(*tint)),
        roughness=(kinds.Float, 0.9),
    )  # fmt: skip
    look.CreateSurfaceOutput().ConnectToSource(surface.ConnectableAPI(), "surface")
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(look)
    if plain.baseColorTexture is None or uv is None or len(uv) != len(part.vertices):
        return
    corners = np.ascontiguousarray(np.asarray(uv)[:, :2], np.float32)  # from the lower left corner
    primvar = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", kinds.TexCoord2fArray, vertex)
    primvar.Set(Vt.Vec2fArray.FromNumpy(corners))
    reader = shader("uv", "UsdPrimvarReader_float2", varname=(kinds.String, "st"))
    file = Sdf.AssetPath(_save_picture(plain.baseColorTexture, folder))
    texture = shader(
        "picture", "UsdUVTexture", file=(kinds.Asset, file),
        scale=(kinds.Float4, Gf.Vec4f(*tint, 1.0)),
        wrapS=(kinds.Token, "repeat"), wrapT=(kinds.Token, "repeat"),
    )  # fmt: skip
    texture.CreateInput("st", kinds.Float2).ConnectToSource(reader.ConnectableAPI(), "result")
    texture.CreateOutput("rgb", kinds.Float3)
    surface.GetInput("diffuseColor").ConnectToSource(texture.ConnectableAPI(), "rgb")


def _save_picture(picture: Any, folder: Path) -> str:  # noqa: ANN401
    """Write a texture beside the scene, once for each content; its relative path."""
    stream = BytesIO()
    picture.convert("RGBA" if "A" in picture.getbands() else "RGB").save(stream, "PNG")
    name = f"textures/{sha256(stream.getvalue()).hexdigest()[:16]}.png"
    with replacing(folder / name) as part:
        part.write_bytes(stream.getvalue())
    return f"./{name}"
