"""The result as one glTF file: objects, floor, camera and some bodies; single objects as PLY."""

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from mover.core.colours import Colour, colour, person_colour
from mover.core.files import replacing
from mover.core.types import Bodies, Camera, Mesh, Scene, SceneObject
from mover.geometry.camera import NEAR
from mover.geometry.placement import place_object
from mover.geometry.rotations import affine, rot_y
from mover.io.export.finished import Exported, Finished
from mover.io.files.fields import At
from mover.io.files.looks import load_parts, looks_lost
from mover.io.files.meshes import stretched_part

GHOSTS = 12  # at most so many bodies
FLOOR_MARGIN = 1.0  # [m] beyond the furniture
FLOOR_COLOUR = (0.86, 0.85, 0.83)
BODY_ALPHA = 0.55
Append = Callable[[dict[Any, bytes], dict[str, Any]], None]
"""Adds to a glTF file: takes its blocks of bytes and its tree."""


def write_glb(
    scene: Scene, bodies: Bodies | None, path: Path, append: Append | None = None
) -> Path:
    """Write the scene with some of its bodies as one glTF file, all at once.

    Each object is a node of its id that holds its placement; its meshes are those of the user's
    own file where it exists, textures included. `ground` is the floor, `camera` the camera of the
    video, `body_<person>_<frame>` are up to twelve bodies, evenly chosen; `append` adds what moves.
    """
    import trimesh
    from trimesh.exchange.gltf import export_glb
    from trimesh.scene.cameras import Camera as View

    out = trimesh.Scene()
    for index, item in enumerate(scene.objects):
        above = _free(out, item.id)
        out.graph.update(frame_to=above, frame_from=out.graph.base_frame, matrix=placement_of(item))
        for part, transform in parts_of(item, colour(index)):
            _add(out, f"{above}_mesh", part, parent_node_name=above, transform=transform)
    if scene.ground is not None:
        _add(out, "ground", _solid(floor_of(scene, scene.ground), (*FLOOR_COLOUR, 1.0), "ground"))
    if bodies is not None:  # evenly over the frames
        order = torch.argsort(bodies.frame, stable=True)
        steps = torch.linspace(0, len(order) - 1, min(GHOSTS, len(order))).round().long()
        for row in order[steps].unique().tolist():
            person, name = int(bodies.person[row]), f"body_{bodies.person[row]}_{bodies.frame[row]}"
            mesh = Mesh(bodies.verts[row], bodies.faces)
            body = _solid(mesh, (*person_colour(person), BODY_ALPHA), name)
            body.vertex_normals = unit_normals(body.vertex_normals)  # skin is smooth
            _add(out, name, body)
    lens = _lens(scene.camera)  # exact in the file alone: see `finish`
    across = 2 * math.atan(lens["aspectRatio"] * math.tan(lens["yfov"] / 2))
    fov, size = [math.degrees(v) for v in (across, lens["yfov"])], scene.camera
    out.camera = View(_free(out, "camera"), resolution=(size.width, size.height), fov=fov)
    out.camera_transform = view_matrix(scene.camera)

    def finish(blocks: dict[Any, bytes], tree: dict[str, Any]) -> None:
        tree["cameras"][0]["perspective"] = lens
        if append is not None:
            append(blocks, tree)

    raw = export_glb(out, buffer_postprocessor=finish)
    with replacing(path) as part:
        part.write_bytes(raw)
    return path


def _add(out: Any, name: str, part: Any, **options: Any) -> None:  # noqa: ANN401
    """A mesh in a node of this name, which is lengthened where another node has it."""
    name = _free(out, name)
    out.add_geometry(part, node_name=name, geom_name=name, **options)


def _free(out: Any, name: str) -> str:  # noqa: ANN401
    while name in out.graph.nodes:
        name += "_"
    return name


def placement_of(item: SceneObject) -> np.ndarray:
    """Matrix of scale, then rotation about +y, then translation: glTF's order."""
    turn = rot_y(item.yaw.detach().cpu().double()).numpy()
    stretched = turn * item.scale.detach().cpu().double().numpy()
    return affine(stretched, item.t_world_object.detach().cpu().numpy())


def parts_of(item: SceneObject, tint: Colour) -> list[tuple[Any, np.ndarray]]:
    """Meshes of the user's file with their transforms; without a file, the mesh that is known."""
    import trimesh

    file, found = Path(item.mesh_file), list[tuple[Any, np.ndarray]]()
    known = bool(item.mesh_file) and file.is_file()
    loaded = load_parts(At(file.name, item.id), file, process=True) if known else trimesh.Scene()
    for node in loaded.graph.nodes_geometry:
        transform, name = loaded.graph[node]
        part = loaded.geometry[name]
        if item.stretch is not None:
            part, transform = stretched_part(part, transform, item.stretch), np.eye(4)
        if isinstance(part, trimesh.Trimesh) and len(part.faces):
            found.append((_coloured(part, tint, item.id), np.asarray(transform)))
    return found or [(_solid(item.mesh, (*tint, 1.0), item.id), np.eye(4))]


def losses_of(scene: Scene) -> list[str]:
    """What to say of textures and materials that are lost, one object a line."""
    files = (Path(item.mesh_file) for item in scene.objects if item.mesh_file)
    return [lost for file in files if file.is_file() and (lost := looks_lost(file))]


def _coloured(part: Any, tint: Colour, name: str) -> Any:  # noqa: ANN401
    """The mesh with its own colours or texture, else in the object's colour.

    Normals of the file stay; without any, viewers shade each face flat, as glTF asks.
    """
    from trimesh.visual import ColorVisuals, TextureVisuals

    part = part.copy(include_cache=True)
    if isinstance(part.visual, ColorVisuals) and not part.visual.defined:
        part.visual = TextureVisuals(material=_material((*tint, 1.0), name))
    if "vertex_normals" in part._cache.cache:  # asked in public, trimesh would make some up
        part.vertex_normals = unit_normals(part.vertex_normals)
    return part


def unit_normals(normals: Float[np.ndarray, "verts 3"]) -> Float[np.ndarray, "verts 3"]:
    """Directions of length one; where triangles without area leave none, up."""
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    up = np.array([0.0, 1.0, 0.0])
    return np.where(length > 1e-6, normals / np.maximum(length, 1e-6), up)


def linear(rgb: Colour) -> Colour:
    """Amounts of light of a colour on the screen."""
    red, green, blue = (((c + 0.055) / 1.055) ** 2.4 if c > 0.04045 else c / 12.92 for c in rgb)
    return red, green, blue


def _material(rgba: tuple[float, float, float, float], name: str) -> Any:  # noqa: ANN401
    """A rough material; glTF counts light, so the colour leaves its sRGB curve here."""
    from trimesh.visual.material import PBRMaterial

    return PBRMaterial(
        name=name,
        baseColorFactor=[*(round(255 * c) for c in linear(rgba[:3])), round(255 * rgba[3])],
        metallicFactor=0.0, roughnessFactor=0.9, alphaMode="BLEND" if rgba[3] < 1 else "OPAQUE",
        doubleSided=True,
    )  # fmt: skip


def _solid(mesh: Mesh, rgba: tuple[float, float, float, float], name: str) -> Any:  # noqa: ANN401
    import trimesh
    from trimesh.visual import TextureVisuals

    return trimesh.Trimesh(
        mesh.verts.detach().cpu().double().numpy(), mesh.faces.cpu().numpy(), process=False,
        visual=TextureVisuals(material=_material(rgba, name)),
    )  # fmt: skip


def floor_of(scene: Scene, height: float) -> Mesh:
    """A rectangle under everything, front side up."""
    stands = [place_object(p).verts.detach().cpu()[:, [0, 2]].float() for p in scene.objects]
    flat = torch.cat([torch.zeros(1, 2), *stands])
    x0, z0 = (flat.amin(0) - FLOOR_MARGIN).tolist()
    x1, z1 = (flat.amax(0) + FLOOR_MARGIN).tolist()
    corners = [[x0, height, z1], [x1, height, z1], [x1, height, z0], [x0, height, z0]]
    return Mesh(torch.tensor(corners), torch.tensor([[0, 1, 2], [0, 2, 3]]))


def view_matrix(camera: Camera) -> Float[np.ndarray, "4 4"]:
    """From the axes of a camera that looks along -z, with +y up, to the world."""
    return affine(camera.R_cam_world.detach().cpu().double().numpy().T @ np.diag([1.0, -1.0, -1.0]))


def _lens(camera: Camera) -> dict[str, float]:
    """As glTF has it: the ratio of lengths, not of angles, and the image's centre on the axis."""
    wide = camera.width / float(camera.K[0, 0])
    high = camera.height / float(camera.K[1, 1])
    return {"aspectRatio": wide / high, "yfov": 2 * math.atan(high / 2), "znear": NEAR}


def export_ply(finished: Finished, folder: Path) -> Exported:
    """Write each object by itself, where it stands in the world [m], as `objects/<id>.ply`."""
    import trimesh

    files: list[Path] = []
    for index, item in enumerate(finished.scene.objects):
        placed = trimesh.Scene()
        for part, transform in parts_of(item, colour(index)):
            placed.add_geometry(part, transform=placement_of(item) @ transform)
        whole = placed.to_mesh()
        files.append(folder / "objects" / f"{item.id}.ply")
        with replacing(files[-1]) as target:
            trimesh.Trimesh(whole.vertices, whole.faces, process=False).export(target)
    return Exported(tuple(files))
