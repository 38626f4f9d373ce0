"""Tables that no detector saw are found where people lean on their hands, and nowhere else."""

from dataclasses import replace

import pytest
import torch
from figures import ARMS_DOWN, LEANING, SEATED, moving, people, pose
from little_room import GROUND, camera
from test_propose import COUNT, TURN, proposed, somewhere, top, tops_at

from mover.bodies.parts import members, parts_of
from mover.bodies.posture import at, facing, landmarks
from mover.core.types import Bodies, Masks, People, Proposal
from mover.geometry.boxes import Box, beyond, box_of
from mover.geometry.raster import Crops, layers
from mover.geometry.rle import encode
from mover.geometry.rotations import rot_y
from mover.stages.config import GatherConfig
from mover.stages.contacts.gather_cues import GatherInputs, hidden_by_unknown
from mover.stages.contacts.resting import NOTHING

HIGH = torch.tensor([0.0, -0.2, 0.0])  # palms of who leans at 1.1 m come down to .9 m


def leaner(yaw: float = TURN, count: int = COUNT) -> Bodies:
    """Somebody leans on something .9 m high, knees through the floor, which nobody asks about."""
    bodies = somewhere(people(pose(LEANING, count), fps=5.0), yaw)
    return replace(bodies, verts=bodies.verts + HIGH)


def typist(count: int = COUNT) -> Bodies:
    return somewhere(people(pose({**SEATED, **LEANING}, count), fps=5.0))


def palms(bodies: Bodies) -> torch.Tensor:
    """Of the first body [m]."""
    return bodies.verts[0, members(parts_of(bodies), "left_palm", "right_palm")]


def front(bodies: Bodies) -> torch.Tensor:
    return facing(landmarks(bodies, parts_of(bodies)))[0]


def tables(found: tuple[Proposal, ...]) -> tuple[Proposal, ...]:
    return tuple(one for one in found if one.object.category in ("table", "desk", "cabinet"))


def test_a_sideboard_is_proposed_under_both_palms_as_high_as_they_are_before_who_leans_on_it():
    bodies = leaner()
    (found,) = proposed(bodies)
    box, points = box_of(found.object), palms(bodies)
    assert found.object.category == "cabinet"
    assert found.object.id == "proposed_cabinet_0"
    height = float(points[:, 1].quantile(0.2)) - GROUND
    assert float(box.size[1]) == pytest.approx(height, abs=0.01)
    assert bool((beyond(box, points) < 0.01).all())
    hips = at(landmarks(bodies, parts_of(bodies)), "hips")[0]
    assert bool((beyond(box, hips) > 0.05).any())
    looks = torch.stack([found.object.yaw.sin(), torch.zeros(()), found.object.yaw.cos()])
    assert float(looks @ front(bodies)) == pytest.approx(-1, abs=0.02)
    middle = (points.mean(0) - box.center) @ rot_y(box.yaw)
    assert float(middle[0]) == pytest.approx(0, abs=0.05)
    assert (found.bodies, found.seconds) == (COUNT, pytest.approx(COUNT / 5))


def test_who_sits_and_lays_the_palms_on_nothing_has_a_desk_as_high_as_desks_are():
    (desk,) = tables(proposed(typist()))
    assert desk.object.category == "desk"
    assert float(box_of(desk.object).size[1]) == pytest.approx(0.74, abs=0.03)


def both_sides() -> Bodies:
    """Two people lean on one top from its two sides."""
    one, other = leaner(), leaner(TURN + torch.pi)
    gap = palms(one).mean(0) + 0.5 * front(one) - palms(other).mean(0)
    verts = other.verts + gap * torch.tensor([1.0, 0.0, 1.0])
    return replace(
        one, verts=torch.cat([one.verts, verts]), frame=torch.arange(COUNT).repeat(2),
        person=torch.arange(2).repeat_interleave(COUNT), pose=None,
    )  # fmt: skip


def test_hands_on_two_sides_lean_on_one_table_that_ends_beyond_both():
    bodies = both_sides()
    (found,) = proposed(bodies)
    box, points = box_of(found.object), palms(bodies)
    assert bool((beyond(box, points) < 0.01).all())
    assert bool(
        (beyond(box, bodies.verts[COUNT, members(parts_of(bodies), "left_palm")]) < 0.01).all()
    )
    assert 0.6 < float(box.size[2]) < 1.0
    assert found.bodies == 2 * COUNT


FOLDED = {**ARMS_DOWN, "left_elbow": (0.0, -2.2, 0.0), "right_elbow": (0.0, 2.2, 0.0)}
HANGING = {"left_elbow": (0.0, 0.0, 0.0), "right_elbow": (0.0, 0.0, 0.0)}


@pytest.mark.parametrize(
    "bodies",
    [
        somewhere(people(pose(ARMS_DOWN, COUNT), fps=5.0)),
        somewhere(people(pose(FOLDED, COUNT), fps=5.0)),
        somewhere(people(pose({**SEATED, **FOLDED}, COUNT), fps=5.0)),
        somewhere(people(pose(SEATED, COUNT), fps=5.0)),
        somewhere(people(pose({**LEANING, **HANGING}, COUNT), fps=5.0)),
        moving(leaner(), 0.0, 0.0, 0.2),
        leaner(count=4),
        replace(leaner(), verts=leaner().verts + torch.tensor([0.0, 0.3, 0.0])),
    ],
    ids=["hang", "folded", "folded sitting", "sits", "steep", "walks", "hardly", "too high"],
)
def test_no_table_is_proposed_for_hands_that(bodies: Bodies):
    assert tables(proposed(bodies)) == ()


def test_a_known_top_below_a_known_box_around_or_an_armrest_beside_needs_no_proposal():
    bodies = leaner()
    x, y, z = palms(bodies).mean(0).tolist()
    assert proposed(bodies, tops_at(top(x, y, z), seat=False)) == ()
    size = torch.tensor([[0.8, 1.0, 0.8]])
    piano = Box(torch.tensor([[x, y - 0.45, z]]), size, torch.zeros(1))
    held = replace(NOTHING, boxes=piano, sat_on=torch.tensor([False]))
    assert proposed(bodies, held) == ()
    far = replace(held, boxes=replace(piano, center=piano.center + torch.tensor([1.2, 0, 0])))
    assert len(proposed(bodies, far)) == 1
    sitter = typist()
    armchair = Box(
        palms(sitter).mean(0)[None] - torch.tensor([[0.0, 0.3, 0.0]]), size, torch.full((1,), TURN)
    )
    arms = replace(NOTHING, boxes=armchair, sat_on=torch.tensor([True]))
    assert len(tables(proposed(sitter, arms))) == 1  # the hands are between its arms
    narrow = replace(armchair, size=torch.tensor([[0.56, 1.0, 0.8]]))
    assert tables(proposed(sitter, replace(arms, boxes=narrow))) == ()


def test_where_people_pass_or_something_is_seen_behind_there_is_no_table():
    bodies = leaner()
    (free,) = proposed(bodies)
    box = box_of(free.object)
    end = box.center + torch.tensor([0.38, 0.0, 0.0]) @ rot_y(box.yaw).mT
    walker = moving(somewhere(people(pose(ARMS_DOWN, COUNT), fps=5.0)), 0.0, 0.0, 0.02)
    there = (end - walker.verts[0].mean(0)) * torch.tensor([1.0, 0.0, 1.0])
    both = replace(
        bodies, verts=torch.cat([bodies.verts, walker.verts + there]),
        frame=torch.arange(2 * COUNT), person=torch.arange(2).repeat_interleave(COUNT), pose=None,
    )  # fmt: skip
    (passed,) = proposed(both)
    assert float(beyond(box_of(passed.object), end).max()) > -0.02
    view = torch.zeros(360, 640)
    cut = (box.center + torch.tensor([0.0, float(box.size[1]) / 2, 0.0])) @ camera().R_cam_world.mT
    column = int(400 * cut[0] / cut[2] + 320)
    view[:, :column] = 20.0  # a wall is seen all along the left of it
    known = replace(NOTHING, free=view)
    (seen,) = proposed(bodies, known)
    assert (
        float(box_of(seen.object).size[0]) < float(box.size[0]) - 0.1
        or float((box_of(seen.object).center - box.center)[0]) > 0.1
    )


def test_pixels_that_something_unknown_hides_are_those_missing_from_masks_and_not_in_known_ones():
    bodies, view = somewhere(people(pose(ARMS_DOWN, 2), fps=5.0)), camera()
    verts = bodies.verts @ view.R_cam_world.mT
    drawn = layers(verts, bodies.faces, Crops(view.K.expand(2, 3, 3), 360, 640)).front.isfinite()
    rows = drawn[0].any(1).nonzero()[:, 0]
    low, lower = (int(rows[0] + share * len(rows)) for share in (0.5, 0.75))
    masks = drawn.clone()
    masks[:, low:] = False  # a table hides the legs, and a known box their lower half
    known = torch.zeros(1, 360, 640, dtype=torch.bool)
    known[:, lower:] = True
    encoded = Masks(360, 640, tuple(encode(mask) for mask in masks))
    seen = People(encoded, torch.arange(2), torch.zeros(2, dtype=torch.long), {})
    inputs = GatherInputs(bodies, seen, known, view)
    hidden = hidden_by_unknown(inputs, GatherConfig()).isfinite()
    wanted = drawn[0].clone()
    wanted[:low] = wanted[lower:] = False
    assert not bool((hidden & ~wanted).any())
    assert float((hidden & wanted).sum() / wanted.sum()) > 0.6
