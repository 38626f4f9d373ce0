r"""Find how far a moving camera's path has drifted from the reference image: furniture tells it.

Not in the paper, whose camera stands still. Where objects are segmented in further frames (views),
each side of an object's box is the sight of a point of it. With p the point in the reference
image, z its depth, and R, t the pose of the view that was given,

    \sum rho(pi(exp(-w) (R^T (z K^-1 p - t - d))) - p')  +  \sum |log z / z_0|^2 / s^2
        +  \sum_k |w_k - w_{k-1}|^2 / a_k  +  |d_k - d_{k-1}|^2 / b_k

over turns w and shifts d of the views, and all z, by reweighted least squares; only the coordinate
across a side is compared, and only where nothing hides the side. Turns and shifts are zero at the
reference image and walk away from it (variances a, b grow with the way). People and views in
between are corrected evenly. How long the path's unit is, people tell (`find_scale`).
"""

import dataclasses
import math

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.core.observe import Observer, Step, silent
from mover.core.records import record
from mover.core.types import Camera, CameraPath, Detection, People
from mover.geometry.camera import project
from mover.geometry.path import poses_at
from mover.geometry.rle import decode, tight_box
from mover.geometry.rotations import axis_angle
from mover.stages.camera.find_drift import home_of, shares_of
from mover.stages.config import ImageConfig, ViewConfig
from mover.stages.objects.find_image_cues import ImageInputs, free_sides

STEPS = 8  # for each scale of the robust price
MOST = 0.3
FEWEST = 6  # sides of a view, below which it says nothing
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
class _Sights:
    """Sides of objects in the reference image and in a view; one row each."""

    point: Float[Tensor, "rows 2"]
    """Where the reference image sees it [px]."""
    at: Float[Tensor, " rows"]
    """Where the view does, across the side [px]."""
    axis: Int[Tensor, " rows"]
    depth: Int[Tensor, " rows"]
    """Index of its depth."""
    view: Int[Tensor, " rows"]
    mask: Int[Tensor, " rows"]
    """Index of its mask, whose outline may be off by some pixels all around."""
    outward: Float[Tensor, " rows"]
    """1 where such an error is added to the coordinate, -1 where it is taken away."""


def align_views(
    inputs: ViewInputs, config: ViewConfig = ViewConfig(), observe: Observer = silent
) -> Views:
    """The turns and shifts with which the views see the objects where the reference image does."""
    frames = _frames(inputs.furniture, config)
    boxes, free = zip(*(_seen(inputs, f) for f in (None, *frames.tolist())), strict=True)
    observe(Step("align_views", 0, 1))
    both = torch.stack(free)[1:] & free[0]
    both = both & (both.flatten(1).sum(1) >= FEWEST)[:, None, None]
    told = both.flatten(1).any(1)
    frames, both, boxes = frames[told], both[told], torch.stack(boxes)[1:][told]
    home = home_of(inputs.path)
    knots = torch.cat([home[None], frames]).unique()
    if not len(frames):
        return Views(knots, torch.zeros(len(knots), 3), torch.zeros(len(knots), 3), ())
    view, piece, side = both.nonzero().unbind(1)
    points = _extremes(inputs)
    across = torch.tensor(ACROSS)
    number, depth = (4 * piece + side).unique(return_inverse=True)
    sights = _Sights(
        points[piece, side].double(), boxes[view, piece, side].double(), across[side], depth,
        torch.searchsorted(knots, frames)[view],
        (view * len(points) + piece).unique(return_inverse=True)[1],
        torch.where(side < 2, -1.0, 1.0).double(),
    )  # fmt: skip
    far = inputs.depth.double()[number // 4]
    turn, shift = _solved(sights, (far, number // 4), knots, (inputs, config))
    most = float(shift.norm(dim=-1).max()), math.degrees(float(turn.norm(dim=-1).max()))
    said = (
        f"the camera's path is corrected by up to {100 * most[0]:.0f} cm and {most[1]:.1f} degrees: "
        "furniture is seen elsewhere than it says"
    )
    loose = most[0] > config.loose or most[1] > config.loose_turn
    return Views(knots, turn.float(), shift.float(), (said,) if loose else ())


def aligned(path: CameraPath, views: Views) -> CameraPath:
    """The path without what the views found to be wrong."""
    share = shares_of(path.frame, views.frame).to(views.turn)
    R = path.R_reference_camera @ axis_angle(share @ views.turn)
    t = path.t_reference_camera + share @ views.shift
    return dataclasses.replace(path, R_reference_camera=R, t_reference_camera=t)


def _frames(furniture: People, config: ViewConfig) -> Int[Tensor, " frames"]:
    """The views: evenly chosen frames in which objects are segmented."""
    frames = furniture.frame.unique()
    if len(frames) <= config.most:
        return frames
    return frames[torch.linspace(0, len(frames) - 1, config.most).round().long()]


def _seen(
    inputs: ViewInputs, frame: int | None
) -> tuple[Float[Tensor, "objects 4"], Bool[Tensor, "objects 4"]]:
    """Boxes of all objects in a view (None: the reference image), and which sides are free."""
    camera = inputs.camera
    masks = torch.zeros(len(inputs.detections), camera.height, camera.width, dtype=torch.bool)
    people = torch.zeros(camera.height, camera.width, dtype=torch.bool)
    if frame is None:
        for k, found in enumerate(inputs.detections):
            masks[k] = masks[k] if found.mask is None else decode(found.mask, 0)
    else:
        number = {found.id: k for k, found in enumerate(inputs.detections)}
        for row in (inputs.furniture.frame == frame).nonzero()[:, 0].tolist():
            index = number.get(int(inputs.furniture.person[row]))
            if index is not None:
                masks[index] = decode(inputs.furniture.masks, row)
        seen = inputs.people
        rows = [] if seen is None else (seen.frame == frame).nonzero()[:, 0].tolist()
        for row in rows:
            assert seen is not None
            people = people | decode(seen.masks, row)
    there = masks.flatten(1).any(1)
    boxes = torch.stack([tight_box(m) if bool(m.any()) else torch.zeros(4) for m in masks])
    behind = torch.ones(len(masks), len(masks), dtype=torch.bool)  # edges that cut others move along
    image = ImageInputs(camera, boxes, there, masks, people, behind)
    return boxes, free_sides(image, ImageConfig(hidden=0.1)) & there[:, None]


def _extremes(inputs: ViewInputs) -> Float[Tensor, "objects 4 2"]:
    """Where the reference image sees the outermost points of each mask [px]."""
    points: list[Tensor] = []
    for found in inputs.detections:
        if found.mask is None:
            points.append(torch.zeros(4, 2))
            continue
        mask = decode(found.mask, 0)
        x0, y0, x1, y1 = box = tight_box(mask)
        left, top, right, low = (int(v) for v in box.tolist())
        row, column = torch.arange(mask.shape[0]) + 0.5, torch.arange(mask.shape[1]) + 0.5
        ends = [row[mask[:, left]], column[mask[top]], row[mask[:, right - 1]], column[mask[low - 1]]]
        a, b, c, d = (end.mean() for end in ends)
        points.append(torch.stack([x0, a, b, y0, x1, c, d, y1]).reshape(4, 2))
    return torch.stack(points)


def _solved(
    sights: _Sights,
    first: tuple[Tensor, Tensor],
    knots: Int[Tensor, " knots"],
    known: tuple[ViewInputs, ViewConfig],
) -> tuple[Float[Tensor, "knots 3"], Float[Tensor, "knots 3"]]:
    """Turns and shifts of all knots by Gauss-Newton with the weights of Geman-McClure."""
    (inputs, config), (far, sights_owner) = known, first
    trust = _trust(inputs.path, knots, config)
    count, depths, masks = 6 * len(knots), len(far), int(sights.mask.max()) + 1
    poses = poses_at(inputs.path, knots[sights.view])
    R, t = poses.R_reference_camera.double(), poses.t_reference_camera.double()
    K = inputs.camera.K.double()
    rays = torch.nn.functional.pad(sights.point, (0, 1), value=1.0) @ torch.linalg.inv(K).mT

    def residual(at: Tensor) -> Tensor:
        moved = at[:count].unflatten(0, (len(knots), 6))[sights.view]
        deep = far * at[count : count + depths].exp()
        there = rays * deep[sights.depth, None] - t - moved[:, 3:]
        there = (axis_angle(-moved[:, :3]) @ (R.mT @ there[..., None]))[..., 0]
        pixel = project(there, K)
        seen = sights.at - sights.outward * at[count + depths :][sights.mask]
        return pixel.gather(1, sights.axis[:, None])[:, 0] - seen

    at = torch.zeros(count + depths + masks).double()
    alike = (sights_owner[:, None] == sights_owner).double() * config.depth**2
    alike = torch.linalg.inv(alike + config.relief**2 * torch.eye(depths).double())
    prior = torch.block_diag(trust, alike, torch.eye(masks).double() / config.border**2)
    for sigma in config.sigmas:
        for _ in range(STEPS):
            off, slope = residual(at), torch.func.jacfwd(residual)(at)
            pull = 1 / (1 + (off / sigma).square()).square() / config.pixel**2
            hessian = slope.mT @ (pull[:, None] * slope) + prior
            gradient = slope.mT @ (pull * off) + prior @ at
            at = at - torch.linalg.solve(hessian, gradient).clamp(-MOST, MOST)
    import os
    if os.environ.get('DBG'):
        r=residual(at); print('rms med', float(r.abs().median()), 'p90', float(r.abs().quantile(.9)), 'by side', [round(float(r[s].abs().median()),2) for s in [(sights.axis==0),(sights.axis==1)]], 'logz', float((at[count:count+depths]).abs().mean()), float(at[count+depths:].abs().mean()))
    moved = at[:count].unflatten(0, (len(knots), 6))
    return moved[:, :3], moved[:, 3:]


def _trust(
    path: CameraPath, knots: Int[Tensor, " knots"], config: ViewConfig
) -> Float[Tensor, "unknowns unknowns"]:
    """One over the covariance of turns and shifts before anything is seen."""
    step = path.t_reference_camera.double().diff(dim=0).norm(dim=-1)
    way = torch.nn.functional.pad(step, (1, 0)).cumsum(0)
    index = torch.searchsorted(path.frame, knots).clamp_max(len(way) - 1)
    between = way[index].diff().clamp_min(LEAST_WAY)
    whole = between.sum()
    change = torch.eye(len(knots)).double().diff(dim=0)
    home = (knots == home_of(path)).double()
    fixed = torch.outer(home, home) * 1e10
    turns = change.mT @ ((whole / (config.turn**2 / 3 * between))[:, None] * change) + fixed
    shifts = change.mT @ ((3 / (config.share**2 * whole * between))[:, None] * change) + fixed
    of_turns = torch.tensor([1.0, 1, 1, 0, 0, 0]).double().diag()
    return torch.kron(turns, of_turns) + torch.kron(shifts, torch.eye(6).double() - of_turns)
