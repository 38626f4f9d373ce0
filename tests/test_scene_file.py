import json
from typing import Any

import numpy as np
import pytest
import tiny_capture as tiny
import torch

from mover.core.errors import InputError
from mover.core.types import Camera, Mesh, Scene, SceneObject
from mover.geometry.placement import place_object
from mover.io.capture.scene_file import read_scene, write_scene

CAMERA = Camera(torch.eye(3) * 50, torch.diag(torch.tensor([1.0, -1, -1])), 20, 10)


def step() -> Mesh:
    return Mesh(torch.from_numpy(tiny.STEP).float(), torch.from_numpy(tiny.STEP_FACES))


def piece(name: str = "a", file: str = "") -> SceneObject:
    place, scale = torch.tensor([0.1, -1.0, -2.0]), torch.tensor([1.0, 2.0, 3.0])
    return SceneObject(name, "chair", step(), file, None, "free", place, torch.tensor(0.3), scale)


def test_a_mesh_without_a_file_becomes_glb_with_the_same_triangles(tmp_path):
    write_scene(Scene(CAMERA, None, (piece(),)), tmp_path / "scene.json")
    assert [p.name for p in (tmp_path / "meshes").iterdir()] == ["a.glb"]
    found = read_scene(tmp_path / "scene.json")
    assert found.ground is None
    assert found.objects[0].support == "free"
    assert found.objects[0].annotation is None
    assert torch.allclose(place_object(found.objects[0]).verts, place_object(piece()).verts)
    assert found.objects[0].mesh.faces.tolist() == tiny.STEP_FACES.tolist()
    tree = json.loads((tmp_path / "scene.json").read_text())
    assert tree["objects"][0]["translation"] == [0.1, -1.0, -2.0]  # short decimals
    assert tree["objects"][0]["yaw"] == 0.3


def test_how_far_off_all_sizes_are_together_is_kept_and_by_itself_nothing(tmp_path):
    file = tmp_path / "scene.json"
    for spread in (0.0, 0.04):
        write_scene(Scene(CAMERA, None, (piece(),), size_spread=spread), file)
        assert read_scene(file).size_spread == spread
        assert ("size_spread" in json.loads(file.read_text())) == bool(spread)
    file.write_text(file.read_text().replace("0.04", "-0.04"))
    with pytest.raises(InputError, match="size_spread"):
        read_scene(file)


def test_a_users_mesh_is_copied_byte_by_byte(tmp_path):
    source = tmp_path / "user" / "thing.obj"
    source.parent.mkdir()
    tiny.write_obj(source, tiny.STEP, tiny.STEP_FACES)
    out = tmp_path / "out" / "scene.json"
    write_scene(Scene(CAMERA, -1.0, (piece("a", str(source)), piece("b", str(source)))), out)
    for name in ("a", "b"):
        assert (out.parent / "meshes" / f"{name}.obj").read_bytes() == source.read_bytes()


def test_materials_and_textures_go_with_an_obj_and_two_do_not_mix(tmp_path):
    pieces = []
    for colour in ("red", "blue"):
        home = tmp_path / colour
        (home / "maps").mkdir(parents=True)
        tiny.write_obj(home / "thing.obj", tiny.STEP, tiny.STEP_FACES)
        text = "mtllib my stuff.mtl\nmtllib ../secret.mtl\n" + (home / "thing.obj").read_text()
        (home / "thing.obj").write_text(text)
        (home / "my stuff.mtl").write_text(f"newmtl {colour}\nmap_Kd -s 1 1 1 maps/wood.png\n")
        (home / "maps" / "wood.png").write_text(colour)
        pieces.append(piece(colour, str(home / "thing.obj")))
    (tmp_path / "secret.mtl").write_text("not beside the mesh")
    write_scene(Scene(CAMERA, None, tuple(pieces)), tmp_path / "out" / "scene.json")
    files = [p for p in (tmp_path / "out").rglob("*") if p.is_file()]
    assert not [p for p in files if "secret" in p.name]
    for colour in ("red", "blue"):
        home = tmp_path / "out" / "meshes" / colour
        given = (tmp_path / colour / "thing.obj").read_bytes()
        assert (home / f"{colour}.obj").read_bytes() == given
        assert colour in (home / "my stuff.mtl").read_text()
        assert (home / "maps" / "wood.png").read_text() == colour
    assert len(read_scene(tmp_path / "out" / "scene.json").objects) == 2


def test_the_buffer_of_a_gltf_goes_with_it(tmp_path):
    import trimesh

    body = trimesh.Trimesh(tiny.STEP, tiny.STEP_FACES, process=False)
    files: Any = trimesh.Scene(body).export(file_type="gltf")
    for name, content in files.items():
        (tmp_path / name).write_bytes(content)
    scene = Scene(CAMERA, None, (piece("a", str(tmp_path / "model.gltf")),))
    write_scene(scene, tmp_path / "o" / "s.json")
    found = read_scene(tmp_path / "o" / "s.json").objects[0]
    assert torch.equal(found.mesh.verts, step().verts)


def test_writing_over_the_scene_that_was_read_changes_no_byte(folder):
    scene = read_scene(folder / "scene.json", CAMERA)
    write_scene(scene, folder / "scene.json")
    before = {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()}
    write_scene(read_scene(folder / "scene.json"), folder / "scene.json")
    assert before == {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_vertices_that_no_face_uses_and_faces_without_area_do_not_count(folder):
    verts = np.array([[9.0, 9, 9], *tiny.STEP, [-9.0, 0, 0]])
    faces = np.array([*(tiny.STEP_FACES + 1), [0, 0, 0]])
    tiny.write_obj(folder / "meshes" / "step.obj", verts, faces)
    mesh = read_scene(folder / "scene.json", CAMERA).objects[0].mesh
    assert torch.equal(mesh.verts, step().verts)
    assert torch.equal(mesh.faces, step().faces)


def test_a_scene_without_any_camera_is_refused(folder):
    with pytest.raises(InputError, match=r"scene.json: field 'camera' has nothing, expected a cam"):
        read_scene(folder / "scene.json")
