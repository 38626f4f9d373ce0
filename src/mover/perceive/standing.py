"""Tilt of the camera and its height above the floor, from feet and straight edges.

Boxes alone constrain neither well, and a first scene on a floor of the wrong height is wrong as a
whole: bodies from keypoints, which know no floor either, still stand on one. Their poses err
together, and with them the tilt by some degrees; edges of the room show it far better, and the
directions along which furniture stands. What feet and edges leave open is decided with the boxes:
they are handed on as an estimate with its covariance (`Gaussian`).
"""

import math
from dataclasses import replace

import torch

from mover.bodies.parts import parts_of
from mover.core.run import Run
from mover.core.types import Bodies
from mover.geometry.camera import pitch_roll, tilted
from mover.perceive.layout import Picture
from mover.stages.camera.align_camera import LEVEL, AlignInputs, Alignment, align_camera
from mover.stages.camera.find_foot_contacts import FootContactInputs, find_foot_contacts
from mover.stages.camera.find_lens import MEASURED, heading_of, tilt_of, tilted_by
from mover.stages.camera.room_lines import SURE, Prior, find_segments, fit_room
from mover.stages.config import AlignConfig, FootContactConfig, LensConfig, SelectConfig
from mover.stages.people.select_frames import select_frames
from mover.stages.posterior import Gaussian, diagonal

POSES = math.radians(2.0)  # [rad] by which a floor under fitted bodies leans: feet err together
HEIGHTS = 0.05  # of the logarithm of the floor's depth, beside the size of the people
GIVEN = 0.02  # of the logarithm of a given height of the camera
SEEN = AlignConfig(tilt_prior=math.radians(0.03))  # a tilt from edges stays: feet err more
GUESSED = AlignConfig(tilt_prior=LEVEL[0])  # a camera of unknown tilt looks anywhere


def seen_from(picture: Picture, bodies: Bodies | None, run: Run) -> Picture:
    """The picture with the camera and heading of the room by feet and by its own edges."""
    by_feet = picture if bodies is None else standing_on(picture, bodies, run)
    found = along_edges(by_feet)
    if bodies is None or found.tilt_spread == by_feet.tilt_spread:
        return found
    return standing_on(replace(found, prior=None), bodies, run)


def along_edges(picture: Picture) -> Picture:
    """The picture with tilt and heading where its edges show them; its focal length is trusted."""
    camera = picture.camera
    if picture.reference is None:
        return picture
    centre, masks = camera.K[:2, 2], picture.masks
    segments = find_segments(picture.reference, picture.people, centre, SURE, masks)
    spread = min(LensConfig.tilt, picture.tilt_spread or math.inf)
    if picture.prior is not None:
        tilts = torch.linalg.inv(picture.prior.precision).diagonal()[:2]
        spread = min(spread, float(tilts.amax()) ** 0.5)
    up = camera.R_cam_world[:, 1].double()
    prior = Prior(float(camera.K[0, 0].double().log()), MEASURED, up, spread)
    ends = fit_room(segments, prior, camera.R_cam_world)
    tilt, heading = tilt_of(ends, spread), heading_of(ends)
    if tilt is not None:
        picture = replace(picture, camera=tilted_by(camera, tilt), tilt_spread=tilt.spread)
    return replace(picture, heading=heading, segments=segments)


def standing_on(picture: Picture, bodies: Bodies, run: Run) -> Picture:
    """The picture with the camera that the feet of people constrain, and how well they do.

    Bodies in world axes say nothing that is not known.
    """
    if bodies.space != "camera":
        return picture
    camera = picture.camera
    keep = run.stage(select_frames, bodies, SelectConfig()).keep
    parts = parts_of(bodies, camera.R_cam_world[:, 1])
    standing = FootContactInputs(bodies, parts, keep, camera)
    feet = run.stage(find_foot_contacts, standing, FootContactConfig())
    config = GUESSED if picture.tilt_spread is None else SEEN
    lean = POSES if picture.tilt_spread is None else 0.0
    inputs = AlignInputs(feet, camera, None, None, lean=lean)
    found = run.stage(align_camera, inputs, config)
    if found.ground >= 0:
        return picture
    prior = camera_prior(found, picture, bodies.size_spread or 0.0)
    R = tilted(prior.mean[0], prior.mean[1]).to(camera.R_cam_world)
    return replace(picture, camera=replace(camera, R_cam_world=R), prior=prior)


def camera_prior(found: Alignment, picture: Picture, size: float) -> Gaussian:
    """The camera of the feet, with the errors that all of them share, and usual cameras.

    A hundred feet err together: by the lean of all poses, and by the size of the people (`size` is
    the standard deviation of its logarithm).
    """
    height = -found.ground
    to_log = torch.tensor([1.0, 1.0, -1 / height], dtype=torch.float64)
    covariance = found.covariance.double().cpu() * to_log * to_log[:, None]
    tilt = picture.tilt_spread or 0.0
    covariance += torch.tensor([tilt**2, tilt**2, HEIGHTS**2 + size**2]).double().diag()
    pitch, roll = (float(x) for x in pitch_roll(found.camera.R_cam_world.double()))
    observed = torch.tensor([pitch, roll, math.log(height)], dtype=torch.float64)
    before = [float(x) for x in pitch_roll(picture.camera.R_cam_world.double())]
    usual = torch.tensor([*before, math.log(picture.height or height)], dtype=torch.float64)
    known = math.inf if picture.height is None else GIVEN
    spreads = LEVEL if picture.tilt_spread is None else (picture.tilt_spread,) * 2
    prior = diagonal(usual, torch.tensor([*spreads, known], dtype=torch.float64))
    both = Gaussian(observed, torch.linalg.inv(covariance)).times(prior)
    return Gaussian(both.mean.float(), both.precision.float())
