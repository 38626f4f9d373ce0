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
from numpy.typing import NDArray

from mover.core.errors import InputError
from mover.core.types import Bodies, Camera, Scene
from mover.io.capture.bodies_file import bodies_to_arrays
from mover.io.capture.parts import Hints, Parts, image_parts
from mover.io.datasets.prox_files import (
    FPS,
    QUANTITATIVE,
    SIZE,
    Recording,
    frames_of,
    lens_of,
    number_of,
    recordings_of,
    scene_camera,
    world_of,
)
from mover.io.datasets.true_boxes import TrueBox, boxes_scene, read_bbox3d
from mover.io.files.cameras import tilt_of
from mover.io.files.fields import At, get, items, mapping, maybe, number, read_json, refuse
from mover.io.files.images import mirrored_copy
from mover.io.files.meshes import floor_of, read_scan
from mover.io.files.schema import rigid
from mover.io.scenes.placing import Matrix

PAIRS_25 = ((2, 5), (3, 6), (4, 7), (9, 12), (10, 13), (11, 14), (15, 16), (17, 18),
            (19, 22), (20, 23), (21, 24))  # fmt: skip
"""BODY_25: right and left."""
FACE = (
    *((i, 16 - i) for i in range(8)), *((17 + i, 26 - i) for i in range(5)), (31, 35), (32, 34),
    (36, 45), (37, 44), (38, 43), (39, 42), (40, 47), (41, 46), (48, 54), (49, 53), (50, 52),
    (55, 59), (56, 58), (60, 64), (61, 63), (65, 67), (68, 69),
)  # fmt: skip
"""The 70 points of a face: right and left."""
BODY, LEFT, RIGHT, HEAD = (
    "pose_keypoints_2d",
    "hand_left_keypoints_2d",
    "hand_right_keypoints_2d",
    "face_keypoints_2d",
)
SURE = 0.3  # joints with less confidence do not vote
LEAST = 20.0  # [px], the difference that decides


def keypoint_trees(
    recording: Recording, first: int, bodies: Bodies | None, camera: Camera, notes: list[str]
) -> dict[str, Any]:
    """OpenPose files by their place in the capture, in the flipped pictures.

    Third-party code says that those of the qualitative part are of the mirrored pictures and those
    of the quantitative part are not. Where the fitted bodies are known, they decide instead.

    Args:
        recording: Of PROX.
        first: The number of frame 0.
        bodies: Fits in the camera's frame.
        camera: Of the flipped pictures.
        notes: Takes what was decided.

    Raises:
        InputError: If a file is not OpenPose's.
    """
    folder = recording.root / "keypoints" / recording.name
    paths = sorted(folder.glob("*.json")) if folder.is_dir() else []
    if not paths:
        return {}
    trees = {number_of(path) - first: read_json(path) for path in paths}
    stored = {frame: _middle(at) for frame, at in trees.items()}
    mirrored, why = recording.scene != QUANTITATIVE, "as third-party code says"
    vote = None if bodies is None else _vote(stored, bodies, camera)
    if vote is not None:
        mirrored, why = vote, "as the fitted bodies say"
    notes.append(f"the keypoints were {'flipped' if mirrored else 'kept'}, {why}")
    return {
        f"keypoints/{frame:06d}_keypoints.json": _flipped(at) if mirrored else dict(mapping(at))
        for frame, at in trees.items()
        if frame >= 0
    }


def _triples(at: At) -> NDArray[np.float64]:
    """x, y and confidence."""
    values = [number(v) for v in items(at)]
    if len(values) % 3:
        refuse(at, "triples of x, y, confidence")
    return np.array(values).reshape(-1, 3)


def _middle(at: At) -> float | None:
    """Mean x of what is seen of the first person."""
    people = items(get(at, "people"))
    if not people:
        return None
    joints = _triples(get(people[0], BODY))
    seen = joints[joints[:, 2] > SURE]
    return float(seen[:, 0].mean()) if len(seen) else None


def _vote(stored: dict[int, float | None], bodies: Bodies, camera: Camera) -> bool | None:
    """Whether the files are of mirrored pictures; None where the bodies do not tell."""
    from mover.geometry.camera import project

    gain = 0.0
    for row, frame in enumerate(bodies.frame.tolist()):
        x = stored.get(frame)
        if x is not None:
            true = float(project(bodies.verts[row], camera.K)[:, 0].mean())
            gain += abs(x - true) - abs(SIZE[0] - x - true)
    return None if abs(gain) < LEAST else gain > 0


def _flipped(at: At) -> dict[str, Any]:
    """A file of a mirrored picture as that of the true one: left is right."""
    people: list[dict[str, Any]] = []
    for person in items(get(at, "people")):
        row = dict(mapping(person))
        hands = {LEFT: maybe(person, RIGHT), RIGHT: maybe(person, LEFT)}
        parts = {BODY: maybe(person, BODY), HEAD: maybe(person, HEAD), **hands}
        for key, given in parts.items():
            if given is not None:
                pairs = PAIRS_25 if key == BODY else FACE if key == HEAD else ()
                row[key] = _mirror(_triples(given), pairs).ravel().tolist()
        people.append(row)
    return {**mapping(at), "people": people}


def _mirror(joints: NDArray[np.float64], pairs: tuple[tuple[int, int], ...]) -> NDArray[np.float64]:
    """Joints of the flipped picture; those that are missing stay zeros."""
    order = np.arange(len(joints))
    for a, b in pairs:
        if max(a, b) < len(joints):
            order[a], order[b] = b, a
    out = joints[order].copy()
    out[:, 0] = np.where(out[:, 2] > 0, SIZE[0] - out[:, 0], 0.0)
    return out


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
    from mover.io.people.bodies import bodies_from
    from mover.io.people.found import Known

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
