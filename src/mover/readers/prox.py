"""PROX: a recording as a capture, with the truth beside it.

The pictures are stored mirrored and are flipped here; the calibration and the fits belong to the
flipped ones. The truth is the camera of cam2world, the floor of the scan and, where the user has
them, the boxes of MOVER's authors (--boxes), and in the quantitative part the bodies of MoSh.
The capture itself knows none of that: its camera is level, its furniture comes from elsewhere.
"""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import torch

from ..records import InputError
from ..types import Bodies, Camera, Scene
from .any_camera import tilt_of
from .bodies_file import bodies_to_arrays
from .fields import At, read_json
from .image_file import mirrored_copy
from .parts import Hints, Parts, image_parts
from .placing import Matrix
from .prox_files import (
    FPS,
    QUANTITATIVE,
    SIZE,
    Recording,
    frames_of,
    lens_of,
    number_of,
    recordings_of,
    rigid,
    scene_camera,
    world_of,
)
from .prox_keypoints import keypoint_trees
from .scans import floor_of, read_scan
from .true_boxes import TrueBox, boxes_scene, read_bbox3d

FITS = ("PROXD", "PROX", "fittings/PROXD", "fittings/PROX", "fittings/RGB")
MOSH = "fittings/mosh"


def prox_parts(root: Path, hints: Hints) -> Parts:
    """One recording of a user's copy of PROX.

    Raises:
        InputError: If there is no such recording, or a file is wrong.
    """
    recording = _recording(root, hints.recording)
    frames = frames_of(recording)
    first = min(frames, default=_first_fit(recording))
    lens = lens_of(root)
    camera = Camera(
        torch.tensor([[lens.value["fl_x"], 0, lens.value["cx"]],
                      [0, lens.value["fl_y"], lens.value["cy"]], [0, 0, 1]]).float(),
        torch.tensor(tilt_of(0.0, 0.0)).float(), *SIZE,
    )  # fmt: skip
    notes: list[str] = [f"{recording.name}: frame 0 is number {first} of the recording"]
    bodies = _fits(recording, FITS, first, notes)
    parts = Parts(
        name=recording.name,
        camera=lens,
        bodies=None if bodies is None else At(bodies_to_arrays(bodies), recording.name),
        trees=keypoint_trees(recording, first, bodies, camera, notes),
        notes=tuple(notes),
    )
    if frames:
        load, size = image_parts(frames[first], mirrored=True)
        copies = {
            f"frames/{number - first:06d}.jpg": mirrored_copy(path, hints.work)
            for number, path in frames.items()
        }
        parts = dataclasses.replace(parts, load_image=load, image_size=size, copies=copies)
    return _with_truth(parts, recording, first, lens, hints)


def _recording(root: Path, name: str) -> Recording:
    """The recording that is asked for."""
    known = recordings_of(root)
    if not name and len(known) == 1:
        name = known[0]
    if name not in known:
        some = ", ".join(known[:4]) + (", ..." if len(known) > 4 else "")
        raise InputError(f"--recording: {name!r} is none of {len(known)} in {root}: {some}")
    return Recording(root, name)


def _first_fit(recording: Recording) -> int:
    """The number of the first frame where there are no pictures."""
    for kind in (*FITS, MOSH):
        folder = recording.root / kind / recording.name / "results"
        numbers = [number_of(p) for p in folder.iterdir()] if folder.is_dir() else []
        if numbers:
            return min(numbers)
    return 1


def _fits(
    recording: Recording, kinds: tuple[str, ...], first: int, notes: list[str]
) -> Bodies | None:
    """Fitted bodies in the frame of their files; None where there are none or no body model."""
    from .people import Known, bodies_from

    for kind in kinds:
        folder = recording.root / kind / recording.name / "results"
        if folder.is_dir():
            known = Known(fps=FPS, gender=recording.gender, first=first)
            try:
                found = bodies_from("prox", folder, known)
            except InputError as error:
                notes.append(f"{kind}: the bodies were not read: {error}")
                return None
            notes += [f"bodies are those of {kind}", *found.warnings]
            return found.bodies
    return None


def _with_truth(parts: Parts, recording: Recording, first: int, lens: At, hints: Hints) -> Parts:
    """The parts with the folders truth/ and truth_scan/."""
    root, notes = recording.root, list(parts.notes)
    if not (root / "cam2world" / f"{recording.scene}.json").is_file():
        return dataclasses.replace(parts, notes=(*notes, "cam2world: missing, so no truth"))
    cam2world = scene_camera(root, recording.scene)
    world, R = world_of(cam2world)
    camera = {**lens.value, "R_cam_world": R.tolist()}
    boxes: list[TrueBox] = []
    if hints.boxes is not None:
        boxes = read_bbox3d(hints.boxes, hints.names, read_json(hints.boxes))
    else:
        notes.append("without --boxes the truth has no furniture")
    scenes = _true_scenes(recording, boxes, (world, cam2world), camera)
    people: dict[str, Bodies] = {}
    if recording.scene == QUANTITATIVE:
        mosh = _fits(recording, (MOSH,), first, notes)
        if mosh is not None:
            people["truth"] = _into_camera(mosh, root, cam2world)
    return dataclasses.replace(parts, scenes=scenes, people_of=people, notes=tuple(notes))


def _true_scenes(
    recording: Recording,
    boxes: list[TrueBox],
    frames: tuple[Matrix, Matrix],
    camera: dict[str, Any],
) -> dict[str, Scene]:
    """The boxes, and the scan's parts in them; the boxes are in the camera's frame."""
    world, cam2world = frames
    path = recording.root / "scenes" / f"{recording.scene}.ply"
    scan = read_scan(path) if path.is_file() else None
    ground = None
    if scan is not None:
        heights = scan.verts.double().numpy() @ world[1, :3] + world[1, 3]
        ground = floor_of(heights)
    from_camera = world @ cam2world
    scenes = {"truth": boxes_scene(boxes, from_camera, camera, ground)}
    if scan is not None and boxes:
        back = np.linalg.inv(cam2world)
        verts = scan.verts.double().numpy() @ back[:3, :3].T + back[:3, 3]
        seen = dataclasses.replace(scan, verts=torch.from_numpy(verts).float())
        scenes["truth_scan"] = boxes_scene(boxes, from_camera, camera, ground, seen)
    return scenes


def _into_camera(bodies: Bodies, root: Path, cam2world: Matrix) -> Bodies:
    """MoSh's bodies, which are in Vicon's frame, in the camera's; without their parameters."""
    matrix = np.linalg.inv(cam2world) @ rigid(read_json(root / "vicon2scene.json"))
    R = torch.from_numpy(matrix[:3, :3]).to(bodies.verts)
    t = torch.from_numpy(matrix[:3, 3]).to(bodies.verts)
    joints = None if bodies.joints is None else bodies.joints @ R.mT + t
    return dataclasses.replace(bodies, verts=bodies.verts @ R.mT + t, joints=joints, pose=None)
