"""What a variant is given of a capture: a part of the video, people without contacts, nobody."""

from dataclasses import replace

import torch
from jaxtyping import Bool, Int
from torch import Tensor

from ..bodies.thinned import pose_rows
from ..types import Bodies, Capture, Masks, People
from .variants import Cut, Hears


def withheld(capture: Capture, hears: Hears, cut: Cut | None) -> Capture:
    """The capture as a variant gets it."""
    if capture.bodies is None:
        return capture
    if hears == "nobody":
        return replace(capture, bodies=None, people=None, touch=None)
    if cut is not None:
        capture = shortened(capture, frames_of(capture.bodies, cut))
    if hears == "no contact":
        assert capture.bodies is not None
        return replace(capture, touch=torch.zeros(capture.bodies.verts.shape[:2]))
    return capture


def frames_of(bodies: Bodies, cut: Cut) -> Int[Tensor, " frames"]:
    """The frames of a part of a video, ascending."""
    seen = bodies.frame.unique()
    first, last = int(seen.amin()), int(seen.amax())
    whole = last - first + 1
    if cut.seconds and bodies.fps is not None:
        count = min(whole, round(cut.seconds * bodies.fps))
    elif cut.share:
        count = max(1, round(cut.share * whole))
    else:
        return seen[[round(cut.place * (len(seen) - 1))]]
    begin = first + round(cut.place * (whole - count))
    return torch.arange(begin, begin + count)


def shortened(capture: Capture, frames: Int[Tensor, " frames"]) -> Capture:
    """Only what is known of these frames; the still image stays."""
    bodies, people, touch = capture.bodies, capture.people, capture.touch
    if bodies is not None:
        keep = torch.isin(bodies.frame, frames)
        bodies, touch = rows_of(bodies, keep), None if touch is None else touch[keep]
    if people is not None:
        people = _masks_of(people, torch.isin(people.frame, frames))
    return replace(capture, bodies=bodies, people=people, touch=touch)


def rows_of(bodies: Bodies, keep: Bool[Tensor, " bodies"]) -> Bodies:
    """Some of the bodies, parameters included."""
    rows = keep.nonzero()[:, 0]
    pose = None if bodies.pose is None else pose_rows(bodies.pose, rows)
    joints = None if bodies.joints is None else bodies.joints[rows]
    return replace(
        bodies,
        verts=bodies.verts[rows],
        joints=joints,
        frame=bodies.frame[rows],
        person=bodies.person[rows],
        pose=pose,
    )


def _masks_of(people: People, keep: Bool[Tensor, " rows"]) -> People:
    masks = people.masks
    counts = tuple(c for c, kept in zip(masks.counts, keep.tolist(), strict=True) if kept)
    some = Masks(masks.height, masks.width, counts)
    return People(some, people.frame[keep], people.person[keep], people.heights)
