"""Bodies fitted to 2D joints alone: python benchmarks/fit.py --rooms 0 1 2.

Known rooms give the joints of `benchmarks/video.py`: COCO's 17 of another body, with errors that
last, missed and swapped ones, guesses of occluded ones, and a camera whose tilt is 3 degrees off.
PJE is the mean distance of the 22 joints of the body from the truth, absolute and after Procrustes
alignment, by posture. Without `--rooms` 24 development rooms are taken, in twelve of which a person
lies and in twelve of which a person is half occluded. `--height` gives the fit the heights of the
people.
"""

import argparse

import numpy as np
import torch
from torch import Tensor

from mover.bodies.corrected import statures
from mover.bodies.skinning import open_body
from mover.core.types import Bodies, Camera, Keypoints, People
from mover.evaluate.bodies import procrustes
from mover.fitting.bodies import FitInputs, fit_bodies
from mover.geometry.camera import project
from mover.perceive.config import ModelsConfig
from mover.perceive.networks import JointsInputs
from mover.perceive.video import Clip
from mover_bench.rooms.config import NoiseConfig, RoomConfig
from mover_bench.rooms.known import KnownRoom, make_room
from mover_bench.rooms.noise import add_noise, hidden_rows
from mover_bench.rooms.seen import Seen

DETECTED = (*range(100, 110), 112, 114, 120, 122, 123, 124, 125, 126, 128, 130, 132, 133, 134, 136)
SEATED, LYING = ("sit", "lean"), ("lie", "lie down", "get up")
Errors = dict[str, tuple[int, float, float]]
"""By posture: bodies, and their PJE, absolute and after Procrustes alignment [m]."""


def detected(room: KnownRoom, seed: int, fps: float) -> tuple[Keypoints, Camera]:
    """COCO's joints as `mover video` gets them in the benchmark, and the camera that it guesses."""
    noisy = add_noise(room, NoiseConfig(), seed)
    people, camera = noisy.people, noisy.scene.camera
    assert people is not None, "a known room has masks"
    count = int(people.frame.max()) + 1
    clip = Clip("", camera.width, camera.height, torch.arange(count) / fps, fps)
    seen = Seen(room, noisy, seed)
    tracks = People(people.masks, people.frame, people.person)
    return seen.joints(JointsInputs(clip, tracks), ModelsConfig()), camera


def postures(room: KnownRoom, rows: list[int]) -> dict[str, list[int]]:
    """Which of some bodies do what, and of which less is seen."""
    camera, bodies = room.truth.camera, room.bodies
    assert bodies.joints is not None
    flat = project(bodies.joints[:, :22], camera.K)
    size = torch.tensor([camera.width, camera.height])
    cut = ((flat < 0) | (flat > size)).any(-1).any(-1)
    actions = [room.actions[k] for k in rows]
    hidden = hidden_rows(room)
    still = (*SEATED, *LYING)
    return {
        "all": list(range(len(rows))),
        "upright": [k for k, a in enumerate(actions) if a not in still],
        "seated": [k for k, a in enumerate(actions) if a in SEATED],
        "lying": [k for k, a in enumerate(actions) if a in LYING],
        "half hidden": [k for k, row in enumerate(rows) if hidden[row]],
        "cut": [k for k, row in enumerate(rows) if cut[row]],
    }


def heights_in(bodies: Bodies) -> Tensor:
    """How tall each of the people is [m]."""
    tall = None if bodies.pose is None else statures(bodies.pose)
    assert tall is not None, "of the open body"
    return torch.stack([tall[bodies.person == one][0] for one in bodies.person.unique()])


def misses(joints: Tensor, truth: Tensor) -> Tensor:
    """PJE of each body, absolute and after Procrustes [m]."""
    joints, truth = joints[:, :22].double(), truth[:, :22].double()
    pairs = [(some - truth).norm(dim=-1).mean(1) for some in (joints, procrustes(joints, truth))]
    return torch.stack(pairs, -1)


def errors_by_posture(pairs: Tensor, room: KnownRoom, rows: list[int]) -> Errors:
    """Of the errors of some bodies of a room [m]."""
    which = postures(room, rows).items()
    return {name: (len(some), *pairs[some].mean(0).tolist()) for name, some in which if some}


def lines_of_postures(rooms: list[Errors], head: str = "") -> str:
    """Means over the bodies of all rooms, and over rooms."""
    lines: list[str] = []
    for name in dict.fromkeys(name for room in rooms for name in room):
        each = np.array([room[name] for room in rooms if name in room])
        body, equal = np.average(each[:, 1:], 0, each[:, 0]), each[:, 1:].mean(0)
        count = f"{int(each[:, 0].sum())} bodies of {len(each)} rooms"
        means = [f"{1e3 * a:.0f} / {1e3 * p:.0f} mm" for a, p in (body, equal)]
        lines.append(f"{head}{name}: {count}, {means[0]}; rooms weighted equally {means[1]}")
    return "\n".join(lines)


def by_posture(seed: int, fps: float, tall: bool) -> tuple[Errors, Tensor]:
    """PJE of bodies by posture, and errors of heights [%]."""
    room = make_room(seed, RoomConfig(fps=fps))
    keypoints, camera = detected(room, seed, fps)
    heights = heights_in(room.bodies)
    inputs = FitInputs(
        keypoints, camera, open_body(), heights=tuple(heights.tolist()) if tall else ()
    )
    found = fit_bodies(inputs)
    where = {int(f): k for k, f in enumerate(room.bodies.frame.tolist())}
    rows = [where[f] for f in found.bodies.frame.tolist()]
    assert found.bodies.joints is not None
    assert room.bodies.joints is not None
    pairs = misses(found.bodies.joints, room.bodies.joints[rows])
    each = errors_by_posture(pairs, room, rows)
    means = ", ".join(f"{n} {k}: {1e3 * a:.0f} / {1e3 * p:.0f}" for n, (k, a, p) in each.items())
    off = 100 * (heights_in(found.bodies) / heights - 1)
    print(f"room {seed}: {means}, height {off.mean():+.1f} %", flush=True)
    return each, off


def table(seeds: list[int], fps: float, tall: bool) -> None:
    """Postures over rooms, PJE absolute / after Procrustes: means of bodies, and of rooms."""
    every = [by_posture(seed, fps, tall) for seed in seeds]
    rooms, off = [room for room, _ in every], torch.cat([some for _, some in every])
    print(f"heights: {off.mean():+.1f} % in the mean, {off.square().mean().sqrt():.1f} % rms")
    print(lines_of_postures(rooms))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rooms", type=int, nargs="+", default=list(DETECTED))
    parser.add_argument("--fps", type=float, default=5.0)
    parser.add_argument(
        "--height", action="store_true", help="give the fit the heights of the people"
    )
    args = parser.parse_args()
    torch.set_num_threads(1)
    table(args.rooms, args.fps, args.height)


if __name__ == "__main__":
    main()
