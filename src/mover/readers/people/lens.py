r"""Lenses: from weak perspective and assumed focal lengths to the true camera.

A network sees a square crop of side b [px] about (x, y) and says how large (s) and where (p, q) a
body is in it. Under a camera with focal length f and principal point c the body's origin is at

    t_z = 2 f / (s b),   t_x = p + 2 (x - c_x) / (s b),   t_y = q + 2 (y - c_y) / (s b)

A tool that assumed another lens put the body where it gives the same pixels under that lens; under
the true one it keeps the pixel of its middle and its size in pixels.
"""

import torch
from jaxtyping import Float
from torch import Tensor

from ..fields import At
from .values import need, one_number, stacked

SAME_LENS = 1e-4  # relative difference of focal lengths that is none


def lens(
    focal: float | Tensor, width: float | Tensor, height: float | Tensor
) -> Float[Tensor, "3 3"]:
    """The lens that most tools assume: the principal point is the image's middle [px]."""
    f, w, h = (float(v) for v in (focal, width, height))
    return torch.tensor([[f, 0, w / 2], [0, f, h / 2], [0, 0, 1]], dtype=torch.float64)


def told_lens(at: At, count: int) -> Float[Tensor, "rows 3 3"]:
    """The lens that a file tells as `img_focal` and `img_center` [px].

    Raises:
        InputError: If a key is missing or is no number.
    """
    focal = one_number(need(at, "img_focal"))
    cx, cy = stacked(need(at, "img_center"), 2)[0].tolist()
    return torch.tensor([[focal, 0, cx], [0, focal, cy], [0, 0, 1]]).expand(count, 3, 3)


def from_crop(
    crop: Float[Tensor, "bodies 3"], box: Float[Tensor, "bodies 3"], K: Float[Tensor, "3 3"]
) -> Float[Tensor, "bodies 3"]:
    """Place of bodies that a network saw in square crops [m].

    Args:
        crop: s, p, q.
        box: Centre x, y and side of the square [px].
        K: The true lens.
    """
    size = (crop[:, 0] * box[:, 2]).clamp_min(1e-9)
    f, c = torch.stack([K[0, 0], K[1, 1]]), K[:2, 2]
    depth = 2 * f.mean() / size
    flat = crop[:, 1:] + (box[:, :2] - c) / f * depth[:, None]
    return torch.cat([flat, depth[:, None]], -1)


def from_image(
    whole: Float[Tensor, "bodies 4"], K: Float[Tensor, "3 3"], size: tuple[int, int]
) -> Float[Tensor, "bodies 3"]:
    """Place of bodies by weak perspective of the whole image: s_x, s_y, p, q [m].

    A point (x, y) of the body is at (s_x (x + p), s_y (y + q)) of an image that spans -1 to 1.
    """
    half = torch.tensor(size, dtype=whole.dtype) / 2
    pixels = (whole[:, :2] * whole[:, 2:] + 1) * half
    f, c = torch.stack([K[0, 0], K[1, 1]]), K[:2, 2]
    depth = (f / (whole[:, :2] * half).clamp_min(1e-9)).mean(-1)
    return torch.cat([(pixels - c) / f * depth[:, None], depth[:, None]], -1)


def from_pixels(
    joints: Float[Tensor, "bodies joints 3"],
    pixels: Float[Tensor, "bodies joints 2"],
    K: Float[Tensor, "3 3"],
) -> Float[Tensor, "bodies 3"]:
    """Place of bodies whose joints are seen at these pixels, by linear least squares [m]."""
    rays = (pixels - K[:2, 2]) / torch.stack([K[0, 0], K[1, 1]])
    one, none = torch.ones_like(rays[..., 0]), torch.zeros_like(rays[..., 0])
    left = torch.stack(
        [torch.stack([one, none, -rays[..., 0]], -1), torch.stack([none, one, -rays[..., 1]], -1)],
        -2,
    ).flatten(1, 2)
    right = (rays * joints[..., 2:] - joints[..., :2]).flatten(1)
    normal = left.mT @ left
    return torch.linalg.solve(normal, (left.mT @ right[..., None])[..., 0])


def refocused(
    middle: Float[Tensor, "bodies 3"], used: Float[Tensor, "bodies 3 3"], K: Float[Tensor, "3 3"]
) -> Float[Tensor, "bodies 3"]:
    """How far bodies must move to keep place and size in the image under another lens [m]."""
    pixel = torch.einsum("bij,bj->bi", used, middle)
    pixel = pixel[:, :2] / pixel[:, 2:]
    f = torch.stack([K[0, 0], K[1, 1]])
    f_used = torch.stack([used[:, 0, 0], used[:, 1, 1]], -1)
    depth = middle[:, 2] * (f / f_used).mean(-1)
    there = torch.cat([(pixel - K[:2, 2]) / f * depth[:, None], depth[:, None]], -1)
    return there - middle


def differs(used: Float[Tensor, "bodies 3 3"], K: Float[Tensor, "3 3"]) -> bool:
    """Whether the lenses are not the same."""
    return bool((used - K).abs().amax() > SAME_LENS * K[0, 0])
