"""The tables of an experiment: every object, the means, and a page that one can read."""

import csv
import json
import math
import os
import platform
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from .. import __version__
from ..metrics_scene import OBJECT_METRICS
from ..records import plain, replacing
from ..run import sources
from .changes import set_named
from .job import STAGES
from .page import Line, fill_page

HIDDEN = 0.3  # share of an object that others hide, from which on it counts as hidden
CUT = 0.1  # share of an object that the border of the image cuts off, likewise
TURNED = math.radians(45)  # an object with a larger yaw error is turned
BAD = 0.25  # IoU3D below which an object is lost
TRAITS = ("category", "touched", "hidden", "truncated", "flipped", "stays")
ABOUT = ("seed", "preset", "stage", "object", *TRAITS)
SHOWN = (
    "iou3d", "p2s", "iou2d", "yaw_error", "center_error", "size_error", "contact_f1",
    "non_collision", "contact", "penetration_depth", "pitch_error", "roll_error", "ground_error",
)  # fmt: skip
"""Metrics of the tables, in their order."""

Row = Mapping[str, Any]


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
    objects: tuple[Row, ...]
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


def read_outcome(path: Path) -> Outcome:
    """Read the results of a finished job."""
    tree = json.loads(path.read_text())
    version = f"{tree['version']} ({tree['sources']})"
    scenes = {stage: tree[stage] for stage in STAGES}
    false = len(tree.get("unmatched", {}).get("false", ()))
    return Outcome(tree["seed"], tree["name"], version, scenes, tuple(tree["objects"]), false)


def write_tables(experiment: Experiment, pictures: Sequence[str], folder: Path) -> Path:
    """Write results.csv, summary.csv and summary.md; returns the latter."""
    objects, rooms = object_rows(experiment), room_rows(experiment)
    lines = summarise(objects, rooms)
    _write_csv(
        folder / "results.csv", (*ABOUT, *(n for n in SHOWN if n in OBJECT_METRICS)), objects
    )
    about = ("over", "preset", "stage", "count", "turned", "bad")
    flat = [
        {"over": x.over, "preset": x.preset, "stage": x.stage, "count": x.count, **x.values}
        for x in lines
    ]
    _write_csv(folder / "summary.csv", (*about, *SHOWN), flat)
    page = fill_page(
        experiment.command,
        made_by(x.version for x in experiment.outcomes),
        lines,
        _notes(experiment, objects),
    )
    with replacing(folder / "summary.md") as part:
        part.write_text(page + "".join(f"\n![{name}]({name})\n" for name in pictures))
    return folder / "summary.md"


def object_rows(experiment: Experiment) -> list[Row]:
    """A row for each object and stage; the initial scene is the same for all presets."""
    rows: list[Row] = []
    for outcome, stage, preset in _scenes(experiment):
        for item in outcome.objects:
            about = {"seed": outcome.seed, "preset": preset, "stage": stage, "object": item["id"]}
            traits = {name: item[name] for name in TRAITS}
            rows.append({**about, **traits, **item[stage]})
    return rows


def room_rows(experiment: Experiment) -> list[Row]:
    """A row for each room and stage."""
    return [
        {"seed": outcome.seed, "preset": preset, "stage": stage, **outcome.scenes[stage]}
        for outcome, stage, preset in _scenes(experiment)
    ]


def _scenes(experiment: Experiment) -> Iterable[tuple[Outcome, str, str]]:
    """Outcome, stage and preset of every measured scene; the initial scene has no preset."""
    first = {outcome.seed: outcome for outcome in reversed(experiment.outcomes)}
    for seed in sorted(first):
        yield first[seed], "initial", ""
    for outcome in experiment.outcomes:
        yield outcome, "image", outcome.preset
        yield outcome, "full", outcome.preset


def summarise(objects: Sequence[Row], rooms: Sequence[Row]) -> list[Line]:
    """Means over rooms, over kinds of objects, and every room by itself."""
    kinds: tuple[tuple[str, Callable[[Row], bool]], ...] = (
        ("objects", lambda _: True),
        ("touched objects", lambda row: row["touched"]),
        ("untouched objects", lambda row: not row["touched"]),
        ("hidden objects", lambda row: row["hidden"] >= HIDDEN),
        ("truncated objects", lambda row: row["truncated"] >= CUT),
        ("flipped objects", lambda row: row["flipped"]),
    )
    lines = _means("rooms", rooms)
    for over, belongs in kinds:
        lines += _means(over, [row for row in objects if belongs(row)])
    for seed in sorted({row["seed"] for row in rooms}):
        lines += _means(f"room {seed}", [row for row in rooms if row["seed"] == seed])
    return lines


def _means(over: str, rows: Sequence[Row]) -> list[Line]:
    groups: dict[tuple[str, str], list[Row]] = {}
    for row in rows:
        groups.setdefault((row["preset"], row["stage"]), []).append(row)
    return [Line(over, *key, len(group), mean_of(group)) for key, group in groups.items()]


def mean_of(rows: Sequence[Row]) -> dict[str, float]:
    """Mean of each metric over those rows that have it, and how many objects are turned or bad."""
    found = {name: [row[name] for row in rows if name in row] for name in SHOWN}
    values = {name: math.fsum(v) / len(v) for name, v in found.items() if v}
    if rows and "object" in rows[0]:
        values["turned"] = sum(row.get("yaw_error", 0.0) > TURNED for row in rows)
        values["bad"] = sum(row["iou3d"] < BAD for row in rows)
    return values


def _write_csv(path: Path, columns: Sequence[str], rows: Sequence[Row]) -> None:
    with replacing(path) as part, part.open("w", newline="") as file:
        writer = csv.DictWriter(file, columns, extrasaction="ignore", lineterminator="\n")
        writer.writeheader()
        writer.writerows({name: _cell(row.get(name, "")) for name in columns} for row in rows)


def _cell(value: object) -> object:
    return f"{value:.6g}" if isinstance(value, float) else value


def made_by(found: Iterable[str]) -> str:
    """Versions of the program that did the jobs, and this machine; a mixture is told."""
    versions = sorted(set(found))
    version = " and ".join(versions) or f"{__version__} ({sources()[:16]})"
    machine = f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores"
    parts = f"Python {platform.python_version()}, torch {torch.__version__}, {machine}"
    mixed = " **Jobs of different versions are mixed.**" if len(versions) > 1 else ""
    return f"mover {version}, {parts}, one thread a job.{mixed}"


def _notes(experiment: Experiment, objects: Sequence[Row]) -> list[str]:
    """How many rooms and objects there are, of which kinds, and what failed."""
    first = [row for row in objects if row["stage"] == "initial"]
    used = sum(row["touched"] for row in first)
    hidden = sum(row["hidden"] >= HIDDEN for row in first)
    found = len({row["seed"] for row in first})
    noise = ", ".join(
        f"{n} {v:g}" for n, v in plain(set_named(experiment.rooms).noise).items() if v
    )
    notes = [
        f"{found} of {len(experiment.seeds)} rooms, {len(first)} objects: {used} touched by people,"
        f" {len(first) - used} not, {hidden} hidden by other furniture by {HIDDEN:.0%} or more.",
        f"Noise: {noise}.",
    ]
    missed = sum("center_error" not in row for row in first)
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
