"""What the viewer shows: a finished result read back, or a capture before its first result."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from jaxtyping import Float
from torch import Tensor

from ..readers.bodies_file import read_bodies
from ..readers.scene_file import read_scene
from ..records import InputError
from ..results import initial_bodies
from ..types import Bodies, Capture, Scene
from .layers import Layers, no_layers
from .stored import read_layers


@dataclass(frozen=True)
class Shown:
    """A room as it was given and as it is now."""

    title: str
    result: Scene
    initial: Scene
    bodies: Bodies | None
    """People in the world of `result`."""
    initial_bodies: Bodies | None
    """People in the world of `initial`."""
    image: Float[Tensor, "h w 3"] | None = None
    """The reference image, in [0, 1]."""
    layers: Layers = field(default_factory=no_layers)
    log: Mapping[str, Any] = field(default_factory=lambda: {})
    """What run.json holds."""
    metrics: Mapping[str, Any] = field(default_factory=lambda: {})
    """What metrics.json holds."""

    @property
    def edits_inside(self) -> int:
        """How many edits of the list the result has in it already."""
        return int(self.log.get("edits", 0))


def read_shown(out: Path, capture: Capture | None = None) -> Shown:
    """Read what `mover run` left in its folder.

    Raises:
        InputError: If there is no result, or something in it is wrong.
    """
    result = read_scene(out / "scene.json")
    log = _json(out / "run.json")
    first = out / "initial.json"
    return Shown(
        title=out.resolve().name,
        result=result,
        initial=read_scene(first) if first.is_file() else result,
        bodies=_bodies(out / "bodies.npz"),
        initial_bodies=_bodies(out / "initial_bodies.npz"),
        image=None if capture is None else capture.reference,
        layers=read_layers(out, log, result),
        log=log,
        metrics=_json(out / "metrics.json"),
    )


def shown_before(capture: Capture) -> Shown:
    """A capture that has no result yet."""
    people = None if capture.bodies is None else initial_bodies(capture)
    return Shown(
        capture.name, capture.scene, capture.scene, people, people, image=capture.reference
    )


def source_of(log: Mapping[str, Any]) -> tuple[str, Path] | None:
    """Format and place of the capture that a result was made from; None: it is not there."""
    source = str(log.get("source") or "")
    if not source or not Path(source).exists():
        return None
    return str(log.get("source_format") or "folder"), Path(source)


def _bodies(file: Path) -> Bodies | None:
    return read_bodies(file) if file.is_file() else None


def _json(file: Path) -> dict[str, Any]:
    if not file.is_file():
        return {}
    try:
        tree = json.loads(file.read_text())
    except ValueError as error:
        raise InputError(f"{file.name} has no valid JSON ({error})") from error
    if not isinstance(tree, dict):
        raise InputError(f"{file.name} has a {type(tree).__name__}, expected an object")
    return tree
