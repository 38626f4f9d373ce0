"""When furniture is moved: change points of the objects' masks in the frames.

What is seen of an object where nothing hides it is compared with what was seen of it since it last
stood still: by the common pixels as a share of the smaller mask, for what is hidden or uncovered by
other furniture only grows or shrinks, and what is moved does both. What is pushed straight away
only shrinks, too: so where neither people nor other furniture are seen, and nothing can hide it,
the share of the larger mask counts. Each stretch between two moves is a stay, in which the object
stands; its mask is what most of its frames show where no person is before it. Stretches that are
too short are moves themselves: the object is carried or pushed.

The camera stands still.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from itertools import pairwise

import torch
from jaxtyping import Bool, Int
from torch import Tensor
from torch.nn.functional import max_pool2d

from mover.core.observe import Observer, Step, silent
from mover.core.records import record, rows_of
from mover.core.types import People
from mover.geometry.rle import decode
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
