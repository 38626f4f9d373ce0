"""When furniture is moved: change points of the objects' masks in the frames (none without such).

What is seen of an object where nobody hides it is compared with what was seen of it since it last
stood still: by the common pixels' share of the smaller of both, for what is hidden or uncovered by
other furniture only grows or shrinks, and what is moved does both. Each stretch between two moves
is a stay, in which the object stands; its mask is what most of its frames show where nobody is
before it. Stretches that are too short are moves themselves: the object is carried or pushed.
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
from mover.core.records import record
from mover.core.types import Masks, People
from mover.geometry.rle import thinned
from mover.stages.config import MoveConfig

STEP = 3  # [px] from one pixel that is compared to the next
UNSEEN = 2.0  # more alike than any two masks can be: nothing is said against it


@record
class MoveInputs:
    """The objects and the people in the frames."""

    furniture: People
    """Visible masks of objects; `person` is the number of an annotation."""
    people: People | None
    annotations: tuple[int, ...]
    """Of the objects."""
    fps: float | None


@record
class Stay:
    """A time in which an object stands."""

    annotation: int
    first: int
    """Its first frame; the time ends where that of the next begins."""
    mask: Bool[Tensor, "h w"]
    """What is seen of it, at a third of the image's resolution."""
    sure: tuple[int, int]
    """First and last frame that show it there."""


@record
class Moves:
    """All stays of the objects that are moved; objects that never are have none."""

    stays: tuple[Stay, ...]
    """By object and time."""


def find_moves(inputs: MoveInputs, config: MoveConfig, observe: Observer = silent) -> Moves:
    """The change points of each object.

    The object that changes most is taken first; where it is seen in one of its stays, it may hide
    or uncover others, which are looked at again without these pixels.
    """
    rows = {n: _rows_of(inputs.furniture, n) for n in inputs.annotations}
    hidden = cache(lambda frame: _hidden(inputs.people, frame))
    changed: dict[int, float] = {}
    for index, (number, mine) in enumerate(rows.items()):
        observe(Step("find_moves", index, len(rows)))
        changed[number] = _least_alike(_stays(inputs, mine, hidden, config), config)
    found: list[Stay] = []
    blocked: Bool[Tensor, "h w"] | None = None
    for number in sorted((n for n, alike in changed.items() if alike < 1), key=changed.__getitem__):
        stays = _stays(inputs, rows[number], hidden, config, blocked)
        if len(stays) > 1:
            starts = [0, *((a.sure + b.first + 1) // 2 for a, b in pairwise(stays))]
            found += [
                Stay(number, start, stay.usual, (stay.first, stay.sure))
                for start, stay in zip(starts, stays, strict=True)
            ]
            seen = torch.stack([stay.usual for stay in stays]).any(0)
            blocked = seen if blocked is None else blocked | seen
    return Moves(tuple(found))


def _rows_of(furniture: People, number: int) -> list[int]:
    """Rows of one object in the order of their frames."""
    rows = (furniture.person == number).nonzero()[:, 0]
    return rows[furniture.frame[rows].argsort()].tolist()


def _least_alike(stays: "list[_Run]", config: MoveConfig) -> float:
    """How alike the two stays are that differ most; 1 where there is but one."""
    return min((_likeness(a, b, config) for a, b in pairwise(stays)), default=UNSEEN)


def thin(masks: Masks, row: int) -> Bool[Tensor, "h w"]:
    """One of the masks, at the resolution of the stays."""
    return torch.from_numpy(thinned(masks, row, STEP).copy())


def _hidden(people: People | None, frame: int) -> Bool[Tensor, "h w"] | None:
    """Pixels of people in a frame, and those beside them; None: there are none."""
    present = [] if people is None else (people.frame == frame).nonzero()[:, 0].tolist()
    if people is None or not present:
        return None
    hidden = torch.stack([thin(people.masks, row) for row in present]).any(0)
    return max_pool2d(hidden[None].float(), 3, 1, 1)[0] > 0


@dataclass(frozen=True)
class _Run:
    """Frames in a row in which an object looks the same."""

    first: int
    last: int
    sure: int
    """The last that shows enough of it."""
    hits: Int[Tensor, "h w"]
    """In how many frames it is seen."""
    times: Int[Tensor, "h w"]
    """In how many it could be seen."""

    @property
    def usual(self) -> Bool[Tensor, "h w"]:
        """What most frames show."""
        return 2 * self.hits > self.times

    def after(self, other: "_Run", sure: bool) -> "_Run":
        """Both as one."""
        last = self.sure if sure else other.sure
        hits, times = self.hits + other.hits, self.times + other.times
        return _Run(other.first, self.last, last, hits, times)


def _stays(
    inputs: MoveInputs,
    rows: list[int],
    hidden: Callable[[int], Bool[Tensor, "h w"] | None],
    config: MoveConfig,
    blocked: Bool[Tensor, "h w"] | None = None,
) -> list[_Run]:
    """The stretches in which an object stands."""
    runs: list[_Run] = []
    for row in rows:  # what is usual grows with each frame
        seen, frame = thin(inputs.furniture.masks, row), int(inputs.furniture.frame[row])
        before = hidden(frame)
        free = torch.ones_like(seen) if before is None else ~before
        free = free if blocked is None else free & ~blocked
        run = _Run(frame, frame, frame, (seen & free).long(), free.long())
        alike = _likeness(run, runs[-1], config) if runs else 0.0
        if alike > config.alike:
            runs[-1] = run.after(runs[-1], alike <= 1)
        else:
            runs.append(run)
    least = config.seconds * (inputs.fps or 1.0)
    stays: list[_Run] = []
    for run in (run for run in runs if run.last - run.first >= least):
        if stays and _likeness(run, stays[-1], config) > config.alike:
            stays[-1] = run.after(stays[-1], True)
        else:
            stays.append(run)
    return stays


def _likeness(a: _Run, b: _Run, config: MoveConfig) -> float:
    """Common pixels of an object in two runs, of those of the smaller; `UNSEEN`: too few are."""
    known = (a.times > 0) & (b.times > 0)
    one, other = a.usual & known, b.usual & known
    fewest = float(torch.minimum(one.sum(), other.sum()))
    if fewest < config.visible * float(torch.maximum(a.usual.sum(), b.usual.sum())):
        return UNSEEN
    return float((one & other).sum()) / max(fewest, 1.0)
