"""Run an experiment: known rooms beside each other, each with all variants.

A process a room (`python -m mover_bench.experiment.job SET SEED OUT VARIANT ...`) with one
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
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import torch

from mover import __version__
from mover.app.batch import read_tree
from mover.core import records
from mover.core.errors import InputError
from mover.core.files import replacing
from mover.core.observe import Observer, Step, silent
from mover.core.run import Run, sources
from mover.evaluate.bodies import shared_rows
from mover.extensions import reconstruct
from mover.stages.config import RefineBodiesConfig
from mover.stages.people.refine_bodies import refine_bodies
from mover_bench.cli import ExperimentArgs
from mover_bench.experiment.measures import Judge, Trial, under_camera
from mover_bench.experiment.sets import RoomSet, changed, parse_seeds, set_named
from mover_bench.experiment.tables import LOG, path_of, write_tables
from mover_bench.experiment.variants import VARIANTS, Variant, names_in, withheld
from mover_bench.rooms.camera_path import filmed
from mover_bench.rooms.known import KnownRoom, make_room
from mover_bench.rooms.moved import make_moved_room
from mover_bench.rooms.noise import without_seat

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


def is_finished(out: Path, rooms: str, seed: int, name: str) -> bool:
    """Whether numbers of this version are there."""
    found = read_tree(path_of(out, rooms, seed, name))
    return "full" in found and found["key"] == key_of(set_named(rooms), seed, VARIANTS[name])


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


def do_room(out: Path, rooms: str, seed: int, names: Sequence[str]) -> None:
    """Reconstruct and measure the room of a seed under each variant, and write their numbers."""
    chosen = set_named(rooms)
    folder = out / rooms / str(seed)
    room = true_room(seed, chosen)
    for change in dict.fromkeys(VARIANTS[name].change for name in names):
        trial = with_noise(room, seed, changed(chosen, change))
        judge = Judge(trial)
        for name in (name for name in names if VARIANTS[name].change == change):
            about = {"key": key_of(chosen, seed, VARIANTS[name]), "version": __version__}
            try:
                numbers = measured(trial, judge, VARIANTS[name], Run(folder))
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
    open_seeds = [
        seed for seed in seeds if not all(is_finished(args.out, args.set, seed, n) for n in names)
    ]
    jobs = [
        ((args.set, str(seed), str(args.out), *names), args.out / args.set / str(seed) / LOG)
        for seed in open_seeds
    ]
    ended = pool("mover_bench.experiment.job", jobs, args.workers)
    for done, index in enumerate(ended, len(seeds) - len(jobs)):
        observe(Step(f"{args.set} {open_seeds[index]}", done, len(seeds)))
    return write_tables(args, seeds, names)


def main(arguments: Sequence[str]) -> None:
    """Do what is named on the command line."""
    rooms, seed, out, *names = arguments
    torch.set_num_threads(1)
    where = Path(out), rooms, int(seed)
    do_room(*where, [name for name in names if not is_finished(*where, name)])


if __name__ == "__main__":
    main(sys.argv[1:])
