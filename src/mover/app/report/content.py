"""What a report is made from."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from jaxtyping import Float
from torch import Tensor

from mover import __version__
from mover.core.explanation import Explanation
from mover.core.types import Bodies, Scene


@dataclass(frozen=True)
class ReportContent:
    """Everything that a report can show; what is missing is left out of the page."""

    title: str
    image: Float[Tensor, "h w 3"] | None
    """The reference image, in [0, 1]."""
    initial: Scene
    result: Scene
    truth: Scene | None = None
    initial_bodies: Bodies | None = None
    """People in the world of `initial`."""
    bodies: Bodies | None = None
    """People in the world of `result`."""
    traces: Mapping[str, Sequence[float]] = field(default_factory=lambda: {})
    """Total energy before each step, by stage."""
    metrics: Mapping[str, Any] | None = None
    """What metrics.json holds."""
    warnings: tuple[str, ...] = ()
    stages: Sequence[Mapping[str, Any]] = ()
    """`name`, `seconds`, `memory` or `peak_memory` [MB] and `kept` of each stage."""
    config: Mapping[str, Any] = field(default_factory=lambda: {})
    objects: Sequence[Mapping[str, Any]] = ()
    """Rows of the table of objects, found by `id`; other keys become columns."""
    explanations: Sequence[Explanation] = ()
    """Why each object of `result` stands where it stands, in their order."""
    command: str = ""
    """What the user typed."""
    version: str = __version__

    @property
    def peopled(self) -> bool:
        """Whether there is anybody to show."""
        return any(b is not None and len(b.verts) > 0 for b in (self.initial_bodies, self.bodies))
