"""The tables of an experiment: every object, the means, and a page that one can read."""

import os
import platform
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch

from mover import __version__
from mover.core.errors import InputError
from mover.core.files import replacing
from mover.core.records import plain
from mover.core.run import sources
from mover.evaluate.scene import HARM_METRICS, OBJECT_METRICS
from mover_bench.studies.compare import COLUMNS, Column, head_of, markdown, shown
from mover_bench.studies.finished import TRAITS, TURNED, Finished, Frame
from mover_bench.studies.job import STAGES, Job
from mover_bench.studies.sets import set_named

HIDDEN = 0.3  # share of an object that others hide, from which on it counts as hidden
CUT = 0.1  # share of an object that the border of the image cuts off, likewise
BAD = 0.25  # IoU3D below which an object is lost
ABOUT = ("seed", "preset", "stage", "object", *TRAITS)
SHOWN: dict[str, Column] = {
    **{
        n: COLUMNS[n]
        for n in (
            "iou3d",
            "p2s",
            "iou2d",
            "yaw_error",
            "yaw_error_symmetric",
            "center_error",
            "size_error",
            "worse_by_10cm",
            "worse_by_50cm",
            "iou3d_aligned",
        )
    },
    "contact_f1": COLUMNS["contact_f1"],
    "non_collision": Column("non-collision"),
    "contact": Column("contact"),
    "penetration_depth": Column("penetration", -1, "cm", 100, 1),
    "pitch_error": COLUMNS["pitch_error"],
    "roll_error": COLUMNS["roll_error"],
    "ground_error": Column("ground", -1, "cm", 100, 1),
}
"""Metrics of the tables, in their order."""
FEW = tuple(SHOWN)[:9]
"""Metrics of objects."""
COUNTED = {"turned": "turned > 45° ↓", "bad": "IoU3D < .25 ↓"}
"""How many objects are so."""


@dataclass(frozen=True)
class Experiment:
    """All that is known when the jobs have ended."""

    command: str
    rooms: str
    """Name of the set of rooms."""
    presets: tuple[str, ...]
    seeds: tuple[int, ...]
    finished: Finished
    failures: Mapping[Job, str]
    """Why the jobs that left no results failed."""


def need_bench() -> None:
    """Tables and plots need pandas and matplotlib.

    Raises:
        InputError: If one of them is not installed.
    """
    for package in ("pandas", "matplotlib"):
        if find_spec(package) is None:
            raise InputError(
                f"mover experiment: {package} is not installed; "
                "pip install '.[bench]' in mover's folder"
            )


def write_tables(experiment: Experiment, pictures: Sequence[str], folder: Path) -> Path:
    """Write results.csv, summary.csv and summary.md; returns the latter."""
    objects, rooms = frames_of(experiment)
    lines = summarise(objects, rooms)
    metrics = (name for name in SHOWN if name in OBJECT_METRICS | HARM_METRICS)
    write_csv(objects, (*ABOUT, *metrics), folder / "results.csv")
    about = ("over", "preset", "stage", "count", *COUNTED)
    write_csv(lines, (*about, *SHOWN), folder / "summary.csv")
    versions = made_by(experiment.finished.scenes.version)
    page = fill_page(experiment.command, versions, lines, _notes(experiment, objects))
    with replacing(folder / "summary.md") as part:
        part.write_text(page + "".join(f"\n![{name}]({name})\n" for name in pictures))
    return folder / "summary.md"


def write_csv(frame: Frame, columns: Sequence[str], path: Path) -> None:
    """Some columns of a table; what it lacks is empty."""
    with replacing(path) as part:
        asked = frame.reindex(columns=list(columns))
        asked.to_csv(part, index=False, float_format="%.6g", lineterminator="\n")


def frames_of(experiment: Experiment) -> tuple[Frame, Frame]:
    """A row for each object and stage, and one for each room and stage."""
    found = experiment.finished
    return _by_stage(found.objects, ["seed", "object"]), _by_stage(found.scenes, ["seed"])


def _by_stage(found: Frame, keys: list[str]) -> Frame:
    """What is measured of the stages; the initial scene has no preset and comes once."""
    from pandas import concat

    rows = found.rename(columns={"name": "preset"})
    first = rows[rows.stage == "initial"].assign(preset="").drop_duplicates(keys)
    later = rows[rows.stage.isin(("image", "full"))]
    return concat([first.sort_values("seed", kind="stable"), later], ignore_index=True)


def summarise(objects: Frame, rooms: Frame) -> Frame:
    """Means over rooms, over kinds of objects, and every room by itself."""
    from pandas import concat

    used = objects.touched.astype(bool)
    kinds = {
        "objects": objects,
        "touched objects": objects[used],
        "untouched objects": objects[~used],
        "hidden objects": objects[objects.hidden >= HIDDEN],
        "truncated objects": objects[objects.truncated >= CUT],
        "flipped objects": objects[objects.flipped.astype(bool)],
    }
    each = {f"room {seed}": rooms[rooms.seed == seed] for seed in sorted(rooms.seed.unique())}
    parts = [means(over, rows) for over, rows in ({"rooms": rooms} | kinds | each).items()]
    return concat([part for part in parts if len(part)] or parts[:1], ignore_index=True)


def means(over: str, rows: Frame) -> Frame:
    """For each preset and stage the mean of each metric over those rows that have it.

    Objects that are turned or bad are counted.
    """
    if "iou3d" not in rows:  # of presets that measure something else
        rows = rows.reindex(columns=[*rows.columns, "iou3d", "yaw_error"])
    named = rows.assign(turned=rows.yaw_error > TURNED, bad=rows.iou3d < BAD) if len(rows) else rows
    groups = named.groupby(["preset", "stage"], sort=False)
    found = groups[[name for name in SHOWN if name in rows]].mean()
    found.insert(0, "count", groups.size())
    if "object" in rows and len(rows):
        found[list(COUNTED)] = groups[list(COUNTED)].sum()
    found.insert(0, "over", over)
    return found.reset_index()


def made_by(found: Iterable[str]) -> str:
    """Versions of the program that did the jobs, and this machine; a mixture is told."""
    versions = sorted(set(found))
    version = " and ".join(versions) or f"{__version__} ({sources('mover_bench')[:16]})"
    machine = f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores"
    parts = f"Python {platform.python_version()}, torch {torch.__version__}, {machine}"
    mixed = " **Jobs of different versions are mixed.**" if len(versions) > 1 else ""
    return f"mover {version}, {parts}, one thread a job.{mixed}"


def _notes(experiment: Experiment, objects: Frame) -> list[str]:
    """How many rooms and objects there are, of which kinds, and what failed."""
    first = objects[objects.stage == "initial"].reindex(columns=[*ABOUT, "center_error"])
    used, hidden = int(first.touched.sum()), int((first.hidden >= HIDDEN).sum())
    noise = ", ".join(
        f"{n} {v:g}" for n, v in plain(set_named(experiment.rooms).noise).items() if v
    )
    notes = [
        f"{first.seed.nunique()} of {len(experiment.seeds)} rooms, {len(first)} objects: {used}"
        f" touched by people, {len(first) - used} not, {hidden} hidden by other furniture by"
        f" {HIDDEN:.0%} or more.",
        f"Noise: {noise}.",
    ]
    missed = int(first.center_error.isna().sum())
    scenes = experiment.finished.scenes
    full = scenes[scenes.stage == "full"]
    false = int(full.drop_duplicates("seed", keep="last").false.sum())
    if missed or false:
        notes.append(
            f"**{missed} objects were not given: they count with IoU 0** and have no other metric."
            f" {false} were given that are not there: they are in no mean of objects."
        )
    for job, reason in experiment.failures.items():
        notes.append(f"**Failed**: seed {job.seed}, {job.name}: {reason}")
    expected = len(experiment.seeds) * len(experiment.presets)
    if len(full) < expected:
        notes.append(
            f"Only {len(full)} of {expected} runs ended: rows of different presets"
            " may be means over different rooms (see `rooms`)."
        )
    return notes


def fill_page(command: str, made_by: str, lines: Frame, notes: Sequence[str]) -> str:
    """The whole page but for the pictures."""
    kinds = ("touched", "untouched", "hidden", "truncated", "flipped")
    parts = [
        "# Known rooms",
        f"    {command}",
        made_by,
        *notes,
        "Stage 1 places the objects by the image alone, under the camera that the full method"
        " found. Arrows point to the better side.",
        "## Mean over rooms",
        _table(lines[lines.over == "rooms"], tuple(SHOWN), "rooms"),
    ]
    for over in ("objects", *(f"{kind} objects" for kind in kinds)):
        some = lines[lines.over == over]
        if len(some):
            parts += [f"## Mean over {over}", _table(some, FEW, "objects", counts=True)]
    parts += ["## IoU3D of each room", _by_room(lines, ("iou3d",), tuple(STAGES))]
    camera = ("pitch_error", "roll_error", "ground_error")
    title = " / ".join(head_of(name, SHOWN).removesuffix(" ↓") for name in camera)
    parts += [f"## {title} of each room", _by_room(lines, camera, ("initial", "full"))]
    return "\n\n".join(parts) + "\n"


def _table(lines: Frame, names: Sequence[str], of: str, *, counts: bool = False) -> str:
    counted = COUNTED if counts else {}
    head = ["", *(head_of(name, SHOWN) for name in names), *counted.values(), of]
    rows = [
        [label_of(line), *(cell_of(name, line) for name in names),
         *(f"{line[name]:.0f}" for name in counted), str(line["count"])]
        for line in lines.to_dict("records")
    ]  # fmt: skip
    return markdown(head, rows)


def _by_room(lines: Frame, names: Sequence[str], stages: Sequence[str]) -> str:
    """One column for each preset and stage, one row for each room."""
    asked = lines[lines.over.str.startswith("room ") & lines.stage.isin(stages)]
    cells: dict[str, dict[str, str]] = {}
    for line in asked.to_dict("records"):
        cell = " / ".join(cell_of(name, line) for name in names)
        cells.setdefault(line["over"], {})[label_of(line)] = cell
    labels = list(dict.fromkeys(label for row in cells.values() for label in row))
    rows = [[over, *(row.get(label, "-") for label in labels)] for over, row in cells.items()]
    return markdown(["", *labels], rows)


def cell_of(name: str, line: Mapping[str, Any]) -> str:
    """A metric of a row in the unit of its column."""
    return shown(name, line.get(name), SHOWN)


def label_of(line: Mapping[str, Any]) -> str:
    """Preset and stage in words."""
    stage = STAGES[line["stage"]]
    return f"{line['preset']}, {stage}" if line["preset"] else stage
