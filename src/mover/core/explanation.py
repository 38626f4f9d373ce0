"""What held each object of a result, how hard, and how well its place is known: the records.

Unknowns of an object, in their order: x, y, z of the middle of its base in the world [m], its yaw
[rad], and the logarithms of its three scales (`UNKNOWNS`).
"""

from typing import Literal

from jaxtyping import Float
from torch import Tensor

from mover.core.records import record

UNKNOWNS = ("x", "y", "z", "yaw", "width", "height", "depth")


@record
class Pull:
    """What one term of Eq. 1 does to an object at its place."""

    term: str
    energy: float
    """Its weighted price."""
    share: float
    """Of the object's whole energy."""
    force: Float[Tensor, "7"]
    """Minus the gradient [1/m], [1/rad], [1]."""
    move: Float[Tensor, "7"]
    """Where the object would go without this term, to second order [m, rad, 1]."""
    constrains: float
    """Share of this term in what keeps the object from moving along its viewing ray."""


@record
class Bound:
    """The tightest bound of an object's depth, and who set it."""

    side: Literal["near", "far"]
    """Near: a person passed in front of it. Far: it hid a person."""
    depth: float
    """The bound [m], from the camera along its axis."""
    slack: float
    """How far the object's surface there is from it on the allowed side; negative: beyond [m]."""
    frame: int
    """-1: no body was found that gives this bound."""
    person: int
    pixels: int
    """Pixels of its window in which the bound is as tight, up to 5 cm."""


@record
class Passing:
    """The body that came nearest to an object."""

    distance: float
    """Between the skin and the object's surface [m]; negative: inside."""
    frame: int
    """-1: nobody came within reach of the volume of free space, which is `distance`."""
    person: int
    side: str
    """`front`, `back`, `left`, `right`, `top` or `bottom` of the object, as itself sees them."""


@record
class TouchingBody:
    """A person who touches an object for some time."""

    part: str
    """`seat`, `top` or `back`."""
    hand: bool
    person: int
    frames: tuple[tuple[int, int], ...]
    """First and last frame of each time."""
    bodies: int
    gap: float
    """Mean distance of the touching skin of all people from that part [m]."""


@record
class Alternative:
    """Another place that the evidence allows nearly as well."""

    rise: float
    """How much higher it ranks, in units of the object's heat (`explain.spread`)."""
    place: Float[Tensor, "7"]


@record
class Facts:
    """All that is known of why an object stands where it stands."""

    id: str
    energy: float
    place: Float[Tensor, "7"]
    covariance: Float[Tensor, "7 7"]
    """Before calibration, if the camera is right; zero for what its support or the user decides."""
    tilt: Float[Tensor, "7 7"]
    """What the doubt about pitch, roll and floor adds, before calibration."""
    whole: Float[Tensor, "7 7"]
    """What the doubt about the scale of the room and about its lens adds; it counts as it is."""
    pulls: tuple[Pull, ...]
    """In the order of Eq. 1."""
    alternatives: tuple[Alternative, ...]
    bounds: tuple[Bound, ...]
    passing: Passing | None
    """None: there is no volume of free space."""
    touches: tuple[TouchingBody, ...]
    overlap: float | None
    """IoU of silhouette and mask where both can be seen; None: no mask."""
    hidden_sides: tuple[str, ...]
    """Sides of its box in the image that are not seen."""
    support: str
    """`ground`, `free`, or the id of the object that carries it."""
    pinned: bool


@record
class Range:
    """Where a number lies with 90 % probability."""

    name: str
    low: float
    high: float
    spread: float
    """Standard deviation about the result, without alternatives."""


@record
class Other:
    """A surviving alternative, with its calibrated probability."""

    probability: float
    place: Float[Tensor, "7"]


@record
class Explanation:
    """Why an object stands where it stands, and how well that is known."""

    facts: Facts
    ranges: tuple[Range, ...]
    covariance: Float[Tensor, "7 7"]
    """Calibrated."""
    others: tuple[Other, ...]
    verdict: str
    """How certain its place is, and what tells it."""
    sentences: tuple[str, ...]
    """Its evidence, each piece in a sentence."""
    calibrated: bool
    """False: no rooms with known truth were rebuilt with these settings."""
