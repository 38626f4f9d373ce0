"""What finished jobs have left, as tables: a row for each scene, and one for each object in it."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from mover.app.batch import read_tree
from mover_bench.studies.job import DONE, ROOM, STAGES, Job

Frame = Any
"""A `pandas.DataFrame`."""
TURNED = math.radians(45)  # [rad], a yaw error from which on an object is turned
SEATS = ("chair", "armchair", "office chair", "sofa", "couch")  # pieces with a front and a back
PLACING = ("place_objects", "find_image_cues", "refine_camera")  # stages that optimise
TRAITS = ("category", "touched", "hidden", "truncated", "flipped", "stays")
MEASURED = (*STAGES, "true_room", "truth")  # scenes of a job that have metrics
SPENT = ("optimisation", "everything else")  # [s] of all stages
LENGTH = ("frames", "seconds", "interactions")  # of what a job was given


@dataclass(frozen=True)
class Source:
    """Jobs whose mean is one number of a room."""

    rooms: str
    """Name of a set."""
    names: tuple[str, ...]
    """Variants; `ROOM` for the truth itself."""
    stage: str = "full"
    """One of `MEASURED`."""


@dataclass(frozen=True)
class Finished:
    """All results that a study needs; both tables begin with set, seed and name of the job."""

    scenes: Frame
    """Stage, version, `LENGTH`, `SPENT`, number of `false` objects, and all metrics."""
    objects: Frame
    """Stage, id (`object`), `TRAITS` and the object's metrics."""


def read_finished(jobs: Iterable[Job]) -> Finished:
    """Read what the jobs have left."""
    from pandas import DataFrame

    scenes, objects = list[dict[str, Any]](), list[dict[str, Any]]()
    for job in jobs:
        tree = read_tree(job.folder / DONE)
        for stage in (name for name in MEASURED if name in tree):
            about = {"set": job.rooms, "seed": job.seed, "name": job.name, "stage": stage}
            scenes.append(about | _about(tree) | tree[stage])
            objects += [
                about | {"object": item["id"]} | {n: item.get(n) for n in TRAITS} | item[stage]
                for item in tree.get("objects", ())
                if stage in item
            ]
    keys = ["set", "seed", "name", "stage"]
    empty = [*keys, "version", "false", *SPENT, *LENGTH, "iou3d"]
    frame = DataFrame(scenes, columns=None if scenes else empty)
    things = DataFrame(objects, columns=None if objects else [*keys, "object", *TRAITS, "iou3d"])
    halves = (("iou3d_touched", True), ("iou3d_untouched", False)) if "iou3d" in things else ()
    for name, used in halves:
        means = things[things.touched.astype(bool) == used].groupby(keys).iou3d.mean()
        frame = frame.join(means.rename(name), on=keys)
    if "pitch_error" in frame:  # the mean of both angles, as the paper's table has it
        frame = frame.assign(tilt=(frame.pitch_error + frame.roll_error) / 2)
    return Finished(frame, things)


def _about(tree: Mapping[str, Any]) -> dict[str, Any]:
    """What is known of a job beside its metrics."""
    spent = dict.fromkeys(SPENT, 0.0)
    for stage in tree.get("stages", ()):
        spent[SPENT[stage["name"] not in PLACING]] += stage["seconds"]
    return {
        "version": f"{tree['version']} ({tree['sources']})",
        "false": len(tree.get("unmatched", {}).get("false", ())),
        **spent,
        **{name: tree.get(name) for name in LENGTH},
    }


def rows_of(frame: Frame, source: Source, seeds: Sequence[int]) -> Frame:
    """The rows of one source in some rooms, by seed."""
    mine = (frame.set == source.rooms) & (frame.stage == source.stage)
    mine &= frame.name.isin(source.names) & frame.seed.isin(seeds)
    return frame[mine].sort_values("seed", kind="stable")


def by_room(
    finished: Finished, source: Source, metric: str, seeds: Sequence[int]
) -> dict[int, float]:
    """A metric in each room, the mean over the source's jobs; rooms that lack it are left out."""
    if metric not in finished.scenes:
        return {}
    rooms = rows_of(finished.scenes, source, seeds).groupby("seed")[metric]
    return rooms.mean()[rooms.count() == len(source.names)].to_dict()


def recovered(
    finished: Finished, source: Source, seeds: Sequence[int], *, used: bool
) -> tuple[int, int]:
    """Of the seats whose guess is turned round (`used`: by people), how many were turned back.

    Returns:
        How many came within 45 degrees, and how many there were.
    """
    rows = rows_of(finished.objects, source, seeds)
    rows = rows[rows.flipped.astype(bool) & rows.category.isin(SEATS)]
    rows = rows[rows.touched.astype(bool)] if used else rows
    return int((rows.yaw_error < TURNED).sum()) if len(rows) else 0, len(rows)


def truth_source(rooms: str) -> Source:
    """The truth measured against itself."""
    return Source(rooms, (ROOM,), "truth")
