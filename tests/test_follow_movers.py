"""Furniture that moves with a person: who moves it, when, and where it is meanwhile."""

import math
from dataclasses import replace

import pytest
import torch
from judged import grid_body
from little_room import GROUND, box, camera, piece

from mover.bodies.parts import LANDMARKS, BodyParts
from mover.core.types import Bodies, Scene, SceneObject, Segment
from mover.evaluate.contact import StandingMesh, nearness
from mover.extensions.moved_furniture.movers import Between, Followed, follow_mover
from mover.geometry.placement import changes, mover_at, placed_at, standing_meshes
from mover.geometry.rotations import rot_y, wrap
from mover_bench.experiment.measures import measure_moves

FPS = 5.0
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


def unknown_parts(bodies: Bodies) -> BodyParts:
    return BodyParts(torch.full((bodies.verts.shape[1],), -1), torch.zeros(0, 1, dtype=torch.long))


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


def between(places: list[SceneObject]) -> Between:
    return Between(places[0], places[-1], BEGIN + 2, END - 2)


def followed(places: list[SceneObject], bodies: Bodies) -> Followed | None:
    return follow_mover(between(places), bodies, unknown_parts(bodies), GROUND)


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


def pushed() -> SceneObject:
    chair = piece("chair_0", box(0.5, 0.9, 0.5), (0.0, 0.0), 0.0, 0.0)
    held = tuple(
        Segment(frame, torch.tensor([0.1 * (frame - 9), 0.0, 0.0]), torch.tensor(0.0), 2)
        for frame in range(10, 14)
    )
    last = Segment(14, torch.tensor([0.5, 0.0, 0.0]), torch.tensor(0.0))
    return replace(chair, segments=(Segment(0, chair.t_world_object, chair.yaw), *held, last))


def test_moves_begin_and_end_once_however_many_frames_they_take():
    chair = pushed()
    assert changes(chair) == [10, 14]
    movers = [mover_at(chair, frame) for frame in (0, 9, 10, 13, 14, 99)]
    assert movers == [None, None, 2, 2, None, None]
    jumps = replace(chair, segments=(chair.segments[0], chair.segments[-1]))
    assert changes(jumps) == [14]


def of_one(chair: SceneObject) -> Scene:
    return Scene(camera(), GROUND, (chair,))


def test_moves_are_measured_in_stays_and_on_the_way():
    truth = of_one(pushed())
    found = measure_moves(truth, truth, FPS)["objects"][0]
    assert found == {"id": "chair_0", "iou3d": pytest.approx([1.0, 1.0]), "late": [0.0, 0.0],
                     "on_the_way": pytest.approx(1.0)}  # fmt: skip
    jump = replace(
        pushed(), segments=(pushed().segments[0], replace(pushed().segments[-1], frame=12))
    )
    found = measure_moves(truth, of_one(jump), FPS)["objects"][0]
    assert found["late"] == [pytest.approx(0.4), pytest.approx(0.4)]
    assert found["on_the_way"] < 0.8
    still = replace(pushed(), segments=())
    assert measure_moves(of_one(still), truth)["false"] == 1


def test_bodies_are_measured_against_furniture_where_it_stands_in_their_frames():
    chair = pushed()
    inside = grid_body(0.3, 0.7).expand(4, -1, -1)  # about x = 0, where the chair stands at first
    frame = torch.tensor([0, 9, 13, 14])
    near = nearness(inside, frame, standing_meshes(chair), 0.05)
    deep = (near.signed < 0).double().mean(-1)
    assert deep[0] == deep[1] == 1
    assert deep[2:].tolist() == [pytest.approx(0.2), 0]  # .4 and .5 m aside, of a .5 m wide chair
    alone = standing_meshes(replace(placed_at(chair, 13), segments=()))[0].mesh
    direct = nearness(inside[2:3], frame[2:3], [StandingMesh(alone)], 0.05)
    assert torch.equal(near.signed[2], direct.signed[0])
