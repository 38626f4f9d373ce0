"""Do rebuilt rooms stand still? Settles truth, initial scene and results of a finished experiment.

Needs `mover experiment --presets robust --seeds 0-9 --out experiments`, then
`python benchmarks/settle.py experiments`.
"""

import argparse
import statistics
import tempfile
from pathlib import Path

from mover.app.simulate import SimulatedObject, simulate
from mover.core import records
from mover.core.run import Run
from mover.core.types import Scene
from mover_bench.studies.job import Rebuilt
from mover_bench.studies.measures import Trial


def main() -> None:
    """Print how far the furniture of each scene moves under gravity."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path, help="folder of the experiment")
    parser.add_argument("--set", default="rooms", help="set of rooms")
    parser.add_argument("--preset", default="robust", help="whose results")
    args = parser.parse_args()
    found: dict[str, list[SimulatedObject]] = {"truth": [], "initial": [], "image": [], "full": []}
    seeds = sorted(int(p.name) for p in (args.out / args.set).iterdir() if p.name.isdigit())
    for seed in seeds:
        folder = args.out / args.set / str(seed)
        trial = records.load(Trial, folder / "room" / "room")
        rebuilt = records.load(Rebuilt, folder / args.preset / "scenes")
        scenes: dict[str, Scene] = {
            "truth": trial.truth,
            "initial": trial.capture.scene,
            "image": rebuilt.image,
            "full": rebuilt.full,
        }
        with tempfile.TemporaryDirectory() as work:  # in which each shape is cut only once
            for name, scene in scenes.items():
                rows = simulate(scene, Run(Path(work)))
                found[name].extend(rows)
                most = 100 * max(row.moved for row in rows)
                print(
                    f"seed {seed} {name:8} {len(rows)} pieces, farthest {most:7.2f} cm", flush=True
                )
    print(f"\n{'scene':8} {'pieces':>6} {'moved, median, mean, max [cm]':>32} {'toppled':>8}")
    for name, rows in found.items():
        moved = [100 * row.moved for row in rows]
        three = (statistics.median(moved), statistics.mean(moved), max(moved))
        numbers = " ".join(f"{value:9.3f}" for value in three)
        print(f"{name:8} {len(rows):6} {numbers:>32} {sum(r.toppled for r in rows):8}")


if __name__ == "__main__":
    main()
