r"""Terms of Eq. 1 that people say of the room: depth order, free space, contact; and their feet.

    Depth order  L_depth     = \sum_i \sum_{q in Sil_i, M_i} ReLU(D_i(q) - far(q))
                                                           + ReLU(near(q) - D_i(q))
    Free space   L_collision = \sum_i \sum_u \| V(u_i) \|_2^2   where V(u_i) < 0
    Contact      L_contact   = \sum_i \sum_v I(v, O_i) [CD(v^y, C(O_i)^y)
                                                           + CD(v^{\perp y}, C(O_i)^{\perp y})]
    Feet         L_feet      = \rho(R^T C^feet - [0, y_gp, 0]^T; \sigma_1)

Sec. 3.1 and 3.2 of the paper: as printed (`paper`, with its `Readings`), and normalised (`robust`).
"""

from dataclasses import fields
from functools import cached_property

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.core.devices import constant
from mover.core.records import record
from mover.core.types import Layout, Objects
from mover.energy.config import Variant
from mover.energy.minimize import geman_mcclure, safe_norm
from mover.geometry.crops import depth_in
from mover.geometry.nearest import nearest_points
from mover.geometry.raster import Depths
from mover.geometry.rotations import rot_y
from mover.geometry.volume import Volume, sample

# --- Depth order: who hides whom bounds the depth ------------------------------------------------
#
# Where a person is seen in front of object i (p in M_i, Sil_t and M_t), the object is not nearer
# than where the ray leaves the body; where object i hides the person (p in M_i and Sil_t, not in
# M_t), it is not farther than where the ray would enter the body.

CLAMP = 2.0  # [m], the authors' released code
DEPTH_MARGIN = 0.02  # [m], slack of the robust form
FEWEST = 100.0  # pixels by which the robust form divides at least


@record
class DepthMaps:
    """Bounds from all frames in the image, and who set them."""

    near: Float[Tensor, "h w"]  #: lower bound [m]; -inf where no person stood in front of an object
    far: Float[Tensor, "h w"]  #: upper bound [m]; inf where no object hid a person


@record
class DepthRange:
    """The bounds in the windows of the objects, each inside its own mask."""

    near: Float[Tensor, "objects h w"]
    far: Float[Tensor, "objects h w"]
    area: Float[Tensor, " objects"]
    """Area of a window pixel in pixels of an image that is 640 wide."""

    @cached_property
    def bounded(self) -> Bool[Tensor, "objects h w"]:
        """Where there is a bound."""
        return self.near.isfinite() | self.far.isfinite()


@record
class BodyView:
    """One person in one frame: what was seen of the body, and what was hidden."""

    front: Float[Tensor, "h w"]  #: depth where the ray enters the body [m]; inf where it misses
    exit: Float[Tensor, "h w"]
    """Depth where it first leaves the body, or of the body's far side [m]."""
    visible: Bool[Tensor, "h w"]  #: the person's visible mask
    others: Bool[Tensor, "h w"]  #: masks of the other people of the frame
    reach: float = 0.0  #: how far the drawn outline may be wrong [px]


def bounds_of(
    seen: BodyView, objects: Bool[Tensor, "objects h w"], erode: int, vote: bool = True
) -> DepthMaps:
    """Bounds from one body in one frame; `objects` are masks in the clean image.

    Silhouettes and masks shrink by `erode` pixels, so that rays that graze the body and borders
    that leak bound nothing. With a `vote` only the larger region of each object counts: it is
    hidden or hides, not both.
    """
    body = eroded(seen.front.isfinite(), erode)
    shown = body & eroded(seen.visible, erode)
    hidden = body & eroded(~seen.visible, erode) & eroded(~seen.others, erode)
    if seen.reach > 0:
        hidden = _thick(hidden, seen.reach)
    before, behind = objects & shown, objects & hidden
    if vote:
        more = (before.sum((-2, -1)) - behind.sum((-2, -1)))[:, None, None]
        before, behind = before & (more > 0), behind & (more < 0)
    infinity = torch.full_like(seen.front, float("inf"))
    near = torch.where(before.any(0), seen.exit, -infinity)
    return DepthMaps(near, torch.where(behind.any(0), seen.front, infinity))


def merge(a: DepthMaps, b: DepthMaps) -> DepthMaps:
    """The narrower bounds of two sets of frames."""
    return DepthMaps(torch.maximum(a.near, b.near), torch.minimum(a.far, b.far))


def depth_term(
    seen: Depths,
    mask: Float[Tensor, "objects h w"],
    allowed: DepthRange,
    form: Variant,
    contradiction: str = "skip",
) -> Float[Tensor, "*starts objects"]:
    """Distance of the front surface out of the allowed range [m px at 640], or its mean [m].

    Paper: the sum over pixels; bounds that contradict each other are no range, unless they `count`.
    Robust: the mean over the constrained pixels, with 2 cm slack, clamped.
    """
    robust, near, far = form == "robust", allowed.near, allowed.far
    sane = near < far if robust else (near <= far) | (contradiction == "count")
    ranged = (mask > 0.5) & allowed.bounded & sane
    item, pixel = ranged.flatten(1).nonzero(as_tuple=True)  # few pixels have bounds
    near, far = (x.flatten(1)[item, pixel] for x in (near, far))
    nearest, covered = (x.flatten(-2)[..., item, pixel] for x in (seen.nearest, seen.covered))
    margin, limit = (DEPTH_MARGIN, CLAMP) if robust else (0.0, float("inf"))
    out = _short(near - margin, nearest, limit) + _short(nearest, far + margin, limit)
    none = nearest.new_zeros(*nearest.shape[:-1], len(mask))
    total = none.index_add(-1, item, out * covered)
    if not robust:
        return total * allowed.area
    return total / none.index_add(-1, item, covered.to(none)).clamp_min(FEWEST)


def _short(
    lower: Float[Tensor, "*any"], upper: Float[Tensor, "*more"], limit: float = float("inf")
) -> Float[Tensor, "*most"]:
    """How much `lower` exceeds `upper`; unbounded pixels (infinite) cost nothing."""
    gap = lower - upper
    return gap.nan_to_num(0.0, 0.0, 0.0).clamp(0, limit)


def _thick(hidden: Bool[Tensor, "h w"], reach: float) -> Bool[Tensor, "h w"]:
    """What a wrong outline does not explain: discs of the radius `reach` that are wholly hidden."""
    inner = depth_in(hidden.cpu().numpy()) > reach
    if inner.any():
        inner = depth_in(~inner) < reach / 2
    return hidden & torch.from_numpy(inner).to(hidden.device)


def eroded(mask: Bool[Tensor, "*batch h w"], steps: int) -> Bool[Tensor, "*batch h w"]:
    """The mask without pixels so many steps from an unset one; the image's border is no edge."""
    if not steps or not mask.numel():
        return mask
    import cv2

    cross = cv2.getStructuringElement(cv2.MORPH_CROSS, (3, 3))
    pixels = mask.reshape(-1, *mask.shape[-2:]).cpu().numpy().astype(np.uint8)
    left = np.stack([cv2.erode(one, cross, iterations=steps) for one in pixels])
    return torch.from_numpy(left > 0).reshape(mask.shape).to(mask.device)


# --- Free space: people move through it -----------------------------------------------------------
#
# V = min(V_1, ..., V_T) is the signed distance to all bodies on one grid [m].

SAMPLES = 1000.0  # of an object in the authors' code; 3 cm inside on each costs one


@record
class BodySpace:
    """The space that the people have moved through."""

    volume: Volume  #: signed distance to the nearest body of any frame


def collision_term(
    points: Float[Tensor, "*starts objects points 3"],
    space: BodySpace,
    lookup: str = "trilinear",
    real: Bool[Tensor, "objects points"] | None = None,
) -> Float[Tensor, "*starts objects"]:
    """Squared depth of surface points inside the bodies of all frames [m²].

    Even samples count as `SAMPLES`; vertices are those that are `real`, one each.
    """
    depth = sample(space.volume, points)
    if lookup == "voxel":
        depth = depth + (_voxel(space.volume, points) - depth).detach()
    squared = depth.clamp_max(0).square()
    return SAMPLES * squared.mean(-1) if real is None else (squared * real).sum(-1)


def _voxel(volume: Volume, points: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
    """The value of the cell that holds a point; 0 beyond the volume."""
    size = torch.tensor(volume.values.shape, device=points.device)
    at = ((points - volume.origin) / volume.cell).round().long()
    inside = ((at >= 0) & (at < size)).all(-1)
    x, y, z = torch.minimum(at.clamp_min(0), size - 1).unbind(-1)
    return volume.values[x, y, z] * inside


def collision_share(objects: Objects, touches: "ContactPoints | None") -> Float[Tensor, " objects"]:
    """Weight of the collision of each object: a tenth for a used seat, as bodies are soft."""
    if touches is None:
        return objects.verts.new_ones(len(objects.ids))
    used = objects.verts.new_zeros(len(objects.ids)).index_fill(0, touches.object_of, 1.0)
    return 1 - 0.9 * used * objects.is_seat.to(used)


# --- Contact: touching surfaces are in the same position ------------------------------------------
#
# Body points that touch, from all frames, are each assigned to one object and to its part: to the
# seat or top (C(O)^y) if their normal lies within 45 degrees of the vertical, else to the back;
# thinned to cells whose weight counts the points inside. Robust: in full once four bodies touch,
# the back a quarter of the seat, so that a few wrong points do not drag an object.

CONTACT_RHO = 0.3  # [m], docs/method.md: 0.15 gives up on objects half a metre away
ENOUGH = 4.0  # bodies that touch before contact counts in full
CONTACT_SHARE = (1.0, 0.25, 1.0, 0.25)  # of seat or top, back, then the same for hands


@record
class ContactPoints:
    """Body points that touch furniture, from all frames, packed over the touched objects."""

    object_of: Int[Tensor, " touched"]  #: index of each touched object
    points: Float[Tensor, "touched 4 points 3"]
    """Positions in the world [m] by part: top, back, top by hand, back by hand."""
    weight: Float[Tensor, "touched 4 points"]  #: body vertices that a point stands for; 0 pads
    bodies: Float[Tensor, " touched"]  #: number of bodies that touch the object
    share: Float[Tensor, "touched 4"]
    """Of all body vertices that touch seats and tops, or backs, those that touch this part [1]."""
    heading: Float[Tensor, "touched 2"]
    """Mean direction (x, z) that its sitters face, or that a person lying on a bed stretches to
    from the neck to the hips, a unit vector; zero where it is not known."""
    across: Bool[Tensor, " touched"]
    """Whether it is known up to the side instead: the front is at right angles to it."""


def shares_of(weight: Float[Tensor, "touched 4 points"]) -> Float[Tensor, "touched 4"]:
    """Of all vertices that touch seats and tops, or backs, those that touch each part."""
    counts = weight.sum(-1)
    of_region = counts.unflatten(-1, (2, 2)).sum((0, 1))
    return counts / of_region.clamp_min(1e-9).repeat(2)


def some_touches(touches: ContactPoints, index: Int[Tensor, " few"], count: int) -> ContactPoints:
    """The evidence about the objects of this index, out of `count`."""
    row = torch.full((count,), -1).to(index)
    row[touches.object_of] = torch.arange(len(touches.object_of)).to(index)
    touched = torch.nonzero(row[index] >= 0)[:, 0]
    few = row[index[touched]]
    rest = [f.name for f in fields(touches) if f.name != "object_of"]
    return ContactPoints(touched, **{name: getattr(touches, name)[few] for name in rest})


def contact_distance(
    layout: Layout, objects: Objects, touches: ContactPoints, components: bool = False
) -> Float[Tensor, "*starts touched 4 points"]:
    """Distance from each body point to the nearest point of the part that it touches [m].

    Or, by `components`, the vertical distance to the nearest point of the top and the horizontal
    one to that of the back, if there is one. The pairing has no gradient.
    """
    real, parts = touches.weight > 0, torch.arange(4).to(touches.object_of)[:, None]
    flat = layout.yaw.new_zeros(*layout.yaw.shape[:-1], real.numel())
    for row, item in enumerate(touches.object_of.tolist()):
        t, scale = layout.t_world_object[..., item, None, :], layout.log_scale[..., item, None, :]
        turn, scale = rot_y(layout.yaw[..., item]), scale.exp()
        for k, region in enumerate((objects.top[item], objects.back[item])):
            asked = real[row] if components else real[row] & (parts % 2 == k)
            if not asked.any() or (components and k and not objects.has_back[item]):
                continue
            query = touches.points[row][asked]
            own, points = ((query - t) @ turn).detach(), (region * scale).detach()
            _, pair = nearest_points(own.nan_to_num(0, 0, 0), points.nan_to_num(0, 0, 0))
            gap = query - (region[pair] * scale) @ turn.mT - t
            if components:
                gap = gap * constant((1.0, 0.0, 1.0) if k else (0.0, 1.0, 0.0), gap)
            places = asked.flatten().nonzero()[:, 0] + row * asked.numel()
            flat = flat.index_add(-1, places, safe_norm(gap))
    return flat.unflatten(-1, real.shape)


def contact_term(
    distance: Float[Tensor, "*starts touched 4 points"],
    touches: ContactPoints,
    objects: int,
    form: Variant,
    contact: str = "mean",
) -> Float[Tensor, "*starts objects"]:
    """Mean distance of body points from the parts that they touch.

    Over all touching skin or, unless `contact` is a mean, its sum (`paper`) [m]; or over that of
    the part, bounded (`robust`) [1].
    """
    weight = touches.weight.sum(-1).clamp_min(1e-9)
    if form == "paper":
        cost = (distance * touches.weight).sum(-1)
        cost = (cost / weight * touches.share if contact == "mean" else cost).sum(-1)
    else:
        mean = (geman_mcclure(distance, CONTACT_RHO) * touches.weight).sum(-1) / weight
        cost = (mean * constant(CONTACT_SHARE, distance)).sum(-1)
        cost = cost * (touches.bodies / ENOUGH).clamp_max(1)
    return cost.new_zeros(*cost.shape[:-1], objects).index_add(-1, touches.object_of, cost)


def heading_term(layout: Layout, touches: ContactPoints) -> Float[Tensor, "*starts objects"]:
    """Seats face as their sitters, beds as people lying: 1 - cos of the angle (`robust` only).

    People on the edge of a bed sit across its long side: cos^2, whichever side it is.
    """
    yaw = layout.yaw[..., touches.object_of]
    facing = yaw.sin() * touches.heading[:, 0] + yaw.cos() * touches.heading[:, 1]
    seated = touches.heading.square().sum(-1) > 0
    off = torch.where(touches.across, facing.square(), 1 - facing)
    cost = torch.where(seated, off, torch.zeros_like(facing))
    return torch.zeros_like(layout.yaw).index_add(-1, touches.object_of, cost)


# --- Feet at rest stand on the ground -------------------------------------------------------------
#
# Each person may float or sink by one offset, which absorbs a wrong depth of the body (robust); a
# weak prior keeps the tilt that the feet cannot constrain where the first guess had it.

TILT_TAIL = 2.0  # degrees of freedom of the prior of the tilt, which forgives large changes


@record
class FootContacts:
    """Points under the feet that carry the people, from all frames."""

    points_cam: Float[Tensor, "soles 3"]  #: positions in camera axes [m]
    person: Int[Tensor, " soles"]  #: track of each point
    frame: Int[Tensor, " soles"]  #: frame of each point
    warnings: tuple[str, ...]  #: what made the evidence weaker than it should be


def up_cam(
    pitch: Float[Tensor, "*starts"], roll: Float[Tensor, "*starts"]
) -> Float[Tensor, "*starts 3"]:
    """The world's up-vector in the axes of a camera with this pitch and roll [rad]."""
    return torch.stack([-pitch.cos() * roll.sin(), -pitch.cos() * roll.cos(), pitch.sin()], -1)


def heights(
    points_cam: Float[Tensor, "soles 3"],
    R_cam_world: Float[Tensor, "*starts 3 3"],
    ground: Float[Tensor, "*starts"],
) -> Float[Tensor, "*starts soles"]:
    """Height of points above the ground, the residual of L_feet [m]."""
    return R_cam_world[..., :, 1] @ points_cam.mT - ground.unsqueeze(-1)


def feet_term(
    soles: FootContacts,
    R_cam_world: Float[Tensor, "*starts 3 3"],
    ground: Float[Tensor, "*starts"],
    offset: Float[Tensor, " soles"],
    rho: float,
) -> Float[Tensor, "*starts soles"]:
    """Cost of each sole point that is not on the ground, in [0, 1); one half at `rho` [m].

    The offset is how far each point's person floats above the floor [m].
    """
    return geman_mcclure(heights(soles.points_cam, R_cam_world, ground) - offset, rho)


def tilt_prior(
    pitch: Float[Tensor, "*starts"],
    roll: Float[Tensor, "*starts"],
    first: Float[Tensor, "2"],
    spread: float,
) -> Float[Tensor, "*starts"]:
    """Cost of leaving the first guess of pitch and roll, in nats.

    Half the squared change over `spread` where it is small; it grows only as a logarithm, because a
    guess is either a few degrees off or no guess at all (a camera that is said to be level).
    """
    squared = ((pitch - first[0]).square() + (roll - first[1]).square()) / spread**2
    return 0.5 * TILT_TAIL * (1 + squared / TILT_TAIL).log()
