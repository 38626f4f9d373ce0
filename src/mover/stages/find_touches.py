"""Which body vertices touch something, in the true gravity frame."""

from dataclasses import dataclass

from jaxtyping import Float
from torch import Tensor

from ..bodies.parts import Parts
from ..bodies.touch import touching
from ..minimize import Observer, silent
from ..records import record
from ..types import Bodies


@dataclass(frozen=True)
class TouchConfig:
    """Where contacts come from."""

    given: bool = True
    """Use the capture's own contacts (POSA, DECO) where it has them; else the geometric prior."""


@record
class FindTouchesInputs:
    """Bodies in the world whose up is true, and what the user knows of their contacts."""

    bodies: Bodies
    parts: Parts
    ground: float
    given: Float[Tensor, "bodies verts"] | None


@record
class Touching:
    """Chance that each vertex touches something."""

    probability: Float[Tensor, "bodies verts"]


def find_touches(
    inputs: FindTouchesInputs, config: TouchConfig, observe: Observer = silent
) -> Touching:
    """Contacts by geometry and motion: seat and thighs, back, hands, soles."""
    del observe
    if config.given and inputs.given is not None:
        return Touching(inputs.given)
    return Touching(touching(inputs.bodies, inputs.parts, inputs.ground))
