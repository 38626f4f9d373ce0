"""Steps and platforms are part of the floor: for feet, for who sits, for furniture, for exports."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from analytic import FACES, box_verts
from figures import ARMS_DOWN, SEATED
from test_plant_feet import shaken
from test_prepare_objects import LIGHT
from test_refine_bodies import CAMERA, GROUND, QUICK, room_with, still_people

from mover.bodies.parts import members, parts_of
from mover.bodies.posture import touching
from mover.core.run import Run
from mover.core.types import Bodies, Layout, Mesh, Proposal, Scene, SceneObject
from mover.energy.human_terms import FootContacts
from mover.evaluate.bodies import float_height, gather_gait, sink_depth
from mover.evaluate.evaluation import evaluate_people
from mover.furniture.floor import (
    CERTAIN,
    REACH,
    Floor,
    floor_of,
    height_under,
    height_under_bodies,
)
from mover.furniture.library import make_piece
from mover.geometry.boxes import box_of
from mover.geometry.camera import pitch_roll, tilted, to_camera
from mover.geometry.rotations import rot_y
from mover.io.export.solids import solids_of
from mover.stages.camera.align_camera import AlignInputs, align_camera
from mover.stages.config import ProposeConfig
from mover.stages.contacts.propose_supports import propose_supports
from mover.stages.contacts.resting import NOTHING, ProposeInputs
from mover.stages.objects.on_platforms import stood, supports_with_platforms
from mover.stages.objects.prepare_objects import (
    Prepared,
    PrepareInputs,
    prepare_objects,
    to_objects,
)
from mover.stages.people.plant_feet import plant_feet
from mover.stages.people.refine_bodies import refine_bodies

HIGH = 0.25  # [m]
COUNT = 12
LOOSE = torch.zeros(3, dtype=torch.bool)


def platform(
    size: tuple[float, float, float] = (1.6, HIGH, 1.6), at: tuple[float, float] = (0.0, -3.0)
) -> SceneObject:
    mesh = Mesh(box_verts(size).float(), FACES)
    place = torch.tensor([at[0], GROUND, at[1]])
    return SceneObject(
        "platform_0", "platform", mesh, "", None, "ground", place, torch.tensor(0.3), torch.ones(3)
    )


def floor_with(*pieces: SceneObject) -> Floor:
    floor = floor_of(Scene(CAMERA, GROUND, pieces))
    assert floor is not None
    return floor


RAISED = floor_with(platform())


def test_the_floor_is_as_high_as_each_tread_of_a_turned_step_and_level_beside_it():
    piece = next(
        made for seed in range(20)
        if len((made := make_piece("step", np.random.default_rng(seed))).mesh.verts) > 8
    )  # fmt: skip
    w, h, d = piece.size
    place, yaw, scale = (
        torch.tensor([0.7, GROUND, -2.0]),
        torch.tensor(1.1),
        torch.tensor([2.0] * 3),
    )
    thing = SceneObject("s", "step", piece.mesh, "", None, "ground", place, yaw, scale)
    rng = torch.Generator().manual_seed(0)
    own = (torch.rand(4000, 2, generator=rng) - 0.5) * torch.tensor([3 * w, 3 * d])
    x, z = own.unbind(-1)
    edge = (torch.stack([x.abs() - w, z.abs() - d, z - 0.1 * d]).abs() < d / 20).any(0)
    inside = (x.abs() < w) & (z.abs() < d)
    wanted = torch.where(inside, torch.where(z < 0.1 * d, 2 * h, h), 0.0)
    points = torch.stack([x, torch.ones_like(x), z], -1) @ rot_y(yaw).mT + place
    found = height_under(floor_with(thing), points) - GROUND
    torch.testing.assert_close(found[~edge], wanted[~edge])
    assert int((~edge & inside).sum()) > 500


def test_what_is_well_below_a_top_is_beside_the_platform():
    low = torch.tensor([0.0, GROUND, -3.0])
    rises = torch.linspace(-0.1, 0.5, 61)
    points = low + rises[:, None] * torch.tensor([0.0, 1.0, 0.0])
    wanted = torch.where(rises > HIGH - REACH - 1e-4, GROUND + HIGH, GROUND)
    torch.testing.assert_close(height_under(RAISED, points), wanted)


def test_only_a_certain_proposal_is_part_of_the_floor():
    scene = Scene(CAMERA, GROUND, ())
    above = torch.tensor([0.0, 1.0, -3.0])
    for certainty, height in ((CERTAIN - 0.01, 0.0), (CERTAIN, HIGH)):
        floor = floor_of(scene, (Proposal(platform(), "step", 0, 0, certainty, 9, 5.0),))
        assert floor is not None
        assert float(height_under(floor, above)) == pytest.approx(GROUND + height, abs=1e-6)


@pytest.mark.parametrize("posture", [ARMS_DOWN, SEATED])
def test_feet_of_shaken_people_on_a_platform_are_brought_onto_it_as_onto_the_floor(posture):
    """The same shakes on the floor and on the platform end in the same bodies, but higher."""
    low, high = (shaken(still_people(posture, COUNT, lift=up), 0.02, 0.04) for up in (0.0, HIGH))
    below = plant_feet(low, parts_of(low), Floor(GROUND))
    above = plant_feet(high, parts_of(high), RAISED)
    rise = (above.verts - below.verts)[..., 1].mean(1)
    assert float((rise - HIGH).abs().max()) < 0.01
    over = above.verts[..., 1].amin(1) - height_under_bodies(RAISED, above)
    before = high.verts[..., 1].amin(1) - height_under_bodies(RAISED, high)
    assert float(over.abs().mean()) < 0.5 * float(before.abs().mean())


def test_who_stands_on_a_platform_neither_floats_nor_sinks_in_what_is_measured():
    up, down = (still_people(ARMS_DOWN, COUNT, lift=HIGH + by) for by in (0.02, -0.03))
    plain = floor_with()
    for people, measure, wanted in ((up, float_height, 0.02), (down, sink_depth, 0.03)):
        assert measure(gather_gait(people, None, RAISED)) == pytest.approx(wanted, abs=2e-3)
    assert float_height(gather_gait(up, None, plain)) == pytest.approx(HIGH + 0.02, abs=2e-3)
    told = evaluate_people(up, RAISED, ())
    assert told["float_height"] == pytest.approx(0.02, abs=2e-3)


def sitters(lift: float) -> Bodies:
    return still_people(SEATED, COUNT, lift=lift)


def test_who_sits_on_a_platform_touches_a_seat_as_on_the_floor():
    low, high = sitters(0.0), sitters(HIGH)
    parts = parts_of(low)
    on_floor = touching(low, parts, GROUND)
    on_top = touching(high, parts, height_under_bodies(RAISED, high))
    torch.testing.assert_close(on_top, on_floor, atol=1e-3, rtol=0)
    assert float(on_floor[:, members(parts, "seat")].amax()) > 0.5


def test_a_seat_that_is_proposed_on_a_platform_stands_on_it():
    high = sitters(HIGH)
    parts = parts_of(high)
    chance = touching(high, parts, height_under_bodies(RAISED, high))
    inputs = ProposeInputs(high, parts, chance, RAISED, CAMERA, NOTHING)
    low = sitters(0.0)
    plain = ProposeInputs(low, parts, chance, floor_with(), CAMERA, NOTHING)
    (found,), (same,) = (propose_supports(x, ProposeConfig()).found for x in (inputs, plain))
    above, below = box_of(found.object), box_of(same.object)
    torch.testing.assert_close(above.size, below.size, atol=2e-3, rtol=0)
    rise = torch.tensor([0.0, HIGH, 0.0])
    torch.testing.assert_close(above.center, below.center + rise, atol=2e-3, rtol=0)


def test_soles_on_a_platform_that_is_seen_do_not_tilt_the_floor():
    rng = torch.Generator().manual_seed(3)
    world = torch.rand(60, 3, generator=rng) * torch.tensor([3.0, 0.0, 2.0])
    world = world + torch.tensor([-1.5, GROUND, -4.5])
    high = world[:, 2] > -4.0  # three quarters of them
    world[:, 1] += HIGH * high
    R = tilted(torch.tensor(-0.25), torch.tensor(0.03))
    frame = torch.arange(60)
    feet = FootContacts(to_camera(world, R), torch.zeros_like(frame), frame, ())
    camera = replace(CAMERA, R_cam_world=tilted(torch.tensor(-0.22), torch.tensor(0.0)))
    lift = torch.where(high | (frame % 5 == 0), HIGH, 0.0)  # some of the box is floor
    flat, known = (
        align_camera(AlignInputs(replace(feet, lift=it), camera, None, None)) for it in (None, lift)
    )
    assert abs(known.ground - GROUND) < 0.005
    assert abs(float(pitch_roll(known.camera.R_cam_world)[0]) + 0.25) < 0.005
    assert abs(flat.ground - GROUND) > 0.1


@pytest.mark.slow
@pytest.mark.parametrize("lift", [-0.05, 0.05])
def test_people_sunk_in_a_platform_or_floating_over_it_are_refined_onto_it(lift):
    bodies = still_people(ARMS_DOWN, 3, lift=HIGH + lift)
    room = room_with(bodies, ((1.6, HIGH, 1.6), (0.0, GROUND, -3.0)))
    step = replace(room.scene.objects[0], category="step")
    room = replace(room, scene=replace(room.scene, objects=(step,)))
    found = refine_bodies(room, None, QUICK).bodies
    assert (found.verts[..., 1].amin(1) - GROUND - HIGH).abs().max() < 0.015


def prepared_room(*places: tuple[float, float]) -> Prepared:
    """A platform at 3 m, and chairs."""
    chair = Mesh(box_verts((0.4, 0.9, 0.4)).float(), FACES)
    chairs = [
        SceneObject(
            f"chair_{k}", "chair", chair, "", None, "ground", torch.tensor([x, GROUND, z]),
            torch.tensor(0.3), torch.ones(3),
        )
        for k, (x, z) in enumerate(places)
    ]  # fmt: skip
    return prepare_objects(PrepareInputs((platform(), *chairs)), LIGHT)


def along(layout: Layout, row: int, factor: float) -> Layout:
    """One object nearer or farther on its ray, as large in the image."""
    t, size = layout.t_world_object.clone(), layout.log_scale.clone()
    t[row], size[row] = t[row] * factor, size[row] + float(np.log(factor))
    return Layout(t, layout.yaw, size)


def test_a_chair_on_a_platform_stands_on_its_top_where_its_ray_meets_it():
    """Truth: one chair on the platform, one on the floor behind it; the first scene errs by 5 %."""
    prepared = prepared_room((0.1, -3.1), (0.2, -4.2))
    true = prepared.start
    t = true.t_world_object.clone()
    t[1, 1] += HIGH
    true = Layout(t, true.yaw, true.log_scale)
    flat = along(true, 1, GROUND / float(t[1, 1]))  # as the image has it on the plane
    given = along(along(true, 1, 1.05), 2, 0.95)
    found = supports_with_platforms(prepared.objects, flat, given, GROUND)
    assert found.tolist() == [-1, 0, -1]
    objects = replace(prepared.objects, supports=found)
    layout = stood(given, objects, GROUND, LOOSE)
    torch.testing.assert_close(layout.t_world_object, true.t_world_object, atol=1e-4, rtol=0)
    torch.testing.assert_close(layout.log_scale, true.log_scale, atol=1e-4, rtol=0)
    pieces = to_objects(
        (platform(), *(replace(platform(), id=f"chair_{k}") for k in range(2))),
        replace(prepared, objects=objects), layout,
    )  # fmt: skip
    assert [piece.support for piece in pieces] == ["ground", "platform_0", "ground"]


def test_a_chair_that_would_be_inside_a_platform_stands_on_it_whatever_the_first_scene_says():
    prepared = prepared_room((0.1, -3.2))
    flat = prepared.start
    found = supports_with_platforms(prepared.objects, flat, flat, GROUND)
    assert found.tolist() == [-1, 0]


def test_a_room_without_platforms_keeps_its_supports_and_its_bits():
    prepared = prepared_room((0.1, -3.1))
    names = ("table", "chair")
    objects = replace(prepared.objects, categories=names)
    found = supports_with_platforms(objects, prepared.start, prepared.start, GROUND)
    assert torch.equal(found, objects.supports)
    points = torch.randn(50, 3, generator=torch.Generator().manual_seed(1))
    assert torch.equal(points[:, 1] - height_under(floor_with(), points), points[:, 1] - GROUND)


def test_a_platform_is_built_in_where_it_is_simulated(tmp_path: Path):
    chair = replace(platform((0.4, 0.9, 0.4)), id="chair_0", category="chair")
    chair = replace(chair, support="platform_0")
    solids = solids_of(Scene(CAMERA, GROUND, (platform(), chair)), Run(tmp_path))
    assert [solid.free for solid in solids] == [False, True]
