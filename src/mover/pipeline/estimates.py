"""What a whole room depends on: lens, scale, statures, standard sizes; and what would narrow it."""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from mover.bodies.parts import BodyParts
from mover.core.types import Bodies, Camera, SceneObject
from mover.fitting.priors import ADULT, ADULTS, size_of
from mover.furniture.library import STANDARD, canonical
from mover.geometry.boxes import box_of
from mover.geometry.camera import pitch_roll
from mover.stages.camera.find_foot_contacts import straight_legs
from mover.stages.objects.gather_given import MEANINGS
from mover.stages.people.find_depth import pelvis

ODD = 2.5  # standard deviations from the population or a standard, from which there is a warning
POOR = 0.025  # of a person's height: keypoints that a fit misses by more
LOOSE = 0.02  # spread of the logarithm of a focal length, or of a room's size: worth a cure
TILTED = math.radians(1.0)  # spread of pitch or roll: worth a cure [rad]
AXES = ("wide", "high", "deep")


def lens_and_scale(camera: Camera, lens: float | None, size: float | None) -> tuple[str, str]:
    """Lens and scale of a room with their spreads, and what would narrow them.

    `lens` is the standard deviation of the logarithm of the focal length, None: not stated; `size`
    that of all lengths together, 0: it was given, None: no people.
    """
    focal = float(camera.K[0, 0])
    across = math.degrees(2 * math.atan(camera.width / (2 * focal)))
    text = f"lens: focal length {focal:.0f} px, {across:.0f}° across"
    text += ", not stated how it was found" if lens is None else f", ± {100 * lens:.1f} %"
    if lens is not None and lens > LOOSE:
        text += "; a measured one (camera.json, 'focal_spread': 0) would narrow it"
    if size is None:
        return text, "scale: that of the initial scene, as there are no people"
    scale = "scale: as the size of the people or the camera's height was given"
    if size:
        scale = f"scale: all lengths ± {100 * size:.1f} %"
    if size > LOOSE:
        scale += (
            "; a person's height (mover fit --height or mover video --height, 'heights' in"
            " people.json) would narrow it"
        )
    return text, scale


def tilt_of_camera(camera: Camera, spread: float) -> str:
    """Pitch and roll of a room's camera, and what would narrow them.

    `spread` is the larger standard deviation [rad] by the feet and what else was known.
    """
    pitch, roll, off = (
        math.degrees(float(angle)) for angle in (*pitch_roll(camera.R_cam_world), spread)
    )
    text = f"camera: pitch {pitch:.1f}°, roll {roll:.1f}°, ± {off:.1f}° before the furniture"
    if spread > TILTED:
        text += "; a measured tilt (mover import --tilt or mover video --tilt) would narrow it"
    return text


def odd_statures(bodies: Bodies, parts: BodyParts) -> tuple[str, ...]:
    """People in the world who are taller or shorter than `ODD` deviations from adults allow."""
    if not len(bodies.frame):
        return ()
    up = torch.tensor([0.0, 1.0, 0.0]).to(bodies.verts)
    stands = straight_legs(bodies, parts, up).all(1)
    found: list[str] = []
    for person in bodies.person.unique().tolist():
        height = bodies.verts[stands & (bodies.person == person), :, 1]
        if not len(height):
            continue
        tall = float((height.amax(1) - height.amin(1)).median())
        if abs(tall - ADULT) > ODD * ADULTS:
            found.append(
                f"person {person} is {tall:.2f} m tall, {abs(tall - ADULT) / ADULTS:.1f} standard"
                " deviations from adults, and the room is as large; a known height (mover fit"
                " --height or mover video --height, 'heights' in people.json) or a measured lens"
                " would correct it"
            )
    return tuple(found)


def odd_sizes(objects: tuple[SceneObject, ...]) -> tuple[str, ...]:
    """Furniture whose size is more than `ODD` deviations from the standard of its class."""
    found: list[str] = []
    for item in objects:
        size, name = box_of(item).size.tolist(), canonical(item.category)
        off = [_beyond(size, kind) for kind in MEANINGS.get(name, (name,))]
        if min(by for _, by, _ in off) > ODD:
            axis, by, usual = min(off, key=lambda one: abs(math.log(size[one[0]] / one[2])))
            found.append(
                f"{item.id} is {size[axis]:.2f} m {AXES[axis]}, {by:.1f} standard deviations from"
                f" the usual {usual:.2f} m of its class; its initial size, the lens or a person's"
                " height may be wrong"
            )
    return tuple(found)


def _beyond(size: list[float], kind: str) -> tuple[int, float, float]:
    """The axis along which a size is farthest from a class's standard, by how much, and that."""
    known = [(k, one) for k, one in enumerate(STANDARD.get(kind, ())) if one is not None]
    off = [(k, abs(math.log(size[k] / s)) / spread, s) for k, (s, spread) in known if size[k] > 0]
    return max(off, key=lambda one: one[1], default=(0, 0.0, 0.0))


def poor_fits(bodies: Bodies, miss: Float[Tensor, " bodies"], camera: Camera) -> tuple[str, ...]:
    """People whose fitted bodies (in camera axes) miss their keypoints [px] by more than `POOR`."""
    assert bodies.joints is not None
    tall = ADULT * size_of(bodies.joints) * camera.K[1, 1] / pelvis(bodies)[:, 2].clamp_min(0.1)
    share = miss / tall
    found = {p: float(share[bodies.person == p].median()) for p in bodies.person.unique().tolist()}
    return tuple(
        f"person {person}: the fit misses the keypoints by {100 * by:.1f} % of the person's height;"
        " is the lens right, and are the joints in the right order?"
        for person, by in found.items()
        if by > POOR
    )
