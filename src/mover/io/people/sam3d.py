"""SAM 3D Body's people: MHR meshes, one file a person or one list of people an image.

Vertices and joints are in camera axes about the body; `pred_cam_t` is added. The lens has its
principal point in the image's middle; where `focal_length` is missing, the joints, which are told
in space and in the image, tell the lens.
"""

import dataclasses
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from mover.io.files.fields import At, refuse
from mover.io.people.found import Found, Known
from mover.io.people.lens import assumed_lens
from mover.io.people.tracks import Sighting, tracked
from mover.io.people.values import either, need, numbers, one_number, rows, stacked, tensor


def read_sam3d(path: Path, known: Known) -> Found:
    """Bodies of SAM 3D Body, meshes only; people are followed from image to image.

    Raises:
        InputError: If a key is missing or has the wrong shape.
    """
    return tracked(
        path, known, lambda at: _verts(at).mean(0), lambda seen, who: _person(seen, who, known)
    )


def _person(seen: Sighting, person: int, known: Known) -> Found:
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
    """The lens that was assumed."""
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
