"""The one builder of captures: put the parts together and check that they fit one another."""

import dataclasses

import torch
from jaxtyping import Float
from torch import Tensor

from mover.core.errors import InputError
from mover.core.types import (
    STILL,
    Bodies,
    Camera,
    CameraPath,
    Capture,
    Detection,
    People,
    Scene,
)
from mover.geometry.path import is_still
from mover.geometry.rotations import rot_y
from mover.io.capture.annotations_file import PeopleFile, detections_of, furniture_of, people_of
from mover.io.capture.bodies_file import bodies_of, read_touch
from mover.io.capture.camera_file import camera_of, path_of
from mover.io.capture.parts import Parts
from mover.io.capture.plausible import check_plausible
from mover.io.capture.pose_file import into_camera
from mover.io.capture.scene_file import hypotheses_of, scene_of
from mover.io.files.fields import At, Warn, array, get, items, listed, maybe, number, refuse

LEAST_HEIGHT, MOST_HEIGHT = 0.1, 20.0  # [m], of the camera above the floor
NO_PEOPLE = PeopleFile(None, None, None, frozenset())


def build_capture(parts: Parts) -> Capture:
    """Check everything that is known of a capture and build it; there is no other way to one.

    Raises:
        InputError: If anything is wrong, or camera, scene or objects are missing.
    """
    if parts.camera is None or parts.scene is None or parts.objects is None:
        lacking = [f"{n}.json" for n in ("camera", "scene", "objects") if not getattr(parts, n)]
        raise InputError(f"{parts.name}: has no {lacking[0]}, expected one (see `mover import`)")
    warnings: list[str] = []
    warn = warnings.append
    scene, turn = scene_of(parts.scene, parts.load_mesh, camera_of(parts.camera), warn)
    detections = detections_of(parts.objects, scene.camera, warn)
    _check_annotations(parts.scene, parts.objects.file, scene, detections, warn)
    found = people_of(parts.people, scene.camera, warn) if parts.people else NO_PEOPLE
    bodies = _bodies_of(parts.bodies, scene.camera, turn, found.fps, warn)
    touch = _touch_of(parts.contacts, bodies, warn)
    _check_frames(parts, found, bodies)
    _check_people(found.people, bodies, warn)
    given = parts.hypotheses
    others = () if given is None else hypotheses_of(given, parts.load_mesh, scene, warn)
    capture = Capture(
        name=parts.name,
        scene=scene,
        camera_height=_camera_height(parts.camera),
        detections=detections,
        reference=_image_of(parts, scene.camera, warn),
        reference_people=found.reference,
        bodies=bodies,
        people=found.people,
        touch=touch,
        warnings=(),
        hypotheses=others,
        furniture=_furniture_of(parts, scene.camera, detections, warn),
        path=_path_of(parts, scene.camera, bodies, warn),
        depth=parts.load_depth(scene.camera),
        focal_spread=_focal_spread(parts.camera),
    )
    check_plausible(capture, warn)
    return dataclasses.replace(capture, warnings=tuple(warnings))


def _image_of(parts: Parts, camera: Camera, warn: Warn) -> Float[Tensor, "h w 3"] | None:
    if parts.load_image is None:
        warn(f"{parts.no_image}: there is no picture to draw on")
        return None
    return parts.load_image(camera)


def _camera_height(at: At) -> float | None:
    """Known height of the camera above the floor [m]."""
    given = maybe(at, "height")
    return None if given is None else number(given, LEAST_HEIGHT, MOST_HEIGHT)


def _focal_spread(at: At) -> float | None:
    """How far off the focal length may be, of its logarithm."""
    given = maybe(at, "focal_spread")
    return None if given is None else number(given, 0.0, 1.0)


def _check_annotations(
    tree: At, file: str, scene: Scene, detections: tuple[Detection, ...], warn: Warn
) -> None:
    """Objects name annotations that exist; the others are named in warnings."""
    known, used = {d.id for d in detections}, {p.annotation for p in scene.objects}
    for item, piece in zip(items(get(tree, "objects")), scene.objects, strict=True):
        if piece.annotation is not None and piece.annotation not in known:
            refuse(get(item, "annotation"), f"the id of an annotation in {file}")
    if bare := [piece.id for piece in scene.objects if piece.annotation is None]:
        warn(f"scene.json: {listed('object', bare)} without annotation, no evidence in the image")
    if alone := [f"{d.id} {d.category}" for d in detections if d.id not in used]:
        warn(f"{file}: {listed('annotation', alone)} without object in the scene")
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
    return dataclasses.replace(bodies, fps=fps) if bodies.fps is None else bodies


def _furniture_of(
    parts: Parts, camera: Camera, detections: tuple[Detection, ...], warn: Warn
) -> People | None:
    """The objects' masks in the frames."""
    given = parts.furniture
    return None if given is None else furniture_of(given, camera, detections, warn)


def _path_of(parts: Parts, camera: Camera, bodies: Bodies | None, warn: Warn) -> CameraPath:
    """Where the camera was; people of a moving one are in its own axes, frame by frame."""
    if parts.cameras is None:
        return STILL
    path = path_of(parts.cameras, camera, bodies, warn)
    if parts.bodies is not None and not is_still(path):
        space = get(parts.bodies, "space")
        if str(array(space, (), "text")) != "camera":
            refuse(space, "'camera': cameras.npz carries people into the room's world", "'world'")
    return path


def _touch_of(
    at: At | None, bodies: Bodies | None, warn: Warn
) -> Float[Tensor, "bodies verts"] | None:
    if at is None:
        return None
    if bodies is None:
        warn("contacts.npz: there are no bodies, so it is not used")
        return None
    return read_touch(at, bodies)


def _check_people(people: People | None, bodies: Bodies | None, warn: Warn) -> None:
    """Warn of rows of bodies and of masks that have no partner."""
    if people is None:
        warn("people.json: there are no masks of people, so nothing is known about depth order")
        return
    if bodies is None:
        return
    masks = set(zip(people.frame.tolist(), people.person.tolist(), strict=True))
    rows = set(zip(bodies.frame.tolist(), bodies.person.tolist(), strict=True))
    if alone := len(rows - masks):
        warn(f"people.json: {alone} of {len(rows)} bodies have no mask and no depth order")
    if alone := len(masks - rows):
        warn(f"bodies.npz: {alone} of {len(masks)} masks of people have no body")


def _check_frames(parts: Parts, found: PeopleFile, bodies: Bodies | None) -> None:
    """No frame lies behind the end of the video."""
    count = parts.n_frames
    if count is None:
        return
    expected = f"a frame from 0 to {count - 1}, as frames/ has {count}"
    if bodies is not None and parts.bodies is not None and bodies.frame.max() >= count:
        refuse(get(parts.bodies, "frame"), expected, f"{int(bodies.frame.max())}")
    if found.frames and parts.people is not None and max(found.frames) >= count:
        refuse(get(parts.people, "images"), expected, f"{max(found.frames)}")
