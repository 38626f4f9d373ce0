"""What is known of the sides of a box: where they are, or how far an object reaches at least."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from analytic import make_inputs
from scipy.spatial import ConvexHull

from mover.energy.image_terms import HIDDEN, LEAST, LIKELY, SEEN, SOFT, UNKNOWN, bbox_term
from mover.geometry.camera import project
from mover.geometry.rotations import rot_y
from mover.stages.config import ImageConfig
from mover.stages.objects.find_image_cues import ImageInputs, find_image_cues, order_in_image
from mover.stages.objects.gather_given import bounded_sides

HEIGHT, WIDTH = 120, 200
CAMERA = replace(make_inputs().camera, width=WIDTH, height=HEIGHT)


def rectangle(x0, y0, x1, y1):
    mask = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
    mask[y0:y1, x0:x1] = True
    return mask


def box_of(mask):
    y, x = mask.nonzero().T
    return torch.tensor([x.min(), y.min(), x.max() + 1, y.max() + 1]).float()


def sides_of(first, *others, form="robust", people=None, behind=(), bounded=False):
    """What is known of the first of some masks."""
    masks = torch.stack([first, *others])
    hidden_by = torch.zeros(len(masks), len(masks), dtype=torch.bool)
    for k in behind:
        hidden_by[0, k] = True
    seen = torch.ones(len(masks), dtype=torch.bool)
    boxes = torch.stack([box_of(m) for m in masks])
    no_people = torch.zeros_like(first) if people is None else people
    inputs = ImageInputs(CAMERA, boxes, seen, masks, no_people, hidden_by)
    return find_image_cues(inputs, ImageConfig(32, form, 0.1, bounded)).sides[0].tolist()


def corners_at_border(K, random):
    """Corners [px] of an upright box that one border of the image cuts, and none of the others."""
    tall = torch.rand(3, generator=random) * 0.6 + 0.3
    turn = float(torch.rand((), generator=random)) * math.pi
    unit = torch.cartesian_prod(*(torch.tensor([-0.5, 0.5]),) * 3) * tall
    for _ in range(1000):
        aim = torch.rand(2, generator=random) * torch.tensor([WIDTH, HEIGHT])
        away = 2 + 6 * float(torch.rand((), generator=random))
        middle = away * torch.linalg.inv(K) @ torch.tensor([*aim.tolist(), 1.0])
        pixels = project(unit @ rot_y(torch.tensor(turn)).mT + middle, K)
        box = torch.cat([pixels.amin(0), pixels.amax(0)])
        out = torch.cat([box[:2] < 0, box[2:] > torch.tensor([WIDTH, HEIGHT])])
        inside = torch.tensor([2.0, 2.0, WIDTH - 2.0, HEIGHT - 2.0])
        clear = (box - inside) * torch.tensor([1.0, 1.0, -1.0, -1.0]) > 0
        if int(out.sum()) == 1 and bool((clear | out).all()):
            return pixels
    raise AssertionError("no box is cut by one border")


def hull(pixels):
    """What is covered of the image by the convex hull of points [px]."""
    around = ConvexHull(pixels.double().numpy()).equations
    y, x = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    beyond = around[:, 0, None, None] * x + around[:, 1, None, None] * y + around[:, 2, None, None]
    return torch.from_numpy((beyond <= 0).all(0))


BOX, FRONT = rectangle(50, 30, 90, 80), rectangle(90, 20, 150, 90)
CUT = rectangle(0, 30, 90, 80)  # by the left border of the image
KNOWN = {
    "alone": ((BOX,), {}, [SEEN] * 4),
    "one in front": ((BOX, FRONT), {}, [SEEN, SEEN, LEAST, SEEN]),
    "one in front, bounded, but not by the border": (
        (CUT, FRONT), {"bounded": True}, [LEAST, SEEN, LIKELY, SEEN]),
    "people and the border": (
        (CUT,), {"people": rectangle(50, 80, 90, 120)}, [LEAST, SEEN, SEEN, LEAST]),
    "known to stand behind": ((BOX, FRONT), {"behind": (1,)}, [SEEN] * 4),
    "the preset of the paper": ((BOX, FRONT), {"form": "paper"}, [SEEN] * 4),
    "legs hidden at both ends of a top": (
        (rectangle(60, 40, 120, 52), rectangle(10, 10, 60, 100), rectangle(112, 52, 150, 100)),
        {}, [LEAST, SEEN, SEEN, LEAST]),
}  # fmt: skip


class TestWhatIsKnown:
    @pytest.mark.parametrize("name", KNOWN)
    def test_sides_of_masks(self, name):
        masks, rest, wanted = KNOWN[name]
        assert sides_of(*masks, **rest) == wanted

    @pytest.mark.parametrize("seed", range(30))
    def test_where_it_truly_stands_a_box_that_a_border_cuts_costs_nothing(self, seed):
        pixels = corners_at_border(CAMERA.K, torch.Generator().manual_seed(seed))
        mask = hull(pixels)
        sides = bounded_sides(torch.tensor([sides_of(mask)]), torch.zeros(1))
        box = box_of(mask)
        cost = bbox_term(pixels[None], box[None], sides, float(WIDTH), "robust")
        whole = float((box[2:] - box[:2]).prod().sqrt())
        assert float(cost) < 4 / whole  # pixels are whole: each side is off by less than one

    def test_a_piece_without_a_detection_knows_none(self):
        mask = rectangle(50, 30, 90, 80)
        whole, none = torch.tensor([[0.0, 0, WIDTH, HEIGHT]]), torch.zeros(1, 1).bool()
        inputs = ImageInputs(CAMERA, whole, none[0], (mask & False)[None], mask & False, none)
        for form in ("paper", "robust"):
            assert find_image_cues(inputs, ImageConfig(32, form)).sides.tolist() == [[UNKNOWN] * 4]


class TestCost:
    detected = torch.tensor([[40.0, 30.0, 80.0, 70.0]])

    def cost(self, drawn, sides):
        corners = torch.tensor([[drawn[:2], drawn[2:]]])
        return float(bbox_term(corners, self.detected, torch.tensor([sides]), 200.0, "robust"))

    @pytest.mark.parametrize("known", [LEAST, LIKELY])
    @pytest.mark.parametrize("side", range(4))
    def test_a_lower_bound_is_as_costly_as_a_seen_side_where_the_object_falls_short(
        self, side, known
    ):
        short = self.detected[0].clone()
        short[side] += 8.0 if side < 2 else -8.0
        sides = [SEEN] * 4
        expected = self.cost(short.tolist(), sides)
        sides[side] = known
        assert self.cost(short.tolist(), sides) == expected
        assert expected == pytest.approx((0.2**2 + SOFT**2) ** 0.5 - SOFT, rel=1e-5)

    @pytest.mark.parametrize("side", range(4))
    def test_beyond_it_costs_nothing_or_if_it_may_be_hidden_less_and_less(self, side):
        def beyond(far, known):
            wide = self.detected[0].clone()
            wide[side] += -far if side < 2 else far
            return self.cost(wide.tolist(), [known if k == side else SEEN for k in range(4)])

        assert beyond(25.0, LEAST) == 0
        costs = [beyond(far, LIKELY) for far in (0.5, 5.0, 50.0, 5000.0)]
        assert costs[0] == pytest.approx(beyond(0.5, SEEN), rel=0.2)
        assert costs == sorted(costs)
        assert 0.9 * HIDDEN < costs[-1] < HIDDEN

    def test_an_unknown_side_never_costs(self):
        for off in (-20.0, 20.0):
            drawn = (self.detected[0] + off).tolist()
            assert self.cost(drawn, [UNKNOWN] * 4) == 0


NO_PEOPLE = torch.zeros(HEIGHT, WIDTH, dtype=torch.bool)
SOFA = rectangle(40, 20, 120, 60)


@pytest.mark.parametrize(("first", "second", "people", "found"), [
    (rectangle(60, 60, 100, 100), SOFA, NO_PEOPLE, [(0, 1)]),  # a table in front of a sofa
    (SOFA, rectangle(60, 60, 100, 100), NO_PEOPLE, [(1, 0)]),
    (rectangle(130, 60, 160, 100), SOFA, NO_PEOPLE, []),  # no column is shared
    (rectangle(60, 30, 100, 61), SOFA, NO_PEOPLE, []),  # bases are equally high
    # the top of a table reaches over a chair whose legs are lower there, not as low as its own
    (rectangle(60, 60, 90, 90), SOFA | rectangle(40, 60, 45, 100), NO_PEOPLE, []),
    (rectangle(60, 60, 100, 100), SOFA, rectangle(40, 60, 60, 110), []),  # a person hides it
    (rectangle(60, 90, 100, 118), rectangle(40, 80, 120, 120), NO_PEOPLE, []),  # the border
    (NO_PEOPLE, SOFA, NO_PEOPLE, []),  # no mask
])  # fmt: skip
def test_bases_in_the_image_order_what_stands_on_the_floor(first, second, people, found):
    order = order_in_image(torch.stack([first, second & ~first]), people)
    assert order.nonzero().tolist() == [list(pair) for pair in found]
