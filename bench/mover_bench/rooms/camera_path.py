"""Known rooms seen by a camera that moves: held by hand, panned, or walked with.

The reference image stays where it was, at the first frame; people, furniture and truth are the
same as under the static camera, so that results can be compared room by room. What SLAM gives is
the path in another scale, with a drift that grows with the way.
"""

from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mover.core.types import CameraPath, Capture
from mover.geometry.path import from_reference, is_still, poses_at, scaled
from mover.geometry.raster import first_hit
from mover.geometry.rotations import axis_angle
from mover.io.capture.pose_file import moved
from mover_bench.rooms.config import NoiseConfig, PathConfig
from mover_bench.rooms.known import KnownRoom, one_thread, rounded_bodies, visible
from mover_bench.rooms.noise import add_noise, slow
from mover_bench.rooms.render import furniture

TARGET = 4.0  # [m] ahead, at which a camera that travels looks
SHAKE = 0.7  # [s], how long a hand keeps its error
PATHS = 20  # number of the stream of random numbers


def filmed(room: KnownRoom, noise: NoiseConfig, seed: int, config: PathConfig) -> Capture:
    """What upstream tools would say about a room that a moving camera, or a still one, has seen."""
    if config == PathConfig():
        return add_noise(room, noise, seed)
    rng = np.random.default_rng([seed, PATHS])
    frames, fps = int(room.bodies.frame.max()) + 1, room.bodies.fps
    assert fps is not None, "a known room is a video"
    true = draw_path(frames, fps, config, rng)
    capture = add_noise(on_the_way(room, true), noise, seed)
    return replace(capture, path=slam_path(true, config, rng))


def draw_path(frames: int, fps: float, config: PathConfig, rng: np.random.Generator) -> CameraPath:
    """The true path [m], at the reference image's camera in the first frame."""
    time = np.arange(frames) / fps
    way, aim = _swing(time, rng, 3), _swing(time, rng, 2)
    place = config.travel * way * [1.0, 0.15, 0.35]
    turn = np.radians(config.turn) * aim * [0.2, 1.0]
    look = np.stack([place[:, 1] / TARGET, -place[:, 0] / TARGET, 0 * time], 1)
    look[:, :2] += turn
    every = np.arange(frames)
    hand = [slow(rng, (every, 0 * every), (3,), fps * SHAKE) for _ in range(2)]
    place = place + config.hand * (hand[0] - hand[0][0])
    look = look + np.radians(config.shake) * (hand[1] - hand[1][0])
    R = axis_angle(torch.from_numpy(look))
    first = R[0].mT
    at = (torch.from_numpy(place) - torch.from_numpy(place)[0]) @ first.mT
    return CameraPath(torch.arange(frames), (first @ R).float(), at.float())


def _swing(time: Float[np.ndarray, " frames"], rng: np.random.Generator, axes: int) -> np.ndarray:
    """Smooth and slow between -1 and 1, one column an axis; 0 at first."""
    period, phase = rng.uniform(14, 26, axes), rng.uniform(-np.pi, np.pi, axes)
    whole = np.sin(2 * np.pi * time[:, None] / period + phase) - np.sin(phase)
    return whole / np.abs(whole).max(0).clip(0.3)


def slam_path(true: CameraPath, config: PathConfig, rng: np.random.Generator) -> CameraPath:
    """The path as SLAM gives it: in units of its own, and adrift.

    Place and direction walk away at random; at the end the place is off by `drift` of the way.
    """
    if is_still(true):
        return true
    step = true.t_reference_camera.diff(dim=0).norm(dim=-1).double()
    share = torch.nn.functional.pad(step.sqrt(), (1, 0))[:, None] / float(step.sum()) ** 0.5
    walk = (share * torch.from_numpy(rng.normal(size=(len(true.frame), 3)))).cumsum(0)
    off = config.drift * float(step.sum()) * walk / 3**0.5
    walk = (share * torch.from_numpy(rng.normal(size=(len(true.frame), 3)))).cumsum(0)
    turn = axis_angle(np.radians(config.drift_turn) * walk / 3**0.5)
    at = true.t_reference_camera.double() + off
    R = true.R_reference_camera.double() @ turn
    adrift = CameraPath(true.frame, R.float(), at.float())
    return scaled(adrift, float(np.exp(config.units * rng.uniform(-1, 1))))


@one_thread()
def on_the_way(room: KnownRoom, path: CameraPath) -> KnownRoom:
    """The room as the moving camera sees it: people in its axes, and their visible masks."""
    bodies = room.bodies
    assert bodies.pose is not None, "a known room has parameters"
    poses = poses_at(path, bodies.frame)
    back = poses.R_reference_camera.mT, poses.t_reference_camera
    shift = -(back[0] @ back[1][..., None])[..., 0]
    assert bodies.joints is not None, "a known room has joints"
    seen = rounded_bodies(replace(
        bodies, verts=from_reference(bodies.verts, poses),
        joints=from_reference(bodies.joints, poses), pose=moved(bodies.pose, back[0], shift),
    ))  # fmt: skip
    camera, (verts, faces, _) = room.truth.camera, furniture(room.plan)
    still = room.plan.view.seen(verts)[None]

    def depth(frame: int) -> Tensor:
        points = from_reference(still, poses_at(path, torch.tensor([frame])))[0]
        return first_hit(points, faces, camera.K, (camera.height, camera.width))[0]

    shown = visible(room.plan, seen, depth)
    capture = replace(room.capture, bodies=seen, people=shown.people)
    return replace(room, bodies=seen, capture=capture, whole=shown.whole)
