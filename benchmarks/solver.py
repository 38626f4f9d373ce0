"""Second-order descents against Adam, and what an iteration costs.

    PYTHONPATH=src python benchmarks/solver.py --rooms 100 101 102
    PYTHONPATH=src python benchmarks/solver.py --iteration

With `--rooms`, known rooms with the noise of the experiments go through the pipeline. Its inputs to
the placing of the objects, by the image alone and with the people, are solved by 3,000 Adam steps
of 0.002 (from the starts that are left after eight short descents), by Adam as in `robust` before
the second-order method, and by the second-order method. With `--iteration`, one evaluation of all
six terms and its gradient is timed on ten objects. Times are of the processor: [s], [ms].
"""

import argparse
import os
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor
from workload import workload

from mover.geometry.raster_engine import use_threads
from mover.minimize import Adam, silent
from mover.minimize_newton import Quasi
from mover.pipeline import reconstruct
from mover.presets import ROBUST
from mover.rooms.noise import NoiseConfig, add_noise
from mover.rooms.room import make_room
from mover.run import Run
from mover.stages.place_objects import (
    PlaceConfig,
    PlaceInputs,
    descend,
    energy_of,
    place_objects,
    with_trees,
)
from mover.stages.starts import best_few, spread
from mover.types import Layout

WITHIN = 1.001  # of Adam's energy
PAPER = Adam(3000, 0.002, 0.002, keep_best=True)
SHORT = Adam(60, 0.03, 0.01, beta2=0.98, keep_best=True)
DESCENT = Adam(200, 0.03, 0.002, beta2=0.98, keep_best=True)
FAST = Quasi(steps=40, reach=0.2)


@dataclass(frozen=True)
class Listening(Run):
    """A run that keeps what is asked of `place_objects`."""

    heard: list[tuple[PlaceInputs, PlaceConfig]] = field(default_factory=list)

    def stage(self, fn: Callable[..., Any], inputs: Any, config: Any) -> Any:  # noqa: ANN401
        """Pass the stage on."""
        if fn is place_objects:
            self.heard.append((inputs, config))
        return fn(inputs, config, self.observe)


def questions(seed: int) -> list[tuple[str, PlaceInputs, PlaceConfig]]:
    """The last placing by the image alone, and the last with the people."""
    capture = add_noise(make_room(seed), NoiseConfig(), seed)
    with tempfile.TemporaryDirectory() as folder:
        run = Listening(Path(folder))
        reconstruct(capture, ROBUST, run)
    image = [q for q in run.heard if q[1].yaws > 1][-1]
    return [("image", *image), ("people", *run.heard[-1])]


def adam(inputs: PlaceInputs, config: PlaceConfig, method: Adam) -> Tensor:
    """Lowest energy of each object by Adam."""
    starts = inputs.starts
    if config.yaws > 1:
        found = descend(inputs, config, spread(starts, config.yaws), SHORT, silent)
        starts = best_few(found.at, found.value, config.keep)
    return descend(with_trees(inputs), config, starts, method, silent).value.amin(0)


def newton(inputs: PlaceInputs, config: PlaceConfig) -> Tensor:
    """The same by second-order descents."""
    fast = replace(config, method=Quasi(), shaken=4)
    if config.yaws > 1:
        fast = replace(fast, short=FAST, coarse=2)
    return place_objects(inputs, fast).energy[0]


def spent(work: Callable[[], Tensor]) -> tuple[Tensor, float]:
    """What it gives, and the processor time [s]."""
    begin = time.process_time()
    return work(), time.process_time() - begin


def compare(rooms: list[int]) -> None:
    """Energies of each object, times of each stage."""
    good, lower, total = 0, 0, 0
    for seed in rooms:
        for name, inputs, config in questions(seed):
            slow, slow_time = spent(lambda i=inputs, c=config: adam(i, c, PAPER))
            mid, mid_time = spent(lambda i=inputs, c=config: adam(i, c, DESCENT))
            fast, fast_time = spent(lambda i=inputs, c=config: newton(i, c))
            print(f"\nroom {seed}, {name}: load {os.getloadavg()[0]:.1f}")
            rows = {"Adam, 3000 steps": (slow, slow_time), "Adam, 200 steps": (mid, mid_time)}
            rows["second order"] = (fast, fast_time)
            for row, (values, seconds) in rows.items():
                cells = " ".join(f"{v:.4f}" for v in values.tolist())
                print(f"  {row:<17} {seconds:7.2f} s  {cells}", flush=True)
            good += int((fast <= slow * WITHIN + 1e-6).sum())
            lower += int((mid <= slow * WITHIN + 1e-6).sum())
            total += len(slow)
    print(f"\nwithin 0.1 % of 3000 steps, or lower: second order {good}/{total},", end=" ")
    print(f"Adam of 200 steps {lower}/{total}")


def iteration(threads: int) -> None:
    """Time of one evaluation with its gradient."""
    print(f"10 objects, robust form, {threads} threads, load {os.getloadavg()[0]:.1f}")
    print(f"{'faces':>6} {'window':>6} {'wall':>8} {'processor':>10}  [ms], least of 30")
    for faces, window in ((2000, 128), (2000, 256), (10000, 128), (10000, 256), (20000, 256)):
        inputs = with_trees(workload(10, faces, window))
        energy, start = energy_of(inputs, ROBUST.place), inputs.starts
        best = (float("inf"), float("inf"))
        for _ in range(30):
            free = Layout(*(
                x.clone().requires_grad_()
                for x in (start.t_world_object, start.yaw, start.log_scale)
            ))  # fmt: skip
            wall, processor = time.perf_counter(), time.process_time()
            with use_threads(threads):
                torch.autograd.backward(energy(free).total)
            took = (time.perf_counter() - wall) * 1e3, (time.process_time() - processor) * 1e3
            best = min(best[0], took[0]), min(best[1], took[1])
        print(f"{faces:>6} {window:>6} {best[0]:8.2f} {best[1]:10.2f}", flush=True)


def main() -> None:
    """Print what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rooms", type=int, nargs="*", default=[])
    parser.add_argument("--iteration", action="store_true")
    parser.add_argument("--threads", type=int, default=2)
    args = parser.parse_args()
    torch.set_num_threads(1)
    if args.iteration or not args.rooms:
        iteration(args.threads)
    if args.rooms:
        compare(args.rooms)


if __name__ == "__main__":
    main()
