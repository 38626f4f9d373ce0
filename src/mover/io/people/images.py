"""Tools that see one image at a time and list its people: Multi-HMR and SAM 3D Body.

Multi-HMR gives SMPL-X meshes and angles. The image was padded to a square and seen with 60 degrees
of view unless told otherwise, so that the focal length is longer side / (2 tan 30°). `rotvec` holds
root, 21 joints of the body, 15 of the left hand, 15 of the right, and the jaw; hands count from the
flat hand; `transl_pelvis` is the place of the pelvis.

SAM 3D Body gives MHR meshes, one file a person or one list of people an image. Vertices and joints
are in camera axes about the body; `pred_cam_t` is added. The lens has its principal point in the
image's middle; where `focal_length` is missing, the joints, which are told in space and in the
image, tell the lens.
"""

import dataclasses
import math
import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from mover.bodies.smpl_model import FLAT
from mover.core.errors import InputError
from mover.io.files.fields import At, refuse
from mover.io.people.found import Found, Known, followed, joined, people_rows
from mover.io.people.lens import assumed_lens
from mover.io.people.values import (
    KINDS,
    either,
    meshes,
    natural,
    need,
    numbers,
    one_number,
    read_any,
    rows,
    stacked,
    tensor,
    wide,
)

TALL = 1.7  # [m], the size of a person whose file does not tell it
VERTS = 10475
VIEW = math.radians(60)
JOINTS = 53
EXTRA = {"left_hand_pose": (66, 111), "right_hand_pose": (111, 156), "jaw_pose": (156, 159)}
"""Columns of `rotvec` behind root and body."""


def read_multihmr(path: Path, known: Known) -> Found:
    """Bodies of Multi-HMR; people are followed from image to image."""
    return tracked(
        path,
        known,
        lambda at: rows(need(at, "transl_pelvis", "transl"), 1, 3)[0],
        lambda seen, track: _of_multihmr(seen, track, known),
    )


def _of_multihmr(seen: "Sighting", person: int, known: Known) -> Found:
    at = seen.at
    turns = tensor(rows(need(at, "rotvec"), 1, JOINTS * 3))
    extra = {name: turns[:, start:end] for name, (start, end) in EXTRA.items()}
    expression = either(at, "expression")
    if expression is not None:
        extra["expression"] = tensor(wide(expression, 1))
    told = turns[:, :66], wide(need(at, "shape", "betas"), 1), torch.zeros(1, 3)
    return people_rows(
        known, "smplx", torch.tensor([seen.frame]), person, told, {**extra, FLAT: torch.ones(1, 1)},
        verts=meshes(either(at, "v3d", "verts_smplx", "verts_smplx_cam"), VERTS, 1),
        pelvis=tensor(rows(need(at, "transl_pelvis"), 1, 3)),
        K=assumed_lens(known, lambda *size: max(size) / (2 * math.tan(VIEW / 2)), 1),
    )  # fmt: skip


def read_sam3d(path: Path, known: Known) -> Found:
    """Bodies of SAM 3D Body, meshes only; people are followed from image to image."""
    return tracked(
        path, known, lambda at: _verts(at).mean(0), lambda seen, who: _of_sam3d(seen, who, known)
    )


def _of_sam3d(seen: "Sighting", person: int, known: Known) -> Found:
    return Found(
        model="mhr",
        frame=torch.tensor([seen.frame]),
        person=torch.tensor([person]),
        pose=None,
        verts=tensor(_verts(seen.at)[None]),
        K=_lens(seen.at, known),
    )


def _verts(at: At) -> NDArray[np.float64]:
    """Vertices in camera axes [m]."""
    given = need(at, "pred_vertices")
    verts = numbers(given)
    if verts.ndim == 3 and len(verts) == 1:
        verts = verts[0]
    if verts.ndim != 2 or verts.shape[1] != 3 or not len(verts):
        refuse(given, "an array of shape (vertices, 3)", f"shape {verts.shape}")
    return verts + rows(need(at, "pred_cam_t"), 1, 3)


def _lens(at: At, known: Known) -> Tensor | None:
    joints, pixels = either(at, "pred_keypoints_3d"), either(at, "pred_keypoints_2d")
    if joints is not None and pixels is not None:
        points = stacked(joints, 3) + rows(need(at, "pred_cam_t"), 1, 3)
        seen = rows(pixels, len(points), 2)
        if np.isfinite(points).all() and np.isfinite(seen).all():
            return lens_of(tensor(points), tensor(seen))[None]
    focal = either(at, "focal_length")
    if focal is None:
        return None if known.focal is None else assumed_lens(known, known.focal, 1)
    return assumed_lens(dataclasses.replace(known, focal=None), one_number(focal), 1)


def lens_of(
    points: Float[Tensor, "points 3"], pixels: Float[Tensor, "points 2"]
) -> Float[Tensor, "3 3"]:
    """The lens that sees these points in camera axes at these pixels, by least squares [px]."""
    rays = (points[:, :2] / points[:, 2:]).double()
    seen = pixels.double()
    one, none = torch.ones(len(rays)).double(), torch.zeros(len(rays)).double()
    left = torch.cat(
        [torch.stack([rays[:, 0], one, none], 1), torch.stack([rays[:, 1], none, one], 1)]
    )
    f, cx, cy = torch.linalg.lstsq(left, seen.T.reshape(-1, 1)).solution[:, 0].tolist()
    return torch.tensor([[f, 0, cx], [0, f, cy], [0, 0, 1]])


# Their files: lists of people by image.


def tracked(
    path: Path, known: Known, place: Callable[[At], Any], body: Callable[["Sighting", int], Found]
) -> Found:
    """People of all images, followed from image to image by the places of their bodies.

    Raises:
        InputError: If there is nobody, or a person is not as the tool writes one.
    """
    seen = sightings(path, known.first)
    if not seen:
        raise InputError(f"{path}: has no people, expected at least one")
    places = np.stack([place(s.at) for s in seen])
    who = followed([s.frame for s in seen], places, np.full(len(seen), TALL))
    return joined([body(s, int(track)) for s, track in zip(seen, who, strict=True)])


@dataclass(frozen=True)
class Sighting:
    """One person in one image."""

    frame: int
    at: At


def sightings(path: Path, first: int) -> list[Sighting]:
    """All people of a file, or of a folder with a file an image or a file a person.

    Raises:
        InputError: If a file cannot be read or lists no people.
    """
    if path.is_dir():
        files = sorted((f for f in path.iterdir() if f.suffix.lower() in KINDS), key=natural)
    else:
        files = [path]
    if not files:
        raise InputError(f"{path}: has no files of kind {', '.join(KINDS)}")
    numbers = _frames([file.stem for file in files])
    found: list[Sighting] = []
    for file, number in zip(files, numbers, strict=True):
        found += _of_file(read_any(file), number - first if path.is_dir() else 0)
    return found


def _frames(stems: list[str]) -> list[int]:
    """Frame of each file: what is left of its name without the person.

    Names that end in `_subj00` or `_person1` are people of the image before; then the last number
    of what is left counts, else the order.
    """
    images = [re.sub(r"_?(?:subj|person|human)_?\d+$", "", stem) for stem in stems]
    digits = [re.findall(r"\d+", image) for image in images]
    if all(digits):
        found = [int(d[-1]) for d in digits]
        if len(set(zip(found, images, strict=True))) == len(set(found)):
            return found
    order = {image: k for k, image in enumerate(dict.fromkeys(images))}
    return [order[image] for image in images]


def _of_file(at: At, frame: int) -> list[Sighting]:
    """The people of one file: a person, a list of people, or lists by image."""
    value = at.value
    if isinstance(value, np.ndarray) and value.dtype == object:
        value = value.tolist()
    if isinstance(value, Mapping):
        return _of_mapping(At(value, at.file, at.field), frame)
    if not isinstance(value, list | tuple):
        refuse(at, "a person, or a list of people")
    found: list[Sighting] = []
    for k, each in enumerate(value):
        field = f"{at.field}[{k}]"
        if isinstance(each, list | tuple):  # one list for each image
            found += _of_file(At(list(each), at.file, field), frame + k)
        else:
            found.append(Sighting(frame, At(each, at.file, field)))
    return found


def _of_mapping(at: At, frame: int) -> list[Sighting]:
    """One person, or lists of people by image number."""
    given: Mapping[Any, Any] = at.value
    if given and all(_is_people(v) for v in given.values()):
        keys = [re.findall(r"\d+", str(key)) for key in given]
        numbers = [int(k[-1]) for k in keys] if all(keys) else list(range(len(given)))
        found: list[Sighting] = []
        for number, (key, value) in zip(numbers, given.items(), strict=True):
            found += _of_file(At(list(value), at.file, str(key)), number)
        return found
    for name in ("humans", "people", "outputs"):
        if name in given:
            return _of_file(At(given[name], at.file, name), frame)
    return [Sighting(frame, at)]


def _is_people(value: Any) -> bool:  # noqa: ANN401
    """Whether a value is a list of people, which may be empty."""
    return isinstance(value, list | tuple) and all(isinstance(v, Mapping) for v in value)
