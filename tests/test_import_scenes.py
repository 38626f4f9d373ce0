"""A known room in the layout of every tool comes back as the same room."""

import json
import math
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import make_scenes as layouts
import numpy as np
import pytest
import torch
import trimesh
from kept_mats import mats_read_once as mats_read_once  # for every test

from mover.core.errors import InputError
from mover.core.types import Capture
from mover.geometry.boxes import Box, box_of, iou3d
from mover.geometry.camera import pitch_roll
from mover.geometry.placement import place_object
from mover.io.capture.faults import check_against_picture
from mover.io.capture.folder import read_capture
from mover.io.capture.merge import Imported, import_into
from mover.io.capture.parts import Hints
from mover.io.capture.scene_file import read_scene
from mover.io.files.fields import At
from mover.io.formats import IMPORTED, chosen

NAMES = {
    "floor lamp": "lamp", "coffee table": "table", "shelf": "shelves", "wardrobe": "cabinet",
    "nightstand": "night_stand", "armchair": "sofa", "office chair": "chair", "stool": "chair",
    "bench": "sofa",
}  # fmt: skip
FINE, COARSE = 1e-4, 1e-2


@pytest.fixture(scope="module")
def plain(small_room):
    """The room as numbers, with sizes that are not those of the meshes."""
    camera = small_room.truth.camera
    things = []
    for i, piece in enumerate(small_room.truth.objects):
        stretch = np.array([1.1, 0.9, 1.2]) if i % 2 else np.ones(3)
        things.append(
            layouts.Thing(
                f"{piece.id}", NAMES.get(piece.category, piece.category),
                piece.mesh.verts.double().numpy(), piece.mesh.faces.numpy(),
                piece.t_world_object.double().numpy(), float(piece.yaw), stretch,
            )
        )  # fmt: skip
    return layouts.Room(
        camera.K.double().numpy(), camera.R_cam_world.double().numpy(),
        (camera.width, camera.height), small_room.truth.ground, things,
    )  # fmt: skip


def imported(format: str, source: Path, out: Path, work: Path, **hints: object) -> Imported:
    parts = chosen("FORMAT", format, *IMPORTED)(source, Hints(work=work, **hints))  # pyright: ignore
    return import_into(out, parts)


def capture_of(format: str, source: Path, tmp: Path, **hints: object) -> Capture:
    """Imported, written, and read again."""
    found = imported(format, source, tmp / "out", tmp / "work", **hints)
    assert found.capture is not None
    return read_capture(tmp / "out")


def worst(found: Capture, room: layouts.Room) -> float:
    """Largest distance between the vertices of an object and the true ones [m]."""
    assert len(found.scene.objects) == len(room.things)
    pairs = zip(found.scene.objects, room.things, strict=True)
    return max(np.abs(place_object(p).verts.double().numpy() - t.world).max() for p, t in pairs)


def tilt_error(R: torch.Tensor, room: layouts.Room) -> float:
    pairs = zip(pitch_roll(R), pitch_roll(torch.from_numpy(room.R)), strict=True)
    return max(abs(float(a) - float(b)) for a, b in pairs)


def camera_at(room: layouts.Room) -> At:
    return At(layouts.camera_json(room), "camera")


def lens_at(room: layouts.Room) -> At:
    return At({k: v for k, v in camera_at(room).value.items() if k != "R_cam_world"}, "lens")


ROOMS: dict[str, tuple[str, Any, Any]] = {
    "in two folders": ("total3d", layouts.write_total3d, None),
    "in one folder": ("total3d", partial(layouts.write_total3d, flat=True), None),
    "as ply": ("total3d", partial(layouts.write_total3d, kind="ply"), None),
    "poses in npz": ("sam3d", layouts.write_sam3d, lens_at),
    "poses in json": ("sam3d", partial(layouts.write_sam3d, kind="json"), lens_at),
    "mirrored": ("holisticmesh", layouts.write_holisticmesh, camera_at),
}


@pytest.mark.parametrize("case", ROOMS)
def test_a_known_room_comes_back(plain, tmp_path, case):
    """SAM 3D's with the tilt of its objects, HolisticMesh's from the flipped picture."""
    tool, write, camera = ROOMS[case]
    hints = {} if camera is None else {"camera": camera(plain)}
    found = capture_of(tool, write(tmp_path / "in", plain), tmp_path, **hints)
    assert worst(found, plain) < FINE
    assert tilt_error(found.scene.camera.R_cam_world, plain) < FINE
    assert [p.category for p in found.scene.objects] == [t.category for t in plain.things]
    for detection, thing in zip(found.detections, plain.things, strict=tool != "sam3d"):
        assert detection.box.tolist() == pytest.approx(plain.box2d(thing), abs=1e-3)
    if tool == "total3d":
        assert found.scene.ground == pytest.approx(plain.ground, abs=1e-5)
        findings = check_against_picture(found)
        assert findings.agreement.objects.mean() == pytest.approx(1, abs=1e-3)
        assert findings.warnings == ()


def test_total3d_numbers_are_numbers_not_words(plain, tmp_path):
    twelve = [(plain.things[i % 4], np.array([0.01 * i, 0, 0])) for i in range(12)]
    many = replace(plain, things=[replace(t, t=t.t + shift) for t, shift in twelve])
    source = layouts.write_total3d(tmp_path / "in", many)
    assert worst(capture_of("total3d", source, tmp_path), many) < FINE


def test_holisticmesh_without_a_camera_is_under_the_lens_of_prox_and_what_it_lacks_is_said(
    plain, tmp_path
):
    source = layouts.write_holisticmesh(tmp_path / "in", plain)
    found = imported("holisticmesh", source, tmp_path / "out", tmp_path / "work")
    assert any("the camera is level" in note for note in found.notes)
    camera = read_capture(tmp_path / "out").scene.camera
    assert float(camera.K[0, 0]) == pytest.approx(1060.5317)
    assert (camera.width, camera.height) == (1920, 1080)
    detections, meshes = source / "detections.json", source / "models" / "scene.ply"
    rows = json.loads(detections.read_text())
    for change, words in (
        (lambda: detections.write_text(json.dumps(rows[:-1])),
         f"expected as many vertices for each of {len(rows) - 1}"),
        (detections.unlink, r"detections\.json: there is no such file"),
        (meshes.unlink, r"models/scene\.ply: there is no such file"),
    ):  # fmt: skip
        change()
        with pytest.raises(InputError, match=words):
            imported("holisticmesh", source, tmp_path / "out", tmp_path)


@pytest.mark.parametrize("up", ["y", "-y", "z"])
@pytest.mark.parametrize("camera", [True, False])
def test_a_gltf_scene_gives_the_room_back_whichever_way_is_up(plain, tmp_path, up, camera):
    turns = {"y": np.eye(3), "-y": layouts.FLIP, "z": layouts.Z_UP}
    world = layouts.four(turns[up], [0.5, -2, 3] if camera else [0, 0, 0])
    source = layouts.write_glb(tmp_path / "in.glb", plain, world, camera)
    given = {} if camera else {"camera": camera_at(plain)}
    found = capture_of("glb", source, tmp_path, up=up, **given)
    order = {p.id: p for p in found.scene.objects}
    pieces = tuple(order[t.name] for t in plain.things)
    found = replace(found, scene=replace(found.scene, objects=pieces))
    assert worst(found, plain) < FINE
    assert tilt_error(found.scene.camera.R_cam_world, plain) < FINE
    scales = [float(t.scale[0]) for t in plain.things]
    assert [float(p.scale[0]) for p in pieces] == pytest.approx(scales, abs=1e-5)


def test_what_is_of_the_room_is_no_furniture_and_a_room_in_one_mesh_is_refused(plain, tmp_path):
    source = layouts.write_glb(tmp_path / "in.glb", plain, np.eye(4), True)
    scene = trimesh.load_scene(source)
    objects = {*scene.graph.nodes_geometry}
    shell = ["Floor", "Wall_back", "Walls.001", "ceiling"]
    for name in (*shell, "floor_lamp", "Wall_front"):
        scene.add_geometry(trimesh.creation.box((0.3, 1.5, 0.3)), node_name=name, geom_name=name)
    scene.export(source)
    names = {"Wall_front": "cabinet"}
    found = imported("glb", source, tmp_path / "out", tmp_path, names=names)
    ids = {item.id for item in found.capture.scene.objects}
    assert ids == {*objects, "floor_lamp", "Wall_front"}
    (note,) = (note for note in found.notes if "left out" in note)
    assert all(name in note for name in shell)
    for name, words in {"all": "all is one mesh of", "Floor": "has only Floor"}.items():
        trimesh.Scene({name: scene.to_mesh()}).export(tmp_path / "joined.glb")
        with pytest.raises(InputError, match=rf"^joined.glb: {words}.*expected a node for each"):
            imported("glb", tmp_path / "joined.glb", tmp_path / "out", tmp_path)


@pytest.mark.parametrize("frame", ["y", "-y", "z", "camera"])
def test_boxes_come_back_with_furniture_of_their_class(plain, tmp_path, frame):
    source = layouts.write_boxes(tmp_path / "in.json", plain, frame=frame)
    found = capture_of("boxes", source, tmp_path)
    assert tilt_error(found.scene.camera.R_cam_world, plain) < FINE
    for piece, thing in zip(found.scene.objects, plain.things, strict=True):
        mine = box_of(piece)
        assert np.allclose(mine.center.numpy(), thing.centre, atol=FINE)
        assert np.allclose(mine.size.numpy(), thing.size, atol=FINE)
        assert math.cos(float(piece.yaw) - thing.yaw) == pytest.approx(1, abs=1e-6)
        assert len(piece.mesh.faces) > 12
    assert all(p.annotation is not None for p in found.scene.objects)


def test_a_list_of_boxes_alone_is_that_of_the_objects(plain, tmp_path):
    source = layouts.write_boxes(tmp_path / "in.json", plain)
    source.write_text(json.dumps(json.loads(source.read_text())["objects"]))
    found = imported("boxes", source, tmp_path / "out", tmp_path, camera=camera_at(plain)).capture
    for piece, thing in zip(found.scene.objects, plain.things, strict=True):
        assert np.allclose(box_of(piece).center.numpy(), thing.centre, atol=FINE)
        assert np.allclose(box_of(piece).size.numpy(), thing.size, atol=FINE)


def test_a_tilted_object_stands_upright_about_its_centre(plain, tmp_path):
    tilt = layouts.Rotation.from_euler("x", 8, degrees=True).as_matrix()
    source = layouts.write_glb(tmp_path / "in.glb", plain, layouts.four(tilt), camera=False)
    result = imported("glb", source, tmp_path / "out", tmp_path, camera=camera_at(plain))
    assert sum("a tilt of" in note for note in result.notes) == len(plain.things)
    centres = {t.name: tilt @ t.centre for t in plain.things}
    for piece in result.capture.scene.objects:
        assert np.allclose(box_of(piece).center.numpy(), centres[piece.id], atol=FINE)


def test_the_release_of_the_authors_comes_back_with_their_result_and_the_truth(plain, tmp_path):
    tetra = np.array([[0, 0, 3.0], [0.3, 0, 3], [0, 0.9, 3], [0, 0, 3.3]])
    bodies = np.stack([tetra + np.array([0.1 * i, 0, 0]) for i in range(4)])
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    source = layouts.write_release(tmp_path / "in", plain, bodies, faces)
    found = capture_of("release", source, tmp_path)
    assert worst(found, plain) < FINE
    assert np.allclose(found.bodies.verts.numpy(), bodies, atol=FINE)
    assert found.bodies.frame.tolist() == [0, 1, 2, 3]
    assert found.people.frame.tolist() == [0, 1, 2, 3]
    assert found.touch[:, 0].tolist() == [0, 0.25, 0.5, 0.75]
    assert sorted(p.name for p in (tmp_path / "out" / "frames").iterdir())[0] == "000000.jpg"
    check_truth(tmp_path / "out" / "truth", plain)
    authors = read_scene(tmp_path / "out" / "authors" / "scene.json")
    for piece, thing in zip(authors.objects, plain.things, strict=True):
        assert np.abs(place_object(piece).verts.numpy() - thing.world).max() < FINE


def check_truth(folder: Path, plain: layouts.Room) -> None:
    """True boxes are those of the room, and so is its floor."""
    truth = read_scene(folder / "scene.json")
    assert truth.ground == pytest.approx(plain.ground, abs=0.02)
    assert tilt_error(truth.camera.R_cam_world, plain) < FINE
    for piece, thing in zip(truth.objects, plain.things, strict=True):
        true = Box(*(torch.tensor(v).float() for v in (thing.centre, thing.size, thing.yaw)))
        assert float(iou3d(box_of(piece), true)) > 1 - COARSE


def test_a_scene_needs_a_camera_and_a_mesh_a_pose(plain, tmp_path):
    source = layouts.write_glb(tmp_path / "in.glb", plain, camera=False)
    with pytest.raises(InputError, match="--camera"):
        imported("glb", source, tmp_path / "out", tmp_path)
    assert not (tmp_path / "out").exists()
    source = layouts.write_sam3d(tmp_path / "in", plain)
    (source / "scene.obj").write_text("version https://git-lfs.github.com/spec/v1\noid 1\n")
    (source / "1.npz").unlink()
    found = imported("sam3d", source, tmp_path / "out", tmp_path, camera=camera_at(plain))
    said = "2 files (1.glb, scene.obj) without a pose (.npz or .json) beside it: passed over"
    assert said in found.notes
    assert len(found.capture.scene.objects) == len(plain.things) - 1
    for pose in (source / "scene.obj", *source.glob("*.npz")):
        pose.unlink()
    with pytest.raises(InputError, match=r"0\.glb: has no pose, expected 0\.npz or 0\.json"):
        imported("sam3d", source, tmp_path / "out", tmp_path, camera=camera_at(plain))
