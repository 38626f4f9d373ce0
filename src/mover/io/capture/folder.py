"""Capture folders (FORMAT.md), and the one builder of captures, which checks that all parts fit."""

import dataclasses
import re
import shutil
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch

from mover.core.errors import InputError
from mover.core.files import copy_whole
from mover.core.types import STILL, Bodies, Camera, Capture, DepthImage, Detection, Scene
from mover.geometry.camera import pitch_roll
from mover.geometry.path import is_still
from mover.geometry.rotations import rot_y
from mover.io.capture.annotations_file import (
    PeopleFile,
    detections_of,
    detections_to_json,
    furniture_of,
    image_name,
    people_of,
    people_to_json,
)
from mover.io.capture.bodies_file import bodies_of, read_touch, write_bodies
from mover.io.capture.camera_file import (
    CameraFields,
    camera_of,
    camera_to_json,
    measured_tilt,
    path_of,
    path_to_arrays,
)
from mover.io.capture.parts import Hints, Parts, image_parts
from mover.io.capture.plausible import check_plausible
from mover.io.capture.pose_file import into_camera
from mover.io.capture.scene_file import (
    HYPOTHESES,
    hypotheses_of,
    scene_of,
    write_hypotheses,
    write_scene,
)
from mover.io.capture.tracks import pair_tracks
from mover.io.files import images
from mover.io.files.cameras import tilt_fields
from mover.io.files.fields import At, Warn, listed, read_json, read_npz, write_json, write_npz
from mover.io.files.meshes import read_mesh
from mover.io.files.schema import checked
from mover.io.people.found import Known
from mover.io.people.keypoints import read_keypoints, read_openpose, write_keypoints

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
        unused = "so the people's speed is not used (field 'fps', or --fps of `mover import`)"
        warn(f"bodies.npz: has no frame rate, {unused}")
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


REFERENCE, FURNITURE = "reference.jpg", "furniture.json"


def read_capture(folder: Path) -> Capture:
    """Read and check a capture folder; its truth is not looked at."""
    if not folder.is_dir():
        what = "is a file" if folder.exists() else "there is no such folder"
        raise InputError(f"{folder}: {what}, expected the folder of a capture")
    inner = sorted(path.parent.name for path in folder.glob("*/camera.json"))
    if inner and not (folder / "camera.json").exists():
        raise InputError(f"{folder}: has no camera.json, but captures: {', '.join(inner[:4])}")
    parts = _files(folder, read_json)
    assert parts.objects is not None
    named = image_name(parts.objects)
    if named is None and (folder / REFERENCE).is_file():
        named = At(REFERENCE, "objects.json", "images[0].file_name")
    load = None if named is None else partial(images.read_image, named, folder)
    capture = build_capture(replace(parts, load_image=load))
    if capture.people is not None or capture.bodies is None:
        return capture
    one, many = folder / "keypoints.npz", folder / "keypoints"
    try:
        if one.is_file():
            return replace(capture, keypoints=read_keypoints(one))
        if many.is_dir():
            return replace(capture, keypoints=read_openpose(many, Known()))
    except InputError as error:  # the method does without
        note = f"{error}; bodies are not held against it"
        return replace(capture, warnings=(*capture.warnings, note))
    return capture


def folder_parts(folder: Path, hints: Hints | None = None) -> Parts:
    """What is already in a capture's folder; the camera of scene.json is taken out of it."""
    del hints
    parts = _files(folder, partial(_if_there, read_json))
    camera, scene = parts.camera, parts.scene
    if scene is not None and isinstance(scene.value, dict):
        own: Any = scene.value.get("camera")
        base: Any = {} if camera is None else camera.value
        if isinstance(own, dict) and isinstance(base, dict):
            camera = At({**base, **own}, scene.file, "camera")
        scene = At({k: v for k, v in scene.value.items() if k != "camera"}, scene.file)
    named = None if parts.objects is None else image_name(parts.objects)
    first = [named.value] if named is not None and isinstance(named.value, str) else []
    paths = ((folder / name).resolve() for name in (*first, "reference.png", REFERENCE))
    inside = (path for path in paths if path.is_relative_to(folder.resolve()) and path.is_file())
    picture = next(inside, None)
    load, size = (None, None) if picture is None else image_parts(picture)
    depth = images.find_depth_file(folder)
    beside = {} if depth is None else {
        f"{images.DEPTH if depth[1] else images.DISPARITY}/000000{depth[0].suffix.lower()}":
            partial(_put_depth, depth[0])
    }  # fmt: skip
    return replace(
        parts, camera=camera, scene=scene, load_image=load, image_size=size, beside=beside,
        n_frames=None, hypotheses=None, furniture=None,  # they may be of what is replaced
    )  # fmt: skip


def _files(folder: Path, needed: Callable[[Path], At | None]) -> Parts:
    """The files of a folder as they are; `needed` reads those that a capture cannot lack."""

    def load_depth(camera: Camera) -> DepthImage | None:
        if (found := images.find_depth_file(folder)) is None:
            return None
        path, metric = found
        frame = images.reference_frame(folder)
        return DepthImage(images.read_depth(path, camera, metric=metric, frame=frame), metric)

    frames = folder / "frames"
    files = frames.iterdir() if frames.is_dir() else ()
    names = (re.fullmatch(r"([0-9]{6,8})\.(jpg|jpeg|png)", path.name) for path in files)
    return Parts(
        name=folder.resolve().name,
        camera=needed(folder / "camera.json"),
        scene=needed(folder / "scene.json"),
        objects=needed(folder / "objects.json"),
        people=_if_there(read_json, folder / "people.json"),
        furniture=_if_there(read_json, folder / FURNITURE),
        bodies=_if_there(read_npz, folder / "bodies.npz"),
        contacts=_if_there(read_npz, folder / "contacts.npz"),
        cameras=_if_there(read_npz, folder / "cameras.npz"),
        load_mesh=partial(read_mesh, folder=folder),
        load_depth=load_depth,
        n_frames=max((int(name[1]) + 1 for name in names if name), default=None),
        hypotheses=_if_there(read_json, folder / HYPOTHESES),
    )


def _put_depth(source: Path, target: Path) -> None:
    """Copy measured depth into a capture, where it is the only one: a picture has one depth."""
    folder = target.parents[1]
    if not source.resolve().is_relative_to(folder.resolve()):
        for name in (images.DEPTH, images.DISPARITY):
            shutil.rmtree(folder / name, ignore_errors=True)
    copy_whole(source, target)


def _if_there(read: Callable[[Path], At], path: Path) -> At | None:
    return read(path) if path.exists() or path.is_symlink() else None


def lacking(capture: Capture) -> set[str]:
    """The files and folders that a capture with all its parts would have, and this one has not."""
    people, depth = capture.people or capture.reference_people, capture.depth
    wanted = {
        "bodies.npz": capture.bodies, "people.json": people, "contacts.npz": capture.touch,
        FURNITURE: capture.furniture, "cameras.npz": None if is_still(capture.path) else True,
        images.DEPTH: depth if depth is not None and depth.metric else None,
        images.DISPARITY: depth if depth is not None and not depth.metric else None,
    }  # fmt: skip
    return {name for name, part in wanted.items() if part is None}


def write_capture(capture: Capture, folder: Path) -> None:
    """Write a capture folder, without frames; reading it gives the same capture.

    The picture is kept with 8 bits a channel.

    Raises:
        ValueError: If the folder has a file that this capture lacks: the two would mix.
    """
    depth = capture.depth
    for name in lacking(capture):
        if (folder / name).exists():
            raise ValueError(f"{folder} has {name}, which the capture lacks; choose a new folder")
    if capture.reference is not None:
        images.write_image(capture.reference, folder / "reference.png")
    if capture.bodies is not None:
        write_bodies(capture.bodies, folder / "bodies.npz")
    if capture.keypoints is not None:
        write_keypoints(capture.keypoints, folder / "keypoints.npz")
    if capture.touch is not None:
        touch = capture.touch.detach().cpu().numpy()
        write_npz({"probability": touch}, folder / "contacts.npz")
    if not is_still(capture.path):
        write_npz(path_to_arrays(capture.path), folder / "cameras.npz")
    if depth is not None:
        images.write_depth_image(depth, folder)
    if capture.furniture is not None:
        tree = people_to_json(capture.furniture, None, None, ())
        tree["categories"] = [{"id": 1, "name": "object"}]
        write_json(tree, folder / FURNITURE)
    write_trees(capture, folder, None if capture.reference is None else "reference.png")
    others = {h.id for h in capture.hypotheses}
    groups = {one.id: [one, *(h for h in capture.hypotheses if h.id == one.id)]
              for one in capture.scene.objects if one.id in others}  # fmt: skip
    write_hypotheses(folder, groups)


def write_trees(
    capture: Capture, folder: Path, image: str | None, info: Mapping[str, Any] | None = None
) -> list[str]:
    """Write the JSON files of a capture, and its meshes; the names of the files.

    Args:
        capture: A checked one.
        folder: Where to.
        image: The name of the reference image in the folder.
        info: Further fields of `info` in people.json; None: written only with people.
    """
    camera = camera_to_json(
        capture.scene.camera, height=capture.camera_height, focal_spread=capture.focal_spread,
        focal_by_lines=capture.focal_by_lines,
    )  # fmt: skip
    if capture.tilt is not None:
        camera |= tilt_fields(capture.tilt)
    write_scene(capture.scene, folder / "scene.json")
    objects = detections_to_json(capture.detections, capture.scene.camera, image)
    write_json(objects, folder / "objects.json")
    write_json(camera, folder / "camera.json")
    done = ["camera.json", "scene.json", "objects.json"]
    people, hidden, bodies = capture.people, capture.reference_people, capture.bodies
    if people is None and hidden is None and info is None:
        return done
    frames = [] if bodies is None else bodies.frame.tolist()
    tree = people_to_json(people, hidden, None if bodies is None else bodies.fps, frames)
    write_json({**tree, "info": {**(info or {}), **tree["info"]}}, folder / "people.json")
    return [*done, "people.json"]
