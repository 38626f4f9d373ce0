"""Results for other programs: what can be written, by name."""

from collections.abc import Callable, Mapping
from pathlib import Path

from .amass import export_bodies
from .finished import Exported, Finished, read_finished
from .glb import export_glb
from .mjcf import export_mjcf
from .objects import export_objects
from .urdf import export_urdf
from .usd import export_usd

__all__ = [
    "EXPORTERS", "Exported", "Finished", "export_bodies", "export_glb", "export_mjcf",
    "export_objects", "export_urdf", "export_usd", "read_finished",
]  # fmt: skip

EXPORTERS: Mapping[str, Callable[[Finished, Path], Exported]] = {
    "glb": export_glb,
    "usd": export_usd,
    "mjcf": export_mjcf,
    "urdf": export_urdf,
    "ply": export_objects,
    "bodies": export_bodies,
}
"""How to write a result into a folder, by format."""
