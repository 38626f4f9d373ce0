"""PROX: recordings of one room as a capture, with the truth beside it.

The pictures are stored mirrored and are flipped here, and so are the masks of people; the
calibration and the fits belong to the flipped ones. Several recordings of a room follow one
another. The stills of the quantitative part are frames of their own without a frame rate. The truth
is the camera of cam2world, the floor of the scan and, where the user has them, the boxes of MOVER's
authors (--boxes), and in the quantitative part the bodies of MoSh. The capture itself knows none of
that: its camera is level, its furniture comes from elsewhere. What is missing is named.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mover.core.errors import InputError
from mover.core.files import copy_whole
from mover.core.types import Bodies
from mover.io.capture.bodies_file import bodies_to_arrays, write_bodies
from mover.io.capture.camera_file import camera_of
from mover.io.capture.parts import Hints, Parts, image_parts
from mover.io.capture.pose_file import joined_bodies
from mover.io.capture.scene_file import write_scene
from mover.io.files.cameras import read_camera_file
from mover.io.files.fields import At, read_json, write_json
from mover.io.files.images import opened
from mover.io.files.schema import rigid
from mover.io.masks.instances import Instance, Instances, with_reference_people
from mover.io.scenes.placing import Matrix
from mover_bench.datasets.prox_files import (
    FITS,
    FOLDERS,
    FPS,
    GIVEN_FITS,
    QUANTITATIVE,
    SIZE,
    Recording,
    Timeline,
    asked_for,
    body_indices,
    keypoint_trees,
    people_of,
    pixels_of,
    timelines,
    world_of,
)
from mover_bench.datasets.true_boxes import TrueBox, boxes_scene, floor_in, read_bbox3d, read_scan

Files = dict[str, Callable[[Path], object]]
"""What writes files beside the capture, by their places in it."""
COSTS = {
    "Color": "no pictures: nothing to draw on, masks of furniture must come from elsewhere",
    "BodyIndexColor": "no masks of people: no depth order",
    "keypoints": "no keypoints: `mover fit` has nothing to fit",
    "fits": "no bodies: only the image speaks, unless `mover fit` makes some of the keypoints",
    "cam2world": "no truth of the camera, and so none at all",
    "scenes": "no scan: the truth has no floor and no surfaces (P2S)",
    "mosh": "no true bodies: no errors of people",
}
"""What each part of a user's copy is for."""
OF_SCENES = {"cam2world": "cam2world/{}.json", "scenes": "scenes/{}.ply"}
"""The parts that belong to a scene, by their files."""


def prox_parts(root: Path, hints: Hints) -> Parts:
    """Recordings of one room of a user's copy of PROX.

    Raises:
        InputError: If there is no such recording, or a file is wrong.
    """
    asked = hints.recordings or ((hints.recording,) if hints.recording else ())
    recordings = asked_for(root, asked)
    lines = timelines(recordings)
    lens = read_camera_file(root / "calibration" / "Color.json", SIZE)  # of flipped pictures
    notes: list[str] = []
    for line in lines:
        first, last = min(line.frames.values()), max(line.frames.values())
        kind = f"{len(line.frames)} {'stills' if line.stills else 'frames'}"
        notes.append(f"{line.recording.name}: {kind}, {first} to {last} of the capture")
    tracks = _tracks(recordings)
    fits = [_fits(line, FITS, notes) for line in lines]
    bodies = _joined(zip(lines, fits, strict=True), tracks, notes)
    trees: dict[str, Any] = {}
    for line, found in zip(lines, fits, strict=True):
        trees |= keypoint_trees(line, found, camera_of(lens), notes)
    notes += _missing(lines)
    masks = body_indices(lines, tracks)
    name = recordings[0].name if len(recordings) == 1 else recordings[0].scene
    parts = Parts(
        name=name,
        camera=lens,
        bodies=None if bodies is None else At(bodies_to_arrays(bodies), name),
        people=people_of(masks, None if lines[0].stills else FPS),
    )
    files: Files = {place: partial(write_json, tree) for place, tree in trees.items()}
    parts = _with_pictures(parts, lines, masks, hints, files, notes)
    files |= _given_fits(lines, tracks) | _truth(lines, lens, hints, notes)
    return replace(parts, beside=files, notes=tuple(notes))


def _missing(lines: Sequence[Timeline]) -> list[str]:
    """The parts that the recordings lack, with what each costs."""
    notes: list[str] = []
    for line in lines:
        name, root = line.recording.name, line.recording.root
        kinds = ("Color", "BodyIndexColor", "keypoints")
        lacking = {kind: FOLDERS[kind].format(name) for kind in kinds if not line.files(kind)}
        if not any(line.files(kind) for kind in FITS):
            kind = "fittings/PROX" if line.stills else FITS[0]
            lacking["fits"] = FOLDERS[kind].format(name)
        if line.recording.scene == QUANTITATIVE and not line.files("mosh"):
            lacking["mosh"] = FOLDERS["mosh"].format(name)
        for kind, place in OF_SCENES.items():
            if not (root / place.format(line.recording.scene)).is_file():
                lacking[kind] = place.format(line.recording.scene)
        notes += [f"{place}: missing, so {COSTS[kind]}" for kind, place in lacking.items()]
    return list(dict.fromkeys(notes))


def _given_fits(lines: Sequence[Timeline], tracks: Mapping[str, int]) -> Files:
    """The fits of stills that the paper compares with, in fits/."""
    files: Files = {}
    for kind in GIVEN_FITS if lines[0].stills else ():
        found = [(line, _fits(line, (f"fittings/{kind}",), [])) for line in lines]
        bodies = _joined(found, tracks, [])
        if bodies is not None:
            files[f"fits/{kind}.npz"] = partial(write_bodies, bodies)
    return files


def _with_pictures(
    parts: Parts,
    lines: Sequence[Timeline],
    masks: Mapping[int, Instance | None],
    hints: Hints,
    files: Files,
    notes: list[str],
) -> Parts:
    """The parts with a reference image; all pictures, flipped left to right, are among the files.

    The reference image is the one with the fewest pixels of people (the paper: without human-object
    occlusion), whose masks say where they are; without masks it is the first.
    """
    from PIL import ImageOps

    paths = [(line, *one) for line in lines for one in line.files("Color").items()]
    for line, frame, path in paths:
        target = hints.work / line.recording.name / f"mirrored_{path.stem}.jpg"
        target.parent.mkdir(parents=True, exist_ok=True)
        with opened(path) as picture:
            ImageOps.mirror(picture.convert("RGB")).save(target, quality=95)
        files[f"frames/{frame:06d}.jpg"] = partial(copy_whole, target)
    if not paths:
        return parts
    _, frame, path = min(paths, key=lambda one: pixels_of(masks, one[1]))
    load, size = image_parts(path, mirrored=True)
    parts = replace(parts, load_image=load, image_size=size)
    person, share = masks.get(frame), pixels_of(masks, frame) / (SIZE[0] * SIZE[1])
    if person is not None:
        hidden = with_reference_people(parts.people, Instances((person,), SIZE, path.name), Path())
        parts = replace(parts, people=hidden)
    said = f"has people on {share:.1%} of it" if frame in masks else "has no mask of people"
    notes.append(f"the reference image is frame {frame}, the emptiest: it {said}")
    return parts


def _tracks(recordings: Sequence[Recording]) -> dict[str, int]:
    """A track for each subject: there is one person in a recording."""
    subjects = dict.fromkeys(recording.subject for recording in recordings)
    return {subject: track for track, subject in enumerate(subjects)}


def _fits(line: Timeline, kinds: Sequence[str], notes: list[str]) -> Bodies | None:
    """Fitted bodies in the frame of their files; None where there are none or no body model.

    Raises:
        InputError: If fits are lost.
    """
    from mover.io.people.bodies import bodies_from
    from mover.io.people.found import Known

    recording = line.recording
    kind = next((kind for kind in kinds if line.files(kind)), None)
    if kind is None:
        return None
    folder = recording.root / FOLDERS[kind].format(recording.name)
    known = Known(fps=None if line.stills else FPS, gender=recording.gender, frames=line.frames)
    try:
        found = bodies_from("prox", folder, known)
    except InputError as error:
        notes.append(f"{kind}: the bodies were not read: {error}")
        return None
    lost = len(line.files(kind)) - len(found.bodies.frame.unique())
    if lost > 0 and not found.warnings:
        raise InputError(f"{folder}: {lost} of {len(line.files(kind))} fits are lost")
    notes += [f"{recording.name}: bodies are those of {kind}", *found.warnings]
    return found.bodies


def _joined(
    given: Iterable[tuple[Timeline, Bodies | None]], tracks: Mapping[str, int], notes: list[str]
) -> Bodies | None:
    """Bodies of all recordings together, each person under the own track."""
    parts = [
        replace(found, person=torch.full_like(found.person, tracks[line.recording.subject]))
        for line, found in given
        if found is not None
    ]
    if len(parts) < 2:
        return parts[0] if parts else None
    if len({tuple(part.faces.shape) + tuple(part.verts.shape[1:]) for part in parts}) > 1:
        raise InputError("the recordings have bodies of different models, expected one")
    whole = joined_bodies(parts)
    if whole.pose is None:
        notes.append("the bodies of several models are kept as meshes, without their parameters")
    return whole


def _truth(lines: Sequence[Timeline], lens: At, hints: Hints, notes: list[str]) -> Files:
    """The folders truth/ and truth_scan/."""
    recording, root = lines[0].recording, lines[0].recording.root
    path = root / "cam2world" / f"{recording.scene}.json"
    if not path.is_file():
        return {}
    cam2world = rigid(read_json(path))
    world, R = world_of(cam2world)
    camera = {**lens.value, "R_cam_world": R.tolist()}
    boxes: list[TrueBox] = []
    if hints.boxes is not None:
        boxes = read_bbox3d(hints.boxes, hints.names)
    else:
        notes.append("without --boxes the truth has no furniture")
    path = root / "scenes" / f"{recording.scene}.ply"
    scan = read_scan(path) if path.is_file() else None
    ground = None if scan is None else floor_in(scan, world)
    there = world @ cam2world, camera, ground  # boxes are in the camera's frame
    scenes = {"truth": boxes_scene(boxes, *there)}
    if scan is not None and boxes:
        back = np.linalg.inv(cam2world)
        verts = scan.verts.double().numpy() @ back[:3, :3].T + back[:3, 3]
        seen = replace(scan, verts=torch.from_numpy(verts).float())
        scenes["truth_scan"] = boxes_scene(boxes, *there, seen)
    files: Files = {f"{place}/scene.json": partial(write_scene, s) for place, s in scenes.items()}
    if recording.scene == QUANTITATIVE:
        true = [(line, _fits(line, ("mosh",), notes)) for line in lines]
        mosh = _joined(true, _tracks([line.recording for line in lines]), notes)
        if mosh is not None:
            true_bodies = _into_camera(mosh, root, cam2world)
            files["truth/bodies.npz"] = partial(write_bodies, true_bodies)
    return files


def _into_camera(bodies: Bodies, root: Path, cam2world: Matrix) -> Bodies:
    """MoSh's bodies, which are in Vicon's frame, in the camera's; without their parameters."""
    matrix = np.linalg.inv(cam2world) @ rigid(read_json(root / "vicon2scene.json"))
    R = torch.from_numpy(matrix[:3, :3]).to(bodies.verts)
    t = torch.from_numpy(matrix[:3, 3]).to(bodies.verts)
    joints = None if bodies.joints is None else bodies.joints @ R.mT + t
    return replace(bodies, verts=bodies.verts @ R.mT + t, joints=joints, pose=None)
