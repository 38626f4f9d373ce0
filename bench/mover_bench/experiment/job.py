"""Run an experiment: known rooms beside each other, each with all variants, measured by the truth.

A process a room (`python -m mover_bench.experiment.job SET SEED STEPS OUT VARIANT ...`) with one
thread. Variants share their finished stages; what is finished is a file OUT/SET/SEED/VARIANT.json
and is not done again; a variant that fails leaves its traceback there.
"""

import json
import os
import shutil
import subprocess
import sys
import time
import traceback
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Bool
from torch import Tensor

from mover import __version__
from mover.app.batch import read_tree
from mover.core import records
from mover.core.errors import InputError
from mover.core.files import replacing, sources
from mover.core.observe import Observer, Step, silent
from mover.core.records import record
from mover.core.run import Run
from mover.core.types import Bodies, Camera, Capture, Room, Scene, SceneObject
from mover.evaluate.bodies import shared_rows
from mover.evaluate.evaluation import EvaluateConfig, EvaluatedBodies, evaluate
from mover.evaluate.scene import Pair, iou3d, unmatched
from mover.extensions import reconstruct
from mover.extensions.moving_camera import bodies_as_given
from mover.furniture.library import SEATS, canonical
from mover.geometry.boxes import box_of
from mover.geometry.mesh import sample_surface
from mover.geometry.placement import changes, place_object, placed_at
from mover.pipeline.result import to_world
from mover.stages.config import RefineBodiesConfig
from mover.stages.objects.prepare_objects import find_regions
from mover.stages.people.refine_bodies import refine_bodies
from mover_bench.cli import ExperimentArgs
from mover_bench.experiment.tables import LOG, path_of, write_tables
from mover_bench.experiment.variants import VARIANTS, Variant, at_most, names_in, withheld
from mover_bench.rooms.config import RoomSet, changed, parse_seeds, set_named
from mover_bench.rooms.known import KnownRoom, make_room
from mover_bench.rooms.moving import filmed, make_moved_room
from mover_bench.rooms.noise import without_seat

NEAR = 0.6  # [m] from the middle of a seat, at most, of its proposal
SOON = 5  # frames after a true change, by which a video of any rate shows the object at rest
SURFACE = 4000  # points that give the height of a seat


@record
class Trial:
    """A known room as the method gets it, and the truth."""

    capture: Capture  #: with noise
    truth: Scene
    bodies: Bodies | None  #: the true people
    used: tuple[bool, ...] = ()
    """Which true objects people sit or lie on, lean on or lay a hand on."""
    touching: Bool[Tensor, "bodies verts"] | None = None
    """Which skin of the capture's bodies truly touches an object or the floor."""


class Judge:
    """Measures scenes of a trial; the initial one once."""

    def __init__(self, trial: Trial, config: EvaluateConfig | None = None) -> None:
        self.trial = trial
        self.config = replace(config or EvaluateConfig(), by_place=False)  # names are known
        people = None if trial.capture.bodies is None else bodies_as_given(trial.capture)
        self.initial = self.scene(trial.capture.scene, people)

    def scene(self, scene: Scene, people: Bodies | None) -> dict[str, Any]:
        """All metrics of a scene: `result` and `objects`."""
        bodies = EvaluatedBodies(None, people, self.trial.bodies)
        given, truth = self.trial.capture.scene, self.trial.truth
        return evaluate(given, scene, truth, bodies, self.config, ("result",))

    def room(self, room: Room) -> dict[str, Any]:
        """All metrics of the initial scene, of Stage 1 and of the full method, object by object.

        Stage 1 has camera, ground and people of the full method: only the furniture differs.
        """
        found = {
            "initial": self.initial,
            "image": self.scene(room.image_only, room.bodies),
            "full": self.scene(room.scene, room.bodies),
        }
        objects = [
            {"id": thing.id, "category": thing.category}
            | {stage: measured["objects"][row]["result"] for stage, measured in found.items()}
            for row, thing in enumerate(self.trial.truth.objects)
        ]
        scenes = self.trial.capture.scene, room.scene, self.trial.truth
        fps = None if room.bodies is None else room.bodies.fps
        return {
            **{stage: measured["result"] for stage, measured in found.items()},
            "objects": objects,
            "unmatched": unmatched(*scenes, by_place=False),
            "proposed": measure_proposals(self.trial, room),
            "moved": measure_moves(self.trial.truth, room.scene, fps),
            "warnings": list(room.warnings),
        }


def measure_moves(truth: Scene, found: Scene, fps: float | None = None) -> dict[str, Any]:
    """Whether objects that are moved stand where they should when, and move when they should.

    Of `objects` that are truly moved: IoU3D in each true stay, how far the nearest change is from
    each true one [s; frames without `fps`] (None: none is), mean IoU3D while a person moves it;
    `false`: how many others are moved by mistake.
    """
    pieces = {piece.id: piece for piece in found.objects}
    rows: list[dict[str, Any]] = []
    for true in truth.objects:
        piece = pieces.get(true.id)
        if not true.segments or piece is None:
            continue
        stays = [segment.frame + SOON for segment in true.segments if segment.mover is None]
        held = [segment.frame for segment in true.segments if segment.mover is not None]
        shared = {
            frame: iou3d(Pair(
                placed_at(piece, frame), found.camera, placed_at(true, frame), truth.camera, 1
            ))
            for frame in (*stays, *held)
        }  # fmt: skip
        late = [
            min((abs(change - when) / (fps or 1.0) for change in changes(piece)), default=None)
            for when in changes(true)
        ]
        on_the_way = sum(shared[frame] for frame in held) / len(held) if held else None
        row = {"iou3d": [shared[frame] for frame in stays], "late": late, "on_the_way": on_the_way}
        rows.append({"id": true.id} | row)
    still = {true.id for true in truth.objects if not true.segments}
    return {"objects": rows, "false": sum(bool(p.segments) for p in found.objects if p.id in still)}


def measure_proposals(trial: Trial, room: Room) -> dict[str, Any]:
    """How well seats that were not given, and are used, are proposed, and what else is.

    A proposal is that of the nearest seat within `NEAR`; others are false.
    """
    given = {thing.id for thing in trial.capture.scene.objects}
    turn = trial.truth.camera.R_cam_world.mT @ room.scene.camera.R_cam_world
    centres = [turn @ box_of(one.proposed).center for one in room.proposals]
    claimed: Counter[int] = Counter()
    rows: list[dict[str, Any]] = []
    for seat, used in zip(trial.truth.objects, trial.used, strict=True):
        if seat.id in given or not used or canonical(seat.category) not in SEATS:
            continue
        away = [float((at - box_of(seat).center)[[0, 2]].norm()) for at in centres]
        near = [k for k, gap in enumerate(away) if gap < NEAR]
        row = {"id": seat.id, "category": seat.category, "found": bool(near)}
        if near:
            best = min(near, key=lambda k: away[k])
            height = seat_height(room.proposals[best].proposed) - seat_height(seat)
            row |= {"centre": away[best], "height": height}
        claimed.update(near)
        rows.append(row)
    return {"withheld": rows, "false": len(centres) - len(claimed)}


def seat_height(seat: SceneObject) -> float:
    """Of the surface that bears people, over the seat's foot [m]."""
    mesh = place_object(seat)
    points, normals = sample_surface(mesh, SURFACE)
    points = points - torch.tensor([0.0, float(mesh.verts[:, 1].min()), 0.0])
    top, _ = find_regions(points, normals, canonical(seat.category))
    return float(top[:, 1].median())


def under_camera(room: Room, capture: Capture, camera: Camera) -> Room:
    """The same room seen by another camera, with all people of the capture as they were given."""
    scene = replace(room.scene, camera=camera)
    return replace(room, scene=scene, bodies=to_world(bodies_as_given(capture), camera), kept=None)


Jobs = Sequence[tuple[Sequence[str], Path]]  #: the words of each, and the file of what it says
Pool = Callable[[str, Jobs, int], Iterator[int]]  #: `run_each`, or what does the same another way
LOOK = 0.05  # [s] between two looks at which jobs have ended
THREADS = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


def run_each(module: str, jobs: Jobs, workers: int) -> Iterator[int]:
    """Run `python -m MODULE WORDS` for each job; yield its index when it has ended.

    So many `workers` run at once; 0: as many as there are cores.
    """
    waiting, running = deque(enumerate(jobs)), dict[int, subprocess.Popen[bytes]]()
    try:
        while waiting or running:
            while waiting and len(running) < (workers or os.cpu_count() or 1):
                index, (words, log) = waiting.popleft()
                log.parent.mkdir(parents=True, exist_ok=True)
                command = [sys.executable, "-m", module, *words]
                with log.open("w") as file:
                    running[index] = subprocess.Popen(
                        command, stdout=file, stderr=file, env=os.environ | THREADS
                    )
            time.sleep(LOOK)
            for index in [k for k, job in running.items() if job.poll() is not None]:
                del running[index]
                yield index
    finally:  # where the user stops, what runs is ended
        for job in running.values():
            job.terminate()
            job.wait()


def true_room(seed: int, rooms: RoomSet) -> KnownRoom:
    """A generated room of a set, without noise."""
    return (make_moved_room if rooms.room.moved else make_room)(seed, rooms.room)


def noisy_room(seed: int, rooms: RoomSet) -> Trial:
    """A generated room of a set, with the noise of the set."""
    return with_noise(true_room(seed, rooms), seed, rooms)


def room_named(name: str) -> Trial:
    """The noisy room SET:SEED."""
    kind, seed = name.split(":")
    return noisy_room(int(seed), set_named(kind))


def with_noise(room: KnownRoom, seed: int, rooms: RoomSet) -> Trial:
    """A known room with the noise of a set."""
    capture = filmed(room, rooms.noise, seed, rooms.paths[seed % len(rooms.paths)])
    if rooms.withheld is not None:
        capture = without_seat(capture, room)
    used = tuple(bool((room.touched == k).any()) for k in range(len(room.truth.objects)))
    touching = None
    if capture.bodies is not None:
        rows, true = shared_rows(capture.bodies, room.bodies)
        touching = torch.zeros(capture.bodies.verts.shape[:2], dtype=torch.bool)
        touching[rows] = room.touching[true]
    return Trial(capture, room.truth, room.bodies, used, touching)


def key_of(rooms: RoomSet, seed: int, variant: Variant) -> str:
    """Digest of everything that the numbers of a variant depend on."""
    made = rooms.room, rooms.noise, rooms.withheld, rooms.paths
    return records.fingerprint(*made, seed, variant, sources("mover_bench"))


def is_finished(out: Path, rooms: str, seed: int, steps: int, name: str) -> bool:
    """Whether numbers of this version are there."""
    found, variant = read_tree(path_of(out, rooms, seed, name)), at_most(VARIANTS[name], steps)
    return "full" in found and found["key"] == key_of(set_named(rooms), seed, variant)


def measured(trial: Trial, judge: Judge, variant: Variant, run: Run) -> dict[str, Any]:
    """Reconstruct a room as a variant does and measure it."""
    capture = withheld(trial.capture, variant.given, variant.cut)
    if variant.given == "true contacts" and trial.touching is not None:
        capture = replace(capture, touch=trial.touching.float())
    room = reconstruct(capture, variant.config, run)
    if room.bodies is None or variant.cut is not None:
        room = under_camera(room, trial.capture, room.scene.camera)
    if variant.refined:
        refined = refine_bodies(room, capture, RefineBodiesConfig())
        room = replace(room, bodies=refined.bodies)
    seconds = sum(stage.seconds for stage in run.stages)
    return judge.room(room) | {"seconds": seconds}


def do_room(out: Path, rooms: str, seed: int, steps: int, names: Sequence[str]) -> None:
    """Reconstruct and measure the room of a seed under each variant, and write their numbers."""
    variants = {name: at_most(VARIANTS[name], steps) for name in names}
    chosen = set_named(rooms)
    folder = out / rooms / str(seed)
    room = true_room(seed, chosen)
    for change in dict.fromkeys(variant.change for variant in variants.values()):
        trial = with_noise(room, seed, changed(chosen, change))
        judge = Judge(trial)
        for name, variant in ((n, v) for n, v in variants.items() if v.change == change):
            about = {"key": key_of(chosen, seed, variant), "version": __version__}
            try:
                numbers = measured(trial, judge, variant, Run(folder))
            except Exception:  # other variants go on; the summary names it
                numbers = {"failed": traceback.format_exc()}
            with replacing(path_of(out, rooms, seed, name)) as part:
                part.write_text(json.dumps(about | numbers, indent=1, allow_nan=False))
    shutil.rmtree(folder / "stages", ignore_errors=True)


def run_experiment(args: ExperimentArgs, observe: Observer = silent, pool: Pool = run_each) -> Path:
    """Do all that is not finished, then write the tables; the summary, OUT/SET/summary.md.

    Raises:
        InputError: If a seed, a variant or a set is none, or pandas is not installed.
    """
    if find_spec("pandas") is None:
        raise InputError("pandas is not installed; pip install -e '.[bench]' in mover's folder")
    seeds, names = parse_seeds(args.seeds), names_in(args.variants)
    set_named(args.set)
    where = args.out, args.set
    open_seeds = [s for s in seeds if not all(is_finished(*where, s, args.steps, n) for n in names)]
    fixed = str(args.steps), str(args.out), *names
    jobs = [((args.set, str(s), *fixed), args.out / args.set / str(s) / LOG) for s in open_seeds]
    ended = pool("mover_bench.experiment.job", jobs, args.workers)
    for done, index in enumerate(ended, len(seeds) - len(jobs)):
        observe(Step(f"{args.set} {open_seeds[index]}", done, len(seeds)))
    return write_tables(args, seeds, names)


def main(arguments: Sequence[str]) -> None:
    """Do what is named on the command line."""
    rooms, seed, steps, out, *names = arguments
    torch.set_num_threads(1)
    where = Path(out), rooms, int(seed), int(steps)
    do_room(*where, [name for name in names if not is_finished(*where, name)])


if __name__ == "__main__":
    main(sys.argv[1:])
