"""Rooms from the people who move in them."""

from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from mover.core.errors import InputError as InputError
    from mover.core.run import Run as Run
    from mover.core.types import Camera as Camera
    from mover.core.types import Capture as Capture
    from mover.core.types import Layout as Layout
    from mover.core.types import Room as Room
    from mover.core.types import Scene as Scene
    from mover.extensions import reconstruct as reconstruct
    from mover.io.formats import read as read
    from mover.pipeline.presets import PRESETS as PRESETS
    from mover.pipeline.presets import Config as Config

_HOMES = {
    "PRESETS": "pipeline.presets", "Config": "pipeline.presets", "Run": "core.run",
    "reconstruct": "extensions", "read": "io.formats", "InputError": "core.errors",
    **dict.fromkeys(("Camera", "Capture", "Layout", "Room", "Scene"), "core.types"),
}  # fmt: skip


def __getattr__(name: str) -> Any:  # noqa: ANN401
    """Import a public name when it is first asked for, so that `mover --help` answers at once."""
    from importlib import import_module

    if name not in _HOMES:
        raise AttributeError(f"mover has no {name!r}; it has {sorted(_HOMES)}")
    return getattr(import_module(f".{_HOMES[name]}", __name__), name)
