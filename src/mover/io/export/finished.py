"""A finished result, read back for another program."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from mover.core.errors import InputError
from mover.core.types import Bodies, Scene
from mover.io.capture.bodies_file import read_bodies
from mover.io.capture.scene_file import read_scene
from mover.io.export.shell import WALLS, Wall, guess_walls, walls_in
from mover.io.files.fields import maybe, read_json

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
    walls: tuple[Wall, ...] | None = None
    """The guess that the scene's pieces were nudged along; None: none was made."""

    def shell(self) -> tuple[Wall, ...]:
        """The walls, guessed where they were not."""
        return guess_walls(self.scene, self.bodies) if self.walls is None else self.walls


@dataclass(frozen=True)
class Exported:
    """What an exporter wrote."""

    files: tuple[Path, ...]
    notes: tuple[str, ...] = field(default=())
    """What the user should know about them."""


STABLE = "stable.json"
"""The result's scene with pieces nudged to where they stand, from `mover simulate --nudge`."""


def read_finished(out: Path, capture: Path | None = None, stable: bool = False) -> Finished:
    """Read a result.

    Args:
        out: Folder of the result.
        capture: Folder of the capture; its bodies.npz tells the parameters of the bodies where the
            result has none.
        stable: Whether the scene is that of `STABLE`.
    """
    if stable and not (out / STABLE).is_file():
        raise InputError(f"{out / STABLE}: not found; `mover simulate OUT --nudge` writes it")
    scene = read_scene(out / (STABLE if stable else "scene.json"))
    file = out / "bodies.npz"
    bodies = read_bodies(file) if file.is_file() else None
    if bodies is not None and bodies.space != "world":
        raise InputError("bodies.npz: field 'space' has 'camera', expected 'world' in a result")
    given = None if capture is None else read_bodies(capture / "bodies.npz")
    along = maybe(read_json(out / STABLE), WALLS) if stable else None
    return Finished(out, scene, bodies, given, None if along is None else walls_in(along))
