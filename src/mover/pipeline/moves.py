"""Objects that are moved: where each stands in each segment of the video, with one shape and size.

The whole room is rebuilt first, as if nothing moved. Then each segment of each moved object is a
small reconstruction of its own: camera, floor, people and all other objects stay as they were
found, the object's mask is that of the segment, and only the people of the segment speak. The
segment of the reference image comes first and tells the size, which the others keep.

Under a moving camera the other segments have a reference image of their own: the frame that shows
most of the object, with the masks that were given of it. The reconstruction then stands about the
camera of that frame, and its place is carried back into the room.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor

from mover.bodies.parts import parts_of
from mover.core.records import rows_of
from mover.core.run import Run
from mover.core.types import (
    STILL,
    Bodies,
    Camera,
    CameraPath,
    Capture,
    DepthImage,
    Detection,
    Masks,
    People,
    Proposal,
    Room,
    SceneObject,
    Segment,
)
from mover.geometry.boxes import beyond, box_of
from mover.geometry.camera import heading
from mover.geometry.path import about, is_still, poses_at, reversed_poses
from mover.geometry.placement import ENDLESS, hit_floor, placed_at
from mover.geometry.rle import encode, tight_box
from mover.geometry.rotations import rot_y
from mover.io.capture.pose_file import into_camera
from mover.pipeline.outcome import Spans
from mover.pipeline.people import carried
from mover.pipeline.presets import Config, with_sizes
from mover.pipeline.proposals import told_of_proposals
from mover.stages.config import ProposeConfig, SpreadConfig
from mover.stages.masks import enlarged, thin
from mover.stages.objects.find_image_cues import evidence_at
from mover.stages.objects.find_moves import STEP, MoveInputs, Stay, find_moves
from mover.stages.objects.follow_movers import Between, Followed, follow_mover

RIGID = 1e3  # factor on the price of another size in all segments but the first
Stays = dict[int, list[Stay]]
"""Of each object that is moved, by its annotation."""


@dataclass(frozen=True)
class Solving:
    """How a segment is rebuilt."""

    capture: Capture
    config: Config
    run: Run
    solve: Callable[[Capture, Config, Run, tuple[str, ...], Spans], Room]


def stays_of(capture: Capture, config: Config, run: Run) -> Stays:
    """When each object that is moved stands where; nothing without masks of it in the frames.

    Before a moving camera no moves are looked for.
    """
    known = {p.annotation: p for p in capture.scene.objects if p.annotation is not None}
    if capture.furniture is None or not known or not is_still(capture.path):
        return {}
    fps = None if capture.bodies is None else capture.bodies.fps
    inputs = MoveInputs(capture.furniture, capture.people, tuple(known), fps)
    found: Stays = {}
    for stay in run.stage(find_moves, inputs, config.moves).stays:
        found.setdefault(stay.annotation, []).append(stay)
    return found


def _where_shown(stays: Stays, capture: Capture) -> People | None:
    """The objects' masks of the frames in which they are where the reference image shows them."""
    if capture.furniture is None:
        return None
    frame, number = capture.furniture.frame, capture.furniture.person
    gone = torch.zeros_like(frame, dtype=torch.bool)
    for annotation, mine in stays.items():
        first, last = mine[_shown_in(mine, capture)].sure
        gone = gone | ((number == annotation) & ((frame < first) | (frame > last)))
    return rows_of(capture.furniture, ~gone)


def away(stays: Stays, capture: Capture) -> Spans:
    """When an object is not where the reference image shows it."""
    spans: list[tuple[int, int]] = []
    for mine in stays.values():
        shown = _shown_in(mine, capture)
        ends = [stay.first for stay in mine[1:]] + [ENDLESS]
        spans += [(mine[k].first, ends[k]) for k in range(len(mine)) if k != shown]
    return tuple(spans)


def with_moves(solving: Solving, pinned: tuple[str, ...]) -> Room:
    """The room, with its moved objects where they stand when; what was given of that is left."""
    given, config, run = solving.capture, solving.config, solving.run
    pieces = tuple(replace(piece, segments=()) for piece in given.scene.objects)
    capture = replace(given, scene=replace(given.scene, objects=pieces))
    solving = replace(solving, capture=capture)
    stays = stays_of(capture, config, run)
    steady = replace(capture, furniture=_where_shown(stays, capture))
    room = solving.solve(steady, config, run, pinned, away(stays, capture))
    for piece in room.scene.objects if room.scene.ground is not None else ():
        mine = stays.get(-1 if piece.annotation is None else piece.annotation)
        if mine:
            room = _with_segments(room, piece, mine, solving)
    return told_of_proposals(room)


def _with_segments(room: Room, piece: SceneObject, stays: list[Stay], solving: Solving) -> Room:
    """The room with an object in its segments, and without proposals of what it then is."""
    places, told = _places(room, piece, stays, solving)
    moves = _moves(room, places, stays, solving)
    segments = [Segment(stays[0].first, places[0].t_world_object, places[0].yaw)]
    for place, stay, move in zip(places[1:], stays[1:], moves, strict=True):
        put = Segment(stay.first, place.t_world_object, place.yaw)
        segments += (put,) if move is None else move.segments
    moved = replace(places[_shown_in(stays, solving.capture)], segments=tuple(segments))
    pieces = tuple(moved if p.id == moved.id else p for p in room.scene.objects)
    said = "; ".join(_told(stay, move) for stay, move in zip(stays[1:], moves, strict=True))
    return replace(
        room,
        scene=replace(room.scene, objects=pieces),
        proposals=tuple(p for p in room.proposals if not _stands_in(p, places)),
        warnings=tuple(dict.fromkeys((*room.warnings, *told, f"{piece.id}: it is moved, {said}"))),
    )


def _told(stay: Stay, move: Followed | None) -> str:
    """How an object comes to where it stays, for the report."""
    if move is None:
        return f"at frame {stay.first}"
    how = "under" if move.hold == "seat" else "by the hands of"
    return f"{how} person {move.person} until frame {move.segments[-1].frame}"


def _moves(
    room: Room, places: list[SceneObject], stays: list[Stay], solving: Solving
) -> list[Followed | None]:
    """Who moves an object from each of its stays to the next."""
    bodies, ground = room.bodies, room.scene.ground
    if bodies is None or ground is None:
        return [None] * (len(stays) - 1)
    people = bodies, parts_of(bodies)
    return [
        follow_mover(Between(*two, a.sure[1], b.sure[0]), people, ground, solving.config.moves)
        for two, (a, b) in zip(pairwise(places), pairwise(stays), strict=True)
    ]


def _stands_in(proposal: Proposal, places: list[SceneObject]) -> bool:
    """Whether a proposal is where an object stands in one of its stays."""
    middle = box_of(proposal.object).center
    return any(bool((beyond(box_of(piece), middle) < 0).all()) for piece in places)


def _places(
    room: Room, piece: SceneObject, stays: list[Stay], solving: Solving
) -> tuple[list[SceneObject], tuple[str, ...]]:
    """The object in each stay, as large as in that of the reference image; what was told there."""
    capture, config = solving.capture, solving.config
    others = tuple(p.id for p in room.scene.objects if p.id != piece.id)
    shown = _shown_in(stays, capture)
    given = next(p for p in capture.scene.objects if p.id == piece.id)
    piece = replace(piece, scale=given.scale)
    views = [_view(stays, k, room, capture) for k in range(len(stays))]
    feet = [_foot(view, stays[0].annotation, room) for view in views]
    held, found = _held(config), dict[int, SceneObject]()
    told: tuple[str, ...] = ()
    for index in sorted(range(len(stays)), key=lambda k: k != shown):
        begins = replace(piece, t_world_object=piece.t_world_object + feet[index] - feet[shown])
        part = _segment(room, begins, (stays, index), views[index], solving)
        solved = solving.solve(part, held, solving.run, others, ())
        told = told if index == shown else (*told, *solved.warnings)
        there = next(p for p in solved.scene.objects if p.id == piece.id)
        found[index] = _seen_from(there, views[index], back=True)
        piece, held = found[shown], with_sizes(_held(config), RIGID, RIGID)
    return [found[k] for k in range(len(stays))], told


def _shown_in(stays: list[Stay], capture: Capture) -> int:
    """The stay that the reference image shows."""
    mask = next(d.mask for d in capture.detections if d.id == stays[0].annotation)
    if mask is None:
        return 0
    there = thin(mask, 0, STEP)
    common = [int((there & stay.mask).sum()) / int((there | stay.mask).sum()) for stay in stays]
    return max(range(len(stays)), key=lambda k: common[k])


@dataclass(frozen=True)
class _View:
    """Where a stay is seen from, and what is seen there."""

    pose: CameraPath
    """One, in the axes of the reference image's camera."""
    camera: Camera
    """In a world about it."""
    place: Float[Tensor, "3"]
    """Of that camera in the room [m]."""
    turn: float
    """From the room's axes to that world's about +y [rad]."""
    detections: tuple[Detection, ...]
    people: Masks | None
    """Who hides something there."""
    depth: DepthImage | None
    """Measured there."""


def _view(stays: list[Stay], index: int, room: Room, capture: Capture) -> _View:
    """The reference image, where it shows the stay or the camera stands still; else a frame."""
    stay, camera, people = stays[index], room.scene.camera, capture.reference_people
    here = STILL, camera, torch.zeros(3), 0.0
    if is_still(room.path):
        seen = (_as_in(d, stay) if d.id == stay.annotation else d for d in capture.detections)
        return _View(*here, tuple(seen), people, capture.depth)
    if index == _shown_in(stays, capture):
        return _View(*here, capture.detections, people, capture.depth)
    pose = poses_at(room.path, torch.tensor([stay.best]))
    R = pose.R_reference_camera[0].mT @ camera.R_cam_world
    turn = heading(R)
    about_it = replace(camera, R_cam_world=R @ rot_y(torch.tensor(turn)).mT)
    place = camera.R_cam_world.mT @ pose.t_reference_camera[0]
    return _View(pose, about_it, place, turn, *_shown_at(stay.best, capture), None)


def _shown_at(frame: int, capture: Capture) -> tuple[tuple[Detection, ...], Masks]:
    """What a frame shows of the objects, and the people before them."""
    seen, pieces = evidence_at(capture, frame), capture.scene.objects
    height, width = seen.people.shape
    found = tuple(
        Detection(piece.annotation, piece.category, box, Masks(height, width, (encode(mask),)), 1.0)
        for piece, there, box, mask in zip(
            pieces, seen.detected.tolist(), seen.boxes, seen.masks, strict=True
        )
        if there and piece.annotation is not None
    )
    return found, Masks(height, width, (encode(seen.people),))


def _seen_from(piece: SceneObject, view: _View, back: bool = False) -> SceneObject:
    """An object of the room in the world about a view, or the way back."""
    if back:
        t = rot_y(torch.tensor(-view.turn)) @ piece.t_world_object + view.place
        return replace(piece, t_world_object=t, yaw=piece.yaw - view.turn)
    t = rot_y(torch.tensor(view.turn)) @ (piece.t_world_object - view.place)
    return replace(piece, t_world_object=t, yaw=piece.yaw + view.turn)


def _foot(view: _View, annotation: int, room: Room) -> Float[Tensor, "3"]:
    """Where the ray through the middle of an object's lower edge meets the floor [m]."""
    left, _, right, low = next(d.box for d in view.detections if d.id == annotation).tolist()
    pixel = torch.tensor([(left + right) / 2, low, 1.0])
    ray = torch.linalg.solve(view.camera.K, pixel)
    foot = hit_floor(ray, view.camera.R_cam_world, torch.tensor(room.scene.ground) - view.place[1])
    return rot_y(torch.tensor(-view.turn)) @ foot + view.place


def _segment(
    room: Room, piece: SceneObject, stay: tuple[list[Stay], int], view: _View, solving: Solving
) -> Capture:
    """A capture of one stay: its people and its mask before the room as it was found."""
    capture, (stays, index) = solving.capture, stay
    this = stays[index]
    bodies, people = _in_frames(room), capture.people
    margin = 0.0 if bodies is None else solving.config.moves.margin * (bodies.fps or 0.0)
    begin = this.sure[0] + margin if index else -ENDLESS
    end = this.sure[1] - margin if index + 1 < len(stays) else ENDLESS
    if bodies is not None:
        inside = (bodies.frame >= begin) & (bodies.frame <= end)
        bodies = rows_of(bodies, inside) if bool(inside.any()) else None
    if people is not None:
        people = rows_of(people, (people.frame >= begin) & (people.frame <= end))
    others = (replace(placed_at(p, this.sure[0]), segments=()) for p in room.scene.objects)
    objects = tuple(_seen_from(piece if p.id == piece.id else p, view) for p in others)
    assert room.scene.ground is not None
    ground = room.scene.ground - float(view.place[1])
    scene = replace(room.scene, camera=view.camera, ground=ground, objects=objects)
    return replace(
        capture, scene=scene, camera_height=-ground, detections=view.detections,
        reference_people=view.people, bodies=bodies, people=people, touch=None, hypotheses=(),
        furniture=None, warnings=(), path=about(room.path, view.pose),
        depth=view.depth,
    )  # fmt: skip


def _in_frames(room: Room) -> Bodies | None:
    """The people of a room in the axes of the cameras of their frames."""
    if room.bodies is None:
        return None
    bodies = into_camera(room.bodies, room.scene.camera.R_cam_world)
    if is_still(room.path):
        return bodies
    frames = torch.cat([room.path.frame, bodies.frame]).unique()
    return carried(bodies, reversed_poses(poses_at(room.path, frames)))


def _as_in(found: Detection, stay: Stay) -> Detection:
    """A detection as it is in a stay."""
    if found.mask is None:
        return replace(found, box=STEP * tight_box(stay.mask))
    big = enlarged(stay.mask, STEP)
    mask = torch.zeros(found.mask.height, found.mask.width, dtype=torch.bool)
    height, width = (min(a, b) for a, b in zip(big.shape, mask.shape, strict=True))
    mask[:height, :width] = big[:height, :width]
    coded = Masks(found.mask.height, found.mask.width, (encode(mask),))
    return replace(found, mask=coded, box=tight_box(mask))


def _held(config: Config) -> Config:
    """Camera, floor, people and their sizes stay as they were found."""
    return replace(
        config,
        correct_depth=False,
        path="keep",
        height_spread=0.0,
        align=replace(config.align, steps=0),
        refine=replace(config.refine, rounds=0),
        sizes=SpreadConfig(),
        propose=ProposeConfig(use=False),
    )
