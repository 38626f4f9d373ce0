"""One job of an experiment: make a known room with noise, or rebuild it and measure.

Each job is a process of its own (`python -m mover_bench.studies.job SET SEED NAME FOLDER`) with one
thread, so that its numbers depend on nothing but its inputs.
"""

import shutil
import statistics
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from mover import __version__
from mover.app.batch import write_tree
from mover.app.results import labels_of
from mover.core import records
from mover.core.observe import Observer, silent
from mover.core.run import Run, sources
from mover.core.types import Bodies, Room, Scene
from mover.evaluate.evaluation import EvaluateConfig
from mover.evaluate.stability import SimulatedObject, loads_in, simulate
from mover.furniture.library import SEATS
from mover.pipeline.reconstruct import Config, reconstruct
from mover.stages.config import RefineBodiesConfig
from mover.stages.people.refine_bodies import refine_bodies
from mover_bench.rooms.camera_path import filmed
from mover_bench.rooms.config import RoomConfig
from mover_bench.rooms.handled import make_handled_room
from mover_bench.rooms.known import KnownRoom
from mover_bench.rooms.moved import make_moved_room
from mover_bench.rooms.noise import without_support
from mover_bench.rooms.room import make_room
from mover_bench.rooms.stepped import make_platform_room, make_stepped_room
from mover_bench.rooms.worked import make_worked_room
from mover_bench.studies.fitted import fitted_trial, measure_fitted
from mover_bench.studies.measures import (
    Trial,
    carry_all,
    measure,
    measure_people,
    measure_true_room,
    measure_truth,
    timing,
    traits_of,
)
from mover_bench.studies.sets import RoomSet, set_named
from mover_bench.studies.variants import Variant, frames_of, is_variant, variant_named, withheld

ROOM = "room"  # the job that makes the room; all others have the name of their variant
DONE = "metrics.json"  # a job that has it is finished
TRUTHS = "truths"  # folder of rooms without noise, which sets share
STAGES = {"initial": "Initial", "image": "Stage 1", "full": "Full"}
"""Scenes that are measured, by their name in the files."""
USES = {
    "sit": "sit", "lean": "sit", "lie": "lie",
    "left hand": "hand", "right hand": "hand", "both hands": "hand",
}  # fmt: skip
"""Interactions that are told apart, by the action of a known room."""


@dataclass(frozen=True)
class Job:
    """One process of an experiment."""

    rooms: str
    """Name of a set, see `changes.set_named`."""
    seed: int
    name: str
    """A variant, or `ROOM`."""
    out: Path
    """Folder of the experiment."""

    @property
    def home(self) -> Path:
        """Where the jobs of its room are, and the stages that they share."""
        return self.out / self.rooms / str(self.seed)

    @property
    def folder(self) -> Path:
        """Where its files are."""
        return self.home / self.name

    @property
    def room(self) -> Path:
        """What the room of its seed is stored as."""
        return self.home / ROOM / ROOM

    @property
    def truths(self) -> Path:
        """Where rooms of its seed without noise are kept, for all sets."""
        return self.out / TRUTHS / str(self.seed)


@records.record
class Rebuilt:
    """The scenes of a job that pictures are drawn from."""

    image: Scene
    full: Scene


@dataclass(frozen=True)
class Seed:
    """What a room is drawn from."""

    seed: int


MAKERS: dict[str, Callable[[int, RoomConfig], KnownRoom]] = {
    "no": make_room, "put": make_moved_room, "stays": make_moved_room,
    "pushed": make_handled_room, "rolled": make_handled_room,
    "step": make_stepped_room, "platform": make_platform_room, "table": make_worked_room,
}  # fmt: skip
"""By `RoomConfig.moved` and `RoomConfig.support`."""


def make_truth(inputs: Seed, config: RoomConfig, observe: Observer = silent) -> KnownRoom:
    """A room without noise, as a stage: sets with the same rooms make it once."""
    del observe
    kind = config.moved if config.support == "no" else config.support
    return MAKERS[kind](inputs.seed, config)


def noisy_room(seed: int, rooms: RoomSet, run: Run | None = None) -> Trial:
    """A generated room of a set, with the noise of the set; `run` keeps the one without noise."""
    recipe = Seed(seed)
    room = (
        make_truth(recipe, rooms.room) if run is None else run.stage(make_truth, recipe, rooms.room)
    )
    return spoilt(room, seed, rooms)


def spoilt(room: KnownRoom, seed: int, rooms: RoomSet) -> Trial:
    """A known room with the noise of a set."""
    capture = filmed(room, rooms.noise, seed, rooms.paths[seed % len(rooms.paths)])
    if rooms.withheld is not None:
        capture = without_support(capture, room, rooms.withheld)
    if "camera" in rooms.exact:
        assert room.truth.ground is not None, "a known room has a floor"
        capture = replace(capture, camera_height=-room.truth.ground)
    if "contacts" in rooms.exact:
        capture = replace(capture, touch=true_contacts(room, capture.bodies))
    traits = traits_of(room, capture.scene)
    return Trial(capture, room.truth, room.bodies, traits, doing_of(room))


def true_contacts(room: KnownRoom, bodies: Bodies | None) -> Float[Tensor, "bodies verts"] | None:
    """1 where the skin of each given body truly touches furniture or the floor, else 0."""
    if bodies is None:
        return None
    true = {
        key: row
        for row, key in enumerate(
            zip(room.bodies.frame.tolist(), room.bodies.person.tolist(), strict=True)
        )
    }
    keys = zip(bodies.frame.tolist(), bodies.person.tolist(), strict=True)
    return room.touching[torch.tensor([true[key] for key in keys])].float()


def held_camera(config: Config) -> Config:
    """The camera stays as it is given, as its height is: nothing is looked for."""
    align = replace(config.align, steps=0)
    return replace(config, align=align, refine=replace(config.refine, rounds=0))


def doing_of(room: KnownRoom) -> tuple[str, ...]:
    """For each body how it uses which piece, such as `sit chair_0`; empty: it uses none."""
    names: list[str] = []
    seats = {k for k, piece in enumerate(room.furniture) if piece.category in SEATS}
    for action, touched in zip(room.actions, room.touched, strict=True):
        known = USES.get(action)
        pieces = Counter(touched[touched >= 0].tolist())
        if known == "hand":  # of who sits at a table the seat is touched most
            pieces = Counter({k: n for k, n in pieces.items() if k not in seats})
        known = known if pieces else None
        most = max(pieces, key=lambda k: (pieces[k], -k)) if pieces else -1
        names.append(f"{known} {room.truth.objects[most].id}" if known else "")
    return tuple(names)


def key_of(job: Job) -> str:
    """Digest of everything that a job's numbers depend on."""
    settings = variant_named(job.name) if is_variant(job.name) else None  # a room has none
    rooms = set_named(job.rooms)
    return records.fingerprint(
        rooms.room, rooms.noise, rooms.exact, rooms.withheld, rooms.paths, rooms.version, job.seed,
        job.name, settings, sources("mover_bench"),
    )  # fmt: skip


def do_job(job: Job) -> None:
    """Do one job, from what is left of it on disk, and write its results."""
    if job.name == ROOM:
        store_room(job, noisy_room(job.seed, set_named(job.rooms), Run(job.truths)))
    else:
        rebuild(job, variant_named(job.name))


def store_room(job: Job, trial: Trial, densities: EvaluateConfig | None = None) -> None:
    """Keep a room for the jobs that rebuild it, and measure the truth itself."""
    records.save(trial, job.room)
    truth = measure_truth(trial, densities)
    _finish(job, {"truth": truth})


def rebuild(job: Job, variant: Variant, densities: EvaluateConfig | None = None) -> None:
    """Rebuild a stored room as a variant does and measure it."""
    run = Run(job.folder if variant.fresh else job.home)
    trial = _given(job, variant, run)
    capture = withheld(trial.capture, variant.hears, variant.cut)
    exact = set_named(job.rooms).exact
    config = held_camera(variant.config) if "camera" in exact else variant.config
    room = reconstruct(capture, config, run)
    if room.bodies is None or variant.cut is not None:
        room = carry_all(room, trial.capture)
    if variant.refined:
        room = replace(room, bodies=refine_bodies(room, capture, RefineBodiesConfig()).bodies)
    stages = timing(run.stages)
    if variant.simulated:
        found = measure_stability(trial.truth, room, run)
    elif variant.fitted:
        found = measure_fitted(trial, room, variant.fitted, job.seed)
    elif variant.bodies:
        found = measure_people(trial, room, variant.bodies)
    else:
        records.save(Rebuilt(room.image_only, room.scene), job.folder / "scenes")
        found = measure(trial, room, run, densities)
        if variant.cut is None:  # no table shows it of parts of a video
            found["true_room"] = measure_true_room(trial, room, run, densities)
    _finish(job, found | {"stages": stages, **_length(trial, variant)})
    shutil.rmtree(job.folder / "stages", ignore_errors=True)


def _given(job: Job, variant: Variant, run: Run) -> Trial:
    """The stored room, with the people that a variant begins with."""
    if not job.room.with_name(DONE).exists():
        raise FileNotFoundError(f"the room of seed {job.seed} could not be made")
    trial = records.load(Trial, job.room)
    return fitted_trial(trial, job.seed, run) if variant.fitted else trial


def _length(trial: Trial, variant: Variant) -> dict[str, float]:
    """How many frames and seconds were given, and how many different interactions are in them."""
    given, truth = trial.capture.bodies, trial.bodies
    if given is None or truth is None or variant.hears == "nobody":
        return {"frames": 0, "seconds": 0.0, "interactions": 0}
    frames = given.frame.unique() if variant.cut is None else frames_of(given, variant.cut)
    seen = torch.isin(truth.frame, frames).tolist()
    uses = {name for name, there in zip(trial.doing, seen, strict=False) if there and name}
    seconds = len(frames) / given.fps if given.fps else 0.0
    return {"frames": len(frames), "seconds": seconds, "interactions": len(uses)}


def _finish(job: Job, results: dict[str, Any]) -> None:
    about = {
        "set": job.rooms,
        "seed": job.seed,
        "name": job.name,
        "key": key_of(job),
        "version": __version__,
        "sources": sources("mover_bench")[:16],
    }
    write_tree(job.folder / DONE, about | results)


def main(arguments: Sequence[str]) -> None:
    """Do the job that is named on the command line."""
    rooms, seed, name, out = arguments
    torch.set_num_threads(1)
    do_job(Job(rooms, int(seed), name, Path(out)))


if __name__ == "__main__":
    main(sys.argv[1:])


def measure_stability(truth: Scene, room: Room, run: Run) -> dict[str, Any]:
    """Let gravity act on the initial scene, the result, and the truth.

    Who sits in the result sits on the same place of each piece in all of them.
    """
    people = room.bodies
    loads = () if people is None else loads_in(labels_of(room, run), room.scene, people.fps)
    scenes = {"initial": room.initial, "image": room.image_only, "full": room.scene,
              "truth": truth}  # fmt: skip
    found = {name: simulate(scene, run, None, loads) for name, scene in scenes.items()}
    objects = [
        {"id": row.id, "category": row.category}
        | {name: _values(rows[place]) for name, rows in found.items() if name != "truth"}
        for place, row in enumerate(found["full"])
        if not row.fixed
    ]
    means = {name: _means(rows) for name, rows in found.items()}
    return {**means, "objects": objects, "warnings": list(room.warnings)}


def _values(row: SimulatedObject) -> dict[str, float]:
    """One piece, under who sits on it where that is worse."""
    return {
        "stands": float(row.stays),
        "toppled": float(row.toppled),
        "moved": max(row.moved, row.moved_loaded),
        "turned": max(row.turned, row.turned_loaded),
        "stuck": row.stuck,
        "load": row.load,
    }


def _means(rows: Sequence[SimulatedObject]) -> dict[str, float]:
    """Of the pieces of a scene that could move."""
    loose = [_values(row) for row in rows if not row.fixed]
    return {name: statistics.fmean(v[name] for v in loose) for name in loose[0]} if loose else {}
