"""Make a set of rooms: in parallel, resumable, with a manifest that can be compared.

Hashes of held-out rooms are part of the package (rooms/hashes): a room that another machine or
another version makes differently is found by `--check`, which also names those without a hash.
"""

import json
import math
import os
import platform
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import torch

from mover import __version__
from mover.app.batch.runner import LOG, Running, start_main
from mover.core.errors import InputError
from mover.core.files import replacing
from mover.core.observe import Observer, Step, silent
from mover.core.records import plain
from mover_bench.studies.args import MakeArgs
from mover_bench.studies.job import DONE, Job
from mover_bench.studies.made import MADE, differences, is_made
from mover_bench.studies.queue import PRELOADED, Launch, failure_of, has_results, run_all
from mover_bench.studies.run import parse_seeds
from mover_bench.studies.sets import SETS

LICENCE = "CC0-1.0"  # of the rooms; the program is Apache-2.0
HASHES = Path(__file__).parents[1] / "rooms" / "hashes"
KEPT = ("truth", "capture", "pixels")  # what is compared


@dataclass(frozen=True)
class Made:
    """What came of it."""

    manifest: Path
    rows: Mapping[str, Mapping[str, Any]]
    """What is in each room, by its seed."""
    failed: Mapping[str, str]
    """Why a room could not be made, by its seed."""
    changed: Mapping[str, Sequence[str]]
    """Rooms that are not as the package knows them, and in what; empty without `check`."""
    unknown: tuple[str, ...]
    """Rooms that the package does not know; empty without `check`."""


def make_set(args: MakeArgs, observe: Observer = silent, launch: Launch | None = None) -> Made:
    """Make all rooms that are not there, then write OUT/SET/manifest.json and hashes.json.

    Args:
        args: What to make.
        observe: Told of every room that is made.
        launch: Starts a job; None: as a process of its own.

    Raises:
        InputError: If the set or a seed is none.
    """
    if args.set not in SETS:
        raise InputError(f"SET: {args.set!r} is none of {', '.join(SETS)}")
    if args.workers < 0:
        raise InputError(f"--workers: {args.workers}, expected 0 or more")
    seeds = parse_seeds(args.seeds or SETS[args.set].seeds)
    jobs = [Job(args.set, seed, MADE, args.out) for seed in seeds]
    todo = [job for job in jobs if not is_made(job, args.captures, args.keep)]
    workers, done = args.workers or os.cpu_count() or 1, len(jobs) - len(todo)
    for job in run_all(todo, workers, launch or partial(start, captures=args.captures)):
        done += 1
        observe(Step(f"{args.set} {job.seed}", done - 1, len(jobs)))
    rows = {str(job.seed): _row(job) for job in jobs if has_results(job)}
    failed = {str(job.seed): failure_of(job) for job in jobs if not has_results(job)}
    manifest = _write_manifests(args, rows, failed)
    known = known_hashes(args.set) if args.check else {}
    wrong = {seed: differences(rows[seed], known[seed]) for seed in rows if seed in known}
    return Made(
        manifest,
        rows,
        failed,
        {seed: names for seed, names in wrong.items() if names},
        tuple(seed for seed in rows if args.check and seed not in known),
    )


def start(job: Job, captures: bool) -> Running[int]:
    """Start the making of a room; what it says goes to its log."""
    words = [job.rooms, str(job.seed), str(job.out), *(["captures"] if captures else [])]
    return start_main("mover_bench.studies.made", words, job.folder / LOG, PRELOADED)


def known_hashes(name: str) -> dict[str, dict[str, Any]]:
    """The hashes of a set's held-out rooms that are part of the package, by seed.

    Raises:
        InputError: If the package has none for this version of the set.
    """
    path = HASHES / f"{name}.json"
    tree = json.loads(path.read_text()) if path.exists() else {}
    if tree.get("version") != SETS[name].version:
        raise InputError(f"--check: the package has no hashes of {name} {SETS[name].version}")
    return tree["rooms"]


def told(made: Made, check: bool) -> str:
    """What came of it, in words."""
    rows = list(made.rows.values())
    lines = [f"{len(rows)} rooms: {made.manifest}"]
    if rows:
        names = ("pieces", "people", "seconds", "touched", "stays", "hidden", "truncated")
        lines.append("mean: " + ", ".join(f"{n} {_mean(rows, n):.3g}" for n in names))
    lines += [f"room {seed} failed: {why}" for seed, why in made.failed.items()]
    lines += [f"room {seed} differs in {', '.join(n)}" for seed, n in made.changed.items()]
    lines += [f"room {seed}: the package does not know it" for seed in made.unknown]
    if check and not made.changed:
        lines.append(f"{len(rows) - len(made.unknown)} rooms are as the package knows them")
    return "\n".join(lines)


def _row(job: Job) -> dict[str, Any]:
    row = json.loads((job.folder / DONE).read_text())
    return {name: value for name, value in row.items() if name != "key"}


def _mean(rows: Sequence[Mapping[str, Any]], name: str) -> float:
    return math.fsum(row[name] for row in rows) / max(1, len(rows))


def _write_manifests(
    args: MakeArgs, rows: Mapping[str, Mapping[str, Any]], failed: Mapping[str, str]
) -> Path:
    """The whole manifest, and the hashes alone as the package holds them; returns the former."""
    rooms, folder = SETS[args.set], args.out / args.set
    about = {"format": "mover-rooms", "set": args.set, "version": rooms.version}
    means = {n: round(_mean(list(rows.values()), n), 4) for n in _numbers(rows)}
    tree = {
        **about,
        "about": rooms.about,
        "licence": LICENCE,
        "held_out": rooms.seeds,
        "development": rooms.development,
        "room": plain(rooms.room),
        "noise": plain(rooms.noise),
        "made_by": {
            "mover": __version__,
            "python": platform.python_version(),
            "torch": torch.__version__,
            "machine": f"{platform.system()} {platform.machine()}",
        },
        "mean": means,
        "rooms": rows,
        "failed": failed,
    }
    hashes = {**about, "rooms": {s: {n: row[n] for n in KEPT} for s, row in rows.items()}}
    for name, content in (("manifest.json", tree), ("hashes.json", hashes)):
        with replacing(folder / name) as part:
            part.write_text(json.dumps(content, indent=1) + "\n")
    return folder / "manifest.json"


def _numbers(rows: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Names of what has a mean."""
    first = next(iter(rows.values()), {})
    return [n for n, v in first.items() if isinstance(v, int | float)]
