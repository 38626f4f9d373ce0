"""Finished jobs, and the numbers of a row of a table in each room."""

import json
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mover_bench.studies.job import DONE, ROOM, Job

TURNED = math.radians(45)  # [rad], a yaw error from which on an object is turned
SEATS = ("chair", "armchair", "office chair", "sofa", "couch")  # pieces with a front and a back


@dataclass(frozen=True)
class Source:
    """Jobs whose mean is one number of a room."""

    rooms: str
    """Name of a set."""
    names: tuple[str, ...]
    """Variants; `ROOM` for the truth itself."""
    stage: str = "full"
    """initial, image, full; or truth."""


@dataclass(frozen=True)
class Finished:
    """All results that a study needs, as their files hold them."""

    found: Mapping[tuple[str, int, str], Mapping[str, Any]]
    """By set, seed and variant."""

    def of(self, rooms: str, seed: int, name: str) -> Mapping[str, Any] | None:
        """Results of one job; None: it left none."""
        return self.found.get((rooms, seed, name))


def read_finished(jobs: Iterable[Job]) -> Finished:
    """Read what the jobs have left."""
    found: dict[tuple[str, int, str], Mapping[str, Any]] = {}
    for job in jobs:
        path = job.folder / DONE
        if path.exists():
            found[(job.rooms, job.seed, job.name)] = _read(path)
    return Finished(found)


def _read(path: Path) -> Mapping[str, Any]:
    tree: Mapping[str, Any] = json.loads(path.read_text())
    return tree


def by_room(
    finished: Finished, source: Source, metric: str, seeds: Sequence[int]
) -> dict[int, float]:
    """A metric in each room, the mean over the source's jobs; rooms that lack it are left out."""
    values: dict[int, float] = {}
    for seed in seeds:
        found = [
            value
            for name in source.names
            if (tree := finished.of(source.rooms, seed, name)) is not None
            and (value := value_of(tree, source.stage, metric)) is not None
        ]
        if len(found) == len(source.names):
            values[seed] = math.fsum(found) / len(found)
    return values


def value_of(tree: Mapping[str, Any], stage: str, metric: str) -> float | None:
    """A metric of a scene of a job; None: it has none."""
    if metric in DERIVED:
        return DERIVED[metric](tree, stage)
    value = tree.get(stage, {}).get(metric)
    return None if value is None else float(value)


def _tilt(tree: Mapping[str, Any], stage: str) -> float | None:
    """Mean of the errors of pitch and roll, as the paper's table has it."""
    scene = tree.get(stage, {})
    if "pitch_error" not in scene:
        return None
    return (scene["pitch_error"] + scene["roll_error"]) / 2


def _touched(tree: Mapping[str, Any], stage: str) -> float | None:
    return _mean([o[stage]["iou3d"] for o in _objects(tree, stage) if o["touched"]])


def _untouched(tree: Mapping[str, Any], stage: str) -> float | None:
    return _mean([o[stage]["iou3d"] for o in _objects(tree, stage) if not o["touched"]])


def _objects(tree: Mapping[str, Any], stage: str) -> Sequence[Mapping[str, Any]]:
    """The objects of a scene of a job; the truth has none that could be wrong."""
    found: Sequence[Mapping[str, Any]] = tree.get("objects", [])
    return [item for item in found if stage in item]


def _mean(values: Sequence[float]) -> float | None:
    return math.fsum(values) / len(values) if values else None


DERIVED = {"tilt": _tilt, "iou3d_touched": _touched, "iou3d_untouched": _untouched}
"""Metrics that are made of those of the objects or of others."""


def recovered(
    finished: Finished, source: Source, seeds: Sequence[int], *, used: bool
) -> tuple[int, int]:
    """Of the chairs and sofas whose guess is turned round, how many were turned back.

    Args:
        finished: The results.
        source: Which jobs and which scene.
        seeds: Which rooms.
        used: Only those that people use.

    Returns:
        How many came within 45 degrees, and how many there were.
    """
    good = count = 0
    for seed in seeds:
        for name in source.names:
            tree = finished.of(source.rooms, seed, name) or {}
            for item in _objects(tree, source.stage):
                if item["flipped"] and item["category"] in SEATS and (item["touched"] or not used):
                    count += 1
                    good += item[source.stage].get("yaw_error", math.pi) < TURNED
    return good, count


def truth_source(rooms: str) -> Source:
    """The truth measured against itself."""
    return Source(rooms, (ROOM,), "truth")
