"""Objects that are moved: where each stands in each segment of the video, with one shape and size.

The whole room is rebuilt first, as if nothing moved. Then each segment of each moved object is a
small reconstruction of its own: camera, floor, people and all other objects stay as they were
found, the object's mask is that of the segment, and only the people of the segment speak. The
segment of the reference image comes first and tells the size, which the others keep.
"""

from collections.abc import Callable
from dataclasses import replace

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mover.core.records import rows_of
from mover.core.run import Run
from mover.core.types import Camera, Capture, Detection, Masks, Room, SceneObject, Segment
from mover.geometry.path import is_still
from mover.geometry.placement import hit_floor
from mover.geometry.rle import encode, tight_box
from mover.io.capture.pose_file import into_camera
from mover.pipeline.presets import Config, with_sizes
from mover.stages.config import ExplainConfig, ProposeConfig, SpreadConfig
from mover.stages.objects.find_moves import STEP, MoveInputs, Stay, find_moves, thin

Solve = Callable[[Capture, Config, Run, tuple[str, ...]], Room]
RIGID = 1e3  # factor on the price of another size in all segments but the first
ENDLESS = 2**40  # later than every frame


def with_moves(room: Room, capture: Capture, config: Config, run: Run, solve: Solve) -> Room:
    """The room with its moved objects where they stand when; as it is where nothing is moved."""
    if capture.furniture is None or not is_still(capture.path) or room.scene.ground is None:
        return room
    pieces = [p for p in room.scene.objects if p.annotation is not None]
    numbers = tuple(p.annotation for p in pieces if p.annotation is not None)
    fps = None if capture.bodies is None else capture.bodies.fps
    inputs = MoveInputs(capture.furniture, capture.people, numbers, fps)
    stays = run.stage(find_moves, inputs, config.moves).stays
    for piece in pieces:
        mine = [stay for stay in stays if stay.annotation == piece.annotation]
        if mine:
            moved = _with_segments(piece, mine, (room, capture), config, run, solve)
            room = _with(room, moved, f"{piece.id}: it is moved, at frame " + _listed(mine))
    return room


def _listed(stays: list[Stay]) -> str:
    return ", ".join(str(stay.first) for stay in stays[1:])


def _with(room: Room, moved: SceneObject, said: str) -> Room:
    """The room with one object in its segments."""
    pieces = tuple(moved if p.id == moved.id else p for p in room.scene.objects)
    scene = replace(room.scene, objects=pieces)
    return replace(room, scene=scene, warnings=(*room.warnings, said))


def _with_segments(
    piece: SceneObject,
    stays: list[Stay],
    known: tuple[Room, Capture],
    config: Config,
    run: Run,
    solve: Solve,
) -> SceneObject:
    """The object with its place in each stay, and as large as in that of the reference image."""
    room, capture = known
    others = tuple(p.id for p in room.scene.objects if p.id != piece.id)
    shown = _shown_in(stays, capture)
    ends = [stay.first for stay in stays[1:]] + [ENDLESS]
    given = next(p for p in capture.scene.objects if p.id == piece.id)
    piece = replace(piece, scale=given.scale)
    held, found = _held(config), dict[int, SceneObject]()
    for index in sorted(range(len(stays)), key=lambda k: k != shown):
        begins = replace(
            piece, t_world_object=piece.t_world_object + _shift(stays, index, shown, room)
        )
        part = _segment(begins, stays[index], ends[index], known)
        solved = solve(part, held, run, others)
        found[index] = next(p for p in solved.scene.objects if p.id == piece.id)
        piece, held = found[shown], with_sizes(_held(config), RIGID, RIGID)
    segments = tuple(
        Segment(stay.first, found[k].t_world_object, found[k].yaw) for k, stay in enumerate(stays)
    )
    return replace(piece, segments=segments)


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


def _segment(piece: SceneObject, stay: Stay, end: int, known: tuple[Room, Capture]) -> Capture:
    """A capture of one stay: its people and its mask before the room as it was found."""
    room, capture = known
    camera, ground = room.scene.camera, room.scene.ground
    assert ground is not None
    bodies, people = room.bodies, capture.people
    if bodies is not None:
        bodies = into_camera(bodies, camera.R_cam_world)
        inside = (bodies.frame >= stay.first) & (bodies.frame < end)
        bodies = rows_of(bodies, inside) if bool(inside.any()) else None
    if people is not None:
        people = rows_of(people, (people.frame >= stay.first) & (people.frame < end))
    objects = tuple(piece if p.id == piece.id else p for p in room.scene.objects)
    seen = tuple(_as_in(d, stay) if d.id == stay.annotation else d for d in capture.detections)
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
