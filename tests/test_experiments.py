"""Experiments: jobs that resume, tables that add up, pictures of what failed."""

import csv
import json
import math
import shutil
from dataclasses import replace
from pathlib import Path

import judged
import little_room
import pytest
import torch
from pandas import DataFrame
from PIL import Image

from mover.app.cli import run_command
from mover.core import records
from mover.core.errors import InputError
from mover.core.observe import Step
from mover.core.types import Camera, Capture, Detection, Masks, Scene
from mover.energy.config import Adam
from mover.evaluate.evaluation import EvaluateConfig
from mover.geometry.camera import to_camera
from mover.geometry.placement import place_object
from mover.geometry.raster import first_hit
from mover.geometry.rle import encode, tight_box
from mover.pipeline.presets import PRESETS, Config
from mover_bench.studies import run, tables
from mover_bench.studies.args import ExperimentArgs
from mover_bench.studies.finished import Finished
from mover_bench.studies.job import DONE, ROOM, Job, rebuild, store_room
from mover_bench.studies.measures import Traits, Trial, hidden_shares
from mover_bench.studies.queue import start
from mover_bench.studies.run import parse_seeds, run_experiment, worst_objects
from mover_bench.studies.tables import fill_page, means
from mover_bench.studies.variants import Variant

FEW = EvaluateConfig(samples=200, bodies=2)


def true_scene() -> Scene:
    scene = little_room.room()
    pieces = [replace(p, annotation=i) for i, p in enumerate(scene.objects[:2])]
    return replace(scene, objects=tuple(pieces))


def small(camera: Camera) -> Camera:
    """The same view in a picture of a quarter of the size."""
    zoom = torch.tensor([0.25, 0.25, 1.0])
    return replace(camera, K=camera.K * zoom[:, None], width=160, height=90)


def detections(scene: Scene) -> tuple[Detection, ...]:
    """Each object alone in the image."""
    camera, found = scene.camera, []
    for index, piece in enumerate(scene.objects):
        mesh = place_object(piece)
        verts = to_camera(mesh.verts, camera.R_cam_world)
        mask = first_hit(verts, mesh.faces, camera.K, (camera.height, camera.width))[1] >= 0
        coded = Masks(camera.height, camera.width, (encode(mask),))
        found.append(Detection(index, piece.category, tight_box(mask), coded, 1.0))
    return tuple(found)


def trial(shift: float = 0.2) -> Trial:
    """Two boxes whose guess is off, and a person who stands in front of a wrong camera."""
    truth = true_scene()
    truth = replace(truth, camera=small(truth.camera))
    guess = tuple(
        replace(p, t_world_object=p.t_world_object + torch.tensor([shift, 0.0, -shift]))
        for p in truth.objects
    )
    initial = Scene(small(little_room.camera(-0.25, 0.02)), None, guess)
    people = records.map_tensors(
        lambda x: x.float() if x.is_floating_point() else x, judged.people(2)
    )
    R = truth.camera.R_cam_world
    shown = replace(
        people,
        verts=to_camera(people.verts, R),
        joints=to_camera(people.joints, R),
        space="camera",
    )
    capture = Capture(
        "two boxes", initial, None, detections(truth), None, None, shown, None, None, ()
    )
    traits = tuple(Traits(p.id, p.category, i == 0, 0.5 * i) for i, p in enumerate(truth.objects))
    return Trial(capture, truth, shown, traits)


def quick(config: Config) -> Config:
    """The same settings with hardly any work."""
    few = Adam(2)
    return replace(
        config,
        image=replace(config.image, size=32),
        layout=replace(
            config.layout, method=few, first=Adam(0), short=Adam(0), yaws=1, num_hypotheses=1
        ),
        place=replace(config.place, method=few, first=Adam(0)),
        refine=replace(config.refine, rounds=0),
        gather=replace(config.gather, cells=16, workers=1),
        prepare=replace(config.prepare, cells=16, samples=100),
        correct_depth=False,
        outer_iterations=0,
    )


class Ended:
    """A job that was done at once."""

    def __init__(self, code: int) -> None:
        self.code = code

    def poll(self) -> int | None:
        return self.code

    def terminate(self) -> None:
        raise AssertionError("it has ended")


class Bench:
    """Does jobs in this process with hand-made numbers and remembers which."""

    def __init__(self, broken: tuple[tuple[int, str], ...] = ()) -> None:
        self.broken, self.done = set(broken), list[tuple[int, str]]()

    def __call__(self, job: Job) -> Ended:
        self.done.append((job.seed, job.name))
        job.folder.mkdir(parents=True, exist_ok=True)
        if (job.seed, job.name) in self.broken:
            (job.folder / "log.txt").write_text("Traceback\n  ...\nValueError: not finite\n")
            return Ended(1)
        if job.name == ROOM:
            store_room(job, trial(0.1 * (job.seed + 1)), FEW)
        else:
            self.measured(job)
        return Ended(0)

    def measured(self, job: Job) -> None:
        rebuild(job, Variant(quick(PRESETS[job.name])), FEW)


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> tuple[ExperimentArgs, list[Step], Bench]:
    """Two rooms, one preset."""
    args = ExperimentArgs("0,1", ("robust", "paper"), tmp_path_factory.mktemp("out"), 2)
    steps, bench = list[Step](), Bench()
    run_experiment(args, steps.append, bench)
    return args, steps, bench


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


class TestSeeds:
    def test_ranges_and_numbers_are_joined_in_order(self) -> None:
        assert parse_seeds("7,0-2, 2-3") == (0, 1, 2, 3, 7)

    @pytest.mark.parametrize("text", ["", "a", "3-1", "1-", "-2", "1..3", "1,,2", "²"])
    def test_anything_else_is_refused(self, text: str) -> None:
        with pytest.raises(InputError, match="--seeds"):
            parse_seeds(text)


def test_every_job_is_done_once_and_rooms_come_before_their_presets(finished) -> None:
    _, steps, bench = finished
    assert sorted(bench.done) == sorted(
        (seed, name) for seed in (0, 1) for name in (ROOM, "paper", "robust")
    )
    for seed in (0, 1):
        assert bench.done.index((seed, ROOM)) < min(
            bench.done.index((seed, name)) for name in ("paper", "robust")
        )
    assert [step.index for step in steps] == list(range(6))
    assert {step.steps for step in steps} == {6}


def test_a_second_pass_does_nothing_and_writes_the_same_bytes(finished) -> None:
    args, _, _ = finished
    names = ("results.csv", "summary.csv", "summary.md", "worst_1.png", "worst_3.png")
    before = {name: (args.out / "rooms" / name).read_bytes() for name in names}
    again = Bench()
    run_experiment(args, launch=again)
    assert again.done == []
    assert {name: (args.out / "rooms" / name).read_bytes() for name in names} == before


def test_results_hold_every_object_of_every_stage(finished) -> None:
    args, _, _ = finished
    rows = rows_of(args.out / "rooms" / "results.csv")
    found = {(r["seed"], r["preset"], r["stage"], r["object"]) for r in rows}
    stages = [("", "initial"), *((p, s) for p in ("paper", "robust") for s in ("image", "full"))]
    assert found == {
        (seed, *stage, name) for seed in "01" for stage in stages for name in ("chair_0", "sofa_0")
    }
    assert len(rows) == len(found)
    assert {(r["object"], r["touched"], r["hidden"]) for r in rows} == {
        ("chair_0", "True", "0"), ("sofa_0", "False", "0.5"),
    }  # fmt: skip


def test_means_of_the_summary_are_those_of_the_results(finished) -> None:
    args, _, _ = finished
    rows = rows_of(args.out / "rooms" / "results.csv")
    for line in rows_of(args.out / "rooms" / "summary.csv"):
        if line["over"] not in ("objects", "rooms", "hidden objects"):
            continue
        mine = [
            float(r["iou3d"])
            for r in rows
            if (r["preset"], r["stage"]) == (line["preset"], line["stage"])
            and (line["over"] != "hidden objects" or float(r["hidden"]) >= 0.3)
        ]
        assert math.isclose(float(line["iou3d"]), sum(mine) / len(mine), abs_tol=2e-6)


def test_the_initial_row_is_the_truth_moved_by_the_noise(finished) -> None:
    args, _, _ = finished
    for row in rows_of(args.out / "rooms" / "results.csv"):
        if row["stage"] == "initial":
            shift = 0.1 * (int(row["seed"]) + 1) * math.sqrt(2)
            assert float(row["center_error"]) == pytest.approx(shift, abs=1e-4)
            assert float(row["size_error"]) == pytest.approx(0, abs=1e-5)


def test_presets_that_measure_something_else_have_rows_without_places() -> None:
    """`--presets stands` measures what gravity does."""
    rows = DataFrame(
        {"preset": ["stands"] * 2, "stage": ["full"] * 2, "object": ["a", "b"], "moved": [0.1, 0.2]}
    )
    found = means("objects", rows)
    assert found["count"].tolist() == [2]
    assert found[["turned", "bad"]].sum().tolist() == [0, 0]
    assert found[["iou3d", "yaw_error"]].isna().all(axis=None)
    done = Finished(rows, rows.assign(name="stands"))
    experiment = tables.Experiment("mover", "rooms", ("stands",), (0,), done, {})
    assert len(worst_objects(experiment, 3)) == 0


def test_stage_1_and_full_share_camera_and_ground(finished) -> None:
    args, _, _ = finished
    tree = json.loads((args.out / "rooms" / "0" / "paper" / DONE).read_text())
    for name in ("pitch_error", "roll_error", "ground_error"):
        assert tree["image"][name] == tree["full"][name]
    assert tree["image"]["iou3d"] != tree["full"]["iou3d"]
    assert not (args.out / "rooms" / "0" / "paper" / "stages").exists()


def test_pictures_show_the_worst_objects_of_the_last_preset(finished) -> None:
    args, _, _ = finished
    page = (args.out / "rooms" / "summary.md").read_text()
    for place in (1, 2, 3):
        name = f"worst_{place}.png"
        assert f"({name})" in page
        with Image.open(args.out / "rooms" / name) as picture:
            assert len(picture.convert("L").getcolors()) > 20
    assert "mover experiment --set rooms --seeds 0,1 --presets robust paper" in page
    assert "2 of 2 rooms, 4 objects: 2 touched" in page


def test_pictures_of_rooms_that_a_study_did_not_keep_are_the_same(finished, tmp_path, monkeypatch):
    args = replace(finished[0], out=tmp_path / "out")
    shutil.copytree(finished[0].out, args.out)
    jobs = {seed: Job("rooms", seed, ROOM, args.out) for seed in (0, 1)}
    trials = {seed: records.load(Trial, job.room) for seed, job in jobs.items()}
    for job in jobs.values():
        for path in job.folder.glob("room.*"):
            path.unlink()
    monkeypatch.setattr(run, "noisy_room", lambda seed, _rooms: trials[seed])
    idle = Bench()
    run_experiment(args, launch=idle)
    assert idle.done == []
    for place in (1, 2, 3):
        name = f"rooms/worst_{place}.png"
        assert (args.out / name).read_bytes() == (finished[0].out / name).read_bytes()


@pytest.mark.slow
def test_a_failure_is_told_and_tried_again(finished, tmp_path: Path) -> None:
    args = replace(finished[0], out=tmp_path / "out")
    shutil.copytree(finished[0].out, args.out)
    folder = args.out / "rooms" / "1" / "paper"
    shutil.rmtree(folder)
    summary = run_experiment(args, launch=Bench(broken=((1, "paper"),)))
    assert json.loads((folder / "failure.json").read_text())["reason"] == "ValueError: not finite"
    assert "**Failed**: seed 1, paper: ValueError: not finite" in summary.read_text()
    assert "Only 3 of 4 runs ended" in summary.read_text()
    repaired = Bench()
    summary = run_experiment(args, launch=repaired)
    assert repaired.done == [(1, "paper")]
    assert summary.read_bytes() == (finished[0].out / "rooms" / "summary.md").read_bytes()
    assert not (folder / "failure.json").exists()


@pytest.mark.slow
def test_a_finished_job_of_other_sources_is_done_again_unless_kept(
    finished, tmp_path: Path
) -> None:
    args = replace(finished[0], out=tmp_path / "out")
    shutil.copytree(finished[0].out, args.out)
    path = args.out / "rooms" / "0" / "paper" / DONE
    path.write_text(json.dumps({**json.loads(path.read_text()), "key": "old", "sources": "old"}))
    kept, renewed = Bench(), Bench()
    summary = run_experiment(replace(args, keep=True), launch=kept)
    assert kept.done == []
    assert "Jobs of different versions are mixed" in summary.read_text()
    run_experiment(args, launch=renewed)
    assert renewed.done == [(0, "paper")]


def test_nothing_is_left_of_a_room_that_could_not_be_made(tmp_path: Path) -> None:
    job = Job("rooms", 0, ROOM, tmp_path)
    store_room(job, trial(), FEW)
    (job.folder / DONE).unlink()
    with pytest.raises(FileNotFoundError, match="seed 0"):
        rebuild(Job("rooms", 0, "paper", tmp_path), Variant(quick(PRESETS["paper"])), FEW)


def test_no_more_jobs_run_at_once_than_there_are_workers(tmp_path: Path) -> None:
    class Slow(Ended):
        """Ends when it is asked for the third time."""

        asked, alive, most = 0, 0, 0

        def __init__(self) -> None:
            super().__init__(1)
            Slow.alive += 1
            Slow.most = max(Slow.most, Slow.alive)

        def poll(self) -> int | None:
            self.asked += 1
            Slow.alive -= self.asked == 3
            return 1 if self.asked >= 3 else None

    run_experiment(ExperimentArgs("0-4", ("paper",), tmp_path, 3), launch=lambda _: Slow())
    assert Slow.most == 3
    assert Slow.alive == 0


def test_running_jobs_are_stopped_when_the_user_stops(tmp_path: Path) -> None:
    stopped = []

    class Endless(Ended):
        def poll(self) -> int | None:
            return None if self.code else -2

        def terminate(self) -> None:
            stopped.append(self.code)

    codes = iter((1, 0))
    args = ExperimentArgs("0,1", ("paper",), tmp_path, 2)
    with pytest.raises(KeyboardInterrupt):
        run_experiment(args, launch=lambda _: Endless(next(codes)))
    assert stopped == [1]
    assert not list(tmp_path.rglob("failure.json"))


@pytest.mark.slow
def test_a_job_is_a_process_whose_last_words_are_kept(tmp_path) -> None:
    job = Job("rooms", 0, "paper", tmp_path)
    process = start(job)
    assert process.wait() == 1
    said = (job.folder / "log.txt").read_text()
    assert said.strip().splitlines()[-1].startswith("FileNotFoundError: the room of seed 0")


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["--set", "flats"], "--set: 'flats' is none of mini, rooms"),
        (["--presets", "best"], "--presets: 'best' is none of paper, robust"),
        (["--seeds", "x"], "--seeds: 'x'"),
        (["--workers", "-1"], "--workers: has -1, expected a whole number from 0 to"),
    ],
)
def test_the_command_names_what_it_does_not_know(flags, said, tmp_path, capsys) -> None:
    assert run_command("experiment", [*flags, "--out", str(tmp_path)]) == 2
    assert said in capsys.readouterr().err


@pytest.mark.parametrize("words", [["--seeds", "0"], ["study", "camera"]])
def test_a_missing_extra_is_one_sentence_before_anything_runs(
    words, tmp_path, capsys, monkeypatch
) -> None:
    monkeypatch.setattr(tables, "find_spec", lambda name: None if name == "matplotlib" else name)
    assert run_command("experiment", [*words, "--out", str(tmp_path)]) == 2
    said = capsys.readouterr().err
    assert "matplotlib is not installed; pip install '.[bench]' in mover's folder" in said
    assert not list(tmp_path.iterdir())


def test_shares_that_others_hide_agree_with_a_plain_count() -> None:
    behind, before = true_scene().objects
    wall = little_room.piece("wall_0", little_room.box(4.0, 3.0, 0.1), (2.0, -2.0), 0.0, -1.5)
    scene = replace(true_scene(), objects=(behind, before, wall))
    camera = little_room.camera()
    zoom = torch.tensor([0.75, 0.75, 1.0])
    depths = []
    for piece in scene.objects:
        mesh = place_object(piece)
        verts = to_camera(mesh.verts, camera.R_cam_world)
        depths.append(first_hit(verts, mesh.faces, camera.K * zoom[:, None], (270, 480))[0])
    for index, share in enumerate(hidden_shares(scene)):
        mine = [(y, x) for y, x in depths[index].isfinite().nonzero().tolist()]
        lost = sum(any(float(d[at]) < float(depths[index][at]) for d in depths) for at in mine[::7])
        assert share == pytest.approx(lost / len(mine[::7]), abs=0.02)
    assert hidden_shares(scene)[0] > 0.4 > 0.1 > hidden_shares(scene)[2]


def test_what_nobody_can_see_is_hidden() -> None:
    scene = true_scene()
    lost = replace(scene.objects[0], t_world_object=torch.tensor([0.0, -1.5, 9.0]))
    assert hidden_shares(replace(scene, objects=(lost,))) == (1.0,)
    assert hidden_shares(replace(scene, objects=())) == ()


def test_means_leave_out_what_is_missing() -> None:
    rows = [
        {"object": "a", "iou3d": 0.2, "yaw_error": 1.0},
        {"object": "b", "iou3d": 0.4, "p2s": 0.1, "yaw_error": 0.1},
        {"object": "c", "iou3d": 0.0},
    ]
    found = means("objects", DataFrame(rows).assign(preset="", stage="full")).iloc[0]
    assert found["iou3d"] == pytest.approx(0.2)
    assert found["p2s"] == pytest.approx(0.1)
    assert found["yaw_error"] == pytest.approx(0.55)
    assert (found["turned"], found["bad"]) == (1, 2)


def test_the_page_speaks_of_centimetres_and_degrees() -> None:
    values = {"iou3d": 0.5, "p2s": 0.123, "pitch_error": math.radians(0.25), "ground_error": 0.02}
    line = {"over": "rooms", "preset": "paper", "stage": "full", "count": 2, **values}
    page = fill_page("mover experiment", "", DataFrame([line]), [])
    head, row = (
        [cell.strip() for cell in line.split("|")[1:-1]]
        for line in page.splitlines()
        if line.startswith("|") and ("IoU3D ↑" in line or "paper, Full |" in line)
    )
    cells = dict(zip(head, row, strict=True))
    assert cells["IoU3D ↑"] == "0.500"
    assert cells["P2S [cm] ↓"] == "12.3"
    assert cells["pitch [°] ↓"] == "0.25"
    assert cells["ground [cm] ↓"] == "2.0"
    assert cells["yaw [°] ↓"] == "-"
    assert cells["rooms"] == "2"
