"""scene.usdc: metres, +y up, objects with their placement and looks, camera, people over time."""

import hashlib
from importlib import import_module
from importlib.util import find_spec
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float
from numpy.typing import NDArray

from mover.core.colours import Colour, colour, person_colour
from mover.core.errors import InputError
from mover.core.files import replacing
from mover.core.types import Bodies, Camera, Scene, SceneObject
from mover.geometry.camera import NEAR
from mover.io.export.finished import Exported, Finished
from mover.io.export.people import FPS, Track, keyframes, seen_from_to, tracks_of
from mover.io.export.scene_glb import floor_of, parts_of


def add_look(stage: Any, mesh: Any, part: Any, folder: Path) -> None:  # noqa: ANN401
    """Give a mesh the material of a trimesh part: its texture or colour, or colours of vertices."""
    from trimesh.visual import ColorVisuals
    from trimesh.visual.material import PBRMaterial

    if isinstance(part.visual, ColorVisuals):
        _add_vertex_colours(mesh, np.asarray(part.visual.vertex_colors))
        return
    material = part.visual.material
    plain = material if isinstance(material, PBRMaterial) else material.to_pbr()
    rgba = plain.baseColorFactor
    colour = [1.0, 1.0, 1.0] if rgba is None else [float(c) / 255 for c in np.asarray(rgba)[:3]]
    picture, uv = plain.baseColorTexture, part.visual.uv
    textured = picture is not None and uv is not None and len(uv) == len(part.vertices)
    shader = _bind_surface(stage, mesh, colour)
    if textured:
        _add_uv(mesh, np.asarray(uv))
        _connect_picture(stage, shader, _save_picture(picture, folder))


def _add_vertex_colours(mesh: Any, rgba: Any) -> None:  # noqa: ANN401
    UsdGeom, Vt = pxr("UsdGeom"), pxr("Vt")

    share = rgba[:, :3].astype(np.float32) / 255
    light = np.where(share > 0.04045, ((share + 0.055) / 1.055) ** 2.4, share / 12.92)
    primvar = mesh.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex)
    primvar.Set(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(light, np.float32)))


def _add_uv(mesh: Any, uv: Any) -> None:  # noqa: ANN401
    """Texture coordinates from the lower left corner, as trimesh and USD both have them."""
    Sdf, UsdGeom, Vt = pxr("Sdf"), pxr("UsdGeom"), pxr("Vt")

    kind = Sdf.ValueTypeNames.TexCoord2fArray
    primvar = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", kind, UsdGeom.Tokens.vertex)
    primvar.Set(Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(uv[:, :2], np.float32)))


def _bind_surface(stage: Any, mesh: Any, colour: list[float]) -> Any:  # noqa: ANN401
    """A rough surface of one colour; its shader."""
    Gf, Sdf, UsdShade = pxr("Gf"), pxr("Sdf"), pxr("UsdShade")

    place = mesh.GetPath().AppendChild("look")
    look = UsdShade.Material.Define(stage, place)
    shader = UsdShade.Shader.Define(stage, place.AppendChild("surface"))
    shader.CreateIdAttr("UsdPreviewSurface")
    shader.CreateInput("diffuseColor", Sdf.ValueTypeNames.Color3f).Set(Gf.Vec3f(*colour))
    shader.CreateInput("roughness", Sdf.ValueTypeNames.Float).Set(0.9)
    look.CreateSurfaceOutput().ConnectToSource(shader.ConnectableAPI(), "surface")
    UsdShade.MaterialBindingAPI.Apply(mesh.GetPrim()).Bind(look)
    return shader


def _connect_picture(stage: Any, shader: Any, picture: str) -> None:  # noqa: ANN401
    Sdf, UsdShade = pxr("Sdf"), pxr("UsdShade")

    names, above = Sdf.ValueTypeNames, shader.GetPath().GetParentPath()
    reader = UsdShade.Shader.Define(stage, above.AppendChild("uv"))
    reader.CreateIdAttr("UsdPrimvarReader_float2")
    reader.CreateInput("varname", names.String).Set("st")
    texture = UsdShade.Shader.Define(stage, above.AppendChild("picture"))
    texture.CreateIdAttr("UsdUVTexture")
    texture.CreateInput("file", names.Asset).Set(Sdf.AssetPath(picture))
    for wrap in ("wrapS", "wrapT"):
        texture.CreateInput(wrap, names.Token).Set("repeat")
    texture.CreateInput("st", names.Float2).ConnectToSource(reader.ConnectableAPI(), "result")
    texture.CreateOutput("rgb", names.Float3)
    shader.GetInput("diffuseColor").ConnectToSource(texture.ConnectableAPI(), "rgb")


def _save_picture(picture: Any, folder: Path) -> str:  # noqa: ANN401
    """Write a texture beside the scene, once for each content; its relative path."""
    stream = BytesIO()
    picture.convert("RGBA" if "A" in picture.getbands() else "RGB").save(stream, "PNG")
    name = f"textures/{hashlib.sha256(stream.getvalue()).hexdigest()[:16]}.png"
    with replacing(folder / name) as part:
        part.write_bytes(stream.getvalue())
    return f"./{name}"


# OpenUSD's Python modules, which fill themselves when they are imported.


def pxr(name: str) -> Any:  # noqa: ANN401
    """The module `pxr.<name>`.

    Raises:
        InputError: If usd-core is not installed.
    """
    if find_spec("pxr") is None:
        raise InputError(
            "--to usd: usd-core is not installed; pip install '.[usd]' in mover's folder"
        )
    return import_module(f"pxr.{name}")


# The room and its people.


APERTURE = 20.955  # width of the film [tenths of a scene unit by USD's custom: mm]
TOLERANCE = 0.002  # [m], of the straight lines between two samples of time
MOST = 100_000
FAR = 1000.0  # [m]


def export_usd(finished: Finished, folder: Path) -> Exported:
    """Write the room as one binary USD file.

    Objects are transforms (translate, rotateY, scale) with the meshes of the user's file below
    them; people are meshes with samples of time, in frames of the video.

    Raises:
        InputError: If usd-core is not installed.
    """
    Usd = pxr("Usd")
    path = folder / "scene.usdc"
    with replacing(path) as part:
        part.unlink()
        stage = Usd.Stage.CreateNew(str(part))
        _head(stage, finished)
        _add_scene(stage, finished.scene, folder)
        if finished.bodies is not None:
            for track in tracks_of(finished.bodies):
                _add_person(stage, finished.bodies, track)
        stage.GetRootLayer().Save()
    return Exported((path,), ("people's meshes move in straight lines between samples, 2 mm off",))


def _head(stage: Any, finished: Finished) -> None:  # noqa: ANN401
    UsdGeom = pxr("UsdGeom")

    UsdGeom.SetStageMetersPerUnit(stage, 1.0)
    UsdGeom.SetStageUpAxis(stage, UsdGeom.Tokens.y)
    stage.SetDefaultPrim(UsdGeom.Xform.Define(stage, "/room").GetPrim())
    bodies = finished.bodies
    if bodies is not None:
        stage.SetTimeCodesPerSecond(bodies.fps or FPS)
        stage.SetFramesPerSecond(bodies.fps or FPS)
        stage.SetStartTimeCode(int(bodies.frame.min()))
        stage.SetEndTimeCode(int(bodies.frame.max()))


def _add_scene(stage: Any, scene: Scene, folder: Path) -> None:  # noqa: ANN401
    for index, piece in enumerate(scene.objects):
        _add_object(stage, piece, colour(index), folder)
    if scene.ground is not None:
        floor = floor_of(scene, scene.ground)
        verts, faces = floor.verts.double().numpy(), floor.faces.numpy()
        _add_mesh(stage, "/room/ground", verts, faces, (0.86, 0.85, 0.83))
    _add_camera(stage, scene.camera)


def _free(stage: Any, parent: str, name: str) -> str:  # noqa: ANN401
    """A path that USD allows and that nothing has yet."""
    Tf = pxr("Tf")

    path = f"{parent}/{Tf.MakeValidIdentifier(name)}"
    while stage.GetPrimAtPath(path):
        path += "_"
    return path


def _add_object(stage: Any, piece: SceneObject, tint: Colour, folder: Path) -> None:  # noqa: ANN401
    """A transform in the format's own order: scale, then turn, then shift."""
    Gf, UsdGeom = pxr("Gf"), pxr("UsdGeom")

    node = UsdGeom.Xform.Define(stage, _free(stage, "/room", piece.id))
    prim, double = node.GetPrim(), UsdGeom.XformOp.PrecisionDouble
    prim.SetCustomDataByKey("mover:id", piece.id)
    prim.SetCustomDataByKey("mover:category", piece.category)
    node.AddTranslateOp(double).Set(Gf.Vec3d(*piece.t_world_object.tolist()))
    node.AddRotateYOp(double).Set(float(np.degrees(float(piece.yaw))))
    node.AddScaleOp(double).Set(Gf.Vec3d(*piece.scale.tolist()))
    for part, transform in parts_of(piece, tint):
        path = _free(stage, str(node.GetPath()), "mesh")
        mesh = _add_mesh(stage, path, np.asarray(part.vertices), np.asarray(part.faces), tint)
        mesh.AddTransformOp(double).Set(Gf.Matrix4d(transform.T.tolist()))
        add_look(stage, mesh, part, folder)


def _add_mesh(
    stage: Any,  # noqa: ANN401
    path: str,
    verts: NDArray[Any],
    faces: NDArray[Any],
    tint: Colour,
) -> Any:  # noqa: ANN401
    UsdGeom, Vt = pxr("UsdGeom"), pxr("Vt")

    mesh = UsdGeom.Mesh.Define(stage, path)
    mesh.CreateSubdivisionSchemeAttr(UsdGeom.Tokens.none)
    mesh.CreateDoubleSidedAttr(True)
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(faces), 3, np.int32)))
    mesh.CreateFaceVertexIndicesAttr(
        Vt.IntArray.FromNumpy(np.ascontiguousarray(faces, np.int32).reshape(-1))
    )
    _set_points(mesh, verts.astype(np.float32), None)
    mesh.CreateDisplayColorAttr([tint])
    return mesh


def _set_points(mesh: Any, points: NDArray[np.float32], time: float | None) -> None:  # noqa: ANN401
    """Places and extent, always or at one time."""
    Usd, Vt = pxr("Usd"), pxr("Vt")

    when = Usd.TimeCode.Default() if time is None else Usd.TimeCode(time)
    mesh.CreatePointsAttr().Set(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(points)), when)
    extent = np.stack([points.min(0), points.max(0)])
    mesh.CreateExtentAttr().Set(Vt.Vec3fArray.FromNumpy(extent), when)


def _add_person(stage: Any, bodies: Bodies, track: Track) -> None:  # noqa: ANN401
    UsdGeom = pxr("UsdGeom")

    verts = bodies.verts[track.rows].detach().cpu().float()
    keys, _ = keyframes(verts, track.time, TOLERANCE, MOST)
    path = _free(stage, "/room", f"person_{track.person}")
    tint = person_colour(track.person)
    mesh = _add_mesh(stage, path, verts[0].numpy(), bodies.faces.cpu().numpy(), tint)
    for key in keys:
        _set_points(mesh, verts[key].numpy(), float(track.frame[key]))
    seen = mesh.CreateVisibilityAttr()
    first, fps = int(bodies.frame.min()), bodies.fps or FPS
    for start, end in seen_from_to(track):
        if start > 0:
            seen.Set(UsdGeom.Tokens.invisible, float(first))
        seen.Set(UsdGeom.Tokens.inherited, first + round(start * fps))
        if end < track.last:
            seen.Set(UsdGeom.Tokens.invisible, first + round(end * fps) + 1)


def _add_camera(stage: Any, camera: Camera) -> None:  # noqa: ANN401
    """USD's cameras look along -z with +y up; the film is moved for the principal point."""
    Gf, UsdGeom = pxr("Gf"), pxr("UsdGeom")

    lens = UsdGeom.Camera.Define(stage, _free(stage, "/room", "camera"))
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
    lens.AddTransformOp(UsdGeom.XformOp.PrecisionDouble).Set(Gf.Matrix4d(_to_world(camera)))


def _to_world(camera: Camera) -> list[list[float]]:
    """Rows of the matrix from the camera's axes (+y up) to the world; USD's points are rows."""
    matrix: Float[np.ndarray, "4 4"] = np.eye(4)
    R = camera.R_cam_world.detach().cpu().double().numpy()
    matrix[:3, :3] = (R.T @ np.diag([1.0, -1.0, -1.0])).T
    return matrix.tolist()
