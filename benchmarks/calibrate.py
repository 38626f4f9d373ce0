"""Are stated doubts true? Learns their factors on some known rooms, and tests them on others.

    python benchmarks/calibrate.py --learn 100-107 --check 108-111 --write

rebuilds the rooms with true meshes, with wrong ones and with inputs of today's tools (jobs of
`mover experiment` on `rooms`, `wrong-shape` and `upstream`, or `--sets`; what is finished in
`--out` is not done again), prints how many values the 90 % ranges hold, how wide they are and
whether their widths rank with the errors, in each room learnt on with what the others teach and in
those to check, and with `--write` replaces `src/mover/evaluate/calibration.json`. Rooms 0-9 and
from 1000 on are for results: nothing is learnt on them. `--learn "" --check 1000-1029` tests what
the package holds on the held-out rooms.
"""

import argparse
import json
import os
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
import torch
from calibrate_learn import Judged, held, in_turn, learn, learn_factor, offs, width
from jaxtyping import Float
from scipy.stats import spearmanr
from torch import Tensor

from mover.core import records
from mover.core.explanation import Explanation, Facts
from mover.core.files import replacing
from mover.core.types import Scene, SceneObject
from mover.evaluate.calibration import (
    FORMAT,
    GROWING,
    KIND_OF,
    VERSION,
    Calibration,
    calibration_of,
)
from mover.evaluate.explanation import LEVEL, explain, ways_of
from mover.geometry.boxes import box_of
from mover.geometry.rotations import wrap
from mover.pipeline.presets import PRESETS
from mover_bench.rooms.room import make_room
from mover_bench.studies.args import ExperimentArgs
from mover_bench.studies.job import ROOM, Job, Rebuilt
from mover_bench.studies.queue import open_jobs, run_all, start
from mover_bench.studies.run import parse_seeds
from mover_bench.studies.sets import set_named

USED = ("rooms", "wrong-shape", "upstream")
"""True meshes, meshes of other pieces, and all as today's tools give it; all have one truth."""
HEAD = (
    "| | values | held by 90 % ranges | median width | best constant width | Spearman |",
    "| --- | --: | --: | --: | --: | --: |",
)
ASSET = Path(__file__).parents[1] / "src" / "mover" / "evaluate" / "calibration.json"


def judged(facts: tuple[Facts, ...], result: Scene, truth: Scene) -> Judged:
    """The true unknowns beside the stated ones: each scene in its own upright world."""
    true = {piece.id: piece for piece in truth.objects}
    pairs = [(f, p) for f, p in zip(facts, result.objects, strict=True) if p.id in true]
    rows = [_row(f, p, true[p.id]) for f, p in pairs]  # others were invented
    return Judged(tuple(f for f, _ in pairs), torch.stack(rows))


def _row(facts: Facts, ours: SceneObject, true: SceneObject) -> Float[Tensor, "7"]:
    a, b = box_of(ours), box_of(true)
    base = b.center.double()
    base[1] -= b.size[1].double() / 2
    yaw = facts.place[3] + wrap(b.yaw - a.yaw).double()
    size = facts.place[4:] + (b.size / a.size).log().double()
    return torch.cat([base, yaw[None], size])


def table(rooms: list[Judged], calibrations: Sequence[Calibration]) -> str:
    """Coverage, width and rank, by kind of unknown; each room with a calibration."""
    pairs = zip(rooms, calibrations, strict=True)
    told = tuple(e for room, known in pairs for e in explain(room.facts, known))
    truth = torch.cat([room.truth for room in rooms])
    return "\n".join([*HEAD, *(_line(kind, told, truth) for kind in GROWING)])


def _line(kind: str, told: tuple[Explanation, ...], truth: Float[Tensor, "objects 7"]) -> str:
    rows = [
        (e, way, t)
        for e, t in zip(told, truth, strict=True)
        for way in ways_of(e.facts.place)[[k == kind for k in KIND_OF]]
    ]
    hold = float(np.mean([held(*row) for row in rows]))
    widths = np.array([width(e, way) for e, way, _ in rows])
    errors = np.array([offs(*row)[0] for row in rows])
    constant = 2 * learn_factor(errors.tolist(), LEVEL)
    rank = float(spearmanr(widths, errors)[0])
    cells = kind, len(rows), f"{hold:.1%}", f"{np.median(widths):.3f}", f"{constant:.3f}"
    return "| " + " | ".join(map(str, cells)) + f" | {rank:.2f} |"


def finished(
    seeds: tuple[int, ...], asked: ExperimentArgs, sets: Sequence[str]
) -> list[list[Judged]]:
    """The judged rooms of each set, seed by seed; jobs that are not finished are done first."""
    (preset,) = asked.presets
    workers = asked.workers or os.cpu_count() or 1
    jobs = [Job(n, s, job, asked.out) for s in seeds for n in sets for job in (ROOM, preset)]
    for job in run_all(open_jobs(jobs, asked.keep), workers, start, store=False):
        print(f"{job.rooms} {job.seed}: {job.name}", file=sys.stderr)
    with ProcessPoolExecutor(workers) as pool:
        truths = list(pool.map(truth_of, seeds))
    pairs = list(zip(seeds, truths, strict=True))
    return [[of_job(Job(n, s, preset, asked.out), truth) for n in sets] for s, truth in pairs]


def truth_of(seed: int) -> Scene:
    """The true furniture of a room, the same in all of `USED`."""
    torch.set_num_threads(1)
    return make_room(seed, set_named(USED[0]).room).truth


def of_job(job: Job, truth: Scene) -> Judged:
    """What a finished job stated, and the truth."""
    rebuilt = records.load(Rebuilt, job.folder / "scenes")
    return judged(rebuilt.facts, rebuilt.full, truth)


def tables(
    groups: list[list[Judged]], calibrations: Sequence[Calibration], sets: Sequence[str]
) -> str:
    """A table for each set, and one for all; each seed with a calibration."""
    parts: list[str] = []
    for k, name in enumerate(sets):
        parts += [f"## {name}", table([group[k] for group in groups], calibrations)]
    flat = [room for group in groups for room in group]
    parts += ["## All", table(flat, [c for c in calibrations for _ in sets])]
    return "\n\n".join(parts)


def learnable(text: str) -> tuple[int, ...]:
    """Seeds, none of those that results are reported on."""
    seeds = parse_seeds(text)
    if any(not 100 <= s < 1000 for s in seeds):
        raise SystemExit(f"seeds {text}: those below 100 and from 1000 on are not to be learnt on")
    return seeds


def main() -> None:
    """Learn on some rooms and test on others."""
    parser = argparse.ArgumentParser(description="Learn and test the doubts' calibration.")
    parser.add_argument("--learn", default="100-117", help="rooms to learn on; '' takes the asset")
    parser.add_argument("--check", default="", help="rooms to test on")
    parser.add_argument("--preset", default="robust")
    parser.add_argument("--sets", nargs="+", default=list(USED), help="of the same rooms")
    parser.add_argument("--out", type=Path, default=Path("experiments"))
    parser.add_argument("--workers", type=int, default=0)
    parser.add_argument("--keep", action="store_true", help="take what other versions finished")
    parser.add_argument("--write", action="store_true", help="replace the package's factors")
    args = parser.parse_args()
    asked = ExperimentArgs("", (args.preset,), args.out, args.workers, keep=args.keep)
    form = PRESETS[args.preset].place.form
    calibration = calibration_of(form)
    if args.learn:
        groups = finished(learnable(args.learn), asked, args.sets)
        calibration = learn([room for group in groups for room in group])
        print(f"learnt on {args.learn}: {calibration}")
        if len(groups) > 2:
            print(f"each of {args.learn} tested with what the others teach")
            print(tables(groups, in_turn(groups), args.sets))
    if args.check:
        print(f"\ntested on {args.check}")
        groups = finished(parse_seeds(args.check), asked, args.sets)
        print(tables(groups, [calibration] * len(groups), args.sets))
    if args.write:
        write(form, calibration, f"{args.learn} --sets {' '.join(args.sets)}")


def write(form: str, calibration: Calibration, learnt_on: str) -> None:
    """Put the factors of one form of the prices into the package."""
    tree = json.loads(ASSET.read_text()) | {"format": FORMAT, "version": VERSION}
    tree["forms"][form] = {
        "factors": {kind: round(f, 4) for kind, f in calibration.factors.items()},
        "powers": dict(calibration.powers),
        "share": round(calibration.share, 4),
        "command": f"python benchmarks/calibrate.py --learn {learnt_on} --write",
    }
    with replacing(ASSET) as part:
        part.write_text(json.dumps(tree, indent=1) + "\n")


if __name__ == "__main__":
    main()
