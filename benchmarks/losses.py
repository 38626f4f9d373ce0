"""What a finished experiment loses IoU3D to, step by step.

    mover experiment --set upstream --seeds 100-109 --presets robust
    python benchmarks/losses.py experiments upstream --seeds 100-109

The boxes of the objects as they were found are set right one after the other: the scale of the
room about its camera (the median of true over found distances, which people's unknown height and
the lens make wrong at once), then each object's distance, its place across the ray, its sizes, its
yaw. What is left then are objects that were not given. `alone`: that one thing set right in what
was found.
"""

import argparse
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from mover.core import records
from mover.evaluate.scene import thick
from mover.geometry.boxes import Box, box_of, iou3d
from mover_bench.studies.job import DONE, Job, Rebuilt
from mover_bench.studies.measures import Trial
from mover_bench.studies.run import parse_seeds

Boxes = dict[str, Box]


def scaled(found: Boxes, true: Boxes) -> Boxes:
    """The room as large as most distances say."""
    factor = torch.stack([_away(true[n]) / _away(b) for n, b in found.items()]).median()
    return {n: Box(factor * b.center, factor * b.size, b.yaw) for n, b in found.items()}


def at_distance(found: Boxes, true: Boxes) -> Boxes:
    """Each object at its distance, in the direction in which it was found."""
    return {n: replace(b, center=b.center * (_away(true[n]) / _away(b))) for n, b in found.items()}


def in_place(found: Boxes, true: Boxes) -> Boxes:
    """Each object in the true direction, as far away as it was found."""
    return {
        n: replace(b, center=true[n].center * (_away(b) / _away(true[n]))) for n, b in found.items()
    }


def sized(found: Boxes, true: Boxes) -> Boxes:
    """Each object of its true sizes, on the middle of its box."""
    return {n: replace(b, size=true[n].size) for n, b in found.items()}


def turned(found: Boxes, true: Boxes) -> Boxes:
    """Each object turned as it truly is."""
    return {n: replace(b, yaw=true[n].yaw) for n, b in found.items()}


STEPS: dict[str, Callable[[Boxes, Boxes], Boxes]] = {
    "scale of the room": scaled,
    "distance of each": at_distance,
    "place across": in_place,
    "sizes": sized,
    "yaws": turned,
}


def _away(box: Box) -> torch.Tensor:
    return box.center.norm()


def losses(job: Job) -> tuple[list[float], list[float]]:
    """Mean IoU3D over the true objects: as found and after each step; each step alone."""
    truth = records.load(Trial, job.room).truth
    result = records.load(Rebuilt, job.folder / "scenes").full
    true = {piece.id: box_of(piece) for piece in truth.objects}
    found = {piece.id: box_of(piece) for piece in result.objects if piece.id in true}

    def mean(boxes: Boxes) -> float:
        each = [float(iou3d(thick(box), thick(true[name]))) for name, box in boxes.items()]
        return sum(each) / len(true)

    alone = [mean(step(found, true)) for step in STEPS.values()]
    row = [mean(found)]
    for step in STEPS.values():
        found = step(found, true)
        row.append(mean(found))
    return row, alone


def main() -> None:
    """A table of means over the rooms."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path, help="folder of the experiment")
    parser.add_argument("set")
    parser.add_argument("--seeds", default="100-109")
    parser.add_argument("--preset", default="robust")
    args = parser.parse_args()
    jobs = [Job(args.set, seed, args.preset, args.out) for seed in parse_seeds(args.seeds)]
    rows = [losses(job) for job in jobs if (job.folder / DONE).is_file()]
    if not rows:
        parser.error(f"{args.out / args.set}: no room of {args.seeds} is rebuilt by {args.preset}")
    whole, alone = (np.array(x).mean(0) for x in zip(*rows, strict=True))
    print(f"{args.set}, {args.preset}, {len(rows)} rooms\n\n| set right | IoU3D | alone |")
    print(f"|---|---|---|\n| nothing | {whole[0]:.3f} | |")
    for name, value, single in zip(STEPS, whole[1:], alone, strict=True):
        print(f"| {name} | {value:.3f} | {single:.3f} |")


if __name__ == "__main__":
    main()
