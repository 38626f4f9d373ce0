"""Furniture that is moved: where it stands in each stay, when it moves, and what that costs others.

    PYTHONPATH=src python benchmarks/moved.py --seeds 100-109 --out moved
    PYTHONPATH=src python benchmarks/moved.py --sets pushed rolled --seeds 100-104 --out moved
    PYTHONPATH=src python benchmarks/moved.py --sets moving-moved --seeds 100-102 --out moved

Rebuilds each room of `--sets` with `robust` (finished rooms are kept in `--out`) and prints of each
moved piece IoU3D in each true stay and, where somebody moves it, in the mean of the frames on the
way; how far the nearest found beginning or end of a move is from each true one [s]; how many other
pieces are said to move; and IoU3D of the pieces that never move, as a mean. Beside it that of the
same pieces of the same room in another set: in `unmoved`, whose second visitor finds everything
where it was, for `moved`; under a camera that stands still for `moving-moved` and its like.
"""

import argparse
import dataclasses
import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mover.core.run import Run
from mover.core.types import SceneObject
from mover.evaluate.moves import measure_moves
from mover.evaluate.scene import Pair, iou3d
from mover.pipeline.presets import ROBUST
from mover.pipeline.reconstruct import reconstruct
from mover_bench.rooms.known import NoRoomError
from mover_bench.studies.job import noisy_room
from mover_bench.studies.run import parse_seeds
from mover_bench.studies.sets import SETS

BESIDE = {
    "moved": "unmoved", "moving-moved": "moved", "moving-pushed": "pushed",
    "moving-rolled": "rolled",
}  # fmt: skip


def measured(name: str, seed: int, out: Path) -> dict[str, Any]:
    """The row of one room, from its file if it is there."""
    file = out / f"{name}_{seed}.json"
    if not file.exists():
        trial = noisy_room(seed, SETS[name], Run(out / str(seed)))
        begin = time.process_time()
        room = reconstruct(trial.capture, ROBUST, Run(out / name / str(seed)))
        seconds, found = time.process_time() - begin, {p.id: p for p in room.scene.objects}
        assert trial.bodies is not None
        shared = {
            true.id: iou3d(Pair(
                _still(found[true.id]), room.scene.camera, _still(true), trial.truth.camera, 1
            ))
            for true in trial.truth.objects
        }  # fmt: skip
        moves = measure_moves(trial.truth, room.scene, trial.bodies.fps)
        tree = {"moves": moves, "objects": shared, "took": seconds, "warnings": room.warnings}
        file.write_text(json.dumps(tree))
    return json.loads(file.read_text())


def _still(piece: SceneObject) -> SceneObject:
    """The piece where the reference image shows it."""
    return dataclasses.replace(piece, segments=())


def line_of(row: dict[str, Any], beside: dict[str, Any] | None) -> tuple[str, list[float]]:
    """What is printed of a room; IoU3D of the pieces that stay, there and beside it."""
    moved = {piece["id"] for piece in row["moves"]["objects"]}
    stay = {name: value for name, value in row["objects"].items() if name not in moved}
    told: list[str] = []
    for piece in row["moves"]["objects"]:
        places = " ".join(f"{value:.3f}" for value in piece["iou3d"])
        way = piece.get("on_the_way")
        late = " ".join("-" if gap is None else f"{gap:.1f}" for gap in piece["late"])
        told.append(f"{piece['id']} {places} | {'-' if way is None else f'{way:.3f}'} | {late}")
    means = [float(np.mean(list(stay.values())))]
    if beside is not None:
        means.append(float(np.mean([beside["objects"][name] for name in stay])))
    values = " ".join(f"{mean:.3f}" for mean in means)
    return f"{'; '.join(told)} | {row['moves']['false']} | {values} | {row['took']:.0f} s", means


def main() -> None:
    """Print a line for each room."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", default="100-109")
    parser.add_argument("--out", type=Path, default=Path("moved"))
    parser.add_argument("--sets", nargs="+", default=["moved"])
    args = parser.parse_args()
    torch.set_num_threads(1)
    args.out.mkdir(parents=True, exist_ok=True)
    for name in args.sets:
        print(f"{name}: piece, IoU3D of each stay | on the way | late | false | the others | time")
        means: list[list[float]] = []
        for seed in parse_seeds(args.seeds):
            try:
                beside = measured(BESIDE[name], seed, args.out) if name in BESIDE else None
                told, mean = line_of(measured(name, seed, args.out), beside)
            except NoRoomError as error:
                print(f"{seed}: left out, there is no such room: {error}", flush=True)
                continue
            means.append(mean)
            print(f"{seed}: {told}", flush=True)
        if means:
            print("mean of the others:", " ".join(f"{v:.3f}" for v in np.mean(means, axis=0)))


if __name__ == "__main__":
    main()
