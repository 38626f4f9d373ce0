r"""Refine camera and ground together with the objects that stand on it.

Ours, not the paper's, which freezes the camera after the feet: one degree of pitch or 2 cm of
ground is 5-15 cm of depth at 5 m, because an object stands where the ray to its base meets the
floor. Objects whose shape fits constrain the camera more than noisy feet do.

    min over pitch, roll, ground and all objects on the floor:
        sum_i E_i / (E_i(start) + 0.02)  +  w (d^T C^-1 d / 2 + sum_i S_i)

Each object's energy is divided by its own residual: exact shapes pull hard, wrong shapes softly.
S_i is the cost in nats of a height off the standard, but for what its category shares (`KIND`).
d is how far pitch, roll and ground are from those of the feet, C their covariance: a floor that was
walked all around outweighs the objects, and what the feet left open is left to them. The borders
of the masks are fixed as they suit the objects at first (`fixed_borders`). An object is carried by
the ray to the centre of its base and grows with its distance, so a change of the camera leaves it
where and as large as it is in the image: else the descent creeps along that valley.
"""

from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor

from mover.core.devices import constant
from mover.core.observe import Energy, Observer, silent
from mover.core.records import map_tensors, record
from mover.core.types import Camera, Layout, Objects
from mover.energy.config import SceneConfig, SceneWeights
from mover.energy.fused.energy import energy_function
from mover.energy.minimize import minimize
from mover.energy.objective import HumanCues, ImageCues, best_borders
from mover.energy.prior_terms import KIND, student
from mover.geometry.camera import pitch_roll, tilted, to_camera
from mover.geometry.placement import GROUND, LOWEST, hit_floor
from mover.stages.config import RefineConfig
from mover.stages.objects.gather_given import standard_sizes
from mover.stages.posterior import Gaussian


def fixed_borders(
    image: ImageCues, layout: Layout, objects: Objects, camera: Camera, weights: SceneWeights
) -> ImageCues:
    """The masks and boxes under the shift that suits a layout best (`image_terms`).

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


FEET = 0.04  # weight w of a nat of feet or standards; each object counts about one
SOFT = 0.02  # [1], added to an object's own residual
UNITS = (0.01, 0.01, 0.02, 0.01, 0.05, 0.03, 0.3)
"""Of pitch, roll [rad], ground [m], rays, yaw [rad], logarithms of scales, and of kinds."""


@record
class RefineInputs:
    """A first camera and ground, what the feet say of them, objects from the image alone."""

    camera: Camera
    """Where the descent starts, and the ground below it [m]."""
    ground: float
    feet: Gaussian
    """Pitch [rad], roll [rad] and ground [m] by the feet."""
    objects: Objects
    image: ImageCues
    layout: Layout


@record
class Refined:
    """The better camera and ground."""

    camera: Camera
    ground: float
    trace: Float[Tensor, " steps"]


@record
class _Joint:
    tilt: Float[Tensor, "3"]
    rays: Float[Tensor, "objects 2"]
    yaw: Float[Tensor, " objects"]
    log_scale: Float[Tensor, "objects 3"]
    shared: Float[Tensor, " kinds"]


def refine_camera(
    inputs: RefineInputs, config: RefineConfig, observe: Observer = silent
) -> Refined:
    """Minimise over the camera, the ground and all standing objects at once."""
    objects, t = inputs.objects, inputs.layout.t_world_object
    base = to_camera(t, inputs.camera.R_cam_world)
    rays = base[:, :2] / base[:, 2:].clamp_min(0.1)
    pitch, roll = pitch_roll(inputs.camera.R_cam_world)
    tilt = torch.stack([pitch, roll, pitch.new_tensor(inputs.ground)])
    kinds = sorted(set(objects.categories))
    kind, shared = [kinds.index(name) for name in objects.categories], tilt.new_zeros(len(kinds))
    fixed = _Joint(tilt, rays, inputs.layout.yaw, inputs.layout.log_scale, shared)
    mean, certainty = inputs.feet.mean.to(tilt), inputs.feet.precision.to(tilt)
    cues = fixed_borders(inputs.image, inputs.layout, objects, inputs.camera, config.weights)
    terms = SceneConfig(config.weights, "robust", config.uniform_scale_weight)
    of_layout = energy_function(objects, inputs.camera, cues, HumanCues(), terms)
    low = -t[:, 1] > 2 * LOWEST * t.norm(dim=-1)  # below the horizon, in front of the camera
    usable = (objects.supports == GROUND) & low & (base[:, 2] > 0.3)
    usable = (usable & inputs.image.keep.flatten(1).any(-1)).to(t)
    standard, precision = (x[:, 1] for x in standard_sizes(objects)[:2])
    zero = map_tensors(torch.zeros_like, fixed)

    def placed(joint: _Joint) -> tuple[Float[Tensor, " objects"], Layout]:
        camera, layout = _unpack(joint, inputs)
        return of_layout(layout, camera.R_cam_world).per_item, layout

    with torch.no_grad():
        residual = placed(fixed)[0] + SOFT

    def energy(free: _Joint) -> Energy:
        joint = _shift(fixed, free)
        energies, layout = placed(joint)
        off = joint.tilt - mean
        feet = 0.5 * FEET * (off @ certainty @ off)
        own = precision.sqrt() * (layout.log_scale[:, 1] - standard)
        own = (own - KIND**0.5 * joint.shared[kind]).square() / (1 - KIND)
        heights = (student(own) * usable * (precision > 0)).sum() + joint.shared.square().sum()
        shares = (energies / residual * usable).sum()
        return Energy({"objects": shares, "feet": feet, "heights": 0.5 * FEET * heights})

    if not bool(usable.any()):
        return Refined(inputs.camera, inputs.ground, torch.zeros(0))
    found = minimize(energy, zero, config.method, observe, "refine_camera")
    joint = _shift(fixed, found.at)
    camera, _ = _unpack(joint, inputs)
    return Refined(camera, float(joint.tilt[2]), found.trace)


def _shift(fixed: _Joint, free: _Joint) -> _Joint:
    units = constant(UNITS, fixed.tilt)
    return _Joint(
        fixed.tilt + free.tilt * units[:3],
        fixed.rays + free.rays * units[3],
        fixed.yaw + free.yaw * units[4],
        fixed.log_scale + free.log_scale * units[5],
        fixed.shared + free.shared * units[6],
    )


def _unpack(joint: _Joint, inputs: RefineInputs) -> tuple[Camera, Layout]:
    """The camera and the objects, each as large in the image as before wherever it stands now."""
    R = tilted(joint.tilt[0], joint.tilt[1])
    rays = torch.nn.functional.pad(joint.rays, (0, 1), value=1.0)
    t = hit_floor(rays, R, joint.tilt[2])
    away = t.norm(dim=-1, keepdim=True) / inputs.layout.t_world_object.norm(dim=-1, keepdim=True)
    return replace(inputs.camera, R_cam_world=R), Layout(t, joint.yaw, joint.log_scale + away.log())
