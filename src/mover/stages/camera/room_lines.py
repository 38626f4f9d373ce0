"""Straight lines of a picture, and the camera under which they run along the axes of a room.

Not in the paper. In a room most edges are vertical or run along one of two horizontal directions
at right angles, so that their pictures meet in three vanishing points, which give the focal length
and the attitude of the camera (Kosecka and Zhang, ECCV 2002). Line segments are those of von Gioi
et al. (LSD, PAMI 2010), as OpenCV finds them. Each belongs to one of the three directions or to
none, with the chances of both (expectation-maximisation); from every heading a descent begins, and
all their ends are kept: two that fit equally well say that the picture is ambiguous.
"""

from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mover.core.records import record
from mover.geometry.rotations import axis_angle, rot_y

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


@record
class RoomPose:
    """Cameras in the axes of a room."""

    log_focal: Float[Tensor, " starts"]
    R_cam_room: Float[Tensor, "starts 3 3"]
    """Columns: a horizontal direction, up, and the other one."""


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
    """Of logarithm of the focal length and rotation vector in camera axes."""


def find_segments(
    picture: Float[Tensor, "h w 3"],
    hidden: Bool[Tensor, "h w"] | None,
    centre: Float[Tensor, "2"],
    fineness: tuple[float, float] = FINE,
) -> Segments:
    """The longest straight edges of a picture.

    Args:
        picture: In [0, 1].
        hidden: What is no room: segments with their middle there are left out.
        centre: The principal point [px].
        fineness: `FINE` or `SURE`.
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
    return Segments(middle - centre.double().cpu(), along, error, vote)


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

    Args:
        segments: Of a picture.
        prior: Of the camera.
        R_cam_world: Its first guess; the headings of the room are sought from there.
    """
    heading = torch.arange(HEADINGS, dtype=torch.float64) * (torch.pi / 2 / HEADINGS)
    R = R_cam_world.double().cpu() @ rot_y(heading)
    pose = RoomPose(torch.full((HEADINGS,), prior.log_focal, dtype=torch.float64), R)
    for coarse in COARSE:
        pose = _descend(segments, prior, pose, coarse)
    cost, _, precision = _quadratic(segments, prior, pose, COARSE[-1])
    order = cost.argsort(stable=True)
    chosen: list[int] = []
    for k in order.tolist():
        if all(_apart(pose, k, other) > SAME for other in chosen):
            chosen.append(k)
    rows = torch.tensor(chosen)
    return Ends(RoomPose(pose.log_focal[rows], pose.R_cam_room[rows]), cost[rows], precision[rows])


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
        new = RoomPose(pose.log_focal + step[:, 0], axis_angle(step[:, 1:]) @ pose.R_cam_room)
        after = _quadratic(segments, prior, new, coarse)
        better = after[0] < cost
        damping = torch.where(better, damping / 5, damping * 5)
        pose = RoomPose(
            torch.where(better, new.log_focal, pose.log_focal),
            torch.where(better[:, None, None], new.R_cam_room, pose.R_cam_room),
        )
        cost = torch.where(better, after[0], cost)
        gradient = torch.where(better[:, None], after[1], gradient)
        hessian = torch.where(better[:, None, None], after[2], hessian)
    return pose


def _quadratic(
    segments: Segments, prior: Prior, pose: RoomPose, coarse: float
) -> tuple[Float[Tensor, " starts"], Float[Tensor, "starts 4"], Float[Tensor, "starts 4 4"]]:
    """Cost, gradient and Gauss and Newton's matrix in (log focal length, rotation vector)."""
    sigma = coarse * segments.error
    angle, slope = _angles(segments, pose)
    e = angle / sigma
    within = (1 - FREE) / 3 * (-0.5 * e.square()).exp() / (sigma * (2 * torch.pi) ** 0.5)
    total = within.sum(1) + FREE / torch.pi
    weight = segments.vote * within / total[:, None] / sigma.square()
    cost = -(segments.vote * total.log()).sum(-1)
    gradient = torch.einsum("skn,skn,sknp->sp", weight, angle, slope)
    hessian = torch.einsum("skn,sknp,sknq->spq", weight, slope, slope)
    off = pose.log_focal - prior.log_focal
    lean, change = _lean(prior, pose)
    tight = prior.up_spread**-2
    cost = cost + 0.5 * (off / prior.focal_spread).square() + 0.5 * tight * lean.square().sum(-1)
    gradient[:, 0] += off / prior.focal_spread**2
    gradient += tight * torch.einsum("spi,si->sp", change, lean)
    hessian[:, 0, 0] += prior.focal_spread**-2
    hessian += tight * change @ change.mT + 1e-9 * torch.eye(4, dtype=off.dtype)
    return cost, gradient, hessian


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


def _angles(
    segments: Segments, pose: RoomPose
) -> tuple[Float[Tensor, "starts 3 lines"], Float[Tensor, "starts 3 lines 4"]]:
    """Sine of the angle between each segment and the way to each vanishing point, and its slope."""
    f = pose.log_focal.exp()[:, None, None]
    v = pose.R_cam_room.mT[:, :, None]  # starts, directions, 1, xyz
    m, d = segments.middle, segments.along
    qx, qy = f * v[..., 0] - m[:, 0] * v[..., 2], f * v[..., 1] - m[:, 1] * v[..., 2]
    square = (qx.square() + qy.square()).clamp_min(1e-9)
    norm = square.sqrt()
    sine = (d[:, 0] * qy - d[:, 1] * qx) / norm
    turned = torch.linalg.cross(
        torch.eye(3, dtype=v.dtype)[None, None], v
    )  # of a turn about x, y and z
    change = [(f * v[..., 0], f * v[..., 1])] + [
        (f * t[..., 0] - m[:, 0] * t[..., 2], f * t[..., 1] - m[:, 1] * t[..., 2])
        for t in turned[..., None, :].unbind(2)
    ]
    slopes = [
        (d[:, 0] * y - d[:, 1] * x) / norm - sine * (qx * x + qy * y) / square for x, y in change
    ]
    return sine, torch.stack(torch.broadcast_tensors(*slopes), -1)
