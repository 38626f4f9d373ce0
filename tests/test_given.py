"""What is known before anything is seen: given places, usual sizes, axes, level feet."""

import itertools
import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
import torch
from analytic import FACES, box_verts, boxes_of, given_at
from torch import Tensor

from mover.core.types import Bodies, Camera, Heading, Layout, Mesh
from mover.energy.human_terms import ContactPoints, heading_term, some_touches
from mover.energy.image_terms import LEAST, LIKELY, SEEN, UNKNOWN
from mover.energy.prior_terms import AWAY, Given, given_term
from mover.furniture.library import (
    MORE_STYLES,
    PIECES,
    SIZES,
    STANDARD,
    STYLES,
    canonical,
    make_piece,
)
from mover.geometry.camera import tilted, to_camera, to_world
from mover.geometry.mesh import box
from mover.geometry.placement import larger
from mover.geometry.topology import is_closed
from mover.stages.objects.gather_given import (
    FIRM,
    UNFIT,
    WEIGHTS,
    bounded_sides,
    gather_given,
    given_axis,
    lighter_where_used,
    prior_weights,
    room_axis,
    sizes_of_shapes,
    standard_sizes,
    unplaced,
)
from mover.stages.objects.prepare_objects import levelled
from mover.stages.objects.starts import reference_yaw
from mover.stages.people.find_depth import are_shapeless, nearer, size_spread
from mover_bench.rooms.noise import foreign_mesh

TURNS = torch.linspace(-math.pi, math.pi, 721)


def somewhere(count: int = 1) -> Layout:
    place = torch.tensor([0.3, -1.4, -4.0]).expand(count, 3)
    return Layout(place.clone(), torch.zeros(count), torch.zeros(count, 3))


def cost(given: Given, layout: Layout) -> float:
    return float(given_term(layout, given).sum())


def test_a_place_metres_away_costs_more_than_one_beside_it_but_not_without_bound() -> None:
    layout = somewhere()
    given = given_at(layout)
    away = [
        cost(given, replace(layout, t_world_object=layout.t_world_object * k))
        for k in (1.0, 1.05, 1.1, 1.3, 1.6, 2.0)
    ]
    assert away[0] == pytest.approx(0, abs=1e-6)
    assert all(b > a + 0.3 for a, b in itertools.pairwise(away))
    slopes = np.diff(away[3:]) / np.diff([1.3, 1.6, 2.0])
    assert slopes[1] < slopes[0]


def test_a_given_yaw_may_be_off_by_a_quarter_or_half_turn_rather_than_by_an_eighth() -> None:
    given = replace(given_at(somewhere()), along=torch.zeros(1), weight=torch.ones(1))
    layouts = Layout(
        somewhere().t_world_object.expand(721, 1, 3), TURNS[:, None], torch.zeros(721, 1, 3)
    )
    costs = given_term(layouts, given)[:, 0]
    eighth, quarter, half = (costs[360 + 2 * degrees] for degrees in (45, 90, 180))
    assert float(costs.argmin()) == 360
    assert float(quarter) < float(costs[360 + 2 * 60]) + 1
    assert 2 < float(half) < 4
    assert float(half) == pytest.approx(float(quarter), abs=0.3)
    assert float(eighth) < float(half)
    assert float(costs.max()) < 5


def test_furniture_along_walls_turns_to_the_axes_and_may_stand_askew() -> None:
    given = replace(
        given_at(somewhere()), axis=torch.full((1,), 0.2), sharpness=torch.full((1,), 8.0)
    )

    def at(yaw: float, along: float) -> float:
        some = replace(given, along=torch.full((1,), along), yaw=torch.full((1,), yaw))
        return cost(some, replace(somewhere(), yaw=torch.full((1,), yaw)))

    for k in range(4):
        assert at(0.2 + k * math.pi / 2, 0.9) == pytest.approx(0, abs=1e-5)
    assert at(0.2 + math.pi / 4, 0.9) > 2 * at(0.2 + math.pi / 4, 0.4) > 0
    assert at(0.2 + math.pi / 4, 0.0) == pytest.approx(0, abs=1e-6)


def test_the_axis_of_a_room_is_found_from_rough_yaws() -> None:
    generator = torch.Generator().manual_seed(3)
    true = 0.3
    quarters = torch.randint(0, 4, (8,), generator=generator) * (math.pi / 2)
    given = true + quarters + math.radians(15) * torch.randn(8, generator=generator)
    placed = true + quarters + math.radians(4) * torch.randn(8, generator=generator)
    along = torch.full((8,), 0.9)
    guess = (given, torch.full((8,), math.radians(20)), along)
    rough, wide = room_axis([guess])
    fine, narrow = room_axis([guess, (placed, torch.full((8,), math.radians(8)), along)])

    def off(angle: float) -> float:
        return abs(math.remainder(angle - true, math.pi / 2))

    assert off(rough) < math.radians(12)
    assert off(fine) < math.radians(4)
    assert narrow < wide
    nothing = room_axis([(*guess[:2], torch.zeros(8))])[1]
    assert nothing > 3 * wide


def test_walls_that_are_seen_give_the_axis_better_than_rough_yaws():
    rough = replace(somewhere(3), yaw=torch.tensor([0.45, 0.30, -0.05]))
    objects, left = boxes_of(("bed",) * 3, [(1.4, 0.5, 2.0)] * 3), torch.full((3,), 0.1)
    walls = Heading(0.1 + math.pi / 2, math.radians(0.5))
    alone = gather_given(objects, rough, rough, left)
    seen = gather_given(objects, rough, rough, left, walls)
    assert abs(math.remainder(float(alone.axis[0]) - 0.1, math.pi / 2)) > 0.1
    assert math.remainder(float(seen.axis[0]) - 0.1, math.pi / 2) == pytest.approx(0, abs=0.03)
    assert float(seen.sharpness[0]) > float(alone.sharpness[0])
    observed = [(yaw, math.radians(2), 0.9) for yaw in (0.6, 0.61, 0.59, 0.6, 0.6)]  # all disagree
    many = tuple(torch.tensor(row) for row in zip(*observed, strict=True))
    wall = tuple(torch.tensor([x]) for x in (0.1, math.radians(0.5), 0.95))
    axis = [(yaw, spread, chance) for yaw, spread, chance in (many, wall)]
    assert room_axis(axis)[0] == pytest.approx(0.6, abs=0.02)


def test_of_a_room_without_a_guess_the_axis_alone_costs():
    objects = boxes_of(("bed", "chair"), [(1.4, 0.5, 2.0), (0.5, 0.9, 0.5)])
    given = given_axis(objects.categories, Heading(0.3, math.radians(0.5)))
    straight = replace(somewhere(2), yaw=torch.full((2,), 0.3 - math.pi))
    skew = replace(straight, yaw=straight.yaw + 0.7)
    far = replace(straight, t_world_object=3 * straight.t_world_object)
    far = replace(far, log_scale=0.4 + straight.log_scale)
    along = given_term(straight, given)
    torch.testing.assert_close(along, torch.zeros(2), atol=1e-5, rtol=0)
    torch.testing.assert_close(given_term(far, given), along)
    bed, chair = given_term(skew, given).tolist()
    assert bed > 3 > chair > 1


def test_shapes_are_held_to_firm_standards_of_the_meaning_that_fits_their_size() -> None:
    kinds = ("bed", "chair", "desk", "nightstand", "aquarium", "table", "table")
    heights = torch.tensor([0.5, 0.5, 0.5, 0.5, 0.5, 0.65, 0.4])
    sizes = torch.stack([torch.full((7,), 1.4), heights, torch.full((7,), 1.15)], -1)
    standard, precision, slack = sizes_of_shapes(kinds, sizes)
    meanings = ("bed", "stool", *kinds[2:-1], "coffee table")  # COCO's words, as high as one
    known = replace(unplaced(7), standard=standard, precision=precision, slack=slack)
    at = replace(somewhere(7), log_scale=torch.zeros(7, 3))
    for i, kind in enumerate(meanings):
        for axis, usual in enumerate(STANDARD.get(kind, (None,) * 3)):
            if usual is not None and usual[1] <= FIRM:
                off = math.log(usual[0] / float(sizes[i, axis]))
                assert float(standard[i, axis]) == pytest.approx(off, abs=1e-5)
                assert float(precision[i, axis]) == pytest.approx(usual[1] ** -2, rel=1e-5)
                assert float(slack[i, axis]) == 0
                continue
            for share, limit in zip((-1, 1), SIZES.get(kind, ((0.1, 9.0),) * 3)[axis], strict=True):
                end = math.log(limit / float(sizes[i, axis])) * share
                costs = []  # at the limit of the class, or as large as the shape, and beyond
                for beyond in (0.0, 0.3):
                    scale = torch.zeros(7, 3)
                    scale[i] = standard[i]
                    scale[i, axis] = share * (max(end, 0.0) + beyond)
                    costs.append(float(given_term(replace(at, log_scale=scale), known)[i]))
                assert costs[0] == pytest.approx(0, abs=1e-3)
                assert (costs[1] > 3) == (kind in SIZES)


def test_of_what_was_not_placed_sizes_cost_as_a_student_t_and_places_nothing() -> None:
    nothing, layout = unplaced(2), somewhere(2)
    assert cost(nothing, replace(layout, yaw=layout.yaw + 1, log_scale=layout.log_scale + 1)) == 0
    size = torch.tensor([[0.0, 0.0, 0.5], [0.1, -0.2, 0.3]])
    known = replace(nothing, standard=size, precision=torch.tensor([[0.0, 0.0, 100.0]] * 2))
    for off in (-0.6, -0.1, 0.0, 0.3):
        found = replace(layout, t_world_object=3 * layout.t_world_object, log_scale=size + off)
        expected = 2 * 2 * math.log(1 + (off / 0.1) ** 2 / 3)
        assert cost(known, found) == pytest.approx(expected, abs=1e-4)


def test_standard_sizes_pull_what_they_know_and_leave_the_rest() -> None:
    sizes = [(1.2, 0.60, 0.8), (0.45, 0.95, 0.5), (1.0, 1.0, 1.0)]
    objects = boxes_of(("table", "chair", "aquarium"), sizes)
    standard, precision, _ = standard_sizes(objects)
    assert float(standard[0, 1]) == pytest.approx(math.log(0.74 / 0.60), abs=1e-5)
    assert float(standard[1].abs().max()) < 0.1
    assert float(precision[2].max()) == 0 < float(precision[0, 1])
    given = gather_given(objects, somewhere(3), somewhere(3), torch.full((3,), 0.1))
    best = minimum(lambda s: replace(somewhere(3), log_scale=s), given)
    assert 0.6 * math.log(0.74 / 0.60) < float(best[0, 1]) < math.log(0.74 / 0.60)
    assert float(best[2].abs().max()) < 1e-4


@pytest.mark.parametrize(("category", "size", "expected"), [
    ("table", (1.1, 0.43, 0.6), 0.42),  # a coffee table, which detectors call a dining table
    ("table", (1.1, 0.65, 0.6), 0.74),
    ("table", (1.1, 0.20, 0.6), None),  # neither
    ("sofa", (1.7, 1.40, 0.9), None),
    ("cabinet", (1.1, 0.8, 0.6), None),  # has no other name, and no standard height
])  # fmt: skip
def test_the_standard_of_another_class_of_the_same_name_counts_where_its_own_is_contradicted(
    category: str, size: tuple[float, float, float], expected: float | None
) -> None:
    standard, precision, _ = standard_sizes(boxes_of((category,), [size]))
    if expected is None:
        assert float(precision[0, 1]) == 0
    else:
        assert float(standard[0, 1]) == pytest.approx(math.log(expected / size[1]), abs=1e-5)
        assert float(precision[0, 1]) > 0


def minimum(layout_of: Callable[[Tensor], Layout], given: Given) -> Tensor:
    """Logarithms of sizes of least cost, by a naive descent."""
    sizes = torch.zeros(len(given.yaw), 3, requires_grad=True)
    descent = torch.optim.LBFGS([sizes], max_iter=100, line_search_fn="strong_wolfe")

    def closure() -> Tensor:
        descent.zero_grad()
        cost = given_term(layout_of(sizes), given).sum()
        cost.backward()
        return cost

    descent.step(closure)
    return sizes.detach()


def test_what_was_guessed_too_far_was_guessed_too_large() -> None:
    """A guess looks right in its picture: the same picture nearer costs only its distance."""
    layout = somewhere()
    given = replace(given_at(layout), precision=torch.zeros(1, 3))
    nearer_one = larger(layout, 0.85)
    smaller = replace(layout, log_scale=nearer_one.log_scale)
    kept = replace(nearer_one, log_scale=layout.log_scale)
    place = 2 * math.log1p((math.log(0.85) / AWAY) ** 2 / 3) * float(given.weight)
    for other in (nearer_one, kept):
        assert place < cost(given, other) < place + math.log(2) * float(given.weight)
    assert cost(given, smaller) > 3 * float(given.weight)
    usual = replace(given, standard=torch.full((1, 3), math.log(0.85)),
                    precision=torch.full((1, 3), 1 / 0.05**2))  # fmt: skip
    assert cost(usual, nearer_one) < cost(usual, layout)


def test_standards_are_those_of_the_classes_and_near_what_the_library_has() -> None:
    for category, axes in STANDARD.items():
        assert canonical(category) == category
        for known, (low, high) in zip(axes, SIZES[category], strict=True):
            assert known is None or low * 0.9 < known[0] < high * 1.1


def test_prior_weights_follow_the_misfit_within_bounds() -> None:
    objects = boxes_of(("table", "chair", "sofa"), [(1.0, 0.7, 1.0)] * 3)
    given = gather_given(objects, somewhere(3), somewhere(3), torch.tensor([1e-6, 0.15, 3.0]))
    assert given.weight.tolist() == pytest.approx([WEIGHTS[0], 1.5, WEIGHTS[1]])


def test_an_object_that_fits_among_shapes_that_do_not_has_more_prior_weight_than_alone() -> None:
    energy = torch.tensor([0.01, 0.16, 0.16, 0.12, 0.9])
    found = prior_weights(energy)
    assert float(found[0]) == pytest.approx((0.01 * 0.16) ** 0.5 / 0.1)
    assert found[[1, 2, 4]].tolist() == pytest.approx([1.6, 1.6, WEIGHTS[1]])
    assert torch.allclose(prior_weights(torch.full((3,), 0.01)), torch.full((3,), 0.1))


CUTS = {known: [[known if s == cut else SEEN for s in range(4)] for cut in range(4)]
        for known in (LEAST, LIKELY)}  # fmt: skip


@pytest.mark.parametrize(("sides", "fits"), [
    ([SEEN, LIKELY, SEEN, LIKELY], [LEAST] * 4),
    ([UNKNOWN] * 4, [UNKNOWN] * 4),
    ([SEEN] * 4, [SEEN] * 4),
    ([SEEN, LEAST, LIKELY, UNKNOWN], [LEAST, LEAST, LEAST, UNKNOWN]),
    *(
        (CUTS[known][cut], [SEEN if s == (cut + 2) % 4 else LEAST for s in range(4)])
        for cut in range(4)
        for known in (LEAST, LIKELY)
    ),
])  # fmt: skip
def test_sides_that_may_be_hidden_and_those_beside_them_bound_nothing_of_a_shape_that_fits(
    sides: list[int], fits: list[int]
) -> None:
    found = bounded_sides(torch.tensor([sides] * 2), torch.tensor([UNFIT - 0.01, UNFIT + 0.01]))
    assert found.tolist() == [fits, sides]


def touched_by(object_of: list[int], heading: list[list[float]], across: list[bool]):
    """Touches of which only the directions of those who touch are known."""
    rows = len(object_of)
    return ContactPoints(
        torch.tensor(object_of), torch.zeros(rows, 4, 2, 3), torch.ones(rows, 4, 2),
        torch.ones(rows), torch.ones(rows, 4), torch.tensor(heading), torch.tensor(across),
    )  # fmt: skip


def test_of_what_people_use_a_guess_says_less_beside_them() -> None:
    given = replace(given_at(somewhere(3)), weight=torch.tensor([4.0, 4.0, 4.0]))
    touched = touched_by([1], [[0.0, 0.0]], [False])
    trust = torch.full((3,), 0.25)
    assert lighter_where_used(given, trust, touched).weight.tolist() == [4.0, 1.0, 4.0]
    assert lighter_where_used(given, trust, None) is given


def test_sitters_turn_chairs_to_where_they_face_and_beds_across_it_to_either_side() -> None:
    touched = touched_by([0, 1], [[0.0, 1.0]] * 2, [False, True])
    quarters = math.pi / 2 * torch.arange(4)[:, None].expand(4, 2)
    starts = Layout(torch.zeros(4, 2, 3), quarters, torch.zeros(4, 2, 3))
    found = heading_term(starts, touched)
    assert found[:, 0].tolist() == pytest.approx([0, 1, 2, 1], abs=1e-6)
    assert found[:, 1].tolist() == pytest.approx([1, 0, 1, 0], abs=1e-6)
    few = some_touches(touched, torch.tensor([1]), 2)
    assert few.across.tolist() == [True]
    assert reference_yaw(torch.tensor([0.3, 0.3]), touched).tolist() == pytest.approx([0.0, 0.3])


def test_prior_weights_count_for_positions_and_sizes_but_not_beyond_one_for_yaws() -> None:
    layout = somewhere()
    given = given_at(layout)
    turned = replace(layout, yaw=layout.yaw + 0.4)
    larger_one = replace(layout, log_scale=layout.log_scale + 0.2)
    for weight, yaw, size in ((0.5, 0.5, 0.5), (1.0, 1.0, 1.0), (6.0, 1.0, 6.0)):
        some = replace(given, weight=torch.tensor([weight]))
        usual = replace(given, weight=torch.ones(1))
        assert cost(some, turned) == pytest.approx(yaw * cost(usual, turned))
        assert cost(some, larger_one) == pytest.approx(size * cost(usual, larger_one))


@pytest.mark.parametrize("name", PIECES)
def test_feet_that_stand_level_stay_as_they_are(name: str) -> None:
    for style in range(STYLES[name] + MORE_STYLES.get(name, 0)):
        mesh = make_piece(name, np.random.default_rng(style), style).mesh
        assert levelled(mesh) is mesh


def test_a_foot_that_hangs_comes_down_and_the_box_stays() -> None:
    for seed in range(3):
        mesh = foreign_mesh(
            make_piece("table", np.random.default_rng(seed)), 0.03, np.random.default_rng(seed)
        )
        found = levelled(mesh)
        for before, after in zip(box(mesh.verts), box(found.verts), strict=True):
            assert torch.allclose(before, after, atol=1e-6)
        assert float((found.verts - mesh.verts).abs().max()) < 0.15 * float(box(mesh.verts)[1][1])
    tilted = box_verts((0.5, 0.8, 0.5)).float()
    tilted[:, 1] += 0.04 * (tilted[:, 0] + 0.25) / 0.5 * (1 - tilted[:, 1] / 0.8)
    level = levelled(Mesh(tilted, FACES))
    assert float(level.verts[tilted[:, 1] < 0.1][:, 1].abs().max()) < 0.005
    assert is_closed(level.faces)


def test_a_larger_room_moves_the_floor_below_people_and_keeps_them_on_it() -> None:
    camera = Camera(torch.eye(3), tilted(torch.tensor(-0.2), torch.tensor(0.03)), 640, 360)
    verts, joint = ([[0.5, y, -3.0] for y in heights] for heights in ((-1.4, 0.3), (-0.5,)))
    one = torch.zeros(1, dtype=torch.long)
    seen = Bodies(
        to_camera(torch.tensor([verts]), camera.R_cam_world), one.expand(1, 3),
        to_camera(torch.tensor([joint]), camera.R_cam_world), ("pelvis",), one, one, 5.0, "camera",
        None,
    )  # fmt: skip
    there = nearer(seen, camera, -1.4, 0.9)
    moved = to_world(there.verts, camera.R_cam_world)[0]
    assert torch.allclose(moved[0], torch.tensor([0.45, -1.26, -2.7]), atol=1e-5)
    assert torch.allclose(moved[1], torch.tensor([0.45, 0.44, -2.7]), atol=1e-5)
    assert not are_shapeless(seen)
    fitted = replace(seen, size_spread=0.02)
    assert [size_spread(b, 0.055) for b in (seen, fitted)] == [0.0, 0.02]
    assert size_spread(fitted, 0.0) == 0  # all sizes are trusted


def test_a_larger_room_is_the_same_picture() -> None:
    layout = somewhere(2)
    found = larger(layout, 1.1)
    assert torch.allclose(found.t_world_object, 1.1 * layout.t_world_object)
    assert torch.allclose(found.log_scale.exp(), torch.full((2, 3), 1.1))
