"""Furniture that is moved: when, where it stands then, and what files and pictures say of it."""

import json
from dataclasses import replace
from pathlib import Path

import pytest
import tiny_capture as tiny
import torch
from little_room import room

from mover.core.errors import InputError
from mover.core.records import rows_of
from mover.core.types import Masks, People, Segment
from mover.extensions.moved_furniture.stays import MoveInputs, find_moves
from mover.geometry.placement import placed_at
from mover.geometry.rle import decode, encode
from mover.io.capture.edits import edit_scene, placement_of
from mover.io.capture.folder import read_capture, write_capture
from mover.io.capture.scene_file import read_scene, write_scene

SIZE = (90, 160)
FPS = 5.0


def patch(x: int, y: int, w: int = 36, h: int = 30) -> torch.Tensor:
    mask = torch.zeros(SIZE, dtype=torch.bool)
    mask[y : y + h, x : x + w] = True
    return mask


def rows(seen: list[tuple[int, int, torch.Tensor]]) -> People:
    """Masks of (frame, object) with pixels."""
    some = [(frame, number, mask) for frame, number, mask in seen if mask.any()]
    coded = Masks(*SIZE, tuple(encode(mask) for _, _, mask in some))
    frame, number = (torch.tensor([row[k] for row in some]) for k in (0, 1))
    return People(coded, frame, number, {})


def stays(seen: list[tuple[int, int, torch.Tensor]], people: People | None = None):
    numbers = tuple(sorted({number for _, number, _ in seen}))
    found = find_moves(MoveInputs(rows(seen), people, numbers, FPS)).stays
    return [(stay.annotation, stay.first) for stay in found]


FRAMES = range(0, 60, 2)
ASIDE = rows([(f, 0, patch(0, 0, 10, 20)) for f in FRAMES])
"""A person who occludes nothing."""


def test_some_rows_of_people_keep_their_own_masks_and_known_heights():
    people = rows([(f, f % 3, patch(f, f)) for f in range(6)])
    some = rows_of(replace(people, heights={"1": 1.8}), people.frame >= 3)
    assert some.frame.tolist() == [3, 4, 5]
    assert some.heights == {"1": 1.8}
    for row, frame in enumerate((3, 4, 5)):
        assert torch.equal(decode(some.masks, row), patch(frame, frame))


def test_a_stay_lasts_only_while_it_is_seen_and_not_while_it_may_be_hidden():
    body = patch(0, 0, 160, 90)
    seen = [(f, 3, patch(20, 30) if f < 20 else patch(90, 40)) for f in FRAMES]
    seen = [(f, n, m & ~body if 14 < f < 30 else m) for f, n, m in seen]
    people = rows([(f, 0, body) for f in FRAMES if 14 < f < 30])
    found = find_moves(MoveInputs(rows(seen), people, (3,), FPS)).stays
    assert [stay.sure for stay in found] == [(0, 14), (30, 58)]


def test_an_object_that_stands_elsewhere_from_a_frame_on_has_two_stays():
    seen = [(f, 3, patch(20, 30) if f < 30 else patch(90, 40)) for f in FRAMES]
    assert stays(seen) == [(3, 0), (3, 29)]
    found = find_moves(MoveInputs(rows(seen), None, (3,), FPS)).stays
    assert torch.equal(found[1].mask, patch(90, 40)[1::3, 1::3])


def test_an_object_that_is_carried_stands_before_and_after_it():
    seen = [
        (f, 3, patch(20, 30) if f < 20 else patch(90, 40) if f > 28 else patch(8 * f - 140, 35))
        for f in FRAMES
    ]
    (_, first), (_, second) = stays(seen)
    assert first == 0
    assert second == pytest.approx(24, abs=2)


@pytest.mark.parametrize("amount", [1, 2])
def test_what_stands_still_never_moves_however_its_outline_trembles(amount: int):
    draw = torch.Generator().manual_seed(amount)
    shift = torch.randint(-amount, amount + 1, (60, 2), generator=draw)
    seen = [(f, 1, patch(40 + int(shift[f, 0]), 30 + int(shift[f, 1]))) for f in FRAMES]
    seen = [(f, n, torch.zeros_like(m) if f == 20 else m) for f, n, m in seen]
    assert stays(seen) == []
    assert stays(seen, ASIDE) == []


def test_people_before_an_object_do_not_move_it():
    body = patch(40, 0, 30, 90)
    seen = [(f, 1, patch(30, 30) & ~(body if 20 < f < 44 else ~body & body)) for f in FRAMES]
    people = rows([(f, 0, body) for f in FRAMES if 20 < f < 44])
    assert stays(seen, people) == []


@pytest.mark.parametrize(("chair", "bed", "people"), [
    ((patch(20, 40, 30, 30), patch(70, 40, 30, 30)), patch(15, 30, 90, 45), (None, ASIDE)),
    ((patch(118, 40, 36, 48), patch(60, 20, 36, 68)), patch(15, 25, 80, 45), (ASIDE,)),
], ids=["hides and uncovers", "comes before it, which looks smaller"])  # fmt: skip
def test_what_a_moved_object_hides_stands_still(chair, bed, people):
    seen = [(f, 1, bed & ~chair[f >= 30]) for f in FRAMES]
    seen += [(f, 2, chair[f >= 30]) for f in FRAMES]
    assert [stays(seen, some) for some in people] == [[(2, 0), (2, 29)]] * len(people)


def pushed(share: float) -> torch.Tensor:
    """What goes straight away from the camera: what is seen of it later lies inside of it."""
    return patch(40 + round(6 * share), 30 + round(2 * share), 48 - round(16 * share),
                 42 - round(14 * share))  # fmt: skip


@pytest.mark.parametrize("frames", [1, 8])
def test_what_is_pushed_straight_away_or_towards_the_camera_moves(frames: int):
    share = {f: min(max(f - 24, 0) / frames, 1.0) for f in FRAMES}
    away = [(f, 3, pushed(share[f])) for f in FRAMES]
    towards = [(f, 3, pushed(1 - share[f])) for f in FRAMES]
    for seen in (away, towards):
        (_, first), (_, second) = stays(seen, ASIDE)
        assert first == 0
        assert 24 <= second <= 24 + frames
        assert stays(seen) == []  # a person without a mask may be before it


def test_a_glance_of_a_wrong_mask_is_no_move():
    seen = [(f, 1, patch(90, 40) if f == 30 else patch(20, 30)) for f in FRAMES]
    assert stays(seen) == []


def moved_room():
    scene = room()
    chair = scene.objects[0]
    later = Segment(12, torch.tensor([0.0, -1.5, -2.5]), torch.tensor(1.0), 4)
    segments = (Segment(0, chair.t_world_object, chair.yaw), later)
    pieces = (replace(chair, segments=segments), *scene.objects[1:])
    return replace(scene, objects=tuple(replace(piece, annotation=None) for piece in pieces))


def test_an_object_stands_in_its_last_segment_that_has_started():
    chair, sofa = moved_room().objects[:2]
    assert torch.equal(placed_at(chair, 11).t_world_object, chair.t_world_object)
    assert placed_at(chair, 12).t_world_object.tolist() == [0.0, -1.5, -2.5]
    assert float(placed_at(chair, 400).yaw) == 1.0
    assert placed_at(sofa, 400) is sofa


def test_scenes_keep_segments_and_those_without_are_written_as_ever(tmp_path: Path):
    write_scene(moved_room(), tmp_path / "scene.json")
    again = read_scene(tmp_path / "scene.json")
    assert [len(piece.segments) for piece in again.objects] == [2, 0, 0]
    assert placed_at(again.objects[0], 12).t_world_object.tolist() == [0.0, -1.5, -2.5]
    assert [segment.mover for segment in again.objects[0].segments] == [None, 4]
    tree = json.loads((tmp_path / "scene.json").read_text())
    assert ["segments" in row for row in tree["objects"]] == [True, False, False]
    tree["objects"][0]["segments"][1]["frame"] = 0
    (tmp_path / "scene.json").write_text(json.dumps(tree))
    with pytest.raises(InputError, match=r"segments\[1\].frame' has 0, expected a frame after 0"):
        read_scene(tmp_path / "scene.json")


def test_a_turned_world_turns_the_segments(tmp_path: Path):
    write_scene(moved_room(), tmp_path / "scene.json")
    tree = json.loads((tmp_path / "scene.json").read_text())
    R = torch.tensor(tree["camera"]["R_cam_world"]).double()
    quarter = torch.tensor([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]).double()
    tree["camera"]["R_cam_world"] = (R @ quarter).tolist()
    (tmp_path / "scene.json").write_text(json.dumps(tree))
    chair = read_scene(tmp_path / "scene.json").objects[0]
    turned = quarter.float() @ torch.tensor([0.0, -1.5, -2.5])
    assert placed_at(chair, 12).t_world_object.tolist() == pytest.approx(turned.tolist(), abs=1e-5)


def test_who_puts_an_object_elsewhere_puts_it_there_for_the_whole_video():
    scene = moved_room()
    edited = edit_scene(scene, [placement_of(replace(scene.objects[1], id="chair_0"), scene)])
    assert edited.objects[0].segments == ()


def furniture(track: int = 0) -> dict[str, object]:
    """Masks of one object in two frames, as COCO has them."""
    size = {"width": tiny.WIDTH, "height": tiny.HEIGHT}
    code = tiny.compressed(tiny.runs(tiny.object_mask(0)))
    mask = {"size": [tiny.HEIGHT, tiny.WIDTH], "counts": code}
    images = [{"id": frame, **size} for frame in (0, 3)]
    same = {"track_id": track, "segmentation": mask}
    return {
        "images": images,
        "annotations": [{"id": i, "image_id": row["id"], **same} for i, row in enumerate(images)],
    }


def test_a_capture_may_have_the_objects_masks_in_its_frames(folder: Path, tmp_path: Path):
    number = tiny.objects()["annotations"][0]["id"]
    (folder / "furniture.json").write_text(json.dumps(furniture(number)))
    capture = read_capture(folder)
    assert capture.furniture.frame.tolist() == [0, 3]
    assert capture.furniture.person.tolist() == [number, number]
    assert (decode(capture.furniture.masks, 1).numpy() == tiny.object_mask(0)).all()
    write_capture(capture, tmp_path / "again")
    again = read_capture(tmp_path / "again").furniture
    assert again.masks.counts == capture.furniture.masks.counts
    (folder / "furniture.json").write_text(json.dumps(furniture(999)))
    with pytest.raises(InputError, match=r"furniture.json.*track_id' has 999, expected the id"):
        read_capture(folder)


def test_furniture_without_masks_is_reported(folder: Path):
    (folder / "furniture.json").write_text('{"images": [], "annotations": []}')
    capture = read_capture(folder)
    assert capture.furniture is None
    assert any("furniture.json: there are no masks of objects" in w for w in capture.warnings)
