"""Tilt of the camera and its height above the floor, as the feet of people tell them.

A picture alone says little of either, and a first scene on a floor of the wrong height is wrong as
a whole: bodies from keypoints, which know no floor either, still stand on one.
"""

import math
from dataclasses import replace

from mover.bodies.parts import parts_of
from mover.core.run import Run
from mover.core.types import Bodies
from mover.perceive.layout import Picture
from mover.stages.camera.align_camera import AlignInputs, Alignment, align_camera
from mover.stages.camera.find_foot_contacts import FootContactInputs, find_foot_contacts
from mover.stages.config import AlignConfig, FootContactConfig, SelectConfig
from mover.stages.people.select_frames import SelectInputs, select_frames

LOOSE = (math.radians(2), math.radians(2), 0.1)  # pitch, roll [rad] and ground [m] that are no news
GUESSED = AlignConfig(tilt_prior=math.radians(8))  # a camera that nobody measured looks anywhere


def standing_on(picture: Picture, bodies: Bodies, run: Run) -> Picture:
    """The picture with tilt and height of its camera, where the feet of people tell them.

    Args:
        picture: Its camera is a guess.
        bodies: In camera axes; in world axes they say nothing that is not known.
        run: Keeps what is finished.
    """
    if bodies.space != "camera" or picture.height is not None:
        return picture
    camera = picture.camera
    keep = run.stage(select_frames, SelectInputs(bodies), SelectConfig()).keep
    parts = parts_of(bodies, camera.R_cam_world[:, 1])
    standing = FootContactInputs(bodies, parts, keep, camera)
    feet = run.stage(find_foot_contacts, standing, FootContactConfig())
    found = run.stage(align_camera, AlignInputs(feet, camera, None, None), GUESSED)
    if not _certain(found):
        return picture
    spread = bodies.size_spread or None
    return replace(picture, camera=found.camera, height=-found.ground, height_spread=spread)


def _certain(found: Alignment) -> bool:
    """Whether the feet tell more than nothing."""
    spreads = found.covariance.diagonal().clamp_min(0).sqrt().tolist()
    return found.ground < 0 and all(s < most for s, most in zip(spreads, LOOSE, strict=True))
