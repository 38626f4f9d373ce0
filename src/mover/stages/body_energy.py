"""What the image, time and the room say about where people are (Sec. "HPS estimation")."""

from dataclasses import dataclass, replace
from typing import TypeVar

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from ..bodies.corrected import Correction, Moved, Puppet, moved
from ..geometry.camera import to_camera
from ..geometry.volume import Volume
from ..minimize import Energy, weigh
from ..terms.body_contact import Matches, touch_term
from ..terms.body_order import Bounds, order_term
from ..terms.body_outline import Outline, outline_term
from ..terms.body_room import sink_term, stand_term, under_term
from ..terms.body_start import angle_term, depth_share, image_term, range_term
from ..terms.body_time import Neighbours, lock_term, smooth_term, steady_term
from ..types import Camera

E = TypeVar("E")


@dataclass(frozen=True)
class BodyWeights:
    """How much each term counts; 0: it is left out. All are in nats, so 1 is the natural weight."""

    angles: float = 1.0
    """Distance of all angles from those that were given."""
    image: float = 1.0
    """Distance of the joints from where they were seen."""
    range: float = 1.0
    """Change of the depth."""
    smooth: float = 1.0
    """E_smooth: joints between their neighbours in time."""
    steady: float = 0.5
    """Corrections that come and go."""
    under: float = 1.0
    """CamGP: skin below the floor."""
    stand: float = 1.0
    """CamGP: soles at rest off the floor."""
    lock: float = 1.0
    """CamGP: soles at rest that slide."""
    sink: float = 1.0
    """SDF: skin inside furniture."""
    touch: float = 1.0
    """Contact: skin that touches, off the furniture."""
    order: float = 0.3
    """Depth order: skin before what hides it, or behind what it hides."""
    outline: float = 1.0
    """Masks: the outline of the body on the outline of its mask."""


@dataclass(frozen=True)
class Feet:
    """The soles among the picked vertices."""

    members: Bool[Tensor, "feet picked"]
    rest: Float[Tensor, "bodies feet"]
    """Chance that each is at rest and carries the body."""


@dataclass(frozen=True)
class Evidence:
    """What is known about some rows of the bodies."""

    camera: Camera
    ground: float
    furniture: Volume | None
    near: Neighbours
    feet: Feet
    matches: Matches | None
    bounds: Bounds | None
    rho: float
    """Of the contact [m]."""
    even: Bool[Tensor, " picked"]
    """Points of the skin that lie evenly over the body."""
    outline: Outline | None = None


def body_energy(by: Correction, puppet: Puppet, known: Evidence, weights: BodyWeights) -> Energy:
    """The price of a correction, one value for each body."""
    w, now, R = _heard(weights, known), moved(puppet, by), known.camera.R_cam_world
    place, start = to_camera(now.points, R), to_camera(puppet.points, R)
    share = depth_share(place[:, 0], start[:, 0])
    angles = torch.cat([by.turn, by.angles], -1)
    middle, low = _soles(now, known.feet)
    even = now.skin[:, known.even]
    return weigh(
        ("angles", w.angles, lambda: angle_term(angles)),
        ("image", w.image, lambda: image_term(place, start)),
        ("range", w.range, lambda: range_term(share, known.near.track)),
        ("smooth", w.smooth, lambda: smooth_term(now.points, known.near)),
        ("steady", w.steady, lambda: steady_term(angles, share, known.near)),
        ("under", w.under, lambda: under_term(even, known.ground)),
        ("stand", w.stand, lambda: stand_term(low, known.feet.rest, known.ground)),
        ("lock", w.lock, lambda: lock_term(middle, known.feet.rest, known.near)),
        ("sink", w.sink, lambda: sink_term(even, _known(known.furniture))),
        ("touch", w.touch, lambda: touch_term(now.skin, _known(known.matches), known.rho)),
        ("order", w.order, lambda: order_term(
            to_camera(even, R)[..., 2], _known(known.bounds))),
        ("outline", w.outline, lambda: outline_term(
            to_camera(now.skin, R), _known(known.outline), known.camera.K, known.camera.width)),
    )  # fmt: skip


def _heard(weights: BodyWeights, known: Evidence) -> BodyWeights:
    """The weights without those whose evidence is missing."""
    missing: dict[str, float] = {}
    if known.furniture is None:
        missing["sink"] = 0.0
    if known.matches is None or not len(known.matches.body):
        missing["touch"] = 0.0
    if known.bounds is None:
        missing["order"] = 0.0
    if known.outline is None or not len(known.outline.body):
        missing["outline"] = 0.0
    if not known.feet.members.any():
        missing |= {"stand": 0.0, "lock": 0.0}
    return replace(weights, **missing)


def _soles(now: Moved, feet: Feet) -> tuple[Tensor, Tensor]:
    """Middle of each sole, and its middle again at the height of its lower half [m]."""
    middles: list[Tensor] = []
    lows: list[Tensor] = []
    for own in feet.members:  # two feet
        sole = now.skin[:, own]
        middle = sole.mean(1) if sole.shape[1] else now.points[:, 0]
        heights = sole[..., 1].sort(1).values[:, : max(1, (sole.shape[1] + 1) // 2)]
        low = heights.mean(1) if sole.shape[1] else middle[:, 1]
        middles.append(middle)
        lows.append(torch.stack([middle[:, 0], low, middle[:, 2]], -1))
    return torch.stack(middles, 1), torch.stack(lows, 1)


def _known(evidence: E | None) -> E:
    """Evidence whose weight is not zero (see `_heard`)."""
    assert evidence is not None
    return evidence
