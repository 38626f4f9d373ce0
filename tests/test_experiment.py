"""Experiments: rooms that resume, variants, tables that add up."""

import csv
import json
import math
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import judged
import little_room
import numpy as np
import pytest
import torch
from scipy.stats import bootstrap

from mover.app.batch import last_line
from mover.app.cli import run_command
from mover.app.report.tables import shown
from mover.core import records
from mover.core.errors import InputError
from mover.core.observe import Step
from mover.core.run import Run
from mover.core.types import Camera, Capture, Detection, Masks, Scene
from mover.energy.config import Adam
from mover.evaluate.evaluation import EvaluateConfig
from mover.geometry.camera import to_camera
from mover.geometry.placement import place_object
from mover.geometry.raster import first_hit
from mover.geometry.rle import encode, tight_box
from mover.pipeline.presets import PRESETS, Config
from mover.stages.people.refine_bodies import RefinedBodies
from mover_bench.cli import ExperimentArgs
from mover_bench.experiment import job
from mover_bench.experiment.job import Jobs, Judge, Trial, run_each, run_experiment
from mover_bench.experiment.tables import head_of, interval
from mover_bench.experiment.variants import (
    LISTS,
    VARIANTS,
    Cut,
    Variant,
    at_most,
    frames_of,
    names_in,
    withheld,
)
from mover_bench.rooms.config import CHANGES, SETS, changed, parse_seeds, set_named

FEW = EvaluateConfig(samples=200, bodies=2)
KNOWN = dict(VARIANTS)


def small(camera: Camera) -> Camera:
    """The same view in a picture of a quarter of the size."""
    zoom = torch.tensor([0.25, 0.25, 1.0])
    return replace(camera, K=camera.K * zoom[:, None], width=160, height=90)


def detections(scene: Scene) -> tuple[Detection, ...]:
    """Each object by itself in the image."""
    camera, found = scene.camera, []
    for index, thing in enumerate(scene.objects):
        mesh = place_object(thing)
        verts = to_camera(mesh.verts, camera.R_cam_world)
        mask = first_hit(verts, mesh.faces, camera.K, (camera.height, camera.width))[1] >= 0
        coded = Masks(camera.height, camera.width, (encode(mask),))
        found.append(Detection(index, thing.category, tight_box(mask), coded, 1.0))
    return tuple(found)


def trial(shift: float = 0.2) -> Trial:
    """Two boxes whose initial positions are off, and a person in front of a wrong camera."""
    room = little_room.room()
    things = tuple(replace(p, annotation=i) for i, p in enumerate(room.objects[:2]))
    truth = replace(room, objects=things, camera=small(room.camera))
    first = tuple(
        replace(p, t_world_object=p.t_world_object + torch.tensor([shift, 0.0, -shift]))
        for p in truth.objects
    )
    initial = Scene(small(little_room.camera(-0.25, 0.02)), None, first)
    people = records.map_tensors(
        lambda x: x.float() if x.is_floating_point() else x, judged.people(2)
    )
    verts, joints = (to_camera(x, truth.camera.R_cam_world) for x in (people.verts, people.joints))
    shown = replace(people, verts=verts, joints=joints, space="camera")
    capture = Capture(
        "two boxes", initial, None, detections(truth), None, None, shown, None, None, ()
    )
    return Trial(capture, truth, shown, (True, False))


def quick(config: Config) -> Config:
    """The same settings with hardly any work."""
    few = Adam(2)
    return replace(
        config, correct_depth=False, outer_iterations=0, image=replace(config.image, size=32),
        layout=replace(config.layout, method=few, short=Adam(0), yaws=1, num_hypotheses=1),
        place=replace(config.place, method=few), refine=replace(config.refine, rounds=0),
        gather=replace(config.gather, cells=16),
        prepare=replace(config.prepare, cells=16, samples=100),
    )  # fmt: skip


class Here:
    """Does jobs in this process on hand-made rooms, and remembers which seeds."""

    def __init__(self) -> None:
        self.seeds: list[int] = []

    def __call__(self, module: str, jobs: Jobs, workers: int) -> Iterator[int]:
        del workers
        assert module == "mover_bench.experiment.job"
        for index, (words, _) in enumerate(jobs):
            self.seeds.append(int(words[1]))
            job.main(words)
            yield index


@pytest.fixture(scope="module")
def patched() -> Iterator[pytest.MonkeyPatch]:
    """Variants with hardly any work on the two boxes."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("robust", "paper", "no-people"):
            variant = VARIANTS[name]
            patch.setitem(VARIANTS, name, replace(variant, config=quick(variant.config)))
        patch.setattr(job, "true_room", lambda _seed, _rooms: None)
        patch.setattr(job, "with_noise", lambda _room, seed, _rooms: trial(0.1 * (seed + 1)))
        patch.setattr(job, "Judge", lambda one: Judge(one, FEW))
        yield patch


@pytest.fixture(scope="module")
def finished(tmp_path_factory, patched):
    """Two rooms, three variants."""
    del patched
    out = tmp_path_factory.mktemp("out")
    args = ExperimentArgs("0,1", ("robust", "paper", "no-people"), out, 2)
    steps, here = list[Step](), Here()
    run_experiment(args, steps.append, here)
    return args, steps, here


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def test_seeds_are_numbers_and_ranges_in_order_and_anything_else_is_refused() -> None:
    assert parse_seeds("7,0-2, 2-3") == (0, 1, 2, 3, 7)
    for text in ("", "a", "3-1", "1-", "-2", "1..3", "1,,2", "²"):
        with pytest.raises(InputError, match="--seeds"):
            parse_seeds(text)


def test_fewer_steps_are_another_result_and_bound_every_descent() -> None:
    rooms, paper = set_named("rooms"), VARIANTS["paper"]
    few = at_most(paper, 5)
    assert (few.config.layout.method.steps, few.config.place.method.steps) == (5, 5)
    assert at_most(paper, 0) == paper == at_most(paper, 10**6)
    assert job.key_of(rooms, 0, few) != job.key_of(rooms, 0, paper)


@pytest.mark.slow
def test_every_room_is_done_once_and_a_second_pass_does_nothing(finished) -> None:
    args, steps, here = finished
    assert here.seeds == [0, 1]
    assert [(step.index, step.steps) for step in steps] == [(0, 2), (1, 2)]
    names = ("results.csv", "summary.csv", "summary.md")
    before = {name: (args.out / "rooms" / name).read_bytes() for name in names}
    again = Here()
    run_experiment(args, pool=again)
    assert again.seeds == []
    assert {name: (args.out / "rooms" / name).read_bytes() for name in names} == before
    assert not list(args.out.rglob("stages"))


@pytest.mark.slow
def test_results_hold_every_object_of_every_stage_and_the_initial_row_is_moved_by_the_noise(
    finished,
) -> None:
    args, _, _ = finished
    rows = rows_of(args.out / "rooms" / "results.csv")
    found = {(r["seed"], r["name"], r["stage"], r["id"]) for r in rows}
    assert found == {
        (seed, name, stage, thing)
        for seed in "01"
        for name in args.variants
        for stage in ("initial", "image", "full")
        for thing in ("chair_0", "sofa_0")
    }
    assert len(rows) == len(found)
    assert {(r["id"], r["category"]) for r in rows} == {("chair_0", "chair"), ("sofa_0", "sofa")}
    for row in rows:
        if row["stage"] == "initial":
            shift = 0.1 * (int(row["seed"]) + 1) * math.sqrt(2)
            assert float(row["center_error"]) == pytest.approx(shift, abs=1e-4)


@pytest.mark.slow
def test_the_page_has_the_means_and_differences_of_the_files(finished) -> None:
    args, _, _ = finished
    page = (args.out / "rooms" / "summary.md").read_text()
    rows = rows_of(args.out / "rooms" / "summary.csv")

    def mean(name: str, stage: str) -> float:
        mine = [float(r["iou3d"]) for r in rows if (r["name"], r["stage"]) == (name, stage)]
        return sum(mine) / len(mine)

    table = page.split("## Mean over rooms")[1].split("##")[0]
    head, _, *lines = [x for x in table.splitlines() if x.startswith("|")]
    assert "| iou3d ↑ |" in head
    assert "| p2s [cm] ↓ |" in head
    assert [line.split("|")[1].strip() for line in lines] == [
        "robust, initial", "robust, image", *args.variants,
    ]  # fmt: skip
    for line in lines:
        name, _, stage = line.split("|")[1].strip().partition(", ")
        assert float(line.split("|")[2]) == pytest.approx(mean(name, stage or "full"), abs=6e-4)
    gaps = page.split("## Difference from robust")[1].split("##")[0]
    paper = next(x for x in gaps.splitlines() if x.startswith("| paper |"))
    gap = mean("paper", "full") - mean("robust", "full")
    shown = paper.split("|")[2].split("(")[0].replace("\N{MINUS SIGN}", "-")
    assert float(shown) == pytest.approx(gap, abs=6e-4)
    assert "mover experiment --set rooms --seeds 0,1 --variants robust paper no-people" in page


@pytest.mark.slow
def test_stages_share_a_camera_and_people_who_are_withheld_are_measured_all_the_same(finished):
    paper, alone = (
        json.loads((finished[0].out / "rooms" / "0" / f"{name}.json").read_text())
        for name in ("paper", "no-people")
    )
    for name in ("pitch_error", "roll_error"):
        assert paper["image"][name] == paper["full"][name]
    assert paper["image"]["iou3d"] != paper["full"]["iou3d"]
    assert alone["full"]["pitch_error"] == alone["initial"]["pitch_error"]
    assert "contact_f1" in alone["full"]


@pytest.mark.slow
def test_a_variant_that_fails_is_named_and_done_again_by_the_next_pass(patched, tmp_path):
    args = ExperimentArgs("0", ("robust", "paper"), tmp_path)
    with patched.context() as patch:
        good = job.measured
        patch.setattr(
            job, "measured",
            lambda *a: 1 / 0 if a[2] == VARIANTS["robust"] else good(*a),
        )  # fmt: skip
        page = run_experiment(args, pool=Here()).read_text()
    assert "**Failed**: seed 0, robust: ZeroDivisionError: division by zero" in page
    assert "| paper |" in page
    again = Here()
    assert "Failed" not in run_experiment(args, pool=again).read_text()
    assert again.seeds == [0]


@pytest.mark.slow
@pytest.mark.usefixtures("patched")
def test_a_result_of_other_sources_is_done_again(finished, tmp_path) -> None:
    args = replace(finished[0], out=tmp_path, seeds="0", variants=("robust",))
    path = tmp_path / "rooms" / "0" / "robust.json"
    path.parent.mkdir(parents=True)
    tree = json.loads((finished[0].out / "rooms" / "0" / "robust.json").read_text())
    for key, done in ((tree["key"], []), ("old", [0])):
        path.write_text(json.dumps({**tree, "key": key}))
        here = Here()
        run_experiment(args, pool=here)
        assert here.seeds == done


@pytest.mark.slow
def test_refined_people_change_what_is_measured_of_people_only(tmp_path, monkeypatch) -> None:
    def sunk(room, _capture, _config):
        down = torch.tensor([0.0, -0.05, 0.0])
        n = len(room.bodies.verts)
        lower = replace(room.bodies, verts=room.bodies.verts + down)
        return RefinedBodies(lower, down.expand(n, 3), torch.zeros(n))

    monkeypatch.setattr(job, "refine_bodies", sunk)
    one = trial()
    plain, judge = Variant(quick(PRESETS["robust"])), Judge(one, FEW)
    before, after = (
        job.measured(one, judge, replace(plain, refined=refined), Run(tmp_path))["full"]
        for refined in (False, True)
    )
    assert before["iou3d"] == after["iou3d"]
    assert before["pitch_error"] == after["pitch_error"]
    assert before["ground_penetration_frequency"] < after["ground_penetration_frequency"] == 1


class TestPool:
    def test_a_job_is_a_process_whose_last_words_are_kept(self, tmp_path: Path) -> None:
        jobs = [((str(k),), tmp_path / f"{k}.txt") for k in range(3)]
        assert sorted(run_each("no_such_module", jobs, 2)) == [0, 1, 2]
        assert "No module named no_such_module" in last_line(jobs[2][1])
        assert last_line(tmp_path / "none.txt") == "it said nothing"

    def test_what_runs_is_ended_when_the_user_stops(self, tmp_path: Path, monkeypatch) -> None:
        (tmp_path / "endless.py").write_text(
            "import sys, time\nprint(sys.argv[1], flush=True)\ntime.sleep(60 * int(sys.argv[1]))\n"
        )
        monkeypatch.setenv("PYTHONPATH", str(tmp_path))
        jobs = [((word,), tmp_path / f"{k}.txt") for k, word in enumerate(("1", "0", "1"))]
        ended = run_each("endless", jobs, 2)
        assert next(ended) == 1
        ended.close()  # returns at once only if the minute is not waited for


@pytest.mark.parametrize(("flags", "said"), [
    (["--set", "flats"], "--set: 'flats' is none of mini, rooms"),
    (["--variants", "best"], "--variants: 'best' is none of ablation, terms"),
    (["--seeds", "x"], "--seeds: 'x'"),
    (["--workers", "-1"], "--workers: has -1, expected a whole number from 0 to"),
])  # fmt: skip
def test_the_command_names_what_it_does_not_know(flags, said, tmp_path, capsys) -> None:
    assert run_command("experiment", [*flags, "--out", str(tmp_path)]) == 2
    assert said in capsys.readouterr().err


def test_a_missing_extra_is_one_sentence_before_anything_runs(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(job, "find_spec", lambda _: None)
    assert run_command("experiment", ["--seeds", "0", "--out", str(tmp_path)]) == 2
    said = capsys.readouterr().err
    assert "pandas is not installed; pip install -e '.[bench]' in mover's folder" in said
    assert not list(tmp_path.iterdir())


class TestVariants:
    def test_lists_hold_different_settings_and_parts_differ_from_robust_in_one(self) -> None:
        assert {name: KNOWN[name].config for name in PRESETS} == PRESETS
        for name, some in LISTS.items():
            shown = {records.fingerprint(replace(variant, row="")) for variant in some.values()}
            assert len(shown) == len(some), name
        plain = records.plain(KNOWN["robust"].config)
        for name, variant in LISTS["parts"].items():
            other = records.plain(variant.config)
            changes = [key for key in plain if plain[key] != other[key]]
            both = name in ("no-walls", "no-given")
            assert len(changes) == (0 if name == "robust" else 1 + both), name

    def test_lists_and_names_are_joined_once_each(self) -> None:
        names = names_in(("paper", "ablation", "contact"))
        assert names[0] == "paper"
        assert len(names) == len(set(names)) == 1 + len(LISTS["ablation"])
        for name in ("depth", "contact-collision", "no-term", "frame-4"):
            assert name in names

    @pytest.mark.parametrize("kind", CHANGES)
    def test_a_change_leaves_rooms_and_all_other_errors(self, kind: str) -> None:
        base, error = SETS["rooms"], CHANGES[kind]
        for level in error.levels:
            found = changed(base, f"{kind}={level:g}")
            touched = [error.field, *([error.without] if error.without else [])]
            back = {name: getattr(base.noise, name) for name in touched}
            assert replace(found, noise=replace(found.noise, **back)) == base
            assert getattr(found.noise, error.field) == level
            assert not error.without or getattr(found.noise, error.without) == 0
        assert changed(base, "") == base


class TestWithheld:
    def test_a_segment_holds_its_seconds_and_nothing_else(self) -> None:
        capture = trial().capture
        bodies, cut = replace(capture.bodies, fps=1.0), Cut(seconds=1.0, start=1.0)
        frames = frames_of(bodies, cut).tolist()
        assert frames == [int(bodies.frame.max())]
        part = withheld(replace(capture, bodies=bodies), "all", cut)
        assert part.bodies.frame.unique().tolist() == frames
        rows = [k for k, f in enumerate(bodies.frame.tolist()) if f in frames]
        assert (part.bodies.verts == bodies.verts[rows]).all()

    def test_without_people_an_image_is_left(self) -> None:
        capture = trial().capture
        last = int(capture.bodies.frame.max())
        gap = replace(capture.bodies, fps=1.0, frame=3 * capture.bodies.frame)
        late = withheld(replace(capture, bodies=gap), "all", Cut(seconds=1.0, start=1 / (3 * last)))
        for part in (late, withheld(capture, "no people", None)):
            assert part.bodies is None
            assert part.people is None

    def test_a_part_longer_than_the_video_is_all_of_it_and_a_frame_is_one(self) -> None:
        bodies = trial().capture.bodies
        whole = bodies.frame.unique().tolist()
        assert frames_of(replace(bodies, fps=5.0), Cut(seconds=1e4)).tolist() == whole
        assert frames_of(bodies, Cut(start=1.0)).tolist() == whole[-1:]

    def test_people_touch_nothing_without_contact(self) -> None:
        part = withheld(trial().capture, "no contact", None)
        assert part.touch.shape == part.bodies.verts.shape[:2]
        assert not part.touch.any()


class TestTables:
    def test_columns_speak_of_centimetres_and_degrees(self) -> None:
        assert shown("m", 0.123, named=True) == "12.3\N{NO-BREAK SPACE}cm"
        assert shown("rad", math.radians(-0.25), named=True) == "\N{MINUS SIGN}0.25°"
        assert shown("m", math.nan) == shown("m", None) == "\N{EN DASH}"
        assert shown("", -1e-9, sign=True) == "+0.000"
        assert [head_of(n) for n in ("p2s", "iou3d", "contact")] == [
            "p2s [cm] ↓", "iou3d ↑", "contact [%]",
        ]  # fmt: skip

    def test_the_interval_is_that_of_another_library(self) -> None:
        values = np.random.default_rng(2).gamma(2.0, size=30)
        other = bootstrap(
            (values,), np.mean, n_resamples=20_000, method="percentile",
            rng=np.random.default_rng(3),
        ).confidence_interval  # fmt: skip
        found = interval(values)
        assert (found.low, found.high) == pytest.approx((other.low, other.high), abs=0.02)
        assert found.mean == pytest.approx(values.mean())

    def test_two_rooms_have_the_interval_that_one_can_count_and_none_is_refused(self) -> None:
        """Of (0, 1): mean 0, .5, 1 with chances 1/4, 1/2, 1/4."""
        found = interval([0.0, 1.0])
        assert (found.low, found.high, found.rooms) == (0, 1, 2)
        with pytest.raises(ValueError, match="at least 1"):
            interval([])
