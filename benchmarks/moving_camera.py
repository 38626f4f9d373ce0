"""A camera that moves against one that stands still: the same known rooms under both.

    PYTHONPATH=src python benchmarks/moving_camera.py --seeds 100-111 --out moving

Rebuilds each room with `robust` from the captures of `--sets` (the first: of the still camera;
`moving-camera` has furniture in the reference image alone, `moving-views` in further frames, too;
finished rooms are kept in `--out`) and prints IoU3D, the angle of gravity [degrees], the error of
the floor [cm], the scale of the room [%] as its furniture and as its people tell it (how far apart
pieces stand, and how far people went, against the truth) and, for the moving camera, the error of
the path's scale [%] and how far it went [m].
"""

import argparse
import math
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from mover.core.records import rows_of
from mover.core.run import Run
from mover.core.types import CameraPath, Room
from mover.evaluate.bodies import shared_rows
from mover.geometry.boxes import box_of
from mover.geometry.path import is_still
from mover.pipeline.presets import ROBUST
from mover.pipeline.reconstruct import reconstruct
from mover.stages.people.find_depth import pelvis
from mover_bench.rooms.camera_path import PATHS, draw_path, slam_path
from mover_bench.studies.job import noisy_room
from mover_bench.studies.measures import Trial, measure
from mover_bench.studies.run import parse_seeds
from mover_bench.studies.sets import SETS

APART = 1.0  # [m] between two pieces that tell the room's scale
KINDS = ("walked", "panned", "held")


def paths_of(trial: Trial, seed: int) -> tuple[CameraPath, CameraPath]:
    """The true path [m], and the one that was given without its drift."""
    assert trial.bodies is not None
    assert trial.bodies.fps is not None
    kinds = SETS["moving-views"].paths
    config, rng = kinds[seed % len(kinds)], np.random.default_rng([seed, PATHS])
    true = draw_path(int(trial.bodies.frame.max()) + 1, trial.bodies.fps, config, rng)
    return true, slam_path(true, replace(config, drift=0.0, drift_turn=0.0), rng)


def scale_error(trial: Trial, path: CameraPath, seed: int) -> tuple[float, float]:
    """Of the path that was found: its scale [%], and how far the camera truly went [m]."""
    true, given = paths_of(trial, seed)
    found = _way(path) / _way(trial.capture.path)
    wanted = _way(true) / _way(given)
    reach = float(true.t_reference_camera.norm(dim=-1).max())
    return 100 * (found / wanted - 1), reach


def _way(path: CameraPath) -> float:
    """How far the camera went in all, which corrections of a slow drift hardly change."""
    return float(path.t_reference_camera.diff(dim=0).norm(dim=-1).sum())


def room_scale(trial: Trial, room: Room) -> tuple[float, float]:
    """How much too large the room is [%]: by ways between pieces, and by those of people."""
    true = {piece.id: box_of(piece).center for piece in trial.truth.objects}
    found = {piece.id: box_of(piece).center for piece in room.scene.objects}
    known = [name for name in true if name in found]
    ways = [torch.pdist(torch.stack([centres[n] for n in known])) for centres in (found, true)]
    assert room.bodies is not None
    assert room.kept is not None
    assert trial.bodies is not None
    rows, same = shared_rows(rows_of(room.bodies, room.kept), trial.bodies)
    ours, theirs = pelvis(room.bodies)[room.kept][rows], pelvis(trial.bodies)[same]
    spreads = [(place - place.mean(0)).square().sum().sqrt() for place in (ours, theirs)]
    far = ways[1] > APART
    pieces = float((ways[0][far] / ways[1][far]).log().median())
    return 100 * math.expm1(pieces), 100 * (float(spreads[0] / spreads[1]) - 1)


def row(name: str, seed: int, out: Path) -> list[float]:
    """IoU3D of stage 1 and of the whole, gravity, floor, room, path, reach, seconds."""
    trial = noisy_room(seed, SETS[name], Run(out / str(seed)))
    begin = time.process_time()
    run = Run(out / name / str(seed))
    room = reconstruct(trial.capture, ROBUST, run)
    seconds = time.process_time() - begin
    found, true = (s.camera.R_cam_world[:, 1].double() for s in (room.scene, trial.truth))
    angle = float(torch.linalg.cross(found, true).norm().asin().rad2deg())
    assert room.scene.ground is not None
    assert trial.truth.ground is not None
    scale = (0.0, 0.0)
    if not is_still(room.path):  # the part of the scale that drift does not move
        scale = scale_error(trial, room.path, seed)
    told = measure(trial, room, run)
    values = [told[stage]["iou3d"] for stage in ("image", "full")]
    floor = 100 * abs(room.scene.ground - trial.truth.ground)
    return [*values, angle, floor, *room_scale(trial, room), *scale, seconds]


def main() -> None:
    """Print a line for each room and camera, and the means."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", default="100-111")
    parser.add_argument("--out", type=Path, default=Path("moving"))
    parser.add_argument("--sets", nargs="+", default=["rooms", "moving-views"])
    args = parser.parse_args()
    torch.set_num_threads(1)
    rows: dict[str, list[list[float]]] = {name: [] for name in args.sets}
    print(
        "seed camera | IoU3D stage 1, full | gravity, floor | room, people | path, reach | seconds"
    )
    for seed in parse_seeds(args.seeds):
        for name, found in rows.items():
            found.append(row(name, seed, args.out))
            kind = "still" if name == "rooms" else KINDS[seed % len(KINDS)]
            told = ("{:.3f}", "{:.3f}", "{:.2f}", "{:.1f}", "{:+.1f}", "{:+.1f}")
            told += ("{:+.1f}", "{:.2f}", "{:.0f}")
            line = " ".join(t.format(v) for t, v in zip(told, found[-1], strict=True))
            print(f"{seed} {kind}: {line}", flush=True)
    for name, found in rows.items():
        means = np.abs(np.array(found)).mean(0)
        print(f"mean {name}:", " ".join(f"{v:.3f}" for v in means))


if __name__ == "__main__":
    main()
