"""The engine's stages beside what a user would pick instead, in one run.

    PYTHONPATH=src:tests python benchmarks/peers.py --scaling --frames 3000 --gate

The workloads: ten objects of 2,000, 10,000 and 20,000 faces in windows of 256 pixels; one body at
640 x 360; with `--frames`, all frames of a walk. The others: the torch oracle, DEODR, Embree,
Open3D, libigl, SciPy and PyTorch3D (`pip install mover[peers]`; what is not installed is left out
with a line). Rows of a stage take turns, so that a busy machine slows all of them; beside each
time stands that of the processor, and the largest memory beyond what was loaded. Then, how far
results are apart. `--gate` fails where a figure is worse than `baseline.json` allows, and only
warns of times; `--write` makes a new baseline; `--only` chooses stages, `--scaling` adds how our
own times grow.
"""

import argparse
import ctypes
import json
import os
import platform
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import torch
from engine import Room, make_room, step
from gate import held, judge
from gather import memory
from gather import scene as walk
from peers_rows import STAGES, Figures, Work
from reference import use_engine

from mover.core.observe import Step
from mover.core.types import Bodies
from mover.geometry.warp_start import use_threads
from mover.stages.config import GatherConfig
from mover.stages.contacts.gather_cues import GatherInputs, gather_cues

BASELINE = Path(__file__).parent / "baseline.json"
Times = dict[str, tuple[float, float, float]]


def measured(work: Work, rounds: int, most: float = 4000.0) -> Times:
    """Least time of the wall and of the processor [ms] and largest memory [MB] of each row.

    Args:
        work: What is measured, in turns.
        rounds: Times that each is measured.
        most: What takes longer in all is not measured again [ms].
    """
    found: Times = {}
    for run in work.values():
        run()  # compiles, loads and fills caches
    trim = getattr(ctypes.CDLL(None), "malloc_trim", lambda _: 0)  # gives back what is free
    for name, run in work.items():
        trim(0)
        memory()
        before = memory()
        run()
        found[name] = (float("inf"), float("inf"), max(memory() - before, 0.0))
    spent = dict.fromkeys(work, 0.0)
    for _ in range(rounds):
        for name, run in work.items():
            if spent[name] < most:
                wall, processor = clock(run)
                spent[name] += wall
                best = found[name]
                found[name] = min(best[0], wall), min(best[1], processor), best[2]
    return found


def clock(run: Callable[[], object]) -> tuple[float, float]:
    """Time of the wall and of the processor [ms]."""
    wall, processor = time.perf_counter(), time.process_time()
    run()
    return 1e3 * (time.perf_counter() - wall), 1e3 * (time.process_time() - processor)


def shown(times: Times) -> None:
    """Print rows."""
    for name, (wall, processor, most) in times.items():
        print(f"  {name:<58} {wall:9.2f} ({processor:9.2f}) ms {most:6.0f} MB", flush=True)


def scaling(rounds: int, cores: int) -> Times:
    """How our own times grow with objects, faces, image size and cores."""
    base = {"objects": 10, "faces": 10000, "window": 256, "cores": cores}
    grow = {"objects": (1, 5, 20), "faces": (2000, 20000), "window": (64, 128, 512), "cores": (1,)}
    rows = [base] + [base | {k: v} for k, values in grow.items() for v in values if base[k] != v]
    found: Times = {}
    for row in rows:
        room = make_room(row["objects"], row["faces"], row["window"])

        def run(room: Room = room, cores: int = row["cores"]) -> None:
            with use_engine("warp"), use_threads(cores):
                step(room)

        name = ", ".join(f"{v} {k}" for k, v in row.items())
        found |= measured({f"scaling: {name}": run}, rounds)
    return found


def part(given: GatherInputs, count: int) -> GatherInputs:
    """The first frames of a walk."""
    b = given.bodies
    few = Bodies(
        b.verts[:count], b.faces, None, (), b.frame[:count], b.person[:count], b.fps, "world", None
    )
    return GatherInputs(few, given.people, given.masks, given.camera)


def frames(counts: Sequence[int], workers: int) -> Times:
    """Gathering of walks at 640 x 360 with a volume of 256 cells, each once, stage by stage."""
    given = walk(max(counts))
    config = GatherConfig(workers=workers)
    gather_cues(part(given, 2), config)
    found: Times = {}
    for count in counts:
        some = part(given, count)
        memory()
        before = memory()
        marks = {"": (time.perf_counter(), time.process_time())}

        def note(now: Step, marks: dict[str, tuple[float, float]] = marks) -> None:
            marks[now.stage] = time.perf_counter(), time.process_time()

        gather_cues(some, config, note)
        note(Step("whole", 0, 0))
        most = max(memory() - before, 0.0)
        names = list(marks)
        for last, name in zip(["", *names[1:-2], ""], names[1:], strict=True):
            wall, busy = (1e3 * (b - a) for a, b in zip(marks[last], marks[name], strict=True))
            found[f"{count} frames: {name.removeprefix('gather_cues: ')}"] = wall, busy, most
    return found


def written(quality: Figures, times: Times) -> dict[str, object]:
    """A baseline of these figures."""
    spent = {
        n: {"wall": round(w, 2), "processor": round(p, 2), "memory": round(m)}
        for n, (w, p, m) in times.items()
    }
    where = {"machine": platform.machine(), "cores": os.cpu_count(), "load": round(load(), 1)}
    return {"where": where, "quality": {n: held(n, v) for n, v in quality.items()}, "times": spent}


def load() -> float:
    """Processes that wanted a processor, of the last minute."""
    return os.getloadavg()[0]


def gated(quality: Figures, times: Times, stages: Sequence[str]) -> bool:
    """Whether the figures of these stages pass the committed gate, told in lines."""
    baseline = json.loads(BASELINE.read_text())
    first = tuple("energy" if s == "iteration" else s for s in stages)
    baseline["quality"] = {n: v for n, v in baseline["quality"].items() if n.startswith(first)}
    verdict = judge(quality, {n: t[0] for n, t in times.items()}, baseline)
    for line in verdict.failures:
        print(f"WORSE  {line}")
    for line in verdict.warnings:
        print(f"slower {line} (only a warning)")
    print(f"gate: {len(baseline['quality'])} figures, {len(verdict.failures)} worse")
    return not verdict.failures


def asked(given: Sequence[str] | None) -> argparse.Namespace:
    """What the command line says."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--rounds", type=int, default=10)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--only", nargs="+", choices=list(STAGES), default=list(STAGES))
    parser.add_argument("--frames", type=int, nargs="*", default=[])
    parser.add_argument("--scaling", action="store_true")
    parser.add_argument("--gate", action="store_true")
    parser.add_argument("--write", action="store_true")
    return parser.parse_args(given)


def main(given: Sequence[str] | None = None) -> None:
    """Print the tables, and judge them where asked."""
    args = asked(given)
    torch.set_num_threads(1)  # with more, torch is no faster here, and waits in a busy loop
    print(f"wall (processor), memory; {args.threads} threads, load {load():.1f} at the start")
    quality: Figures = {}
    times: Times = {}

    def entered(rows: Times) -> None:
        shown(rows)
        times.update(rows)

    for name in args.only:
        work, figures = STAGES[name](args.threads)
        quality |= figures
        entered(measured(work, args.rounds))
    if args.scaling:
        entered(scaling(args.rounds, args.threads))
    if args.frames:
        entered(frames(args.frames, args.threads))
    print(f"how far results are apart; load {load():.1f} at the end")
    for name, value in quality.items():
        print(f"  {name:<58} {value:9.2e}")
    if args.write:
        BASELINE.write_text(json.dumps(written(quality, times), indent=1) + "\n")
    if args.gate and not gated(quality, times, args.only):
        raise SystemExit(1)


if __name__ == "__main__":
    main()
