"""The paper's first table on known rooms: initial, Stage 1 and full, preset by preset.

Every seed and preset is a process of its own; finished ones are files and are not done again.
"""

from collections.abc import Sequence
from pathlib import Path

from mover.core.errors import InputError
from mover.core.observe import Observer, silent
from mover_bench.studies.args import ExperimentArgs
from mover_bench.studies.finished import Source, read_finished
from mover_bench.studies.job import ROOM, Job
from mover_bench.studies.pictures import draw_worst
from mover_bench.studies.queue import Launch, failure_of, finish, has_results, open_jobs, start
from mover_bench.studies.sets import set_named
from mover_bench.studies.study_page import command_of
from mover_bench.studies.tables import Experiment, need_bench, write_tables
from mover_bench.studies.variants import choices, is_variant


def run_experiment(
    args: ExperimentArgs, observe: Observer = silent, launch: Launch | None = None
) -> Path:
    """Do all jobs that are not finished, then write tables and pictures.

    Returns:
        The summary, OUT/SET/summary.md.

    Raises:
        InputError: If a seed, a preset or a set is none.
    """
    seeds = parse_seeds(args.seeds)
    _check(args)
    need_bench()
    rooms = [Job(args.set, seed, ROOM, args.out) for seed in seeds]
    presets = tuple(dict.fromkeys(args.presets))
    rebuilt = [Job(args.set, s, name, args.out) for name in presets for s in seeds]
    jobs = rooms + rebuilt
    waiting = open_jobs(by_room(jobs), args.keep)
    finish(jobs, waiting, args.workers, (observe, launch or start))
    failures = {job: failure_of(job) for job in jobs if not has_results(job)}
    found = read_finished(rebuilt)
    command = command_of(Source(args.set, args.presets), args.seeds)
    experiment = Experiment(command, args.set, presets, seeds, found, failures)
    folder = args.out / args.set
    pictures = draw_worst(experiment, args.set, args.out)
    return write_tables(experiment, pictures, folder)


def parse_seeds(text: str) -> tuple[int, ...]:
    """Read `0-9` or `0,3,5-7`.

    Raises:
        InputError: If it is anything else.
    """
    seeds: set[int] = set()
    for part in text.split(","):
        first, dash, last = part.strip().partition("-")
        ends = [first, last if dash else first]
        if not all(end.isascii() and end.isdigit() for end in ends) or int(ends[1]) < int(ends[0]):
            raise InputError(f"--seeds: {text!r}, expected numbers and ranges like 0,3,5-7")
        seeds.update(range(int(ends[0]), int(ends[1]) + 1))
    return tuple(sorted(seeds))


def by_room(jobs: Sequence[Job]) -> list[Job]:
    """The jobs of a room one after the other, rooms in the order in which they first appear."""
    rooms = {key: place for place, key in enumerate(dict.fromkeys((j.rooms, j.seed) for j in jobs))}
    return sorted(jobs, key=lambda job: rooms[(job.rooms, job.seed)])


def _check(args: ExperimentArgs) -> None:
    set_named(args.set)
    for name in args.presets:
        if not is_variant(name):
            raise InputError(f"--presets: {name!r} is none of {choices()}")
