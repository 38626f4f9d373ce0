r"""Who hides whom bounds the depth (Sec. 3.1, "Depth order constraint").

Evidence:  far(p) = min_t D_far^t(p),  near(p) = max_t D_near^t(p), gathered once over all frames:
           where a person is seen in front of object i (p in M_i, Sil_t and M_t), the object is not
           nearer than where the ray leaves the body; where object i hides the person (p in M_i and
           Sil_t, not in M_t), it is not farther than where the ray would enter the body.
Price:     L_depth = \sum_i \sum_{q in Sil_i, M_i} ReLU(D_i(q) - far(q)) + ReLU(near(q) - D_i(q))
Paper:     both bounds act on D_i, the front surface; pixels of an image that is 640 wide. Where
           near(p) > far(p) there is no range to lie in, and the pixel says nothing.
Robust:    mean over the constrained pixels (at least 100), 2 cm margin, clamped at 2 m; pixels
           whose bounds contradict each other are dropped. What is missing from a person's mask
           counts as hidden only where it is thicker than the error of an outline (`Seen.reach`).
Departure: the near bound is the first exit of the ray from the visible body, not the farthest
           layer of the body, which would forbid true places (an arm in front of a chair).
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mover.core.records import record
from mover.energy.config import Variant
from mover.geometry.raster import Depths

CLAMP = 2.0  # [m], the authors' released code
MARGIN = 0.02  # [m], slack of the robust form
FEWEST = 100.0  # pixels by which the robust form divides at least


@record
class DepthMaps:
    """Bounds from all frames in the image, and who set them."""

    near: Float[Tensor, "h w"]
    """Lower bound [m]; -inf where no person stood in front of an object."""
    far: Float[Tensor, "h w"]
    """Upper bound [m]; inf where no object hid a person."""
    free: Float[Tensor, "h w"]
    """Nothing stands nearer than this [m], inside masks or out; -inf where nobody was seen."""


@record
class DepthRange:
    """The bounds in the windows of the objects, each inside its own mask."""

    near: Float[Tensor, "objects h w"]
    far: Float[Tensor, "objects h w"]
    area: Float[Tensor, " objects"]
    """Area of a window pixel in pixels of an image that is 640 wide."""


@record
class Seen:
    """One person in one frame: what was seen of the body, and what was hidden."""

    front: Float[Tensor, "h w"]
    """Depth where the ray enters the body [m]; inf where it misses."""
    exit: Float[Tensor, "h w"]
    """Depth where it first leaves the body [m]."""
    visible: Bool[Tensor, "h w"]
    """The person's visible mask."""
    others: Bool[Tensor, "h w"]
    """Masks of the other people of the frame."""
    reach: float = 0.0
    """How far the drawn outline may be wrong [px]."""


def bounds_of(
    seen: Seen, objects: Bool[Tensor, "objects h w"], erode: int, *, vote: bool
) -> DepthMaps:
    """Bounds from one body in one frame.

    Args:
        seen: The drawn body and the masks.
        objects: Masks of the objects in the clean image.
        erode: Pixels by which silhouettes and masks shrink, so that rays that graze the body and
            borders that leak bound nothing.
        vote: Of each object, keep only the larger region: it is hidden or hides, not both.
    """
    body = eroded(seen.front.isfinite(), erode)
    shown = body & eroded(seen.visible, erode)
    hidden = body & ~_grow(seen.visible, erode) & ~_grow(seen.others, erode)
    if seen.reach > 0:
        hidden = _thick(hidden, seen.reach)
    before, behind = objects & shown, objects & hidden
    if vote:
        more = before.sum((-2, -1)) - behind.sum((-2, -1))
        before = before & (more > 0)[:, None, None]
        behind = behind & (more < 0)[:, None, None]
    infinity = torch.full_like(seen.front, float("inf"))
    near = torch.where(before.any(0), seen.exit, -infinity)
    free = torch.where(shown, seen.exit, -infinity)
    return DepthMaps(near, torch.where(behind.any(0), seen.front, infinity), free)


def merge(a: DepthMaps, b: DepthMaps) -> DepthMaps:
    """The narrower bounds of two sets of frames."""
    near, far = torch.maximum(a.near, b.near), torch.minimum(a.far, b.far)
    return DepthMaps(near, far, torch.maximum(a.free, b.free))


def depth_term(
    seen: Depths, mask: Float[Tensor, "objects h w"], allowed: DepthRange, form: Variant
) -> Float[Tensor, "*starts objects"]:
    """Distance out of the allowed range [m px at 640], or its mean [m] (`robust`)."""
    inside = seen.covered & (mask > 0.5)
    if form == "robust":
        sane = allowed.near < allowed.far
        bounded = inside & sane & (allowed.near.isfinite() | allowed.far.isfinite())
        out = _short(allowed.near - MARGIN, seen.nearest, CLAMP)
        out = out + _short(seen.nearest, allowed.far + MARGIN, CLAMP)
        return (out * bounded).sum((-2, -1)) / bounded.sum((-2, -1)).clamp_min(FEWEST)
    ranged = inside & (allowed.near <= allowed.far)
    out = _short(allowed.near, seen.nearest) + _short(seen.nearest, allowed.far)
    return (out * ranged).sum((-2, -1)) * allowed.area


def _short(
    lower: Float[Tensor, "*any h w"], upper: Float[Tensor, "*more h w"], limit: float = float("inf")
) -> Float[Tensor, "*most h w"]:
    """How much `lower` exceeds `upper`; unbounded pixels (infinite) cost nothing."""
    gap = lower - upper
    return gap.nan_to_num(0.0, 0.0, 0.0).clamp(0, limit)


def _erode(mask: Bool[Tensor, "*batch h w"]) -> Bool[Tensor, "*batch h w"]:
    """Drop pixels beside an unset one (four neighbours); the border of the image is no edge."""
    padded = torch.nn.functional.pad(mask, (1, 1, 1, 1), value=True)
    rows = padded[..., :-2, 1:-1] & padded[..., 2:, 1:-1]
    return mask & rows & padded[..., 1:-1, :-2] & padded[..., 1:-1, 2:]


def _thick(hidden: Bool[Tensor, "h w"], reach: float) -> Bool[Tensor, "h w"]:
    """What a wrong outline does not explain: discs of the radius `reach` that are wholly hidden.

    An arm that the body has in a wrong place is not hidden by what stands behind it.
    """
    from scipy.ndimage import distance_transform_edt

    inner = torch.from_numpy(distance_transform_edt(hidden.cpu().numpy())) > reach
    if bool(inner.any()):
        inner = torch.from_numpy(distance_transform_edt(~inner.numpy())) < reach / 2
    return hidden & inner.to(hidden.device)


def eroded(mask: Bool[Tensor, "*batch h w"], steps: int) -> Bool[Tensor, "*batch h w"]:
    """The mask without what lies so many steps from an unset pixel; the image's border is none."""
    for _ in range(steps):
        mask = _erode(mask)
    return mask


def _grow(mask: Bool[Tensor, "h w"], steps: int) -> Bool[Tensor, "h w"]:
    return ~eroded(~mask, steps)
