r"""Find how far a moving camera's path has drifted from the reference image: furniture tells it.

Not in the paper, whose camera stands still. Where objects are segmented in further frames (views),
each side of an object's box is the sight of a point of it. With p the point in the reference
image, z its depth, and R, t the pose of the view that was given,

    \sum rho(pi(exp(-w) (R^T (z K^-1 p - t - d))) - p')  +  \sum |log z / z_0|^2 / s^2
        +  \sum_k |w_k - w_{k-1}|^2 / a_k  +  |d_k - d_{k-1}|^2 / b_k

over turns w and shifts d of the views, and all z, by reweighted least squares; only the coordinate
across a side is compared, and only where neither people nor the image's border cut the side (edges
of other furniture do, but they stand as still). A mask whose outline is too wide or too narrow all
around has an unknown of its own. Turns and shifts are zero at the reference image and walk away
from it (variances a, b grow with the way); frames in between are corrected evenly. How long the
path's unit is, people tell (`find_scale`).
"""

import dataclasses
import math
from collections.abc import Mapping

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import one_hot

from mover.core.observe import Observer, Step, silent
from mover.core.records import record
from mover.core.types import Camera, CameraPath, Detection, People
from mover.geometry.camera import project
from mover.geometry.path import poses_at
from mover.geometry.rle import decode, tight_box
from mover.geometry.rotations import axis_angle
from mover.stages.camera.config import ViewConfig
from mover.stages.camera.find_drift import home_of, shares_of
from mover.stages.config import ImageConfig
from mover.stages.objects.find_image_cues import ImageInputs, free_sides

STEPS = 8  # for each scale of the robust price
STRIDE = 0.3  # [1], most that the logarithm of a depth changes in a step
FEWEST = 6  # sides of a view, below which it says nothing
HIDDEN = 0.1  # share of the strip beyond a side that people may fill
FIXED = 1e-5  # [rad], [m], error of the reference image's own pose
LEAST_WAY = 1e-3  # [m] between two views
ACROSS = (0, 1, 0, 1)  # coordinate that is told by the left, upper, right and lower side


@record
class ViewInputs:
    """Masks of the objects in the reference image and in further frames."""

    camera: Camera
    detections: tuple[Detection, ...]
    """Of the objects, in their order."""
    depth: Float[Tensor, " objects"]
    """Of the middle of each in the reference image, as first guessed [m]."""
    furniture: People
    """Visible masks in the views; `person` is the number of a detection."""
    people: People | None
    path: CameraPath
    """[m]"""


@record
class Views:
    """By how much the path is wrong at the views, and at the reference image (not at all)."""

    frame: Int[Tensor, " knots"]
    turn: Float[Tensor, "knots 3"]
    """About the axes of the view's camera [rad]."""
    shift: Float[Tensor, "knots 3"]
    """To be added to its place, in the axes of the reference image's camera [m]."""
    warnings: tuple[str, ...]


@record
class _Boxes:
    """Boxes of all objects in one picture."""

    sides: Float[Tensor, "objects 4"]
    """x_min, y_min, x_max, y_max [px]."""
    free: Bool[Tensor, "objects 4"]
    """Sides that neither people nor the border of the image cut off."""


@record
class _Sights:
    """Sides of objects in the reference image and in a view; one row each."""

    ray: Float[Tensor, "rows 3"]
    """Through the point that the reference image sees, of depth one."""
    at: Float[Tensor, " rows"]
    """Where the view sees it, across the side [px]."""
    axis: Int[Tensor, " rows"]
    outward: Float[Tensor, " rows"]
    """Sign of the coordinate's change where the mask's outline is too wide."""
    knot: Int[Tensor, " rows"]
    point: Int[Tensor, " rows"]
    """Whose depth is one unknown."""
    mask: Int[Tensor, " rows"]
    """Whose outline's error is one unknown."""
    depth: Float[Tensor, " points"]
    """First guess of the depth of each point [m]."""
    piece: Int[Tensor, " points"]
    """The object of each point."""


def align_views(
    inputs: ViewInputs, config: ViewConfig = ViewConfig(), observe: Observer = silent
) -> Views:
    """The turns and shifts with which the views see the objects where the reference image does."""
    reference = _in_reference(inputs)
    frames = _frames(inputs.furniture, config).tolist()
    views: dict[int, _Boxes] = {}
    for index, frame in enumerate(frames):  # a loop keeps the memory at one image
        observe(Step("align_views", index, len(frames)))
        view = _in_view(inputs, frame)
        view = dataclasses.replace(view, free=view.free & reference.free)
        if int(view.free.sum()) >= FEWEST:
            views[frame] = view
    knots = torch.cat([home_of(inputs.path)[None], torch.tensor(list(views)).long()]).unique()
    if not views:
        return Views(knots, torch.zeros(len(knots), 3), torch.zeros(len(knots), 3), ())
    sights = _sights(inputs, views, knots)
    moved = _solved(sights, knots, inputs, config).float()
    turn, shift = moved[:, :3], moved[:, 3:]
    far, wide = float(shift.norm(dim=-1).max()), math.degrees(float(turn.norm(dim=-1).max()))
    told = (
        f"the camera's path is corrected by up to {100 * far:.0f} cm and {wide:.1f} degrees: "
        "it drifts from the furniture in the frames"
    )
    loose = far > config.loose or wide > config.loose_turn
    return Views(knots, turn, shift, (told,) if loose else ())


def aligned(path: CameraPath, views: Views) -> CameraPath:
    """The path without what the views found to be wrong."""
    if len(views.frame) == 1:
        return path
    share = shares_of(path.frame, views.frame).to(views.turn)
    R = path.R_reference_camera @ axis_angle(share @ views.turn)
    t = path.t_reference_camera + share @ views.shift
    return dataclasses.replace(path, R_reference_camera=R, t_reference_camera=t)


def _frames(furniture: People, config: ViewConfig) -> Int[Tensor, " frames"]:
    """Evenly chosen frames in which objects are segmented."""
    frames = furniture.frame.unique()
    if len(frames) <= config.most:
        return frames
    return frames[torch.linspace(0, len(frames) - 1, config.most).round().long()]


def _in_reference(inputs: ViewInputs) -> _Boxes:
    """The objects in the reference image."""
    found = [None if d.mask is None else decode(d.mask, 0) for d in inputs.detections]
    return _boxes(inputs, dict(enumerate(found)), None)


def _in_view(inputs: ViewInputs, frame: int) -> _Boxes:
    """The objects in a further frame."""
    number = {found.id: k for k, found in enumerate(inputs.detections)}
    furniture, people = inputs.furniture, inputs.people
    rows = (furniture.frame == frame).nonzero()[:, 0].tolist()
    masks = {
        number[track]: decode(furniture.masks, row)
        for row, track in zip(rows, furniture.person[rows].tolist(), strict=True)
        if track in number
    }
    hidden = None
    if people is not None and bool((people.frame == frame).any()):
        seen = (people.frame == frame).nonzero()[:, 0].tolist()
        hidden = torch.stack([decode(people.masks, row) for row in seen]).any(0)
    return _boxes(inputs, masks, hidden)


def _boxes(
    inputs: ViewInputs,
    found: Mapping[int, Bool[Tensor, "h w"] | None],
    people: Bool[Tensor, "h w"] | None,
) -> _Boxes:
    """Boxes around the masks of some objects, and which of their sides are free."""
    camera, count = inputs.camera, len(inputs.detections)
    blank = torch.zeros(camera.height, camera.width, dtype=torch.bool)
    given = [found.get(k) for k in range(count)]
    masks = torch.stack([blank if m is None else m for m in given])
    there = masks.flatten(1).any(1)
    sides = torch.stack([tight_box(m) if bool(m.any()) else torch.zeros(4) for m in masks])
    alone = torch.ones(count, count, dtype=torch.bool)  # edges of what stands still may cut sides
    people = blank if people is None else people
    image = ImageInputs(camera, sides, there, masks, people, alone)
    free = free_sides(image, ImageConfig(hidden=HIDDEN))
    return _Boxes(sides, free & there[:, None])


def _extremes(inputs: ViewInputs) -> Float[Tensor, "objects 4 2"]:
    """Where the reference image sees the outermost points of each mask [px]."""
    points = torch.zeros(len(inputs.detections), 4, 2)
    for index, found in enumerate(inputs.detections):
        mask = None if found.mask is None else decode(found.mask, 0)
        if mask is None or not bool(mask.any()):
            continue
        box = tight_box(mask)
        left, top, right, low = (int(v) for v in box.tolist())
        ends = (mask[:, left], mask[top], mask[:, right - 1], mask[low - 1])
        middle = torch.stack([(end.nonzero() + 0.5).mean() for end in ends])
        across = torch.stack([box, middle], -1)
        points[index] = torch.where(torch.tensor(ACROSS)[:, None] == 0, across, across.flip(-1))
    return points


def _sights(
    inputs: ViewInputs, views: Mapping[int, _Boxes], knots: Int[Tensor, " knots"]
) -> _Sights:
    """All sides that are free in the reference image and in a view."""
    free = torch.stack([view.free for view in views.values()])
    sides = torch.stack([view.sides for view in views.values()])
    view, piece, side = free.nonzero().unbind(1)
    pixel = torch.nn.functional.pad(_extremes(inputs)[piece, side], (0, 1), value=1.0).double()
    number, point = (4 * piece + side).unique(return_inverse=True)
    return _Sights(
        ray=pixel @ torch.linalg.inv(inputs.camera.K.double()).mT,
        at=sides[view, piece, side].double(),
        axis=torch.tensor(ACROSS)[side],
        outward=torch.where(side < 2, -1.0, 1.0).double(),
        knot=torch.searchsorted(knots, torch.tensor(list(views)))[view],
        point=point,
        mask=(view * len(inputs.detections) + piece).unique(return_inverse=True)[1],
        depth=inputs.depth.double()[number // 4],
        piece=number // 4,
    )


def _solved(
    sights: _Sights, knots: Int[Tensor, " knots"], inputs: ViewInputs, config: ViewConfig
) -> Float[Tensor, "knots 6"]:
    """Turns and shifts of all knots by Gauss-Newton with the weights of Geman-McClure."""
    poses, K = poses_at(inputs.path, knots[sights.knot]), inputs.camera.K.double()
    trust = _drift_trust(inputs.path, knots, config)
    same = (sights.piece[:, None] == sights.piece).double() * config.depth**2
    depths = torch.linalg.inv(same + config.relief**2 * torch.eye(len(same)).double())
    outlines = torch.eye(int(sights.mask.max()) + 1).double() / config.border**2
    prior = torch.block_diag(trust, depths, outlines)
    at = prior.new_zeros(len(prior))
    for sigma in config.sigmas:
        for _ in range(STEPS):
            off, slope = _linear(at, sights, poses, K)
            pull = 1 / (1 + (off / sigma).square()).square() / config.pixel**2
            hessian = slope.mT @ (pull[:, None] * slope) + prior
            gradient = slope.mT @ (pull * off) + prior @ at
            at = at - torch.linalg.solve(hessian, gradient).clamp(-STRIDE, STRIDE)
    return at[: len(trust)].unflatten(0, (len(knots), 6))


def _linear(
    at: Float[Tensor, " unknowns"], sights: _Sights, poses: CameraPath, K: Float[Tensor, "3 3"]
) -> tuple[Float[Tensor, " rows"], Float[Tensor, "rows unknowns"]]:
    """By how much sides are seen elsewhere [px], and the derivatives; turns are small.

    Args:
        at: Turns and shifts of all knots, logarithms of depths, errors of outlines.
        sights: Where the sides are seen.
        poses: That were given of the view of each row.
        K: Intrinsics.
    """
    depths, masks = len(sights.depth), int(sights.mask.max()) + 1
    knots = (len(at) - depths - masks) // 6
    moved = at[: 6 * knots].unflatten(0, (knots, 6))[sights.knot]
    depth, outline = at[6 * knots :].split([depths, masks])
    R, t = poses.R_reference_camera.double(), poses.t_reference_camera.double()
    back = axis_angle(-moved[:, :3]) @ R.mT
    point = sights.ray * (sights.depth * depth.exp())[sights.point, None]
    there = (back @ (point - t - moved[:, 3:])[..., None])[..., 0]
    pixel = project(there, K).gather(1, sights.axis[:, None])
    off = pixel[:, 0] + sights.outward * outline[sights.mask] - sights.at
    slope = (K[sights.axis] - pixel * K[2]) / there[:, 2:]
    carried = (slope[:, None] @ back)[:, 0]
    pose = torch.cat([torch.linalg.cross(slope, there), -carried], -1)
    poses_of = (one_hot(sights.knot, knots)[..., None] * pose[:, None]).flatten(1)
    depths_of = one_hot(sights.point, depths) * (carried * point).sum(-1, keepdim=True)
    outlines_of = one_hot(sights.mask, masks) * sights.outward[:, None]
    return off, torch.cat([poses_of, depths_of, outlines_of], -1)


def _drift_trust(
    path: CameraPath, knots: Int[Tensor, " knots"], config: ViewConfig
) -> Float[Tensor, "unknowns unknowns"]:
    """What is believed of turns and shifts before anything is seen: one over their covariance."""
    step = path.t_reference_camera.double().diff(dim=0).norm(dim=-1)
    way = torch.nn.functional.pad(step, (1, 0)).cumsum(0)
    index = torch.searchsorted(path.frame, knots).clamp_max(len(way) - 1)
    between = way[index].diff().clamp_min(LEAST_WAY)
    change = torch.eye(len(knots)).double().diff(dim=0)
    home = (knots == home_of(path)).double()
    walks = change.mT @ ((3 / (between * between.sum()))[:, None] * change)
    fixed = torch.outer(home, home) / FIXED**2
    turns = walks * (between.sum() / math.radians(config.turn)) ** 2 + fixed
    shifts = walks / config.share**2 + fixed
    first = torch.tensor([1.0, 1, 1, 0, 0, 0]).double().diag()
    return torch.kron(turns, first) + torch.kron(shifts, torch.eye(6).double() - first)
