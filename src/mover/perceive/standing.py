"""Tilt of the camera and its height above the floor, as feet and straight edges tell them.

Boxes alone say little of either, and a first scene on a floor of the wrong height is wrong as a
whole: bodies from keypoints, which know no floor either, still stand on one. Their poses are off
together, and with them the tilt by a degree or more; edges of the room tell it far better, and
along which directions furniture stands. Then the feet tell the height under that tilt.
"""

import math
from dataclasses import replace

from mover.bodies.parts import parts_of
from mover.core.run import Run
from mover.core.types import Bodies
from mover.perceive.layout import Picture
from mover.stages.camera.align_camera import AlignInputs, Alignment, align_camera
from mover.stages.camera.config import LensConfig
from mover.stages.camera.find_foot_contacts import FootContactInputs, find_foot_contacts
from mover.stages.camera.find_lens import MEASURED, heading_of, tilt_of, tilted_by
from mover.stages.camera.room_lines import SURE, Prior, find_segments, fit_room
from mover.stages.config import AlignConfig, FootContactConfig, SelectConfig
from mover.stages.people.select_frames import SelectInputs, select_frames

LOOSE = (math.radians(2), math.radians(2), 0.1)  # pitch, roll [rad] and ground [m] that are no news
SEEN = AlignConfig(tilt_prior=math.radians(0.03))  # a tilt that edges told stays: feet err more
GUESSED = AlignConfig(tilt_prior=math.radians(8))  # a camera that nobody measured looks anywhere


def seen_from(picture: Picture, bodies: Bodies | None, run: Run) -> Picture:
    """The picture with what feet and its edges tell of camera and room.

    Args:
        picture: Its camera is a guess.
        bodies: Of the people; None: nobody is known.
        run: Keeps what is finished.
    """
    by_feet = picture if bodies is None else standing_on(picture, bodies, run)
    found = along_edges(by_feet, by_feet is not picture)
    if bodies is None or found.tilt_spread is None:
        return found
    return standing_on(replace(found, height=picture.height), bodies, run)


def along_edges(picture: Picture, by_feet: bool) -> Picture:
    """The picture with the tilt of its camera and the room's heading, where its edges tell them.

    Args:
        picture: Its focal length counts as known.
        by_feet: Whether feet told the tilt already.
    """
    camera = picture.camera
    if picture.reference is None:
        return picture
    segments = find_segments(picture.reference, picture.people, camera.K[:2, 2], SURE)
    spread = LensConfig.feet if by_feet else LensConfig.tilt
    up = camera.R_cam_world[:, 1].double()
    prior = Prior(float(camera.K[0, 0].double().log()), MEASURED, up, spread)
    ends = fit_room(segments, prior, camera.R_cam_world)
    tilt, heading = tilt_of(ends, spread), heading_of(ends)
    if tilt is not None:
        picture = replace(picture, camera=tilted_by(camera, tilt), tilt_spread=tilt.spread)
    return replace(picture, heading=heading, segments=segments)


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
    believed = GUESSED if picture.tilt_spread is None else SEEN
    found = run.stage(align_camera, AlignInputs(feet, camera, None, None), believed)
    if not _certain(found):
        return picture
    spread = bodies.size_spread or None
    return replace(picture, camera=found.camera, height=-found.ground, height_spread=spread)


def _certain(found: Alignment) -> bool:
    """Whether the feet tell more than nothing."""
    spreads = found.covariance.diagonal().clamp_min(0).sqrt().tolist()
    return found.ground < 0 and all(s < most for s, most in zip(spreads, LOOSE, strict=True))
