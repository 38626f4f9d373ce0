r"""Terms of the energy of bodies: E_Body of `mover fit`, and the refinement in a room (Sec. 3.2).

    E_Body = Σ_t E_SMPLify-X(t) + λ_smooth L_smooth,
    E_SMPLify-X = (1000 / H)² Σ_j (w_j c_j)² ρ(π(J_j) - x_j) + E_pose + E_shape + E_hands + E_face
                  + E_bend,
    L_smooth = Σ_t ρ(|J_{t-1} + J_{t+1} - 2 J_t|; σ2) + ρ(|π(J_{t-1}) + π(J_{t+1}) - 2 π(J_t)|; σ3)

after Pavlakos et al. 2019 (SMPLify-X, Sec. 3.2 and its published configuration) and the paper;
ρ(r; σ) = σ² r² / (r² + σ²), for keypoints on each coordinate; self-collision is left out, as in the
authors' video configuration. The terms of the refinement (under, stand, sink after PROX) are in
nats. All return one value for each body; `BODY_TERMS` lists them.
"""

from typing import Any

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.core.observe import Energy
from mover.core.records import record
from mover.energy.body_contact import touch_term
from mover.energy.config import BodyWeights
from mover.energy.minimize import Term, active_weights, geman_mcclure, safe_norm, sum_terms
from mover.geometry.camera import project
from mover.geometry.volume import Volume, sample


def robust_square(
    squared: Float[Tensor, "*any"], rho: float | Float[Tensor, "*#any"]
) -> Float[Tensor, "*any"]:
    """ρ² r² / (r² + ρ²): r² near zero, ρ² far away."""
    return rho**2 * squared / (squared + rho**2)


def deviation_term(
    off: Float[Tensor, "bodies numbers"], usual: float | Float[Tensor, "*bodies numbers"] = 1.0
) -> Float[Tensor, " bodies"]:
    """Squared deviations over their usual size: of angles, coefficients and offsets."""
    return (off / usual).square().sum(-1)


def keypoint_term(
    pixels: Float[Tensor, "bodies keypoints 2"],
    seen: Float[Tensor, "bodies keypoints 2"],
    weight: Float[Tensor, "bodies keypoints"],
    rho: float,
) -> Float[Tensor, " bodies"]:
    """Robust squared distances of projected keypoints from detected ones [px²]."""
    cost = robust_square((pixels - seen).square(), rho).sum(-1)
    return (cost * weight.square()).sum(-1)


# --- Near to what was given: the prior of the refinement -----------------------------------------
#
# Half the squared change over its usual size, in nats: of the joints' angles, of the depth, and of
# the position in the image (robust, in metres at the body's depth), but for the size there. The
# paper fits the pose to the image again (SMPLify-X's terms); here the first fit is the datum, so
# that bodies of any source, meshes too, can be refined.

ANGLE = 0.09  # [rad], 5 degrees: usual error of a joint
BIAS = 0.03  # usual error of a person's depth in all frames, as a share
DRIFT = 0.012  # usual error that changes, as a share
IMAGE_USUAL = 0.03  # [m], usual error of a joint across the ray
IMAGE_LOST = 0.15  # [m], an error across the ray that is down-weighted
IMAGE_POINTS = 3.0  # joints whose places are independent: a body that is off is off as a whole
NEAR = 0.1  # [m], nearer no depth is taken to be


def depth_share(
    points_cam: Float[Tensor, "bodies 3"], start_cam: Float[Tensor, "bodies 3"]
) -> Float[Tensor, " bodies"]:
    """Logarithm of the factor by which a body's depth has changed."""
    here, there = (x[:, 2].clamp_min(NEAR) for x in (points_cam, start_cam))
    return (here / there).log()


def range_term(
    share: Float[Tensor, " bodies"], track: Int[Tensor, " bodies"]
) -> Float[Tensor, " bodies"]:
    """Cost of a change of depth: one error that a person keeps, and one that drifts about it.

    So what a seat says about a sitter's depth holds for the same person's way through the room.
    `share` is `depth_share`, `track` the number of each body's person, from 0.
    """
    tracks = int(track.max()) + 1 if len(track) else 0
    count = share.new_zeros(tracks).index_add(0, track, torch.ones_like(share))
    mean = share.new_zeros(tracks).index_add(0, track, share) / count.clamp_min(1)
    kept = (mean / BIAS).square()[track] / count[track]
    return 0.5 * (kept + ((share - mean[track]) / DRIFT).square())


def image_term(
    points_cam: Float[Tensor, "bodies points 3"], start_cam: Float[Tensor, "bodies points 3"]
) -> Float[Tensor, " bodies"]:
    """Cost of leaving the pixels where the joints were seen.

    A body that moves along the ray of its pelvis costs nothing for its size in the image: its size
    is known no better than its depth, in all frames. Both have joints in camera axes, as they are
    and as they were given, the pelvis first [m].
    """
    here, there = points_cam[..., :2], start_cam[..., :2]
    farther = points_cam[:, :1, 2:].clamp_min(NEAR) / start_cam[:, :1, 2:].clamp_min(NEAR)
    along = (farther - 1) * there[:, :1]
    z, now = (x[..., 2:].clamp_min(NEAR) for x in (start_cam, points_cam))
    leans = now - start_cam[:, :1, 2:].clamp_min(NEAR) * (farther - 1)
    off = ((here - along) / leans.clamp_min(NEAR) - there / z) * z
    robust = geman_mcclure(off.square().sum(-1).add(1e-12).sqrt(), IMAGE_LOST)
    return 0.5 * IMAGE_POINTS * (IMAGE_LOST / IMAGE_USUAL) ** 2 * robust.mean(-1)


# --- Time: people move smoothly, and errors last -------------------------------------------------
#
# Rows of one track at most a second apart. Second differences are taken over real time (paper: at
# the video's rate), so that gaps and frame rates make no acceleration. A fit divides those of 3D
# joints by the size of the body: most of them is noise of the keypoints, which is longer in metres
# the larger and the farther the body is estimated.

GAP = 1.0  # [s], longer nothing is known about the way between two frames
TREMBLE = 0.02  # [m], second difference of a body that is fitted frame by frame
PUSH = 1.5  # [m/s²], usual acceleration of a joint
SMOOTH_TAIL = 3.0  # usual residuals at which the cost is half of the most
ANGLE_LASTS = 0.6  # [s]
DEPTH = 0.015  # usual error of the depth that changes with time, as a share
DEPTH_LASTS = 1.0  # [s]
FRESH = 0.003  # share of the depth's error that is new in each frame
SLIP = 0.02  # [m], usual way of a sole at rest in a fit
SMOOTH_POINTS = 8.0  # joints whose ways are independent, of all of them
SIGMA_JOINTS = 0.1  # sigma_2 of the paper [m]
SIGMA_PIXELS = 100.0  # sigma_3 of the paper [px]
SIGMA_HELD = 0.25  # of limbs about the pelvis, in sizes of the body


@record
class Neighbours:
    """Which rows follow each other in time."""

    triples: Int[Tensor, "triples 3"]  #: rows before, at and after a moment
    steps: Float[Tensor, "triples 2"]  #: time from the first to the second and to the third [s]
    pairs: Int[Tensor, "pairs 2"]  #: rows that follow each other
    gaps: Float[Tensor, " pairs"]  #: time between them [s]
    track: Int[Tensor, " rows"]  #: number of each row's person, from 0


def gather_neighbours(
    frame: Int[Tensor, " bodies"], person: Int[Tensor, " bodies"], fps: float | None
) -> Neighbours:
    """Rows of the same track that follow each other within a second; none of unordered images."""
    order = torch.argsort(frame, stable=True)
    order = order[torch.argsort(person[order], stable=True)]
    pairs = torch.stack([order[:-1], order[1:]], 1)
    gaps = frame[pairs].double().diff(dim=1)[:, 0] / (fps or 1.0)
    same = (person[pairs[:, 0]] == person[pairs[:, 1]]) & (gaps > 0) & (gaps <= GAP)
    follows = same if fps is not None else torch.zeros_like(same)
    both = follows[:-1] & follows[1:]
    triples = torch.cat([pairs[:-1], pairs[1:, 1:]], 1)[both]
    steps = torch.stack([gaps[:-1], gaps[1:]], 1)[both]
    track = person.unique(return_inverse=True)[1]
    return Neighbours(triples, steps, pairs[follows], gaps[follows], track)


def second_difference(
    values: Float[Tensor, "bodies points axes"], near: Neighbours
) -> Float[Tensor, "triples points axes"]:
    """Twice the distance from the straight line through the neighbours, at their real times."""
    before, now, after = (values[near.triples[:, k]] for k in range(3))
    share = (near.steps[:, 1] / near.steps.sum(1)).to(values)[:, None, None]
    return 2 * (share * before + (1 - share) * after - now)


def motion_term(
    points: Float[Tensor, "bodies points axes"],
    near: Neighbours,
    usual: Float[Tensor, "triples some"],
    tail: float | Float[Tensor, "triples some"] | None = None,
) -> Float[Tensor, " bodies"]:
    """Squared second differences of points over usual ones, added to the rows in their middle.

    They are robust beyond `tail` where it is given.
    """
    squared = second_difference(points, near).square().sum(-1)
    cost = squared if tail is None else robust_square(squared, tail)
    return _per_row((cost / usual.square()).sum(-1), near.triples[:, 1], len(near.track))


def smooth_term(
    points: Float[Tensor, "bodies points 3"], near: Neighbours
) -> Float[Tensor, " bodies"]:
    """Cost of points that are off the straight way between their neighbours in time [nats]."""
    usual = (TREMBLE + PUSH * near.steps.prod(1, keepdim=True)).to(points)
    share = 0.5 * SMOOTH_POINTS / points.shape[1]
    return share * motion_term(points, near, usual, SMOOTH_TAIL * usual)


def steady_term(
    angles: Float[Tensor, "bodies angles"], share: Float[Tensor, " bodies"], near: Neighbours
) -> Float[Tensor, " bodies"]:
    """Cost of changes of angles [rad] and of depth that come and go [nats]."""
    i, j = near.pairs.unbind(-1)
    gaps = near.gaps.to(angles)
    turned = (angles[j] - angles[i]).square().sum(-1) / (ANGLE**2 * _fresh(gaps, ANGLE_LASTS))
    moved = (share[j] - share[i]).square()
    moved = moved / (DEPTH**2 * _fresh(gaps, DEPTH_LASTS) + FRESH**2)
    return _per_row(0.5 * (turned + moved), j, len(near.track))


def lock_term(
    soles: Float[Tensor, "bodies feet 3"], rest: Float[Tensor, "bodies feet"], near: Neighbours
) -> Float[Tensor, " bodies"]:
    """Cost of soles at rest (a chance) that slide between rows that follow each other [nats]."""
    i, j = near.pairs.unbind(-1)
    slip = geman_mcclure(safe_norm(soles[j] - soles[i]) / SLIP, SMOOTH_TAIL)
    both = rest[i] * rest[j]
    return _per_row(0.5 * SMOOTH_TAIL**2 * (both * slip).sum(-1), j, len(near.track))


def _fresh(gaps: Float[Tensor, " pairs"], lasts: float) -> Float[Tensor, " pairs"]:
    """Variance of what is new after so long, of an error of variance one."""
    return 2 * (1 - (-gaps / lasts).exp())


def _per_row(cost: Float[Tensor, " items"], row: Int[Tensor, " items"], rows: int) -> Tensor:
    return cost.new_zeros(rows).index_add(0, row, cost)


# --- Room: bodies do not sink into it, and feet stand on its floor -------------------------------
#
# The paper sums the depths of all vertices. Here a squared cost up to 2 cm, because skin and
# cushions give way, and a linear one beyond; and points of the skin share one body's weight, so
# that the resolution of the mesh has none.

SOFT = 0.02  # [m], as far skin gives way
SKIN_POINTS = 80.0  # places of the skin that count, of all that are looked at
FEW = 8  # deepest points of the skin that the floor holds: it does not give way as cushions do
DEEPEST = 8.0  # independent places among them
FEET = 4.0  # independent heights of a sole
STAND_TAIL = 5.0  # times `SOFT`, from where on a sole is down-weighted


def sink_term(
    skin: Float[Tensor, "bodies points 3"], furniture: Volume
) -> Float[Tensor, " bodies"]:
    """Cost of the skin's depth inside furniture [nats]."""
    return _dent((-sample(furniture, skin)).clamp_min(0))


def under_term(skin: Float[Tensor, "bodies points 3"], floor: float) -> Float[Tensor, " bodies"]:
    """Cost of the skin's depth below the floor, whose height is given [nats]."""
    depth = (floor - skin[..., 1]).clamp_min(0)
    return DEEPEST * _dent(depth.topk(min(FEW, depth.shape[-1]), -1).values) / SKIN_POINTS


def stand_term(
    soles: Float[Tensor, "bodies feet 3"], rest: Float[Tensor, "bodies feet"], floor: float
) -> Float[Tensor, " bodies"]:
    """Cost of the lowest places of feet at rest (a chance) that are not on the floor [nats]."""
    off = geman_mcclure((soles[..., 1] - floor) / SOFT, STAND_TAIL)
    return 0.5 * FEET * STAND_TAIL**2 * (rest * off).sum(-1)


def support_term(
    points: Float[Tensor, "bodies points 3"], up: Float[Tensor, "3"], level: float | Tensor
) -> Float[Tensor, " bodies"]:
    """Squared depth of points under a floor of this height along `up` [m²]; of a fit."""
    return (level - points @ up).clamp_min(0).square().sum(-1)


def _dent(depth: Float[Tensor, "bodies points"]) -> Float[Tensor, " bodies"]:
    """Squared up to `SOFT`, linear beyond (Huber)."""
    share = depth / SOFT
    cost = torch.where(share < 1, 0.5 * share.square(), share - 0.5)
    return SKIN_POINTS * cost.mean(-1)


# --- Depth order: who hides whom bounds the depth of people --------------------------------------
#
# The furniture of the estimated room is drawn once. Skin that faces the camera and is seen (inside
# the person's visible mask) before an object is not farther than its front; skin that an object
# hides (inside its mask, outside of all people) is not nearer than its front. The refinement of the
# paper does not name this term.

ORDER_MARGIN = 0.03  # [m], outlines and fronts are not known better
ORDER_MOST = 0.5  # [m], beyond, something else is wrong
ORDER_USUAL = 0.05  # [m]
ORDER_POINTS = 20.0  # independent places of a body's skin


@record
class Bounds:
    """How near and far skin points may be."""

    near: Float[Tensor, "bodies points"]  #: depth that hidden skin has at least [m]; -inf: no bound
    far: Float[Tensor, "bodies points"]  #: depth that visible skin has at most [m]; inf: no bound


@record
class Sighting:
    """What is seen where skin points are projected."""

    front: Float[Tensor, "bodies points"]  #: depth of the nearest furniture there [m]; inf: none
    shown: Bool[Tensor, "bodies points"]  #: well inside the person's visible mask
    hidden: Bool[Tensor, "bodies points"]
    """Well outside the masks of people, inside the mask of the furniture that is drawn there."""
    facing: Bool[Tensor, "bodies points"]  #: the skin faces the camera
    loose: Float[Tensor, "bodies points"]
    """Uncertainty of the depth of that furniture along the ray, from that of its shape [m]."""


def bounds_of_skin(seen: Sighting) -> Bounds:
    """Bounds for the depth of the skin; of one body, only what the larger region says."""
    real = seen.front.isfinite() & seen.facing
    shown, hidden = seen.shown & real, seen.hidden & real
    more = (shown.sum(-1) - hidden.sum(-1))[:, None]
    none = torch.full_like(seen.front, torch.inf)
    far = torch.where(shown & (more > 0), seen.front + seen.loose, none)
    return Bounds(torch.where(hidden & (more < 0), seen.front - seen.loose, -none), far)


def order_term(depth: Float[Tensor, "bodies points"], bounds: Bounds) -> Float[Tensor, " bodies"]:
    """Cost of skin in front of furniture that hides it or behind furniture that it hides [nats]."""
    known = bounds.near.isfinite() | bounds.far.isfinite()
    none = torch.zeros_like(depth)
    near = torch.where(bounds.near.isfinite(), bounds.near - ORDER_MARGIN - depth, none)
    far = torch.where(bounds.far.isfinite(), depth - bounds.far - ORDER_MARGIN, none)
    out = (near.clamp(0, ORDER_MOST) + far.clamp(0, ORDER_MOST)) / ORDER_USUAL
    cost = torch.where(out < 1, 0.5 * out.square(), out - 0.5)
    return ORDER_POINTS * cost.sum(-1) / known.sum(-1).clamp_min(ORDER_POINTS)


# --- Outlines: the outline of a body lies on that of its mask ------------------------------------
#
# Points of the drawn body's outline where nothing else can end the person's mask; for each the skin
# next to it, the outline's normal, and how far the mask's outline is from it. Points of one body
# share a weight. A mask that is too wide all around says nothing: that much is taken out of the
# distances. Not in the paper, whose refinement of bodies knows keypoints only.

OUTLINE_BORDER = 0.0025  # [image widths], usual error of an outline that is not the same all around
OUTLINE_TAIL = 3.0  # usual errors at which the cost is half of the most
OUTLINE_POINTS = 16.0  # independent places of an outline


@record
class Outline:
    """Where the outlines of bodies should go, seen from where they are."""

    body: Int[Tensor, " points"]
    skin: Int[Tensor, " points"]  #: index of the skin point that carries the outline
    pixel: Float[Tensor, "points 2"]  #: where that skin point is seen now [px]
    normal: Float[Tensor, "points 2"]  #: of the outline in the image, outwards
    gap: Float[Tensor, " points"]  #: how far the outline is outside its mask [px]; negative: inside
    weight: Float[Tensor, " points"]  #: share in the body's weight, at most `OUTLINE_POINTS` in sum


def outline_term(
    skin_cam: Float[Tensor, "bodies points 3"],
    outline: Outline,
    K: Float[Tensor, "3 3"],
    width: int,
) -> Float[Tensor, " bodies"]:
    """Cost of outlines (of skin in camera axes) that leave the outlines of the masks [nats]."""
    here = project(skin_cam[outline.body, outline.skin], K)
    off = ((here - outline.pixel) * outline.normal).sum(-1) + outline.gap
    robust = geman_mcclure(off / (OUTLINE_BORDER * width), OUTLINE_TAIL)
    cost = 0.5 * OUTLINE_TAIL**2 * outline.weight * robust
    return skin_cam.new_zeros(len(skin_cam)).index_add(0, outline.body, cost)


# --- One energy of bodies, for `mover fit` and `mover refine`: weights and evidence differ --------

STEP = 0.1  # [m], feet that are higher are not on the floor
FALLING = 0.3  # [m], a centre of mass farther out is held by something else


BODY_TERMS: tuple[Term[Any], ...] = (
    # E_Body, of bodies that are fitted to keypoints; in camera axes
    Term("keypoints", lambda b: keypoint_term(b.pixels, b.seen.pixels, b.seen.weight, b.rho),
         ("pixels",)),
    Term("smooth_joints", lambda b: motion_term(
        b.sized, b.motion.near, b.motion.expected[:, None], SIGMA_JOINTS), ("motion",)),
    Term("smooth_pixels", lambda b: motion_term(
        b.pixels, b.motion.near, 1 / b.weight_between, SIGMA_PIXELS), ("motion",)),
    # A body along the view; not robust, since a single frame is off by a metre.
    Term("still", lambda b: motion_term(b.sized[:, :1], b.motion.near, b.motion.calm[:, :1]),
         ("motion",)),
    # Single frames hardly constrain the depth of an arm, either.
    Term("held", lambda b: motion_term(
        b.sized[:, b.upper] - b.sized[:, :1], b.motion.near, b.motion.calm[:, b.upper],
        SIGMA_HELD), ("motion",)),
    Term("support", lambda b: support_term(
        torch.cat([b.points.joints, b.points.keypoints], 1), *b.plane), ("plane",)),
    Term("stands", lambda b: robust_square(b.sole_height.square(), STEP), ("free_floor",)),
    Term("balance", lambda b: b.seen.standing * robust_square(b.falling, FALLING),
         ("free_floor", "standing")),
    Term("level", lambda b: b.slope, ("free_floor",)),
    Term("lies", lambda b: b.away_from_lying.square(), ("about",)),
    Term("pose", lambda b: deviation_term(*b.off_pose), ("pixels",)),
    Term("limits", lambda b: deviation_term(b.excess), ("pixels",)),
    Term("bending", lambda b: b.bent.exp().square().sum(-1), ("pixels",)),
    Term("shape", lambda b: b.shape, ("pixels",)),
    Term("height", lambda b: b.off_height, ("stature",)),
    Term("offset", lambda b: deviation_term(
        b.at.offset.flatten(1), b.seen.lasting.repeat_interleave(3))[b.frame.person] / b.same,
        ("lasting",)),
    Term("hands", lambda b: deviation_term(b.at.hands), ("hands",)),
    Term("jaw", lambda b: (
        deviation_term(b.at.face[:, :1]) + 100 * deviation_term(b.at.face[:, 1:3])), ("face",)),
    Term("expression", lambda b: deviation_term(b.at.face[:, 3:]), ("face",)),
    # The refinement of given bodies in a room; in its world
    Term("angles", lambda b: 0.5 * deviation_term(b.angles, ANGLE), ("given",)),
    Term("image", lambda b: image_term(b.points_cam, b.start_cam), ("given",)),
    Term("range", lambda b: range_term(b.share, b.known.near.track), ("given",)),
    Term("smooth", lambda b: smooth_term(b.now.points, b.known.near), ("given",)),
    Term("steady", lambda b: steady_term(b.angles, b.share, b.known.near), ("given",)),
    Term("under", lambda b: under_term(b.even, b.known.floor), ("given",)),
    Term("stand", lambda b: stand_term(b.feet[1], b.known.rest, b.known.floor), ("feet",)),
    Term("lock", lambda b: lock_term(b.feet[0], b.known.rest, b.known.near), ("feet",)),
    Term("sink", lambda b: sink_term(b.even, b.known.furniture), ("furniture",)),
    Term("touch", lambda b: touch_term(b.now.skin, b.known.matches, b.known.rho), ("matches",)),
    Term("order", lambda b: order_term(b.in_camera(b.even)[..., 2], b.known.bounds), ("bounds",)),
    Term("outline", lambda b: outline_term(
        b.in_camera(b.now.skin), b.known.outline, b.known.camera.K, b.known.camera.width),
        ("outline",)),
)  # fmt: skip
"""All terms of the energy of bodies; a new one is a function, a weight and a row."""


def body_energy(state: Any, weights: BodyWeights) -> Energy:  # noqa: ANN401
    """The cost of bodies, one value each; terms whose evidence `state.has` not are left out."""
    return sum_terms(active_weights(weights, BODY_TERMS, state.has), BODY_TERMS, state)
