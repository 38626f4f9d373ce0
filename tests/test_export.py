"""scene.glb: read back by another reader, everything stands where it stood."""

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from little_room import box, camera, piece, room, walkers
from PIL import Image

from mover.core.types import Scene, SceneObject
from mover.geometry.placement import place_object
from mover.io.export.scene_glb import write_glb


def bounds_of(piece: SceneObject) -> np.ndarray:
    """Lowest and highest corner in the world."""
    return torch.stack(place_object(piece).verts.aminmax(dim=0)).numpy()


def placed(path: Path, name: str) -> trimesh.Trimesh:
    """The mesh below a node, in the world."""
    scene = trimesh.load_scene(path)
    parents = scene.graph.transforms.parents
    nodes = [scene.graph[n] for n in scene.graph.nodes_geometry if name in (n, parents[n])]
    parts = [scene.geometry[shape].copy().apply_transform(move) for move, shape in nodes]
    return trimesh.util.concatenate(parts)


TYPES = {5126: np.float32, 5125: np.uint32, 5123: np.uint16, 5121: np.uint8}
WIDTH = {"SCALAR": 1, "VEC3": 3, "VEC4": 4, "MAT4": 16}


class Glb:
    """The two parts of a glTF file, its tree and its block of bytes."""

    def __init__(self, path: Path) -> None:
        raw = path.read_bytes()
        size = int.from_bytes(raw[12:16], "little")
        self.tree, self.block = json.loads(raw[20 : 20 + size]), raw[28 + size :]

    def array(self, index: int) -> np.ndarray:
        accessor = self.tree["accessors"][index]
        view = self.tree["bufferViews"][accessor["bufferView"]]
        start = view.get("byteOffset", 0) + accessor.get("byteOffset", 0)
        kind, width = TYPES[accessor["componentType"]], WIDTH[accessor["type"]]
        flat = np.frombuffer(self.block, kind, accessor["count"] * width, start)
        return flat if width == 1 else flat.reshape(-1, width)


def with_file(file: Path) -> Path:
    """The export of a chair that is in the user's file."""
    given = piece("chair_0", box(0.5, 0.9, 0.5), (0.4, -3.0), 0.7, -1.5)
    given = replace(given, mesh_file=str(file), scale=torch.tensor([1.2, 0.8, 1.0]))
    return write_glb(Scene(camera(), None, (given,)), None, file.with_name("scene.glb"))


def textured(**material: Any) -> trimesh.Trimesh:
    """A box whose picture has the colours 0 to 47."""
    shape = trimesh.creation.box(extents=(0.5, 0.9, 0.5))
    picture = Image.fromarray(np.arange(48, dtype=np.uint8).reshape(4, 4, 3))
    uv = np.random.default_rng(0).random((len(shape.vertices), 2))
    material = trimesh.visual.material.PBRMaterial(baseColorTexture=picture, **material)
    shape.visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
    return shape


def test_objects_are_nodes_of_their_ids_where_they_stand(tmp_path):
    scene = room()
    path = write_glb(scene, None, tmp_path / "out" / "scene.glb")
    assert [*path.parent.iterdir()] == [path]  # it appears all at once
    for given in scene.objects:
        assert placed(path, given.id).bounds == pytest.approx(bounds_of(given), abs=1e-5)


def test_a_node_holds_the_placement_and_its_mesh_keeps_its_own_frame(tmp_path):
    turned = replace(room().objects[0], scale=torch.tensor([1.2, 0.8, 1.0]))
    path = write_glb(Scene(camera(), None, (turned,)), None, tmp_path / "scene.glb")
    node = next(n for n in Glb(path).tree["nodes"] if n.get("name") == "chair_0")
    matrix = np.array(node["matrix"]).reshape(4, 4).T
    corner = np.array([0.25, 0.9, 0.25])
    c, s = math.cos(float(turned.yaw)), math.sin(float(turned.yaw))
    x, y, z = corner * [1.2, 0.8, 1.0]
    by_hand = np.array([c * x + s * z, y, c * z - s * x]) + turned.t_world_object.numpy()
    assert matrix[:3, :3] @ corner + matrix[:3, 3] == pytest.approx(by_hand, abs=1e-6)


def test_textures_of_the_users_file_survive(tmp_path):
    textured().export(tmp_path / "chair.glb")
    path = with_file(tmp_path / "chair.glb")
    image = placed(path, "chair_0").visual.material.baseColorTexture
    assert np.array_equal(np.asarray(image.convert("RGB")).ravel(), np.arange(48))


def test_transforms_inside_the_users_file_apply(tmp_path):
    inside = trimesh.Scene()
    lift = trimesh.transformations.translation_matrix([0.0, 0.45, 0.0])
    inside.add_geometry(trimesh.creation.box(extents=(0.5, 0.9, 0.5)), transform=lift)
    seat = trimesh.transformations.translation_matrix([0.0, 1.0, 0.0])
    inside.add_geometry(trimesh.creation.box(extents=(0.1, 0.2, 0.1)), transform=seat)
    file = tmp_path / "chair.glb"
    inside.export(file)
    found = placed(with_file(file), "chair_0")
    assert found.bounds[:, 1] == pytest.approx([-1.5, -1.5 + 0.8 * 1.1], abs=1e-5)
    assert found.volume == pytest.approx(1.2 * 0.8 * (0.5 * 0.9 * 0.5 + 0.1 * 0.2 * 0.1), rel=1e-4)


def test_at_most_twelve_bodies_are_named_after_person_and_frame(tmp_path):
    bodies = walkers(40, people=2)
    path = write_glb(room(), bodies, tmp_path / "scene.glb")
    names = [n["name"] for n in Glb(path).tree["nodes"] if n.get("name", "").startswith("body_")]
    assert len(names) == 12
    for name in names:
        _, person, frame = name.split("_")
        row = int(((bodies.person == int(person)) & (bodies.frame == int(frame))).nonzero())
        truth = torch.stack(bodies.verts[row].aminmax(dim=0)).numpy()
        assert placed(path, name).bounds == pytest.approx(truth, abs=1e-5)


def test_the_floor_is_level_under_everything_and_faces_up(tmp_path):
    scene = room()
    floor = placed(write_glb(scene, None, tmp_path / "scene.glb"), "ground")
    assert floor.bounds[:, 1] == pytest.approx([scene.ground, scene.ground])
    assert np.allclose(floor.face_normals, [0, 1, 0])
    stands = torch.cat([place_object(p).verts for p in scene.objects]).numpy()
    assert (floor.bounds[0, [0, 2]] < stands.min(0)[[0, 2]]).all()
    assert (floor.bounds[1, [0, 2]] > stands.max(0)[[0, 2]]).all()


def test_the_camera_sees_the_same_pixels(tmp_path):
    scene = replace(room(), camera=camera(-0.3, 0.1))
    tree = Glb(write_glb(scene, None, tmp_path / "scene.glb")).tree
    lens = tree["cameras"][0]["perspective"]
    node = next(n for n in tree["nodes"] if "camera" in n)
    to_world = np.array(node["matrix"]).reshape(4, 4).T
    point = np.array([0.4, -0.8, -3.5])
    x, y, z = to_world[:3, :3].T @ (point - to_world[:3, 3])  # glTF: looks along -z, +y up
    focal = 1 / math.tan(lens["yfov"] / 2)
    u = 320 * (1 + focal / lens["aspectRatio"] * x / -z)
    v = 180 * (1 - focal * y / -z)
    seen = (scene.camera.K @ scene.camera.R_cam_world @ torch.tensor(point).float()).numpy()
    assert [u, v] == pytest.approx(seen[:2] / seen[2], abs=0.01)


def test_names_that_clash_stay_apart(tmp_path):
    names = ("ground", "camera", "world", "body_0_0", "ground_mesh")
    pieces = [piece(n, box(1, 1, 1), (i * 2.0, -3.0), 0.0, -1.5) for i, n in enumerate(names)]
    path = write_glb(Scene(camera(), -1.5, tuple(pieces)), walkers(1), tmp_path / "scene.glb")
    tree = Glb(path).tree
    assert len(tree["meshes"]) == len(names) + 2
    assert len({n["name"] for n in tree["nodes"]}) == len(tree["nodes"])


def test_normals_of_flattened_triangles_are_valid(tmp_path):
    corners = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [2, 0, 0], [3, 0, 0], [4, 0, 0.0]]
    shape = trimesh.Trimesh(corners, [[0, 1, 2], [3, 4, 5]], process=False)
    file = tmp_path / "flat.glb"
    file.write_bytes(trimesh.exchange.gltf.export_glb(trimesh.Scene(shape), include_normals=True))
    glb = Glb(with_file(file))
    normals = glb.array(glb.tree["meshes"][0]["primitives"][0]["attributes"]["NORMAL"])
    assert np.linalg.norm(normals, axis=1) == pytest.approx(np.ones(6), abs=1e-3)
