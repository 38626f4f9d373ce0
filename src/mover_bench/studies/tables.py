"""The tables of an experiment: every object, the means, and a page that one can read."""

import json
import math
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
from mover_bench.studies.job import STAGES
from mover_bench.studies.sets import set_named

Frame = Any
"""A `pandas.DataFrame`."""
HIDDEN = 0.3  # share of an object that others hide, from which on it counts as hidden
CUT = 0.1  # share of an object that the border of the image cuts off, likewise
TURNED = math.radians(45)  # an object with a larger yaw error is turned
BAD = 0.25  # IoU3D below which an object is lost
TRAITS = ("category", "touched", "hidden", "truncated", "flipped", "stays")
ABOUT = ("seed", "preset", "stage", "object", *TRAITS)
SHOWN: dict[str, Column] = {
    **{
        n: COLUMNS[n]
        for n in (
            "iou3d",
            "p2s",
            "iou2d",
            "yaw_error",
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
FEW = tuple(SHOWN)[:8]
"""Metrics of objects."""
COUNTED = {"turned": "turned > 45° ↓", "bad": "IoU3D < .25 ↓"}
"""How many objects are so."""


@dataclass(frozen=True)
class Failure:
    """A job that ended without results."""

    seed: int
    name: str
    reason: str


@dataclass(frozen=True)
class Outcome:
    """What a finished job found."""

    seed: int
    preset: str
    version: str
    """Of the program, with a digest of its sources."""
    scenes: Mapping[str, Mapping[str, float]]
    """Metrics of each stage of `STAGES`."""
    objects: tuple[Mapping[str, Any], ...]
    false: int = 0
    """Objects of the result that the truth does not have."""


@dataclass(frozen=True)
class Experiment:
    """All that is known when the jobs have ended."""

    command: str
    rooms: str
    """Name of the set of rooms."""
    presets: tuple[str, ...]
    seeds: tuple[int, ...]
    outcomes: tuple[Outcome, ...]
    failures: tuple[Failure, ...]


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


def read_outcome(path: Path) -> Outcome:
    """Read the results of a finished job."""
    tree = json.loads(path.read_text())
    version = f"{tree['version']} ({tree['sources']})"
    scenes = {stage: tree[stage] for stage in STAGES}
    false = len(tree.get("unmatched", {}).get("false", ()))
    return Outcome(tree["seed"], tree["name"], version, scenes, tuple(tree["objects"]), false)


def write_tables(experiment: Experiment, pictures: Sequence[str], folder: Path) -> Path:
    """Write results.csv, summary.csv and summary.md; returns the latter."""
    objects, rooms = frames_of(experiment)
    lines = summarise(objects, rooms)
    metrics = (name for name in SHOWN if name in OBJECT_METRICS | HARM_METRICS)
    write_csv(objects, (*ABOUT, *metrics), folder / "results.csv")
    about = ("over", "preset", "stage", "count", *COUNTED)
    write_csv(lines, (*about, *SHOWN), folder / "summary.csv")
    versions = made_by(x.version for x in experiment.outcomes)
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
    from pandas import DataFrame

    objects, rooms = list[dict[str, Any]](), list[dict[str, Any]]()
    for outcome, stage, preset in _scenes(experiment):
        about = {"seed": outcome.seed, "preset": preset, "stage": stage}
        rooms.append({**about, **outcome.scenes[stage]})
        objects += [
            {**about, "object": item["id"], **{n: item[n] for n in TRAITS}, **item[stage]}
            for item in outcome.objects
        ]
    columns = None if objects else list(ABOUT)
    return DataFrame(objects, columns=columns), DataFrame(rooms, columns=columns)


def _scenes(experiment: Experiment) -> Iterable[tuple[Outcome, str, str]]:
    """Outcome, stage and preset of every measured scene; the initial scene has no preset."""
    first = {outcome.seed: outcome for outcome in reversed(experiment.outcomes)}
    for seed in sorted(first):
        yield first[seed], "initial", ""
    for outcome in experiment.outcomes:
        yield outcome, "image", outcome.preset
        yield outcome, "full", outcome.preset


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
    false = sum({outcome.seed: outcome.false for outcome in experiment.outcomes}.values())
    if missed or false:
        notes.append(
            f"**{missed} objects were not given: they count with IoU 0** and have no other metric."
            f" {false} were given that are not there: they are in no mean of objects."
        )
    for failure in experiment.failures:
        notes.append(f"**Failed**: seed {failure.seed}, {failure.name}: {failure.reason}")
    expected = len(experiment.seeds) * len(experiment.presets)
    if len(experiment.outcomes) < expected:
        notes.append(
            f"Only {len(experiment.outcomes)} of {expected} runs ended: rows of different presets"
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
    value = line.get(name)
    return shown(name, None if value is None or math.isnan(value) else value, SHOWN)


def label_of(line: Mapping[str, Any]) -> str:
    """Preset and stage in words."""
    stage = STAGES[line["stage"]]
    return f"{line['preset']}, {stage}" if line["preset"] else stage
