"""Known rooms seen by a camera that moves: held by hand, panned, or walked with.

The reference image stays where it was, at the first frame; people, furniture and truth are the
same as under the static camera, so that results can be compared room by room. What SLAM gives is
the path in another scale, with a drift that grows with the way.
"""

import dataclasses

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mover.core.records import map_tensors
from mover.core.types import Bodies, CameraPath, Capture, People
from mover.geometry.path import from_reference, is_still, poses_at, scaled
from mover.geometry.raster import first_hit
from mover.geometry.rle import decode
from mover.geometry.rotations import axis_angle
from mover.io.capture.pose_file import moved
from mover_bench.rooms.config import NoiseConfig, PathConfig
from mover_bench.rooms.known import KnownRoom, one_thread, rounded
from mover_bench.rooms.noise import add_noise
from mover_bench.rooms.render import encode, furniture, look_at

TARGET = 4.0  # [m] ahead, at which a camera that travels looks
SHAKE = 0.7  # [s], how long a hand keeps its error
LEAST_PIXELS = 100  # [px] of a piece; what is seen of less is not segmented
PATHS = 20  # number of the stream of random numbers


def filmed(room: KnownRoom, noise: NoiseConfig, seed: int, config: PathConfig) -> Capture:
    """What upstream tools would say about a room that a moving camera, or a still one, has seen."""
    if config == PathConfig():
        return add_noise(room, noise, seed)
    rng = np.random.default_rng([seed, PATHS])
    frames, fps = int(room.bodies.frame.max()) + 1, room.bodies.fps
    assert fps is not None, "a known room is a video"
    true = draw_path(frames, fps, config, rng)
    known = on_the_way(room, true)
    if config.views:
        seen = furniture_seen(known, true, max(1, round(config.views * fps)))
        known = dataclasses.replace(
            known, capture=dataclasses.replace(known.capture, furniture=seen)
        )
    capture = add_noise(known, noise, seed)
    return dataclasses.replace(capture, path=slam_path(true, config, rng))


def draw_path(frames: int, fps: float, config: PathConfig, rng: np.random.Generator) -> CameraPath:
    """The true path [m], at the reference image's camera in the first frame."""
    time = np.arange(frames) / fps
    way, aim = _swing(time, rng, 3), _swing(time, rng, 2)
    place = config.travel * way * [1.0, 0.15, 0.35]
    turn = np.radians(config.turn) * aim * [0.2, 1.0]
    look = np.stack([place[:, 1] / TARGET, -place[:, 0] / TARGET, 0 * time], 1)
    look[:, :2] += turn
    hand = _slow(rng, frames, fps), _slow(rng, frames, fps)
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


def _slow(rng: np.random.Generator, frames: int, fps: float) -> Float[np.ndarray, "frames 3"]:
    """Noise of variance one that forgets within `SHAKE`."""
    fresh, memory = rng.normal(size=(frames, 3)), np.exp(-1 / (fps * SHAKE))
    for k in range(1, frames):  # each frame builds on the one before
        fresh[k] = memory * fresh[k - 1] + np.sqrt(1 - memory**2) * fresh[k]
    return fresh


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
    seen = dataclasses.replace(
        bodies,
        verts=rounded(from_reference(bodies.verts, poses)),
        joints=rounded(from_reference(bodies.joints, poses)),
        pose=map_tensors(rounded, moved(bodies.pose, back[0], shift)),
    )
    people, whole, free = _people(room, seen, path)
    passing = free < 0.9 * whole
    capture = dataclasses.replace(room.capture, bodies=seen, people=people)
    return dataclasses.replace(room, bodies=seen, capture=capture, whole=whole, passing=passing)


@one_thread()
def furniture_seen(room: KnownRoom, path: CameraPath, every: int) -> People:
    """What the moving camera sees of the furniture in some frames, as `furniture.json` has it."""
    camera, (verts, faces, owner) = room.truth.camera, furniture(room.plan)
    still, people = room.plan.view.seen(verts), room.capture.people
    assert people is not None, "a known room has masks"
    rows: list[tuple[int, int]] = []
    masks: list[np.ndarray] = []
    for frame in range(every, int(path.frame[-1]) + 1, every):
        pose = poses_at(path, torch.tensor([frame]))
        points = from_reference(still[None], pose)[0]
        _, face = first_hit(points, faces, camera.K, (camera.height, camera.width))
        piece = torch.where(face >= 0, owner[face.clamp_min(0)], -1)
        for row in (people.frame == frame).nonzero()[:, 0].tolist():
            piece[decode(people.masks, row)] = -1
        for index in piece.unique().tolist():
            mask = piece == index
            if index >= 0 and int(mask.sum()) >= LEAST_PIXELS:
                rows.append((frame, index + 1))
                masks.append(mask.numpy())
    frame, number = torch.tensor(rows).unbind(1)
    return People(encode(masks), frame, number, {})


def _people(room: KnownRoom, bodies: Bodies, path: CameraPath) -> tuple[People, Tensor, Tensor]:
    """Visible masks, and how many pixels each body fills alone and without furniture."""
    camera, (verts, faces, _) = room.truth.camera, furniture(room.plan)
    seen = room.plan.view.seen(verts)
    masks, counts = list[bytes](), list[tuple[int, int]]()
    for frame in bodies.frame.unique().tolist():
        rows = (bodies.frame == frame).nonzero()[:, 0].tolist()
        pose = poses_at(path, torch.tensor([frame]))
        depth, _ = first_hit(
            from_reference(seen[None], pose)[0], faces, camera.K, (camera.height, camera.width)
        )
        looks = [look_at(room.plan, bodies.verts[row], bodies.faces) for row in rows]
        nearest = depth.clone()
        for look in looks:
            nearest[look.window] = torch.minimum(nearest[look.window], look.depth)
        for look in looks:
            alone = look.depth.isfinite()
            mask = torch.zeros_like(depth, dtype=torch.bool)
            mask[look.window] = alone & (look.depth <= nearest[look.window])
            counts.append(
                (int(alone.sum()), int((alone & (look.depth <= depth[look.window])).sum()))
            )
            masks += encode([mask.numpy()]).counts
    assert room.capture.people is not None, "a known room has masks"
    coded = dataclasses.replace(room.capture.people.masks, counts=tuple(masks))
    whole, free = torch.tensor(counts).unbind(1)
    return People(coded, bodies.frame, bodies.person, {}), whole, free
