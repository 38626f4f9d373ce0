"""Mesh files: read any, copy them with what belongs to them, write new ones."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from mover.core.files import copy_whole, replacing
from mover.core.types import Mesh, SeatStretch
from mover.io.files.fields import LARGEST, LARGEST_FILE, At, reason, shown
from mover.io.files.looks import check_faces, companions, load_parts

KINDS = (".glb", ".gltf", ".obj", ".ply", ".off", ".stl")
THINNEST = 1e-9  # a mesh that is thinner along two axes has no surface


def inside(at: At, folder: Path) -> Path:
    """The file that a relative path names, which may not lie outside of the folder."""
    name = at.text()
    path = Path(name)
    if path.is_absolute() or ".." in path.parts or "\0" in name or "\\" in name:
        at.refuse("a relative path with forward slashes inside the capture's folder")
    try:
        full = (folder / path).resolve()
        if not full.is_relative_to(folder.resolve()):
            at.refuse("a file inside the capture's folder", f"{name!r}, a link that leaves it")
        if not full.is_file():
            at.refuse("a file", f"{shown(name)}, which does not exist")
    except (OSError, RuntimeError) as error:  # names that are too long, links in a circle
        at.refuse("a file", f"{shown(name)}, which cannot be found ({reason(error)})")
    return full


def read_mesh(at: At, folder: Path) -> tuple[Mesh, str]:
    """The mesh that a field names, with the transforms of its nodes applied, and its full path.

    Raises:
        InputError: If it leaves the folder, cannot be read, is empty or is not finite.
    """
    path = inside(at, folder)
    if path.suffix.lower() not in KINDS:
        at.refuse(f"a file of kind {', '.join(KINDS)}")
    if path.stat().st_size > LARGEST_FILE:
        at.refuse(f"at most {LARGEST_FILE} bytes", f"a file of {path.stat().st_size}")
    verts, faces = load_arrays(at, path)
    return mesh_of(verts, faces, at), str(path)


def load_arrays(at: At, path: Path) -> tuple[NDArray[Any], NDArray[Any]]:
    """All vertices, used or not, and the faces of all parts of a file."""
    whole = load_parts(at, path, looks=False).to_mesh()
    return np.asarray(whole.vertices), np.asarray(whole.faces)


def mesh_of(verts: NDArray[Any], faces: NDArray[Any], at: At) -> Mesh:
    """A checked mesh without vertices that no face uses and without faces of repeated vertices.

    Raises:
        InputError: If it is empty, not finite, or its faces name missing vertices.
    """
    if verts.ndim != 2 or verts.shape[1:] != (3,) or faces.ndim != 2 or faces.shape[1:] != (3,):
        found = f"vertices of shape {verts.shape} and faces of shape {faces.shape}"
        at.refuse("triangles: (vertices, 3) and (faces, 3)", found)
    check_faces(at, faces, len(verts))
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    if not len(faces):
        at.refuse("a mesh with faces", "an empty mesh")
    kept, flat = np.unique(faces, return_inverse=True)
    verts = verts[kept]
    if not (np.abs(verts) <= LARGEST).all():
        at.refuse("finite vertices", "a mesh with NaN or infinite vertices")
    if np.sort(np.ptp(verts, axis=0))[1] < THINNEST:
        at.refuse("a mesh with a surface", "a mesh that is a line or a point")
    places = torch.from_numpy(np.ascontiguousarray(verts, dtype=np.float32))
    return Mesh(places, torch.from_numpy(flat.reshape(-1, 3).astype(np.int64)))


def write_mesh(mesh: Mesh, path: Path) -> None:
    """Write a mesh as binary glTF."""
    import trimesh
    from trimesh.exchange.gltf import export_glb

    body = trimesh.Trimesh(mesh.verts.cpu().numpy(), mesh.faces.cpu().numpy(), process=False)
    with replacing(path) as part:
        part.write_bytes(export_glb(trimesh.Scene({"object": body})))


def copy_mesh(source: Path, folder: Path, name: str) -> Path:
    """Copy a user's mesh as it is under a new name; into a folder of its own with other files."""
    beside = companions(source)
    home = folder / name if beside else folder
    target = home / (name + source.suffix)
    copy_whole(source, target)
    for file in beside:
        copy_whole(source.parent / file, home / file)
    return target


def stretch_file(path: Path, stretch: SeatStretch) -> Path:
    """Raise the seat in a copy of a mesh file, which becomes a .glb; materials and textures stay.

    The stretch is in the coordinates of the whole, with the transforms of the nodes applied.
    """
    import trimesh
    from trimesh.exchange.gltf import export_glb

    whole, out = load_parts(At(path.name, path.name), path), trimesh.Scene()
    for node in whole.graph.nodes_geometry:
        matrix, name = whole.graph[node]
        out.add_geometry(stretched_part(whole.geometry[name], matrix, stretch), node_name=node)
    target = path.with_suffix(".glb")
    with replacing(target) as file:
        file.write_bytes(export_glb(out))
    if target != path:
        path.unlink()
    return target


def stretched_part(part: Any, matrix: NDArray[Any], stretch: SeatStretch) -> Any:  # noqa: ANN401
    """A part of a scene of trimesh, put where its node has it, and raised there."""
    part = part.copy()
    part.apply_transform(matrix)
    verts = torch.from_numpy(np.array(part.vertices, dtype=np.float32))
    part.vertices = stretch.of(verts).numpy()
    return part
