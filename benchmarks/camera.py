"""What the people alone tell of the camera: focal length, pitch, roll and floor, on known rooms.

    PYTHONPATH=src python benchmarks/camera.py --seeds 100-111 --out camera

Makes the rooms (finished ones are kept in `--out`) and prints for each, and on average, the errors
of `robust` before any object is looked at, with feet at rest only (`--foot_contacts.speed 0.2`)
and as the preset has it, and the error of a focal length that is looked for, given the true one and
one that is 4 % too long. Rooms 0-9 and from 1000 on are for results and never used.
"""

import argparse
import math
from dataclasses import replace
from pathlib import Path

import torch

from mover.core.run import Run
from mover.geometry.camera import pitch_roll
from mover.pipeline.people import people_of
from mover.pipeline.presets import ROBUST, Config
from mover.stages.camera.find_focal import zoomed
from mover_bench.studies.job import noisy_room
from mover_bench.studies.measures import Trial
from mover_bench.studies.run import parse_seeds
from mover_bench.studies.sets import SETS

STRICT = replace(ROBUST, foot_contacts=replace(ROBUST.foot_contacts, speed=0.2))
GUESSED = replace(ROBUST, focal=replace(ROBUST.focal, spread=0.05))
LONGER = 1.04


def tilt(trial: Trial, config: Config, run: Run) -> list[float]:
    """Errors of pitch, roll [degrees] and ground [cm] from the feet, with their signs."""
    crew = people_of(trial.capture, config, run)
    assert crew is not None
    assert trial.truth.ground is not None
    cameras = (crew.alignment.camera, trial.truth.camera)
    found, true = (torch.stack(pitch_roll(c.R_cam_world)).rad2deg() for c in cameras)
    return [*(found - true).tolist(), 100 * (crew.alignment.ground - trial.truth.ground)]


def lens(trial: Trial, longer: float, run: Run) -> float:
    """Error of the focal length that was found [%]."""
    scene = trial.capture.scene
    camera = zoomed(scene.camera, longer)
    capture = replace(trial.capture, scene=replace(scene, camera=camera))
    crew = people_of(capture, GUESSED, run)
    assert crew is not None
    return 100 * (float(crew.alignment.camera.K[0, 0] / trial.truth.camera.K[0, 0]) - 1)


def main() -> None:
    """Print a line for each room and the means of the absolute values."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", default="100-111")
    parser.add_argument("--out", type=Path, default=Path("camera"))
    args = parser.parse_args()
    rows: list[list[float]] = []
    print("seed | feet at rest: pitch, roll, floor | robust: pitch, roll, floor | f, f of 4 % more")
    for seed in parse_seeds(args.seeds):
        run = Run(args.out / str(seed))
        trial = noisy_room(seed, SETS["rooms"], run)
        row = [*tilt(trial, STRICT, run), *tilt(trial, ROBUST, run)]
        row += [lens(trial, 1.0, run), lens(trial, LONGER, run)]
        rows.append(row)
        print(seed, *(f"{value:+.2f}" for value in row), flush=True)
    sizes = [math.fsum(abs(row[k]) for row in rows) / len(rows) for k in range(len(rows[0]))]
    print("mean |.|", *(f"{size:.2f}" for size in sizes))


if __name__ == "__main__":
    main()
