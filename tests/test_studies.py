"""The paper's experiments: variants, shared stages, tables against hand-made results, commands."""

import csv
import json
import re
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from test_experiments import FEW, Ended, quick, trial

from mover.app.cli import run_command
from mover.core import records
from mover.core.errors import InputError
from mover.core.observe import Step
from mover.core.settings import check_settings
from mover.core.types import Room
from mover.energy.config import Adam
from mover.energy.terms.feet import FootContacts
from mover.geometry.camera import project, to_camera
from mover.pipeline.outcome import to_world
from mover.pipeline.presets import PRESETS
from mover.stages.camera.align_camera import AlignInputs, align_camera
from mover.stages.people.refine_bodies import RefinedBodies
from mover_bench.rooms.known import KnownRoom
from mover_bench.studies.args import StudyArgs
from mover_bench.studies.job import (
    DONE,
    ROOM,
    Job,
    held_camera,
    key_of,
    rebuild,
    spoilt,
    store_room,
)
from mover_bench.studies.measures import seen_from
from mover_bench.studies.queue import open_jobs, run_all
from mover_bench.studies.run import by_room
from mover_bench.studies.sets import CHANGES, EXACT, SETS, changed_set, set_named
from mover_bench.studies.study import STUDIES, ask_of, jobs_of, run_study
from mover_bench.studies.variants import (
    HUMAN,
    PARTS,
    TERMS,
    VARIANTS,
    Cut,
    Variant,
    frames_of,
    is_variant,
    variant_named,
    withheld,
)

SEEDS = "1000-1019"
SCENES = ("initial", "image", "full")


def scene(iou: float) -> dict[str, float]:
    """Metrics of a scene that follow from one number."""
    return {
        "iou3d": iou, "p2s": 1 - iou, "iou2d": 0.9, "non_collision": 0.99, "contact": 0.4,
        "contact_f1": iou / 2, "yaw_error": 0.1, "pitch_error": 0.01, "roll_error": 0.02,
        "ground_error": 0.03, "ground_penetration_frequency": 0.1,
        "ground_penetration_distance": 0.02, "pje": 0.2, "v2v": 0.2, "p_pje": 0.07, "p_v2v": 0.06,
    }  # fmt: skip


def noisy(seed: int) -> float:
    """What a room adds to every row."""
    return 0.01 * ((7 * seed) % 5)


class Table:
    """Answers every job with numbers that are known."""

    def __init__(self, **ious: float) -> None:
        self.ious, self.done = ious, list[tuple[str, int, str]]()

    def __call__(self, job: Job) -> Ended:
        self.done.append((job.rooms, job.seed, job.name))
        iou = self.ious.get(job.name.replace("-", "_"), 0.5) + noisy(job.seed)
        scenes = {"initial": scene(0.2), "image": scene(iou - 0.1), "full": scene(iou)}
        item = {"id": "chair_0", "category": "chair", "touched": True, "hidden": 0.0,
                "flipped": job.seed % 2 == 0, **scenes}  # fmt: skip
        turned = {**item, "id": "sofa_0", "category": "sofa", "touched": False,
                  "full": {**scenes["full"], "yaw_error": 3.0}}  # fmt: skip
        place = int(job.name[-1]) if job.name[-1].isdigit() else 0
        tree = {
            "set": job.rooms, "seed": job.seed, "name": job.name, "key": key_of(job),
            "version": "1", "sources": "s", "truth": scene(1.0), "objects": [item, turned],
            "frames": 100, "seconds": 20.0, "interactions": place, **scenes,
            "stages": [{"name": "place_objects", "seconds": 3.0}, {"name": "x", "seconds": 2.0}],
        }  # fmt: skip
        job.folder.mkdir(parents=True, exist_ok=True)
        (job.folder / DONE).write_text(json.dumps(tree))
        if job.name == ROOM:
            job.room.with_suffix(".json").write_text("{}")
        return Ended(0)


def lines_of(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def ablation(tmp_path_factory: pytest.TempPathFactory) -> tuple[StudyArgs, Path, Table]:
    """A study in which contact alone is better, depth alone as good, and no trust much worse."""
    args = StudyArgs("ablation", seeds=SEEDS, out=tmp_path_factory.mktemp("out"), workers=2)
    table = Table(contact=0.6, no_trust=0.3)
    return args, run_study(args, launch=table)[0], table


def test_every_job_of_an_ablation_is_done_once_after_its_room(ablation) -> None:
    _, _, table = ablation
    assert len(table.done) == len(set(table.done))
    names = {name for _, _, name in table.done}
    assert names >= {ROOM, "robust", "nobody", "frame-4", *TERMS, *PARTS}
    for seed in range(1000, 1020):
        mine = [name for _, s, name in table.done if s == seed]
        assert mine[0] == ROOM


def test_rows_are_marked_where_they_differ_from_robust(ablation) -> None:
    page = ablation[1].read_text()
    rows = {line.split("|")[1].strip(): line for line in page.splitlines() if line[:1] == "|"}
    first = page.split("Difference from")[0]
    line = next(x for x in first.splitlines() if x.startswith("| + contact |"))
    assert "0.620 ▲" in line
    assert "✓" in line
    assert "▲" not in rows["+ depth"]
    assert "▼" in rows["no trust"] or "-0.200" in rows["no trust"]
    assert "| the truth itself |" in page
    assert "*MOVER, camera, depth* (paper)" in page
    assert "0.393" in page


def test_the_file_of_numbers_has_intervals_and_commands(ablation) -> None:
    args, page, _ = ablation
    lines = lines_of(page.with_name("table.csv"))
    worse = next(x for x in lines if (x["row"], x["metric"]) == ("no trust", "iou3d"))
    assert float(worse["difference"]) == pytest.approx(-0.2)
    assert float(worse["difference_low"]) == pytest.approx(-0.2)
    assert float(worse["p_holm"]) < 0.05
    assert worse["mark"] == "worse"
    assert worse["rooms"] == "20"
    assert worse["command"] == f"mover experiment --set rooms --seeds {SEEDS} --presets no-trust"
    same = next(x for x in lines if (x["row"], x["metric"]) == ("no slide", "iou3d"))
    assert float(same["p"]) == 1
    assert same["mark"] == ""
    quoted = [x for x in lines if x["quoted"]]
    assert {x["command"] for x in quoted} == {""}
    assert {x["rooms"] for x in quoted} == {""}
    assert args.out / "studies" / "ablation" / "table.csv" == page.with_name("table.csv")


def test_a_second_pass_does_nothing_and_writes_the_same_bytes(ablation) -> None:
    args, page, _ = ablation
    before, again = page.read_bytes(), Table()
    assert run_study(args, launch=again)[0].read_bytes() == before
    assert again.done == []


def test_a_missing_job_is_done_again_with_its_room(ablation) -> None:
    args, _, _ = ablation
    (args.out / "rooms" / "1003" / "depth" / DONE).unlink()
    again = Table()
    run_study(args, launch=again)
    assert again.done == [("rooms", 1003, ROOM), ("rooms", 1003, "depth")]


def test_few_rooms_prove_nothing(tmp_path: Path) -> None:
    """Eight rooms agree by chance in one of 128 comparisons, and there are as many."""
    args = StudyArgs("ablation", seeds="1000-1007", out=tmp_path)
    page = run_study(args, launch=Table(no_trust=0.1))[0]
    assert {x["mark"] for x in lines_of(page.with_name("table.csv"))} == {""}


def test_a_failed_job_is_told(tmp_path: Path) -> None:
    class Broken(Table):
        def __call__(self, job: Job) -> Ended:
            if job.name != "depth":
                return super().__call__(job)
            job.folder.mkdir(parents=True)
            (job.folder / "log.txt").write_text("ValueError: not finite\n")
            return Ended(1)

    page = run_study(StudyArgs("ablation", seeds="1000", out=tmp_path), launch=Broken())[0]
    assert "**Failed**: rooms 1000, depth: ValueError: not finite" in page.read_text()


def test_looking_runs_nothing_and_says_what_is_missing(tmp_path: Path) -> None:
    asked, table = StudyArgs("camera", seeds="1000,1001", out=tmp_path), Table()
    jobs = [Job("rooms", 1000, name, tmp_path) for name in (ROOM, "robust")]
    done = list(run_all(jobs, 1, table, store=False))
    page = run_study(replace(asked, look=True), launch=table)[0].read_text()
    assert [(job.rooms, job.seed, job.name) for job in done] == table.done
    assert "**Not run**: 10 of 12 jobs" in page
    assert "| feet and objects (robust) |" in page


@pytest.mark.parametrize("name", [n for n in STUDIES if n != "sets"])
def test_every_study_has_a_page_with_its_command_and_plots(name: str, tmp_path: Path) -> None:
    args = StudyArgs(name, seeds="1000,1001", out=tmp_path)
    page = run_study(args, launch=Table())[0]
    text = page.read_text()
    assert f"    mover experiment study {name} --seeds 1000,1001\n" in text
    own = ("interactions", "upstream", "stability", "motion")  # the paper has no such table
    assert "(paper)" in text or name in own
    for plot in re.findall(r"!\[[^]]*\]\(([^)]*)\)", text):
        assert page.with_name(plot).read_text().startswith("<svg")
    for line in text.splitlines():
        if line.startswith("    mover experiment --set"):
            named = line.split("--presets ")[1].split()
            assert set(named) <= set(VARIANTS)


def test_stable_pieces_are_counted_and_those_that_fall_are_named(tmp_path: Path) -> None:
    def stood(job: Job) -> Ended:
        chair = {"stands": 1.0, "moved": 0.001, "stuck": 0.0}
        table = {"stands": 0.0, "moved": 0.04, "stuck": 0.098}
        items = [
            {"id": "chair_0", "category": "chair"} | dict.fromkeys(SCENES, chair),
            {"id": "table_0", "category": "table", "initial": table, "image": table,
             "full": table},
        ]  # fmt: skip
        means = {name: {"stands": 0.5} for name in (*SCENES, "truth")}
        ended = Table()(job)
        if job.name == ROOM:
            return ended
        tree = json.loads((job.folder / DONE).read_text())
        (job.folder / DONE).write_text(json.dumps(tree | means | {"objects": items}))
        return ended

    args = StudyArgs("stability", seeds="1000,1001", out=tmp_path)
    text = run_study(args, launch=stood)[0].read_text()
    assert "| robust | 2 / 4 | 50.0 |" in text
    assert "| 1001 table_0 | 40 | 98 |" in text
    assert "chair_0" not in text


def test_a_job_lets_gravity_act_on_what_it_rebuilt(tmp_path: Path) -> None:
    pytest.importorskip("mujoco", reason="needs the extra physics")
    store_room(Job("rooms", 0, ROOM, tmp_path), trial(), FEW)
    job = Job("rooms", 0, "stands", tmp_path)
    rebuild(job, Variant(quick(PRESETS["robust"]), simulated=True), FEW)
    tree = json.loads((job.folder / DONE).read_text())
    assert tree["truth"]["stands"] == 1
    for item in tree["objects"]:
        assert set(SCENES) <= set(item)
        for name in SCENES:
            found = item[name]
            expected = found["moved"] < 0.01 and found["turned"] < 0.0174533
            assert found["stands"] == expected


def test_the_study_of_all_sets_counts_turned_seats(tmp_path: Path) -> None:
    args = StudyArgs("sets", seeds="1000-1003", presets=("paper", "robust"), out=tmp_path)
    table = Table(paper=0.3, robust=0.7)
    text = run_study(args, launch=table)[0].read_text()
    assert {rooms for rooms, _, _ in table.done} == set(SETS)
    turned = text.split("## Turned seats recovered")[1]
    row = next(x for x in turned.splitlines() if x.startswith("| clutter |"))
    cells = [cell.strip() for cell in row.split("|")[2:-1]]
    assert cells == ["2 / 2", "4 / 4", "2 / 2", "4 / 4", "2 / 2", "2 / 4"]
    gains = text.split("## What people add")[1].split("##")[0]
    for who, more in {"first camera": "+0.200", "camera of the people": "+0.100"}.items():
        row = next(x for x in gains.splitlines() if x.startswith(f"| two, {who} |"))
        assert f"| {more} [{more}, {more}] |" in row


def test_noise_that_costs_is_a_share_of_the_clean_value(tmp_path: Path) -> None:
    class Worse(Table):
        def __call__(self, job: Job) -> Ended:
            self.ious = {"robust": 0.36 if job.rooms.endswith("scale=0.25") else 0.4}
            return super().__call__(job)

    args = StudyArgs("sensitivity", seeds="1000,1005", out=tmp_path)
    text = run_study(args, launch=Worse())[0].read_text()
    section = text.split("## Error in the size of objects")[1].split("##")[0]
    row = next(x for x in section.splitlines() if x.startswith("| 25 |"))
    assert "| 10.0 [10.0, 10.0] |" in row
    assert row.endswith("| 0.345 |")
    assert "mover experiment --set rooms+scale=0.25" in text


class TestQueue:
    def test_two_workers_take_two_rooms(self, tmp_path: Path) -> None:
        """A worker that is free goes on with a room that nobody works on."""
        jobs = [Job("rooms", s, n, tmp_path) for s in (0, 1) for n in (ROOM, "robust", "depth")]
        pairs, alive = [], list[Job]()

        class Slow(Ended):
            def __init__(self, job: Job) -> None:
                super().__init__(0)
                self.job, self.asked = job, 0
                alive.append(job)
                pairs.append({j.seed for j in alive})
                job.folder.mkdir(parents=True)

            def poll(self) -> int | None:
                self.asked += 1
                if self.asked < 2:
                    return None
                (self.job.folder / DONE).write_text("{}")
                alive.remove(self.job)
                return 0

        done = list(run_all(jobs, 2, Slow))
        assert sorted(done, key=str) == sorted(jobs, key=str)
        assert pairs[1::2] == [{0, 1}] * 3

    def test_stages_go_with_the_last_job_of_a_room(self, tmp_path: Path) -> None:
        jobs = [Job("rooms", 0, n, tmp_path) for n in (ROOM, "robust", "depth")]
        seen = []

        def launch(job: Job) -> Ended:
            (job.home / "stages").mkdir(parents=True, exist_ok=True)
            seen.append((job.home / "stages").exists())
            return Table()(job)

        for job in run_all(jobs, 1, launch, store=False):
            seen.append((job.home / "stages").exists())
        assert seen[-1] is False
        assert all(seen[:-1])
        assert not jobs[0].room.with_suffix(".json").exists()

    def test_a_finished_room_without_its_files_is_made_again(self, tmp_path: Path) -> None:
        jobs = [Job("rooms", 0, n, tmp_path) for n in (ROOM, "robust")]
        table = Table()
        list(run_all(jobs, 1, table, store=False))
        assert open_jobs(jobs, keep=False) == []
        (jobs[1].folder / DONE).unlink()
        assert open_jobs(jobs, keep=False) == jobs

    def test_jobs_of_a_room_stay_together(self, tmp_path: Path) -> None:
        jobs = [Job("rooms", s, n, tmp_path) for n in ("a", "b") for s in (3, 1)]
        assert [(j.seed, j.name) for j in by_room(jobs)] == [
            (3, "a"), (3, "b"), (1, "a"), (1, "b"),
        ]  # fmt: skip


class TestChanges:
    @pytest.mark.parametrize("kind", CHANGES)
    def test_a_change_leaves_rooms_and_all_other_errors(self, kind: str) -> None:
        base = SETS["rooms"]
        for level in CHANGES[kind].levels:
            found = set_named(changed_set("rooms", kind, level))
            assert found.room == base.room
            touched = (*CHANGES[kind].fields, *CHANGES[kind].without)
            back = {name: getattr(base.noise, name) for name in touched}
            assert replace(found.noise, **back) == base.noise
            assert all(getattr(found.noise, name) == level for name in CHANGES[kind].fields)

    def test_the_usual_size_of_an_error_is_the_set_itself(self) -> None:
        assert changed_set("rooms", "scale", 0.15) == "rooms"
        assert changed_set("rooms", "scale", 0.25) == "rooms+scale=0.25"

    @pytest.mark.parametrize("name", ["flats", "rooms+colour=1", "rooms+scale=big", "rooms+scale"])
    def test_other_names_are_refused(self, name: str) -> None:
        with pytest.raises(InputError, match="--set"):
            set_named(name)


class TestVariants:
    def test_each_differs_from_robust_in_one_thing(self) -> None:
        robust = VARIANTS["robust"]
        for name, variant in {**TERMS, **PARTS}.items():
            assert variant != robust, name
        plain = records.plain(robust.config)
        for name, variant in PARTS.items():
            other = records.plain(variant.config)
            changed = [key for key in plain if plain[key] != other[key]]
            both = ("no-distance", "no-walls", "paper-camera")
            assert len(changed) == 1 or name in both, name

    def test_presets_are_variants(self) -> None:
        assert {name: VARIANTS[name].config for name in PRESETS} == PRESETS


class TestWithheld:
    def test_a_segment_holds_its_seconds_and_nothing_else(self) -> None:
        capture = trial().capture
        bodies = replace(capture.bodies, fps=1.0)
        frames = frames_of(bodies, Cut(seconds=1.0, place=1.0))
        assert frames.tolist() == [int(bodies.frame.max())]
        part = withheld(replace(capture, bodies=bodies), "all", Cut(seconds=1.0, place=1.0))
        assert part.bodies.frame.unique().tolist() == frames.tolist()
        assert (part.bodies.verts == bodies.verts[torch_rows(bodies, frames)]).all()

    def test_a_segment_in_which_nobody_is_there_is_an_image_alone(self) -> None:
        capture = trial().capture
        last = int(capture.bodies.frame.max())
        gap = replace(capture.bodies, fps=1.0, frame=3 * capture.bodies.frame)
        late = withheld(replace(capture, bodies=gap), "all", Cut(seconds=1.0, place=1 / (3 * last)))
        assert late.bodies is None
        assert late.people is None

    def test_a_part_longer_than_the_video_is_all_of_it(self) -> None:
        bodies = trial().capture.bodies
        whole = bodies.frame.unique().tolist()
        for cut in (Cut(seconds=1e4), Cut(share=1.0)):
            assert frames_of(replace(bodies, fps=5.0), cut).tolist() == whole

    def test_nobody_touches_where_no_contact_is_told(self) -> None:
        part = withheld(trial().capture, "no contact", None)
        assert part.touch.shape == part.bodies.verts.shape[:2]
        assert not part.touch.any()

    def test_nobody_is_there_where_nobody_is_told(self) -> None:
        part = withheld(trial().capture, "nobody", None)
        assert part.bodies is None
        assert part.people is None


def torch_rows(bodies, frames):
    """Rows of some frames."""
    return [k for k, f in enumerate(bodies.frame.tolist()) if f in frames.tolist()]


def test_an_ablation_takes_the_stages_that_it_shares(tmp_path: Path) -> None:
    """Only what differs is computed: not the meshes, not the layout by the image."""
    config = quick(PRESETS["robust"])
    lean = replace(
        config, place=replace(config.place, weights=replace(config.place.weights, collision=0.0))
    )
    store_room(Job("rooms", 0, ROOM, tmp_path), trial(), FEW)
    stages = {}
    for name, variant in {"robust": Variant(config), "contact-depth": Variant(lean)}.items():
        job = Job("rooms", 0, name, tmp_path)
        rebuild(job, variant, FEW)
        found = json.loads((job.folder / DONE).read_text())["stages"]
        stages[name] = [(s["name"], s["kept"]) for s in found]
    names = [name for name, _ in stages["robust"]]
    for i, (name, kept) in enumerate(stages["robust"]):  # asked twice by one run: computed once
        assert kept == (name in ("find_image_cues", "find_contacts") and name in names[:i])
    again = dict(reversed(stages["contact-depth"]))
    assert [n for n, _ in stages["contact-depth"]] == [n for n, _ in stages["robust"]]
    assert again["prepare_objects"]
    assert again["gather_cues"]
    placed = [kept for name, kept in stages["contact-depth"] if name == "place_objects"]
    assert placed == [True, False]


def test_people_who_are_not_told_are_measured_all_the_same(tmp_path: Path) -> None:
    store_room(Job("rooms", 0, ROOM, tmp_path), trial(), FEW)
    job = Job("rooms", 0, "nobody", tmp_path)
    rebuild(job, Variant(quick(PRESETS["robust"]), "nobody"), FEW)
    tree = json.loads((job.folder / DONE).read_text())
    assert tree["full"]["pitch_error"] == tree["initial"]["pitch_error"]
    assert "contact_f1" in tree["full"]
    assert tree["frames"] == 0


def test_refined_people_change_what_is_measured_of_people_only(tmp_path: Path, monkeypatch) -> None:
    def sunk(room, _capture, _config):
        down = torch.tensor([0.0, -0.05, 0.0])
        n = len(room.bodies.verts)
        moved = replace(room.bodies, verts=room.bodies.verts + down)
        return RefinedBodies(moved, down.expand(n, 3), torch.zeros(n))

    monkeypatch.setattr("mover_bench.studies.job.refine_bodies", sunk)
    store_room(Job("rooms", 0, ROOM, tmp_path), trial(), FEW)
    plain = Variant(quick(PRESETS["robust"]))
    trees = []
    for name, variant in (("robust", plain), ("refined-people", replace(plain, refined=True))):
        job = Job("rooms", 0, name, tmp_path)
        rebuild(job, variant, FEW)
        trees.append(json.loads((job.folder / DONE).read_text()))
    before, after = (tree["full"] for tree in trees)
    assert before["iou3d"] == after["iou3d"]
    assert before["pitch_error"] == after["pitch_error"]
    assert before["ground_penetration_frequency"] < after["ground_penetration_frequency"] == 1


def test_the_true_room_is_measured_with_the_people_of_the_result(tmp_path: Path) -> None:
    store_room(Job("rooms", 0, ROOM, tmp_path), trial(), FEW)
    job = Job("rooms", 0, "robust", tmp_path)
    rebuild(job, Variant(quick(PRESETS["robust"])), FEW)
    tree = json.loads((job.folder / DONE).read_text())
    assert tree["true_room"]["iou3d"] == pytest.approx(1, abs=1e-4)
    assert tree["true_room"]["pitch_error"] == 0
    assert tree["true_room"]["contact_f1"] == 1  # this room has true people


def test_people_seen_from_another_camera_stay_in_their_pixels() -> None:
    known = trial()
    bodies = to_world(known.capture.bodies, known.capture.scene.camera)
    room = Room(
        known.capture.scene, known.capture.scene, known.capture.scene, bodies, None, (), (), None,
        {}, (),
    )  # fmt: skip
    true = known.truth.camera
    moved = seen_from(true, room)
    pixels = project(to_camera(moved.verts, true.R_cam_world), true.K)
    given = project(known.capture.bodies.verts, true.K)
    torch.testing.assert_close(pixels, given, atol=0.01, rtol=0)


@pytest.mark.parametrize(
    ("flags", "said"),
    [
        (["colours"], "study: 'colours' is none of ablation, camera"),
        (["ablation", "--set", "flats"], "--set: 'flats' is none of mini, rooms"),
        (["ablation", "--seeds", "x"], "--seeds: 'x'"),
        (["sets", "--presets", "paper"], "--presets: robust is missing"),
        (["sensitivity", "--set", "rooms+scale=0"], "is changed already"),
        (["paper", "--set", "rooms+exact=camera"], "is changed already"),
        (["ablation", "--set", "rooms+exact=light"], "'light' exact, expected some of camera"),
        (["sensitivity", "--errors", "size"], "--errors: 'size' is none of scale, place"),
        (["camera", "--errors", "scale"], "--errors: the study camera tries none"),
        (["paper", "--errors", "scale"], "--errors: 'scale' is none of camera, bodies"),
        (["camera", "--steps", "5"], "--steps: the study camera keeps"),
    ],
)
def test_the_command_names_what_it_does_not_know(flags, said, tmp_path, capsys) -> None:
    assert run_command("experiment", ["study", *flags, "--out", str(tmp_path)]) == 2
    assert said in capsys.readouterr().err


def test_what_is_exact_has_no_noise_and_all_else_stays() -> None:
    for name, zero in EXACT.items():
        noise, base = set_named(f"rooms+exact={name}").noise, SETS["rooms"].noise
        for field in vars(base):
            wanted = 0 if field in zero else getattr(base, field)
            assert getattr(noise, field) == wanted, (name, field)


def test_a_true_camera_is_held_and_true_contacts_are_given(small_room: KnownRoom) -> None:
    rooms = set_named("rooms+exact=camera,contacts")
    trial = spoilt(small_room, 3, rooms)
    capture, given = trial.capture, trial.capture.bodies
    true = small_room.truth.camera.R_cam_world
    assert torch.allclose(capture.scene.camera.R_cam_world, true, atol=1e-5)
    assert given is not None
    assert capture.touch is not None
    for row in (0, len(given.frame) - 1):
        same = (small_room.bodies.frame == given.frame[row]) & (
            small_room.bodies.person == given.person[row]
        )
        assert torch.equal(capture.touch[row], small_room.touching[same][0].float())
    config = held_camera(PRESETS["paper"])
    check_settings(config, "config")
    points = torch.tensor([[0.0, 2.0, 3.0], [1.0, 2.0, 4.0], [-1.0, 2.2, 5.0]]).double()
    feet = FootContacts(points, torch.zeros(3).long(), torch.arange(3), ())
    known = AlignInputs(feet, capture.scene.camera, None, capture.camera_height)
    found = align_camera(known, config.align)
    assert torch.allclose(found.camera.R_cam_world, true, atol=1e-5)
    assert found.ground == pytest.approx(small_room.truth.ground, abs=1e-6)


def test_people_of_the_paper_are_compared_with_its_first_stage(tmp_path: Path) -> None:
    args = StudyArgs("paper", seeds="1000-1007", out=tmp_path)
    page = run_study(args, launch=Table(paper=0.4, paper_contact=0.55, paper_depth=0.45))[0]
    text = page.read_text()
    gains = text.split("## What people add to IoU3D")[1]
    line = next(x for x in gains.splitlines() if x.startswith("| paper, all errors |"))
    assert [x.split()[0] for x in line.split("|")[2:7]] == [
        "+0.200", "+0.250", "+0.150", "+0.200", "+0.100",
    ]  # fmt: skip
    first = text.split("## paper, true camera\n")[0]
    assert "*MOVER, camera, depth* (paper)" in first
    assert "+exact=camera,bodies,contacts,masks" in text
    assert "| 1000 chair_0 | ✓ |" in text.split("## Object by object")[1]


def test_the_paper_is_asked_with_few_steps_about_some_errors(tmp_path: Path) -> None:
    table = Table()
    args = StudyArgs(
        "paper", seeds="5", presets=("paper",), errors=("camera", "bodies"), steps=7, out=tmp_path
    )
    page = run_study(args, launch=table)[0].read_text()
    sets = {rooms for rooms, _, _ in table.done}
    assert sets == {"rooms", *(f"rooms+exact={x}" for x in ("camera", "bodies", "camera,bodies"))}
    names = {name for _, _, name in table.done} - {ROOM}
    assert names == {"paper@7", *(f"paper-{x}@7" for x in ("nothing", *HUMAN))}
    assert all(variant_named(name).config.place.method == Adam(7) for name in names)
    assert "study paper --seeds 5 --presets paper --errors camera bodies --steps 7\n" in page
    assert [is_variant(n) for n in ("paper@7", "paper@x", "papers@7")] == [True, False, False]


def test_all_studies_share_one_queue(tmp_path: Path) -> None:
    table, steps = Table(), list[Step]()
    args = StudyArgs("all", seeds="1000", presets=("robust",), out=tmp_path)
    pages = run_study(args, steps.append, table)
    assert len(table.done) == len(set(table.done))
    assert [page.parent.name for page in pages] == list(STUDIES)
    assert steps[-1].index == steps[-1].steps - 1


def test_a_plan_has_the_room_of_every_job(tmp_path: Path) -> None:
    ask = ask_of(StudyArgs("sensitivity", seeds="5", out=tmp_path), STUDIES["sensitivity"])
    jobs = jobs_of(STUDIES["sensitivity"].plan(ask), ask, tmp_path)
    assert {j.rooms for j in jobs if j.name == ROOM} == {j.rooms for j in jobs}
    assert {j.seed for j in jobs} == {5}


def test_some_errors_by_themselves_have_their_jobs_and_a_page_of_their_own(tmp_path: Path) -> None:
    table = Table()
    args = StudyArgs("sensitivity", seeds="5", errors=("turn", "scale"), out=tmp_path)
    page = run_study(args, launch=table)[0]
    text = page.read_text()
    assert page.parent.name == "sensitivity-turn-scale"
    assert "mover experiment study sensitivity --seeds 5 --errors turn scale\n" in text
    heads = [line for line in text.splitlines() if line.startswith("## Error")]
    assert heads == ["## Error in the orientation of objects", "## Error in the size of objects"]
    kinds = {rooms.partition("+")[2].partition("=")[0] for rooms, _, _ in table.done}
    assert kinds == {"turn", "scale", ""}
