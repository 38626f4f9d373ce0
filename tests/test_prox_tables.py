"""`mover paper-table` end to end: every row, from files in the layout of PROX and of PiGraphs."""

import re
import traceback
from collections.abc import Iterator
from dataclasses import replace

import make_prox
import make_scenes as layouts
import numpy as np
import pytest
from test_experiment import quick, rows_of
from test_import_datasets import prox_room
from test_import_scenes import imported
from test_import_scenes import plain as plain  # the fixture

from mover.pipeline.presets import PRESETS
from mover_bench.cli import TableArgs
from mover_bench.datasets.pigraphs import NAMES
from mover_bench.experiment import paper_job
from mover_bench.experiment import paper_job as rows
from mover_bench.experiment.job import Jobs
from mover_bench.experiment.paper_job import TABLES, TableJob, do_job
from mover_bench.experiment.paper_table import asked, paper_table
from mover_bench.rooms.known import KnownRoom

STILLS = ("vicon_03301_01", "vicon_03301_02")
VIDEOS = ("MPH8_00034_01", "MPH8_00035_02")
pytestmark = pytest.mark.long


def chosen_rows(room: KnownRoom, action: str, count: int) -> list[int]:
    """Rows that do something, spread over the video."""
    wanted = [k for k, name in enumerate(room.actions) if name == action]
    return wanted[:: max(1, len(wanted) // count)][:count]


@pytest.fixture(scope="module")
def captures(plain, small_room, tmp_path_factory):
    """Captures of a user's copy: two recordings of the quantitative room, two of another one.

    The fits are the truth, as MoSh's bodies are.
    """
    room, root = prox_room(plain), tmp_path_factory.mktemp("prox")
    models = make_prox.write_body_model(tmp_path_factory.mktemp("models"))
    walks, sits = (chosen_rows(small_room, action, 3) for action in ("walk", "sit"))
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MOVER_BODY_MODELS", str(models))
        for name in STILLS:
            fits = ["fittings/PROX", "fittings/mosh"]
            make_prox.write_recording(root, room, name, small_room, [*walks, *sits], fits)
        for name in VIDEOS:
            make_prox.write_recording(root, room, name, small_room, sits, ["PROXD"])
        world = (root / "cam2world" / "vicon.json").read_text()
        (root / "vicon2scene.json").write_text(world)  # MoSh's bodies are where the fits are
        furniture = make_prox.write_furniture(root / "total3d", room)
        masks = make_prox.write_object_masks(root / "masks.json", room, small_room)
        out = tmp_path_factory.mktemp("captures")
        boxes = root / "boxes" / "bbox3d.json"
        for name, recordings in (("vicon_03301", STILLS), (VIDEOS[0], VIDEOS)):
            work = tmp_path_factory.mktemp("work")
            imported("prox", root, out / name, work, recordings=recordings, boxes=boxes)
            imported("total3d", furniture, out / name, work)
            imported("masks", masks, out / name, work)
        yield out


def at_once(module: str, jobs: Jobs, workers: int) -> Iterator[int]:
    """Do jobs here; a traceback is the log of one."""
    del module, workers
    for index, (words, log) in enumerate(jobs):
        log.parent.mkdir(parents=True, exist_ok=True)
        try:
            do_job(TableJob.of(words))
        except Exception:
            log.write_text(traceback.format_exc())
        yield index


def made(args: TableArgs, patch: pytest.MonkeyPatch) -> dict[tuple[str, str], dict[str, str]]:
    """The numbers of a table by part and row."""
    for preset, config in PRESETS.items():
        patch.setitem(PRESETS, preset, quick(config))
    patch.setattr(rows, "SEGMENTS", 3)  # the middle one lies between the two videos
    patch.setattr(paper_job, "BOXES", replace(paper_job.BOXES, samples=500))
    page = paper_table(args, pool=at_once).read_text()
    assert "Failed" not in page
    assert "Not run" not in page
    lines = rows_of(args.results / f"{args.table}-paper.csv")
    return {(line["table"], line["row"]): line for line in lines}


def kinds(name: str) -> tuple[str, ...]:
    """Rows of a table; of those of another length or level of noise, the first one."""
    every = [row.label for part in TABLES[name].parts for row in part.ours]
    return tuple({re.sub(r"[\d.]+", "#", label): label for label in reversed(every)}.values())


@pytest.mark.parametrize("name", ["prox", "prox-quantitative"])
def test_every_kind_of_row_is_made_from_the_files_of_prox(name, captures, tmp_path, monkeypatch):
    args = TableArgs(name, captures, tmp_path, "paper", captures, only=kinds(name))
    numbers = made(args, monkeypatch)
    for part in TABLES[name].parts:
        for row in asked(part, args):
            if row.job == "fits-RGB":  # the copy has fittings/PROX alone
                continue
            line = numbers[part.title, row.label]
            assert line["recordings"] == "1"
            lacking = [c for c in part.columns if not line.get(c)]
            whole = rows.STD in part.columns and row is rows.ABLATION_ROWS[-1]  # "-" in the paper
            assert lacking == ([rows.STD] if whole else []), (part.title, row.label)
    if name == "prox-quantitative":  # the fits are the truth: under a level camera they lean
        baseline, camgp = (numbers["People [mm]", row] for row in ("baseline", "+ CamGP"))
        assert float(baseline["p_pje"]) < 1
        assert float(camgp["pje"]) < 0.7 * float(baseline["pje"])
        assert float(numbers["People [mm]", "PROX, given fits"]["pje"]) < 1e-2


def kinect_joints(room: KnownRoom, wanted: list[int]) -> np.ndarray:
    """Joints (frames, 25, 3) of some rows under Kinect's names; tips of hands are at the wrists."""
    bodies = room.bodies
    known = list(bodies.joint_names)
    places = [
        known.index(name if name in known else f"{name.partition('_')[0]}_wrist") for name in NAMES
    ]
    return bodies.joints[wanted][:, places].double().numpy()


@pytest.fixture(scope="module")
def graphs(plain, small_room, tmp_path_factory):
    """Captures of two recordings of PiGraphs, one of them mirrored as Kinect's pictures are."""
    room, root = prox_room(plain), tmp_path_factory.mktemp("pigraphs")
    rows_ = [k for act in ("walk", "sit") for k in chosen_rows(small_room, act, 3)]
    joints = kinect_joints(small_room, rows_)
    furniture = make_prox.write_furniture(root / "total3d", room)
    masks = make_prox.write_object_masks(root / "masks.json", room, small_room)
    out = tmp_path_factory.mktemp("captures")
    for name, mirror in (("roomA_anna_1", False), ("roomB_bert_1", True)):
        copy, work = root / name, tmp_path_factory.mktemp("work")
        layouts.write_pigraphs(copy, room, name, joints, mirror=mirror)
        imported("pigraphs", copy, out / name, work, recording=name)
        imported("total3d", furniture, out / name, work)
        imported("masks", masks, out / name, work)
    return out


def test_every_row_is_made_from_the_files_of_pigraphs(graphs, tmp_path, monkeypatch):
    args = TableArgs("pigraphs", graphs, tmp_path, "paper", graphs)
    numbers = made(args, monkeypatch)
    (part,) = TABLES["pigraphs"].parts
    for row in asked(part, args):
        line = numbers[part.title, row.label]
        assert line["recordings"] == "2"
        assert [c for c in part.columns if not line.get(c)] == [], row.label
