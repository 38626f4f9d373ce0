"""Mesh files: read any, copy them with what belongs to them, write new ones; what is lost of them.

People's files name textures with back slashes, in another case, by paths of another computer, or
behind options of the material. They are found where they lie, at or below the file's own folder.
"""

import json
import re
import warnings
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from io import BytesIO
from pathlib import Path, PurePosixPath
from typing import Any
from urllib.parse import unquote

import numpy as np
import torch
from numpy.typing import NDArray

from mover.core.errors import InputError
from mover.core.files import copy_whole, instead, not_there, reason, replacing
from mover.core.types import Mesh, SeatStretch
from mover.io.files.fields import LARGEST, LARGEST_FILE, At, shown

MOST_NUMBERS = 1 << 27  # in one array of a glTF file
MOST_ZEROS = 1 << 20  # in one that has no bytes in the file
MOST_NODES = 10_000
MOST_FACES = 5_000_000  # of all places of all meshes together: 8 s and 1.5 GB
MOST_MATERIALS = 500  # of an .obj
PACKED = {"KHR_draco_mesh_compression": "Draco", "EXT_meshopt_compression": "meshopt"}
MAPS = re.compile(r"(?im)^\s*(?:map_\w+|bump|disp|decal|refl|norm)\s+(.+?)\s*$")
"""A picture in a file of materials."""
OPTION = re.compile(
    r"-(?:([ost])((?: [-+.\deE]+){0,3})|mm(?: [-+.\deE]+){0,2}|[a-z]\w*(?: \S+)?) (?=\S)"
)
"""An option of a texture before another word: some have numbers, all others one word."""


@dataclass(frozen=True)
class Source:
    """What trimesh reads of a file."""

    content: bytes | None
    """None: the file as it is."""
    beside: dict[str, bytes]
    """Other files by the names that `content` has for them."""
    lost: tuple[str, ...]
    """What is not found, in words."""


def load_parts(at: At, path: Path, *, looks: bool = True, process: bool = False) -> Any:  # noqa: ANN401
    """The scene of a mesh file, as trimesh has it; parts without faces are left out.

    With `looks` it has materials and textures; with `process` vertices that are the same are one.

    Raises:
        InputError: If it cannot be read, is too large, has no faces, or names files elsewhere.
    """
    import trimesh

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of parsers about things that are checked here
        try:
            check_gltf(at, path, pictures=looks)
            source, kind = source_of(path, looks=looks), path.suffix[1:].lower()
            stream = str(path) if source.content is None else BytesIO(source.content)
            more: Any = {} if source.content is None else {"resolver": source.beside}
            more |= {} if looks else {"skip_materials": True}
            scene = trimesh.load_scene(stream, file_type=kind, process=process, **more)
            for part in scene.geometry.values():
                if hasattr(part, "faces"):
                    check_faces(at, np.asarray(part.faces), len(part.vertices))
        except InputError:
            raise
        except Exception as error:  # the parsers of six formats raise anything on broken files
            why = reason(error, path)
            at.refuse("a readable mesh", f"{at.value!r}, which cannot be read ({why})")
    bare = {n: part for n, part in scene.geometry.items() if not len(getattr(part, "faces", ()))}
    if len(bare) == len(scene.geometry):
        count = sum(len(part.vertices) for part in bare.values())
        points = f"{count} points without faces (a cloud of points, or Gaussian splats)"
        said = f"an empty mesh{': ' * bool(count)}{points * bool(count)}"
        if found := instead(path):
            said = f"which cannot be read: {found}"
        at.refuse("a mesh with faces", f"{at.value!r}, {said}")
    if bare:
        scene.delete_geometry(list(bare))
    return scene


def is_cloud(path: Path) -> bool:
    """Whether a .ply has no faces: a cloud of points, or Gaussian splats."""
    if path.suffix.lower() != ".ply":
        return False
    with path.open("rb") as file:
        header = file.read(1 << 14).split(b"end_header")[0]
    count = re.search(rb"element\s+face\s+(\d+)", header)
    return count is None or not int(count[1])


def check_faces(at: At, faces: NDArray[Any], count: int) -> None:
    """Refuse faces that name vertices which do not exist."""
    if faces.size and (faces.min() < 0 or faces.max() >= count):
        found = f"faces that name vertices {faces.min()} to {faces.max()}"
        at.refuse(f"vertices 0 to {count - 1}", found)


# glTF: what a file may make of a few bytes.


def gltf_tree(path: Path) -> Any:  # noqa: ANN401
    """The JSON of a .gltf or .glb; what it holds is not checked."""
    content, binary = path.read_bytes(), path.suffix.lower() == ".glb"
    if not content.startswith(b"glTF") if binary else b"\0" in content[:64]:
        raise ValueError("it is no glTF")
    end = 20 + int.from_bytes(content[12:16], "little")
    return json.loads(content[20:end] if binary else content)


def check_gltf(at: At, path: Path, *, pictures: bool = False) -> None:
    """Refuse buffers outside of the file's folder, and more numbers than a file can hold.

    Other kinds than glTF pass; with `pictures` those outside of the folder are refused as well.
    """
    if path.suffix.lower() not in (".glb", ".gltf"):
        return
    tree = gltf_tree(path)
    for extension in tree.get("extensionsRequired", []):
        if extension in PACKED:
            found = f"{at.value!r}, which is packed by {PACKED[extension]}"
            at.refuse("glTF without compression (Blender: export without Compression)", found)
    for kind, part, name in _uris(tree):
        outside = ".." in re.split(r"[/\\]", name) or path.suffix.lower() == ".glb"
        wanted = kind == "buffers" or (pictures and outside)
        if wanted and beside(path, name) is None:
            at.refuse(f"{kind} beside it", f"{at.value!r} with the file {shown(part['uri'])}")
    for count, most, what in _amounts(tree):
        if count > most:
            at.refuse(f"at most {most}", f"{at.value!r} with {count} {what}")
    _check_trees(at, [node.get("children", []) for node in tree.get("nodes", [])])


def _check_trees(at: At, children: list[list[int]]) -> None:
    """Refuse nodes of several parents and nodes in a circle: glTF has trees."""
    parents = Counter(child for some in children for child in some)
    if max(parents.values(), default=0) > 1:
        at.refuse("trees of nodes", f"{at.value!r} with a node of several parents")
    reached = [node for node in range(len(children)) if node not in parents]
    for node in reached:  # grows
        reached.extend(children[node] if node >= 0 else ())
    if len(reached) < len(children):
        at.refuse("trees of nodes", f"{at.value!r} with nodes in a circle")


def _uris(tree: Any) -> Iterator[tuple[str, dict[str, str], str]]:  # noqa: ANN401
    """The buffers and images that lie in files of their own: kind, part, name of the file."""
    for kind in ("buffers", "images"):
        for part in tree.get(kind, []):
            if not part.get("uri", "data:").startswith("data:"):
                yield kind, part, unquote(part["uri"])


def _amounts(tree: Any) -> Iterator[tuple[int, int, str]]:  # noqa: ANN401
    """What a file unfolds to, at most how much of it is read, and its name."""
    counts = [part["count"] for part in tree.get("accessors", [])]
    for part, count in zip(tree.get("accessors", []), counts, strict=True):
        held = "bufferView" in part
        yield count, MOST_NUMBERS if held else MOST_ZEROS, "items" if held else "items of no bytes"
    faces = [
        sum(counts[p["indices"] if "indices" in p else p["attributes"]["POSITION"]] // 3
            for p in mesh["primitives"])
        for mesh in tree.get("meshes", [])
    ]  # fmt: skip
    nodes = tree.get("nodes", [])
    yield len(nodes), MOST_NODES, "nodes"
    placed = sum(faces[node["mesh"]] for node in nodes if "mesh" in node)
    yield placed, MOST_FACES, "faces in all places of its meshes"


# Files that a mesh names.


def source_of(path: Path, *, looks: bool) -> Source:
    """What trimesh is given of a file: clean text, and the files that it names."""
    kind = path.suffix.lower()
    if kind == ".obj":
        return _obj(path, looks=looks)
    if kind == ".gltf":
        return _gltf(path)
    content = path.read_bytes() if kind in (".off", ".stl", ".ply") else b"\0"
    if b"\0" not in content:
        try:
            content.decode()
        except UnicodeDecodeError:  # of a comment or a name
            return Source(content.decode("cp1252", errors="replace").encode(), {}, ())
    return Source(None, {}, ())


def companions(path: Path) -> tuple[Path, ...]:
    """Files that an .obj or .gltf names (materials, textures, buffers), relative to its folder."""
    if path.suffix.lower() not in (".obj", ".gltf"):
        return ()
    if path.suffix.lower() == ".gltf":
        found = [beside(path, name) for _, _, name in _uris(gltf_tree(path))]
    else:
        libraries = _libraries(_text(path), path)
        lines = (line for library in libraries for line in MAPS.findall(_text(library)))
        found = [*libraries, *(beside(path, _map(line)[0]) for line in lines)]
    home = path.parent.resolve()
    return tuple(dict.fromkeys(file.relative_to(home) for file in found if file is not None))


def beside(path: Path, name: str) -> Path | None:
    """The file at or below the folder of `path` that a name in it means; None: there is none.

    Slashes, case, and the folders of another computer do not count.
    """
    if name.startswith("data:") or "\0" in name or not name.strip():
        return None
    home, parts = path.parent.resolve(), PurePosixPath(name.replace("\\", "/")).parts
    for way in (parts, parts[-1:]):
        full = (home / Path(*way)).resolve()
        if full.is_relative_to(home) and full.is_file():
            return full
        below = (p for p in home.iterdir() if p.is_dir()) if way == parts[-1:] else ()
        for folder in (home, *below):
            current: Path | None = folder
            for part in way:
                known = current.iterdir() if current is not None and current.is_dir() else ()
                current = next((p for p in known if p.name.lower() == part.lower()), None)
            if current is not None and current.is_file():
                full = current.resolve()
                return full if full.is_relative_to(home) else None
    return None


def _text(path: Path) -> str:
    """A text of any encoding."""
    content = path.read_bytes()
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError:
        return content.decode("cp1252", errors="replace")


def _libraries(text: str, path: Path) -> list[Path]:
    """The files of materials that an .obj names, in one word or several."""
    found: list[Path | None] = []
    for name in dict.fromkeys(re.findall(r"^mtllib\s+(.+?)\s*$", text, re.MULTILINE)):
        whole = beside(path, name)
        found += [whole] if whole is not None else [beside(path, word) for word in name.split()]
    return [file for file in found if file is not None]


def _map(line: str) -> tuple[str, bool]:
    """The file of a texture, without the options before it, and whether they move the picture."""
    name, moved = " ".join(line.split()), False
    while option := OPTION.match(name):
        usual = 1 if option[1] == "s" else 0
        moved = moved or any(float(word) != usual for word in (option[2] or "").split())
        name = name[option.end() :]
    return name, moved


def _obj(path: Path, *, looks: bool) -> Source:
    """An .obj whose faces come material by material: groups by the thousand cost nothing.

    Indices from the end are counted from the start.
    """
    corners: dict[str, list[str]] = {}
    points, current = list[str](), ""
    counts = {"v": 0, "vt": 0, "vn": 0}
    text = _text(path)
    for line in text.replace("\\\r\n", " ").replace("\\\n", " ").splitlines():
        word, _, rest = line.strip().partition(" ")
        if word in counts:
            counts[word] += 1
            points.append(line)
        elif word == "f":
            if "-" in rest:
                rest = " ".join(_absolute(corner, counts) for corner in rest.split())
            corners.setdefault(current, []).append(f"f {rest}")
        elif word == "usemtl" and looks:
            current = rest.strip()
    materials, files, lost = ("", {}, []) if not looks else _materials(path, text)
    if len(corners) > MOST_MATERIALS:
        lost.append(f"{len(corners)} materials, more than {MOST_MATERIALS}")
        corners, materials = {"": [face for faces in corners.values() for face in faces]}, ""
    chunks = [f"usemtl {name}\n" * bool(name) + "\n".join(f) for name, f in corners.items()]
    head = ["mtllib looks.mtl"] if materials else []
    content = "\n".join([*head, *points, *chunks, ""]).encode()
    return Source(content, {**files, "looks.mtl": materials.encode()}, tuple(lost))


def _absolute(corner: str, counts: dict[str, int]) -> str:
    """`3/2/3` of a corner that counts from the end of what was read before it."""
    numbers = corner.split("/")
    for k, (kind, number) in enumerate(zip(("v", "vt", "vn"), numbers, strict=False)):
        if number.startswith("-"):
            numbers[k] = str(counts[kind] + 1 + int(number))
    return "/".join(numbers)


def _materials(path: Path, text: str) -> tuple[str, dict[str, bytes], list[str]]:
    """All materials of an .obj as one text, its colour textures by name, and what is not there."""
    lines, files, lost = list[str](), dict[str, bytes](), list[str]()
    libraries = _libraries(text, path)
    if "mtllib" in text and "usemtl" in text and not libraries:
        name = re.findall(r"^mtllib\s+(.+?)\s*$", text, re.MULTILINE)
        lost.append(f"the materials of {', '.join(name)}, which is not beside it")
    for line in (line for library in libraries for line in _text(library).splitlines()):
        word, _, rest = line.strip().partition(" ")
        if word.lower() != "map_kd":
            lines += [] if word.lower().startswith(("map_", "bump", "norm", "disp")) else [line]
            continue
        name, moved = _map(rest)
        found = beside(path, name)
        if found is None:
            lost.append(f"the texture {name}, which is not beside it")
            continue
        lost += [f"how {name} is shifted or repeated by options"] if moved else []
        key = f"texture_{len(files)}{found.suffix.lower()}"
        files[key] = found.read_bytes()
        lines.append(f"map_Kd {key}")
    return "\n".join(lines), files, lost


def _gltf(path: Path) -> Source:
    """A .gltf that names its files as they are called."""
    tree, files, lost = gltf_tree(path), dict[str, bytes](), list[str]()
    for k, (kind, part, name) in enumerate(_uris(tree)):
        found, part["uri"] = beside(path, name), f"{kind}_{k}"
        if found is None:
            lost.append(f"the texture {name}, which is not beside it")
        else:
            files[part["uri"]] = found.read_bytes()
    return Source(json.dumps(tree).encode(), files, tuple(lost))


def looks_lost(path: Path) -> str:
    """What to say of a mesh file that loses some of its looks; empty: it keeps them all."""
    try:
        lost = source_of(path, looks=True).lost
    except (InputError, OSError, ValueError):
        return ""
    return f"{path.name} loses {'; '.join(lost)}" if lost else ""


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
            at.refuse("a file", f"{shown(name)}, which {not_there(full, 'does not exist')}")
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
