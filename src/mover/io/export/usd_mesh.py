"""Meshes of USD and their looks; OpenUSD's own modules, imported when they are asked for."""

from hashlib import sha256
from importlib import import_module
from importlib.util import find_spec
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mover.core.colours import Colour
from mover.core.errors import InputError
from mover.core.files import replacing
from mover.io.export.scene_glb import linear

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
        light = np.array([linear((r, g, b)) for r, g, b in share.tolist()], np.float32)
        mesh.CreateDisplayColorPrimvar(vertex).Set(Vt.Vec3fArray.FromNumpy(light))
        return
    material, uv = part.visual.material, part.visual.uv
    plain = material if isinstance(material, PBRMaterial) else material.to_pbr()
    rgba = plain.baseColorFactor
    tint = [1.0, 1.0, 1.0] if rgba is None else [float(c) / 255 for c in np.asarray(rgba)[:3]]
    place = mesh.GetPath().AppendChild("look")
    look = UsdShade.Material.Define(stage, place)

    def shader(name: str, kind: str, **inputs: tuple[Any, Any]) -> Prim:
        made = UsdShade.Shader.Define(stage, place.AppendChild(name))
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
