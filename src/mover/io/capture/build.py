"""The one builder of captures: put the parts together and check that they fit one another."""

import dataclasses

import torch

from mover.core.errors import InputError
from mover.core.types import STILL, Bodies, Camera, Capture, Detection, Scene
from mover.geometry.camera import pitch_roll
from mover.geometry.path import is_still
from mover.geometry.rotations import rot_y
from mover.io.capture.annotations_file import PeopleFile, detections_of, furniture_of, people_of
from mover.io.capture.bodies_file import bodies_of, read_touch
from mover.io.capture.camera_file import CameraFields, camera_of, measured_tilt, path_of
from mover.io.capture.parts import Parts
from mover.io.capture.plausible import check_plausible
from mover.io.capture.pose_file import into_camera
from mover.io.capture.scene_file import hypotheses_of, scene_of
from mover.io.capture.tracks import pair_tracks
from mover.io.files.fields import At, Warn, listed
from mover.io.files.schema import checked

SLOW, FAST = 2.0, 250.0  # frames a second, of usual videos
SAME_RATE = 0.01  # relative difference of two rates that are one


def build_capture(parts: Parts) -> Capture:
    """Check everything that is known of a capture and build it; there is no other way to one."""
    if parts.camera is None or parts.scene is None or parts.objects is None:
        lacking = [f"{n}.json" for n in ("camera", "scene", "objects") if not getattr(parts, n)]
        raise InputError(f"{parts.name}: has no {lacking[0]}, expected one (see `mover import`)")
    warnings: list[str] = []
    warn = warnings.append
    scene, turn = scene_of(parts.scene, parts.load_mesh, camera_of(parts.camera), warn)
    camera, lens = scene.camera, checked(parts.camera, CameraFields)
    _check_camera(parts.camera, camera, warn)
    detections = detections_of(parts.objects, camera, warn)
    _check_annotations(parts.scene, parts.objects.file, scene, detections, warn)
    none = PeopleFile(None, None, None)
    people = people_of(parts.people, camera, warn) if parts.people else none
    bodies = _bodies_of(parts.bodies, camera, turn, people.fps, warn)
    touch = None
    if parts.contacts is not None and bodies is not None:
        touch = read_touch(parts.contacts, bodies)
    elif parts.contacts is not None:
        warn("contacts.npz: there are no bodies, so it is not used")
    _check_frames(parts, bodies)
    bodies, people = _same_people(bodies, people, camera, warn)
    given, path = parts.hypotheses, STILL
    others = hypotheses_of(given, parts.load_mesh, scene, warn) if given else ()
    if parts.load_image is None:
        warn(f"{parts.no_image}: there is no picture to draw on")
    given = parts.furniture
    furniture = furniture_of(given, camera, detections, warn) if given else None
    if parts.cameras is not None:
        path = path_of(parts.cameras, camera, bodies, warn)
        space = None if parts.bodies is None or is_still(path) else parts.bodies.get("space")
        if space is not None and str(space.array((), "text")) != "camera":
            space.refuse("'camera': cameras.npz carries people into the room's world", "'world'")
    capture = Capture(
        name=parts.name, scene=scene, camera_height=lens.height, detections=detections,
        reference=None if parts.load_image is None else parts.load_image(camera),
        reference_people=people.reference, bodies=bodies, people=people.people, touch=touch,
        warnings=(), hypotheses=others, furniture=furniture, path=path,
        depth=None if parts.load_depth is None else parts.load_depth(camera),
        focal_spread=lens.focal_spread, focal_by_lines=lens.focal_by_lines,
        tilt=measured_tilt(parts.camera),
    )  # fmt: skip
    check_plausible(capture, warn)
    return dataclasses.replace(capture, warnings=tuple(warnings))


def _check_camera(at: At, camera: Camera, warn: Warn) -> None:
    """Warn where scene.json has another camera; a measured tilt may be off from its estimate."""
    other = camera_of(at, camera)
    if measured_tilt(at) is not None:
        other = dataclasses.replace(other, R_cam_world=camera.R_cam_world)
    if _lens(other) != _lens(camera):
        warn(f"scene.json: its camera counts ({_lens(camera)}), not camera.json "
             f"({_lens(other)}); give one in both")  # fmt: skip


def _lens(camera: Camera) -> str:
    """Size, lens and tilt as a message names them."""
    K, tilt = camera.K.tolist(), [round(float(v), 2) + 0.0 for v in pitch_roll(camera.R_cam_world)]
    lens = f"fl_x {K[0][0]:.4g}, fl_y {K[1][1]:.4g}, cx {K[0][2]:.4g}, cy {K[1][2]:.4g}"
    return f"{camera.width} x {camera.height}, {lens}, pitch {tilt[0]} rad, roll {tilt[1]} rad"


def _check_annotations(
    tree: At, file: str, scene: Scene, detections: tuple[Detection, ...], warn: Warn
) -> None:
    """Objects name annotations that exist; the others are named in warnings."""
    known, used = {d.id for d in detections}, {p.annotation for p in scene.objects}
    for item, piece in zip(tree.get("objects").items(), scene.objects, strict=True):
        if piece.annotation is not None and piece.annotation not in known:
            item.get("annotation").refuse(f"the id of an annotation in {file}")
    if bare := [piece.id for piece in scene.objects if piece.annotation is None]:
        warn(f"scene.json: {listed('object', bare)} without annotation, no evidence in the image")
    if unused := [f"{d.id} {d.category}" for d in detections if d.id not in used]:
        warn(f"{file}: {listed('annotation', unused)} without object in the scene")
    if not scene.objects:
        warn("scene.json: there are no objects")


def _bodies_of(
    at: At | None, camera: Camera, turn: float, fps: float | None, warn: Warn
) -> Bodies | None:
    """Bodies in the camera frame."""
    if at is None:
        warn("bodies.npz: there is none, so the image alone is used")
        return None
    bodies = bodies_of(at, warn)
    if bodies.space == "world":
        # The file's world is that of scene.json, before its heading was taken out.
        bodies = into_camera(bodies, camera.R_cam_world @ rot_y(torch.tensor(turn)))
    rate = fps if bodies.fps is None else bodies.fps
    if rate is None and len(bodies.frame.unique()) > 1:
        warn("bodies.npz: has no frame rate, so the people's speed is not used (give --fps)")
    elif rate is not None and not SLOW <= rate <= FAST:
        warn(f"bodies.npz: has {rate:g} frames a second; is that the rate of the video?")
    if rate is not None and fps is not None and abs(rate / fps - 1) > SAME_RATE:
        warn(f"bodies.npz: has {rate:g} frames a second, people.json {fps:g}; the bodies' counts")
    return dataclasses.replace(bodies, fps=rate)


def _same_people(
    bodies: Bodies | None, people: PeopleFile, camera: Camera, warn: Warn
) -> tuple[Bodies | None, PeopleFile]:
    """Bodies and masks with one number for each person; warns of rows without a partner."""
    if people.people is None:
        warn("people.json: there are no masks of people, so nothing is known about depth order")
        return bodies, people
    if bodies is None:
        return bodies, people
    bodies, masks, notes = pair_tracks(bodies, people.people, camera)
    for note in notes:
        warn(note)
    shown, rows = (
        set(zip(one.frame.tolist(), one.person.tolist(), strict=True)) for one in (masks, bodies)
    )
    if lone := len(rows - shown):
        warn(f"people.json: {lone} of {len(rows)} bodies have no mask and no depth order")
    if lone := len(shown - rows):
        warn(f"bodies.npz: {lone} of {len(shown)} masks of people have no body")
    return bodies, dataclasses.replace(people, people=masks)


def _check_frames(parts: Parts, bodies: Bodies | None) -> None:
    """No frame lies behind the end of the video."""
    count = parts.n_frames
    if count is None:
        return
    expected = f"a frame from 0 to {count - 1}, as frames/ has {count}"
    if bodies is not None and parts.bodies is not None and bodies.frame.max() >= count:
        parts.bodies.get("frame").refuse(expected, f"{int(bodies.frame.max())}")
    images = [] if parts.people is None else parts.people.get("images").items()
    last = max((image.get("id").value for image in images), default=-1)
    if parts.people is not None and last >= count:
        parts.people.get("images").refuse(expected, f"{last}")
