"""Known rooms in which more than people moves: furniture between two visits, or the camera.

Two rooms that differ in the place of one piece, each with a visitor of its own, become one video:
the second visitor comes after the piece was moved. How the objects look in the frames is known, as
a segmenter that tracks them would give it.

The camera is held by hand, panned, or walked with. The reference image stays where it was, at the
first frame; people, furniture and truth are the same as under the static camera, so that results
can be compared room by room. What SLAM gives is the path in another scale, with a drift that grows
with the way.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mover.core.types import CameraPath, Capture, People, Scene, Segment
from mover.geometry.path import from_reference, is_still, poses_at, scaled
from mover.geometry.raster import first_hit
from mover.geometry.rle import decode, joined
from mover.geometry.rotations import axis_angle
from mover.io.capture.pose_file import joined_bodies, moved
from mover_bench.rooms.compose import Plan, fits, in_view
from mover_bench.rooms.config import NoiseConfig, PathConfig, RoomConfig
from mover_bench.rooms.known import (
    KnownRoom,
    NoRoomError,
    RefusedError,
    build,
    cast,
    make_room,
    one_thread,
    rounded_bodies,
    visible,
)
from mover_bench.rooms.noise import add_noise, slow
from mover_bench.rooms.placed import Placed
from mover_bench.rooms.render import encode, furniture, see

MOVABLE = ("chair", "office chair", "stool", "armchair", "table", "coffee table")
GAP = 10  # frames in which the room is empty, and in the middle of which the piece is moved
EVERY = 2  # frames from one in which the objects are segmented to the next
FAR = (0.5, 1.6)  # [m] by which a piece is moved
TURN = 60.0  # [degrees] by which it is turned, at most
TRIES = 60
Rows = TypeVar("Rows")


@one_thread()
def make_moved_room(seed: int, config: RoomConfig) -> KnownRoom:
    """A room in which the piece that is used most, of those that can be moved, is moved.

    Raises:
        NoRoomError: If no piece of the room can be moved.
    """
    first = make_room(seed, config)
    rng = np.random.default_rng([seed, 77])
    refused: list[str] = []
    used = [int((first.touched == k).any(1).sum()) for k in range(len(first.furniture))]
    movable = [k for k, piece in enumerate(first.furniture) if piece.category in MOVABLE]
    for index in sorted(movable, key=lambda k: -used[k]):
        for _ in range(TRIES // 10):
            try:
                plan = _moved(first.plan, index, rng)
                acts = cast(plan, config, rng, refused)
                second = build(plan, acts, config, first.capture.name, ())
                return _joined(first, second, index)
            except RefusedError as error:
                refused.append(str(error))
    raise NoRoomError(f"seed {seed}: nothing can be moved: {refused[-3:]}")


def _moved(plan: Plan, index: int, rng: np.random.Generator) -> Plan:
    """The plan with one piece elsewhere, free and in view."""
    piece = plan.pieces[index]
    others = [p for k, p in enumerate(plan.pieces) if k != index]
    for _ in range(TRIES):
        way, far = rng.uniform(-np.pi, np.pi), rng.uniform(*FAR)
        x, z = piece.place + far * np.array([math.sin(way), math.cos(way)])
        turn = math.radians(float(rng.uniform(-TURN, TURN)))
        there = Placed(piece.id, piece.furniture, (float(x), float(z)), piece.heading + turn)
        if fits(there, others, 0.3, plan.walls) and in_view(there, plan.view) >= 0.95:
            pieces = tuple(there if k == index else p for k, p in enumerate(plan.pieces))
            return replace(plan, pieces=pieces)
    raise RefusedError(f"{piece.id} has nowhere to go")


def _joined(first: KnownRoom, second: KnownRoom, index: int) -> KnownRoom:
    """One video of both."""
    later = int(first.bodies.frame.max()) + 1 + GAP
    change, people = later - GAP // 2, 1 + int(first.bodies.person.max())
    second = replace(
        second,
        bodies=_shifted(second.bodies, later, people),
        capture=replace(second.capture, people=_shifted(second.capture.people, later, people)),
    )
    end = int(second.bodies.frame.max()) + 1
    before, after = range(0, change, EVERY), range(change + change % EVERY, end, EVERY)
    truth = _scene(first.truth, second.truth, index, change)
    rooms = first, second
    bodies = joined_bodies([room.bodies for room in rooms])
    capture = replace(
        first.capture,
        bodies=bodies,
        people=joined_people([room.capture.people for room in rooms if room.capture.people]),
        furniture=joined_people([_seen(first, before), _seen(second, after)]),
    )
    names = ("touching", "touched", "whole")
    rows = {name: torch.cat([getattr(room, name) for room in rooms]) for name in names}
    actions = (*first.actions, *second.actions)
    return replace(first, **rows, bodies=bodies, capture=capture, truth=truth, actions=actions)


def _shifted(rows: Rows, frames: int, people: int) -> Rows:
    """The same later, and other people."""
    moved: Any = rows
    return replace(moved, frame=moved.frame + frames, person=moved.person + people)


def joined_people(parts: Sequence[People]) -> People:
    """The rows of all masks, one after the other."""
    frame, person = (torch.cat([getattr(p, name) for p in parts]) for name in ("frame", "person"))
    return People(joined([p.masks for p in parts]), frame, person, parts[0].heights)


def _seen(room: KnownRoom, frames: range) -> People:
    """Masks of the objects in some frames; `person` is the number of the annotation."""
    people, objects = room.capture.people, see(room.plan).piece
    assert people is not None, "a known room has masks"
    rows: list[tuple[int, int]] = []
    masks: list[np.ndarray] = []
    for frame in frames:
        shown = objects.clone()
        for row in (people.frame == frame).nonzero()[:, 0].tolist():
            shown[decode(people.masks, row)] = -1
        for index in shown.unique().tolist():
            if index >= 0:
                rows.append((frame, index + 1))
                masks.append((shown == index).numpy())
    frame, number = torch.tensor(rows).unbind(1)
    return People(encode(masks), frame, number, {})


def _scene(first: Scene, second: Scene, index: int, change: int) -> Scene:
    """The first scene; one piece of it stands elsewhere from a frame on."""
    segments = tuple(
        Segment(frame, scene.objects[index].t_world_object, scene.objects[index].yaw)
        for frame, scene in ((0, first), (change, second))
    )
    pieces = list(first.objects)
    pieces[index] = replace(pieces[index], segments=segments)
    return replace(first, objects=tuple(pieces))


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
