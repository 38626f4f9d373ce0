"""People in PROX's pictures, which are stored mirrored: their masks and OpenPose's keypoints.

Masks are Kinect's body index on the colour frames: a pixel holds the number of a body, 0 to 5, or
255 where there is no person. Kinect gives a person a new number when it has lost them, and there
is one person in a recording, so all bodies of a frame are one.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool
from numpy.typing import NDArray

from mover.core.errors import InputError
from mover.core.types import Bodies, Camera
from mover.io.files.fields import At, get, items, mapping, maybe, number, read_json, reason, refuse
from mover.io.masks.instances import Instance, Instances, code_of, people_tree
from mover_bench.datasets.prox_files import QUANTITATIVE, SIZE, Timeline

BODIES = 6  # that Kinect distinguishes
NO_PEOPLE = 255
MOST = 0.7  # of the picture that a person may fill


def people_masks(
    lines: Sequence[Timeline], tracks: Mapping[str, int], fps: float | None
) -> At | None:
    """The fields of people.json; None where no recording has masks; stills have no `fps`."""
    items: list[Instance] = []
    for line in lines:
        for frame, path in line.files("BodyIndexColor").items():
            code = code_of(read_body_index(path))
            if code is not None:
                track = tracks[line.recording.subject]
                items.append(Instance("person", None, code, frame=frame, track=track))
    if not items:
        return None
    return people_tree(Instances(tuple(items), SIZE, "BodyIndexColor"), fps)


def read_body_index(path: Path) -> Bool[np.ndarray, "h w"]:
    """Where a person is, in the flipped picture.

    Raises:
        InputError: If it cannot be read, has another size, or holds other numbers.
    """
    from PIL import Image

    try:
        with Image.open(path) as picture:
            pixels = np.asarray(picture.convert("L"))
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise InputError(f"{path}: cannot be read ({reason(error)}), expected a picture") from error
    if pixels.shape != SIZE[::-1]:
        found = f"{pixels.shape[1]} x {pixels.shape[0]} pixels"
        raise InputError(f"{path}: has {found}, expected {SIZE[0]} x {SIZE[1]}")
    other = np.unique(pixels[(pixels >= BODIES) & (pixels != NO_PEOPLE)])
    if len(other):
        raise InputError(
            f"{path}: has the number {other[0]}, expected bodies 0 to {BODIES - 1}, and {NO_PEOPLE}"
            " where there is no person"
        )
    somebody = pixels < BODIES
    if somebody.mean() > MOST:
        share = f"{somebody.mean():.0%} of the picture is a body"
        raise InputError(f"{path}: {share}, expected {NO_PEOPLE} where there is no person")
    return somebody[:, ::-1]


# OpenPose's keypoints of PROX, of pictures that are stored mirrored or of flipped ones.


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
    line: Timeline, bodies: Bodies | None, camera: Camera, notes: list[str]
) -> dict[str, Any]:
    """OpenPose files by their place in the capture, in the flipped pictures.

    Third-party code says that those of the qualitative part are of the mirrored pictures and those
    of the quantitative part are not. Where the fitted bodies are known, they decide instead.

    Args:
        line: The frames of a recording.
        bodies: Fits in the camera's frame.
        camera: Of the flipped pictures.
        notes: Takes what was decided.
    """
    trees = {frame: read_json(path) for frame, path in line.files("keypoints").items()}
    if not trees:
        return {}
    stored = {frame: _middle(at) for frame, at in trees.items()}
    mirrored, why = line.recording.scene != QUANTITATIVE, "as third-party code says"
    vote = None if bodies is None else _vote(stored, bodies, camera)
    if vote is not None:
        mirrored, why = vote, "as the fitted bodies say"
    notes.append(f"the keypoints were {'flipped' if mirrored else 'kept'}, {why}")
    return {
        f"keypoints/{frame:06d}_keypoints.json": _flipped(at) if mirrored else dict(mapping(at))
        for frame, at in trees.items()
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
    """Whether the files are of mirrored pictures; None where the bodies do not decide."""
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
