"""What the user knows and what a tool found: rows of bodies, with tracks."""

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor

from mover.core.errors import InputError
from mover.core.records import record, rows_of
from mover.core.types import BodyPose, Camera
from mover.io.files.fields import At, mapping

PATIENCE = 15  # a person who is gone for so many frames starts a new track
REACH = 0.6  # of a person's size: how far one may move from frame to frame
GROWTH = 0.25  # `REACH` grows by this share with each frame of a gap


def people_of(at: At) -> list[tuple[int, At]]:
    """The people of a mapping from track to person, numbered by their keys or in order."""
    given = mapping(at)
    if not given:
        raise InputError(f"{at.place} has no people, expected at least one track")
    keys = [str(key) for key in given]
    numbered = all(key.isdigit() for key in keys)
    people: list[tuple[int, At]] = []
    for index, (key, value) in enumerate(given.items()):
        person = At(value, at.file, f"{at.field}.{key}" if at.field else str(key))
        mapping(person)
        people.append((int(keys[index]) if numbered else index, person))
    return people


def followed(
    frames: Sequence[int], places: NDArray[np.float64], sizes: NDArray[np.float64]
) -> NDArray[np.int64]:
    """Tracks of people that each frame lists in any order.

    The nearest pair of a track and a person is joined first, if the person moved no further than
    `REACH` of the larger of the two sizes, and a little more after a gap.

    Args:
        frames: Frame of each row.
        places: (rows, axes), positions in any unit.
        sizes: (rows,), sizes in the same unit.
    """
    tracks = np.full(len(frames), -1, dtype=np.int64)
    last: dict[int, int] = {}
    order = np.asarray(frames)
    for frame in sorted(set(order.tolist())):
        current = np.flatnonzero(order == frame)
        options: list[tuple[float, int, int]] = []
        for track, before in last.items():
            gap = frame - int(order[before])
            if gap > PATIENCE:
                continue
            for row in current:
                size = max(sizes[row], sizes[before], 1e-9)
                way = float(np.linalg.norm(places[row] - places[before]) / size)
                if way <= REACH * (1 + GROWTH * (gap - 1)):
                    options.append((way, track, int(row)))
        taken: set[int] = set()
        for _, track, row in sorted(options):
            if track not in taken and tracks[row] < 0:
                tracks[row] = track
                taken.add(track)
        for row in current:
            if tracks[row] < 0:
                tracks[row] = len(last)
            last[int(tracks[row])] = int(row)
    return tracks


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


@record
class Found:
    """Rows of bodies in the camera axes of their frames; a row is NaN where the tool failed."""

    model: str
    """Whose vertices: smpl, smplh, smplx or mhr."""
    frame: Int[Tensor, " bodies"]
    person: Int[Tensor, " bodies"]
    pose: BodyPose | None
    verts: Float[Tensor, "bodies verts 3"] | None = None
    """[m]."""
    joints: Float[Tensor, "bodies joints 3"] | None = None
    """As the model places them [m]."""
    K: Float[Tensor, "bodies 3 3"] | None = None
    """The lens that the tool assumed [px]."""
    up: Float[Tensor, "bodies 3"] | None = None
    """Away from the ground, where the tool knows gravity."""
    fps: float | None = None
    space: Literal["camera", "world"] = "camera"
    """world: +y up, where the tool knows no camera."""
    warnings: tuple[str, ...] = ()


_TENSORS = ("frame", "person", "verts", "joints", "K", "up")
_POSE = ("global_orient", "body_pose", "transl")


def joined(parts: Sequence[Found]) -> Found:
    """Rows of several people or frames together; all are of one tool."""
    first = parts[0]
    sizes = sorted({part.verts.shape[1] for part in parts if part.verts is not None})
    if len(sizes) > 1:
        found = f"meshes of {' and of '.join(map(str, sizes))} vertices"
        raise InputError(f"the files hold {found}, expected one topology")
    if len(parts) == 1:
        return first
    values = {name: [getattr(part, name) for part in parts] for name in _TENSORS}
    whole = {
        name: None if any(v is None for v in each) else torch.cat(each)
        for name, each in values.items()
    }
    poses = [part.pose for part in parts if part.pose is not None]
    pose = _joined_poses(poses) if len(poses) == len(parts) else None
    warnings = tuple(dict.fromkeys(w for part in parts for w in part.warnings))
    return dataclasses.replace(first, **whole, pose=pose, warnings=warnings)


def _joined_poses(poses: Sequence[BodyPose]) -> BodyPose:
    """Parameters of several; shapes are filled up with zeros."""
    width = max(pose.betas.shape[1] for pose in poses)
    betas = [torch.nn.functional.pad(p.betas, (0, width - p.betas.shape[1])) for p in poses]
    names = set.intersection(*(set(pose.extra) for pose in poses))
    names = {n for n in names if len({p.extra[n].shape[1] for p in poses}) == 1}
    return dataclasses.replace(
        poses[0],
        betas=torch.cat(betas),
        **{name: torch.cat([getattr(p, name) for p in poses]) for name in _POSE},
        extra={name: torch.cat([p.extra[name] for p in poses]) for name in sorted(names)},
    )


def chosen(found: Found, index: Int[Tensor, " rows"]) -> Found:
    """Some rows."""
    values = {name: getattr(found, name) for name in _TENSORS}
    picked = {name: None if v is None else v[index] for name, v in values.items()}
    pose = None if found.pose is None else rows_of(found.pose, index)
    return dataclasses.replace(found, **picked, pose=pose)
