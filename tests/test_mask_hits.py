"""Each rule of `mask_hits`: the object that a group of contact vertices touches."""

import pytest
import torch

from mover.stages.contacts.contact_association import Candidates, decide_by_mask_hits

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


def points(count, place=(0.0, 0.0, 0.0)):
    return torch.tensor(place).expand(count, 3).clone()


def pixels(count, x=10, y=10):
    return torch.tensor([[x, y]]).expand(count, 2).clone()


PERSON = rectangle(5, 5, 15, 30)
CHAIR = ("chair", (8, 8, 20, 20), (0.3, 0.0, 0.0))
TABLE = ("table", (6, 6, 18, 18), (0.1, 0.0, 0.0))
SHELF = ("shelf", (6, 6, 18, 18), (0.0, 0.0, 0.0))


def test_a_single_candidate_needs_more_than_twenty_hits_and_may_be_far():
    far = room(("chair", (8, 8, 20, 20), (50.0, 0.0, 0.0)))
    assert decide_by_mask_hits(points(20), pixels(20), PERSON, far, arms=False) == -1
    assert decide_by_mask_hits(points(21), pixels(21), PERSON, far, arms=False) == 0


def test_of_several_the_one_with_most_nearest_vertices_is_touched():
    objects = room(CHAIR, TABLE)
    assert decide_by_mask_hits(points(5), pixels(5), PERSON, objects, arms=False) == 1
    near_chair = points(5, (0.3, 0.0, 0.0))
    assert decide_by_mask_hits(near_chair, pixels(5), PERSON, objects, arms=False) == 0


def test_several_that_are_all_more_than_a_metre_away_are_not_touched():
    objects = room(CHAIR, TABLE)
    assert decide_by_mask_hits(points(5, (1.0, 0, 0)), pixels(5), PERSON, objects, arms=False) == 0
    assert decide_by_mask_hits(points(5, (1.4, 0, 0)), pixels(5), PERSON, objects, arms=False) == -1


def test_arms_touch_tables_only():
    assert decide_by_mask_hits(points(30), pixels(30), PERSON, room(CHAIR, TABLE), arms=True) == 1
    assert decide_by_mask_hits(points(30), pixels(30), PERSON, room(CHAIR), arms=True) == -1


def test_other_classes_are_touched_only_without_a_rival():
    assert decide_by_mask_hits(points(30), pixels(30), PERSON, room(SHELF), arms=False) == 0
    assert decide_by_mask_hits(points(30), pixels(30), PERSON, room(SHELF, CHAIR), arms=False) == 1


@pytest.mark.parametrize(("few", "touched"), [(1, 0), (2, 1)])
def test_candidates_with_at_most_a_twentieth_of_the_hits_fall_away(few, touched):
    """The second chair owns all nearest vertices but is hit by `few` of 21."""
    objects = room(
        ("chair", (5, 5, 12, 12), (0.5, 0.0, 0.0)), ("chair", (30, 6, 40, 16), (0.0, 0.0, 0.0))
    )
    objects.masks[1] |= rectangle(13, 8, 14, 9)  # so that it shares a pixel with the person
    objects.boxes[1, 0] = 13
    where = pixels(21)
    where[:few] = torch.tensor([32, 10])
    person = rectangle(5, 5, 41, 30)
    assert decide_by_mask_hits(points(21), where, person, objects, arms=False) == touched


def test_an_object_that_shares_no_pixel_with_the_person_is_no_candidate():
    elsewhere = rectangle(40, 30, 50, 38)
    assert decide_by_mask_hits(points(30), pixels(30), elsewhere, room(CHAIR), arms=False) == -1
    assert decide_by_mask_hits(points(30), pixels(30), None, room(CHAIR), arms=False) == 0


def test_vertices_beyond_the_window_count_at_its_border():
    """The mask fills its window (1.3 boxes), so whatever lies outside hits."""
    objects = room(("chair", (8, 8, 18, 18), (0.0, 0.0, 0.0)))
    objects.masks[0] = rectangle(4, 4, 24, 24)
    assert decide_by_mask_hits(points(30), pixels(30, 50, 35), PERSON, objects, arms=False) == 0
    objects.masks[0] = rectangle(8, 8, 18, 18)
    assert decide_by_mask_hits(points(30), pixels(30, 50, 35), PERSON, objects, arms=False) == -1
