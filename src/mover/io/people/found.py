"""What the user knows and what a tool found: rows of bodies, with tracks."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import product
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Int
from numpy.typing import NDArray
from torch import Tensor

from mover.core.errors import InputError
from mover.core.types import Camera

UNTRACKED = -1
"""Track of people whom a tool lists image by image."""
PATIENCE = 15  # a person who is gone for so many frames starts a new track
REACH = 0.6  # of a person's size: how far one may move from frame to frame
GROWTH = 0.25  # `REACH` grows by this share with each frame of a gap
AHEAD = 0.5  # of the way at its last speed, where a track leads: people stop and turn


@dataclass(frozen=True)
class Known:
    """What the user knows beyond the files of a tool."""

    camera: Camera | None = None
    """The true lens: bodies are moved so that they keep their pixels under it."""
    focal: float | None = None
    """The focal length that the tool assumed, where its files do not give it [px]."""
    faces: Path | None = None
    """A mesh file with the triangles of the bodies, where their model is not at hand."""
    fps: float | None = None
    """Frames a second."""
    gender: str | None = None
    """neutral, female or male; None: what the files say, else neutral."""
    first: int = 0
    """The number in the name of the first frame's file."""
    frames: Mapping[str, int] | None = None
    """Frames by the names of files or folders; None: by the numbers in them, less `first`."""
    decode: Callable[[Tensor], Tensor] | None = None
    """Angles of the 21 joints from VPoser's codes, where the user has its weights."""
    tracks: Mapping[int, int] = field(default_factory=dict[int, int])
    """New numbers of tracks by old ones; two that become one are one person."""


@dataclass(frozen=True)
class Found:
    """Rows of bodies in the camera axes of their frames; a row is NaN where the tool failed."""

    model: str
    """Whose vertices: smpl, smplh, smplx or mhr."""
    values: Mapping[str, Tensor]
    """One row a body: `frame` and `person`; the parameters of `BodyPose`, or `verts` (vertices, 3)
    [m]; and `K` (3, 3), the lens that the tool assumed [px]."""
    gender: str = "neutral"
    fps: float | None = None
    space: Literal["camera", "world"] = "camera"
    """world: +y up, where the tool knows no camera."""
    warnings: tuple[str, ...] = ()

    def chosen(self, index: Int[Tensor, " rows"]) -> "Found":
        """Some rows."""
        return dataclasses.replace(self, values={k: v[index] for k, v in self.values.items()})


def joined(parts: Sequence[Found]) -> Found:
    """Rows of several people or frames together; shapes are filled up with zeros.

    Raises:
        InputError: If their meshes have different topologies.
    """
    values: dict[str, Tensor] = {}
    for name in parts[0].values:
        each = [part.values[name] for part in parts if name in part.values]
        sizes = sorted({len(value[0].flatten()) for value in each})
        if name == "verts" and len(sizes) > 1:
            found = f"meshes of {' and of '.join(str(n // 3) for n in sizes)} vertices"
            raise InputError(f"the files hold {found}, expected one topology")
        if name == "betas":
            pad = torch.nn.functional.pad
            each = [pad(value, (0, sizes[-1] - value.shape[1])) for value in each]
        if len(each) == len(parts) and (name == "betas" or len(sizes) == 1):
            values[name] = torch.cat(each)
    warnings = tuple(dict.fromkeys(text for part in parts for text in part.warnings))
    return dataclasses.replace(parts[0], values=values, warnings=warnings)


def followed(
    frames: Sequence[int], positions: NDArray[np.float64], sizes: NDArray[np.float64]
) -> NDArray[np.int64]:
    """Tracks of people that each frame lists in any order.

    The pair of a track and a person that is nearest to where the track leads (`AHEAD`) is joined
    first, if the person moved no further than `REACH` of the larger of the two sizes, and a little
    more after a gap. Positions (rows, axes) and sizes (rows,) have one unit, any.
    """
    tracks, order = np.full(len(frames), -1, dtype=np.int64), np.asarray(frames)
    last, speed = dict[int, int](), dict[int, NDArray[np.float64]]()
    for frame in sorted(set(frames)):
        current: list[int] = np.flatnonzero(order == frame).tolist()
        recent = [(t, before) for t, before in last.items() if frame - frames[before] <= PATIENCE]
        options: list[tuple[float, int, int]] = []
        for (track, before), row in product(recent, current):
            gap, size = frame - frames[before], max(sizes[row], sizes[before], 1e-9)
            way = positions[row] - positions[before]
            if np.linalg.norm(way) <= size * REACH * (1 + GROWTH * (gap - 1)):
                off = way - AHEAD * gap * speed.get(track, 0.0)
                options.append((float(np.linalg.norm(off) / size), track, row))
        for _, track, row in sorted(options):
            if tracks[row] < 0 and last[track] not in current:
                before = last[track]
                speed[track] = (positions[row] - positions[before]) / (frame - frames[before])
                tracks[row], last[track] = track, row
        for row in current:
            if tracks[row] < 0:
                tracks[row] = len(last)
                last[len(last)] = row
    return tracks
