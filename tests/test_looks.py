"""Mesh files as people have them: textures named in any way, no faces, packed, far too many."""

import json
import struct
from pathlib import Path
from typing import Any

import pytest
import trimesh
from PIL import Image
from test_export import textured as textured_box

from mover.core.errors import InputError
from mover.io.files import meshes
from mover.io.files.fields import At

RED = (200, 10, 10)
OBJ = """{library}
v 0 0 0
v 1 0 0
v 1 1 0
v 0 1 0
vt 0 0
vt 1 0
vt 1 1
vt 0 1
usemtl wood
f 1/1 2/2 3/3 4/4
"""
NAMED = {  # the line of the material, where the picture lies
    "plain": ("map_Kd wood.png", "wood.png"),
    "back slashes": ("map_Kd textures\\wood.png", "textures/wood.png"),
    "case": ("map_Kd Textures/WOOD.PNG", "textures/wood.png"),
    "options": ("map_Kd -s 1 1 1 -blendu on wood.png", "wood.png"),
    "space": ("map_Kd dark wood.png", "dark wood.png"),
    "another computer": ("map_Kd C:\\Users\\me\\Textures\\wood.png", "textures/wood.png"),
    "upper case": ("MAP_KD wood.png", "wood.png"),
}


def textured(folder: Path, line: str, file: str | None, library: str = "mtllib a.mtl") -> Path:
    folder.mkdir(exist_ok=True)
    (folder / "a.obj").write_text(OBJ.format(library=library))
    (folder / "a.mtl").write_text(f"newmtl wood\nKd 1 1 1\n{line}\n")
    if file is not None:
        (folder / file).parent.mkdir(exist_ok=True)
        Image.new("RGB", (4, 4), RED).save(folder / file)
    return folder / "a.obj"


def parts_of(path: Path) -> Any:
    return meshes.load_parts(At(path.name, "here"), path)


def colour_of(path: Path) -> Any:
    (part,) = parts_of(path).geometry.values()
    image = getattr(part.visual.material, "image", None)
    return None if image is None else image.convert("RGB").getpixel((0, 0))


@pytest.mark.parametrize("way", NAMED)
def test_a_texture_is_found_as_people_name_it_and_goes_along(way, tmp_path):
    path = textured(tmp_path / "in", *NAMED[way])
    assert colour_of(path) == RED
    assert meshes.looks_lost(path) == ""
    assert meshes.companions(path) == (Path("a.mtl"), Path(NAMED[way][1]))
    assert colour_of(meshes.copy_mesh(path, tmp_path / "out", "chair_0")) == RED


@pytest.mark.parametrize(("line", "library", "said"), [
    ("map_Kd oak.png", "mtllib a.mtl", "a.obj loses the texture oak.png, which is not beside"),
    ("map_Kd ../wood.png", "mtllib b.mtl", "a.obj loses the materials of b.mtl, which is not"),
    ("map_Kd -s 4 4 wood.png", "mtllib a.mtl", "how wood.png is shifted or repeated"),
])  # fmt: skip
def test_what_is_lost_of_the_looks_is_said(line, library, said, tmp_path):
    path = textured(tmp_path, line, "wood.png", library)
    assert said in meshes.looks_lost(path)
    assert len(parts_of(path).to_mesh().faces) == 2


def test_pictures_of_a_gltf_are_found_in_any_case(tmp_path):
    files: Any = trimesh.Scene(textured_box()).export(file_type="gltf")
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
    path = tmp_path / "model.gltf"
    tree = json.loads(path.read_text())
    assert len(tree["images"]) == 1
    tree["images"] = [{"uri": "textures\\wood.PNG"}]
    Image.new("RGB", (2, 2), RED).save(tmp_path / "Wood.png")
    path.write_text(json.dumps(tree))
    (loaded,) = parts_of(path).geometry.values()
    assert loaded.visual.material.baseColorTexture.getpixel((0, 0)) == RED
    assert Path("Wood.png") in meshes.companions(path)
    (tmp_path / "Wood.png").unlink()
    assert "loses the texture textures\\wood.PNG" in meshes.looks_lost(path)


def test_groups_materials_and_indices_from_the_end_are_one_mesh(tmp_path):
    part = "o part{i}\nv {i} 0 0\nv {i} 1 0\nv {i} 0 1\ng g{i}\nusemtl m{i}\nf -3 -2 -1\n"
    path = tmp_path / "many.obj"
    text = "mtllib many.mtl\n# M\xf6bel\n" + "".join(part.format(i=i) for i in range(3000))
    path.write_bytes(text.encode("latin-1"))
    (tmp_path / "many.mtl").write_text("".join(f"newmtl m{i}\nKd 1 0 0\n" for i in range(3000)))
    verts, faces = meshes.load_arrays(At(path.name, "here"), path)
    assert verts[faces].tolist() == [[[i, 0, 0], [i, 1, 0], [i, 0, 1]] for i in range(3000)]
    assert len(parts_of(path).to_mesh().faces) == 3000
    assert "3000 materials" in meshes.looks_lost(path)


REMARKS = {  # how the file is written, and what becomes of its first mark
    "off": ({"file_type": "off"}, b"\n", b"\n# M\xf6bel\n"),
    "stl": ({"file_type": "stl_ascii"}, b"\n", b" M\xf6bel\n"),
    "ply": ({"file_type": "ply", "encoding": "ascii"}, b"element", b"comment M\xf6bel\nelement"),
}


@pytest.mark.parametrize("kind", REMARKS)
def test_a_byte_that_is_not_utf_8_does_not_matter(kind, tmp_path):
    path, (options, mark, word) = tmp_path / f"a.{kind}", REMARKS[kind]
    whole: Any = trimesh.creation.box().export(**options)
    content = whole.encode() if isinstance(whole, str) else whole
    path.write_bytes(content.replace(mark, word, 1))
    assert len(meshes.load_arrays(At(path.name, "here"), path)[1]) == 12


# What has no surface, or is not what its name says.

SPLATS = "ply\nformat ascii 1.0\nelement vertex 2\n" + "".join(
    f"property float {name}\n"
    for name in ("x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2", "opacity",
                 "scale_0", "scale_1", "scale_2", "rot_0", "rot_1", "rot_2", "rot_3")
) + "end_header\n" + "0 " * 17 + "\n" + "1 " * 17 + "\n"  # fmt: skip
"""What 3D Gaussian splatting writes (graphdeco-inria, scene/gaussian_model.py: save_ply)."""
BAD = {
    "splats.ply": (SPLATS, "2 points without faces .a cloud of points, or Gaussian"),
    "points.obj": ("v 0 0 0\nv 1 0 0\nv 0 1 0\n", "3 points without faces"),
    "empty.obj": ("", "cannot be read: it is empty"),
    "lines.obj": ("v 0 0 0\nv 1 0 0\nl 1 2\n", "without faces"),
    "pointer.glb": ("version https://git-lfs.github.com/spec/v1\noid sha256:1\n", "Git LFS"),
    "page.stl": ("<!DOCTYPE html>\n<html><body>sign in</body></html>", "a web page"),
    "wide.obj": ("\ufeffv 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "text in UTF-16: save it as UTF-8"),
    "page.obj": ("<html><body>sign in</body></html>", "a web page"),
}


@pytest.mark.parametrize("name", BAD)
def test_what_is_no_mesh_is_named_for_what_it_is(name, tmp_path):
    content, words = BAD[name]
    text = "utf-16-le" if name == "wide.obj" else "utf-8"
    (tmp_path / name).write_text(content, text)
    with pytest.raises(InputError, match=words) as caught:
        meshes.load_arrays(At(name, "scene.json", "objects[0].mesh"), tmp_path / name)
    assert str(caught.value).startswith("scene.json: field 'objects[0].mesh' has ")
    assert "Error" not in str(caught.value)
    assert meshes.is_cloud(tmp_path / name) == (name == "splats.ply")


def gltf(path: Path, nodes: list[Any], count: int = 60_000, **more: Any) -> Path:
    """A .glb of one mesh of `count` corners, of whose arrays there are no bytes."""
    arrays = [{"componentType": 5126, "count": count, "type": "VEC3"}]
    tree = {"asset": {"version": "2.0"}, "scenes": [{"nodes": [0]}], "nodes": nodes,
            "meshes": [{"primitives": [{"attributes": {"POSITION": 0}}]}],
            "accessors": arrays, **more}  # fmt: skip
    body = json.dumps(tree).encode()
    body += b" " * (-len(body) % 4)
    head = struct.pack("<4sIIII", b"glTF", 2, 20 + len(body), len(body), 0x4E4F534A)
    path.write_bytes(head + body)
    return path


@pytest.mark.parametrize(("nodes", "more", "words"), [
    ([{"mesh": 0}] * 800, {}, "16000000 faces in all places of its meshes, expected at most"),
    ([{"mesh": 0}] * 40_000, {}, "40000 nodes, expected at most 10000"),
    ([{"mesh": 0}], {"count": (1 << 27) - 1}, "134217727 items of no bytes, expected at most"),
    ([{"mesh": 0}], {"extensionsRequired": ["KHR_draco_mesh_compression"]}, "packed by Draco"),
])  # fmt: skip
def test_files_that_unfold_or_are_packed_are_refused_at_once(nodes, more, words, tmp_path):
    path = gltf(tmp_path / "a.glb", nodes, **more)
    with pytest.raises(InputError, match=words):
        meshes.load_arrays(At(path.name, "here"), path)
