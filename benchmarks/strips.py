"""Known rooms through their cameras, the truth beside what is rebuilt: pictures and short films.

    PYTHONPATH=src python benchmarks/strips.py --set moving-views --seed 102 --out moving \
        --frames 0 80 --width 320 --to docs/images/moving.webp
    PYTHONPATH=src python benchmarks/strips.py --set withheld-seat --seed 104 --out withheld \
        --frames 60 140 --width 320 --to docs/images/withheld.webp
    PYTHONPATH=src python benchmarks/strips.py --set pushed --seed 100 --out moved \
        --frames 45 125 --width 320 --to docs/images/moved.webp

Rebuilds the room with `robust` (what `moving_camera.py`, `withheld.py` and `moved.py` left in
`--out` is used). A .webp is a film of all frames from the first to the last of `--frames`, the
truth on the left; a .jpg has the truth above, in just these frames. Supports that are proposed are
drawn like other pieces. A camera that moves is the true one, and the one that was found.
"""

import argparse
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image
from torch import Tensor

from mover.app.pictures.eye import RenderCamera, camera_sized
from mover.app.pictures.film import captioned, pixels, save_still
from mover.app.pictures.paint import people
from mover.app.pictures.render import Tiles, set_up, show, world_of
from mover.core.files import replacing
from mover.core.run import Run
from mover.core.types import STILL, Bodies, CameraPath, Room, Scene, SceneObject
from mover.geometry.path import is_still, poses_at
from mover.geometry.placement import placed_at
from mover.pipeline.outcome import to_world
from mover.pipeline.presets import ROBUST
from mover.pipeline.reconstruct import reconstruct
from mover_bench.rooms.camera_path import PATHS, draw_path
from mover_bench.studies.job import Trial, noisy_room
from mover_bench.studies.sets import SETS

GAP = 6  # [px] of white between two pictures
QUALITY = 55  # of a film's pictures


@dataclass(frozen=True)
class Filmed:
    """A room, its people in the world, and the camera that sees them."""

    scene: Scene
    bodies: Bodies
    path: CameraPath
    name: str
    boards: dict[int, Tiles] = field(default_factory=dict)

    def picture(self, frame: int, width: int) -> Float[Tensor, "h w 3"]:
        """One frame; what does not move is drawn once."""
        rows = (self.bodies.frame == frame).nonzero()[:, 0].tolist()
        moves = not is_still(self.path) or any(piece.segments for piece in self.scene.objects)
        key = frame if moves else 0
        if key not in self.boards:
            pieces = tuple(placed_at(piece, frame) for piece in self.scene.objects)
            world = world_of("", replace(self.scene, objects=pieces), self.bodies)
            camera = self.scene.camera
            height = round(width * camera.height / camera.width)
            eye = _eye(camera_sized(camera, width, height), self.path, frame)
            self.boards.clear()
            self.boards[key] = set_up(eye, world.ground, world.still, None)
        return captioned(show(self.boards[key], people(self.bodies, rows)), self.name)


def _eye(eye: RenderCamera, path: CameraPath, frame: int) -> RenderCamera:
    """The eye of the reference image, where the camera was in a frame."""
    if is_still(path):
        return eye
    pose = poses_at(path, torch.tensor([frame]))
    place = eye.R_eye_world.mT @ pose.t_reference_camera[0]
    return replace(eye, R_eye_world=pose.R_reference_camera[0].mT @ eye.R_eye_world,
                   t_world_eye=place)  # fmt: skip


def filmed(name: str, seed: int, out: Path) -> tuple[Filmed, Filmed]:
    """A room of a set as it is, and as it is rebuilt."""
    trial = noisy_room(seed, SETS[name], Run(out / "rooms" / str(seed)))
    room = reconstruct(trial.capture, ROBUST, Run(out / name / str(seed)))
    assert trial.bodies is not None
    assert room.bodies is not None
    true = STILL
    if not is_still(room.path):
        rng, kinds = np.random.default_rng([seed, PATHS]), SETS[name].paths
        last, fps = int(trial.bodies.frame.max()), trial.bodies.fps or 1.0
        true = draw_path(last + 1, fps, kinds[seed % len(kinds)], rng)
    truth = Filmed(trial.truth, to_world(trial.bodies, trial.truth.camera), true, "truth")
    found = replace(room.scene, objects=_in_order(trial, room))
    return truth, Filmed(found, room.bodies, room.path, "rebuilt")


def _in_order(trial: Trial, room: Room) -> tuple[SceneObject, ...]:
    """The pieces in the order, and so the colours, of the true ones; proposals fill the gaps."""
    found = {piece.id: piece for piece in room.scene.objects}
    proposed = [one.object for one in room.proposals]
    pieces: list[SceneObject] = []
    for true in trial.truth.objects:
        if true.id in found:
            pieces.append(found.pop(true.id))
        elif proposed:
            pieces.append(proposed.pop(0))
    return (*pieces, *found.values(), *proposed)


def strip(sides: tuple[Filmed, Filmed], frames: list[int], width: int) -> Float[Tensor, "h w 3"]:
    """Truth and result, one above the other, in some frames."""
    rows = [_joined([side.picture(frame, width) for frame in frames], 1) for side in sides]
    return _joined(rows, 0)


def _joined(pictures: list[Tensor], axis: int) -> Float[Tensor, "h w 3"]:
    """Pictures beside (1) or above (0) each other, with white between them."""
    shape = list(pictures[0].shape)
    shape[axis] = GAP
    parts = [part for picture in pictures for part in (torch.ones(shape), picture)]
    return torch.cat(parts[1:], axis)


def save_webp(pictures: list[Float[Tensor, "h w 3"]], rate: float, path: Path) -> None:
    """A film that browsers show like a picture, over and over."""
    first, *rest = (Image.fromarray(pixels(picture)) for picture in pictures)
    with replacing(path) as part:
        first.save(
            part, format="webp", save_all=True, append_images=rest, duration=round(1000 / rate),
            loop=0, quality=QUALITY, method=6,
        )  # fmt: skip


def main() -> None:
    """Draw what is asked for."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--set", default="moving-views", choices=tuple(SETS))
    parser.add_argument("--seed", type=int, default=108)
    parser.add_argument("--out", type=Path, default=Path("moving"))
    parser.add_argument("--frames", type=int, nargs="+", default=[0, 40])
    parser.add_argument("--width", type=int, default=400)
    parser.add_argument("--to", type=Path, default=Path("strip.jpg"))
    args = parser.parse_args()
    torch.set_num_threads(1)
    sides = filmed(args.set, args.seed, args.out)
    if args.to.suffix != ".webp":
        save_still(strip(sides, args.frames, args.width), args.to)
        return
    seen = sides[0].bodies.frame.unique().tolist()
    frames = [frame for frame in seen if args.frames[0] <= frame <= args.frames[-1]]
    shown = [_joined([side.picture(frame, args.width) for side in sides], 1) for frame in frames]
    save_webp(shown, sides[0].bodies.fps or 5.0, args.to)


if __name__ == "__main__":
    main()
