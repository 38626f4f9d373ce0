"""Straight lines of a picture, and the camera under which they run along the axes of a room.

Not in the paper. In a room most edges are vertical or run along one of two horizontal directions
at right angles, so that their pictures meet in three vanishing points, which give the focal length
and the attitude of the camera (Kosecka and Zhang, ECCV 2002). Line segments are those of von Gioi
et al. (LSD, PAMI 2010), as OpenCV finds them. Each belongs to one of the three directions or to
none, with the chances of both (expectation-maximisation). Furniture has right angles of its own,
but may be turned away from the room: the edges on each object have their own heading, and count
as one observation of that object's right angles, however many they are. From every heading a
descent begins, and all their ends are kept: two that fit equally well say that the picture is
ambiguous.
"""

from dataclasses import replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.core.records import map_tensors, record
from mover.geometry.rotations import axis_angle, rot_y, wrap

MOST = 400  # the longest segments
FINE, SURE = (0.02, 0.3), (0.04, 0.5)
"""Of the picture's diagonal, shorter segments are left out; [px], by which their ends are off: what
is best where a lens was guessed, and what may contradict a lens of which nothing is said."""
BENT = 0.001  # [rad] edges are not straighter and not more parallel than that
FREE = 0.5  # share of segments that belong to no direction
ALONG, ASIDE = 0.05, 0.02  # [rad], of the width: segments that are one edge, or its two sides
COARSE = (5.0, 2.0, 1.0)  # times the errors, one descent after the other
STEPS = 12
HEADINGS = 12  # over a quarter turn
ALIGNED = 0.5  # share of furniture that is meant to stand along the axes of the room
ASKEW = 0.02  # [rad] by which that misses them
SHAPE = 0.002  # [rad] by which the right angles of an object, and of a room, are none
NEAR = 0.005  # of the picture's width: edges so near to a mask are those of its object
SAME = 0.003  # ends that differ by less are one


@record
class Segments:
    """Line segments, from the principal point."""

    middle: Float[Tensor, "lines 2"]
    """[px]"""
    along: Float[Tensor, "lines 2"]
    """Unit vectors."""
    error: Float[Tensor, " lines"]
    """Of the angle [rad]."""
    vote: Float[Tensor, " lines"]
    """How much it counts: segments that are one edge share one vote."""
    group: Int[Tensor, " lines"]
    """The object on which it lies, counted from 1; 0: none."""


@record
class RoomPose:
    """Cameras in the axes of a room."""

    log_focal: Float[Tensor, " starts"]
    R_cam_room: Float[Tensor, "starts 3 3"]
    """Columns: a horizontal direction, up, and the other one."""
    askew: Float[Tensor, "starts groups"]
    """How far the edges of each group are turned away from the room about its vertical [rad]."""


@record
class Prior:
    """What is known of the camera before a line is seen."""

    log_focal: float
    focal_spread: float
    up: Float[Tensor, "3"]
    """In camera axes, under this focal length."""
    up_spread: float
    """[rad]"""
    up_is_plane: bool = False
    """Whether `up` is the normal of a floor under people: as many times longer the lens is, as many
    times farther are they, and so less steep is the floor."""


@record
class Ends:
    """Where the descents ended, the best first; similar ends are one."""

    pose: RoomPose
    cost: Float[Tensor, " starts"]
    """Minus the logarithm of the posterior density."""
    precision: Float[Tensor, "starts 4 4"]
    """Of logarithm of the focal length and rotation vector in camera axes, over all headings of
    objects."""


def find_segments(
    picture: Float[Tensor, "h w 3"],
    hidden: Bool[Tensor, "h w"] | None,
    centre: Float[Tensor, "2"],
    fineness: tuple[float, float] = FINE,
    masks: Bool[Tensor, "objects h w"] | None = None,
) -> Segments:
    """The longest straight edges of a picture.

    Args:
        picture: In [0, 1].
        hidden: What is no room: segments with their middle there are left out.
        centre: The principal point [px].
        fineness: `FINE` or `SURE`.
        masks: Objects, each with right angles of its own.
    """
    import cv2  # here: it takes a tenth of a second, and only this needs it

    shortest, end = fineness
    grey = (picture.mean(-1) * 255).round().to(torch.uint8).cpu().numpy()
    found: Any = cv2.createLineSegmentDetector(cv2.LSD_REFINE_STD).detect(grey)[0]
    ends = np.zeros((0, 4)) if found is None else np.asarray(found, np.float64)
    lines = torch.from_numpy(ends).reshape(-1, 2, 2) + 0.5  # pixel centres are at halves
    length = (lines[:, 1] - lines[:, 0]).norm(dim=-1)
    keep = length > shortest * float(np.hypot(*grey.shape))
    if hidden is not None:
        x, y = lines.mean(1).long().unbind(-1)
        keep &= ~hidden[y.clamp(0, grey.shape[0] - 1), x.clamp(0, grey.shape[1] - 1)].cpu()
    rows = keep.nonzero()[:, 0]
    rows = rows[length[rows].argsort(descending=True, stable=True)[:MOST]]
    lines, length = lines[rows], length[rows]
    middle = lines.mean(1)
    along = (lines[:, 1] - lines[:, 0]) / length[:, None]
    error = ((2 * end / length).square() + BENT**2).sqrt()
    vote = 1 / _sides(middle, along, length, ASIDE * grey.shape[1])
    group = torch.zeros(len(lines), dtype=torch.long)
    if masks is not None and len(masks):
        group = _groups(lines, masks, NEAR * grey.shape[1])
    return Segments(middle - centre.double().cpu(), along, error, vote, group)


def _groups(
    lines: Float[Tensor, "lines 2 2"], masks: Bool[Tensor, "objects h w"], aside: float
) -> Int[Tensor, " lines"]:
    """The object on or beside whose mask most of a segment lies, counted from 1; 0: none."""
    size = torch.tensor(masks.shape[1:]).flip(0) - 1
    share = torch.tensor([0.1, 0.3, 0.5, 0.7, 0.9], dtype=torch.float64)[:, None]
    points = lines[:, :1] + share * (lines[:, 1:] - lines[:, :1])
    way = torch.nn.functional.normalize(lines[:, 1] - lines[:, 0], dim=-1)
    normal = torch.stack([-way[:, 1], way[:, 0]], -1)[:, None]
    on = torch.zeros(len(masks), len(lines), len(share), dtype=torch.bool)
    for side in (-aside, 0.0, aside):
        x, y = (points + side * normal).long().clamp_min(0).minimum(size).unbind(-1)
        on |= masks[:, y, x].cpu()
    most, index = on.sum(-1).max(0)
    return torch.where(most > len(share) / 2, index + 1, 0)


def _sides(
    middle: Float[Tensor, "lines 2"],
    along: Float[Tensor, "lines 2"],
    length: Float[Tensor, " lines"],
    aside: float,
) -> Float[Tensor, " lines"]:
    """How many segments are the same edge, or another side of it."""
    gap = middle[None] - middle[:, None]
    off = (gap[..., 0] * along[:, None, 1] - gap[..., 1] * along[:, None, 0]).abs()
    ahead = (gap * along[:, None]).sum(-1).abs()
    parallel = (along @ along.mT).abs() > np.cos(ALONG)
    near = parallel & (off < aside) & (ahead < (length[None] + length[:, None]) / 2)
    return near.sum(1).clamp_min(1).double()


def fit_room(segments: Segments, prior: Prior, R_cam_world: Float[Tensor, "3 3"]) -> Ends:
    """The cameras under which the segments run along three directions at right angles.

    The headings of the room are sought from the first guess `R_cam_world`.
    """
    heading = torch.arange(HEADINGS, dtype=torch.float64) * (torch.pi / 2 / HEADINGS)
    R = R_cam_world.double().cpu() @ rot_y(heading)
    focal = torch.full((HEADINGS,), prior.log_focal, dtype=torch.float64)
    groups = int(segments.group.max()) + 1 if len(segments.group) else 1
    none = torch.zeros(HEADINGS, groups, dtype=torch.float64)
    segments = counted_once(segments)
    return fit_from(segments, prior, _turned(segments, RoomPose(focal, R, none)))


def fit_from(segments: Segments, prior: Prior, pose: RoomPose) -> Ends:
    """The same from other starts, with votes as `counted_once` gives them."""
    for coarse in COARSE:
        pose = _descend(segments, prior, pose, coarse)
    cost, _, precision = _quadratic(segments, prior, pose, COARSE[-1])
    chosen: list[int] = []
    for k in cost.argsort(stable=True).tolist():
        if all(_apart(pose, k, other) > SAME for other in chosen):
            chosen.append(k)
    rows = torch.tensor(chosen)
    common = torch.linalg.inv(torch.linalg.inv(precision[rows])[:, :4, :4])
    return Ends(map_tensors(lambda x: x[rows], pose), cost[rows], common)


def counted_once(segments: Segments) -> Segments:
    """The segments with smaller votes: those of an object share the error of its right angles."""
    known = segments.vote / segments.error.square() / 3  # by each of the three directions
    same = (segments.group[:, None] == segments.group) & (segments.group > 0)
    return replace(segments, vote=segments.vote / (1 + SHAPE**2 * (same.to(known) @ known)))


def _turned(segments: Segments, pose: RoomPose) -> RoomPose:
    """The best heading of each group under each camera, of all over a quarter turn."""
    tried = torch.arange(2 * HEADINGS, dtype=torch.float64) * (torch.pi / 4 / HEADINGS)
    none = torch.zeros_like(pose.askew)
    costs: list[Tensor] = []
    for turn in tried:
        angle = sines(segments, replace(pose, askew=none + turn))
        total, _ = _likelihood(segments, angle, COARSE[0])
        cost = none.index_add(1, segments.group, -segments.vote * total.log())
        costs.append(cost + _off_axes(none + turn)[0])
    askew = tried[torch.stack(costs).argmin(0)]
    askew[:, 0] = 0
    return replace(pose, askew=wrap(4 * askew) / 4)


def _apart(pose: RoomPose, one: int, other: int) -> float:
    """How far two cameras differ, quarter turns aside: [rad], or of the focal length."""
    between = (pose.R_cam_room[one].mT @ pose.R_cam_room[other]).abs()
    turn = 1 - float(between.amax(1).amin())
    zoom = abs(float(pose.log_focal[one] - pose.log_focal[other]))
    return max(zoom, (2 * max(turn, 0.0)) ** 0.5)


def _descend(segments: Segments, prior: Prior, pose: RoomPose, coarse: float) -> RoomPose:
    """Levenberg and Marquardt's steps, each under the chances of the one before."""
    damping = torch.full_like(pose.log_focal, 1e-3)
    cost, gradient, hessian = _quadratic(segments, prior, pose, coarse)
    for _ in range(STEPS):
        damped = hessian + damping[:, None, None] * torch.diag_embed(hessian.diagonal(0, 1, 2))
        step = -torch.linalg.solve(damped, gradient)
        turned = axis_angle(step[:, 1:4]) @ pose.R_cam_room
        new = RoomPose(pose.log_focal + step[:, 0], turned, pose.askew + step[:, 4:])
        after = _quadratic(segments, prior, new, coarse)
        better = after[0] < cost
        damping = torch.where(better, damping / 5, damping * 5)
        pose = RoomPose(
            torch.where(better, new.log_focal, pose.log_focal),
            torch.where(better[:, None, None], new.R_cam_room, pose.R_cam_room),
            torch.where(better[:, None], new.askew, pose.askew),
        )
        cost = torch.where(better, after[0], cost)
        gradient = torch.where(better[:, None], after[1], gradient)
        hessian = torch.where(better[:, None, None], after[2], hessian)
    return pose


def _likelihood(
    segments: Segments, angle: Float[Tensor, "starts 3 lines"], coarse: float
) -> tuple[Float[Tensor, "starts lines"], Float[Tensor, "starts 3 lines"]]:
    """Density of each segment's angle, and the part of each direction."""
    sigma = coarse * segments.error
    e = angle / sigma
    within = (1 - FREE) / 3 * (-0.5 * e.square()).exp() / (sigma * (2 * torch.pi) ** 0.5)
    return within.sum(1) + FREE / torch.pi, within


def _off_axes(
    askew: Float[Tensor, "*batch"],
) -> tuple[Float[Tensor, "*batch"], Float[Tensor, "*batch"], Float[Tensor, "*batch"]]:
    """Cost of headings that are not the room's, gradient and curvature."""
    off = wrap(4 * askew) / 4
    near = ALIGNED * (-0.5 * (off / ASKEW).square()).exp() / (ASKEW * (2 * torch.pi) ** 0.5)
    total = near + (1 - ALIGNED) * 2 / torch.pi
    weight = near / total / ASKEW**2
    return -total.log(), weight * off, weight


def _quadratic(
    segments: Segments, prior: Prior, pose: RoomPose, coarse: float
) -> tuple[
    Float[Tensor, " starts"],
    Float[Tensor, "starts unknowns"],
    Float[Tensor, "starts unknowns unknowns"],
]:
    """Cost, gradient and Gauss and Newton's matrix.

    The unknowns are the logarithm of the focal length, the rotation vector, and the heading of
    each group.
    """
    angle, each = sines_and_slopes(segments, pose)
    total, within = _likelihood(segments, angle, coarse)
    weight = segments.vote * within / total[:, None] / (coarse * segments.error).square()
    groups = torch.nn.functional.one_hot(segments.group, pose.askew.shape[1]).to(angle)
    groups[:, 0] = 0  # the room itself has the heading of the room
    slope = torch.cat([each[..., :4], each[..., 4:] * groups], -1)
    slope = slope.flatten(1, 2)
    weighted = slope.mT * weight.flatten(1)[:, None]
    gradient = (weighted @ angle.reshape(len(angle), -1, 1))[..., 0]
    hessian = weighted @ slope
    zoom = pose.log_focal - prior.log_focal
    lean, change = _lean(prior, pose)
    tight = prior.up_spread**-2
    off, pull, held = _off_axes(pose.askew)
    cost = 0.5 * (zoom / prior.focal_spread).square()
    cost = cost + 0.5 * tight * lean.square().sum(-1) + off[:, 1:].sum(-1)
    gradient[:, 0] += zoom / prior.focal_spread**2
    gradient[:, :4] += tight * torch.einsum("spi,si->sp", change, lean)
    gradient[:, 5:] += pull[:, 1:]
    hessian[:, 0, 0] += prior.focal_spread**-2
    hessian[:, :4, :4] += tight * change @ change.mT
    hessian[:, 4:, 4:] += torch.diag_embed(held)
    hessian += 1e-9 * torch.eye(hessian.shape[-1], dtype=zoom.dtype)
    return cost - (segments.vote * total.log()).sum(-1), gradient, hessian


def _lean(
    prior: Prior, pose: RoomPose
) -> tuple[Float[Tensor, "starts 3"], Float[Tensor, "starts 4 3"]]:
    """How far up is from where it was said to be, and its slope in the four unknowns."""
    up = pose.R_cam_room[:, :, 1]
    said, change = prior.up.to(up).expand(len(up), 3).clone(), torch.zeros_like(up)
    if prior.up_is_plane:
        said[:, 2] *= (prior.log_focal - pose.log_focal).exp()
        change[:, 2] = -said[:, 2]
    length = said.norm(dim=-1, keepdim=True)
    said = said / length
    steeper = (change - (change * said).sum(-1, keepdim=True) * said) / length
    turn = torch.linalg.cross(torch.eye(3, dtype=up.dtype).expand(len(up), 3, 3), up[:, None])
    return up - said, torch.cat([-steeper[:, None], turn], 1)


def sines(segments: Segments, pose: RoomPose) -> Float[Tensor, "starts 3 lines"]:
    """Sine of the angle between each segment and the way to each vanishing point."""
    return sines_and_slopes(segments, pose)[0]


def sines_and_slopes(
    segments: Segments, pose: RoomPose
) -> tuple[Float[Tensor, "starts 3 lines"], Float[Tensor, "starts 3 lines unknowns"]]:
    """`sines`, and their slopes by the unknowns of each segment.

    These are the logarithm of the focal length, the rotation vector, and the heading of its group.
    """
    f = pose.log_focal.exp()[:, None, None, None]
    m, d = segments.middle, segments.along
    turned = rot_y(pose.askew)[:, segments.group]
    v = (pose.R_cam_room[:, None] @ turned).permute(0, 3, 1, 2)  # starts, directions, lines, xyz
    q = f * v[..., :2] - m * v[..., 2:]
    norm = q.square().sum(-1).clamp_min(1e-9).sqrt()
    across = torch.stack([-d[:, 1], d[:, 0]], -1)
    sine = (across * q).sum(-1) / norm
    by_q = (across - (sine / norm)[..., None] * q) / norm[..., None]
    up = pose.R_cam_room[:, None, None, :, 1]
    axes = [*torch.eye(3).to(v), up]
    turns = [torch.linalg.cross(axis.expand_as(v), v) for axis in axes]
    changes = [f * v[..., :2], *(f * t[..., :2] - m * t[..., 2:] for t in turns)]
    return sine, torch.stack([(by_q * change).sum(-1) for change in changes], -1)
