"""When furniture is moved, by change points of its masks, and who moves it.

What is seen of an object where nothing hides it is compared with what was seen of it since it last
stood still: by the common pixels as a share of the smaller mask, for what is hidden or uncovered by
other furniture only grows or shrinks, and what is moved does both. What is pushed straight away
only shrinks, too: so where neither people nor other furniture are seen, and nothing can hide it,
the share of the larger mask counts. Each stretch between two moves is a stay, in which the object
stands; its mask is what most of its frames show where no person is before it. Stretches that are
too short are moves themselves: the object is carried or pushed.

Between two stays an object is put, unseen (then it jumps), or moves with a person, held by hand or
sat on. The mover is found by motion alone: a rigid hold on the hands, or on the pelvis of a sitting
person, carries the object from its position before to its position after,

    T_k = H_k H_a^{-1} T_a,   and from the other end   H_k H_b^{-1} T_b

with H_k the hold (a position on the floor and a heading) in frame k. Of all first and last frames
a, b about the time between the stays those are taken that bring it nearest to where it is found
after, with a cost for each frame; both ends are then met by going over from the first to the
second.

The camera stands still.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import max_pool2d

from mover.bodies.parts import BodyParts
from mover.bodies.posture import at, facing, landmarks, postures
from mover.core.observe import Observer, Step, silent
from mover.core.records import record, rows_of
from mover.core.types import Bodies, People, SceneObject, Segment
from mover.geometry.boxes import beyond, box_of
from mover.geometry.placement import placed_at
from mover.geometry.rle import decode
from mover.geometry.rotations import rot_y, wrap
from mover.stages.masks import thin, widened

STEP = 3  # [px] from one pixel that is compared to the next
SIMILAR = 0.7  # share of common pixels from which two masks show an object that stands still
VISIBLE = 0.3  # share of an object that must be seen for a comparison
UNSEEN = 2.0  # more similar than any two masks can be: nothing speaks against it
SECONDS = 1.5  # [s], an object that stands for a shorter time is being moved


@record
class MoveInputs:
    """The objects and the people in the frames."""

    furniture: People  #: visible masks of objects; `person` is the number of an annotation
    people: People | None
    annotations: tuple[int, ...]  #: of the objects
    fps: float | None


@record
class Stay:
    """A time in which an object stands."""

    annotation: int
    first: int  #: its first frame; the time ends where that of the next begins
    mask: Bool[Tensor, "h w"]  #: what is seen of it, at a third of the image's resolution
    sure: tuple[int, int]  #: first and last frame that show it there


@record
class Moves:
    """All stays of the objects that are moved; objects that never are have none."""

    stays: tuple[Stay, ...]  #: by object and time


def find_moves(inputs: MoveInputs, config: None = None, observe: Observer = silent) -> Moves:
    """The change points of each object.

    The object that changes most is taken first; where it is seen, it may hide or uncover others,
    which are compared again without these pixels.
    """
    del config
    sights, whole = _sights(inputs), dict[int, list[_Stretch]]()
    for index, (number, sight) in enumerate(sights.items()):
        observe(Step("find_moves", index, len(sights)))
        whole[number] = _stretches(sight)
    changed = {
        number: min((_similarity(a, b) for a, b in pairwise(runs)), default=UNSEEN)
        for number, runs in whole.items()
    }
    found: list[Stay] = []
    moved: tuple[_ObjectMasks, ...] = ()
    for number in sorted((n for n, share in changed.items() if share < 1), key=changed.__getitem__):
        sight = sights[number]
        runs = _stretches(sight, moved) if moved else whole[number]
        if len(runs) > 1:
            starts = [0, *((a.sure + b.first + 1) // 2 for a, b in pairwise(runs))]
            found += [
                Stay(number, start, run.usual, (run.first, run.sure))
                for start, run in zip(starts, runs, strict=True)
            ]
            moved = (*moved, sight)
    return Moves(tuple(found))


@dataclass(frozen=True)
class _ObjectMasks:
    """How one object is seen."""

    furniture: People  #: its masks, in the order of their frames
    hidden: Callable[[int], Bool[Tensor, "h w"] | None]  #: what people hide in a frame
    covered: Callable[[int], Bool[Tensor, "h w"]]  #: where a frame may show furniture
    fps: float | None


def _sights(inputs: MoveInputs) -> dict[int, _ObjectMasks]:
    """Each object, by its annotation."""
    furniture = inputs.furniture
    hidden = cache(lambda frame: _hidden(inputs.people, frame))
    covered = cache(lambda frame: _covered(furniture, frame))
    found: dict[int, _ObjectMasks] = {}
    for number in inputs.annotations:
        rows = (furniture.person == number).nonzero()[:, 0]
        ordered = rows_of(furniture, rows[furniture.frame[rows].argsort()])
        found[number] = _ObjectMasks(ordered, hidden, covered, inputs.fps)
    return found


def _hidden(people: People | None, frame: int) -> Bool[Tensor, "h w"] | None:
    """Pixels of some rows of a frame, and those beside them; None: there are none."""
    present = [] if people is None else (people.frame == frame).nonzero()[:, 0].tolist()
    if people is None or not present:
        return None
    hidden = torch.stack([thin(people.masks, row, STEP) for row in present]).any(0)
    return widened(hidden[None], 1)[0]


def _covered(furniture: People, frame: int) -> Bool[Tensor, "h w"]:
    """Steps with any pixel of furniture in a frame, and those beside them: what is thin is seen."""
    rows = (furniture.frame == frame).nonzero()[:, 0].tolist()
    whole = torch.stack([decode(furniture.masks, row) for row in rows]).any(0)
    height, width = thin(furniture.masks, rows[0], STEP).shape
    steps = max_pool2d(whole[None].float(), STEP, ceil_mode=True)[:, :height, :width]
    return widened(steps > 0, 1)[0]


@dataclass(frozen=True)
class _Stretch:
    """Frames in a row in which an object looks the same."""

    first: int
    last: int
    sure: int  #: the last that shows enough of it
    hits: Int[Tensor, "h w"]  #: in how many frames it is seen
    times: Int[Tensor, "h w"]  #: in how many it could be seen
    bare: Int[Tensor, "h w"]  #: in how many it is seen, or nothing else that could hide it

    @property
    def usual(self) -> Bool[Tensor, "h w"]:
        """What most frames show."""
        return 2 * self.hits > self.times

    def after(self, other: "_Stretch", sure: bool) -> "_Stretch":
        """Both as one."""
        last = self.sure if sure else other.sure
        hits, times = self.hits + other.hits, self.times + other.times
        return _Stretch(other.first, self.last, last, hits, times, self.bare + other.bare)


def _frame(sight: _ObjectMasks, row: int, moved: tuple[_ObjectMasks, ...]) -> _Stretch:
    """One of an object's frames as a run."""
    seen, frame = thin(sight.furniture.masks, row, STEP), int(sight.furniture.frame[row])
    people = sight.hidden(frame)
    others = (_hidden(one.furniture, frame) for one in moved)
    hidden = [mask for mask in (people, *others) if mask is not None]
    free = ~torch.stack(hidden).any(0) if hidden else torch.ones_like(seen)
    seen, bare = seen & free, torch.zeros_like(seen)
    if people is not None:  # else people without a mask may hide it
        bare = seen | (free & ~sight.covered(frame))
    return _Stretch(frame, frame, frame, *(mask.long() for mask in (seen, free, bare)))


def _stretches(sight: _ObjectMasks, moved: tuple[_ObjectMasks, ...] = ()) -> list[_Stretch]:
    """The stretches in which an object stands."""
    runs: list[_Stretch] = []
    for row in range(len(sight.furniture.frame)):  # what is usual grows
        run = _frame(sight, row, moved)
        similar = _similarity(run, runs[-1]) if runs else 0.0
        if similar > SIMILAR:
            runs[-1] = run.after(runs[-1], similar <= 1)
        else:
            runs.append(run)
    stays: list[_Stretch] = []
    for run in (run for run in runs if run.last - run.first >= SECONDS * (sight.fps or 1.0)):
        if stays and _similarity(run, stays[-1]) > SIMILAR:
            stays[-1] = run.after(stays[-1], True)
        else:
            stays.append(run)
    return stays


def _similarity(a: _Stretch, b: _Stretch) -> float:
    """Common pixels of an object in two runs, as a share; `UNSEEN`: too few are seen.

    Of those of the smaller, since the rest may be hidden; where no mask could hide it, of those of
    the larger. The smaller share counts.
    """
    enough = VISIBLE * max(int(a.usual.sum()), int(b.usual.sum()))
    shares = [UNSEEN]
    for bare in (False, True):
        times = (a.bare, b.bare) if bare else (a.times, b.times)
        known = (times[0] > 0) & (times[1] > 0)
        one, other = (known & (2 * run.hits > n) for run, n in zip((a, b), times, strict=True))
        sizes = int(one.sum()), int(other.sum())
        whole = max(sizes) if bare else min(sizes)
        if whole >= enough:
            shares.append(int((one & other).sum()) / max(whole, 1))
    return min(shares)


MARGIN = 0.8  # [s] before and after an object is seen elsewhere in which it may have been moved
REACH = 0.25  # [m] from the mover's wrists to the object's footprint, at most
LOOSE = 0.1  # [m] from where the mover brings an object to where it then stands, at most ...
SHARE = 0.25  # ... and this share of the way besides
SMOOTH = (0.25, 0.5, 0.25)  # weights of the rows before, at and after: bodies tremble
FRAME = 0.01  # [m] of misfit that another frame must save
TURNED = 0.8  # [rad]; ends that disagree by more do so by a symmetry of the object
Hold = Literal["hands", "seat"]


@dataclass(frozen=True)
class Between:
    """Two stays of an object, and when it surely stands there."""

    before: SceneObject
    after: SceneObject
    last: int  #: of the frames that surely show it where it stood before
    first: int  #: of the frames that surely show it where it stands after


@dataclass(frozen=True)
class Followed:
    """How a person moves an object."""

    person: int
    hold: Hold
    segments: tuple[Segment, ...]
    """One for each frame in which it moves, and the first of its next stay."""


@dataclass(frozen=True)
class _Holds:
    """Where a person could hold something, frame by frame."""

    frame: Int[Tensor, " frames"]
    position: Float[Tensor, "frames 2"]  #: (x, z) [m]
    heading: Float[Tensor, " frames"]  #: [rad]
    able: Bool[Tensor, " frames"]  #: whether it can be held so: the person sits


def follow_mover(
    between: Between, bodies: Bodies, parts: BodyParts, ground: float
) -> Followed | None:
    """The person who moves an object from one stay to the next; None: none is seen to do so.

    All people are in the world, whose floor is at the height `ground` [m].
    """
    if bodies.fps is None:
        return None
    margin = MARGIN * bodies.fps
    near = (bodies.frame >= between.last - margin) & (bodies.frame <= between.first + margin)
    found: list[tuple[float, Followed]] = []  # of a sitter the hands are near, too
    for person in bodies.person[near].unique().tolist():
        rows = rows_of(bodies, near & (bodies.person == person))
        rows = rows_of(rows, rows.frame.argsort())
        if len(rows.frame) < 3:
            continue
        for hold, held in _holds(rows, parts, ground):
            best = _fitted(between, held, REACH if hold == "hands" else 0.0)
            if best is not None:
                misfit, first, last = best
                moving = _segments(between, held, first, last, person)
                found.append((misfit, Followed(person, hold, moving)))
    best = min(found, key=lambda pair: (pair[1].hold != "seat", pair[0]), default=None)
    return None if best is None else best[1]


def _holds(bodies: Bodies, parts: BodyParts, ground: float) -> Iterator[tuple[Hold, _Holds]]:
    """The hands and the seat of one person."""
    points = landmarks(bodies, parts)
    front = _smooth(facing(points))
    heading = torch.atan2(front[:, 0], front[:, 2])
    hands, hips = (_smooth(at(points, name))[:, [0, 2]] for name in ("wrists", "hips"))
    sits = postures(bodies, parts, ground).sitting
    yield "seat", _Holds(bodies.frame, hips, heading, sits)
    yield "hands", _Holds(bodies.frame, hands, heading, torch.ones_like(sits))


def _smooth(rows: Float[Tensor, "rows 3"]) -> Float[Tensor, "rows 3"]:
    padded = torch.cat([rows[:1], rows, rows[-1:]])
    return torch.stack([w * padded[k : k + len(rows)] for k, w in enumerate(SMOOTH)]).sum(0)


def _on_floor(position: Float[Tensor, "*any 2"]) -> Float[Tensor, "*any 3"]:
    """The point (x, 0, z)."""
    x, z = position.unbind(-1)
    return torch.stack([x, torch.zeros_like(x), z], -1)


def _carried(
    piece: SceneObject, held: _Holds, start: int
) -> tuple[Float[Tensor, "frames 2"], Float[Tensor, " frames"]]:
    """Position (x, z) [m] and yaw [rad] of an object that is fixed in a hold from one row on."""
    turn = held.heading - held.heading[start]
    off = piece.t_world_object - _on_floor(held.position[start])
    moved = (rot_y(turn) @ off)[:, [0, 2]] + held.position
    return moved, piece.yaw + turn


def _fitted(between: Between, held: _Holds, reach: float) -> tuple[float, int, int] | None:
    """Misfit [m] and the first and last row of the hold that fits best; None: none does."""
    goal = between.after.t_world_object[[0, 2]]
    far = float((goal - between.before.t_world_object[[0, 2]]).norm())
    starts, ends = (_touches(one, held, reach) for one in (between.before, between.after))
    best: tuple[float, int, int] | None = None
    for first in starts.nonzero()[:, 0].tolist():
        position = _carried(between.before, held, first)[0]
        cost = (position - goal).norm(dim=-1) + FRAME * (held.frame - held.frame[first])
        cost[: first + 1] = torch.inf
        cost[~ends] = torch.inf
        last = int(cost.argmin())
        if best is None or float(cost[last]) < best[0]:
            best = float(cost[last]), first, last
    if best is None or best[0] == torch.inf:
        return None
    _, first, last = best
    off = float((_carried(between.before, held, first)[0][last] - goal).norm())
    return best if off <= LOOSE + SHARE * far else None


def _touches(piece: SceneObject, held: _Holds, reach: float) -> Bool[Tensor, " frames"]:
    """Rows in which the hold is over the footprint of an object, or within reach of it [m].

    Rows beside those of a sitting person count: who rolls fast is not seen to sit.
    """
    off = beyond(box_of(piece), _on_floor(held.position)).clamp_min(0).norm(dim=-1)
    padded = torch.nn.functional.pad(held.able, (2, 2))
    able = torch.stack([padded[k : k + len(held.able)] for k in range(5)]).any(0)
    return (off <= reach) & able


def _segments(
    between: Between, held: _Holds, first: int, last: int, person: int
) -> tuple[Segment, ...]:
    """Each frame from one row to another; rows that are missing are filled in evenly."""
    begin, end = int(held.frame[first]), int(held.frame[last])
    share = (held.frame - begin).double().clamp_min(0) / max(1, end - begin)
    share = share.clamp_max(1).to(held.position)
    (one, yaw), (other, back) = (
        _carried(piece, held, row)
        for piece, row in ((between.before, first), (between.after, last))
    )
    position = one + share[:, None] * (other - one)
    off = wrap(back - yaw)
    turned = torch.where(off.abs() < TURNED, yaw + share * off, torch.where(share < 0.5, yaw, back))
    low, high = between.before.t_world_object[1], between.after.t_world_object[1]
    found: list[Segment] = []
    for frame in range(begin + 1, end):
        row = int((held.frame <= frame).sum()) - 1
        after = min(row + 1, last)
        step = int(held.frame[after] - held.frame[row])
        part = (frame - int(held.frame[row])) / max(1, step)
        x, z = (position[row] + part * (position[after] - position[row])).unbind()
        t = torch.stack([x, low + share[row] * (high - low), z])
        angle = turned[row] + part * wrap(turned[after] - turned[row])
        found.append(Segment(frame, t, wrap(angle), person))
    ready = placed_at(between.after, end)
    return (*found, Segment(end, ready.t_world_object, ready.yaw))
