"""The paper's tables on a user's own copy: rows, jobs, pages, and what a perfect result scores."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import make_people as made
import make_scenes as layouts
import numpy as np
import pytest
import torch
import trimesh
from test_experiment import rows_of as lines_of
from test_import_datasets import FIRST, SECOND, prox_room, write_stills
from test_import_scenes import imported
from test_import_scenes import plain as plain  # the fixture
from test_readers_people import Toy
from test_readers_people import models as models  # the fixture: the body that the fits are of

from mover.app.cli import run_command
from mover.bodies import BODY_MODELS
from mover.core.errors import InputError
from mover.core.records import rows_of
from mover.evaluate.bodies import feet_places, soles_of
from mover.io.capture.bodies_file import read_bodies
from mover.io.capture.folder import read_capture
from mover.io.capture.scene_file import read_scene
from mover_bench.cli import TableArgs
from mover_bench.experiment import paper_job as rows
from mover_bench.experiment.job import Jobs
from mover_bench.experiment.paper_job import (
    DONE,
    TABLES,
    TableJob,
    disturb,
    key_of,
    measure,
    named_contacts,
)
from mover_bench.experiment.paper_table import paper_table, planned
from mover_bench.rooms.known import KnownRoom


@pytest.fixture(scope="module")
def stood(plain: layouts.Room) -> layouts.Room:
    """The known room's furniture, and a low stage on which the people of the fits stand.

    Their soles are a millimetre in it and 5.5 cm above the floor.
    """
    R, room = made.camera_matrix(), prox_room(plain)
    lowest = float((made.person("smplx")["verts"] @ R)[..., 1].min(1)[0])
    ground = lowest - 0.055
    up = np.array([0, ground - room.ground, 0])
    lifted = [replace(thing, t=thing.t + up) for thing in room.things]
    box = trimesh.creation.box((1.15, 0.056, 0.7)).subdivide().subdivide()
    place = np.array([0.375, ground + 0.028, -4.05])
    stage = layouts.Thing("table_9", "table", box.vertices, box.faces, place, 0.0, np.ones(3))
    return layouts.Room(room.K, R, room.size, ground, [*lifted, stage])


@pytest.fixture(scope="module")
def copy(stood: layouts.Room, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Captures of a user's copy: the two recordings of the quantitative room as one capture."""
    stills = write_stills(tmp_path_factory.mktemp("quantitative"), stood)
    scene = (stills / "cam2world" / "vicon.json").read_text()
    (stills / "vicon2scene.json").write_text(scene)  # MoSh's bodies are where the fits are
    work = tmp_path_factory.mktemp("work")
    out = tmp_path_factory.mktemp("captures") / "vicon_03301"
    source = layouts.write_glb(work / "in.glb", stood)
    with pytest.MonkeyPatch.context() as patch:
        for name in made.COUNTS:
            patch.setitem(BODY_MODELS, name, lambda _, name=name: Toy(name))
        boxes = stills / "boxes" / "bbox3d.json"
        imported("prox", stills, out, work, recordings=(FIRST, SECOND), boxes=boxes)
        imported("glb", source, out, work)
    return out


@pytest.mark.slow
def test_a_perfect_result_scores_one_and_zero_in_every_column(copy, stood):
    """The truth is boxes and a scan; the result is the furniture itself where it stands.

    Who touches is in an object with a vertex (Cont.), so that NonCol is not quite 1: here by the
    few vertices of the soles that are a millimetre in the stage.
    """
    capture = read_capture(copy)
    truth = read_scene(copy / "truth" / "scene.json")
    by_id = {piece.id: piece for piece in truth.objects}
    pieces = []
    for thing in stood.things:
        box = next(p for p in by_id.values() if p.id.endswith(thing.name) or thing.name in p.id)
        verts = torch.from_numpy(thing.world).float()
        mesh = replace(box.mesh, verts=verts, faces=torch.from_numpy(thing.faces))
        zero = torch.zeros(3)
        pieces.append(
            replace(box, mesh=mesh, t_world_object=zero, yaw=torch.tensor(0.0), scale=zero + 1)
        )
    pieces = [_own_axes(piece, by_id[piece.id]) for piece in pieces]
    perfect = replace(truth, objects=tuple(pieces))
    people = read_bodies(copy / "truth" / "bodies.npz")
    found = measure(copy, capture, perfect, people)
    assert found["iou3d"] == pytest.approx(1, abs=2e-3)
    assert found["iou2d"] == pytest.approx(1, abs=1e-3)
    assert found["p2s"] == pytest.approx(0, abs=2e-3)
    assert found["contact"] == 1
    assert found["non_collision"] == pytest.approx(1, abs=5e-3)
    ground = ("ground_penetration_frequency", "ground_penetration_distance")
    for name in ("pitch_error", "roll_error", "pje", "v2v", "p_pje", "p_v2v", *ground):
        assert found[name] == pytest.approx(0, abs=1e-5), name
    shown = {column for part in TABLES["prox-quantitative"].parts for column in part.columns}
    shown |= {column for part in TABLES["prox"].parts for column in part.columns}
    shown -= {"mean_tilt", rows.STD}
    assert shown <= set(found)


def _own_axes(piece, box):
    """The same mesh with the yaw of its true box: a placed mesh keeps its vertices."""
    from mover.geometry.rotations import rot_y

    turn = rot_y(box.yaw)
    verts = (piece.mesh.verts - box.t_world_object) @ turn
    return replace(
        piece, mesh=replace(piece.mesh, verts=verts), yaw=box.yaw,
        t_world_object=box.t_world_object,
    )  # fmt: skip


class Answers:
    """Answers every job with numbers that are known."""

    seconds = 3600.0

    def __init__(self, broken: str = "") -> None:
        self.done: list[tuple[str, str]] = []
        self.broken = broken

    def __call__(self, module: str, jobs: Jobs, workers: int) -> Iterator[int]:
        del module, workers
        for index, (words, log) in enumerate(jobs):
            self.answer(TableJob.of(words), log)
            yield index

    def answer(self, job: TableJob, log: Path) -> None:
        self.done.append((job.capture.name, job.name))
        job.folder.mkdir(parents=True, exist_ok=True)
        if job.name == self.broken:
            log.write_text("Traceback\nValueError: no floor\n")
            return
        number = job.name.rpartition("-")[2]
        iou = 0.5 + (0.01 * (int(number) - 4.5) if job.name.startswith("length") else 0)
        scene = {"iou3d": iou, "p2s": 0.1, "iou2d": 0.8, "pitch_error": 0.02, "roll_error": 0.04,
                 "pje": 0.17, "v2v": 0.18}  # fmt: skip
        tree = {"key": key_of(job), "seconds": self.seconds, "full": scene, "image": scene,
                "initial": {"iou3d": 0.25}}  # fmt: skip
        (job.folder / DONE).write_text(json.dumps(tree))


def asked_for(tmp_path: Path, table: str, *names: str, **asked: Any) -> TableArgs:
    """A table of captures of these names, of which there is nothing but that they have a truth."""
    for name in names or ("vicon_03301",):
        (tmp_path / "c" / name / "truth").mkdir(parents=True)
        (tmp_path / "c" / name / "truth" / "scene.json").write_text("{}")
    return TableArgs(table, tmp_path / "c", tmp_path / "out", **asked)


@pytest.mark.parametrize("name", list(TABLES))
def test_every_table_makes_all_of_its_rows_once(name: str, tmp_path: Path) -> None:
    names = "MPH8_00034_01", "vicon_03301", "room_kitchen_1"
    args, answers = asked_for(tmp_path, name, *names, workers=2), Answers()
    page = paper_table(args, pool=answers).read_text()
    assert len(answers.done) == len(set(answers.done))
    wanted = {"prox": "MPH8_00034_01", "prox-quantitative": "vicon_03301"}
    assert {capture for capture, _ in answers.done} <= {
        wanted.get(name, "room_kitchen_1"),
        *(() if name != "pigraphs" else ("MPH8_00034_01",)),
    }
    for part in TABLES[name].parts:
        lines = page.split(f"## {part.title}")[1].split("\n## ")[0].splitlines()
        ours = [x for x in lines if x.startswith("| ") and "(paper)" not in x][2:]
        assert [x.split("|")[1].strip() for x in ours] == [
            row.label for row in part.ours if not row.detected and not row.job.startswith("fits-")
        ]
        assert sum("(paper)" in x for x in lines) == len(part.quoted)
    numbers = lines_of(args.results / f"{name}-robust.csv")
    full = next(x for x in numbers if x["row"] == "full")
    assert float(full["iou3d"]) == (50 if name == "pigraphs" else 0.5)
    again = Answers()
    paper_table(args, pool=again)
    assert again.done == []


@pytest.mark.parametrize(("table", "capture", "asked", "lines"), [
    ("prox-quantitative", "vicon_03301", {"only": ("baseline", "initial")}, [
        "| baseline | 170.0 | 180.0 |", "| initial | 0.250 |",
        "| *MOVER, +CamGP+SDF+Contact* (paper) | 174.4 | 178.3 |",
    ]),
    ("prox", "MPH8_00034_01", {"only": ("10 s",)}, [
        f"| 10 s | 0.500 | {np.std(0.01 * np.arange(10), ddof=1):.3f} | 1 |",
        "| *10 s* (paper) | 0.389 | 0.018 |",
    ]),
    ("prox", "MPH8_00034_01", {"only": ("initial", "full"), "detected": "c"}, [
        "| initial, detected | 0.250 |", "| *Total3D, PointRend* (paper) | 0.246 |",
    ]),
], ids=["people in millimetres", "spread of segments", "detected captures"])  # fmt: skip
def test_rows_that_are_asked_for_are_printed_as_the_paper_prints_them(
    table, capture, asked, lines, tmp_path
):
    if "detected" in asked:
        asked = {**asked, "detected": tmp_path / asked["detected"]}
    args = asked_for(tmp_path, table, capture, **asked)
    page = paper_table(args, pool=Answers()).read_text()
    for line in lines:
        assert line in page
    assert "+ depth" not in page


def test_what_other_jobs_need_is_done_first_and_the_given_scene_needs_no_job(tmp_path):
    args = asked_for(tmp_path, "prox-quantitative", "vicon_03301", "vicon_03301_b")
    (args.captures / "vicon_03301" / "fits").mkdir()
    (args.captures / "vicon_03301" / "fits" / "RGB.npz").touch()
    answers = Answers()
    page = paper_table(args, pool=answers)
    first = [name for _, name in answers.done[:4]]
    assert sorted(first) == ["full", "full", "people-baseline", "people-baseline"]
    assert ("vicon_03301", "fits-RGB") in answers.done
    assert ("vicon_03301_b", "fits-RGB") not in answers.done
    assert "| RGB, given fits | 170.0 | 180.0 |" in page.read_text()
    assert "PROX, given fits" not in page.read_text()


def test_the_plan_counts_jobs_and_takes_the_time_of_those_that_have_ended(tmp_path: Path) -> None:
    only = ("initial", "full")
    args = asked_for(tmp_path, "prox-quantitative", preset="paper", only=only)
    assert planned(args).startswith("2 jobs of 1 captures, 2 to do: about 0.1 h of one core")
    few = replace(args, steps=100)
    assert planned(few).startswith("2 jobs of 1 captures, 2 to do: about 0.0 h of one core")
    paper_table(args, pool=Answers())
    every = planned(replace(args, only=()))  # seven more hours, of jobs like `full`
    assert "10 jobs of 1 captures, 8 to do: about 8.0 h of one core (as the 2" in every


def test_fewer_steps_are_other_jobs_of_the_same_command_line(tmp_path: Path) -> None:
    job = TableJob(tmp_path, tmp_path / "out", "paper", "full", 50, "auto", "weights")
    assert TableJob.of(job.words) == job
    config = job.variant.config
    assert (config.layout.method.steps, config.place.method.steps) == (50, 50)
    assert key_of(job) != key_of(replace(job, steps=0))
    assert key_of(job) != key_of(replace(job, preset="robust"))
    assert key_of(job) == key_of(replace(job, device="cpu", vposer=""))
    people = replace(job, name="people-sdf")
    assert key_of(people) != key_of(replace(people, vposer=""))


@pytest.mark.slow
def test_feet_are_the_soles_that_posa_names_and_contacts_are_those_of_the_bodies(copy):
    capture = read_capture(copy)
    bodies = capture.bodies
    assert bodies is not None
    assert named_contacts(capture, bodies) is None
    some = rows_of(bodies, torch.tensor([2, 0]))
    soles = soles_of(some, capture.scene.camera)
    touch = torch.zeros(bodies.verts.shape[:2])
    touch[2, soles[0]] = 0.9
    known = replace(capture, touch=touch)
    named = named_contacts(known, some)
    assert torch.equal(named, touch[[2, 0]])
    feet = feet_places(some, capture.scene.camera, named)
    R = capture.scene.camera.R_cam_world
    torch.testing.assert_close(feet[:, 0], bodies.verts[2, soles[:1]] @ R)
    assert len(feet_places(some, capture.scene.camera)) > 1
    assert named_contacts(known, replace(bodies, frame=bodies.frame + 100)) is None


def test_a_job_that_fails_is_named_and_done_again(tmp_path: Path) -> None:
    args = asked_for(tmp_path, "prox-quantitative")
    page = paper_table(args, pool=Answers(broken="people-sdf")).read_text()
    assert "**Failed**: vicon_03301, people-sdf: ValueError: no floor" in page
    assert "| + CamGP + SDF | - | - | - | - | 0 |" in page
    again = Answers()
    paper_table(args, pool=again)
    assert again.done == [("vicon_03301", "people-sdf")]


def test_what_is_asked_wrongly_is_one_sentence(tmp_path: Path, capsys) -> None:
    args = asked_for(tmp_path, "prox")
    with pytest.raises(InputError, match="has no capture of PROX qualitative"):
        paper_table(args)
    words = ["prox-quantitative", str(args.captures), str(args.results), "--preset", "best"]
    assert run_command("paper-table", words) == 2
    assert "--preset: 'best' is none of paper, robust, printed" in capsys.readouterr().err


def test_noise_is_uniform_and_within_its_level(small_room: KnownRoom) -> None:
    scene = small_room.truth
    for kind, levels in rows.NOISES.items():
        level = levels[0]
        found = disturb(scene, f"{kind}={level:g}", torch.Generator().manual_seed(3))
        for a, b in zip(scene.objects, found.objects, strict=True):
            change = {
                "scale": b.scale / a.scale - 1,
                "place": b.t_world_object - a.t_world_object,
                "turn": (b.yaw - a.yaw).rad2deg()[None],
            }
            for name, value in change.items():
                assert float(value.abs().max()) <= (level if name == kind else 0) + 1e-4
            assert change[kind].abs().max() > 0
