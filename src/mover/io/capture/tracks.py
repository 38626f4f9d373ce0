"""Which numbers are one person: of bodies and masks, of pieces of a track, of two files."""

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from mover.core.types import Bodies, Camera, Masks, People
from mover.geometry.camera import NEAR, project

OVERLAP = 0.5  # of a body and a mask of one person, mean of share and union
CLEAR = 0.3  # by so much the next best pair is worse where there is no uncertainty
TOGETHER = 0.2  # share of the shorter track's frames in which both are seen
POINTS = 1000  # vertices of a body that give its box

Track = tuple[str, int]
"""`bodies` or `masks`, and its number."""


@dataclass(frozen=True)
class Pairs:
    """One number for each person: the new number by the old one, and what changed in words."""

    bodies: Mapping[int, int]
    masks: Mapping[int, int]
    notes: tuple[str, ...] = ()


def pair_tracks(bodies: Bodies, people: People, camera: Camera) -> Pairs:
    """Pair tracks of bodies and of masks by their positions in the image.

    A body and a mask are paired where their boxes overlap in the frames that they share, and no
    other mask or body of these frames fits nearly as well. A person in pieces, on either side,
    becomes one. Numbers that agree with the positions, and what is uncertain, stay.

    Args:
        bodies: In the camera frame of their frames.
        people: Visible masks.
        camera: Whose lens sees both.

    Returns:
        The numbers of the bodies count; those of a mask without a body may change to a free one.
    """
    ours, theirs = _body_boxes(bodies, camera), _mask_boxes(people.masks)
    scores, margins = defaultdict[Any, list[float]](list), defaultdict[Any, list[float]](list)
    for frame in sorted({*bodies.frame.tolist()} & {*people.frame.tolist()}):
        a, b = ((one.frame == frame).nonzero()[:, 0].numpy() for one in (bodies, people))
        fit = _overlaps(ours[a], theirs[b])
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


def _numbered(groups: Mapping[Track, set[Track]], bodies: Bodies, people: People) -> Pairs:
    """Numbers of the groups in which no person is twice in a frame."""
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
    return Pairs(found["bodies"], found["masks"], tuple(notes))


def paired(bodies: Bodies, people: People, pairs: Pairs) -> tuple[Bodies, People]:
    """Bodies and masks under the numbers of `pair_tracks`."""
    heights = {str(pairs.masks.get(int(k), int(k))): v for k, v in people.heights.items()}
    return replace(bodies, person=renumbered(bodies.person, pairs.bodies)), replace(
        people, person=renumbered(people.person, pairs.masks), heights=heights
    )


def renumbered(person: torch.Tensor, numbers: Mapping[int, int]) -> torch.Tensor:
    """Tracks under their new numbers; those without one stay."""
    return torch.tensor([numbers.get(one, one) for one in person.tolist()], dtype=person.dtype)


def _body_boxes(bodies: Bodies, camera: Camera) -> NDArray[np.float64]:
    """Boxes around the bodies in the image; empty for one outside or behind the camera [px]."""
    verts = bodies.verts[:, :: max(1, bodies.verts.shape[1] // POINTS)]
    pixels = project(verts, camera.K) * (verts[..., 2:] > NEAR).all(1, keepdim=True)
    size = torch.tensor([camera.width, camera.height]).to(pixels)
    low, high = pixels.amin(1).clamp_min(0), torch.minimum(pixels.amax(1), size)
    return torch.cat([low, torch.maximum(low, high)], 1).double().numpy()


def _mask_boxes(masks: Masks) -> NDArray[np.float64]:
    """Boxes around the pixels of masks [px]."""
    from pycocotools import mask as coco

    size = [masks.height, masks.width]
    codes: Any = [{"size": size, "counts": code} for code in masks.counts]
    boxes = np.asarray(coco.toBbox(codes), dtype=np.float64)
    return np.concatenate([boxes[:, :2], boxes[:, :2] + boxes[:, 2:]], 1)


def _overlaps(ours: NDArray[np.float64], theirs: NDArray[np.float64]) -> NDArray[np.float64]:
    """How well each body fits each mask: the share of the mask's box inside, and the union."""
    low = np.maximum(ours[:, None, :2], theirs[None, :, :2])
    high = np.minimum(ours[:, None, 2:], theirs[None, :, 2:])
    common = np.prod(np.clip(high - low, 0, None), axis=2)
    a, b = (np.prod(box[:, 2:] - box[:, :2], axis=1) for box in (ours, theirs))
    inside = common / np.maximum(b, 1e-9)
    return (inside + common / np.maximum(a[:, None] + b - common, 1e-9)) / 2
