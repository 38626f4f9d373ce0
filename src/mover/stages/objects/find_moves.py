"""When furniture is moved: change points of the objects' masks in the frames (none without such).

What is seen of an object where nobody hides it is compared with what was seen of it since it last
stood still: by the common pixels' share of the smaller of both, for what is hidden or uncovered by
other furniture only grows or shrinks, and what is moved does both. What is pushed straight away
only shrinks, too: so where neither people nor other furniture are seen, and nothing can hide it,
the share of the larger counts. Each stretch between two moves
is a stay, in which the object stands; its mask is what most of its frames show where nobody is
before it. Stretches that are too short are moves themselves: the object is carried or pushed.

The masks of a moving camera are compared in the image of the reference camera, to which they are
carried as if the object were flat, at several depths: what stands still is alike at one of them. A
camera that stands still has one depth, and nothing to carry.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cache
from itertools import pairwise

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import max_pool2d

from mover.core.observe import Observer, Step, silent
from mover.core.records import record, rows_of
from mover.core.types import STILL, CameraPath, People
from mover.geometry.camera import project
from mover.geometry.path import is_still, poses_at, resampled
from mover.geometry.rle import area, decode, tight_box
from mover.stages.config import MoveConfig
from mover.stages.masks import enlarged, thin, widened

STEP = 3  # [px] from one pixel that is compared to the next
WIDE = 480  # [px]; masks of a wider image are carried by so many times longer steps
UNSEEN = 2.0  # more alike than any two masks can be: nothing is said against it
NEAREST, FARTHEST = 0.7, 1.5  # times its first depth: what is moved goes so near or so far
SWEEP = 2.0  # [steps] by which a mask is carried from one depth to the next, at most
RELIEF = 0.07  # of its depth: what stands still is not flat, so that carried outlines differ


@record
class MoveInputs:
    """The objects and the people in the frames."""

    furniture: People
    """Visible masks of objects; `person` is the number of an annotation."""
    people: People | None
    annotations: tuple[int, ...]
    """Of the objects."""
    fps: float | None
    depth: Float[Tensor, " objects"] = torch.zeros(0)
    """Only of a moving camera, as is all that follows: of the middle of each object from the
    reference image's camera, as first guessed [m]."""
    path: CameraPath = STILL
    """[m]"""
    K: Float[Tensor, "3 3"] = torch.eye(3)


@record
class Stay:
    """A time in which an object stands."""

    annotation: int
    first: int
    """Its first frame; the time ends where that of the next begins."""
    mask: Bool[Tensor, "h w"]
    """What the reference image's camera sees of it, at a third of the image's resolution."""
    sure: tuple[int, int]
    """First and last frame that show it there."""
    best: int
    """The frame that shows most of it."""


@record
class Moves:
    """All stays of the objects that are moved; objects that never are have none."""

    stays: tuple[Stay, ...]
    """By object and time."""


def find_moves(inputs: MoveInputs, config: MoveConfig, observe: Observer = silent) -> Moves:
    """The change points of each object.

    The object that changes most is taken first; where it is seen, it may hide or uncover others,
    which are looked at again without these pixels.
    """
    seen = _sights(inputs)
    alone: dict[int, list[_Run]] = {}
    for index, (number, sight) in enumerate(seen.items()):
        observe(Step("find_moves", index, len(seen)))
        alone[number] = _stays(sight, config)
    changed = {n: _least_alike(stays, seen[n], config) for n, stays in alone.items()}
    found: list[Stay] = []
    moved: tuple[_Sight, ...] = ()
    for number in sorted((n for n, alike in changed.items() if alike < 1), key=changed.__getitem__):
        sight = seen[number]
        stays = _stays(sight, config, moved) if moved else alone[number]
        if len(stays) > 1:
            starts = [0, *((a.sure + b.first + 1) // 2 for a, b in pairwise(stays))]
            found += [_told(number, *pair, sight) for pair in zip(starts, stays, strict=True)]
            moved = (*moved, sight)
    return Moves(tuple(found))


def _least_alike(stays: "list[_Run]", sight: "_Sight", config: MoveConfig) -> float:
    """How alike the two stays are that differ most; 1 where there is but one."""
    return min((_likeness(a, b, sight, config) for a, b in pairwise(stays)), default=UNSEEN)


def _hidden(people: People | None, frame: int, step: int) -> Bool[Tensor, "h w"] | None:
    """Pixels of some rows of a frame, and those beside them; None: there are none."""
    present = [] if people is None else (people.frame == frame).nonzero()[:, 0].tolist()
    if people is None or not present:
        return None
    hidden = torch.stack([thin(people.masks, row, step) for row in present]).any(0)
    return widened(hidden[None], 1)[0]


def _covered(furniture: People, frame: int, step: int) -> Bool[Tensor, "h w"]:
    """Steps with any pixel of furniture in a frame, and those beside them: what is thin is seen."""
    rows = (furniture.frame == frame).nonzero()[:, 0].tolist()
    whole = torch.stack([decode(furniture.masks, row) for row in rows]).any(0)
    height, width = thin(furniture.masks, rows[0], step).shape
    steps = max_pool2d(whole[None].float(), step, ceil_mode=True)[:, :height, :width]
    return widened(steps > 0, 1)[0]


@dataclass(frozen=True)
class _Sight:
    """How one object is looked at."""

    furniture: People
    """Its masks, in the order of their frames."""
    hidden: Callable[[int], Bool[Tensor, "h w"] | None]
    """What people hide in a frame."""
    covered: Callable[[int], Bool[Tensor, "h w"]]
    """Where a frame may show furniture."""
    fps: float | None
    path: CameraPath
    step: int
    """From one pixel that is compared to the next [px]."""
    K: Float[Tensor, "3 3"]
    """Of the thinner image."""
    depth: Float[Tensor, " depths"]
    """At which it is compared [m]."""
    window: tuple[slice, slice]
    """Rows and columns of the thinner image of the reference camera in which a moving camera sees
    it."""
    loose: int
    """By how much carried outlines of it differ while it stands still [steps]."""


def _sights(inputs: MoveInputs) -> dict[int, _Sight]:
    """Each object, by its annotation."""
    still = is_still(inputs.path)
    step = STEP if still else STEP * max(1, round(inputs.furniture.masks.width / WIDE))
    hidden = cache(lambda frame: _hidden(inputs.people, frame, step))
    covered = cache(lambda frame: _covered(inputs.furniture, frame, step))
    K = inputs.K / torch.tensor([[step], [step], [1.0]])
    found: dict[int, _Sight] = {}
    for index, number in enumerate(inputs.annotations):
        rows = (inputs.furniture.person == number).nonzero()[:, 0]
        mine = rows_of(inputs.furniture, rows[inputs.furniture.frame[rows].argsort()])
        here = torch.ones(1), (slice(0, 0), slice(0, 0)), 0
        sight = _Sight(mine, hidden, covered, inputs.fps, inputs.path, step, K, *here)
        if len(rows) and not still:
            sight = _swept(sight, float(inputs.depth[index]))
        found[number] = sight
    return found


def _swept(sight: _Sight, depth: float) -> _Sight:
    """The depths at which what a moving camera sees is compared, and where it is seen then."""
    poses = poses_at(sight.path, sight.furniture.frame)
    near, far = 1 / (NEAREST * depth), 1 / (FARTHEST * depth)
    at = torch.cat([torch.zeros(1, 3), poses.t_reference_camera])
    moves = float((at.amax(0) - at.amin(0)).norm() * sight.K[0, 0])  # of what is 1 m away
    depths = 1 / torch.linspace(near, far, 1 + math.ceil(moves * (near - far) / SWEEP))
    masks = (decode(sight.furniture.masks, row) for row in range(len(poses.frame)))
    boxes = torch.stack([tight_box(mask) for mask in masks]) / sight.step
    corner = torch.stack([boxes[:, [0, 2, 0, 2]], boxes[:, [1, 1, 3, 3]]], -1)
    ray = torch.nn.functional.pad(corner, (0, 1), value=1.0) @ torch.linalg.inv(sight.K).mT
    ray = ray @ poses.R_reference_camera.mT
    reach = (depths[:, None, None] - poses.t_reference_camera[:, None, 2]) / ray[..., 2]
    point = poses.t_reference_camera[:, None] + reach[..., None] * ray
    low, high = (
        end(project(point, sight.K).flatten(0, -2), 0)[0] for end in (torch.min, torch.max)
    )
    (left, top), (right, bottom) = low.floor().long().tolist(), high.ceil().long().tolist()
    window = slice(top, bottom), slice(left, right)
    return replace(sight, depth=depths, window=window, loose=round(moves * RELIEF / depth))


def _seen(sight: _Sight, row: int, moved: tuple[_Sight, ...]) -> "_Run":
    """One of an object's frames as a run."""
    seen, frame = thin(sight.furniture.masks, row, sight.step), int(sight.furniture.frame[row])
    people = sight.hidden(frame)
    others = (_hidden(one.furniture, frame, sight.step) for one in moved)
    hidden = [mask for mask in (people, *others) if mask is not None]
    free = ~torch.stack(hidden).any(0) if hidden else torch.ones_like(seen)
    seen, bare = seen & free, torch.zeros_like(seen)
    if people is not None:  # else people may hide what no mask tells
        bare = seen | (free & ~sight.covered(frame))
    if is_still(sight.path):
        return _Run(frame, frame, frame, *(mask[None].long() for mask in (seen, free, bare)))
    pose, (rows, columns) = poses_at(sight.path, torch.tensor([frame])), sight.window
    size = rows.stop - rows.start, columns.stop - columns.start
    depth = sight.depth[:, None, None].expand(-1, *size)
    carried = resampled(torch.stack([seen, free, bare]), depth, (sight.K, sight.window), pose)
    return _Run(frame, frame, frame, *carried.long().unbind(0))


@dataclass(frozen=True)
class _Run:
    """Frames in a row in which an object looks the same."""

    first: int
    last: int
    sure: int
    """The last that shows enough of it."""
    hits: Int[Tensor, "depths h w"]
    """In how many frames it is seen."""
    times: Int[Tensor, "depths h w"]
    """In how many it could be seen."""
    bare: Int[Tensor, "depths h w"]
    """In how many it is seen, or nothing else that could hide it."""

    @property
    def usual(self) -> Bool[Tensor, "depths h w"]:
        """What most frames show."""
        return 2 * self.hits > self.times

    def after(self, other: "_Run", sure: bool) -> "_Run":
        """Both as one."""
        last = self.sure if sure else other.sure
        hits, times = self.hits + other.hits, self.times + other.times
        return _Run(other.first, self.last, last, hits, times, self.bare + other.bare)


def _stays(sight: _Sight, config: MoveConfig, moved: tuple[_Sight, ...] = ()) -> list[_Run]:
    """The stretches in which an object stands."""
    runs: list[_Run] = []
    for row in range(len(sight.furniture.frame)):  # what is usual grows
        run = _seen(sight, row, moved)
        alike = _likeness(run, runs[-1], sight, config) if runs else 0.0
        if alike > config.alike:
            runs[-1] = run.after(runs[-1], alike <= 1)
        else:
            runs.append(run)
    least = config.seconds * (sight.fps or 1.0)
    stays: list[_Run] = []
    for run in (run for run in runs if run.last - run.first >= least):
        if stays and _likeness(run, stays[-1], sight, config) > config.alike:
            stays[-1] = run.after(stays[-1], True)
        else:
            stays.append(run)
    return stays


def _likeness(a: _Run, b: _Run, sight: _Sight, config: MoveConfig) -> float:
    """Common pixels of an object in two runs, as a share; `UNSEEN`: too few are seen.

    Of those of the smaller, since the rest may be hidden; where no mask could hide it, of those of
    the larger. The less counts, at the depth that suits both best.
    """
    enough = config.visible * torch.maximum(_count(a.usual), _count(b.usual))
    alike = torch.full_like(enough, UNSEEN)
    for bare in (False, True):
        times = (a.bare, b.bare) if bare else (a.times, b.times)
        known = (times[0] > 0) & (times[1] > 0)
        one, other = (known & (2 * run.hits > n) for run, n in zip((a, b), times, strict=True))
        pairs = (one, other), (other, one)
        common = torch.stack([_count(x & widened(y, sight.loose)) for x, y in pairs])
        size = torch.stack([_count(one), _count(other)])
        if bare:
            whole, share = size.amax(0), (common / size.clamp_min(1.0)).amin(0)
        else:
            whole = size.amin(0)
            share = common.amin(0) / whole.clamp_min(1.0)
        alike = torch.minimum(alike, torch.where(whole >= enough, share, UNSEEN))
    told = alike[alike <= 1]
    return float(told.max()) if len(told) else UNSEEN


def _count(masks: Bool[Tensor, "depths h w"]) -> Float[Tensor, " depths"]:
    return masks.flatten(1).sum(1).double()


def _told(number: int, start: int, run: _Run, sight: _Sight) -> Stay:
    """What is told of a stay."""
    masks, frame = sight.furniture.masks, sight.furniture.frame
    agreed = _count(run.usual & (run.hits > 0)) / _count(run.hits > 0).clamp_min(1.0)
    usual = run.usual[int(agreed.argmax())]
    within = ((frame >= run.first) & (frame <= run.sure)).nonzero()[:, 0].tolist()
    best = int(frame[max(within, key=lambda row: area(masks, row))])
    mask = usual if is_still(sight.path) else _in_image(usual, sight)
    return Stay(number, start, mask, (run.first, run.sure), best)


def _in_image(usual: Bool[Tensor, "h w"], sight: _Sight) -> Bool[Tensor, "height width"]:
    """What is seen in a window, in the image of the reference camera at the resolution of stays."""
    image = torch.zeros_like(thin(sight.furniture.masks, 0, STEP))
    (rows, columns), (height, width), times = sight.window, image.shape, sight.step // STEP
    y, x = (
        enlarged(usual, times).nonzero() + times * torch.tensor([rows.start, columns.start])
    ).unbind(1)
    inside = (y >= 0) & (y < height) & (x >= 0) & (x < width)
    image[y[inside], x[inside]] = True
    return image
