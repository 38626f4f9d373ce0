"""Rooms from the people who move in them."""

from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from .pipeline import PRESETS as PRESETS
    from .pipeline import Config as Config
    from .pipeline import Run as Run
    from .pipeline import reconstruct as reconstruct
    from .readers import read as read
    from .records import InputError as InputError
    from .types import Camera as Camera
    from .types import Capture as Capture
    from .types import Layout as Layout
    from .types import Room as Room
    from .types import Scene as Scene

_HOMES = {
    "PRESETS": "pipeline", "Config": "pipeline", "Run": "pipeline", "reconstruct": "pipeline",
    "read": "readers", "InputError": "records", "Camera": "types", "Capture": "types",
    "Layout": "types", "Room": "types", "Scene": "types",
}  # fmt: skip


def __getattr__(name: str) -> Any:  # noqa: ANN401
    """Import a public name when it is first asked for, so that `mover --help` answers at once."""
    from importlib import import_module

    if name not in _HOMES:
        raise AttributeError(f"mover has no {name!r}; it has {sorted(_HOMES)}")
    return getattr(import_module(f".{_HOMES[name]}", __name__), name)
