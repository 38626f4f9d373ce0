"""A finished result, read back for another program."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from mover.core.errors import InputError
from mover.core.types import Bodies, Scene
from mover.io.capture.bodies_file import read_bodies
from mover.io.capture.scene_file import read_scene

BodyForm = Literal["auto", "skin", "morph", "none"]
"""How people move: on bones, by exact shapes, not at all; auto: on bones where these are known."""
Up = Literal["y", "z"]
"""y: the world of scene.json; z: that of simulators and of AMASS."""


@dataclass(frozen=True)
class Finished:
    """What `mover run` left in its folder."""

    out: Path
    scene: Scene
    bodies: Bodies | None
    """People in the world of `scene`."""
    given: Bodies | None
    """People as the capture had them, with the parameters of their model."""


@dataclass(frozen=True)
class Exported:
    """What an exporter wrote."""

    files: tuple[Path, ...]
    notes: tuple[str, ...] = field(default=())
    """What the user should know about them."""


def read_finished(out: Path, capture: Path | None = None) -> Finished:
    """Read a result.

    Args:
        out: Folder of the result.
        capture: Folder of the capture; its bodies.npz has the parameters of the bodies where the
            result has none.
    """
    scene = read_scene(out / "scene.json")
    file = out / "bodies.npz"
    bodies = read_bodies(file) if file.is_file() else None
    if bodies is not None and bodies.space != "world":
        raise InputError("bodies.npz: field 'space' has 'camera', expected 'world' in a result")
    given = None if capture is None else read_bodies(capture / "bodies.npz")
    return Finished(out, scene, bodies, given)
