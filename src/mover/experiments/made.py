"""Make one room of a set: its hashes, what is in it, and the files for other tools.

A process of its own with one thread: `python -m mover.experiments.made SET SEED FOLDER [captures]`.
"""

import json
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from .. import __version__, records
from ..readers.bodies_file import write_bodies
from ..readers.folder import write_capture
from ..readers.scene_file import write_scene
from ..rooms import KnownRoom
from ..run import Run, sources
from ..types import Capture
from .digests import capture_hash, mask_pixels, truth_hash
from .job import DONE, Job, Seed, make_truth, spoilt
from .sets import SETS
from .tables import CUT, HIDDEN
from .traits import Traits

MADE = "made"  # the job that makes a room of a set; its results are the room's row of the manifest
CAPTURE = "capture"  # folder of the files for other tools; its `truth` holds the truth


def key_of(job: Job) -> str:
    """Digest of everything that a room depends on."""
    rooms = SETS[job.rooms]
    return records.fingerprint(rooms.room, rooms.noise, rooms.version, job.seed, sources())


def is_made(job: Job, captures: bool, keep: bool) -> bool:
    """Whether a room is there, of this version unless others are taken as well."""
    try:
        found = json.loads((job.folder / DONE).read_text())
    except (OSError, ValueError):
        return False
    there = not captures or (job.home / CAPTURE / "truth" / "scene.json").exists()
    return there and (keep or found.get("key") == key_of(job))


def make_one(job: Job, captures: bool) -> None:
    """Make a room and write its row and, where asked for, its files."""
    rooms = SETS[job.rooms]
    room = Run(job.truths).stage(make_truth, Seed(job.seed), rooms.room)
    trial = spoilt(room, job.seed, rooms)
    if captures:
        folder = job.home / CAPTURE
        shutil.rmtree(folder, ignore_errors=True)
        write_capture(trial.capture, folder)
        write_bodies(room.bodies, folder / "truth" / "bodies.npz")
        write_scene(room.truth, folder / "truth" / "scene.json")
    row = {"key": key_of(job), "version": __version__, **row_of(room, trial.capture, trial.traits)}
    with records.replacing(job.folder / DONE) as part:
        part.write_text(json.dumps(row, indent=1, allow_nan=False))


def row_of(room: KnownRoom, capture: Capture, traits: Sequence[Traits]) -> dict[str, Any]:
    """The hashes of a room, and what is in it."""
    true = {piece.id for piece in room.truth.pieces}
    given = {piece.id for piece in capture.scene.pieces}
    frames = int(room.bodies.frame.max()) + 1
    counts = {
        "pieces": len(true),
        "people": len(room.bodies.person.unique()),
        "frames": frames,
        "seconds": frames / (room.bodies.fps or 1.0),
        "touched": sum(t.touched for t in traits),
        "stays": sum(t.stays for t in traits),
        "hidden": sum(t.hidden >= HIDDEN for t in traits),
        "truncated": sum(t.truncated >= CUT for t in traits),
        "flipped": sum(t.flipped for t in traits),
        "missed": len(true - given),
        "false": len(given - true),
    }
    shares = {
        "mean_hidden": _mean([t.hidden for t in traits]),
        "mean_truncated": _mean([t.truncated for t in traits]),
        "bodies_behind_furniture": _mean(room.passing.tolist()),
        "bodies_touching_furniture": _mean((room.touched >= 0).any(1).tolist()),
    }
    hashes = {"truth": truth_hash(room), "capture": capture_hash(capture)}
    return {
        **hashes,
        "pixels": mask_pixels(capture),
        **counts,
        **shares,
        "refused": list(room.refused),
    }


def _mean(values: Sequence[float]) -> float:
    return round(sum(values) / max(1, len(values)), 4)


def main(arguments: Sequence[str]) -> None:
    """Make the room that is named on the command line."""
    rooms, seed, out, *rest = arguments
    torch.set_num_threads(1)
    make_one(Job(rooms, int(seed), MADE, Path(out)), captures=rest == ["captures"])


if __name__ == "__main__":
    main(sys.argv[1:])
