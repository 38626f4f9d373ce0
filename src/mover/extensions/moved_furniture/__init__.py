"""Objects that are moved: where each stands in each segment of the video, with one shape and size.

Not in the paper, whose furniture stands still (Sec. 5, "Future work"). The whole room is rebuilt
first, as if nothing moved. Then each segment of each moved object is a small reconstruction of its
own: camera, floor, people and all other objects stay as they were found, the object's mask is that
of the segment, and only the people of the segment count. The segment of the reference image comes
first and gives the size, which the others keep. The camera stands still.
"""

from dataclasses import dataclass, replace
from itertools import pairwise

import torch
from jaxtyping import Float
from torch import Tensor

from mover.bodies.parts import parts_of
from mover.core.records import rows_of
from mover.core.run import Run
from mover.core.types import Capture, Detection, Masks, People, Room, SceneObject, Segment
from mover.extensions.moved_furniture.stays import (
    STEP,
    Between,
    Followed,
    MoveInputs,
    Stay,
    find_moves,
    follow_mover,
)
from mover.geometry.path import is_still
from mover.geometry.placement import ENDLESS, hit_floor, placed_at
from mover.geometry.rle import encode, tight_box
from mover.io.capture.pose_file import into_camera
from mover.pipeline.presets import Config, with_sizes
from mover.pipeline.reconstruct import reconstruct
from mover.stages.config import SpreadConfig
from mover.stages.masks import enlarged, thin

RIGID = 1e3  # factor on the cost of another size in all segments but the first
MARGIN = 0.8  # [s] before and after an object is seen elsewhere in which people may be moving it
FLOATING = " sits on nothing in "  # a diagnostic that holds only while the furniture stands


@dataclass(frozen=True)
class _MovedObject:
    """One object that is moved, and its stays in the order of time."""

    given: SceneObject
    stays: tuple[Stay, ...]
    shown: int  #: the stay that the reference image shows


def reconstruct_moved(
    capture: Capture, config: Config, run: Run, pinned: tuple[str, ...] = ()
) -> Room:
    """The room, with its moved objects where they stand when."""
    objects = tuple(replace(piece, segments=()) for piece in capture.scene.objects)
    capture = replace(capture, scene=replace(capture.scene, objects=objects))
    moved = moved_objects(capture, run)
    steady = replace(capture, furniture=_where_shown(moved, capture.furniture))
    room = reconstruct(steady, config, run, pinned)
    if room.scene.ground is None:
        return room
    if moved:  # what people sit on may be elsewhere then: each segment answers for itself
        room = replace(room, warnings=tuple(w for w in room.warnings if FLOATING not in w))
    for one in moved:
        room = _with_segments(room, one, capture, config, run)
    return room


def moved_objects(capture: Capture, run: Run) -> list[_MovedObject]:
    """When each object that is moved stands where; none without masks of it in the frames."""
    known = {p.annotation: p for p in capture.scene.objects if p.annotation is not None}
    if capture.furniture is None or not known or not is_still(capture.path):
        return []
    fps = None if capture.bodies is None else capture.bodies.fps
    inputs = MoveInputs(capture.furniture, capture.people, tuple(known), fps)
    stays = run.stage(find_moves, inputs, None).stays
    found: list[_MovedObject] = []
    for number, piece in known.items():
        of_it = tuple(stay for stay in stays if stay.annotation == number)
        if of_it:
            mask = next(d.mask for d in capture.detections if d.id == number)
            found.append(_MovedObject(piece, of_it, _shown_in(of_it, mask)))
    return found


def _shown_in(stays: tuple[Stay, ...], mask: Masks | None) -> int:
    """The stay whose mask is most like that of the reference image."""
    if mask is None:
        return 0
    pixels = thin(mask, 0, STEP)
    common = [int((pixels & s.mask).sum()) / int((pixels | s.mask).sum()) for s in stays]
    return max(range(len(stays)), key=lambda k: common[k])


def _where_shown(moved: list[_MovedObject], furniture: People | None) -> People | None:
    """The objects' masks of the frames in which they are where the reference image shows them."""
    if furniture is None:
        return None
    frame, gone = furniture.frame, torch.zeros_like(furniture.frame, dtype=torch.bool)
    for one in moved:
        first, last = one.stays[one.shown].sure
        of_it = furniture.person == one.given.annotation
        gone = gone | (of_it & ((frame < first) | (frame > last)))
    return rows_of(furniture, ~gone)


def _with_segments(
    room: Room, one: _MovedObject, capture: Capture, config: Config, run: Run
) -> Room:
    """The room with an object in its segments."""
    placed, warnings = _placed(room, one, capture, config, run)
    moves = _moves(room, placed, one.stays)
    segments = [Segment(one.stays[0].first, placed[0].t_world_object, placed[0].yaw)]
    for piece, stay, move in zip(placed[1:], one.stays[1:], moves, strict=True):
        put = Segment(stay.first, piece.t_world_object, piece.yaw)
        segments += (put,) if move is None else move.segments
    moved = replace(placed[one.shown], segments=tuple(segments))
    how = "; ".join(
        f"at frame {stay.first}" if move is None else _described(move)
        for stay, move in zip(one.stays[1:], moves, strict=True)
    )
    said = f"{moved.id}: it is moved, {how}"
    objects = tuple(moved if p.id == moved.id else p for p in room.scene.objects)
    return replace(
        room,
        scene=replace(room.scene, objects=objects),
        warnings=tuple(dict.fromkeys((*room.warnings, *warnings, said))),
    )


def _described(move: Followed) -> str:
    how = "under" if move.hold == "seat" else "by the hands of"
    return f"{how} person {move.person} until frame {move.segments[-1].frame}"


def _moves(room: Room, placed: list[SceneObject], stays: tuple[Stay, ...]) -> list[Followed | None]:
    """The person who moves an object from each of its stays to the next."""
    bodies, ground = room.bodies, room.scene.ground
    if bodies is None or ground is None:
        return [None] * (len(stays) - 1)
    parts = parts_of(bodies)
    return [
        follow_mover(Between(*two, a.sure[1], b.sure[0]), bodies, parts, ground)
        for two, (a, b) in zip(pairwise(placed), pairwise(stays), strict=True)
    ]


def _placed(
    room: Room, one: _MovedObject, capture: Capture, config: Config, run: Run
) -> tuple[list[SceneObject], tuple[str, ...]]:
    """The object in each stay, as large as in that of the reference image; warnings of all."""
    piece = next(p for p in room.scene.objects if p.id == one.given.id)
    others = tuple(p.id for p in room.scene.objects if p.id != piece.id)
    piece = replace(piece, scale=one.given.scale)
    views = [
        tuple(_as_in(d, stay) if d.id == stay.annotation else d for d in capture.detections)
        for stay in one.stays
    ]
    feet = [_foot(view, one.stays[0].annotation, room) for view in views]
    held, found = _held(config), dict[int, SceneObject]()
    warnings: list[str] = []
    for index in sorted(range(len(one.stays)), key=lambda k: k != one.shown):
        start = replace(piece, t_world_object=piece.t_world_object + feet[index] - feet[one.shown])
        part = replace(_segment(room, start, one, index, capture), detections=views[index])
        solved = reconstruct(part, held, run, others)
        warnings += (w for w in solved.warnings if FLOATING in w)
        found[index] = next(p for p in solved.scene.objects if p.id == piece.id)
        piece, held = found[one.shown], with_sizes(_held(config), RIGID, RIGID)
    return [found[k] for k in range(len(one.stays))], tuple(warnings)


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


def _foot(detections: tuple[Detection, ...], annotation: int, room: Room) -> Float[Tensor, "3"]:
    """Where the ray through the middle of an object's lower edge meets the floor [m]."""
    left, _, right, low = next(d.box for d in detections if d.id == annotation).tolist()
    camera = room.scene.camera
    ray = torch.linalg.solve(camera.K, torch.tensor([(left + right) / 2, low, 1.0]))
    return hit_floor(ray, camera.R_cam_world, torch.tensor(room.scene.ground))


def _segment(
    room: Room, start: SceneObject, one: _MovedObject, index: int, capture: Capture
) -> Capture:
    """A capture of one stay: its people before the room as it was found."""
    stay, people, bodies = one.stays[index], capture.people, room.bodies
    margin = 0.0 if bodies is None else MARGIN * (bodies.fps or 0.0)
    begin = stay.sure[0] + margin if index else -ENDLESS
    end = stay.sure[1] - margin if index + 1 < len(one.stays) else ENDLESS
    if bodies is not None:
        inside = (bodies.frame >= begin) & (bodies.frame <= end)
        bodies = into_camera(bodies, room.scene.camera.R_cam_world)
        bodies = rows_of(bodies, inside) if bool(inside.any()) else None
    if people is not None:
        people = rows_of(people, (people.frame >= begin) & (people.frame <= end))
    others = (replace(placed_at(p, stay.sure[0]), segments=()) for p in room.scene.objects)
    objects = tuple(start if p.id == start.id else p for p in others)
    assert room.scene.ground is not None
    return replace(
        capture, scene=replace(room.scene, objects=objects), camera_height=-room.scene.ground,
        bodies=bodies, people=people, touch=None, hypotheses=(), furniture=None, warnings=(),
        tilt=None,
    )  # fmt: skip


def _held(config: Config) -> Config:
    """Lens, camera, floor, people and their sizes stay as they were found."""
    return replace(
        config,
        lens=replace(config.lens, use=False),
        correct_depth=False,
        height_spread=0.0,
        align=replace(config.align, steps=0),
        refine=replace(config.refine, rounds=0),
        sizes=SpreadConfig(),
    )
