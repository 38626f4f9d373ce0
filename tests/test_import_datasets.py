"""PROX and PiGraphs from files in their exact layout."""

import json
from pathlib import Path

import make_scenes as layouts
import numpy as np
import pytest
import torch
from PIL import Image
from test_import_scenes import check_truth, imported
from test_import_scenes import plain as plain  # the fixture

import mover.io.formats
from mover.app.cli import run_command
from mover.core.errors import InputError
from mover.geometry.placement import place_object
from mover.io.capture.evidence import gather_evidence
from mover.io.capture.folder import read_capture
from mover.io.capture.scene_file import read_scene
from mover.io.formats import names
from mover_bench.datasets.pigraphs import NAMES, capsule_people, read_segments
from mover_bench.datasets.prox_files import recordings_of
from mover_bench.datasets.true_boxes import FLOOR

RECORDING = "MPH8_00034_01"


def prox_room(plain: layouts.Room) -> layouts.Room:
    """The room under PROX's picture size."""
    K = np.diag([1920 / plain.size[0]] * 2 + [1]) @ plain.K
    return layouts.Room(K, plain.R, (1920, 1080), plain.ground, plain.things)


@pytest.fixture(scope="module")
def prox(plain, tmp_path_factory):
    root = tmp_path_factory.mktemp("prox")
    room = prox_room(plain)
    layouts.write_prox(root, room, RECORDING, 3, np.array([1.0, 2.0, 1.5]))
    (root / "recordings" / "N0SittingBooth_00162_01" / "Color").mkdir(parents=True)
    return root


def test_prox_gives_flipped_frames_its_lens_and_the_truth(prox, plain, tmp_path):
    out, room = tmp_path / "out", prox_room(plain)
    boxes = prox / "boxes" / "bbox3d.json"
    imported("prox", prox, out, tmp_path, recording=RECORDING, boxes=boxes)
    lens = json.loads((out / "camera.json").read_text())
    assert lens["cx"] == pytest.approx(room.K[0, 2], abs=1e-6)
    assert "R_cam_world" not in lens  # the truth stays in truth/
    names = sorted(p.name for p in (out / "frames").iterdir())
    assert names == ["000000.jpg", "000001.jpg", "000002.jpg"]
    with Image.open(out / "frames" / "000000.jpg") as picture:
        flipped = np.asarray(picture).astype(int)
    assert np.abs(flipped - np.asarray(layouts.picture(room.size)).astype(int)).mean() < 3
    check_truth(out / "truth", room)
    check_scan(out / "truth_scan", room)
    check_keypoints(out / "keypoints" / "000001_keypoints.json")


def check_scan(folder: Path, room: layouts.Room) -> None:
    """What the scan has in the boxes are the objects themselves above the floor, and no floor."""
    truth = read_scene(folder / "scene.json")
    for piece, thing in zip(truth.objects, room.things, strict=True):
        mesh = place_object(piece)
        verts = mesh.verts.numpy()
        gap = np.linalg.norm(thing.world[:, None] - verts[None], axis=-1).min(1)
        above = thing.world[:, 1] - truth.ground > FLOOR
        assert above.any()
        assert gap[above].max() < 1e-3, thing.name
        assert (verts[mesh.faces.numpy()][..., 1].max(1) - truth.ground > 0.9 * FLOOR).all()


def check_keypoints(file: Path) -> None:
    """Those of mirrored pictures change sides."""
    (person,) = json.loads(file.read_text())["people"]
    joints = np.array(person["pose_keypoints_2d"]).reshape(-1, 3)
    assert joints[7].tolist() == [1920 - 101, 200, 0.9]  # the left wrist
    assert not joints[4].any()
    hands = [np.array(person[f"hand_{s}_keypoints_2d"]) for s in ("right", "left")]
    assert hands[0].any()
    assert not hands[1].any()


def test_axes_by_columns_are_understood(prox, plain, tmp_path):
    layouts.write_truth(tmp_path, prox_room(plain), columns=True)
    boxes = tmp_path / "bbox3d.json"
    imported("prox", prox, tmp_path / "out", tmp_path, recording=RECORDING, boxes=boxes)
    check_truth(tmp_path / "out" / "truth", prox_room(plain))


def test_booths_are_left_out_and_an_unknown_recording_is_named_with_those_there_are(prox, tmp_path):
    assert recordings_of(prox) == [RECORDING]
    with pytest.raises(InputError, match=RECORDING):
        imported("prox", prox, tmp_path / "out", tmp_path, recording="MPH11_1_1")


def walking(frames: int) -> np.ndarray:
    """Skeletons of Kinect in the camera's axes: they walk to the right of the picture."""
    joints = np.zeros((frames, 25, 3))
    heights = {0: 0.9, 1: 1.2, 2: 1.5, 3: 1.65, 20: 1.4, 12: 0.9, 16: 0.9, 13: 0.5, 17: 0.5,
               14: 0.1, 18: 0.1, 15: 0.03, 19: 0.03}  # fmt: skip
    for j in range(25):
        joints[:, j, 1] = 1.4 - heights.get(j, 1.1)
        side = 1 if j in (4, 5, 6, 7, 12, 13, 14, 15, 21, 22) else -1
        joints[:, j, 0] = 0.15 * side if j not in (0, 1, 2, 3, 20) else 0
    joints[..., 2] = 3.0
    joints[..., 0] += 0.1 * np.arange(frames)[:, None]
    return joints


@pytest.mark.parametrize("mirror", [False, True])
def test_pigraphs_gives_skeletons_with_skin_and_the_truth(plain, tmp_path, mirror):
    joints = walking(4)
    name = "3bHallway_mati2_2014-04-30-22-46-22"
    things = [t for t in plain.things if t.category in ("chair", "bed", "desk", "cabinet", "sofa")]
    room = layouts.Room(plain.K, plain.R, plain.size, plain.ground, things)
    layouts.write_pigraphs(tmp_path / "in", room, name, joints, mirror=mirror)
    source = layouts.write_glb(tmp_path / "in.glb", plain)
    imported("glb", source, tmp_path / "out", tmp_path)
    found = imported("pigraphs", tmp_path / "in", tmp_path / "out", tmp_path, recording=name)
    assert any("mirrored" in note for note in found.notes) != mirror
    capture = read_capture(tmp_path / "out")
    assert np.allclose(capture.bodies.joints.numpy(), joints, atol=1e-5)
    assert capture.bodies.frame.tolist() == [0, 1, 2, 3]
    gap = torch.cdist(capture.bodies.verts[2], capture.bodies.joints[2]).amin(0)
    assert float(gap[[0, 3, 13, 17]].max()) < 0.15
    check_truth(tmp_path / "out" / "truth", room)
    gather_evidence(capture)


def test_capsules_are_closed_and_outward():
    arrays = capsule_people([(0, 0, walking(1)[0])], np.eye(3), 5.0)
    verts, faces = arrays["vertices"][0].astype(float), arrays["faces"]
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    assert {tuple(e) for e in edges.tolist()} == {tuple(e[::-1]) for e in edges.tolist()}
    volume = np.einsum("ij,ij->i", verts[faces[:, 0]],
                       np.cross(verts[faces[:, 1]], verts[faces[:, 2]])).sum() / 6  # fmt: skip
    assert 0.03 < volume < 0.2
    assert len(NAMES) == 25


def test_parts_of_an_object_become_one_box(plain, tmp_path):
    layouts.write_pigraphs(tmp_path, plain, "room_a_b", walking(1), mirror=False)
    boxes = read_segments(tmp_path / "roomd.segs.json")
    known = [t for t in plain.things if t.category not in ("shelves", "lamp", "night_stand")]
    assert len(boxes) == len(known)
    for box, thing in zip(boxes, known, strict=True):
        assert np.allclose(sorted(2 * box.half), sorted(thing.size), atol=1e-6)


def test_without_the_bench_the_command_says_where_data_sets_are_read(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(mover.io.formats, "find_spec", lambda _: None)
    for name in names("dataset"):
        assert run_command("import", [name, str(tmp_path), "--out", str(tmp_path / "out")]) == 2
        said = capsys.readouterr().err
        assert f"{name}: is read by mover_bench, which is not part of the installed package" in said
