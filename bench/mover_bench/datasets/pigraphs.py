"""People of Kinect's 25 joints, as capsules along the bones: a body that any mesh stage takes."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mover.core.errors import InputError
from mover.geometry.rotations import affine
from mover.io.capture.parts import Hints, Parts, image_parts
from mover.io.capture.scene_file import write_scene
from mover.io.files.fields import At, read_json
from mover.io.scenes.placing import Matrix
from mover_bench.datasets.prox_files import world_of
from mover_bench.datasets.true_boxes import SIGNS, TrueBox, boxes_scene, floor_in, read_scan

JOINTS = 25
NAMES = (
    "pelvis", "spine2", "neck", "head", "left_shoulder", "left_elbow", "left_wrist", "left_hand",
    "right_shoulder", "right_elbow", "right_wrist", "right_hand", "left_hip", "left_knee",
    "left_ankle", "left_foot", "right_hip", "right_knee", "right_ankle", "right_foot", "spine3",
    "left_index3", "left_thumb3", "right_index3", "right_thumb3",
)  # fmt: skip
"""Kinect's joints under the names of SMPL-X, where it has them."""
BONES = (
    (0, 1, 0.13), (1, 20, 0.13), (20, 2, 0.07), (2, 3, 0.09), (20, 4, 0.07), (4, 5, 0.045),
    (5, 6, 0.035), (6, 7, 0.035), (20, 8, 0.07), (8, 9, 0.045), (9, 10, 0.035), (10, 11, 0.035),
    (0, 12, 0.11), (12, 13, 0.075), (13, 14, 0.05), (14, 15, 0.035), (0, 16, 0.11),
    (16, 17, 0.075), (17, 18, 0.05), (18, 19, 0.035),
)  # fmt: skip
"""Two joints and the thickness of the limb between them [m]."""
SIDES, RINGS = 12, 4
SHORTEST = 0.01  # [m], joints that lie on each other have no direction


def capsule_people(
    skeletons: Sequence[tuple[int, int, Matrix]], turn: Matrix, fps: float
) -> dict[str, Any]:
    """The arrays of bodies.npz.

    `skeletons` are frame, person and joints (25, 3) in Kinect's camera space [m]; `turn` gives the
    camera's axes (x right, y down, z forward) from there.
    """
    joints = np.stack([joints @ turn.T for _, _, joints in skeletons])
    unit, faces = _unit_capsule()
    parts = [_limbs(joints[:, a], joints[:, b], radius, unit) for a, b, radius in BONES]
    triangles = np.concatenate([faces + i * len(unit) for i in range(len(BONES))])
    return {
        "vertices": np.concatenate(parts, axis=1).astype(np.float32),
        "faces": triangles,
        "joints": joints.astype(np.float32),
        "joint_names": np.array(NAMES),
        "frame": np.array([frame for frame, _, _ in skeletons]),
        "person": np.array([person for _, person, _ in skeletons]),
        "space": np.array("camera"),
        "fps": np.array(fps),
    }


def _unit_capsule() -> tuple[Matrix, NDArray[np.int64]]:
    """Points (x, y, end, bulge): a circle's place, which end, how far beyond it; and triangles."""
    import trimesh

    shape = trimesh.creation.capsule(height=1.0, radius=1.0, count=[2 * RINGS, SIDES])
    x, y, z = (shape.vertices - shape.bounds.mean(0)).T
    end = (z > 0).astype(float)
    return np.stack([x, y, end, z - (end - 0.5)], axis=-1), np.asarray(shape.faces, np.int64)


def _limbs(start: Matrix, end: Matrix, radius: float, unit: Matrix) -> Matrix:
    """Capsules (bodies, points, 3) between two joints of all bodies."""
    along = end - start
    length = np.linalg.norm(along, axis=1, keepdims=True)
    w = np.where(length > SHORTEST, along / np.maximum(length, 1e-9), np.array([0.0, 1.0, 0.0]))
    helper = np.where(np.abs(w[:, 2:]) < 0.9, np.array([0.0, 0, 1.0]), np.array([1.0, 0, 0]))
    u = np.cross(helper, w)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    v = np.cross(w, u)
    x, y, e, bulge = unit.T
    side = radius * (x[:, None] * u[:, None] + y[:, None] * v[:, None])
    axis = e[:, None] * along[:, None] + radius * bulge[:, None] * w[:, None]
    return start[:, None] + side + axis


# PiGraphs: a recording with its skeletons as a capture, the scan's boxes as the truth.
#
# A recording holds 25 joints of Kinect's camera space (x to the sensor's left, y up, z forward) and
# the matrix from there to the scan (z up). The picture of a Kinect is mirrored; where the matrix is
# no mirror, the joints are of the true room, and pictures must be flipped. The depth and the colour
# camera are taken as one. No colour intrinsics come with the data; those are MOVER's.


FPS = 5.0
VIDEOS, ROOMS = 60, 30
LENS = {"w": 1920, "h": 1080, "fl_x": 1081.37, "fl_y": 1081.37, "cx": 960.0, "cy": 540.0}
"""MOVER's colour camera; an OpenCV calibration's centre gains half a pixel."""
LEFT_UP, RIGHT_UP = np.diag([-1.0, -1.0, 1.0]), np.diag([1.0, -1.0, 1.0])
"""Kinect's camera space -> x right, y down: x is the sensor's left, or already its right."""
LARGE = ("chair", "sofa", "couch", "bed", "table", "desk", "bench", "stool", "cabinet", "shelf",
         "bookshelf", "nightstand", "dresser", "coffee table", "dining table", "armchair",
         "office chair", "counter", "wardrobe", "bookcase")  # fmt: skip
"""Labels that are furniture; the rest of a scan is walls and small things."""


def pigraphs_parts(root: Path, hints: Hints) -> Parts:
    """One recording of a user's copy of PiGraphs.

    Raises:
        InputError: If there is no such recording, or a file is wrong.
    """
    path = _recording(root, hints.recording)
    at = read_json(path)
    matrix = _matrix(at.get("camera"))
    mirror = float(np.linalg.det(matrix[:3, :3])) < 0
    to_camera = RIGHT_UP if mirror else LEFT_UP
    lens = LENS if hints.camera is None else hints.camera.value
    notes = [] if mirror else ["the pictures of this recording are mirrored and are flipped"]
    joints = _skeletons(at)
    bodies = At(capsule_people(joints, to_camera, FPS), path.name) if joints else None
    parts = Parts(name=path.stem, camera=At(lens, path.name), bodies=bodies, notes=tuple(notes))
    if hints.image is not None:
        load, size = image_parts(hints.image, mirrored=not mirror)
        parts = replace(parts, load_image=load, image_size=size)
    from_camera = affine(to_camera)  # its own inverse
    return _with_truth(parts, root, path.stem.split("_")[0], matrix @ from_camera)


def recordings_of(root: Path) -> list[Path]:
    """The recordings of a user's copy, by their JSON files.

    Raises:
        InputError: If there are none.
    """
    paths = [
        p for p in sorted(root.rglob("*.json"))
        if not p.name.endswith("segs.json") and p.stem.count("_") >= 2
    ]  # fmt: skip
    if not paths:
        raise InputError(f"{root}: has no <scene>_<camera>_<time>.json, expected PiGraphs")
    return paths


def _recording(root: Path, name: str) -> Path:
    """The recording that is asked for."""
    if root.is_file():
        return root
    known = {p.stem: p for p in recordings_of(root)}
    if not name and len(known) == 1:
        name = next(iter(known))
    if name not in known:
        some = ", ".join(list(known)[:4])
        raise InputError(f"--recording: {name!r} is none of {len(known)} in {root}: {some}, ...")
    return known[name]


def _matrix(at: At) -> Matrix:
    """16 numbers by rows: the scan from Kinect's camera space (4, 4), rigid or a mirror."""
    out = np.array(at.vector(16)).reshape(4, 4)
    turn = out[:3, :3]
    if np.abs(turn @ turn.T - np.eye(3)).max() > 1e-2 or out[3].tolist() != [0, 0, 0, 1]:
        at.refuse("16 numbers of a rigid transform, by rows")
    return out


def _skeletons(at: At) -> list[tuple[int, int, Matrix]]:
    """Frame, person and joints (25, 3) [m] of each skeleton."""
    times = at.maybe("depthTimestamps")
    clock = np.array([] if times is None else [_time(item) for item in times.items()])
    people: dict[str, int] = {}
    seen: dict[tuple[int, int], Matrix] = {}
    for place, item in enumerate(at.get("skeletons").items()):
        joints = np.array([row.vector(3) for row in item.get("jointPositions").items(JOINTS)])
        key, stamp = item.maybe("trackingId"), item.maybe("timestamp")
        person = people.setdefault("" if key is None else str(key.value)[:40], len(people))
        frame = place
        if len(clock) and stamp is not None:
            frame = int(np.abs(clock - _time(stamp)).argmin())
        seen.setdefault((frame, person), joints)
    return [(frame, person, seen[frame, person]) for frame, person in sorted(seen)]


def _time(at: At) -> float:
    """A time, as a number or as text of one."""
    try:
        value = float(at.value)
    except (TypeError, ValueError, OverflowError):
        return at.refuse("a time")
    return value if np.isfinite(value) else at.refuse("a time")


def _with_truth(parts: Parts, root: Path, room: str, scan_cam: Matrix) -> Parts:
    """The parts with truth/: the furniture among the segments of the scan."""
    home = root.parent if root.is_file() else root
    files = sorted(p for p in home.rglob(f"{room}*segs.json"))
    if not files:
        note = f"{room}d.segs.json: missing, so no truth"
        return replace(parts, notes=(*parts.notes, note))
    boxes = read_segments(files[0])
    world, R = world_of(scan_cam)
    assert parts.camera is not None
    camera: dict[str, Any] = {**parts.camera.value, "R_cam_world": R.tolist()}
    ground = None
    scans = sorted(home.rglob(f"{room}.ply"))
    if scans:
        ground = floor_in(read_scan(scans[0]), world)
    truth = boxes_scene(boxes, world, camera, ground)
    return replace(parts, beside={"truth/scene.json": partial(write_scene, truth)})


def read_segments(path: Path) -> list[TrueBox]:
    """The furniture of segs.json: groups that are parts of one object are one box."""
    groups: dict[str, list[TrueBox]] = {}
    for item in read_json(path).get("segGroups").items():
        label = item.get("label").text().lower()
        whole = label.split(":")[0].strip().replace("_", " ")
        if whole not in LARGE or item.maybe("obb") is None:
            continue
        key = item.maybe("objectId")
        name = f"{whole}_{str(item.get('id').value if key is None else key.value)[:20]}"
        groups.setdefault(name, []).append(_obb(item.get("obb"), name, whole, item))
    return [_union(boxes) for boxes in groups.values()]


def _obb(at: At, name: str, category: str, item: At) -> TrueBox:
    """One box: full lengths; axes by rows or by columns, whichever has the vertical in it."""
    at.mapping()
    axes = np.array(at.get("normalizedAxes").vector(9)).reshape(3, 3)
    if np.abs(axes @ axes.T - np.eye(3)).max() > 1e-2:
        at.get("normalizedAxes").refuse("three axes at right angles, of length 1")
    normal = item.maybe("dominantNormal")
    known = np.array([0.0, 0, 1]) if normal is None else np.array(normal.vector(3))
    by_rows, by_columns = np.abs(axes @ known).max(), np.abs(axes.T @ known).max()
    if by_columns > by_rows + 1e-6:
        axes = axes.T
    half = np.array(at.get("axesLengths").vector(3)) / 2
    return TrueBox(name, category, np.array(at.get("centroid").vector(3)), np.abs(half), axes)


def _union(boxes: list[TrueBox]) -> TrueBox:
    """The box around parts, along the axes of the largest one."""
    main = max(boxes, key=lambda box: float(box.half.prod()))
    points = np.concatenate([box.center + (SIGNS * box.half) @ box.axes for box in boxes])
    local = (points - main.center) @ main.axes.T
    low, high = local.min(0), local.max(0)
    centre = main.center + (low + high) / 2 @ main.axes
    return TrueBox(main.name, main.category, centre, (high - low) / 2, main.axes)
