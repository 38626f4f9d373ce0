"""Find the focal length that a tool guessed, from the lines of the reference picture.

Not in the paper, which takes the lens as given. Bodies and scene that were made under a wrong lens
contradict nothing: all is seen where it is, and only depths are off, by the same factor as the
lens. The picture's own lines (`room_lines`) constrain it. Two rules keep what is right:

- only a focal length that is stated to be a guess (`focal_spread` in camera.json, `--fov`) is
  changed; one of which nothing is stated counts as measured to 1 %;
- lines that fit several cameras, or none, constrain little, and are weighted with the guess.
"""

import dataclasses
import math

import torch
from jaxtyping import Float
from torch import Tensor

from mover.core.observe import Observer, Step, silent
from mover.core.records import record, rows_of
from mover.core.types import Camera, Capture, Heading, SceneObject, Tilt
from mover.geometry.boxes import box_of
from mover.geometry.camera import pitch_roll, tilted
from mover.geometry.rotations import wrap
from mover.stages.camera.room_lines import Ends, Prior, Segments, counted_once, fit_from, fit_room
from mover.stages.config import LensConfig
from mover.stages.people.find_depth import pelvis, shifted

MEASURED = 0.003  # error of the logarithm of a measured focal length
UNSTATED = 0.01  # the same where nothing is stated of how it was found
SYSTEMATIC = 0.012  # error of the logarithm that more lines do not make smaller: a bent picture
SYSTEMATIC_TILT = 0.003  # [rad]
VAGUE = math.radians(5)  # spread of a heading that says nothing
HALVES = 8  # random halves of the lines: their estimates differ as much as that of all may be off
SAYS_LITTLE = 0.95  # of the spread before any line: lines that leave more of it are no evidence


@record
class LensInputs:
    """Lines of the reference picture, and the camera under which all else was made."""

    segments: Segments
    camera: Camera
    """Pitch and roll by the feet, or as they are given."""
    focal_spread: float | None
    """What is said of the focal length; None: nothing."""
    tilt_spread: float
    """How far off pitch and roll are [rad]."""
    by_feet: bool = False
    """Whether they are those of a floor on which feet rest, at depths under this focal length."""


@record
class LensEstimate:
    """The lens, as estimated from the lines of the image."""

    zoom: float
    """Focal length to take over the given one; 1 where it is kept."""
    spread: float
    """Standard deviation of its logarithm."""
    tilt: Tilt | None
    """None: the lines do not determine it."""
    heading: Heading | None
    """The same of the room."""
    warnings: tuple[str, ...] = ()


def find_lens(inputs: LensInputs, _config: LensConfig, observe: Observer = silent) -> LensEstimate:
    """How much longer the lens is than the given one, if that was a guess."""
    stated, camera = inputs.focal_spread, inputs.camera
    spread = UNSTATED if stated is None else max(stated, MEASURED)
    up = camera.R_cam_world[:, 1].double().cpu()
    focal = float(camera.K[0, 0].double().log())
    prior = Prior(focal, spread, up, inputs.tilt_spread, inputs.by_feet)
    ends = fit_room(inputs.segments, prior, camera.R_cam_world)
    observe(Step("find_lens", 0, 1))
    observed, tilt = _observed(ends, focal, spread), tilt_of(ends, inputs.tilt_spread)
    heading = heading_of(ends)
    if observed is None or not stated:
        return LensEstimate(1.0, spread, tilt, heading)
    off, error = observed
    between = _between_halves(inputs.segments, prior, ends)
    if between >= SAYS_LITTLE * spread:
        return LensEstimate(1.0, spread, tilt, heading)
    wide = math.hypot(error, spread)
    left = max(error * spread / wide, between)
    zoom = math.exp(off * (spread / wide) ** 2)
    warnings = (_sentence(zoom, left),) if abs(math.log(zoom)) > left else ()
    return LensEstimate(zoom, left, tilt, heading, warnings)


def _between_halves(segments: Segments, prior: Prior, ends: Ends) -> float:
    """Standard deviation of the focal length's logarithm between random halves of the lines.

    Half-sampling (Politis and Romano, Ann. Statist. 1994): what fits one sharply may be another
    camera than what fits the other half.
    """
    chance, found = torch.Generator().manual_seed(0), list[float]()
    for _ in range(HALVES):
        half = rows_of(segments, torch.rand(len(segments.vote), generator=chance) < 0.5, "lines")
        other = fit_from(counted_once(half), prior, ends.pose)
        found.append(float(_over(other, other.pose.log_focal[:, None], [0])[0]))
    return max(float(torch.tensor(found).std()), MEASURED)


def tilt_of(ends: Ends, before: float) -> Tilt | None:
    """Pitch and roll over all ends; None where that is no better than what was known."""
    both = torch.stack(pitch_roll(ends.pose.R_cam_room), -1)
    mean, square = _over(ends, both, [1, 3])  # about x and z
    spread = math.hypot(float(square.amax()) ** 0.5, SYSTEMATIC_TILT)
    return Tilt(float(mean[0]), float(mean[1]), spread) if spread < before / 2 else None


def tilted_by(camera: Camera, tilt: Tilt) -> Camera:
    """The camera with the tilt by lines."""
    R = tilted(torch.tensor(tilt.pitch), torch.tensor(tilt.roll)).to(camera.R_cam_world)
    return dataclasses.replace(camera, R_cam_world=R)


def heading_of(ends: Ends) -> Heading | None:
    """The heading over all ends; None where they hardly agree."""
    R = ends.pose.R_cam_room
    level = tilted(*pitch_roll(R)).mT @ R
    yaw = torch.atan2(level[:, 0, 2], level[:, 2, 2])
    off = wrap(4 * (yaw - yaw[0])) / 4  # quarter turns aside
    mean, square = _over(ends, off[:, None], [2])  # about y
    spread = math.hypot(float(square) ** 0.5, SYSTEMATIC_TILT)
    return Heading(float(yaw[0] + mean), spread) if spread < VAGUE else None


def _observed(ends: Ends, focal: float, spread: float) -> tuple[float, float] | None:
    """The logarithm of the zoom by the lines alone, and its error; None: not constrained."""
    off, square = _over(ends, (ends.pose.log_focal - focal)[:, None], [0])
    mean, left = float(off), float(square) ** 0.5
    if not left < SAYS_LITTLE * spread:
        return None
    error = (left**-2 - spread**-2) ** -0.5
    return mean * (error / left) ** 2, math.hypot(error, SYSTEMATIC)


def _over(
    ends: Ends, values: Float[Tensor, "starts values"], unknowns: list[int]
) -> tuple[Float[Tensor, " values"], Float[Tensor, " values"]]:
    """Mean and variance over all ends by their probability; `unknowns` are those of each end."""
    weight = (ends.cost.min() - ends.cost).exp()
    weight = (weight / weight.sum())[:, None]
    mean = (weight * values).sum(0)
    own = torch.linalg.inv(ends.precision).diagonal(0, 1, 2)[:, unknowns]
    return mean, (weight * (own + (values - mean).square())).sum(0)


def _sentence(zoom: float, spread: float) -> str:
    change = f"{100 * abs(zoom - 1):.1f} ± {100 * spread:.1f} %"
    which = "longer" if zoom > 1 else "shorter"
    return (
        f"camera.json: the lines of the picture show a focal length {change} {which} than the"
        ' given one, which "focal_spread" states to be a guess; 0 there keeps a measured one'
    )


def through_lens(capture: Capture, zoom: float, pinned: tuple[str, ...] = ()) -> Capture:
    """The capture as it is seen through another lens: all depths longer, as the picture stays.

    `pinned` objects are where the user says.
    """
    if zoom == 1:
        return capture
    scene, camera, bodies = capture.scene, capture.scene.camera, capture.bodies
    objects = tuple(p if p.id in pinned else _deeper(p, camera, zoom) for p in scene.objects)
    scene = dataclasses.replace(scene, camera=zoomed(camera, zoom), objects=objects)
    others = tuple(_deeper(piece, camera, zoom) for piece in capture.hypotheses)
    if bodies is not None:
        gap = torch.zeros_like(bodies.verts[:, 0])
        gap[:, 2] = (zoom - 1) * pelvis(bodies)[:, 2]
        bodies = shifted(bodies, gap)
    return dataclasses.replace(capture, scene=scene, hypotheses=others, bodies=bodies)


def _deeper(piece: SceneObject, camera: Camera, zoom: float) -> SceneObject:
    R = camera.R_cam_world.double()
    away = R[2] @ box_of(piece).center.double()
    t = piece.t_world_object.double() + (zoom - 1) * away * R[2]
    return dataclasses.replace(piece, t_world_object=t.to(piece.t_world_object))


def zoomed(camera: Camera, zoom: float) -> Camera:
    """The camera with a focal length that is longer by a factor."""
    K = camera.K.clone()
    K[0, 0], K[1, 1] = K[0, 0] * zoom, K[1, 1] * zoom
    return dataclasses.replace(camera, K=K)
