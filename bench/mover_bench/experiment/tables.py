"""The tables of an experiment: every object, the means, and a page that one can read."""

import json
import os
import platform
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float

from mover.app.batch import last_line, read_tree
from mover.app.report.tables import SHOWN, shown
from mover.core.files import replacing
from mover.core.observe import Observer, Step
from mover.core.records import plain
from mover.evaluate.evaluation import METRICS
from mover_bench.cli import ExperimentArgs
from mover_bench.experiment.variants import VARIANTS
from mover_bench.rooms.config import set_named

Frame = Any  #: a `pandas.DataFrame`
LOG = "log.txt"
STAGES = ("initial", "image", "full")
RESAMPLES, LEVEL = 10_000, 0.95


COLUMNS = (
    "iou3d", "iou3d_aligned", "p2s", "iou2d", "center_error", "worse_by_10cm", "non_collision",
    "contact", "contact_f1", "pitch_error", "roll_error", "pje", "p_pje",
)  # fmt: skip
"""Metrics of the tables, in their order."""


def head_of(name: str) -> str:
    """A metric's name, unit, and the better side; contact is compared with the truth's own."""
    metric = METRICS[name]
    unit = f" [{SHOWN[metric.unit][0]}]" if SHOWN[metric.unit][0] else ""
    side = "" if name == "contact" else " ↑" if metric.best > 0 else " ↓"
    return f"{name}{unit}{side}"


def markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table: the first column on the left, the others on the right."""
    rule = ["---", *["--:"] * (len(head) - 1)]
    return "\n".join("| " + " | ".join(row) + " |" for row in (head, rule, *rows))


Numbers = dict[str, Any]


def judge_each(
    folders: Sequence[Path],
    judge: Callable[[Path], Numbers],
    table: Callable[[dict[str, Numbers]], str],
    out: Path,
    observe: Observer,
) -> Path:
    """Judge the folders of a set of real data; write summary.json and, returned, summary.md."""
    found: dict[str, Numbers] = {}
    for done, folder in enumerate(folders):
        observe(Step(f"{out.name} {folder.name}", done, len(folders)))
        found[folder.name] = judge(folder)
    texts = {"summary.json": json.dumps(found, indent=1), "summary.md": table(found)}
    for name, text in texts.items():
        with replacing(out / name) as part:
            part.write_text(text)
    return out / "summary.md"


class Interval(NamedTuple):
    """A mean over rooms and its 95 % interval (percentiles of the resampled means)."""

    mean: float
    low: float
    high: float
    rooms: int


def interval(values: Sequence[float] | Float[np.ndarray, " rooms"], seed: int = 0) -> Interval:
    """Mean over rooms and its interval by bootstrap; equal seeds and counts draw the same rooms.

    Raises:
        ValueError: If there are no rooms.
    """
    data = np.asarray(values, dtype=np.float64)
    if not len(data):
        raise ValueError("no rooms, expected at least 1")
    drawn = data[np.random.default_rng(seed).integers(0, len(data), (RESAMPLES, len(data)))]
    low, high = np.quantile(drawn.mean(1), [(1 - LEVEL) / 2, (1 + LEVEL) / 2])
    return Interval(float(data.mean()), float(low), float(high), len(data))


def path_of(out: Path, rooms: str, seed: int, name: str) -> Path:
    """The file of a variant's numbers."""
    return out / rooms / str(seed) / f"{name}.json"


@dataclass(frozen=True)
class Finished:
    """What an experiment has found so far."""

    scenes: Frame
    """A row for each seed, variant (`name`, its table `row`) and stage, with all metrics."""
    objects: Frame  #: the same for each object, with what it is
    lacking: Mapping[tuple[int, str], str]  #: why there are no numbers, by seed and variant
    versions: tuple[str, ...]


def read_finished(out: Path, rooms: str, seeds: Sequence[int], names: Sequence[str]) -> Finished:
    """Read what the variants have left."""
    from pandas import DataFrame

    scenes, objects = list[dict[str, Any]](), list[dict[str, Any]]()
    lacking: dict[tuple[int, str], str] = {}
    versions: set[str] = set()
    for seed, name in ((seed, name) for seed in seeds for name in names):
        tree = read_tree(path_of(out, rooms, seed, name))
        if "full" not in tree:
            log = out / rooms / str(seed) / LOG
            reason = tree["failed"].strip().split("\n")[-1] if "failed" in tree else last_line(log)
            lacking[seed, name] = reason
            continue
        versions.add(tree["version"])
        for stage in STAGES:
            about = {"seed": seed, "name": name, "row": VARIANTS[name].row or name, "stage": stage}
            scenes.append(about | {"seconds": tree["seconds"]} | tree[stage])
            objects += [
                about | {key: item[key] for key in ("id", "category")} | item[stage]
                for item in tree["objects"]
            ]
    about = ["seed", "name", "row", "stage"]
    rows = DataFrame(scenes, columns=None if scenes else [*about, "seconds"])
    things = DataFrame(objects, columns=None if objects else about)
    return Finished(rows, things, lacking, tuple(sorted(versions)))


def write_tables(args: ExperimentArgs, seeds: Sequence[int], names: Sequence[str]) -> Path:
    """Write results.csv, summary.csv and summary.md into OUT/SET; returns the latter."""
    folder, found = args.out / args.set, read_finished(args.out, args.set, seeds, names)
    for name, frame in (("results.csv", found.objects), ("summary.csv", found.scenes)):
        with replacing(folder / name) as part:
            frame.to_csv(part, index=False, float_format="%.6g", lineterminator="\n")
    with replacing(folder / "summary.md") as part:
        part.write_text(page_of(args, names, found))
    return folder / "summary.md"


def page_of(args: ExperimentArgs, names: Sequence[str], found: Finished) -> str:
    """Means over rooms, and differences from the first variant."""
    machine = f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores"
    versions = " and ".join(found.versions) or "nothing is finished"
    lines = [
        f"# Known rooms: {args.set}",
        f"    mover experiment --set {args.set} --seeds {args.seeds} --variants "
        + " ".join(args.variants)
        + (f" --steps {args.steps}" if args.steps else ""),
        f"mover {versions}, torch {torch.__version__}, {machine}, one thread a room.",
        set_named(args.set).about,
        "Noise: "
        + ", ".join(f"{n} {v:g}" for n, v in plain(set_named(args.set).noise).items() if v)
        + ".",
        "`initial` is the scene as it is given; `image` places the objects by the image alone,"
        " under the camera that the full method has found. Intervals: 95 %, bootstrap over rooms.",
    ]
    lines += [
        f"**Failed**: seed {seed}, {name}: {why}" for (seed, name), why in found.lacking.items()
    ]
    if not len(found.scenes):
        return "\n\n".join(lines) + "\n"
    rows = list(dict.fromkeys(VARIANTS[name].row or name for name in names))
    lead = [(rows[0], "initial"), (rows[0], "image"), *((row, "full") for row in rows)]
    columns = [name for name in COLUMNS if name in found.scenes]  # means over a row's variants
    means = found.scenes.groupby(["row", "stage", "seed"])[columns].mean()
    lines += ["## Mean over rooms", _means(means, lead)]
    lines += [f"## Difference from {rows[0]}", _differences(means, rows)] if rows[1:] else []
    return "\n\n".join(lines) + "\n"


def _chosen(means: Frame, row: str, stage: str) -> Frame:
    """The means of one row and stage, by seed."""
    level = means.index.get_level_values
    return means[(level("row") == row) & (level("stage") == stage)].droplevel(["row", "stage"])


def _means(means: Frame, keys: Iterable[tuple[str, str]]) -> str:
    """One line for each row and stage; metrics that no line has are left out."""
    columns = [name for name in COLUMNS if name in means and means[name].notna().any()]
    lines: list[list[str]] = []
    for key in keys:
        rooms = _chosen(means, *key)
        if not len(rooms):
            continue
        cells = [shown(METRICS[name].unit, float(rooms[name].mean())) for name in columns]
        lines.append([", ".join(key) if key[1] != "full" else key[0], *cells, str(len(rooms))])
    return markdown(["", *map(head_of, columns), "rooms"], lines)


def _differences(means: Frame, rows: Sequence[str]) -> str:
    """What each row gains over the first one, in the rooms that both have."""
    columns = [name for name in COLUMNS if name in means]
    lines: list[list[str]] = []
    for row in rows[1:]:
        gaps = _chosen(means, row, "full") - _chosen(means, rows[0], "full")
        if not gaps.notna().any(axis=None):
            continue
        cells: list[str] = []
        for name in columns:
            values = gaps[name].dropna().to_numpy()
            if not len(values):
                cells.append("-")
                continue
            gap, unit = interval(values), METRICS[name].unit
            ends = " … ".join(shown(unit, x, sign=True) for x in (gap.low, gap.high))
            cells.append(f"{shown(unit, gap.mean, sign=True)} ({ends})")
        lines.append([row, *cells, str(int(gaps[columns].notna().any(axis=1).sum()))])
    return markdown(["", *map(head_of, columns), "rooms"], lines)
