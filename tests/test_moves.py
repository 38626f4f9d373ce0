"""Furniture that is moved: when, where it stands then, who moves it, and what files say of it."""

import json
import math
from dataclasses import replace
from pathlib import Path

import pytest
import tiny_capture as tiny
import torch
from judged import grid_body
from little_room import GROUND, box, camera, piece, room

from mover.bodies.parts import LANDMARKS, BodyParts
from mover.core.errors import InputError
from mover.core.records import rows_of
from mover.core.types import Bodies, Masks, People, Scene, SceneObject, Segment
from mover.evaluate.bodies import StandingMesh, nearness
from mover.extensions.moved_furniture import stays as movers
from mover.geometry.placement import changes, mover_at, placed_at, standing_meshes
from mover.geometry.rle import decode, encode
from mover.geometry.rotations import rot_y, wrap
from mover.io.capture.edits import edit_scene, placement_of
from mover.io.capture.folder import read_capture, write_capture
from mover.io.capture.scene_file import read_scene, write_scene
from mover_bench.experiment.job import measure_moves

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
    found = movers.find_moves(movers.MoveInputs(rows(seen), people, numbers, FPS)).stays
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
    found = movers.find_moves(movers.MoveInputs(rows(seen), people, (3,), FPS)).stays
    assert [stay.sure for stay in found] == [(0, 14), (30, 58)]


def test_an_object_that_stands_elsewhere_from_a_frame_on_has_two_stays():
    seen = [(f, 3, patch(20, 30) if f < 30 else patch(90, 40)) for f in FRAMES]
    assert stays(seen) == [(3, 0), (3, 29)]
    found = movers.find_moves(movers.MoveInputs(rows(seen), None, (3,), FPS)).stays
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


BEGIN, END, COUNT = 10, 22, 40  # frames in which something moves, and of the video
FIGURES = {
    "stands": {
        "hip": (0.1, 0.9, 0.0), "knee": (0.1, 0.5, 0.0), "ankle": (0.1, 0.1, 0.0),
        "shoulder": (0.2, 1.4, 0.0), "elbow": (0.25, 1.1, 0.1), "wrist": (0.2, 0.95, 0.45),
        "neck": (0.0, 1.5, 0.0),
    },
    "sits": {
        "hip": (0.1, 0.5, 0.0), "knee": (0.1, 0.5, 0.42), "ankle": (0.1, 0.1, 0.42),
        "shoulder": (0.2, 1.0, 0.0), "elbow": (0.25, 0.8, 0.0), "wrist": (0.15, 0.6, 0.25),
        "neck": (0.0, 1.1, 0.0),
    },
}  # fmt: skip
"""Landmarks of the left side (+x), facing +z [m]."""


def figure(name: str) -> torch.Tensor:
    rows = []
    for landmark in LANDMARKS:
        side, _, joint = landmark.rpartition("_")
        x, y, z = FIGURES[name][joint]
        rows.append((-x if side == "right" else x, y, z))
    return torch.tensor(rows)


def share() -> torch.Tensor:
    """0 before anything moves, 1 after it."""
    return ((torch.arange(COUNT) - BEGIN) / (END - BEGIN)).clamp(0, 1)


def someone(name: str, way: torch.Tensor, person: int = 0, jitter: float = 0.0) -> Bodies:
    """A figure along a way of (x, z, heading) rows."""
    turned = figure(name) @ rot_y(way[:, 2]).mT
    joints = (
        turned + torch.stack([way[:, 0], torch.full((len(way),), GROUND), way[:, 1]], 1)[:, None]
    )
    draw = torch.Generator().manual_seed(3)
    joints = joints + jitter * torch.randn(len(way), 1, 3, generator=draw)
    frame = torch.arange(len(way))
    return Bodies(
        joints, torch.tensor([[0, 1, 2]]), joints, LANDMARKS, frame,
        torch.full_like(frame, person), FPS, "world", None,
    )  # fmt: skip


def straight(turn: float) -> torch.Tensor:
    """From (0, -3) by .8 m to the right, .3 m ahead, with a turn [rad]."""
    s = share()[:, None]
    return torch.tensor([0.0, -3.0, 0.2]) + s * torch.tensor([0.8, 0.3, turn])


def carried(way: torch.Tensor, off: tuple[float, float]) -> list[SceneObject]:
    """A chair that keeps its place, `off` (left, ahead), before or below a figure."""
    places = []
    for x, z, heading in way.tolist():
        at = rot_y(torch.tensor(heading)) @ torch.tensor([off[0], 0.0, off[1]])
        spot = (x + float(at[0]), z + float(at[2]))
        places.append(piece("chair_0", box(0.5, 0.9, 0.5), spot, heading + 0.4, GROUND))
    return places


def followed(places: list[SceneObject], bodies: Bodies) -> movers.Followed | None:
    unknown = torch.full((bodies.verts.shape[1],), -1)
    parts = BodyParts(unknown, torch.zeros(0, 1, dtype=torch.long))
    between = movers.Between(places[0], places[-1], BEGIN + 2, END - 2)
    return movers.follow_mover(between, bodies, parts, GROUND)


@pytest.mark.parametrize(("name", "off", "hold"), [
    ("stands", (0.05, 0.6), "hands"), ("sits", (0.0, 0.05), "seat"),
])  # fmt: skip
@pytest.mark.parametrize("turn", [0.0, 0.9])
def test_what_a_person_moves_is_before_the_hands_or_below_the_seat_in_each_frame(
    name: str, off: tuple[float, float], hold: str, turn: float
):
    way = straight(turn)
    places = carried(way, off)
    found = followed(places, someone(name, way))
    assert (found.person, found.hold) == (0, hold)
    assert found.segments[0].frame == pytest.approx(BEGIN, abs=1)
    assert found.segments[-1].frame == pytest.approx(END, abs=1)
    assert found.segments[-1].mover is None
    for segment in found.segments:  # it starts abruptly, which is smoothed
        true = places[segment.frame]
        assert (segment.t_world_object - true.t_world_object).norm() < 0.03
        assert float(wrap(segment.yaw - true.yaw).abs()) < 0.03
    assert {segment.mover for segment in found.segments[:-1]} == {0}
    frames = [segment.frame for segment in found.segments]
    assert frames == list(range(frames[0], frames[-1] + 1))


def test_bodies_that_tremble_and_places_that_are_off_meet_both_ends():
    way = straight(0.5)
    places = carried(way, (0.0, 0.6))
    off = torch.tensor([0.06, 0.0, -0.04])
    places[-1] = replace(places[-1], t_world_object=places[-1].t_world_object + off)
    found = followed(places, someone("stands", way, jitter=0.015))
    steps = torch.stack([places[0].t_world_object, *(s.t_world_object for s in found.segments)])
    assert steps.diff(dim=0).norm(dim=-1).max() < 0.16  # 7 cm a frame in truth
    assert torch.equal(found.segments[-1].t_world_object, places[-1].t_world_object)


def test_who_walks_past_or_stands_by_moves_nothing():
    places = carried(straight(0.3), (0.0, 0.6))
    past = torch.tensor([0.0, -2.2, -1.57]).repeat(COUNT, 1)
    past[:, 0] = torch.linspace(2, -2, COUNT)  # the other way
    assert followed(places, someone("stands", past)) is None
    assert followed(places, someone("stands", straight(0.3)[:1].expand(COUNT, 3))) is None


def test_who_moves_it_is_found_among_several():
    way = straight(0.4)
    places = carried(way, (0.0, 0.6))
    idle = someone("stands", way[:1].expand(COUNT, 3), 0)
    busy = someone("stands", way, 4)
    joints = torch.cat([idle.verts, busy.verts])
    both = replace(
        idle, verts=joints, joints=joints, frame=torch.cat([idle.frame, busy.frame]),
        person=torch.cat([idle.person, busy.person]),
    )  # fmt: skip
    found = followed(places, both)
    assert found.person == 4


def test_a_symmetric_piece_that_is_found_half_a_turn_round_does_not_spin():
    way = straight(0.0)
    places = carried(way, (0.0, 0.6))
    places[-1] = replace(places[-1], yaw=places[-1].yaw + math.pi)
    found = followed(places, someone("stands", way))
    yaws = torch.stack([segment.yaw for segment in found.segments])
    turns = wrap(yaws.diff()).abs()
    assert int((turns > 0.05).sum()) == 1  # it changes once, as the same object the other way round


def pushed_chair() -> SceneObject:
    chair = piece("chair_0", box(0.5, 0.9, 0.5), (0.0, 0.0), 0.0, 0.0)
    held = tuple(
        Segment(frame, torch.tensor([0.1 * (frame - 9), 0.0, 0.0]), torch.tensor(0.0), 2)
        for frame in range(10, 14)
    )
    last = Segment(14, torch.tensor([0.5, 0.0, 0.0]), torch.tensor(0.0))
    return replace(chair, segments=(Segment(0, chair.t_world_object, chair.yaw), *held, last))


def test_moves_begin_and_end_once_however_many_frames_they_take():
    chair = pushed_chair()
    assert changes(chair) == [10, 14]
    movers = [mover_at(chair, frame) for frame in (0, 9, 10, 13, 14, 99)]
    assert movers == [None, None, 2, 2, None, None]
    jumps = replace(chair, segments=(chair.segments[0], chair.segments[-1]))
    assert changes(jumps) == [14]


def of_one(chair: SceneObject) -> Scene:
    return Scene(camera(), GROUND, (chair,))


def test_moves_are_measured_in_stays_and_on_the_way():
    chair = pushed_chair()
    truth, (first, *_, last) = of_one(chair), chair.segments
    found = measure_moves(truth, truth, FPS)["objects"][0]
    assert found == {"id": "chair_0", "iou3d": pytest.approx([1.0, 1.0]), "late": [0.0, 0.0],
                     "on_the_way": pytest.approx(1.0)}  # fmt: skip
    jump = replace(chair, segments=(first, replace(last, frame=12)))
    found = measure_moves(truth, of_one(jump), FPS)["objects"][0]
    assert found["late"] == [pytest.approx(0.4), pytest.approx(0.4)]
    assert found["on_the_way"] < 0.8
    still = replace(chair, segments=())
    assert measure_moves(of_one(still), truth)["false"] == 1


def test_bodies_are_measured_against_furniture_where_it_stands_in_their_frames():
    chair = pushed_chair()
    inside = grid_body(0.3, 0.7).expand(4, -1, -1)  # about x = 0, where the chair stands at first
    frame = torch.tensor([0, 9, 13, 14])
    near = nearness(inside, frame, standing_meshes(chair), 0.05)
    deep = (near.signed < 0).double().mean(-1)
    assert deep[0] == deep[1] == 1
    assert deep[2:].tolist() == [pytest.approx(0.2), 0]  # .4 and .5 m aside, of a .5 m wide chair
    alone = standing_meshes(replace(placed_at(chair, 13), segments=()))[0].mesh
    direct = nearness(inside[2:3], frame[2:3], [StandingMesh(alone)], 0.05)
    assert torch.equal(near.signed[2], direct.signed[0])
