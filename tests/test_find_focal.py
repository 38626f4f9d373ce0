"""The focal length from people: bodies drawn by a known lens, and a lens that is said wrong."""

import dataclasses
import math

import pytest
import torch
from test_find_depth import CAMERA, SIZE, film, inputs_of, masks_of, moved, table
from torch.nn.functional import pad

from mover.core import records
from mover.core.observe import Step
from mover.core.run import Run
from mover.pipeline.people import people_of
from mover.pipeline.presets import PRESETS, ROBUST, Config
from mover.stages.camera.find_focal import (
    OFFSET,
    Focal,
    FocalInputs,
    Sightings,
    best_shift,
    find_focal,
    fit_zoom,
    zoomed,
)
from mover.stages.config import FocalConfig
from mover_bench.rooms.config import NoiseConfig
from mover_bench.rooms.noise import add_noise
from mover_bench.studies.args import StudyArgs
from mover_bench.studies.study import STUDIES, ask_of
from mover_bench.studies.variants import VARIANTS

WIDE = [(x, z) for z in (-3.6, -4.6) for x in (-1.6, -1.0, -0.4, 0.4, 1.0, 1.6)]
LOOSE = FocalConfig(spread=0.05)


def asked(bodies, seen, zoom=1.0, objects=()):
    given = inputs_of(bodies, seen, objects)
    camera = zoomed(CAMERA, zoom)
    return FocalInputs(given.bodies, given.keep, given.people, given.objects, camera)


def sightings(zoom, rows=60, noise=0.0, offset=(0.0, 0.0), together=1, seed=0):
    """People all over the image whose masks are where a lens that is `zoom` times longer draws."""
    draw = torch.Generator().manual_seed(seed)
    drawn = (torch.rand(rows, 2, generator=draw) - 0.5) * torch.tensor([600.0, 120.0])
    height = 150 + 100 * torch.rand(rows, generator=draw)
    error = noise * torch.randn(-(-rows // together), 2, generator=draw)
    error = error.repeat_interleave(together, 0)[:rows] + torch.tensor(offset)
    return Sightings(
        drawn, zoom * drawn + height[:, None] * error, height, torch.zeros(rows).long(),
        torch.arange(rows) // together,
    )  # fmt: skip


@pytest.mark.parametrize("wrong", [0.95, 1.0, 1.05])
def test_a_wrong_focal_length_is_found_to_a_percent(wrong):
    true = film(WIDE)
    found = find_focal(asked(true, masks_of(true), wrong), LOOSE)
    assert found.zoom * wrong == pytest.approx(1, abs=0.005)
    assert found.spread < 0.02
    assert bool(found.warnings) == (wrong != 1)


@pytest.mark.parametrize("depth", [0.97, 1.03])
@pytest.mark.parametrize("grow", [-2, 2])
def test_a_wrong_depth_and_wide_masks_are_not_taken_for_the_lens(depth, grow):
    true = film(WIDE)
    found = find_focal(asked(moved(true, depth), masks_of(true, grow=grow), 1.04), LOOSE)
    assert found.zoom * 1.04 == pytest.approx(1, abs=0.01)


def test_people_whose_legs_are_hidden_tell_it_too():
    true = film(WIDE)
    seen = masks_of(true, hidden=table())
    found = find_focal(asked(true, seen, 0.96, [table()]), LOOSE)
    assert found.zoom * 0.96 == pytest.approx(1, abs=0.01)


def test_people_who_were_fitted_under_the_wrong_lens_leave_it_as_it_is():
    """What docs and docstring say cannot be told: they are seen where they are drawn."""
    true = film(WIDE)
    scale = torch.tensor([1.0, 1.0, 1.05])  # the same picture under a lens that is 5 % longer
    bodies = dataclasses.replace(true, verts=true.verts * scale)
    found = find_focal(asked(bodies, masks_of(true), 1.05), LOOSE)
    assert found.zoom == pytest.approx(1, abs=0.005)


def test_nobody_who_is_seen_moves_nothing():
    true = film(WIDE[:3])
    wall = torch.ones(SIZE, dtype=torch.bool)
    hidden = find_focal(asked(true, masks_of(true, hidden=wall), 1.05, [wall]), LOOSE)
    assert (hidden.zoom, hidden.spread, hidden.sightings) == (1.0, 0.05, 0)
    few = find_focal(asked(true, masks_of(true), 1.05), LOOSE)
    assert (few.zoom, few.sightings) == (1.0, 3)
    assert "3 of at least 5 bodies" in few.warnings[0]


def test_without_a_spread_no_preset_looks_for_it_and_the_stage_refuses():
    assert Config().focal.spread == 0
    assert all(preset.focal.spread == 0 for preset in PRESETS.values())
    true = film(WIDE[:1])
    with pytest.raises(ValueError, match="spread 0"):
        find_focal(asked(true, masks_of(true)), FocalConfig())


def test_only_the_focal_length_of_the_camera_changes():
    camera = zoomed(CAMERA, 1.1)
    expected = CAMERA.K * torch.tensor([[1.1, 1, 1], [1, 1.1, 1], [1, 1, 1]])
    assert torch.equal(camera.K, expected)
    assert torch.equal(camera.R_cam_world, CAMERA.R_cam_world)


def test_the_line_is_exact_without_noise_and_an_offset_of_all_masks_is_no_zoom():
    for zoom in (0.93, 1.0, 1.06):
        for offset in ((0.0, 0.0), (0.01, -0.02)):
            found, spread = fit_zoom(sightings(zoom, offset=offset), 0.1)
            assert found == pytest.approx(zoom, abs=2e-4)
            assert spread < 0.01


def test_the_fit_is_least_squares_where_there_are_no_outliers():
    """Against NumPy with the priors as further lines; noise so small that its floor counts."""
    import numpy as np

    some = sightings(1.03, noise=1e-4)
    x, y = ((v / some.height[:, None]).double().numpy() for v in (some.drawn, some.seen))
    ones, none = np.ones(len(x)), np.zeros(len(x))
    lines = (
        np.concatenate([np.stack([x[:, 0], ones, none], 1), np.stack([x[:, 1], none, ones], 1)])
        / 0.005
    )
    prior = np.diag([1 / 0.05, 1 / OFFSET, 1 / OFFSET])
    target = np.concatenate([np.concatenate([y[:, 0], y[:, 1]]) / 0.005, [1 / 0.05, 0, 0]])
    at = np.linalg.lstsq(np.concatenate([lines, prior]), target, rcond=None)[0]
    assert fit_zoom(some, 0.05)[0] == pytest.approx(at[0], abs=1e-4)


def test_a_third_of_wrong_masks_does_not_matter():
    some = sightings(1.04, rows=90, noise=0.01)
    seen = some.seen.clone()
    seen[::3] += torch.tensor([120.0, -40.0])
    found, _ = fit_zoom(dataclasses.replace(some, seen=seen), 0.05)
    assert found == pytest.approx(1.04, abs=0.01)


@pytest.mark.parametrize("together", [1, 6])
def test_the_stated_spread_is_the_spread_of_the_errors(together):
    """Over 200 draws, errors shared by the rows of a moment included."""
    found = [
        fit_zoom(sightings(1.02, noise=0.05, together=together, seed=k), 0.2) for k in range(200)
    ]
    errors = torch.tensor([math.log(z / 1.02) / s for z, s in found])
    assert 0.75 < float(errors.square().mean().sqrt()) < 1.3


def test_little_evidence_stays_at_the_prior():
    """People in the middle of the image: z hardly matters there."""
    some = sightings(1.05, noise=0.05)
    near = dataclasses.replace(
        some, drawn=some.drawn / 100, seen=some.seen - 1.05 * some.drawn * 0.99
    )
    found, spread = fit_zoom(near, 0.03)
    assert abs(found - 1) < 0.005
    assert spread == pytest.approx(0.03, rel=0.1)


@pytest.mark.parametrize("shift", [(3.0, -2.0), (0.5, 1.5), (0.0, 0.0)])
def test_a_picture_is_moved_onto_its_mask(shift):
    y, x = torch.meshgrid(torch.arange(60.0), torch.arange(80.0), indexing="ij")

    def disc(dx, dy):
        return (12.5 - ((x - 40 - dx) ** 2 + ((y - 30 - dy) / 1.3) ** 2).sqrt()).clamp(0, 1)

    drawn, mask, known = (pad(p, [8] * 4) for p in (disc(0, 0), disc(*shift), torch.ones(60, 80)))
    found = best_shift(drawn, mask, known, 8, 0.5)
    assert found is not None
    assert found.tolist() == pytest.approx(shift, abs=0.3)
    assert best_shift(drawn, mask * 0, known, 8, 0.5) is None
    assert best_shift(drawn, mask, known * 0, 8, 0.5) is None


def test_whoever_watches_is_told():
    steps: list[Step] = []
    true = film(WIDE[:1])
    find_focal(asked(true, masks_of(true)), LOOSE, steps.append)
    assert [step.stage for step in steps] == ["find_focal"]


def named(run):
    return [stage.name for stage in run.stages]


def test_the_whole_job_looks_for_it_only_when_told_to(small_room, tmp_path):
    """Without a spread the same people to the last bit, whatever else the settings say."""
    capture = add_noise(small_room, NoiseConfig(), 1)
    plain, other = Run(tmp_path / "plain"), Run(tmp_path / "other")
    crew = people_of(capture, ROBUST, plain)
    same = people_of(capture, dataclasses.replace(ROBUST, focal=FocalConfig(0.0, 9, 50)), other)
    assert "find_focal" not in named(plain) + named(other)
    assert records.fingerprint(crew) == records.fingerprint(same)
    assert torch.equal(crew.alignment.camera.K, capture.scene.camera.K)


def test_the_whole_job_goes_on_with_the_lens_that_was_found(small_room, tmp_path):
    capture = add_noise(small_room, NoiseConfig(), 1)
    wrong = zoomed(capture.scene.camera, 1.05)
    capture = dataclasses.replace(capture, scene=dataclasses.replace(capture.scene, camera=wrong))
    run = Run(tmp_path)
    crew = people_of(capture, VARIANTS["refined-focal"].config, run)
    assert named(run).index("find_focal") < named(run).index("find_depth")
    ratio = crew.alignment.camera.K / small_room.truth.camera.K
    assert float(ratio[0, 0]) == pytest.approx(1, abs=0.015)
    assert torch.equal(ratio[0, 0], ratio[1, 1])


def test_the_study_of_sensitivity_has_both_rows():
    ask = ask_of(StudyArgs("sensitivity", seeds="1000"), STUDIES["sensitivity"])
    jobs = STUDIES["sensitivity"].plan(ask)
    for name in ("robust", "refined-focal"):
        for rooms in ("rooms", "rooms+focal=0.025", "rooms+focal=0.05"):
            assert (rooms, name) in jobs


def test_what_was_found_is_kept_on_disk(tmp_path):
    found = Focal(1.03, 0.004, 80, ("focal length: +3.0 +- 0.4 % by the people",))
    records.save(found, tmp_path / "focal")
    assert dataclasses.asdict(records.load(Focal, tmp_path / "focal")) == dataclasses.asdict(found)
