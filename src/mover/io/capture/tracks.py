"""Which numbers are one person: of bodies and masks, of pieces of a track, of two files."""

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor

from mover.core.types import Bodies, Camera, People
from mover.geometry.camera import NEAR
from mover.geometry.rle import mask_boxes
from mover.io.capture.agreement import box_around, in_image, pairwise_iou2d

OVERLAP = 0.5  # of a body and a mask of one person, mean of share and union
CLEAR = 0.3  # by so much the next best pair is worse where there is no uncertainty
TOGETHER = 0.2  # share of the shorter track's frames in which both are seen
POINTS = 1000  # vertices of a body that give its box
PATIENCE = 15  # frames that a person may be lost for
FEW = 5  # rows that show the motion at the end of a track
REACH, DRIFT = 0.25, 0.02  # [m], and a frame: so far from where the motion leads
DEPTH = 0.1  # the same along the view, as a share of the distance
SHAPES = 2.0  # difference of the shapes of two people
TALL = 1.7  # [m], a person's size
ONE_PLACE = 0.35  # of a person's size: so near are two estimates of one person
LEAST_WAY, WALK = 1.0, 0.07  # [m], and a frame: so far one can have walked unseen

Track = tuple[str, int]
"""`bodies` or `masks`, and its number."""


def pair_tracks(
    bodies: Bodies, people: People, camera: Camera
) -> tuple[Bodies, People, tuple[str, ...]]:
    """One number for each person: tracks of bodies and of masks paired by their positions.

    A body and a mask are paired where their boxes overlap in the frames that they share, and no
    other mask or body of these frames fits nearly as well. A person in pieces, on either side,
    becomes one. Numbers that agree with the positions, and what is uncertain, stay.

    Args:
        bodies: In the camera frame of their frames.
        people: Visible masks.
        camera: Whose lens sees both.

    Returns:
        Both under their new numbers, and what changed in words. The numbers of the bodies count;
        those of a mask without a body may change to a free one. Heights count masks, then bodies.
    """
    verts = bodies.verts[:, :: max(1, bodies.verts.shape[1] // POINTS)]
    seen = (verts[..., 2] > NEAR).all(1, keepdim=True)  # without area: beside or behind the camera
    ours = in_image(box_around(verts, camera), camera).where(seen, torch.zeros(()))
    theirs = mask_boxes(people.masks).double()
    scores, margins = defaultdict[Any, list[float]](list), defaultdict[Any, list[float]](list)
    for frame in sorted({*bodies.frame.tolist()} & {*people.frame.tolist()}):
        a, b = ((one.frame == frame).nonzero()[:, 0] for one in (bodies, people))
        shared = pairwise_iou2d(ours[a].double(), theirs[b])
        areas = [(x[:, 2:] - x[:, :2]).prod(-1) for x in (ours[a].double(), theirs[b])]
        inside = shared * (areas[0][:, None] + areas[1]) / (1 + shared)
        fit = ((inside / areas[1].clamp_min(1e-9) + shared) / 2).numpy()  # share of mask, and union
        for i, j in np.ndindex(fit.shape):
            rival = max([0.0, *np.delete(fit[i], j), *np.delete(fit[:, j], i)])
            pair = int(bodies.person[a[i]]), int(people.person[b[j]])
            scores[pair].append(float(fit[i, j]))
            margins[pair].append(float(fit[i, j]) - rival)
    groups: dict[Track, set[Track]] = {}
    for (body, mask), found in scores.items():
        shorter = min(int((bodies.person == body).sum()), int((people.person == mask).sum()))
        sure = np.mean(found) >= OVERLAP and np.mean(margins[body, mask]) >= CLEAR
        if sure and len(found) >= TOGETHER * shorter:
            both: tuple[Track, Track] = (("bodies", body), ("masks", mask))
            one = {*both}.union(*(groups.get(track, set()) for track in both))
            groups |= dict.fromkeys(one, one)
    return _numbered(groups, bodies, people)


def _numbered(
    groups: Mapping[Track, set[Track]], bodies: Bodies, people: People
) -> tuple[Bodies, People, tuple[str, ...]]:
    """One number for each of the groups in which no person is twice in a frame."""
    sides: Mapping[str, Bodies | People] = {"bodies": bodies, "masks": people}
    found: dict[str, dict[int, int]] = {"bodies": {}, "masks": {}}
    for group in {id(group): group for group in groups.values()}.values():
        number = min(person for side, person in group if side == "bodies")
        members = {name: [person for side, person in group if side == name] for name in sides}
        frames = [one.frame[torch.isin(one.person, torch.tensor(members[name]))]
                  for name, one in sides.items()]  # fmt: skip
        if all(len(one) == len(one.unique()) for one in frames):
            for name in sides:
                found[name] |= dict.fromkeys(members[name], number)
    masks, notes = {*people.person.tolist()}, list[str]()
    free = 1 + max(*masks, *bodies.person.tolist())
    taken = sorted(masks & {*found["bodies"].values()} - {*found["masks"]})
    found["masks"] |= {mask: free + k for k, mask in enumerate(taken)}  # they are of others
    for name, file in (("bodies", "bodies.npz"), ("masks", "people.json")):
        found[name] = {old: new for old, new in sorted(found[name].items()) if old != new}
        if found[name]:
            same = ", ".join(f"track {old} is {new}" for old, new in found[name].items())
            notes.append(f"{file}: by its position in the image {same}")
    numbers = {**found["bodies"], **{mask: mask for mask in masks}, **found["masks"]}
    heights = {str(numbers.get(int(k), int(k))): v for k, v in people.heights.items()}
    person = renumbered(people.person, found["masks"])
    people = replace(people, person=person, heights=heights)
    bodies = replace(bodies, person=renumbered(bodies.person, found["bodies"]))
    return bodies, people, tuple(notes)


def renumbered(person: Int[Tensor, " rows"], numbers: Mapping[int, int]) -> Int[Tensor, " rows"]:
    """Tracks under their new numbers; those without one stay."""
    return torch.tensor([numbers.get(one, one) for one in person.tolist()], dtype=person.dtype)


# Pieces of one person's track, as trackers leave them behind a pillar or at the image's border.


@dataclass(frozen=True)
class _End:
    """Where a track begins or ends, and how it moves there [m, m a frame]."""

    frame: int
    place: NDArray[np.float64]
    speed: NDArray[np.float64]
    shape: NDArray[np.float64]


def join_pieces(
    frame: Int[Tensor, " rows"],
    person: Int[Tensor, " rows"],
    place: Float[Tensor, "rows 3"],
    betas: Float[Tensor, "rows shape"] | None = None,
) -> tuple[dict[int, int], list[str]]:
    """Join tracks that continue another after a few frames, where both motions lead there.

    Two people cannot change places within `PATIENCE` frames. A track with two that could continue
    it is not joined; it is named, as are those which one person could have walked between.

    Args:
        frame: Frames of the rows.
        person: Their tracks.
        place: Positions in the camera frame [m].
        betas: Shapes, where the tool estimates them.

    Returns:
        New numbers of tracks that continue others, and what is said of them.
    """
    shapes = torch.zeros(len(frame), 1) if betas is None else betas
    rows = torch.cat([place.double(), shapes.double()], 1).numpy()
    begins, ends = dict[int, _End](), dict[int, _End]()
    for one in person.unique().tolist():
        own = (person == one).nonzero()[:, 0]
        own = own[frame[own].argsort()]
        for found, part in ((begins, own[:FEW]), (ends, own[-FEW:].flip(0))):
            when, there = frame[part].numpy(), rows[part.numpy()]
            span = when[-1] - when[0]
            speed = (there[-1, :3] - there[0, :3]) / span if span else np.zeros(3)
            found[one] = _End(int(when[0]), there[0, :3], speed, there[:, 3:].mean(0))
    after = {a: [b for b in begins if _continues(ends[a], begins[b])] for a in ends}
    follows: dict[int, int] = {}
    for a, options in after.items():
        near = min(options, key=lambda b: begins[b].frame, default=None)
        if near is None or any(begins[b].frame <= ends[near].frame for b in options if b != near):
            continue
        others = [c for c, theirs in after.items() if near in theirs and c != a]
        if not any(ends[c].frame >= begins[a].frame for c in others):
            follows[near] = a
    numbers: dict[int, int] = {}
    for b in sorted(follows, key=lambda b: begins[b].frame):
        numbers[b] = numbers.get(follows[b], follows[b])
    notes: list[str] = []
    for first in dict.fromkeys(numbers.values()):
        chain = ", ".join(map(str, [first, *(b for b in numbers if numbers[b] == first)]))
        notes.append(f"tracks {chain} follow one another in time and position: one person, {first}")
    return numbers, notes + _possible(begins, ends, follows)


def _continues(end: _End, begin: _End) -> bool:
    """Whether a track can be the other's continuation, by where the motions of both lead."""
    gap = begin.frame - end.frame
    if not 0 < gap <= PATIENCE or np.linalg.norm(begin.shape - end.shape) > SHAPES:
        return False
    reach = REACH + DRIFT * gap
    for one, other, time in ((end, begin, gap), (begin, end, -gap)):
        led = one.place + one.speed * time
        off = np.abs(led[:2] - other.place[:2] * led[2] / other.place[2])
        deep = abs(led[2] - other.place[2]) - DEPTH * abs(led[2])  # depths are uncertain
        if max(float(np.linalg.norm(off)), deep) > reach:
            return False
    return True


def _possible(
    begins: Mapping[int, _End], ends: Mapping[int, _End], joined: Mapping[int, int]
) -> list[str]:
    """Tracks that one person could have walked between, each with the nearest in time."""
    found: list[str] = []
    cure = ""
    for b in sorted(set(begins) - set(joined), key=lambda b: begins[b].frame):
        gaps = {a: begins[b].frame - ends[a].frame for a in set(ends) - set(joined.values())}
        near = {a: gap for a, gap in gaps.items() if gap > 0 and LEAST_WAY + WALK * gap
                >= np.linalg.norm(begins[b].place - ends[a].place)}  # fmt: skip
        if near:
            a = min(near, key=near.__getitem__)
            found.append(f"{a} and {b} (frames {ends[a].frame} and {begins[b].frame})")
            cure = cure or f"--tracks {b}={a} would make the first two one"
    more = f" and {len(found) - 6} more pairs" if len(found) > 6 else ""
    return [f"tracks {', '.join(found[:6])}{more} may be one person; {cure}"] if found else []


# Two files of bodies: people who are in both, and people who are new.


def numbers_beside(old: Bodies, new: Bodies) -> tuple[dict[int, int], set[int]]:
    """Numbers of the tracks of a second file beside those of a first.

    One who is at the same positions in shared frames, or continues a track, has its number; another
    person with a number that is taken gets a free one.

    Returns:
        New numbers by old ones, and those that were in the first file in the same frames.
    """
    middles = [one.verts.mean(1) for one in (old, new)]
    before, seen = (seen_at(middle, old.space) for middle in middles)
    taken, given = ({*one.person.tolist()} for one in (old, new))
    free = unused = 1 + max(taken | given)
    frame, person = torch.cat([old.frame, new.frame]), torch.cat([old.person, new.person + free])
    later, _ = join_pieces(frame, person, torch.cat(middles))
    numbers, same = dict[int, int](), set[int]()
    for track in sorted(given):
        offs: dict[int, float] = {}
        own = (new.person == track).nonzero()[:, 0]
        for other in taken:
            theirs = (old.person == other).nonzero()[:, 0]
            i, j = (new.frame[own][:, None] == old.frame[theirs]).nonzero().T
            a, b = seen[own[i]], before[theirs[j]]
            if len(a):
                offs[other] = float(((a - b)[:, :-1].norm(dim=1) / b[:, -1]).median())
        near = min(offs, key=offs.__getitem__, default=None)
        if near is not None and offs[near] <= ONE_PLACE:
            numbers[track] = near
            same.add(near)
        elif (first := later.get(track + free)) is not None and first in taken - set(offs):
            numbers[track] = first
        elif track in taken:
            numbers[track] = unused
            unused += 1
    return numbers, same


def seen_at(place: Float[Tensor, "rows 3"], space: str = "camera") -> Float[Tensor, "rows axes"]:
    """Where people are, in the image where a camera sees them, and last a person's size there."""
    place = place.double()
    if space == "world":
        return torch.cat([place, torch.full_like(place[:, :1], TALL)], 1)
    depth = place[:, 2:].clamp_min(NEAR)
    return torch.cat([place[:, :2] / depth, TALL / depth], 1)
