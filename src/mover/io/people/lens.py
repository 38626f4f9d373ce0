"""Lenses of other tools, from weak perspective and assumed ones to the true one; cameras that move.

A tool that assumed another lens put the body where it gives the same pixels under that lens; under
the true one it keeps the pixel of its middle and its size in pixels.
"""

import math
from collections.abc import Callable, Sequence

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mover.core.devices import lstsq
from mover.core.types import Camera
from mover.geometry.rotations import axis_angle
from mover.io.files.fields import At
from mover.io.people.found import Known

SAME_LENS = 1e-4  # relative difference of focal lengths that is none
TURNED = math.radians(5)  # cameras whose up-vectors spread more are not taken to stand still
TRAVELLED = 0.1  # [m], the same for their positions


def lens(fx: float, fy: float, cx: float, cy: float) -> At:
    """The nine numbers of a pinhole camera [px]."""
    return At(np.array([[fx, 0, cx, 0, fy, cy, 0, 0, 1]]), "the lens")


def assumed_lens(
    known: Known, focal: Callable[[float, float], float], size: Sequence[float] | None = None
) -> At | None:
    """The lens that most tools assume: the principal point is the image's middle.

    The user's focal length goes before the tool's, `focal` of width and height [px]; without a
    `size` [px] that of the user's camera counts, and without either the lens is not known.
    """
    if size is None and known.camera is not None:
        size = known.camera.width, known.camera.height
    if size is None:
        return None
    f = known.focal or focal(*size)
    return lens(f, f, size[0] / 2, size[1] / 2)


def own_lens(given: At | None, known: Known) -> tuple[At | None, tuple[str, ...]]:
    """The lens of the files, else that of the user's focal length, else what to say of it."""
    if given is not None or known.focal is not None or known.camera is None:
        return given or assumed_lens(known, lambda *_: 1.0), ()
    return None, ("has no lens, so the true one is taken for the tool's: --focal gives that [px]",)


def from_weak(crop: Float[Tensor, "bodies 4"], camera: Camera) -> Float[Tensor, "bodies 3"]:
    """Position of bodies by weak perspective of the whole image: s_x, s_y, p, q [m].

    A point (x, y) of the body is at (s_x (x + p), s_y (y + q)) of an image that spans -1 to 1.
    """
    half = torch.tensor([camera.width, camera.height], dtype=torch.float64) / 2
    K, scale = camera.K.double(), crop[:, :2].double()
    pixels = (scale * crop[:, 2:].double() + 1) * half
    f, c = K[[0, 1], [0, 1]], K[:2, 2]
    depth = (f / (scale * half).clamp_min(1e-9)).mean(-1, keepdim=True)
    return torch.cat([(pixels - c) / f * depth, depth], -1).float()


def refocused(
    middle: Float[Tensor, "bodies 3"], used: Float[Tensor, "bodies 3 3"], K: Float[Tensor, "3 3"]
) -> Float[Tensor, "bodies 3"]:
    """Shift that keeps position and size in the image under another lens; 0 under the same."""
    if not (used - K).abs().amax() > SAME_LENS * K[0, 0]:
        return torch.zeros_like(middle)
    pixel = torch.einsum("bij,bj->bi", used, middle)
    pixel = pixel[:, :2] / pixel[:, 2:]
    f, f_used = K[[0, 1], [0, 1]], used[:, [0, 1], [0, 1]]
    depth = middle[:, 2:] * (f / f_used).mean(-1, keepdim=True)
    return torch.cat([(pixel - K[:2, 2]) / f * depth, depth], -1) - middle


def lens_of(points: Float[Tensor, "points 3"], pixels: Float[Tensor, "points 2"]) -> At:
    """The lens that sees these points in camera axes at these pixels, by least squares [px]."""
    rays = (points[:, :2] / points[:, 2:]).double()
    centre = torch.eye(2).double().repeat_interleave(len(rays), 0)  # first all x, then all y
    left = torch.cat([rays.T.reshape(-1, 1), centre], 1)
    f, cx, cy = lstsq(left, pixels.double().T.flatten()).tolist()
    return lens(f, f, cx, cy)


def tilting(
    root_cam: Float[Tensor, "rows 3"], root_world: Float[Tensor, "rows 3"]
) -> tuple[str, ...]:
    """A warning if gravity turns in the camera: by one body's root in it and in a world (+y up).

    The spread is the angle to the normalised median that nine of ten rows keep.
    """
    up = (axis_angle(root_cam.double()) @ axis_angle(root_world.double()).mT)[..., 1]
    up = up[up.isfinite().all(-1)]
    if not len(up):
        return ()
    middle = torch.nn.functional.normalize(up.median(0).values, dim=0)
    spread = float((up @ middle).clamp(-1, 1).acos().quantile(0.9))
    text = f"its gravity turns by {spread:.2f} rad: does the camera move?"
    return (text,) if spread > TURNED else ()


def movement(
    R_cam_world: Float[np.ndarray, "frames 3 3"], t: Float[np.ndarray, "frames 3"]
) -> tuple[str, ...]:
    """A warning if the camera of a tool (x_cam = R x + t) does not stand still."""
    turn = np.trace(R_cam_world @ R_cam_world[0].T, axis1=1, axis2=2)
    angle = float(np.arccos(np.clip((turn - 1) / 2, -1, 1)).max())
    centre = -np.einsum("tji,tj->ti", R_cam_world, t)
    way = float(np.linalg.norm(centre - centre[0], axis=1).max())
    if angle < TURNED and way < TRAVELLED:
        return ()
    path = f"turns by up to {math.degrees(angle):.1f} degrees and travels {way:.2f} m"
    return (f"the camera {path}: give its poses, too (`mover import --cameras`)",)
