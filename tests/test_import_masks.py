"""The same masks in every layout, and parts of captures that come one after the other."""

import base64
import dataclasses
import io
import json
import math
from pathlib import Path
from typing import Any

import make_scenes as layouts
import numpy as np
import pytest
import torch
from kept_mats import mats_read_once as mats_read_once  # for every test
from PIL import Image
from test_cameras import apple_note
from test_import_scenes import camera_at, capture_of
from test_import_scenes import plain as plain  # the fixture

from mover.app.cli.imports import ImportArgs, run_import
from mover.core.errors import InputError
from mover.core.types import Capture, Masks
from mover.geometry.boxes import box_of
from mover.geometry.camera import pitch_roll, to_camera
from mover.geometry.rle import decode
from mover.io.capture.folder import read_capture
from mover.io.capture.merge import import_into
from mover.io.capture.parts import Parts
from mover.io.masks.instance_files import read_instances
from mover.io.masks.instances import Instance

DATA = Path(__file__).parents[2] / "shared" / "data"
WORDS = ["chair", "couch", "chair", "person"]
KINDS = (
    "coco_list", "coco_text", "results", "detectron2", "mover", "npz",
    "npz_logits", "labels", "files", "alpha",
)  # fmt: skip
NAMELESS = {"npz_logits", "alpha"}


def drawn() -> np.ndarray:
    """Masks with a hole, two parts, and a border pixel."""
    masks = np.zeros((4, 48, 64), dtype=bool)
    masks[0, 5:20, 3:20] = True
    masks[0, 8:12, 6:9] = False
    masks[1, 22:40, 0:10] = True
    masks[1, 44:48, 0:3] = True
    masks[2, 10:30, 40:64] = True
    masks[3, 0:9, 30:36] = True
    return masks


def drawn_of(item: Instance, height: int = 48, width: int = 64) -> np.ndarray:
    return decode(Masks(height, width, (item.mask,)), 0).numpy()


@pytest.mark.parametrize("kind", KINDS)
def test_every_layout_gives_the_same_masks(tmp_path, kind):
    masks = drawn()
    files = layouts.write_masks(tmp_path / "in", masks, WORDS)
    found = read_instances(files[kind], {}, None)
    assert found.size == (64, 48)
    got = {drawn_of(item).tobytes(): item.category for item in found.items}
    assert set(got) == {m.tobytes() for m in masks}
    words = [got[m.tobytes()] for m in masks]
    assert words == (["object"] * 4 if kind in NAMELESS else WORDS)


def test_shapes_of_labelme_are_filled_and_those_of_a_group_are_one(tmp_path):
    shapes = [
        ("chair", [[10, 10], [30, 10], [30, 25], [10, 25]], "polygon", 4),
        ("lamp", [[50, 40], [45, 30]], "rectangle", None),
        ("chair", [[40, 10], [44, 10], [44, 14], [40, 14]], "polygon", 4),
        ("chair", [[0, 30], [8, 30], [8, 34], [0, 34]], "polygon", None),
        ("floor", [[5, 5]], "point", None),
    ]
    found = read_instances(layouts.write_labelme(tmp_path / "a.json", shapes), {}, None)
    assert found.size == (64, 48)
    assert found.notes == ("a.json: shapes of points or lines passed over: 1",)
    assert [item.category for item in found.items] == ["chair", "lamp", "chair"]
    truth = np.zeros((3, 48, 64), dtype=bool)
    truth[0, 10:25, 10:30] = truth[0, 10:14, 40:44] = True
    truth[1, 30:40, 45:50] = truth[2, 30:34, 0:8] = True
    assert (np.stack([drawn_of(item) for item in found.items]) == truth).all()
    file = tmp_path / "tools.json"  # its AI tools save pixels, and round tables are circles
    layouts.write_labelme(file, [
        ("table", [[30, 20], [30, 35]], "circle", None),
        ("chair", [[60.0, 40.0], [65.0, 44.0]], "mask", 1),
        ("chair", [[0, 30], [8, 30], [8, 34], [0, 34]], "polygon", 1),
    ])  # fmt: skip
    tree, pixels = json.loads(file.read_text()), np.eye(5, 6, dtype=np.uint8)
    with io.BytesIO() as png:
        Image.fromarray(255 * pixels).save(png, "PNG")
        tree["shapes"][1]["mask"] = base64.b64encode(png.getvalue()).decode()
    file.write_text(json.dumps(tree))
    round_table, chair = (drawn_of(item) for item in read_instances(file, {}, None).items)
    y, x = np.mgrid[:48, :64] + 0.5
    assert (round_table ^ (np.hypot(x - 30, y - 20) < 15)).sum() < 12  # a polygon of 64 corners
    truth[1:] = False
    truth[1, 30:34, 0:8], truth[1, 40:45, 60:64] = True, pixels[:, :4] > 0
    assert (chair == truth[1]).all()
    tree["shapes"][1]["mask"] = "no png"
    file.write_text(json.dumps(tree))
    with pytest.raises(InputError, match=r"shapes\[1\]\.mask.* a PNG in base64"):
        read_instances(file, {}, None)
    bad = layouts.write_labelme(tmp_path / "b.json", [("chair", [[1, 1], [9, 9]], "line", None)])
    with pytest.raises(InputError, match=r"shapes\[0\]\.shape_type.*polygon, rectangle"):
        read_instances(bad, {}, None)


def test_names_of_the_user_win(tmp_path):
    files = layouts.write_masks(tmp_path / "in", drawn(), WORDS)
    names = {"0": "table", "1": "bed"}
    for kind in NAMELESS:
        found = read_instances(files[kind], names, None)
        assert [i.category for i in found.items][:2] == ["table", "bed"], kind


def test_masks_of_another_size_are_stretched_and_of_another_shape_refused(tmp_path):
    files = layouts.write_masks(tmp_path / "in", drawn(), WORDS)
    found = read_instances(files["npz"], {}, None).fitted((128, 96))
    mask = drawn_of(found.items[0], 96, 128)
    assert (mask == np.kron(drawn()[0], np.ones((2, 2), dtype=bool))).all()
    with pytest.raises(InputError, match="64 x 48"):
        read_instances(files["npz"], {}, None).fitted((128, 128))


@pytest.mark.slow
@pytest.mark.skipif(not DATA.is_dir(), reason="the shared data is not here")
def test_real_total3d_and_masks_of_its_boxes_become_one_capture(tmp_path):
    rows = json.loads((DATA / "total3d_1" / "input" / "detections.json").read_text())
    masks = np.zeros((len(rows), 530, 730), dtype=bool)
    for mask, row in zip(masks, rows, strict=True):
        x0, y0, x1, y1 = (round(v) for v in row["bbox"])
        mask[max(y0, 0) + 2 : y1 - 2, max(x0, 0) + 2 : x1 - 2] = True
    np.savez(tmp_path / "masks.npz", masks=masks[::-1])
    masks_file = tmp_path / "masks.npz"
    found = command(tmp_path, "total3d", DATA / "total3d_1", objects_masks=masks_file)
    known = {d.id: d for d in found.detections}
    assert [p.annotation for p in found.scene.objects] == list(range(18))
    for i, mask in enumerate(masks):
        assert (decode(known[i].mask, 0).numpy() == mask).all()


def of_boxes(room: layouts.Room, things: list[layouts.Thing], path: Path, **more: object) -> Path:
    """Masks that fill the boxes of things."""
    w, h = room.size
    masks = np.zeros((len(things), h, w), dtype=bool)
    for mask, thing in zip(masks, things, strict=True):
        x0, y0, x1, y1 = (round(v) for v in room.box2d(thing))
        mask[y0:y1, x0:x1] = True
    np.savez(path, masks=masks, **more)  # pyright: ignore[reportArgumentType]
    return path


def command(home: Path, kind: str, source: Path, **given: Any) -> Capture:
    """What `mover import` leaves in out/."""
    run_import(ImportArgs(kind, source, home / "out", **given))
    return read_capture(home / "out")


def files_in(folder: Path) -> dict[Path, bytes]:
    return {p: p.read_bytes() for p in folder.rglob("*") if p.is_file()}


def test_parts_come_in_any_order_and_stay(plain, tmp_path):
    """Masks first and the scene later is the same capture as the other way round."""
    words = np.array([thing.category for thing in plain.things])
    sources = {
        "total3d": layouts.write_total3d(tmp_path / "in", plain),
        "masks": of_boxes(plain, plain.things, tmp_path / "masks.npz", labels=words),
    }
    found = []
    for name, order in (("a", ("total3d", "masks")), ("b", ("masks", "total3d"))):
        for step in order:
            run_import(ImportArgs(step, sources[step], tmp_path / name))
        found.append(read_capture(tmp_path / name))
    for capture in found:
        assert all(d.mask is not None for d in capture.detections)
        assert len(capture.detections) == len(plain.things)
        used = {p.annotation: p.category for p in capture.scene.objects}
        assert {d.id: d.category for d in capture.detections} == used
    for piece, other in zip(found[0].scene.objects, found[1].scene.objects, strict=True):
        a = next(d for d in found[0].detections if d.id == piece.annotation)
        b = next(d for d in found[1].detections if d.id == other.annotation)
        assert torch.allclose(a.box, b.box)


def test_a_scene_without_annotations_finds_its_masks(plain, tmp_path):
    source = layouts.write_glb(tmp_path / "in.glb", plain)
    layouts.picture(plain.size).save(tmp_path / "photo.png")
    masks = of_boxes(plain, plain.things[::-1], tmp_path / "masks.npz")
    image = tmp_path / "photo.png"
    found = command(tmp_path, "glb", source, image=image, objects_masks=masks)
    order = [t.name for t in plain.things[::-1]]
    assert {p.id: p.annotation for p in found.scene.objects} == {n: i for i, n in enumerate(order)}


def test_a_new_tilt_keeps_box_centres_in_the_camera(plain, tmp_path):
    source = layouts.write_total3d(tmp_path / "in", plain)
    first = capture_of("total3d", source, tmp_path)
    tilted = {**camera_at(plain).value, "R_cam_world": layouts.FLIP.tolist()}
    (tmp_path / "level.json").write_text(json.dumps(tilted))
    second = command(tmp_path, "folder", tmp_path / "out", camera=tmp_path / "level.json")
    for a, b in zip(first.scene.objects, second.scene.objects, strict=True):
        before = to_camera(box_of(a).center, first.scene.camera.R_cam_world)
        after = to_camera(box_of(b).center, second.scene.camera.R_cam_world)
        assert torch.allclose(before, after, atol=1e-4)
    assert second.scene.camera.R_cam_world.tolist() == layouts.FLIP.tolist()


@pytest.mark.slow
def test_a_measured_tilt_and_height_stay_when_other_parts_come(plain, tmp_path):
    out = tmp_path / "out"
    capture_of("total3d", layouts.write_total3d(tmp_path / "in", plain), tmp_path)
    known = command(tmp_path, "folder", out, tilt=(-12.0, 3.0, 2.0), camera_height=1.3)
    tilt = known.tilt
    degrees = [math.degrees(angle) for angle in (tilt.pitch, tilt.roll, tilt.spread)]
    assert degrees == pytest.approx([-12, 3, 2], abs=1e-4)
    found = [math.degrees(float(a)) for a in pitch_roll(known.scene.camera.R_cam_world)]
    assert found == pytest.approx([-12, 3], abs=1e-4)
    later = command(
        tmp_path, "folder", out, fov=70.0, image=picture(tmp_path / "i.png", plain.size)
    )
    assert dataclasses.astuple(later.tilt) == pytest.approx(dataclasses.astuple(tilt), abs=1e-6)
    assert (known.camera_height, later.camera_height) == (1.3, 1.3)
    (tmp_path / "other.json").write_text(json.dumps(camera_at(plain).value))
    assert command(tmp_path, "folder", out, camera=tmp_path / "other.json").tilt is None


def picture(path: Path, size: tuple[int, int], exif: Any = None) -> Path:
    Image.new("RGB", size).save(path, **({} if exif is None else {"exif": exif}))
    return path


def test_a_photo_gives_its_lens_and_tilt_and_other_numbers_are_refused(tmp_path):
    exif = Image.new("RGB", (1, 1)).getexif()
    exif.get_ifd(0x8769).update({0xA405: 26, 0x927C: apple_note((-0.9397, 0.0, -0.3420))})
    masks = layouts.write_masks(tmp_path / "in", drawn(), WORDS)["coco_text"]
    photo, out = picture(tmp_path / "p.jpg", (64, 48), exif), tmp_path / "out"
    run_import(ImportArgs("masks", masks, out, image=photo))
    camera = json.loads((out / "camera.json").read_text())
    assert camera["fl_x"] == pytest.approx(80 * 26 / math.hypot(36, 24))
    assert camera["focal_spread"] == 0.05
    turn = pitch_roll(torch.tensor(camera["R_cam_world"]))
    assert [math.degrees(float(a)) for a in turn] == pytest.approx([-20, 0], abs=0.01)
    assert camera["tilt_spread"] == pytest.approx(math.radians(1))
    for wrong in ((3.0,), (90.0, 0.0), (0.0, 0.0, 0.0), (0.0, math.nan), (1.0, 2.0, 3.0, 4.0)):
        with pytest.raises(InputError, match=r"--tilt: has .* expected pitch"):
            run_import(ImportArgs("masks", masks, out, tilt=wrong))
    with pytest.raises(InputError, match="there is no lens"):
        run_import(ImportArgs("masks", masks, tmp_path / "new", tilt=(1.0, 2.0)))
    bare = picture(tmp_path / "bare.png", (64, 48))
    with pytest.raises(InputError, match=r"bare\.png: has no focal length in its EXIF"):
        run_import(ImportArgs("masks", masks, tmp_path / "new", image=bare, camera=bare))


def test_a_photo_that_is_stored_on_its_side_is_as_large_as_it_is_shown(tmp_path):
    exif = Image.new("RGB", (1, 1)).getexif()
    exif[0x0112] = 6
    photo = picture(tmp_path / "p.jpg", (48, 64), exif)
    masks = layouts.write_masks(tmp_path / "in", drawn(), WORDS)["coco_text"]
    run_import(ImportArgs("masks", masks, tmp_path / "out", image=photo, fov=60.0))
    camera = json.loads((tmp_path / "out" / "camera.json").read_text())
    with Image.open(tmp_path / "out" / "reference.png") as shown:
        assert shown.size == (camera["w"], camera["h"]) == (64, 48)


@pytest.mark.parametrize("tracks", [[4, 9], [4]])
def test_people_keep_their_tracks_and_frames(plain, tmp_path, tracks):
    """(n, 1, h, w) alone is n things; with one object id it is one thing in n frames."""
    w, h = plain.size
    stack = np.zeros((3, len(tracks), h, w), dtype=bool)
    for frame in range(3):
        stack[frame, 0, 10:50, 10 + frame : 30 + frame] = True
        stack[frame, 1:, 60:90, 40:60] = frame != 1
    np.savez(tmp_path / "people.npz", masks=stack, object_ids=np.array(tracks))
    source, masks = layouts.write_total3d(tmp_path / "in", plain), tmp_path / "people.npz"
    people = command(tmp_path, "total3d", source, people_masks=masks, fps=5.0).people
    rows = list(zip(people.frame.tolist(), people.person.tolist(), strict=True))
    every = [(frame, track) for frame in range(3) for track in tracks]
    assert rows == [row for row in every if row != (1, 9)]
    for row, (frame, person) in enumerate(rows):
        truth = stack[frame, tracks.index(person)]
        assert (decode(people.masks, row).numpy() == truth).all()


def test_masks_alone_make_a_part_and_what_is_missing_is_said(tmp_path, capsys):
    files = layouts.write_masks(tmp_path / "in", drawn(), WORDS)
    run_import(ImportArgs("masks", files["coco_text"], tmp_path / "out"))
    said = capsys.readouterr().out
    assert "wrote objects.json" in said
    for word in ("camera.json", "scene.json", "bodies.npz", "people.json", "reference.jpg"):
        assert f"still missing: {word}" in said
    assert [p.name for p in (tmp_path / "out").iterdir()] == ["objects.json"]
    with pytest.raises(InputError, match="none: there is no such folder, expected a capture"):
        run_import(ImportArgs("folder", tmp_path / "none", tmp_path / "out"))
    new, picture_of = tmp_path / "new", picture(tmp_path / "a.png", (64, 48))
    run_import(ImportArgs("folder", new, new, image=picture_of))  # a capture that is started
    assert (new / "reference.png").is_file()


@pytest.mark.parametrize("wrong", [(1,), (0, 1, 2, 3)])
def test_each_mask_that_is_inverted_is_named(wrong, tmp_path, capsys):
    masks = drawn()
    masks[list(wrong)] ^= True
    files = layouts.write_masks(tmp_path / "in", masks, ["chair", "couch"] * 2)
    picture_of = picture(tmp_path / "a.png", (64, 48))
    people = tmp_path / "people.npz"
    video = np.repeat(masks[:2], 3, axis=0).reshape(2, 3, 48, 64)
    np.savez(people, masks=video.swapaxes(0, 1), object_ids=np.array([4, 9]))
    run_import(ImportArgs("masks", files["coco_text"], tmp_path / "out", image=picture_of, fov=60.0,
                          people_masks=people))  # fmt: skip
    said = capsys.readouterr().out
    names = [f"{('chair', 'couch')[i % 2]} ({i})" for i in wrong]
    assert f"masks fill the picture to its borders, inverted? {', '.join(names)}\n" in said
    names = [f"person {(4, 9)[i]}" for i in wrong if i < 2]
    known = "people.npz: masks fill the picture to its borders, inverted?"
    assert f"{known} {', '.join(names)}\n" in said


def test_nothing_is_written_when_a_part_does_not_fit_or_there_is_none(plain, tmp_path):
    out = tmp_path / "out"
    capture_of("total3d", layouts.write_total3d(tmp_path / "in", plain), tmp_path)
    before = files_in(out)
    Image.new("RGB", (10, 10)).save(tmp_path / "small.png")
    with pytest.raises(InputError, match="10 x 10"):
        command(tmp_path, "folder", out, image=tmp_path / "small.png")
    assert files_in(out) == before
    import_into(out, Parts(name="nothing"))
    assert files_in(out) == before
