"""Which sources determine the scale of a room without a known height: each alone, all but each.

    python benchmarks/scale.py --rooms upstream:1000 upstream:1001
    python benchmarks/scale.py CAPTURE=HEIGHT...     # with the true height of its camera [m]

Each room is reconstructed once, and its scale estimated from some of the sources
(`stages.objects.room_scale`). Printed for each choice: the root mean square of the errors [%] and
its difference from that of all sources with its 95 % interval over rooms, the mean error, and the
root mean square of errors over stated spreads. Rooms of known scale are passed over.
"""

import argparse
import math
import tempfile
from collections.abc import Callable
from pathlib import Path
from unittest.mock import patch

import numpy as np
import torch

from mover.core.run import Run
from mover.core.types import Capture, Layout
from mover.energy.prior_terms import Given
from mover.io.capture.folder import read_capture
from mover.pipeline import objects
from mover.pipeline.presets import PRESETS
from mover.pipeline.reconstruct import reconstruct
from mover.stages.objects.room_scale import SOURCES, ScaleKnown, common_scale
from mover_bench.experiment.job import Trial, room_named
from mover_bench.experiment.tables import LEVEL, RESAMPLES

CHOICES: dict[str, tuple[str, ...]] = {
    "all": SOURCES,
    **{f"{one} alone": (one,) for one in SOURCES},
    **{f"without {one}": tuple(x for x in SOURCES if x != one) for one in SOURCES},
}
Known = tuple[Layout, Given, tuple[str, ...], ScaleKnown]
NONE = "none: as the people have it"


def errors_of(capture: Capture, height: float) -> dict[str, tuple[float, float]]:
    """Error of the logarithm of the scale and its stated spread, for each choice."""
    found: list[Known] = []

    def spy(*args: *Known) -> tuple[float, float]:
        found.append(args)
        return common_scale(*args)

    with tempfile.TemporaryDirectory() as folder, patch.object(objects, "common_scale", spy):
        room = reconstruct(capture, PRESETS["robust"], Run(Path(folder)))
    if not found:
        return {}
    scale, _ = common_scale(*(args := found[0]))
    assert room.scene.ground is not None
    true = math.log(-room.scene.ground / height) + scale  # before it was divided by the scale
    errors = {NONE: (-true, args[-1].people[1])}
    for name, sources in CHOICES.items():
        if sources != ("seats",) or args[-1].seats is not None:
            value, spread = common_scale(*args, sources)
            errors[name] = value - true, spread
    return errors


def table(rooms: list[dict[str, tuple[float, float]]]) -> list[str]:
    """A line for each choice."""
    rng, lines = np.random.default_rng(0), list[str]()

    def rms(values: np.ndarray) -> np.ndarray:
        return np.sqrt(np.square(values).mean(-1))

    for name in [*CHOICES, NONE]:
        some = [room for room in rooms if name in room]
        if not some:
            continue
        error, spread = np.array([room[name] for room in some]).T
        whole = np.array([room["all"][0] for room in some])
        draw = rng.integers(0, len(some), (RESAMPLES, len(some)))
        low, high = 100 * np.quantile(
            rms(error[draw]) - rms(whole[draw]), [(1 - LEVEL) / 2, (1 + LEVEL) / 2]
        )
        lines.append(
            f"{name:<28} {len(some):>3} rooms {100 * rms(error):6.2f} %"
            f" {100 * (rms(error) - rms(whole)):+6.2f} [{low:+.2f}, {high:+.2f}]"
            f" mean {100 * error.mean():+6.2f} % error / stated {rms(error / spread):5.2f}"
        )
    return lines


def of_trial(trial: Trial) -> tuple[Capture, float]:
    """The capture of a known room, and how high its camera is [m]."""
    return trial.capture, -(trial.truth.ground or math.nan)


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("captures", nargs="*", help="CAPTURE=HEIGHT")
    parser.add_argument("--rooms", nargs="*", default=[], help="SET:SEED of mover_bench")
    args = parser.parse_args()
    torch.set_num_threads(1)
    cases: dict[str, Callable[[], tuple[Capture, float]]] = {}
    for name in args.captures:
        path, height = name.rsplit("=", 1)
        cases[path] = lambda path=path, height=height: (read_capture(Path(path)), float(height))
    for name in args.rooms:
        cases[name] = lambda name=name: of_trial(room_named(name))
    found: list[dict[str, tuple[float, float]]] = []
    for name, case in cases.items():
        errors = errors_of(*case())
        if errors:
            found.append(errors)
        spoken = f"{100 * errors['all'][0]:+.1f} % of" if errors else "known scale:"
        print(f"{spoken} {name}", flush=True)
    print("\n".join(table(found)))


if __name__ == "__main__":
    main()
