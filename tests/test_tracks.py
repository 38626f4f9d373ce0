"""Which numbers are one person: of bodies and masks by position, of pieces, of two files."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from mover.core.types import Bodies, Camera, Masks, People
from mover.geometry.camera import project
from mover.geometry.rle import encode
from mover.io.capture.tracks import pair_tracks, paired

CAMERA = Camera(
    torch.tensor([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]]),
    torch.diag(torch.tensor([1.0, -1, -1])), 320, 240,
)  # fmt: skip
HUMAN = torch.tensor([0.5, 1.7, 0.3])
CORNERS = torch.cartesian_prod(*[torch.tensor([-0.5, 0.5])] * 3) * HUMAN
FACES = torch.tensor([[0, 1, 2]])
FRAMES = range(12)


def bodies_of(rows: list[tuple[int, int, tuple[float, float, float]]]) -> Bodies:
    """Boxes of a person's size, each a frame, a track and a position."""
    verts = torch.stack([CORNERS + torch.tensor(place) for _, _, place in rows])
    frame, person = (torch.tensor([row[k] for row in rows]) for k in (0, 1))
    return Bodies(verts, FACES, None, (), frame, person, 30.0, "camera", None)


def masks_of(rows: list[tuple[int, int, tuple[float, float, float]]], shown: float = 1.0) -> People:
    """Their boxes in the image, of which the upper part is shown."""
    codes: list[bytes] = []
    for place in (row[2] for row in rows):
        pixels = project(CORNERS + torch.tensor(place), CAMERA.K).round().long()
        (left, top), (right, low) = pixels.amin(0).clamp_min(0), pixels.amax(0)
        mask = torch.zeros(CAMERA.height, CAMERA.width, dtype=torch.bool)
        mask[top : top + round(float(low - top) * shown), left:right] = True
        codes.append(encode(mask))
    frame, person = (torch.tensor([row[k] for row in rows]) for k in (0, 1))
    return People(Masks(CAMERA.height, CAMERA.width, tuple(codes)), frame, person, {"1": 1.8})


def walkers(first: int, second: int) -> list[tuple[int, int, tuple[float, float, float]]]:
    """One walks from the left to the middle, the other stands at the right."""
    rows = [(f, first, (-1 + 0.05 * f, 0.0, 3.5)) for f in FRAMES]
    return rows + [(f, second, (1.0, 0.1, 4.0)) for f in FRAMES]


CASES = {  # numbers of bodies and masks: what the bodies' numbers and the masks' become
    "of two tools": ((7, 0), (1, 2), {}, {1: 7, 2: 0}),
    "from 1000": ((0, 1), (1000, 1001), {}, {1000: 0, 1001: 1}),
    "swapped": ((0, 1), (1, 0), {}, {1: 0, 0: 1}),
    "the same": ((3, 5), (3, 5), {}, {}),
}


@pytest.mark.parametrize("shown", [1.0, 0.5])
@pytest.mark.parametrize("case", CASES)
def test_tracks_of_two_tools_are_paired_by_position(case: str, shown: float):
    ours, theirs, of_bodies, of_masks = CASES[case]
    bodies, people = bodies_of(walkers(*ours)), masks_of(walkers(*theirs), shown)
    pairs = pair_tracks(bodies, people, CAMERA)
    assert (pairs.bodies, pairs.masks) == (of_bodies, of_masks)
    assert len(pairs.notes) == bool(of_masks)
    found, masks = paired(bodies, people, pairs)
    assert torch.equal(masks.person, bodies.person)
    assert torch.equal(found.person, bodies.person)
    assert masks.heights == {str(of_masks.get(1, 1)): 1.8}


def test_pieces_are_one_person_where_the_other_side_is_whole():
    rows = walkers(0, 1)
    cut = [(f, 9 if p == 0 and f > 5 else p, place) for f, p, place in rows]
    pairs = pair_tracks(bodies_of(cut), masks_of(rows), CAMERA)
    assert (pairs.bodies, pairs.masks) == ({9: 0}, {})
    pairs = pair_tracks(bodies_of(rows), masks_of(cut), CAMERA)
    assert (pairs.bodies, pairs.masks) == ({}, {9: 0})


def test_what_is_uncertain_keeps_its_number():
    """Two people close together under other numbers; and a mask elsewhere whose number is used."""
    near = [(f, p, (0.05 * p, 0.0, 3.5)) for f in FRAMES for p in (0, 1)]
    others = [(f, p + 5, place) for f, p, place in near]
    assert pair_tracks(bodies_of(near), masks_of(others), CAMERA).notes == ()
    elsewhere = [(f, 0, (-1.2, 0.0, 5.0)) for f in FRAMES] + [
        (f, 4, (1.0, 0.0, 4.0)) for f in FRAMES
    ]
    alone = [(f, 0, (1.0, 0.0, 4.0)) for f in FRAMES]
    pairs = pair_tracks(bodies_of(alone), masks_of(elsewhere), CAMERA)
    assert (pairs.bodies, pairs.masks) == ({}, {4: 0, 0: 5})
    apart = replace(bodies_of(alone), frame=torch.arange(100, 100 + len(FRAMES)))
    assert pair_tracks(apart, masks_of(elsewhere), CAMERA).notes == ()
    assert np.isfinite(apart.verts.numpy()).all()
