"""Meshes of USD and their looks; OpenUSD's own modules, imported when they are asked for."""

import hashlib
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mover.core.colours import Colour
from mover.core.errors import InputError
from mover.core.files import replacing
from mover.io.export.looks import png_of

Stage = Any
"""A file of OpenUSD, whose Python modules have no types and fill themselves when imported."""
Prim = Any
"""A thing in it, or the schema that defines it."""


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


def free_path(stage: Stage, parent: str, name: str) -> str:
    """A path that USD allows and that nothing has yet."""
    Tf = pxr("Tf")

    path = f"{parent}/{Tf.MakeValidIdentifier(name)}"
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
    mesh.CreateFaceVertexCountsAttr(Vt.IntArray.FromNumpy(np.full(len(faces), 3, np.int32)))
    mesh.CreateFaceVertexIndicesAttr(
        Vt.IntArray.FromNumpy(np.ascontiguousarray(faces, np.int32).reshape(-1))
    )
    set_points(mesh, verts.astype(np.float32), None)
    mesh.CreateDisplayColorAttr([tint])
    return mesh


def set_points(mesh: Prim, points: NDArray[np.float32], time: float | None) -> None:
    """Places and extent, always or at one time."""
    Usd, Vt = pxr("Usd"), pxr("Vt")

    when = Usd.TimeCode.Default() if time is None else Usd.TimeCode(time)
    mesh.CreatePointsAttr().Set(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(points)), when)
    extent = np.stack([points.min(0), points.max(0)])
    mesh.CreateExtentAttr().Set(Vt.Vec3fArray.FromNumpy(extent), when)


def add_look(stage: Stage, mesh: Prim, part: Any, folder: Path) -> None:  # noqa: ANN401
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
        _connect_picture(stage, shader, _save_picture(picture, folder), colour)


def _add_vertex_colours(mesh: Prim, rgba: Any) -> None:  # noqa: ANN401
    UsdGeom, Vt = pxr("UsdGeom"), pxr("Vt")

    share = rgba[:, :3].astype(np.float32) / 255
    light = np.where(share > 0.04045, ((share + 0.055) / 1.055) ** 2.4, share / 12.92)
    primvar = mesh.CreateDisplayColorPrimvar(UsdGeom.Tokens.vertex)
    primvar.Set(Vt.Vec3fArray.FromNumpy(np.ascontiguousarray(light, np.float32)))


def _add_uv(mesh: Prim, uv: Any) -> None:  # noqa: ANN401
    """Texture coordinates from the lower left corner, as trimesh and USD both have them."""
    Sdf, UsdGeom, Vt = pxr("Sdf"), pxr("UsdGeom"), pxr("Vt")

    kind = Sdf.ValueTypeNames.TexCoord2fArray
    primvar = UsdGeom.PrimvarsAPI(mesh).CreatePrimvar("st", kind, UsdGeom.Tokens.vertex)
    primvar.Set(Vt.Vec2fArray.FromNumpy(np.ascontiguousarray(uv[:, :2], np.float32)))


def _bind_surface(stage: Stage, mesh: Prim, colour: list[float]) -> Prim:
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


def _connect_picture(stage: Stage, shader: Prim, picture: str, colour: list[float]) -> None:
    """Let a picture, multiplied with a colour, be that of a surface."""
    Gf, Sdf, UsdShade = pxr("Gf"), pxr("Sdf"), pxr("UsdShade")

    names, above = Sdf.ValueTypeNames, shader.GetPath().GetParentPath()
    reader = UsdShade.Shader.Define(stage, above.AppendChild("uv"))
    reader.CreateIdAttr("UsdPrimvarReader_float2")
    reader.CreateInput("varname", names.String).Set("st")
    texture = UsdShade.Shader.Define(stage, above.AppendChild("picture"))
    texture.CreateIdAttr("UsdUVTexture")
    texture.CreateInput("file", names.Asset).Set(Sdf.AssetPath(picture))
    texture.CreateInput("scale", names.Float4).Set(Gf.Vec4f(*colour, 1.0))
    for wrap in ("wrapS", "wrapT"):
        texture.CreateInput(wrap, names.Token).Set("repeat")
    texture.CreateInput("st", names.Float2).ConnectToSource(reader.ConnectableAPI(), "result")
    texture.CreateOutput("rgb", names.Float3)
    shader.GetInput("diffuseColor").ConnectToSource(texture.ConnectableAPI(), "rgb")


def _save_picture(picture: Any, folder: Path) -> str:  # noqa: ANN401
    """Write a texture beside the scene, once for each content; its relative path."""
    content = png_of(picture)
    name = f"textures/{hashlib.sha256(content).hexdigest()[:16]}.png"
    with replacing(folder / name) as part:
        part.write_bytes(content)
    return f"./{name}"
