"""Objects that are moved: where each stands in each segment of the video, with one shape and size.

The whole room is rebuilt first, as if nothing moved. Then each segment of each moved object is a
small reconstruction of its own: camera, floor, people and all other objects stay as they were
found, the object's mask is that of the segment, and only the people of the segment speak. The
segment of the reference image comes first and tells the size, which the others keep.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mover.bodies.parts import parts_of
from mover.core.records import rows_of
from mover.core.run import Run
from mover.core.types import Camera, Capture, Detection, Masks, Proposal, Room, SceneObject, Segment
from mover.geometry.boxes import beyond, box_of
from mover.geometry.path import is_still
from mover.geometry.placement import ENDLESS, hit_floor, placed_at
from mover.geometry.rle import encode, tight_box
from mover.io.capture.pose_file import into_camera
from mover.pipeline.outcome import Spans, told_of_proposals
from mover.pipeline.presets import Config, with_sizes
from mover.stages.config import ExplainConfig, ProposeConfig, SpreadConfig
from mover.stages.objects.find_moves import STEP, MoveInputs, Stay, find_moves, thin
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
    """When each object that is moved stands where; nothing without masks of it in the frames."""
    if capture.furniture is None or not is_still(capture.path):
        return {}
    numbers = tuple(p.annotation for p in capture.scene.objects if p.annotation is not None)
    fps = None if capture.bodies is None else capture.bodies.fps
    inputs = MoveInputs(capture.furniture, capture.people, numbers, fps)
    found: Stays = {}
    for stay in run.stage(find_moves, inputs, config.moves).stays:
        found.setdefault(stay.annotation, []).append(stay)
    return found


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
    room = solving.solve(capture, config, run, pinned, away(stays, capture))
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
    held, found = _held(config), dict[int, SceneObject]()
    told: tuple[str, ...] = ()
    for index in sorted(range(len(stays)), key=lambda k: k != shown):
        begins = replace(
            piece, t_world_object=piece.t_world_object + _shift(stays, index, shown, room)
        )
        part = _segment(room, begins, (stays, index), solving)
        solved = solving.solve(part, held, solving.run, others, ())
        told = told if index == shown else (*told, *solved.warnings)
        found[index] = next(p for p in solved.scene.objects if p.id == piece.id)
        piece, held = found[shown], with_sizes(_held(config), RIGID, RIGID)
    return [found[k] for k in range(len(stays))], told


def _shown_in(stays: list[Stay], capture: Capture) -> int:
    """The stay that the reference image shows."""
    mask = next(d.mask for d in capture.detections if d.id == stays[0].annotation)
    if mask is None:
        return 0
    there = thin(mask, 0)
    common = [int((there & stay.mask).sum()) / int((there | stay.mask).sum()) for stay in stays]
    return max(range(len(stays)), key=lambda k: common[k])


def _shift(stays: list[Stay], index: int, shown: int, room: Room) -> Float[Tensor, "3"]:
    """How far the foot of an object went over the floor from the reference to a stay [m]."""
    ground = torch.tensor(room.scene.ground)
    feet = torch.stack([_foot(stays[k].mask, room.scene.camera) for k in (index, shown)])
    there, here = hit_floor(feet, room.scene.camera.R_cam_world, ground)
    return there - here


def _foot(mask: Bool[Tensor, "h w"], camera: Camera) -> Float[Tensor, "3"]:
    """The ray through the middle of a mask's lower edge, in camera axes."""
    left, _, right, low = (STEP * tight_box(mask)).tolist()
    pixel = torch.tensor([(left + right) / 2, low, 1.0])
    return torch.linalg.solve(camera.K, pixel)


def _segment(
    room: Room, piece: SceneObject, stay: tuple[list[Stay], int], solving: Solving
) -> Capture:
    """A capture of one stay: its people and its mask before the room as it was found."""
    capture, (stays, index) = solving.capture, stay
    this = stays[index]
    camera, ground = room.scene.camera, room.scene.ground
    assert ground is not None
    bodies, people = room.bodies, capture.people
    margin = 0.0 if bodies is None else solving.config.moves.margin * (bodies.fps or 0.0)
    begin = this.sure[0] + margin if index else -ENDLESS
    end = this.sure[1] - margin if index + 1 < len(stays) else ENDLESS
    if bodies is not None:
        bodies = into_camera(bodies, camera.R_cam_world)
        inside = (bodies.frame >= begin) & (bodies.frame <= end)
        bodies = rows_of(bodies, inside) if bool(inside.any()) else None
    if people is not None:
        people = rows_of(people, (people.frame >= begin) & (people.frame <= end))
    others = (replace(placed_at(p, this.sure[0]), segments=()) for p in room.scene.objects)
    objects = tuple(piece if p.id == piece.id else p for p in others)
    seen = tuple(_as_in(d, this) if d.id == this.annotation else d for d in capture.detections)
    return replace(
        capture, scene=replace(room.scene, objects=objects), camera_height=-ground,
        detections=seen, bodies=bodies, people=people, touch=None, hypotheses=(), furniture=None,
        warnings=(),
    )  # fmt: skip


def _as_in(found: Detection, stay: Stay) -> Detection:
    """A detection as it is in a stay."""
    if found.mask is None:
        return found
    big = stay.mask.repeat_interleave(STEP, 0).repeat_interleave(STEP, 1)
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
        shape="keep",
        height_spread=0.0,
        focal=replace(config.focal, spread=0.0),
        align=replace(config.align, steps=0),
        refine=replace(config.refine, rounds=0),
        sizes=SpreadConfig(),
        propose=ProposeConfig(use=False),
        explain=ExplainConfig(use=False),
    )
