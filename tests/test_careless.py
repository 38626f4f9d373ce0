"""What careless users bring: each is read, or named with its cure in one sentence."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tiny_capture as tiny
import torch
from PIL import Image

from mover.app.cli import run_command
from mover.core.errors import InputError
from mover.core.types import Bodies, Camera, Masks
from mover.geometry.rle import decode
from mover.io.capture.camera_file import LEVEL, path_of
from mover.io.capture.folder import read_capture
from mover.io.capture.parts import UNKNOWN
from mover.io.files.fields import At
from mover.io.files.images import image_size
from mover.io.masks.instance_files import read_people, read_things

SIZE = (tiny.WIDTH, tiny.HEIGHT)
BOX = {"x1": 10.0, "y1": 8.0, "x2": 30.0, "y2": 40.0}
ROWS = {  # a chair of x 10 to 30 and y 8 to 40, or its box, as tools write it
    "ultralytics": [{"name": "chair", "class": 56, "confidence": 0.9, "box": BOX,
                     "segments": {"x": [10, 30, 30, 10], "y": [8, 8, 40, 40]}}],
    "sa1b": {"image": {"image_id": 7, "width": SIZE[0], "height": SIZE[1], "file_name": "s.jpg"},
             "annotations": [{"id": 3, "bbox": [10, 8, 20, 32], "area": 640,
                              "segmentation": [[10, 8, 30, 8, 30, 40, 10, 40]]}]},
}  # fmt: skip


@pytest.mark.parametrize("tool", ROWS)
def test_rows_of_other_tools_are_read(tool: str, tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text(json.dumps(ROWS[tool]))
    (found,) = read_things(tmp_path / "a.json", {}, SIZE).items
    mask = decode(Masks(*SIZE[::-1], (found.mask,)), 0)
    assert mask[8:40, 10:30].all()
    assert mask.sum() == 20 * 32
    assert found.box == pytest.approx((10, 8, 30, 40))
    assert found.category == ("chair" if tool == "ultralytics" else UNKNOWN)


def photo(path: Path) -> None:
    noise = np.random.default_rng(0).integers(60, 180, (*SIZE[::-1], 3), dtype=np.uint8)
    Image.fromarray(noise).save(path)


HEIC = b"\0\0\0\x18ftypheic" + b"\0" * 40
MASKS: dict[str, tuple[Any, str]] = {  # what a file or the only file of a folder holds
    "labels/a.txt": (b"0 .5 .5 .2 .3\n", "YOLO's text, expected COCO"),
    "xml/annotations.xml": (b"<annotations></annotations>", "CVAT's XML, expected 'COCO 1.0'"),
    "packed/masks.zip": (b"PK\3\4", "an archive, expected the files in it"),
    "read/me.txt": (b"masks of the room\n", "no file of masks"),
    "pano.json": ({"images": [], "annotations": [{"segments_info": []}]}, "panoptic JSON"),
    "robo.json": ({"predictions": [{"x": 5}], "image": {"width": 3}}, "Roboflow's predictions"),
    "photo.png": (photo, "values, as a photo, expected a mask"),
    "photo.jpg": (photo, "values, as a photo, expected a mask"),
    "a.png": (HEIC, "HEIC"),
    "v.png": (b"\0\0\0\x18ftypmp42", "a video: save one of its frames"),
    "studio.json": ([{"id": 1, "annotations": [{"result": []}], "data": {"image": "a"}}],
                    "Label Studio's JSON, expected its export as COCO"),
    "mini.json": ([{"image": "a.jpg", "id": 1, "tag": [], "annotation_id": 3}],
                  "Label Studio's JSON"),
    "min.json": ([{"image": "a", "id": 1, "label": [{"points": []}], "annotator": 1}],
                 "Label Studio's JSON"),
    "guess.json": ([{"data": {"image": "a"}, "predictions": []}], "Label Studio's JSON"),
    "v7.json": ({"videos": [], "annotations": []}, "expected COCO's 'images' and 'annotations'"),
    "via.json": ({"a.jpg1": {"filename": "a.jpg", "regions": []}}, "project of VIA"),
    "rows.json": ([{"image": "a.jpg", "id": 7}], r"\[0\].*bbox, segmentation or mask"),
    "cvat.xml": (b"<?xml?><annotations><version>1.1</version></annotations>", "CVAT's XML"),
    "voc.xml": (b"<annotation><object/></annotation>", "an XML of Pascal VOC"),
    "yolo.txt": (b"56 0.31 0.6 0.2 0.4", "YOLO's text"),
    "masks.zip": (b"PK", "unpack it"),
}  # fmt: skip


@pytest.mark.parametrize("name", MASKS)
def test_what_holds_no_masks_is_named(name: str, tmp_path: Path) -> None:
    content, words = MASKS[name]
    path = tmp_path / name
    path.parent.mkdir(exist_ok=True)
    if callable(content):
        content(path)
    else:
        data = content if isinstance(content, bytes) else json.dumps(content).encode()
        path.write_bytes(data)
    with pytest.raises(InputError, match=words) as caught:
        read_things(path if path.parent == tmp_path else path.parent, {}, SIZE)
    assert "expected" in str(caught.value)


def test_of_a_folder_of_labelme_files_that_of_the_picture_counts(tmp_path: Path) -> None:
    shape = {"label": "chair", "points": [[10, 8], [30, 8], [30, 40]], "shape_type": "polygon"}
    for name, label in (("other", "sofa"), ("room", "chair")):
        shapes = [{**shape, "label": label}]
        tree = {"imageWidth": SIZE[0], "imageHeight": SIZE[1], "shapes": shapes}
        (tmp_path / f"{name}.json").write_text(json.dumps(tree))
    found = read_things(tmp_path, {}, SIZE, "room.jpg")
    assert [item.category for item in found.items] == ["chair"]
    assert any("only room.json is taken" in note for note in found.notes)


def test_masks_without_names_and_files_without_people_are_said(tmp_path: Path) -> None:
    mask = np.zeros(SIZE[::-1], bool)
    mask[5:20, 5:30] = True
    np.savez(tmp_path / "m.npz", masks=mask[None], labels=np.array(["chair"]))
    with pytest.raises(InputError, match="no people, only name 'chair', expected masks of people"):
        read_people(tmp_path / "m.npz", {}, SIZE)
    np.savez(tmp_path / "n.npz", masks=mask[None])
    said = "n.npz: masks without category: 1 of 1 (--names 1=chair)"
    assert said in read_things(tmp_path / "n.npz", {}, SIZE).notes


@pytest.mark.parametrize(("data", "words"), [(HEIC, "HEIC"), (b"hello", "no picture that can be")])
def test_a_picture_that_cannot_be_opened_is_named(data: bytes, words: str, tmp_path: Path) -> None:
    (tmp_path / "a.jpg").write_bytes(data)
    with pytest.raises(InputError, match=words) as caught:
        image_size(tmp_path / "a.jpg")
    assert str(tmp_path) not in str(caught.value)


DEPTHS = [
    (3500.0, "millimetres"), (350.0, "centimetres"), (-3.5, "negate"), (0.2, "disparity/"),
    (0.0, "0 % usable"), (np.nan, "0 % usable"),
]  # fmt: skip


@pytest.mark.parametrize(("value", "words"), DEPTHS)
def test_depth_that_no_room_has_is_refused(value: float, words: str, folder: Path) -> None:
    (folder / "depth").mkdir()
    np.save(folder / "depth" / "000000.npy", np.full(SIZE[::-1], value, np.float32))
    with pytest.raises(InputError, match=f"000000.npy: .*{words}"):
        read_capture(folder)


@pytest.mark.parametrize(("one", "other"), [("scene", "objects"), ("objects", "scene")])
def test_files_in_one_anothers_place_are_named(one: str, other: str, folder: Path) -> None:
    (folder / f"{one}.json").write_bytes((folder / f"{other}.json").read_bytes())
    with pytest.raises(InputError, match=rf"{one}.json has .* \(is it {other}.json\?\)"):
        read_capture(folder)


def test_two_cameras_of_a_capture_are_said(folder: Path) -> None:
    tilted = [[1, 0, 0], [0, -0.8, 0.6], [0, -0.6, -0.8]]
    for other, words in (({"fl_x": 75.0}, "fl_x 75"), ({"R_cam_world": tilted}, "pitch -0.64 rad")):
        tiny.change(folder / "scene.json", "camera", tiny.camera(**other))
        (said,) = [text for text in read_capture(folder).warnings if "not camera.json" in text]
        assert said.startswith("scene.json: its camera counts")
        assert words in said


FLIP = np.diag([1.0, -1, -1, 1])
POSES: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "": lambda T: T,
    "from world to camera": np.linalg.inv,
    "those of OpenGL": lambda T: T @ FLIP,
    "from world to camera, in OpenGL": lambda T: FLIP @ np.linalg.inv(T),
}


@pytest.mark.parametrize("words", POSES)
def test_poses_under_which_people_move_too_much_are_named(words: str) -> None:
    n = 40
    turn = np.linspace(0, 0.6, n)
    T = np.tile(np.eye(4), (n, 1, 1))
    T[:, 0, 0] = T[:, 2, 2] = np.cos(turn)
    T[:, 0, 2], T[:, 2, 0] = np.sin(turn), -np.sin(turn)
    T[:, 0, 3], T[:, 1, 3] = np.linspace(0, 1.2, n), np.linspace(0, 0.3, n)
    place = np.stack([0.2 * np.sin(np.arange(n) / 4), np.full(n, 0.5), np.full(n, 4.0)], 1)
    seen = (np.linalg.inv(T) @ np.concatenate([place, np.ones((n, 1))], 1)[..., None])[:, :3, 0]
    verts = torch.from_numpy(seen).float()[:, None] + 0.3 * torch.eye(3)[None]
    rows = torch.arange(n)
    faces = torch.tensor([[0, 1, 2]])
    bodies = Bodies(verts, faces, None, (), rows, rows * 0, 30.0, "camera", None)
    K = torch.tensor([[500.0, 0, 320], [0, 500, 180], [0, 0, 1]])
    camera = Camera(K, LEVEL, 640, 360)
    said: list[str] = []
    at = At({"frame": rows.numpy(), "T_world_camera": POSES[words](T)}, "cameras.npz")
    path_of(at, camera, bodies, said.append)
    assert (len(said) == 1) == bool(words)
    assert all(words in text for text in said)


def test_a_capture_is_no_result_and_a_file_no_capture(folder, capsys):
    for command, words in (
        (["export", str(folder), "--to", "glb"], "is a capture, expected a result"),
        (["evaluate", str(folder), "--truth", str(folder)], "is a capture, expected a result"),
        (["check", str(folder / "scene.json")], "is a file, expected the folder of a capture"),
        (["check", str(folder.parent)], "has no camera.json, but captures: tiny"),
    ):
        assert run_command(command[0], command[1:]) == 2
        assert words in capsys.readouterr().err


def test_keypoints_of_another_size_of_the_video_are_refused(tmp_path, capsys):
    points = np.random.default_rng(0).uniform([300, 100], [1200, 700], (4, 25, 2))
    np.savez(tmp_path / "k.npz", layout=np.array("openpose25"), frame=np.arange(4),
             person=np.zeros(4, int), points=points, confidence=np.ones((4, 25)))  # fmt: skip
    (tmp_path / "c.json").write_text(json.dumps(tiny.camera()))
    args = [str(tmp_path / "k.npz"), "--camera", str(tmp_path / "c.json"), "--out", "unused.npz"]
    assert run_command("fit", args) == 2
    assert "another size of the video" in capsys.readouterr().err


def test_what_is_too_large_is_refused_at_once(folder: Path) -> None:
    rows = [{**tiny.objects()["annotations"][0], "id": k} for k in range(5_001)]
    tiny.change(folder / "objects.json", "annotations", rows)
    with pytest.raises(InputError, match="'annotations' has 5001 items, expected at most 5000"):
        read_capture(folder)
    tiny.change(folder / "camera.json", "w", 13_000)
    tiny.change(folder / "camera.json", "h", 13_000)
    with pytest.raises(InputError, match=r"13000 x 13000, expected at most .* scale image"):
        read_capture(folder)


def test_a_list_of_images_of_ultralytics_keeps_its_frames_and_tracks(tmp_path: Path) -> None:
    (row,) = ROWS["ultralytics"]
    first, second = ({**row, "name": "person", "track_id": track} for track in (4, 7))
    (tmp_path / "people.json").write_text(json.dumps([[first], [], [first, second]]))
    found = read_people(tmp_path / "people.json", {}, SIZE)
    rows = [(item.frame, item.track, item.category) for item in found.items]
    assert rows == [(0, 4, "person"), (2, 4, "person"), (2, 7, "person")]
    assert len({item.mask for item in found.items}) == 1
