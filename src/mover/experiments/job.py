"""One job of an experiment: make a known room with noise, or rebuild it with a preset and measure.

Each job is a process of its own (`python -m mover.experiments.job SET SEED NAME FOLDER`) with one
thread, so that its numbers depend on nothing but its inputs.
"""

import json
import shutil
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch

from .. import __version__, records
from ..evaluate import EvaluateConfig, EvaluatedBodies, evaluate
from ..pipeline import reconstruct
from ..presets import PRESETS, Config
from ..rooms import KnownRoom, NoiseConfig, add_noise, make_room
from ..run import Run, sources
from ..types import Bodies, Capture, Room, Scene
from .traits import Traits, hidden_shares

ROOM = "room"  # the job that makes the room; all others have the name of their preset
DONE = "metrics.json"  # a job that has it is finished
SETS = {"rooms": NoiseConfig()}
"""Generated rooms with their noise; the standard noise is the default one."""
STAGES = {"initial": "Initial", "image": "Stage 1", "full": "Full"}
"""Scenes that are measured, by their name in the files."""


@dataclass(frozen=True)
class Job:
    """One process of an experiment."""

    rooms: str
    """Name of a set in `SETS`."""
    seed: int
    name: str
    """A preset, or `ROOM`."""
    out: Path
    """Folder of the experiment."""

    @property
    def folder(self) -> Path:
        """Where its files are."""
        return self.out / self.rooms / str(self.seed) / self.name

    @property
    def room(self) -> Path:
        """What the room of its seed is stored as."""
        return self.out / self.rooms / str(self.seed) / ROOM / ROOM


@records.record
class Trial:
    """A known room as the method gets it, and the truth."""

    capture: Capture
    """With noise."""
    truth: Scene
    bodies: Bodies | None
    """The true people."""
    traits: tuple[Traits, ...]
    """Of the true objects, in their order."""


@records.record
class Rebuilt:
    """The scenes of a job that pictures are drawn from."""

    image: Scene
    full: Scene


def noisy_room(seed: int, noise: NoiseConfig) -> Trial:
    """A generated room with noise."""
    room = make_room(seed)
    return Trial(add_noise(room, noise, seed), room.truth, room.bodies, traits_of(room))


def traits_of(room: KnownRoom) -> tuple[Traits, ...]:
    """What each object of a generated room is, who uses it and how well it is seen."""
    used = set(room.touched.unique().tolist())
    rows = zip(room.truth.pieces, hidden_shares(room.truth), strict=True)
    return tuple(
        Traits(piece.id, piece.category, index in used, hidden)
        for index, (piece, hidden) in enumerate(rows)
    )


def key_of(job: Job) -> str:
    """Digest of everything that a job's numbers depend on."""
    settings = None if job.name == ROOM else PRESETS[job.name]
    return records.fingerprint(SETS[job.rooms], job.seed, job.name, settings, sources())


def do_job(job: Job) -> None:
    """Do one job, from what is left of it on disk, and write its results."""
    if job.name == ROOM:
        store_room(job, noisy_room(job.seed, SETS[job.rooms]))
    else:
        rebuild(job, PRESETS[job.name])


def store_room(job: Job, trial: Trial) -> None:
    """Keep a room for the jobs that rebuild it."""
    records.save(trial, job.room)
    _finish(job, {"objects": len(trial.truth.pieces)})


def rebuild(job: Job, config: Config, densities: EvaluateConfig | None = None) -> None:
    """Rebuild a stored room with one configuration and measure it."""
    if not job.room.with_name(DONE).exists():
        raise FileNotFoundError(f"the room of seed {job.seed} could not be made")
    trial = records.load(Trial, job.room)
    room = reconstruct(trial.capture, config, Run(job.folder))
    records.save(Rebuilt(room.image_only, room.scene), job.folder / "scenes")
    _finish(job, measure(trial, room, densities))
    shutil.rmtree(job.folder / "stages")


def measure(trial: Trial, room: Room, densities: EvaluateConfig | None = None) -> dict[str, Any]:
    """All metrics of the initial scene, of Stage 1 and of the full method, object by object.

    Stage 1 has camera, ground and people of the full method: only the furniture differs.
    """
    bodies = EvaluatedBodies(trial.capture.bodies, room.bodies, trial.bodies)
    image, full = (
        evaluate(trial.capture.scene, scene, trial.truth, bodies, densities)
        for scene in (room.image_only, room.scene)
    )
    rows = zip(trial.traits, image["objects"], full["objects"], strict=True)
    objects = [
        {
            "id": traits.id,
            "category": traits.category,
            "touched": traits.touched,
            "hidden": traits.hidden,
            "initial": one["initial"],
            "image": one["result"],
            "full": other["result"],
        }
        for traits, one, other in rows
    ]
    return {
        "initial": full["initial"],
        "image": image["result"],
        "full": full["result"],
        "objects": objects,
        "warnings": list(room.warnings),
    }


def _finish(job: Job, results: dict[str, Any]) -> None:
    about = {
        "set": job.rooms,
        "seed": job.seed,
        "name": job.name,
        "key": key_of(job),
        "version": __version__,
        "sources": sources()[:16],
    }
    with records.replacing(job.folder / DONE) as part:
        part.write_text(json.dumps(about | results, indent=1, allow_nan=False))


def main(arguments: Sequence[str]) -> None:
    """Do the job that is named on the command line."""
    rooms, seed, name, out = arguments
    torch.set_num_threads(1)
    do_job(Job(rooms, int(seed), name, Path(out)))


if __name__ == "__main__":
    main(sys.argv[1:])
