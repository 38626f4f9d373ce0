r"""Refine camera and ground together with the objects that stand on it.

Ours, not the paper's, which freezes the camera after the feet: one degree of pitch or 2 cm of
ground is 5-15 cm of depth at 5 m, because an object stands where the ray to its base meets the
floor. Objects whose shape fits tell the camera more exactly than noisy feet do.

    min over pitch, roll, ground and all objects on the floor:
        sum_i E_i / (E_i(start) + 0.02)  +  w/2 d^T C^-1 d

Each object's energy is divided by its own residual: exact shapes pull hard, wrong shapes softly.
d is the change of pitch, roll and ground, C their covariance from the feet: a floor that was
walked all around outweighs the objects, and what no foot told is left to them. The borders of the
masks are held as they suit the objects at first (`fixed_borders`). An object is carried by the
ray to the centre of its base, so a change of the camera leaves it where it is in the image.

Of a moving camera further frames with masks of the furniture (views) count, too, all together as
much as the reference image. Where they were seen from is known to a tenth of a degree and some
millimetres only, which furniture would otherwise take for its own place: small turns and shifts of
theirs are found together with all else, at the price  w_p/2 \sum |pose / sigma|^2.
"""

import math
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from mover.core.devices import constant
from mover.core.observe import Energy, Observer, silent
from mover.core.records import map_tensors, record
from mover.core.types import Camera, Layout, Objects
from mover.energy.config import SceneConfig, SceneWeights, only
from mover.energy.fused.energy import EnergyOf, energy_function, never_asks
from mover.energy.minimize import minimize
from mover.energy.objective import (
    FurtherView,
    HumanCues,
    ImageCues,
    best_borders,
    from_view,
    shares_of,
)
from mover.geometry.camera import pitch_roll, tilted, to_camera
from mover.geometry.placement import GROUND, LOWEST, hit_floor
from mover.geometry.rotations import axis_angle
from mover.stages.config import RefineConfig

# Masks whose border has been found: evidence without that freedom.


def fixed_borders(
    image: ImageCues, layout: Layout, objects: Objects, camera: Camera, weights: SceneWeights
) -> ImageCues:
    """The masks and boxes under the shift that suits a layout best (`terms.border`).

    The layout has one place for each object.
    """
    borders = image.borders
    if borders is None:
        return image
    with torch.no_grad():
        number = best_borders(layout, objects, camera, image, weights)
    shift = borders.shifts[number]
    boxes = image.boxes + torch.stack([-shift, -shift, shift, shift], -1)
    masks = borders.masks[number, torch.arange(len(number))]
    return replace(image, masks=masks, boxes=boxes, borders=None)


SOFT = 0.02  # [1], added to an object's own residual
UNITS = (
    0.01,
    0.01,
    0.02,
    0.01,
    0.05,
    0.03,
)  # pitch, roll [rad], ground [m], rays, yaw [rad], log scale


@record
class RefineInputs:
    """Camera and ground from the feet, objects from the image alone."""

    camera: Camera
    ground: float
    covariance: Float[Tensor, "3 3"]
    """Of pitch [rad], roll [rad] and ground [m], from the feet."""
    objects: Objects
    image: ImageCues
    layout: Layout
    views: tuple[FurtherView, ...] = ()
    """Their image terms count as much, all together, as those of the reference image."""


@record
class Refined:
    """The better camera and ground."""

    camera: Camera
    ground: float
    trace: Float[Tensor, " steps"]
    views: tuple[FurtherView, ...] = ()
    """From where the furniture says that they were seen."""


@record
class _Joint:
    tilt: Float[Tensor, "3"]
    rays: Float[Tensor, "objects 2"]
    yaw: Float[Tensor, " objects"]
    log_scale: Float[Tensor, "objects 3"]
    poses: Float[Tensor, "views 6"]
    """Turns [rad] and shifts [m] of the further views."""


def refine_camera(
    inputs: RefineInputs, config: RefineConfig, observe: Observer = silent
) -> Refined:
    """Minimise over the camera, the ground and all standing objects at once."""
    fixed, objects = _start(inputs), inputs.objects
    certainty = torch.linalg.inv(inputs.covariance)
    cues = fixed_borders(inputs.image, inputs.layout, objects, inputs.camera, config.weights)
    priced = SceneConfig(config.weights, "robust", config.uniform_scale_weight)
    seen = energy_function(objects, inputs.camera, cues, HumanCues(), priced)
    usable, views = _usable(inputs), _views(inputs, config)
    zero = map_tensors(torch.zeros_like, fixed)

    def energies(joint: _Joint) -> tuple[Tensor, Tensor]:
        camera, layout = _unpack(joint, inputs)
        elsewhere = _in_views(camera, layout, views, joint.poses)
        return seen(layout, camera.R_cam_world).per_item, elsewhere

    with torch.no_grad():
        own = energies(fixed)[0] + SOFT

    def energy(free: _Joint) -> Energy:
        joint = _shift(fixed, free, config)
        here, elsewhere = energies(joint)
        terms = (here + elsewhere) / own
        off = joint.tilt - fixed.tilt
        feet = 0.5 * config.feet * (off @ certainty @ off)
        path = 0.5 * config.path * free.poses.square().sum()
        return Energy({"objects": (terms * usable).sum(), "feet": feet, "path": path})

    if not bool(usable.any()):
        return Refined(inputs.camera, inputs.ground, torch.zeros(0), inputs.views)
    still = never_asks(inputs.objects)
    found = minimize(energy, zero, config.method, observe, "refine_camera", still=still)
    joint = _shift(fixed, found.at, config)
    camera, _ = _unpack(joint, inputs)
    aligned = (moved_view(*one) for one in zip(inputs.views, joint.poses, strict=True))
    return Refined(camera, float(joint.tilt[2]), found.trace, tuple(aligned))


def _seen_terms(config: RefineConfig) -> SceneConfig:
    """Of further views only what is seen counts: sizes are believed once."""
    weights = only(bbox=config.weights.bbox, silhouette=config.weights.silhouette)
    return SceneConfig(weights, "robust", config.uniform_scale_weight)


def moved_view(view: FurtherView, pose: Float[Tensor, "6"]) -> FurtherView:
    """The view from a camera turned about its own axes [rad] and shifted [m]."""
    return replace(
        view,
        R_reference_camera=view.R_reference_camera @ axis_angle(pose[:3]),
        t_reference_camera=view.t_reference_camera + pose[3:],
    )


def _in_views(
    camera: Camera,
    layout: Layout,
    views: list[tuple[FurtherView, EnergyOf]],
    poses: Float[Tensor, "views 6"],
) -> Float[Tensor, " objects"]:
    """The mean energy of each object in the further views; zero where there are none."""
    whole = torch.zeros_like(layout.yaw)
    shares = shares_of(tuple(view for view, _ in views)) if views else poses
    for (view, seen), share, pose in zip(views, shares, poses, strict=True):  # few
        there, moved = from_view(camera, layout, moved_view(view, pose))
        whole = whole + share * seen(moved, there.R_cam_world).per_item
    return whole


def _views(inputs: RefineInputs, config: RefineConfig) -> list[tuple[FurtherView, EnergyOf]]:
    """The further views, by masks whose borders suit the objects as they stand."""
    found: list[tuple[FurtherView, EnergyOf]] = []
    for view in inputs.views:
        camera, layout = from_view(inputs.camera, inputs.layout, view)
        image = fixed_borders(view.image, layout, inputs.objects, camera, config.weights)
        known = inputs.objects, camera, image, HumanCues()
        found.append((view, energy_function(*known, _seen_terms(config))))
    return found


def _start(inputs: RefineInputs) -> _Joint:
    base = to_camera(inputs.layout.t_world_object, inputs.camera.R_cam_world)
    rays = base[:, :2] / base[:, 2:].clamp_min(0.1)
    pitch, roll = pitch_roll(inputs.camera.R_cam_world)
    tilt = torch.stack([pitch, roll, pitch.new_tensor(inputs.ground)])
    poses = tilt.new_zeros(len(inputs.views), 6)
    return _Joint(tilt, rays, inputs.layout.yaw, inputs.layout.log_scale, poses)


def _usable(inputs: RefineInputs) -> Float[Tensor, " objects"]:
    """Objects on the ground, in front of the camera, below the horizon, with a mask."""
    t = inputs.layout.t_world_object
    low = -t[:, 1] > 2 * LOWEST * t.norm(dim=-1)
    ahead = to_camera(t, inputs.camera.R_cam_world)[:, 2] > 0.3
    seen = inputs.image.keep.flatten(1).any(-1)
    return ((inputs.objects.supports == GROUND) & low & ahead & seen).to(t)


def _shift(fixed: _Joint, free: _Joint, config: RefineConfig) -> _Joint:
    units = constant(UNITS, fixed.tilt)
    turn, shift = math.radians(config.turn), config.shift
    steps = constant((turn,) * 3 + (shift,) * 3, fixed.tilt)
    return _Joint(
        fixed.tilt + free.tilt * units[:3],
        fixed.rays + free.rays * units[3],
        fixed.yaw + free.yaw * units[4],
        fixed.log_scale + free.log_scale * units[5],
        fixed.poses + free.poses * steps,
    )


def _unpack(joint: _Joint, inputs: RefineInputs) -> tuple[Camera, Layout]:
    old = inputs.camera
    R = tilted(joint.tilt[0], joint.tilt[1])
    rays = torch.nn.functional.pad(joint.rays, (0, 1), value=1.0)
    t = hit_floor(rays, R, joint.tilt[2])
    return Camera(old.K, R, old.width, old.height), Layout(t, joint.yaw, joint.log_scale)
