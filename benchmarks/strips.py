"""A strip of pictures from the camera of a known room: the truth above, what is rebuilt below.

    PYTHONPATH=src python benchmarks/strips.py --set moving-views --seed 108 --out moving \
        --to docs/images/moving.jpg
    PYTHONPATH=src python benchmarks/strips.py --set withheld-seat --seed 104 --out withheld \
        --to docs/images/withheld.jpg
    PYTHONPATH=src python benchmarks/strips.py --set pushed --seed 100 --frames 50 63 66 300 \
        --out moved --to docs/images/moved.jpg

Rebuilds the room with `robust` (what `moving_camera.py` and `withheld.py` left in `--out` is used)
and draws `--count` frames. Supports that are proposed are drawn like other pieces. A camera that
moves is the true one above, and the one that was found below.
"""

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mover.app.pictures.eye import RenderCamera, camera_sized
from mover.app.pictures.film import save_still
from mover.app.pictures.paint import people
from mover.app.pictures.render import set_up, show, world_of
from mover.core.run import Run
from mover.core.types import STILL, Bodies, CameraPath, Scene
from mover.geometry.path import is_still, poses_at
from mover.geometry.placement import placed_at
from mover.pipeline.outcome import to_world
from mover.pipeline.presets import ROBUST
from mover.pipeline.reconstruct import reconstruct
from mover_bench.rooms.camera_path import PATHS, draw_path
from mover_bench.studies.job import noisy_room
from mover_bench.studies.sets import SETS

GAP = 6  # [px] of white between two pictures


def pictures(
    scene: Scene, bodies: Bodies, path: CameraPath, frames: list[int], width: int
) -> Float[Tensor, "h w 3"]:
    """A row of pictures; bodies are in the world."""
    found = list[Tensor]()
    height = round(width * scene.camera.height / scene.camera.width)
    for frame in frames:
        pieces = tuple(placed_at(piece, frame) for piece in scene.objects)
        world = world_of("", replace(scene, objects=pieces), bodies)
        eye = _eye(camera_sized(scene.camera, width, height), path, frame)
        board = set_up(eye, world.ground, world.still, None)
        rows = (bodies.frame == frame).nonzero()[:, 0].tolist()
        found += [show(board, people(bodies, rows)), torch.ones(height, GAP, 3)]
    return torch.cat(found[:-1], 1)


def _eye(eye: RenderCamera, path: CameraPath, frame: int) -> RenderCamera:
    """The eye of the reference image, where the camera was in a frame."""
    if is_still(path):
        return eye
    pose = poses_at(path, torch.tensor([frame]))
    place = eye.R_eye_world.mT @ pose.t_reference_camera[0]
    return replace(eye, R_eye_world=pose.R_reference_camera[0].mT @ eye.R_eye_world,
                   t_world_eye=place)  # fmt: skip


def strip(
    name: str, seed: int, out: Path, frames: list[int] | int, width: int
) -> Float[Tensor, "h w 3"]:
    """Truth and result, one above the other, in some frames or in so many."""
    trial = noisy_room(seed, SETS[name], Run(out / "rooms" / str(seed)))
    room = reconstruct(trial.capture, ROBUST, Run(out / name / str(seed)))
    assert trial.bodies is not None
    assert room.bodies is not None
    true = STILL
    if not is_still(room.path):
        rng, kinds = np.random.default_rng([seed, PATHS]), SETS[name].paths
        last, fps = int(trial.bodies.frame.max()), trial.bodies.fps or 1.0
        true = draw_path(last + 1, fps, kinds[seed % len(kinds)], rng)
    found = (*room.scene.objects, *(one.object for one in room.proposals))
    seen = room.bodies.frame.unique()
    if isinstance(frames, int):
        frames = seen[torch.linspace(0, len(seen) - 1, frames + 2).round().long()[1:-1]].tolist()
    above = pictures(trial.truth, to_world(trial.bodies, trial.truth.camera), true, frames, width)
    below = pictures(replace(room.scene, objects=found), room.bodies, room.path, frames, width)
    return torch.cat([above, torch.ones(GAP, above.shape[1], 3), below])


def main() -> None:
    """Draw the strip that is asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--set", default="moving-views", choices=tuple(SETS))
    parser.add_argument("--seed", type=int, default=108)
    parser.add_argument("--out", type=Path, default=Path("moving"))
    parser.add_argument("--count", type=int, default=4)
    parser.add_argument("--frames", type=int, nargs="*", default=[])
    parser.add_argument("--width", type=int, default=480)
    parser.add_argument("--to", type=Path, default=Path("strip.jpg"))
    args = parser.parse_args()
    torch.set_num_threads(1)
    frames = args.frames or args.count
    save_still(strip(args.set, args.seed, args.out, frames, args.width), args.to)


if __name__ == "__main__":
    main()
