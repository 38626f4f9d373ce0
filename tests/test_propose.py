"""Supports that no detector saw are found where people rest on nothing, and nowhere else."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from figures import ARMS_DOWN, SEATED, STRIDE, moving, people, pose, turned
from little_room import GROUND, camera, room
from test_pipeline import light

from mover.bodies.parts import members, parts_of
from mover.bodies.posture import touching
from mover.core.records import fingerprint
from mover.core.run import Run
from mover.core.types import Bodies, Proposal, Room, Segment
from mover.extensions import reconstruct
from mover.extensions.missing_seats import (
    KnownTops,
    Resting,
    proposed,
    with_missing_seats,
    write_proposals,
)
from mover.furniture.library import make_piece
from mover.geometry.boxes import box_of
from mover.geometry.placement import place_object
from mover.geometry.rotations import rot_y
from mover.io.capture.scene_file import read_scene
from mover.stages.masks import small_camera
from mover_bench.experiment.job import noisy_room
from mover_bench.rooms.config import SETS

COUNT = 12  # frames: 2.4 s
LYING = turned(pose(ARMS_DOWN, COUNT), -torch.pi / 2, 0.0, 0.0)
TURN = 0.7  # [rad]


def somewhere(bodies: Bodies, yaw: float = TURN, lift: float = 0.0) -> Bodies:
    """The same people, turned about up and 3 m before the camera, on a floor 1.5 m below it."""
    there = torch.tensor([0.4, GROUND + lift, -3.0])
    return replace(bodies, verts=bodies.verts @ rot_y(torch.tensor(yaw)).mT + there)


SMALL = small_camera(camera())
NO_PIXELS = torch.zeros(0, 1, 1, dtype=torch.bool)
NOTHING = KnownTops(torch.zeros(0, 1, 3), NO_PIXELS, NO_PIXELS[:, 0, 0], SMALL)


def missing(bodies: Bodies, known: KnownTops = NOTHING) -> list[Proposal]:
    parts = parts_of(bodies)
    resting = Resting(bodies, parts, touching(bodies, parts, GROUND) > 0.5, GROUND)
    return proposed(resting, known, {"proposed_chair_0"})


def sitters(count: int = COUNT) -> Bodies:
    return somewhere(people(pose(SEATED, count), fps=5.0))


def seat_of(bodies: Bodies) -> torch.Tensor:
    """Middle and height of what the sitters touch [m]."""
    parts = parts_of(bodies)
    part = members(parts, "seat", "left_thigh", "right_thigh")
    sure = (touching(bodies, parts, GROUND)[0] > 0.5) & part
    points = bodies.verts[0, sure]
    middle = points.mean(0)
    middle[1] = points[:, 1].quantile(0.2)
    return middle


def top(x: float, y: float, z: float) -> torch.Tensor:
    spots = torch.cartesian_prod(torch.linspace(-0.2, 0.2, 5), torch.linspace(-0.2, 0.2, 5))
    return torch.stack([spots[:, 0] + x, torch.full((25,), y), spots[:, 1] + z], -1)[None]


def tops_at(points: torch.Tensor, *, seat: bool = True, seen: bool = False) -> KnownTops:
    masks = torch.full((1, 360, 640), seen)
    return KnownTops(points, masks, torch.tensor([seat]), SMALL)


def test_a_sitter_on_nothing_proposes_a_seat_below_as_high_as_what_touches():
    bodies = sitters()
    (found,) = missing(bodies)
    piece = make_piece(found.piece, np.random.default_rng(found.seed), 0)
    middle = seat_of(bodies)
    assert found.proposed.category == "stool"
    assert found.proposed.id == "proposed_stool_0"
    height = piece.seat_height * float(found.proposed.scale[1])
    assert height == pytest.approx(float(middle[1]) - GROUND, abs=0.01)
    front = torch.stack([found.proposed.yaw.sin(), torch.zeros(()), found.proposed.yaw.cos()])
    away = found.proposed.t_world_object - (middle - 0.1 * front)
    assert away[[0, 2]].abs().max() < 0.01
    assert float(place_object(found.proposed).verts[:, 1].min()) == pytest.approx(GROUND, abs=1e-5)
    assert float(found.proposed.yaw) == pytest.approx(TURN, abs=0.05)
    assert (found.bodies, found.seconds) == (COUNT, pytest.approx(COUNT / 5))
    assert 0.6 < found.certainty < 1


def test_a_leaning_person_has_a_chair_and_a_lying_one_a_bed_with_the_feet_to_its_front():
    back = {**SEATED, "left_hip": (-1.2, 0, 0), "right_hip": (-1.2, 0, 0)}
    leaning = turned(pose(back, COUNT), -0.35, 0.0, 0.0)
    (chair,) = missing(somewhere(people(leaning, fps=5.0)))
    assert chair.proposed.category == "chair"
    assert chair.proposed.id == "proposed_chair_1"  # the first is taken
    lying = somewhere(people(LYING, fps=5.0, floor=0.45))
    (bed,) = missing(lying)
    assert bed.proposed.category == "bed"
    flat = (lying.verts[0] - bed.proposed.t_world_object) @ rot_y(bed.proposed.yaw)
    soles = members(parts_of(lying), "left_sole", "right_sole")
    assert flat[soles, 2].mean() > 0.5
    assert flat[:, [0, 2]].abs().amax(0)[1] < box_of(bed.proposed).size[2] / 2 + 0.1


def on_a_sofa(yaw: float = TURN) -> Bodies:
    """One person lies, and another sits across at the feet, on a seat .45 m high."""
    lying = somewhere(people(LYING, fps=5.0, floor=0.45), yaw)
    middle = lying.verts[0].mean(0)
    feet = torch.stack([torch.tensor(yaw).sin(), torch.zeros(()), torch.tensor(yaw).cos()])
    sitting = somewhere(people(pose(SEATED, COUNT), fps=5.0), yaw + torch.pi / 2)
    there = middle + 0.7 * feet - sitting.verts[0, members(parts_of(sitting), "seat")].mean(0)
    sitting = sitting.verts + there * torch.tensor([1.0, 0.0, 1.0])
    return replace(
        lying, verts=torch.cat([lying.verts, sitting]), frame=torch.arange(2 * COUNT),
        person=torch.zeros(2 * COUNT, dtype=torch.long), pose=None, joints=None,
    )  # fmt: skip


def test_a_person_seated_across_to_a_lying_one_is_on_a_sofa_as_long_as_both():
    bodies = on_a_sofa()
    (sofa,) = missing(bodies)
    assert sofa.proposed.category == "sofa"
    assert sofa.bodies > 1.5 * COUNT
    assert float(sofa.proposed.yaw) == pytest.approx(TURN + torch.pi / 2, abs=0.1)
    flat = (bodies.verts - sofa.proposed.t_world_object) @ rot_y(sofa.proposed.yaw)
    lying, half = flat[:COUNT, :, 0], box_of(sofa.proposed).size[0] / 2
    assert lying.abs().max() < half
    assert lying.abs().max() > half - 0.45


@pytest.mark.parametrize("bodies", [
    somewhere(people(pose(ARMS_DOWN, COUNT), fps=5.0)),
    somewhere(moving(people(pose(STRIDE, COUNT), fps=5.0), 0.0, 0.0, 0.2)),
    somewhere(people(LYING, fps=5.0)),
    sitters(count=4),
], ids=["stands", "walks", "lies on the floor", "hardly sits"])  # fmt: skip
def test_nothing_is_proposed_for_who(bodies: Bodies):
    assert missing(bodies) == []


def test_a_known_seat_below_or_one_that_is_seen_there_and_near_needs_no_proposal():
    bodies = sitters()
    x, y, z = seat_of(bodies).tolist()
    assert missing(bodies, tops_at(top(x, y, z))) == []
    assert missing(bodies, tops_at(top(x, y, z), seat=False)) == []
    assert missing(bodies, tops_at(top(x, y, z - 0.8), seen=True)) == []
    assert len(missing(bodies, tops_at(top(x, y, z - 0.8)))) == 1
    assert len(missing(bodies, tops_at(top(x, y, z - 0.8), seat=False, seen=True))) == 1
    assert len(missing(bodies, tops_at(top(x, y, z - 1.6), seen=True))) == 1
    assert len(missing(bodies, tops_at(top(x, y + 0.35, z), seat=False))) == 1


def test_two_people_on_two_seats_propose_two_and_two_visits_one():
    one = sitters()
    aside = replace(one, verts=one.verts + torch.tensor([1.2, 0.0, 0.0]), person=one.person + 1)
    both = replace(
        one, verts=torch.cat([one.verts, aside.verts]), frame=torch.cat([one.frame, aside.frame]),
        person=torch.cat([one.person, aside.person]), pose=None,
    )  # fmt: skip
    assert [p.proposed.id for p in missing(both)] == ["proposed_stool_0", "proposed_stool_1"]
    again = replace(both, verts=torch.cat([one.verts, one.verts]), frame=torch.arange(2 * COUNT))
    (found,) = missing(replace(again, person=torch.zeros(2 * COUNT, dtype=torch.long)))
    assert found.bodies == 2 * COUNT


def result(found: tuple[Proposal, ...]) -> Room:
    scene = room()
    return Room(
        scene=scene, initial=scene, image_only=scene, bodies=None, kept=None, proxies=(),
        evidence=(), covariance=None, traces={}, warnings=(), proposals=found,
    )  # fmt: skip


def test_proposals_are_a_file_of_their_own_that_goes_with_them(tmp_path: Path):
    (found,), path = missing(sitters()), tmp_path / "proposed.json"
    write_proposals(result((found,)), path)
    (same,) = read_scene(path).objects
    assert same.id == "proposed_stool_0"
    assert box_of(same).center.tolist() == pytest.approx(
        box_of(found.proposed).center.tolist(), abs=1e-4
    )
    write_proposals(result(()), path)
    assert not path.exists()


@pytest.mark.slow
def test_what_a_run_proposes_changes_nothing_else_of_its_room(tmp_path: Path):
    capture = noisy_room(103, replace(SETS["mini"], withheld="seat")).capture
    run, config = Run(tmp_path), light("robust")
    without = replace(config, propose_seats=False)
    with_it, bare = (reconstruct(capture, one, run) for one in (config, without))
    assert [one.piece for one in with_it.proposals] != []
    assert bare.proposals == ()
    said = tuple(line for line in with_it.warnings if "is proposed there" not in line)
    assert fingerprint(replace(with_it, proposals=(), warnings=said)) == fingerprint(bare)
    seat = with_it.proposals[0].proposed
    first, *others = bare.scene.objects
    stays = tuple(Segment(n, p.t_world_object, p.yaw) for n, p in ((0, first), (9, seat)))
    scene = replace(bare.scene, objects=(replace(first, segments=stays), *others))
    moved = with_missing_seats(replace(bare, scene=scene), capture, config, run)
    assert seat.id not in [one.proposed.id for one in moved.proposals]
