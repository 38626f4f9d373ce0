"""A finished result, read back for another program, and its people one after the other."""

from bisect import bisect
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mover.core.errors import InputError
from mover.core.records import record
from mover.core.types import Bodies, Scene, rows_by_person
from mover.io.capture.bodies_file import read_bodies
from mover.io.capture.scene_file import read_scene

BodyForm = Literal["auto", "skin", "morph", "none"]
"""How people move: on bones, by exact shapes, not at all; auto: on bones where these are known."""
Up = Literal["y", "z"]
"""y: the world of scene.json; z: that of simulators and of AMASS."""
FPS = 5.0  # of images that have no time: so many a second
GAP = 1.0  # [s]; a person who is not visible for longer is hidden meanwhile
WATCHED = 300  # vertices of a moving mesh that are compared, evenly chosen


@dataclass(frozen=True)
class Finished:
    """What `mover run` left in its folder."""

    out: Path
    scene: Scene
    bodies: Bodies | None
    """People in the world of `scene`."""
    given: Bodies | None
    """People as the capture had them, with the parameters of their model."""

    @property
    def clock(self) -> tuple[int, float]:
        """`clock_of` the people."""
        return clock_of(self.bodies)


@dataclass(frozen=True)
class Exported:
    """What an exporter wrote."""

    files: tuple[Path, ...]
    notes: tuple[str, ...] = ()
    """What the user should know about them."""


def read_finished(out: Path, capture: Path | None = None) -> Finished:
    """A result, and the bodies of its capture, which have parameters where the result has none."""
    scene = read_scene(out / "scene.json")
    file = out / "bodies.npz"
    bodies = read_bodies(file) if file.is_file() else None
    if bodies is not None and bodies.space != "world":
        raise InputError("bodies.npz: field 'space' has 'camera', expected 'world' in a result")
    given = None if capture is None else read_bodies(capture / "bodies.npz")
    return Finished(out, scene, bodies, given)


@record
class Track:
    """One person."""

    person: int
    rows: Int[Tensor, " rows"]
    """Rows of the bodies, by frame."""
    frame: Int[Tensor, " rows"]
    time: Float[Tensor, " rows"]
    """Since the first frame of the file [s]."""
    last: float
    """Time of the last frame of the file [s]."""

    def spans(self) -> list[tuple[float, float]]:
        """Spans of time in which the person is visible [s]."""
        gaps = (self.time.diff() > GAP).nonzero()[:, 0] + 1
        pieces = self.time.tensor_split(gaps)
        return [(float(piece[0]), float(piece[-1])) for piece in pieces]


def clock_of(bodies: Bodies | None) -> tuple[int, float]:
    """The first frame of the file, which is at 0 s, and the frames a second."""
    if bodies is None or not len(bodies.frame):
        return 0, FPS
    return int(bodies.frame.min()), bodies.fps or FPS


def tracks_of(bodies: Bodies) -> list[Track]:
    """All people, by the number of their track."""
    first, fps = clock_of(bodies)
    last = (int(bodies.frame.max()) - first) / fps
    found: list[Track] = []
    for rows in rows_by_person(bodies.frame, bodies.person):
        person, frame = int(bodies.person[rows[0]]), bodies.frame[rows]
        found.append(Track(person, rows, frame, (frame - first).double() / fps, last))
    return found


def keyframes(
    verts: Float[Tensor, "frames verts 3"],
    time: Float[Tensor, " frames"],
    tolerance: float,
    most: int,
) -> tuple[list[int], float]:
    """Key frames between which a mesh moves in nearly straight lines, and the largest miss [m].

    The frame that the lines miss most becomes a key frame, until none is missed by more than
    `tolerance` [m] or there are `most`; the first and the last frame are among them.
    """
    watched = verts[:, :: max(1, verts.shape[1] // WATCHED)].double()
    time, miss = time.double(), torch.zeros(len(verts), dtype=torch.float64)
    keys = sorted({0, len(verts) - 1})

    def measure(first: int, last: int) -> None:
        inner = slice(first + 1, last)
        share = ((time[inner] - time[first]) / (time[last] - time[first]))[:, None, None]
        line = watched[first] + share * (watched[last] - watched[first])
        miss[inner] = (line - watched[inner]).norm(dim=-1).amax(-1)

    measure(0, len(verts) - 1)
    while float(miss.max()) > tolerance and len(keys) < most:
        worst = int(miss.argmax())
        at = bisect(keys, worst)
        keys.insert(at, worst)
        miss[worst] = 0
        measure(keys[at - 1], worst)
        measure(worst, keys[at + 1])
    return keys, float(miss.max())
