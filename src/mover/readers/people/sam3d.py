"""SAM 3D Body's people: MHR meshes, one file a person or one list of people an image.

Vertices and joints are in camera axes about the body; `pred_cam_t` is added. The lens has its
principal point in the image's middle; where `focal_length` is missing, the joints, which are told
in space and in the image, tell the lens.
"""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from ...records import InputError
from ..fields import At, refuse
from .found import Found, found_rows, joined
from .known import Known
from .lens import lens
from .lists import Sighting, sightings
from .tracks import followed
from .values import either, need, numbers, one_number, rows, stacked, tensor


def read_sam3d(path: Path, known: Known) -> Found:
    """Bodies of SAM 3D Body, meshes only; people are followed from image to image.

    Raises:
        InputError: If a key is missing or has the wrong shape.
    """
    seen = sightings(path, known.first)
    if not seen:
        raise InputError(f"{path}: has no people, expected at least one")
    places = np.stack([_verts(s.at).mean(0) for s in seen])
    who = followed([s.frame for s in seen], places, np.full(len(seen), 1.7))
    return joined([_person(s, int(t), known) for s, t in zip(seen, who, strict=True)])


def _person(seen: Sighting, person: int, known: Known) -> Found:
    verts = tensor(_verts(seen.at)[None])
    frame = torch.tensor([seen.frame])
    used = _lens(seen.at, known)
    return found_rows("mhr", frame, person, None, verts=verts, **used)


def _verts(at: At) -> NDArray[np.float64]:
    """Vertices in camera axes [m]."""
    given = need(at, "pred_vertices")
    verts = numbers(given)
    if verts.ndim == 3 and len(verts) == 1:
        verts = verts[0]
    if verts.ndim != 2 or verts.shape[1] != 3 or not len(verts):
        refuse(given, "an array of shape (vertices, 3)", f"shape {verts.shape}")
    return verts + rows(need(at, "pred_cam_t"), 1, 3)


def _lens(at: At, known: Known) -> dict[str, Any]:
    """The lens that was assumed."""
    joints, pixels = either(at, "pred_keypoints_3d"), either(at, "pred_keypoints_2d")
    if joints is not None and pixels is not None:
        points = stacked(joints, 3) + rows(need(at, "pred_cam_t"), 1, 3)
        seen = rows(pixels, len(points), 2)
        if np.isfinite(points).all() and np.isfinite(seen).all():
            return {"K": lens_of(tensor(points), tensor(seen))[None]}
    focal = either(at, "focal_length")
    if known.camera is None or (focal is None and known.focal is None):
        return {}
    f = known.focal if focal is None else one_number(focal)
    assert f is not None
    return {"K": lens(f, known.camera.width, known.camera.height).float()[None]}


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
