"""What placing the objects needs, how it is done, and what comes of it."""

from dataclasses import dataclass, field, replace

from jaxtyping import Float
from torch import Tensor

from ..energy import HumanCues, ImageCues, SceneWeights
from ..minimize import Adam
from ..minimize_newton import Quasi
from ..records import record
from ..terms import Form
from ..terms.scale import GROWTH
from ..terms.wall import Walls
from ..types import Camera, Layout, Objects
from .pinned import Pinned


@dataclass(frozen=True)
class PlaceConfig:
    """How the objects are placed."""

    weights: SceneWeights = field(default_factory=SceneWeights)
    form: Form = "paper"
    """How the terms are priced."""
    method: Adam | Quasi = field(default_factory=Adam)
    """The descent from each start that is left."""
    first: Adam = field(default_factory=lambda: Adam(steps=0))
    """A descent of the box term over the places alone, before all others (release)."""
    yaws: int = 1
    """Starts that are turned evenly round each object."""
    distances: tuple[float, ...] = ()
    """Further starts at these shares of its distance, turned as often."""
    short: Adam | Quasi = field(default_factory=lambda: Adam(steps=0))
    """A short descent from each of them."""
    keep: int = 1
    """Starts of each object that are left after the short descents."""
    coarse: int = 1
    """Pixels of a window that are one, along each side, in the short descents."""
    shaken: int = 0
    """Further descents from places around the best one of each object."""
    rounds: int = 1
    """How often that is done; each time around the best so far, and half as far from it."""
    lined: int = 0
    """How often pieces along a wall are placed again with its line (robust)."""
    tie: float = 0.0
    """How much a turn away from the reference yaw worsens a candidate: 1 doubles half a turn."""
    apart: float = 0.0
    """Weight of the space that objects share, in a last descent of all together."""
    span: float = 0.0
    """Release: scales stay within 1 +- span/2 by a sigmoid; 0: free."""
    chair_span: float = 0.0
    """The same for chairs."""
    growth: float = GROWTH
    """Price of another size as a whole, against that of another shape (robust)."""


@record
class PlaceInputs:
    """What placing the objects needs."""

    objects: Objects
    camera: Camera
    ground: float
    image: ImageCues
    humans: HumanCues
    starts: Layout
    """Candidates on a leading axis."""
    reference: Float[Tensor, " objects"]
    """Yaw that breaks ties: of the sitters where there are any, else the initial one [rad]."""
    pinned: Pinned | None = None
    """Objects that stay where they are; None: all may move."""


@record
class Moment:
    """The room in the middle of a descent, for those who watch."""

    layout: Layout
    """All starts."""
    camera: Camera
    ground: float


@record
class Placed:
    """Where the objects ended."""

    layout: Layout
    """The chosen candidate of each object."""
    candidates: Layout
    """All that were left, best first."""
    energy: Float[Tensor, "starts objects"]
    """Of the candidates."""
    trace: Float[Tensor, " steps"]
    """Total energy before each step of the last descent, summed over the candidates."""
    walls: Walls | None = None
    """The lines that were priced; None: none."""


def with_walls(inputs: PlaceInputs, walls: Walls | None) -> PlaceInputs:
    """The inputs with the lines along which furniture stands."""
    return replace(inputs, image=replace(inputs.image, walls=walls))
