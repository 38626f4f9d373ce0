"""Each rule of `mask_hits`: the object that a group of contact vertices touches."""

import pytest
import torch

from mover.stages.contacts.assign_contacts import Candidates, decide_by_mask_hits

H, W = 40, 60


def rectangle(x0, y0, x1, y1):
    mask = torch.zeros(H, W, dtype=torch.bool)
    mask[y0:y1, x0:x1] = True
    return mask


def room(*pieces):
    """Objects as (category, box, place of its only vertex)."""
    return Candidates(
        tuple(category for category, _, _ in pieces),
        torch.stack([rectangle(*box) for _, box, _ in pieces]),
        torch.tensor([box for _, box, _ in pieces], dtype=torch.float32),
        torch.tensor([[place] for _, _, place in pieces]),
    )


PERSON = rectangle(5, 5, 15, 30)
CHAIR = ("chair", (8, 8, 20, 20), (0.3, 0.0, 0.0))
TABLE = ("table", (6, 6, 18, 18), (0.1, 0.0, 0.0))
SHELF = ("shelf", (6, 6, 18, 18), (0.0, 0.0, 0.0))


def touched(objects, count=30, at=0.0, person=PERSON, arms=False, pixel=(10, 10)):
    """The object that so many vertices in one place touch."""
    points = torch.tensor([at, 0.0, 0.0]).expand(count, 3).clone()
    pixels = torch.tensor([pixel]).expand(count, 2).clone()
    return decide_by_mask_hits(points, pixels, person, objects, arms=arms)


FAR = ("chair", (8, 8, 20, 20), (50.0, 0.0, 0.0))
RULES = {
    "a single candidate needs more than twenty hits": ((FAR,), {"count": 20}, -1),
    "and may be far": ((FAR,), {"count": 21}, 0),
    "of several the one with most nearest vertices": ((CHAIR, TABLE), {"count": 5}, 1),
    "whichever it is": ((CHAIR, TABLE), {"count": 5, "at": 0.3}, 0),
    "up to a metre away": ((CHAIR, TABLE), {"count": 5, "at": 1.0}, 0),
    "but no farther": ((CHAIR, TABLE), {"count": 5, "at": 1.4}, -1),
    "arms touch tables": ((CHAIR, TABLE), {"arms": True}, 1),
    "and nothing else": ((CHAIR,), {"arms": True}, -1),
    "other classes are touched without a rival": ((SHELF,), {}, 0),
    "but not beside one": ((SHELF, CHAIR), {}, 1),
    "nor one that shares no pixel": ((CHAIR,), {"person": rectangle(40, 30, 50, 38)}, -1),
    "without a mask of the person all are": ((CHAIR,), {"person": None}, 0),
}  # fmt: skip


@pytest.mark.parametrize("name", RULES)
def test_rules(name):
    pieces, rest, wanted = RULES[name]
    assert touched(room(*pieces), **rest) == wanted


@pytest.mark.parametrize(("few", "nearest"), [(1, 0), (2, 1)])
def test_candidates_with_at_most_a_twentieth_of_the_hits_fall_away(few, nearest):
    """The second chair owns all nearest vertices but is hit by `few` of 21."""
    objects = room(
        ("chair", (5, 5, 12, 12), (0.5, 0.0, 0.0)), ("chair", (30, 6, 40, 16), (0.0, 0.0, 0.0))
    )
    objects.masks[1] |= rectangle(13, 8, 14, 9)  # so that it shares a pixel with the person
    objects.boxes[1, 0] = 13
    where = torch.tensor([[32, 10]] * few + [[10, 10]] * (21 - few))
    person = rectangle(5, 5, 41, 30)
    assert decide_by_mask_hits(torch.zeros(21, 3), where, person, objects, arms=False) == nearest


def test_vertices_beyond_the_window_count_at_its_border():
    """The mask fills its window (1.3 boxes), so whatever lies outside hits."""
    objects = room(("chair", (8, 8, 18, 18), (0.0, 0.0, 0.0)))
    for mask, wanted in ((rectangle(4, 4, 24, 24), 0), (rectangle(8, 8, 18, 18), -1)):
        objects.masks[0] = mask
        assert touched(objects, pixel=(50, 35)) == wanted
