"""Furniture along a wall: what a line costs, who gives it to whom, and where hidden bases end."""

import functools
import math
from dataclasses import fields, replace

import pytest
import torch
from analytic import GROUND, boxes_of, image_at, make_inputs, walls_at
from hypothesis import given, settings
from hypothesis import strategies as st

from mover.core.types import Layout
from mover.energy.config import BatchedBFGS
from mover.energy.image_terms import LEAST, SEEN, UNKNOWN
from mover.energy.objective import HumanCues
from mover.energy.prior_terms import ALONG, WALL_RHO, Walls, wall_term
from mover.furniture.library import WALL_PIECES
from mover.pipeline.presets import ROBUST
from mover.stages.objects.place_inputs import Pinned, PlaceInputs, with_walls
from mover.stages.objects.place_objects import energy_of, place_objects
from mover.stages.objects.wall_alignment import NEAR, STRETCH, TURN, UNSEEN, find_walls, starts_at

BOTTOM = 3
WALL = -5.0  # [m], where the rears of the rows below stand
CABINET, SHELF, TABLE = (1.2, 0.9, 0.45), (1.0, 1.8, 0.35), (0.9, 0.7, 0.7)
SEEDS = st.integers(0, 2**20)


def layout_of(places, yaws, dtype=torch.float64):
    """Objects on the floor at (x, z)."""
    t = torch.tensor([[x, GROUND, z] for x, z in places], dtype=dtype)
    return Layout(t, torch.tensor(yaws, dtype=dtype), torch.zeros_like(t))


def vector(numbers):
    return torch.tensor(numbers, dtype=torch.float64)


def any_room(seed, starts=3, n=5, lines=4):
    """Layouts, sizes and lines with nothing in common; some lines say nothing."""
    g = torch.Generator().manual_seed(seed)

    def draw(*shape):
        return torch.rand(*shape, generator=g, dtype=torch.float64)

    layout = Layout(4 * draw(starts, n, 3) - 2, 7 * draw(starts, n), 0.6 * draw(starts, n, 3) - 0.3)
    angle = 2 * math.pi * draw(lines)
    trust = draw(n, lines) * (draw(n, lines) < 0.6)
    trust[0] = 0
    walls = Walls(torch.stack([angle.sin(), angle.cos()], -1), 4 * draw(lines) - 2, trust)
    return layout, 0.2 + draw(n, 3), walls


def rear(layout, size, item):
    """Outward direction (x, z) and corners of the side that looks away, by what a box is."""
    x, _, z = layout.t_world_object[item].tolist()
    yaw, scale = float(layout.yaw[item]), layout.log_scale[item].exp()
    half = (size[item[-1]] * scale / 2).tolist()
    sides = []
    for sign in (1, -1):
        out = sign * math.sin(yaw), sign * math.cos(yaw)
        ends = [
            (x + u * math.cos(yaw) + half[2] * out[0], z - u * math.sin(yaw) + half[2] * out[1])
            for u in (-half[0], half[0])
        ]
        sides.append((out[0] * x + out[1] * z, out, ends))
    return max(sides)[1:]


class TestCost:
    @given(seed=SEEDS)
    @settings(max_examples=20, deadline=None)
    def test_it_is_that_of_a_naive_loop(self, seed):
        layout, size, walls = any_room(seed)
        found = wall_term(layout, size, walls)
        for start in range(found.shape[0]):
            for i in range(found.shape[1]):
                out, ends = rear(layout, size, (start, i))
                near = [0.0]
                for normal, offset, q in zip(walls.out, walls.offset, walls.trust[i], strict=True):
                    a, b = normal.tolist()
                    if a * out[0] + b * out[1] > ALONG:
                        apart = sum((a * x + b * z - float(offset)) ** 2 for x, z in ends) / 2
                        near.append(float(q) * (1 - apart / (apart + WALL_RHO**2)))
                want = float(walls.trust[i].max()) - max(near)
                assert float(found[start, i]) == pytest.approx(want, abs=1e-12)
        assert (found[:, 0] == 0).all(), "no line constrains the first"

    @pytest.mark.parametrize("seed", range(3))
    def test_its_gradient_equals_finite_differences(self, seed):
        layout, size, walls = any_room(seed)
        near = replace(walls_at(boxes_of(["bed"] * 5, size.tolist()), layout[0]))
        for lines in (walls, Walls(near.out, near.offset + 0.05, near.trust)):
            free = [getattr(layout, f.name).clone().requires_grad_() for f in fields(Layout)]
            torch.autograd.gradcheck(
                lambda *x, lines=lines: wall_term(Layout(*x), size, lines), free, eps=1e-7
            )

    @given(seed=SEEDS)
    @settings(max_examples=20, deadline=None)
    def test_it_is_zero_on_the_line_and_rises_with_the_distance_from_it(self, seed):
        layout, size, _ = any_room(seed, starts=1)
        there = layout[0]
        walls = walls_at(boxes_of(["bed"] * 5, size.tolist(), torch.float64), there)
        assert float(wall_term(there, size, walls).abs().max()) < 1e-12
        own = replace(walls, trust=torch.eye(5, dtype=torch.float64))
        costs = [wall_term(there, size, replace(own, offset=own.offset + d)) for d in (0.05, 0.1)]
        torch.testing.assert_close(costs[0], torch.full_like(costs[0], 0.2))
        torch.testing.assert_close(costs[1], torch.full_like(costs[1], 0.5))


def a_row(names=("cabinet", "cabinet", "cabinet", "shelf"), off=(0.0, 0.04, -0.04, 1.0)):
    """Furniture side by side with its rear this far in front of the wall."""
    sizes = [{"cabinet": CABINET, "shelf": SHELF}.get(name, TABLE) for name in names]
    places = [(1.3 * k - 2, WALL + d + s[2] / 2)
              for k, (d, s) in enumerate(zip(off, sizes, strict=True))]  # fmt: skip
    objects = boxes_of(names, sizes, torch.float64)
    return layout_of(places, [0.0] * len(names)), objects, torch.full((len(names), 4), SEEN)


def naive_lines(layout, objects, sides):
    """Normal, offset and trust of each line, by loops."""
    n, able = len(objects.ids), []
    rears = [rear(layout, objects.size, (i,)) for i in range(n)]
    for i in range(n):
        if objects.categories[i] in WALL_PIECES and int(objects.supports[i]) == -1:
            able.append(i)
    found = []
    for j in able:
        (a, b), ends = rears[j]
        offset = sum(a * x + b * z for x, z in ends) / 2
        weight = [0.0] * n
        for i in able:
            out, others = rears[i]
            apart = sum((a * x + b * z - offset) ** 2 for x, z in others) / 2
            if math.sqrt(apart) < NEAR and a * out[0] + b * out[1] > ALONG:
                weight[i] = 1.0 if int(sides[i, BOTTOM]) == SEEN else UNSEEN
        normal = [sum(w * r[0][k] for w, r in zip(weight, rears, strict=True)) for k in (0, 1)]
        length = math.hypot(*normal)
        normal = [x / length for x in normal]
        middle = [sum(normal[0] * x + normal[1] * z for x, z in r[1]) / 2 for r in rears]
        mean = sum(w * m for w, m in zip(weight, middle, strict=True)) / sum(weight)
        trusts = [max(weight[:i] + weight[i + 1 :]) if i in able else 0.0 for i in range(n)]
        found.append((normal, mean, trusts))
    return found


class TestLines:
    @given(seed=SEEDS)
    @settings(max_examples=30, deadline=None)
    def test_they_are_those_of_a_naive_loop(self, seed):
        g = torch.Generator().manual_seed(seed)
        names = [("cabinet", "bed", "shelf", "table", "sofa", "bench")[k]
                 for k in torch.randint(6, (7,), generator=g).tolist()]  # fmt: skip
        _, size, _ = any_room(seed, 1, 7)
        objects = boxes_of(names, size.tolist(), torch.float64)
        carried = torch.where(torch.rand(7, generator=g) < 0.2, 0, -1)
        carried[0] = -1
        objects = replace(objects, supports=carried)
        jitter = torch.rand(3, 7, generator=g, dtype=torch.float64) - 0.5
        side = torch.rand(7, generator=g) < 0.5  # along one of two walls, roughly
        x = torch.where(side, 3 + 0.6 * jitter[0], 4 * jitter[1])
        z = torch.where(side, -4 + 4 * jitter[1], WALL + 0.6 * jitter[0])
        yaw = torch.where(side, -math.pi / 2, 0.0) + jitter[2]
        layout = layout_of(list(zip(x.tolist(), z.tolist(), strict=True)), yaw.tolist())
        sides = torch.randint(3, (7, 4), generator=g)
        walls, lines = find_walls(layout, objects, sides), naive_lines(layout, objects, sides)
        if len(lines) < 2:
            assert walls is None
            return
        found = walls.out, walls.offset, walls.trust.mT
        for value, want in zip(found, zip(*lines, strict=True), strict=True):
            torch.testing.assert_close(value, torch.tensor(want, dtype=torch.float64))

    def test_three_in_a_row_give_it_to_one_that_is_far_off_and_takes_nothing_of_itself(self):
        layout, objects, sides = a_row()
        sides[3, BOTTOM] = LEAST
        walls = find_walls(layout, objects, sides)
        torch.testing.assert_close(walls.out, torch.tensor([[0.0, -1.0]] * 4).double())
        assert walls.offset.tolist() == pytest.approx([5.0, 5.0, 5.0, 4.0])
        others = 1 - torch.eye(4).double()
        others[3, :3] = 1
        others[:3, :3] = 1
        others[:3, 3] = UNSEEN
        torch.testing.assert_close(walls.trust, others)

    def test_one_piece_and_a_line_of_its_own_constrain_nothing(self):
        for names in (("table",), ("cabinet",), ("cabinet", "table", "bench", "chair")):
            assert find_walls(*a_row(names, [0.0] * len(names))) is None
        walls = find_walls(*a_row(("cabinet", "shelf"), (0.0, 0.8)))
        assert torch.equal(walls.trust, 1 - torch.eye(2).double())


class TestStarts:
    @given(seed=SEEDS)
    @settings(max_examples=30, deadline=None)
    def test_each_line_has_one_in_which_rears_are_on_it_as_large_in_the_image_as_before(self, seed):
        g = torch.Generator().manual_seed(seed)
        off, turn = torch.rand(2, 5, generator=g).double() - 0.5
        layout, objects, sides = a_row(
            ("cabinet", "shelf", "table", "bed", "sofa"), (1.2 * off).tolist()
        )
        layout = replace(layout, yaw=turn)
        walls = find_walls(layout, objects, sides)
        found = starts_at(layout, objects, walls)
        assert len(found.yaw) == 1 + len(walls.offset)
        for f in fields(Layout):
            assert torch.equal(getattr(found, f.name)[0], getattr(layout, f.name))
        for number, (line, offset) in enumerate(zip(walls.out, walls.offset, strict=True)):
            at = found[1 + number]
            for i in range(5):
                old, new = layout.t_world_object[i].tolist(), at.t_world_object[i].tolist()
                ahead = float(line @ vector([old[0], old[2]]))
                share = float(offset) / (ahead + float(objects.size[i, 2]) / 2)
                out, _ = rear(layout, objects.size, (i,))
                near = float(line @ vector(out)) > math.cos(TURN)
                inside = ahead > 0 and STRETCH[0] < share < STRETCH[1]
                if float(walls.trust[i, number]) == 0 or not near or not inside:
                    assert all(
                        torch.equal(getattr(at, f.name)[i], getattr(layout, f.name)[i])
                        for f in fields(Layout)
                    )
                    continue
                _, ends = rear(at, objects.size, (i,))
                for end in ends:
                    assert float(line @ vector(end)) == pytest.approx(float(offset))
                assert new == pytest.approx([share * old[0], old[1], share * old[2]])
                grown = at.log_scale[i] - layout.log_scale[i]
                assert grown.tolist() == pytest.approx([math.log(share)] * 3)

    def test_what_would_have_to_go_too_far_or_to_turn_too_much_stays(self):
        layout, objects, sides = a_row(("cabinet",) * 4, (0.0,) * 4)
        walls = find_walls(layout, objects, sides)
        t, yaw = layout.t_world_object.clone(), layout.yaw.clone()
        t[0, 2] = WALL / (STRETCH[1] + 0.1)
        t[1, 2] = WALL / (STRETCH[0] - 0.05)
        yaw[2] = TURN + 0.02
        t[3, 2] += 0.5
        found = starts_at(replace(layout, t_world_object=t, yaw=yaw), objects, walls)
        assert (found.t_world_object[:, :3] == t[:3]).all()
        assert (found.yaw[:, :3] == yaw[:3]).all()
        assert (found.log_scale[:, :3] == 0).all()
        rears = found.t_world_object[:, 3, 2] - CABINET[2] / 2 * found.log_scale[:, 3, 2].exp()
        assert rears.tolist() == pytest.approx([WALL + 0.5] + [WALL] * 4)


def a_hidden_shelf(given_at, size=48):
    """Two cabinets beside a shelf of hidden base, given too far or near; before it, a table."""
    camera = make_inputs(size=16).camera
    names, sizes = ("cabinet", "shelf", "cabinet", "table"), [CABINET, SHELF, CABINET, TABLE]
    objects = boxes_of(names, sizes)
    places = [(1.5 * k - 1.5, WALL + s[2] / 2) for k, s in enumerate(sizes[:3])]
    truth = layout_of([*places, (0.3, -3.2)], [0.0, 0.0, 0.0, 0.4], torch.float32)
    image = image_at(objects, truth, camera, size)
    image.sides[1, BOTTOM] = UNKNOWN
    image.keep[1, size // 2 :] = False
    share = torch.tensor([1.0, given_at, 1.0, 1.0])[:, None]
    objects = replace(objects, verts=objects.verts * share[:, None], size=objects.size * share)
    t = truth.t_world_object * torch.cat([share, torch.ones_like(share), share], -1)
    image = replace(image, distance=t.norm(dim=-1))
    start = replace(truth, t_world_object=t)[None]
    return truth, PlaceInputs(objects, camera, GROUND, image, HumanCues(), start, truth.yaw)


@functools.cache
def lined(given_at):
    """Where the descent with lines puts a hidden shelf."""
    return place_objects(a_hidden_shelf(given_at)[1], CONFIG)


CONFIG = replace(
    ROBUST.place, method=BatchedBFGS(),
    weights=replace(ROBUST.place.weights, given=0.0, measured=0.0),  # in tests of their own
)  # fmt: skip
UNLINED = replace(CONFIG, walls=False)


class TestPlacing:
    @pytest.mark.parametrize("given_at", [0.93, 1.06])
    def test_a_shelf_whose_base_is_hidden_stands_where_its_neighbours_stand(self, given_at):
        truth, inputs = a_hidden_shelf(given_at)
        found, plain = lined(given_at), place_objects(inputs, UNLINED)

        def error(placed):
            return (placed.layout.t_world_object - truth.t_world_object).norm(dim=-1)

        assert plain.walls is None
        assert found.walls.trust.amax(-1).tolist() == pytest.approx([1, 1, 1, 0])
        assert float(error(plain)[1]) > 0.25
        assert float(error(found)[1]) < 0.15 * float(error(plain)[1])
        assert float(error(found)[[0, 2]].max()) < 0.02
        count = len(found.energy)
        for name in (f.name for f in fields(Layout)):
            one, other = getattr(found.layout, name), getattr(plain.layout, name)
            assert torch.equal(one[3], other[3]), name
            one, other = getattr(found.candidates, name), getattr(plain.candidates, name)
            assert torch.equal(one[:, 3], other[:count, 3]), name
        assert torch.equal(found.energy[:, 3], plain.energy[:count, 3])
        assert (found.energy.diff(dim=0) >= 0).all()

    def test_its_energies_are_those_of_its_candidates_under_the_lines_that_it_names(self):
        inputs, placed = a_hidden_shelf(0.93)[1], lined(0.93)
        found = energy_of(with_walls(inputs, placed.walls), CONFIG)(placed.candidates)
        torch.testing.assert_close(placed.energy, found.per_item, rtol=1e-4, atol=1e-6)
        assert float(found.parts["wall"][:, :3].amax()) > 0
        assert not found.parts["wall"][:, 3].any()

    def test_a_pinned_object_stays_and_gives_its_line(self):
        truth, inputs = a_hidden_shelf(0.93)
        aside = replace(truth, t_world_object=truth.t_world_object + torch.tensor([0.0, 0, 0.15]))
        held = Pinned(torch.tensor([True, False, True, False]), aside)
        placed = place_objects(replace(inputs, pinned=held), CONFIG)
        for i in (0, 2):
            assert torch.equal(placed.layout.t_world_object[i], aside.t_world_object[i])
            assert torch.equal(placed.layout.yaw[i], aside.yaw[i])
        assert placed.walls.offset[[0, 2]].tolist() == pytest.approx([4.85, 4.85], abs=0.02)
        back = float(placed.layout.t_world_object[1, 2]) - SHELF[2] / 2
        assert back == pytest.approx(WALL + 0.15, abs=0.06)
