"""The result as files that any 3D program opens: scene.glb, and single objects as OBJ and PLY."""

import math
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
from mover.io.files.meshes import bent_part

GHOSTS = 12  # at most so many bodies
FLOOR_MARGIN = 1.0  # [m] beyond the furniture
FLOOR_COLOUR = (0.86, 0.85, 0.83)
BODY_ALPHA = 0.55


def write_glb(scene: Scene, bodies: Bodies | None, path: Path) -> Path:
    """Write the scene with some of its bodies as one glTF file, all at once.

    Each object is a node of its id that holds its placement; its meshes are those of the user's
    own file where it exists, textures included. `ground` is the floor, `camera` the camera of the
    video, `body_<person>_<frame>` are up to twelve bodies, evenly chosen.

    Args:
        scene: The furniture; +y is up, as in glTF.
        bodies: People in the world of `scene`; None: nobody.
        path: The file to write.
    """
    import trimesh
    from trimesh.exchange.gltf import export_glb

    out = trimesh.Scene()
    for index, piece in enumerate(scene.objects):
        _add_object(out, piece, colour(index))
    if scene.ground is not None:
        floor = _solid(floor_of(scene, scene.ground), (*FLOOR_COLOUR, 1.0), "ground")
        name = _free(out, "ground")
        out.add_geometry(floor, node_name=name, geom_name=name)
    if bodies is not None:
        for row in _chosen(bodies):
            _add_body(out, bodies, row)
    _add_camera(out, scene.camera)
    raw = export_glb(out, tree_postprocessor=lambda tree: _set_lens(tree, scene.camera))
    with replacing(path) as part:
        part.write_bytes(raw)
    return path


def _free(out: Any, name: str) -> str:  # noqa: ANN401
    """The name, longer where a node has it already."""
    while name in out.graph.nodes:
        name += "_"
    return name


def _add_object(out: Any, piece: SceneObject, tint: Colour) -> None:  # noqa: ANN401
    """A node with the piece's id, and the meshes of its file below it."""
    above = _free(out, piece.id)
    out.graph.update(frame_to=above, frame_from=out.graph.base_frame, matrix=placement_of(piece))
    for part, transform in parts_of(piece, tint):
        name = _free(out, f"{above}_mesh")
        out.add_geometry(
            part, node_name=name, geom_name=name, parent_node_name=above, transform=transform
        )


def placement_of(piece: SceneObject) -> np.ndarray:
    """Matrix of scale, then rotation about +y, then translation: glTF's order."""
    turn = rot_y(piece.yaw.detach().cpu().double()).numpy()
    stretched = turn * piece.scale.detach().cpu().double().numpy()
    return affine(stretched, piece.t_world_object.detach().cpu().numpy())


def parts_of(piece: SceneObject, tint: Colour) -> list[tuple[Any, np.ndarray]]:
    """Meshes of the user's file with their places in it; without a file, the mesh that is known."""
    import trimesh

    file = Path(piece.mesh_file)
    if not (piece.mesh_file and file.is_file()):
        return [(_solid(piece.mesh, (*tint, 1.0), piece.id), np.eye(4))]
    loaded = trimesh.load_scene(file)
    found: list[tuple[Any, np.ndarray]] = []
    for node in loaded.graph.nodes_geometry:
        transform, name = loaded.graph[node]
        part = loaded.geometry[name]
        if piece.cage is not None:
            part, transform = bent_part(part, transform, piece.cage), np.eye(4)
        if isinstance(part, trimesh.Trimesh) and len(part.faces):
            found.append((_finished(part, tint, piece.id), np.asarray(transform)))
    return found or [(_solid(piece.mesh, (*tint, 1.0), piece.id), np.eye(4))]


def _finished(part: Any, tint: Colour, name: str) -> Any:  # noqa: ANN401
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
        metallicFactor=0.0,
        roughnessFactor=0.9,
        alphaMode="BLEND" if rgba[3] < 1 else "OPAQUE",
        doubleSided=True,
    )


def _solid(mesh: Mesh, rgba: tuple[float, float, float, float], name: str) -> Any:  # noqa: ANN401
    import trimesh
    from trimesh.visual import TextureVisuals

    return trimesh.Trimesh(
        mesh.verts.detach().cpu().double().numpy(),
        mesh.faces.cpu().numpy(),
        process=False,
        visual=TextureVisuals(material=_material(rgba, name)),
    )


def floor_of(scene: Scene, height: float) -> Mesh:
    """A rectangle under everything, front side up."""
    stands = [place_object(p).verts.detach().cpu()[:, [0, 2]].float() for p in scene.objects]
    flat = torch.cat([torch.zeros(1, 2), *stands])
    (x0, z0), (x1, z1) = (
        (flat.amin(0) - FLOOR_MARGIN).tolist(),
        (flat.amax(0) + FLOOR_MARGIN).tolist(),
    )
    corners = [[x0, height, z1], [x1, height, z1], [x1, height, z0], [x0, height, z0]]
    return Mesh(torch.tensor(corners), torch.tensor([[0, 1, 2], [0, 2, 3]]))


def _chosen(bodies: Bodies) -> list[int]:
    """Rows of at most `GHOSTS` bodies, evenly over the frames."""
    order = torch.argsort(bodies.frame, stable=True)
    count = min(GHOSTS, len(order))
    return order[torch.linspace(0, len(order) - 1, count).round().long()].unique().tolist()


def _add_body(out: Any, bodies: Bodies, row: int) -> None:  # noqa: ANN401
    person, frame = int(bodies.person[row]), int(bodies.frame[row])
    name = _free(out, f"body_{person}_{frame}")
    body = _solid(Mesh(bodies.verts[row], bodies.faces), (*person_colour(person), BODY_ALPHA), name)
    body.vertex_normals = unit_normals(body.vertex_normals)  # skin is smooth
    out.add_geometry(body, node_name=name, geom_name=name)


def _add_camera(out: Any, camera: Camera) -> None:  # noqa: ANN401
    """The camera at the origin; glTF's cameras look along -z, with +y up."""
    from trimesh.scene.cameras import Camera as View

    sizes = (camera.width, camera.height)
    out.camera = View(name=_free(out, "camera"), resolution=sizes, fov=_field_of_view(camera))
    out.camera_transform = view_matrix(camera)


def view_matrix(camera: Camera) -> Float[np.ndarray, "4 4"]:
    """From the axes of a camera that looks along -z, with +y up, to the world."""
    return affine(camera.R_cam_world.detach().cpu().double().numpy().T @ np.diag([1.0, -1.0, -1.0]))


def _field_of_view(camera: Camera) -> list[float]:
    """Across and up [deg], as if the image's centre were on the optical axis."""
    focal = (float(camera.K[0, 0]), float(camera.K[1, 1]))
    sizes = (camera.width, camera.height)
    return [math.degrees(2 * math.atan(s / (2 * f))) for s, f in zip(sizes, focal, strict=True)]


def _set_lens(tree: dict[str, Any], camera: Camera) -> None:
    """Say the camera's exact lens in the file: glTF's ratio is that of lengths, not of angles."""
    across, up = (math.tan(math.radians(angle) / 2) for angle in _field_of_view(camera))
    tree["cameras"][0]["perspective"] = {
        "aspectRatio": across / up,
        "yfov": 2 * math.atan(up),
        "znear": NEAR,
    }


# Single objects in the world, as OBJ with their textures and as PLY.


def export_objects(finished: Finished, folder: Path) -> Exported:
    """Write each object by itself, where it stands in the world [m].

    Args:
        finished: The result.
        folder: Gets `objects/<id>.ply` (shape alone) and `objects/<id>/<id>.obj` (with materials
            and textures).
    """
    import trimesh

    files: list[Path] = []
    for index, piece in enumerate(finished.scene.objects):
        placed = trimesh.Scene()
        for part, transform in parts_of(piece, colour(index)):
            placed.add_geometry(part, transform=placement_of(piece) @ transform)
        whole = placed.to_mesh()
        plain = trimesh.Trimesh(whole.vertices, whole.faces, process=False)
        path = folder / "objects" / f"{piece.id}.ply"
        with replacing(path) as target:
            plain.export(target)
        home = folder / "objects" / piece.id
        home.mkdir(parents=True, exist_ok=True)
        placed.export(home / f"{piece.id}.obj", mtl_name=f"{piece.id}.mtl")
        files += [path, home / f"{piece.id}.obj"]
    return Exported(tuple(files))
