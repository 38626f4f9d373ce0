"""Second-order descents against Adam, and what an iteration costs.

    PYTHONPATH=src python benchmarks/solver.py --rooms 100 101 102 --keep FOLDER
    PYTHONPATH=src python benchmarks/solver.py --iteration
    PYTHONPATH=src python benchmarks/solver.py --adam 3000

With `--rooms`, known rooms with the noise of the experiments go through the pipeline. Its inputs to
the placing of the objects, by the image alone and with the people, are solved by 3,000 Adam steps
of 0.002 (from the starts that are left after the short descents of `robust`), by 200 faster ones,
and by the second-order method from the same starts, shaken as in `robust` and longer. `--keep`
leaves the inputs in a folder, and takes them from there. With `--iteration`, one evaluation of all
terms and its gradient is timed on ten objects, by one kernel and term by term; with `--adam`, a
whole descent.
Times are of the wall and of the processor: [s], [ms]. With `--gate`, the run fails where the two
ways to compute disagree. `--device cuda` takes iterations and descents to an NVIDIA GPU, where
there is no kernel for all terms: both columns of `--iteration` are then term by term.
"""

import argparse
import os
import pickle
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, get_args

import torch
from torch import Tensor
from workload import workload

from mover.core.devices import CPU, Choice, device_of, finish, named
from mover.core.observe import Energy, silent
from mover.core.records import to_device
from mover.core.run import Run
from mover.core.types import Layout
from mover.energy.config import Adam, BatchedBFGS, SceneConfig
from mover.energy.fused.energy import energy_function
from mover.energy.objective import scene_energy
from mover.geometry.warp_start import use_threads
from mover.pipeline.presets import ROBUST
from mover.pipeline.reconstruct import reconstruct
from mover.stages.config import PlaceConfig
from mover.stages.objects.place_inputs import PlaceInputs
from mover.stages.objects.place_objects import descend, place_objects, starts_left, with_trees
from mover_bench.rooms.config import NoiseConfig
from mover_bench.rooms.noise import add_noise
from mover_bench.rooms.room import make_room

WITHIN = 1.001  # of Adam's energy
PAPER = Adam(3000, 0.002, 0.002, keep_best=True)
DESCENT = Adam(200, 0.03, 0.002, beta2=0.98, keep_best=True)
SHAKES = {
    "robust": (ROBUST.place.perturbations, ROBUST.place.perturbation_rounds),
    "second order": (12, 4),
}


@dataclass(frozen=True)
class Listening(Run):
    """A run that keeps what is asked of `place_objects`."""

    heard: list[tuple[PlaceInputs, PlaceConfig]] = field(default_factory=list)

    def stage(self, fn: Callable[..., Any], inputs: Any, config: Any) -> Any:  # noqa: ANN401
        """Pass the stage on."""
        if fn is place_objects:
            self.heard.append((inputs, config))
        return fn(inputs, config, self.observe)


Question = tuple[str, PlaceInputs, PlaceConfig]
Timed = tuple[Tensor, float, float]


def kept(seed: int, folder: Path | None) -> list[Question]:
    """The questions of a room, from the folder if they are there, else left there."""
    if folder is None:
        return questions(seed)
    path = folder / f"{seed}.pkl"
    if not path.exists():
        folder.mkdir(parents=True, exist_ok=True)
        path.write_bytes(pickle.dumps(questions(seed)))
    return pickle.loads(path.read_bytes())


def questions(seed: int) -> list[Question]:
    """The last placing by the image alone, and the last with the people."""
    capture = add_noise(make_room(seed), NoiseConfig(), seed)
    with tempfile.TemporaryDirectory() as folder:
        run = Listening(Path(folder))
        reconstruct(capture, ROBUST, run)
    image = [q for q in run.heard if q[1].yaws > 1][-1]
    return [("image", *image), ("people", *run.heard[-1])]


def adam(inputs: PlaceInputs, config: PlaceConfig, method: Adam) -> Tensor:
    """Lowest energy of each object by Adam."""
    inputs = with_trees(inputs)
    starts = starts_left(inputs, config)
    return descend(inputs, config, starts, method, silent).value.amin(0)


def newton(inputs: PlaceInputs, config: PlaceConfig, count: int, rounds: int) -> Tensor:
    """The same by second-order descents."""
    fast = replace(config, method=BatchedBFGS(), perturbations=count, perturbation_rounds=rounds)
    return place_objects(inputs, fast).energy.amin(0)


def spent(work: Callable[[], Tensor]) -> Timed:
    """What it gives, the time of the wall and that of the processor [s]."""
    wall, processor = time.perf_counter(), time.process_time()
    found = work()
    return found, time.perf_counter() - wall, time.process_time() - processor


def compare(rooms: list[int], folder: Path | None) -> None:
    """Energies of each object, times of each stage."""
    shares: dict[str, list[Tensor]] = {"Adam, 200 steps": [], **{name: [] for name in SHAKES}}
    slowest = dict.fromkeys(SHAKES, 0.0)
    for seed in rooms:
        for name, inputs, config in kept(seed, folder):
            slow = spent(lambda i=inputs, c=config: adam(i, c, PAPER))
            mid = spent(lambda i=inputs, c=config: adam(i, c, DESCENT))
            fast = {
                row: spent(lambda i=inputs, c=config, s=shakes: newton(i, c, *s))
                for row, shakes in SHAKES.items()
            }
            print(f"\nroom {seed}, {name}: load {os.getloadavg()[0]:.1f}")
            rows = {"Adam, 3000 steps": slow, "Adam, 200 steps": mid, **fast}
            for row, (values, wall, processor) in rows.items():
                cells = " ".join(f"{v:.4f}" for v in values.tolist())
                print(f"  {row:<17} {wall:6.2f} {processor:6.2f} s  {cells}", flush=True)
                if row in shares:
                    shares[row].append((values - 1e-6) / slow[0].clamp_min(1e-6))
            slowest = {row: max(slowest[row], fast[row][1]) for row in SHAKES}
    print("\nwithin 0.1 % of 3000 steps, or lower:")
    for row, found in shares.items():
        every = torch.cat(found)
        good, worst = int((every <= WITHIN).sum()), 100 * (float(every.max()) - 1)
        print(f"  {row:<17} {good} of {len(every)}, worst {worst:+.2f} %")
    for row, wall in slowest.items():
        print(f"slowest placing, {row}: {wall:.2f} s of the wall")


def told(energy: Callable[[Layout], Energy], start: Layout) -> Tensor:
    """Energy and gradient of each object in a row."""
    free = Layout(*(
        x.clone().requires_grad_() for x in (start.t_world_object, start.yaw, start.log_scale)
    ))  # fmt: skip
    value = energy(free).per_item
    slopes = torch.autograd.grad(value.sum(), [free.t_world_object, free.yaw, free.log_scale])
    rows = [value.detach(), slopes[0], slopes[1], slopes[2]]
    return torch.cat([r.reshape(value.numel(), -1) for r in rows], -1)


def least(
    work: Callable[[], object], rounds: int, device: torch.device = CPU
) -> tuple[float, float]:
    """Least time of the wall and of the processor [ms]."""
    best = (float("inf"), float("inf"))
    for _ in range(rounds):
        wall, processor = time.perf_counter(), time.process_time()
        work()
        finish(device)
        took = (time.perf_counter() - wall) * 1e3, (time.process_time() - processor) * 1e3
        best = min(best[0], took[0]), min(best[1], took[1])
    return best


def iteration(threads: int, device: torch.device = CPU) -> bool:
    """Time of one evaluation with its gradient; whether both ways give the same."""
    where = f"{named(device)}, {threads} threads, load {os.getloadavg()[0]:.1f}"
    print(f"10 objects, robust form, {where}")
    print("faces window | one kernel: wall, processor | terms: wall, processor [ms] | off: E, grad")
    good = True
    for faces, window in ((2000, 128), (2000, 256), (10000, 128), (10000, 256), (20000, 256)):
        inputs = with_trees(to_device(workload(10, faces, window), device))
        place, start = ROBUST.place, inputs.starts
        rest = inputs.objects, inputs.camera, inputs.image, inputs.humans
        scene = SceneConfig(place.weights, place.form)
        fast = energy_function(*rest, scene)

        def slow(layout: Layout, rest: Any = rest, scene: SceneConfig = scene) -> Energy:  # noqa: ANN401
            return scene_energy(layout, *rest, scene)

        with use_threads(threads):
            a = least(lambda f=fast, s=start: told(f, s), 30, device)
            b = least(lambda f=slow, s=start: told(f, s), 6, device)
            one, two = told(fast, start), told(slow, start)
        value = float((one[:, 0] - two[:, 0]).abs().max())
        slope = float((one[:, 1:] - two[:, 1:]).norm() / two[:, 1:].norm())
        good = good and value < 1e-5 and slope < 1e-3
        print(
            f"{faces:>5} {window:>6} | {a[0]:8.2f} {a[1]:8.2f} | {b[0]:8.2f} {b[1]:8.2f}"
            f" | {value:.0e} {slope:.0e}",
            flush=True,
        )
    return good


def whole(steps: int, threads: int, device: torch.device = CPU) -> None:
    """Time of a descent with Adam."""
    inputs = with_trees(to_device(workload(10, 10000, 256), device))
    method = Adam(steps, 0.002, 0.002, keep_best=True)
    with use_threads(threads):
        if device.type == "cuda":  # compiling is no part of a descent
            descend(inputs, ROBUST.place, inputs.starts, replace(method, steps=1), silent)
        finish(device)
        wall, processor = time.perf_counter(), time.process_time()
        descend(inputs, ROBUST.place, inputs.starts, method, silent)
        finish(device)
    wall, processor = time.perf_counter() - wall, time.process_time() - processor
    print(
        f"{steps} steps of Adam, 10 objects of 10000 faces, 256 x 256, {named(device)},"
        f" {threads} threads:",
        end="",
    )
    print(f" wall {wall:.1f} s, processor {processor:.1f} s, load {os.getloadavg()[0]:.1f}")


def main() -> None:
    """Print what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rooms", type=int, nargs="*", default=[])
    parser.add_argument("--keep", type=Path)
    parser.add_argument("--iteration", action="store_true")
    parser.add_argument("--adam", type=int, default=0)
    parser.add_argument("--gate", action="store_true")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--device", choices=get_args(Choice), default="cpu")
    args = parser.parse_args()
    device = device_of(args.device)
    torch.set_num_threads(1)
    if args.adam:
        whole(args.adam, args.threads, device)
    if args.rooms:
        with use_threads(args.threads):
            compare(args.rooms, args.keep)
    asked = args.iteration or not (args.rooms or args.adam)
    if asked and not iteration(args.threads, device):
        print("the kernel and the terms disagree")
        raise SystemExit(int(args.gate))


if __name__ == "__main__":
    main()
