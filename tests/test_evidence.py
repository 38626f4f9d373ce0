from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tiny_capture as tiny
import torch
from scipy.ndimage import binary_erosion

from mover.core.types import Capture, Masks, People
from mover.geometry.rle import encode
from mover.io.capture import evidence
from mover.io.capture.arrays import ObjectArrays, PeopleArrays, capture_from_arrays
from mover.io.capture.evidence import BORDER, evidence_table, gather_evidence
from mover.io.capture.folder import read_capture

WIDTH, HEIGHT, FOCAL = 160, 120, 100.0
CAMERA = {"w": WIDTH, "h": HEIGHT, "fl_x": FOCAL, "fl_y": FOCAL, "cx": 80.0, "cy": 60.0}
DATA = Path(__file__).parents[2] / "shared" / "data"


def sphere(x: float) -> tuple[np.ndarray, np.ndarray]:
    """A ball of 1 m at 4 m: a disc of about 25.8 px radius around (80 + 25 x, 60)."""
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=4)
    return ball.vertices + np.array([x, 0, 4.0]), ball.faces


def disc(x: float) -> np.ndarray:
    v, u = np.mgrid[:HEIGHT, :WIDTH] + 0.5
    return (u - 80 - FOCAL * x / 4) ** 2 + (v - 60) ** 2 < (FOCAL / 15**0.5) ** 2


def room(hide: bool) -> Capture:
    """A cupboard fills the right half; a ball passes before it, or is hidden by it."""
    left = np.zeros((HEIGHT, WIDTH), dtype=bool)
    left[:, 80:] = True
    verts = [sphere(x)[0] for x in (-1.5, 0.0)]
    masks = np.stack([disc(-1.5), disc(0.0) & (~left if hide else True)])
    other = np.zeros_like(left)
    other[:5, :5] = True
    step: dict[str, Any] = {"vertices": tiny.STEP, "faces": tiny.STEP_FACES,
                            "translation": (0, 0, -3), "yaw": 0}  # fmt: skip
    return capture_from_arrays(
        CAMERA,
        [
            ObjectArrays("cupboard", "cabinet", **step, mask=left),
            ObjectArrays("lamp", "lamp", **step, mask=other),
            ObjectArrays("box", "box", **step, box=(1, 2, 30, 40)),
            ObjectArrays("guess", "box", **step),
        ],
        bodies={
            "vertices": np.stack(verts), "faces": sphere(0)[1], "frame": [0, 4],
            "person": [0, 0], "space": "camera",
        },
        people=PeopleArrays(masks, [0, 4], [0, 0]),
    )  # fmt: skip


@pytest.mark.parametrize("hide", [False, True])
def test_a_person_before_an_object_is_near_evidence_and_a_hidden_one_far(hide):
    capture = room(hide)
    cupboard, lamp, box, guess = gather_evidence(capture)
    half = disc(0.0)[:, 80:].sum()
    assert cupboard.mask_pixels == 80 * HEIGHT
    shown, hidden = (cupboard.near_pixels, cupboard.far_pixels)
    inner = binary_erosion(disc(0.0), iterations=BORDER)[:, 80 + BORDER :].sum()
    # The disc's border is a third of a pixel's width uncertain on the grid.
    assert (hidden if hide else shown) == pytest.approx(inner if hide else half, rel=0.06)
    assert (shown if hide else hidden) < 0.1 * half
    assert cupboard.frames == (0 if hide else 1)
    assert lamp.missing == ("no person passes it",)
    assert (box.mask_pixels, box.missing) == (0, ("no mask, only a box",))
    assert guess.missing == ("no annotation",)


def test_each_nth_frame_of_a_long_video_stands_for_n(monkeypatch):
    code = encode(torch.from_numpy(disc(0.0)))
    times, one = torch.arange(12), torch.zeros(12, dtype=torch.long)
    people = People(Masks(HEIGHT, WIDTH, (code,) * 12), times, one)
    capture = replace(room(hide=False), people=people)
    whole = gather_evidence(capture)[0]
    monkeypatch.setattr(evidence, "LOOKED", 6)
    assert gather_evidence(capture)[0] == whole
    assert whole.frames == 12


def test_the_table_shows_every_object_and_every_warning():
    capture = room(hide=False)
    lines = evidence_table(capture, gather_evidence(capture)).splitlines()
    columns = "object category mask px near px far px frames contacts missing"
    assert lines[0].split() == columns.split()
    assert [line.split()[0] for line in lines[1:5]] == ["cupboard", "lamp", "box", "guess"]
    assert lines[5:] == [f"warning: {text}" for text in capture.warnings]
    assert lines[5:]


@pytest.mark.skipif(not DATA.is_dir(), reason="the shared data is not here")
def test_the_dancer_of_the_photograph_is_beside_the_bench():
    capture = read_capture(DATA / "photo_bench")
    (bench,) = gather_evidence(capture)
    assert bench.mask_pixels == 41688
    assert bench.frames == 0
