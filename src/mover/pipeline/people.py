"""The people of a run: frames, lens, depth, feet, and from these the camera and the ground."""

import math
from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool
from torch import Tensor

from mover.bodies.corrected import in_world
from mover.bodies.parts import BodyParts, parts_of
from mover.core.errors import InputError
from mover.core.records import rows_of
from mover.core.run import Run
from mover.core.types import Bodies, Camera, CameraPath, Capture
from mover.energy.human_terms import FootContacts
from mover.geometry.path import is_still, poses_at, to_reference
from mover.geometry.rle import decode
from mover.io.capture.pose_file import moved
from mover.pipeline.presets import Config
from mover.stages.camera.align_camera import AlignInputs, Alignment, align_camera
from mover.stages.camera.find_foot_contacts import FootContactInputs, find_foot_contacts
from mover.stages.camera.find_lens import LensInputs, find_lens, through_lens, tilted_by
from mover.stages.camera.room_lines import FINE, SURE, Segments, find_segments
from mover.stages.cover import hiding
from mover.stages.objects.find_image_cues import people_in_reference
from mover.stages.people.find_depth import DepthInputs, apply_depth, find_depth, size_spread
from mover.stages.people.select_frames import select_frames

NO_POSA = (
    "contacts.npz: missing, so contacts are estimated from geometry where the paper has POSA's"
    " (mover contacts posa)"
)
LEAN = math.radians(2.0)  # of the floor under fitted bodies, whose poses err together [rad]
LOWEST, HIGHEST = -30.0, -0.05  # [m] of a floor, below the camera
APART = 1.0  # [m] between the given floor and that of the people, from which on there is a warning


@dataclass(frozen=True)
class Located:
    """The people, and the camera and the ground under them."""

    bodies: Bodies
    """All rows, in the axes of the reference image's camera, at their corrected depth."""
    path: CameraPath
    """Where the cameras of their frames were [m]."""
    kept: Bool[Tensor, " bodies"]
    parts: BodyParts
    feet: FootContacts
    alignment: Alignment
    warnings: tuple[str, ...]
    size: float
    """Standard deviation of the logarithm of all lengths together; 0: people's are trusted."""

    def in_world(self, camera: Camera) -> Bodies:
        """The rows that count, in the world of a camera."""
        return in_world(rows_of(self.bodies, self.kept), camera)


def through_its_lens(
    capture: Capture, config: Config, run: Run, pinned: tuple[str, ...]
) -> Capture:
    """The capture under the focal length and tilt that the lines of its picture constrain."""
    stated = 0.0 if capture.focal_by_lines else capture.focal_spread
    camera, guessed = capture.scene.camera, bool(stated)
    segments = lines_of(capture, config, FINE if guessed else SURE)
    if segments is None:
        return capture
    people, tilt, measured = locate(capture, config, run), config.lens.tilt, capture.tilt
    if people is not None:
        camera = replace(camera, R_cam_world=people.alignment.camera.R_cam_world)
        spread = people.alignment.covariance.diag()[:2].amax()
        tilt = min(tilt, math.hypot(config.lens.feet, float(spread) ** 0.5))
    elif measured is not None:
        camera = tilted_by(camera, measured)
    known = math.inf if measured is None else measured.spread
    by_feet = guessed and people is not None and tilt < known
    inputs = LensInputs(segments, camera, stated, min(tilt, known), by_feet)
    lens = run.stage(find_lens, inputs, config.lens)
    warnings, tilted = (*capture.warnings, *lens.warnings), lens.tilt or measured
    found = replace(capture, warnings=warnings, tilt=tilted, heading=lens.heading)
    if stated or lens.zoom != 1:
        found = replace(found, focal_spread=lens.spread)
    return through_lens(found, lens.zoom, pinned)


def lines_of(
    capture: Capture, config: Config, fineness: tuple[float, float] = SURE
) -> Segments | None:
    """Straight edges of the reference image of a still camera, where a preset looks for them."""
    picture, centre = capture.reference, capture.scene.camera.K[:2, 2]
    if not config.lens.use or picture is None or not is_still(capture.path):
        return None
    masks = [decode(d.mask, 0) for d in capture.detections if d.mask is not None]
    objects = torch.stack(masks) if masks else None
    return find_segments(picture, people_in_reference(capture), centre, fineness, objects)


def estimate_people(capture: Capture, config: Config, run: Run) -> Located | None:
    """The people of a run, with a warning where their floor is not the given one.

    Raises:
        InputError: If no camera stands above such a floor.
    """
    found = locate(capture, config, run)
    if found is None:
        return None
    odd = check_floor(found.alignment.ground, capture)
    if config.foot_contacts.given and capture.touch is None:
        odd += (NO_POSA,)
    return replace(found, warnings=(*found.warnings, *odd))


def locate(capture: Capture, config: Config, run: Run) -> Located | None:
    """Choose frames, find the people's depth and their feet, and from these camera and ground."""
    given, scene, path = capture.bodies, capture.scene, capture.path
    if given is None:
        return None
    parts = parts_of(given, scene.camera.R_cam_world[:, 1])
    chosen = chosen_people(capture, parts, config, run)
    bodies, kept = carried(chosen.bodies, path), chosen.kept
    touch = capture.touch if config.foot_contacts.given else None
    standing = FootContactInputs(bodies, parts, kept, scene.camera, touch)
    feet = run.stage(find_foot_contacts, standing, config.foot_contacts)
    tilt = capture.tilt
    camera = scene.camera if tilt is None else tilted_by(scene.camera, tilt)
    tilt_spread = None if tilt is None else tilt.spread
    lean = 0.0 if bodies.size_spread is None else LEAN
    heights = capture.people is not None and bool(capture.people.heights)
    size = 0.0 if heights else size_spread(bodies, config.height_spread)
    known = AlignInputs(feet, camera, scene.ground, capture.camera_height, tilt_spread, lean, size)
    alignment = run.stage(align_camera, known, config.align)
    warnings = (*chosen.warnings, *feet.warnings, *alignment.warnings)
    return Located(bodies, path, kept, parts, feet, alignment, warnings, size)


@dataclass(frozen=True)
class ChosenPeople:
    """People at their corrected depth, in the axes of the cameras of their frames."""

    bodies: Bodies
    kept: Bool[Tensor, " bodies"]
    """The frames that count."""
    warnings: tuple[str, ...]


def chosen_people(capture: Capture, parts: BodyParts, config: Config, run: Run) -> ChosenPeople:
    """Choose frames (Sec. 3.1) and, with masks, correct the depth of each person."""
    bodies, path, masks = capture.bodies, capture.path, capture.people
    assert bodies is not None
    kept = run.stage(select_frames, carried(bodies, path), config.select).keep
    if not config.correct_depth or masks is None:
        return ChosenPeople(bodies, kept, ())
    camera = capture.scene.camera
    inputs = DepthInputs(bodies, parts, kept, masks, hiding(capture, path), camera)
    depth = run.stage(find_depth, inputs, config.depth)
    return ChosenPeople(apply_depth(bodies, depth), kept, depth.warnings)


def carried(bodies: Bodies, path: CameraPath) -> Bodies:
    """Bodies from the axes of their frames' cameras into those of the reference image's camera."""
    if is_still(path):
        return bodies
    poses = poses_at(path, bodies.frame)
    joints, pose = bodies.joints, bodies.pose
    if pose is not None:
        pose = moved(pose, poses.R_reference_camera, poses.t_reference_camera)
    return replace(
        bodies, verts=to_reference(bodies.verts, poses), pose=pose,
        joints=None if joints is None else to_reference(joints, poses),
    )  # fmt: skip


def check_floor(ground: float, capture: Capture) -> tuple[str, ...]:
    """Refuse a floor that no camera stands above; warn where a given one is elsewhere.

    Raises:
        InputError: If the floor is above the camera, or farther below it than in any room.
    """
    if not LOWEST <= ground <= HIGHEST:
        side = "above" if ground > 0 else "below"
        cause = "scene.json: 'ground.height'"
        if capture.bodies is not None:
            cause = "bodies.npz: the feet of the people"
        tilt = "R_cam_world upright" if capture.tilt is None else "the tilt (--tilt) the camera's"
        raise InputError(
            f"{cause} put the floor {abs(ground):.3g} m {side} the camera, expected {-HIGHEST:g} to"
            f" {-LOWEST:g} m below; are places in metres, y down, z forward, and {tilt}?"
        )
    given = capture.scene.ground
    if given is None or abs(given - ground) <= APART:
        return ()
    return (
        f"scene.json: field 'ground.height' has {given:.3g}, but people stand at {ground:.3g} m,"
        " which is taken",
    )
