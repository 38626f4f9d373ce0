r"""How high is the camera, and which shapes can fill the boxes: a quick look by boxes alone.

    E(h, tilt) = \sum_i min_{shape, yaw}  L_bbox + \lambda L_scale   on the floor y = -h

One picture has no scale. Furniture has: beds are two metres long, seats are knee-high. Each shape
of the library is put on floors of several heights and turned, and descends until its projected
extent fills the detected box at the least change of its usual size. The height (and a small change
of the tilt) at which all objects together are most usual is the camera's; outliers are capped.
"""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mover.core.observe import Energy, Observer, silent
from mover.core.records import record
from mover.core.types import Camera, Layout
from mover.energy.image_terms import SEEN, bbox_term
from mover.energy.minimize import minimize
from mover.energy.prior_terms import Given, given_term, scale_term
from mover.geometry.camera import pitch_roll, project, tilted, to_world
from mover.geometry.placement import place
from mover.perceive.config import ScreenConfig
from mover.stages.posterior import Gaussian

DIRECTIONS = 60  # in which the outermost point of a shape is kept
LITTLE = 0.01  # share of items that are not the best
AROUND = (-1.5, -0.75, 0.0, 0.75, 1.5)  # standard deviations of the height of a prior
NEAREST = 0.6  # [m], where a start is put at least
FARTHEST = 15.0  # [m], and at most
SPREAD = 0.4  # of the logarithm of usual heights of cameras,
KNOWN = 0.05  # and of one that is given, or by people or depth without a prior of their heights
YAWS = 8  # turns that are tried
SCALE, DEPTH, AXIS = 0.3, 0.5, 0.15  # weights of usual sizes, measured depth, axes seen in pictures
CAP = 0.3  # most that one object may say about the height
SOFT = 0.05  # shapes that fit worse than the best by so much hardly count


@record
class ScreenInputs:
    """Shapes for the detected things: `items` are (thing, shape) pairs."""

    camera: Camera
    boxes: Float[Tensor, "things 4"]
    sides: Int[Tensor, "things 4"]
    """What is known of each side of the box, see `image_terms`."""
    depth: Float[Tensor, " things"]
    """Measured distance along the view of the visible surface [m]; NaN: unknown."""
    thing: Int[Tensor, " items"]
    """Whose shape an item is."""
    points: Float[Tensor, "items points 3"]
    """Outermost points of each shape, from the centre of its bottom [m]."""
    height: float | None
    """The camera's, where it is given or a depth map shows it [m]."""
    given: Given
    """Along which axis each item may stand."""
    tilt_spread: float | None = None
    """How far off pitch and roll are, where the picture shows them [rad]."""
    prior: Gaussian | None = None
    """Pitch and roll [rad], logarithm of the height [m] by the feet of people; it takes the place
    of `height` and `tilt_spread`."""


@record
class ScreenGuess:
    """What descends, from each height."""

    t_world_object: Float[Tensor, "heights yaws items 3"]
    """Its y does not count: everything stands on the floor."""
    yaw: Float[Tensor, "heights yaws items"]
    log_scale: Float[Tensor, "heights yaws items 3"]
    log_height: Float[Tensor, " heights"]
    """Of the camera above the floor [m]."""
    tilt: Float[Tensor, "heights 2"]
    """What pitch and roll differ from the first guess [rad]."""


@record
class Screened:
    """What the quick look found."""

    height: float
    """Of the camera above the floor [m]."""
    R_cam_world: Float[Tensor, "3 3"]
    """Of the camera with its tilt corrected."""
    layout: Layout
    """Each item in each turn on the floor of that height."""
    energy: Float[Tensor, "yaws items"]


def outermost(verts: Float[Tensor, "verts 3"]) -> Float[Tensor, "points 3"]:
    """The outermost vertices in evenly spread directions."""
    k = torch.arange(DIRECTIONS) + 0.5
    y = 1 - 2 * k / DIRECTIONS
    angle = k * math.pi * (3 - math.sqrt(5))
    ring = (1 - y * y).sqrt()
    out = torch.stack([ring * angle.cos(), y, ring * angle.sin()], -1).to(verts)
    return verts[(verts @ out.mT).argmax(0)]


def screen(inputs: ScreenInputs, config: ScreenConfig, observe: Observer = silent) -> Screened:
    """Begin at all heights, descend, choose the best."""
    heights = _heights(inputs, config)
    start = _starts(inputs, heights)

    def energy(guess: ScreenGuess) -> Energy:
        each = _each(guess, inputs, config)
        share = _share(each, inputs)
        world = _world(guess, inputs, config)
        return Energy({"items": (each * share).sum((1, 2)), "world": world})

    found = minimize(energy, start, config.method, observe, "screen").at
    with torch.no_grad():
        each = _each(found, inputs, config)
        things = _best_of_things(inputs, each.amin(1)).clamp_max(CAP)
        curve = things.sum(-1) + _world(found, inputs, config)
        best = int(curve.argmin())
        layout = _standing(found)
        pitch, roll = pitch_roll(inputs.camera.R_cam_world)
        turn = found.tilt[best]
        R = tilted(pitch + turn[0], roll + turn[1])
    return Screened(
        height=float(found.log_height[best].exp()),
        R_cam_world=R if config.tilt else inputs.camera.R_cam_world,
        layout=Layout(layout.t_world_object[best], layout.yaw[best], layout.log_scale[best]),
        energy=each[best],
    )


def _best_of_things(
    inputs: ScreenInputs, energy: Float[Tensor, "heights items"]
) -> Float[Tensor, "heights things"]:
    """The best shape of each thing."""
    best = energy.new_full((len(energy), len(inputs.boxes)), math.inf)
    return best.scatter_reduce(1, inputs.thing.expand(len(energy), -1), energy, "amin")


def _share(
    each: Float[Tensor, "heights yaws items"], inputs: ScreenInputs
) -> Float[Tensor, "heights yaws items"]:
    """How much an item in a turn moves camera and floor.

    All of a thing have one vote together, and less where none fits; the best of them has most of
    it. The others keep a little, so that they go on (Adam's steps do not shrink with it).
    """
    with torch.no_grad():
        best = _best_of_things(inputs, each.amin(1))
        share = ((best[:, None, inputs.thing] - each) / SOFT).exp().clamp_min(LITTLE)
        votes = torch.zeros_like(best).index_add(1, inputs.thing, share.sum(1))
        vote = (1 + best / CAP) ** -2 / votes
        return share * vote[:, None, inputs.thing]


def _heights(inputs: ScreenInputs, config: ScreenConfig) -> Float[Tensor, " heights"]:
    """Heights of the camera from which the descents start [m]."""
    if inputs.prior is not None:
        spread = torch.linalg.inv(inputs.prior.precision)[2, 2].sqrt()
        return (inputs.prior.mean[2] + spread * torch.tensor(AROUND)).exp()
    return torch.tensor(config.heights if inputs.height is None else (inputs.height,))


def _world(
    guess: ScreenGuess, inputs: ScreenInputs, config: ScreenConfig
) -> Float[Tensor, " heights"]:
    """Squared deviations of height and tilt from what is known or usual, weighted."""
    if inputs.prior is not None:
        at = torch.stack(pitch_roll(inputs.camera.R_cam_world)) + guess.tilt
        off = torch.cat([at, guess.log_height[:, None]], -1) - inputs.prior.mean
        return config.prior * torch.einsum("hi,ij,hj->h", off, inputs.prior.precision, off)
    usual, spread, tilt = config.usual, SPREAD, config.tilt
    if inputs.height is not None:
        usual, spread, tilt = inputs.height, KNOWN, config.tilt_known
    tilt = tilt if inputs.tilt_spread is None else inputs.tilt_spread
    height = ((guess.log_height - math.log(usual)) / spread).square()
    turned = (guess.tilt / max(tilt, 1e-3)).square().sum(-1)
    return config.prior * (height + turned)


def _standing(guess: ScreenGuess) -> Layout:
    x, _, z = guess.t_world_object.unbind(-1)
    y = -guess.log_height.exp()[:, None, None].expand_as(x)
    return Layout(torch.stack([x, y, z], -1), guess.yaw, guess.log_scale)


def _each(
    guess: ScreenGuess, inputs: ScreenInputs, config: ScreenConfig
) -> Float[Tensor, "heights yaws items"]:
    """Cost of each item in each turn on the floor of each height."""
    camera, thing = inputs.camera, inputs.thing
    pitch, roll = pitch_roll(camera.R_cam_world)
    turn = guess.tilt if config.tilt else torch.zeros_like(guess.tilt)
    R = tilted(pitch + turn[:, 0], roll + turn[:, 1])[:, None, None]
    verts = place(inputs.points, _standing(guess)) @ R.mT
    boxes, sides = inputs.boxes[thing], inputs.sides[thing]
    box = bbox_term(project(verts, camera.K), boxes, sides, float(camera.width), "robust")
    size = SCALE * scale_term(guess.log_scale, "robust")
    energy = box + size + DEPTH * _off_depth(verts, inputs.depth[thing])
    return energy + AXIS * given_term(_standing(guess), inputs.given)


def _off_depth(
    verts: Float[Tensor, "*starts items points 3"], depth: Float[Tensor, " items"]
) -> Float[Tensor, "*starts items"]:
    """How far a measured depth is out of the object's own range (of its logarithm)."""
    z = verts[..., 2].clamp_min(0.05).log()
    near, far = z.amin(-1), z.mean(-1)
    known = depth.nan_to_num(1.0).clamp_min(0.05).log()
    off = (near - known).relu() + (known - far).relu()
    return torch.where(depth.isnan(), torch.zeros_like(off), off)


def _starts(inputs: ScreenInputs, heights: Tensor) -> ScreenGuess:
    """On the floor below the box where its lower edge is seen, else as far as its usual size says.

    An item whose floor point is not plausible (above the horizon) starts by its size, too.
    """
    R, K, boxes = inputs.camera.R_cam_world, inputs.camera.K, inputs.boxes[inputs.thing]
    extent = inputs.points.amax(1) - inputs.points.amin(1)
    ones = torch.ones(len(boxes))
    foot = torch.stack([(boxes[:, 0] + boxes[:, 2]) / 2, boxes[:, 3], ones], -1)
    middle = torch.stack([foot[:, 0], (boxes[:, 1] + boxes[:, 3]) / 2, ones], -1)
    rays = [to_world(pixel @ torch.linalg.inv(K).mT, R) for pixel in (foot, middle)]
    by_size = (extent[:, 1] * K[1, 1] / (boxes[:, 3] - boxes[:, 1]).clamp_min(1)).clamp(
        NEAREST, FARTHEST
    )
    far = -heights[:, None] / rays[0][:, 1].clamp_max(-1e-3) + extent[:, 2] / 2
    usable = (rays[0][:, 1] < -0.02) & (inputs.sides[inputs.thing][:, 3] == SEEN) & (far < FARTHEST)
    distance = torch.where(usable, far, by_size.expand_as(far)).clamp(NEAREST, FARTHEST)
    t = distance[..., None] * torch.where(usable[..., None], rays[0], rays[1])
    yaw = torch.arange(YAWS)[:, None] * (2 * math.pi / YAWS) + inputs.given.axis
    shape = (len(heights), YAWS, len(boxes))
    return ScreenGuess(
        t_world_object=t[:, None].expand(*shape, 3).clone(),
        yaw=yaw.expand(shape).clone(),
        log_scale=torch.zeros(*shape, 3),
        log_height=heights.log(),
        tilt=torch.zeros(len(heights), 2),
    )
