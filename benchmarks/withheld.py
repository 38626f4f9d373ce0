"""Supports that no detector saw: are they found, where and how high, and what else is proposed?

    PYTHONPATH=src python benchmarks/withheld.py --seeds 100-109 --out withheld

Rebuilds the rooms of `--sets` with `robust` (`withheld-seat` lacks the seat that is used most,
`withheld-step` a step, `withheld-table` a table, `rooms` nothing, so that all proposals there are
false; finished stages are kept in `--out`) and prints for each what is missing, how far the
proposal's middle is from it and how much too high its seat or top is [cm], its certainty, and the
number of false proposals. Seeds without such a room (no step fits) are told and left out.
"""

import argparse
from pathlib import Path

import numpy as np
import torch

from mover.core.run import Run
from mover.pipeline.presets import ROBUST
from mover.pipeline.reconstruct import reconstruct
from mover_bench.rooms.known import NoRoomError
from mover_bench.studies.job import noisy_room
from mover_bench.studies.measures import measure_proposals
from mover_bench.studies.run import parse_seeds
from mover_bench.studies.sets import SETS

DEFAULT = ["withheld-seat", "withheld-step", "withheld-table", "rooms"]
Row = tuple[float, float]  # centre and height [cm]; nan where nothing was found


def rows(name: str, seed: int, out: Path) -> tuple[list[Row], int] | None:
    """What became of each support that is missing in a room, and the false proposals."""
    try:
        trial = noisy_room(seed, SETS[name], Run(out / "rooms" / str(seed)))
    except NoRoomError as error:
        print(f"{name} {seed}: left out, there is no such room: {error}", flush=True)
        return None
    room = reconstruct(trial.capture, ROBUST, Run(out / name / str(seed)))
    told = measure_proposals(trial, room)
    found: list[Row] = []
    for one in told["withheld"]:
        away = (100 * one["centre"], 100 * one["height"]) if one["found"] else (np.nan, np.nan)
        found.append(away)
        print(f"{name} {seed} {one['id']}: centre {away[0]:.1f} cm, height {away[1]:+.1f} cm")
    given = ", ".join(f"{p.object.id} ({p.certainty:.2f})" for p in room.proposals) or "nothing"
    print(f"{name} {seed}: proposed {given}; {told['false']} false", flush=True)
    return found, told["false"]


def main() -> None:
    """Print a line for each support and room, and for each set the sums."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", default="100-109")
    parser.add_argument("--out", type=Path, default=Path("withheld"))
    parser.add_argument("--sets", nargs="+", default=DEFAULT)
    args = parser.parse_args()
    torch.set_num_threads(1)
    for name in args.sets:
        tried = [rows(name, seed, args.out) for seed in parse_seeds(args.seeds)]
        all_rows = [row for row in tried if row is not None]
        told = np.array([row for found, _ in all_rows for row in found]).reshape(-1, 2)
        there = told[np.isfinite(told[:, 0])]
        false = sum(count for _, count in all_rows)
        print(f"{name}: {len(there)} of {len(told)} found, {false} false in {len(all_rows)} rooms")
        if len(there):
            within = int((there[:, 0] <= 15).sum()), int((abs(there[:, 1]) <= 4).sum())
            print(f"  centre {there[:, 0].mean():.1f} cm (<= 15 cm in {within[0]}), height"
                  f" {abs(there[:, 1]).mean():.1f} cm (<= 4 cm in {within[1]})")  # fmt: skip


if __name__ == "__main__":
    main()
