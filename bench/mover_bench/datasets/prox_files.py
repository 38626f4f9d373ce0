"""Files of PROX: calibration, cameras, names of frames and recordings, and people in pictures.

The pictures are stored mirrored. Masks are Kinect's body index on the colour frames: a pixel holds
the number of a body, 0 to 5, or 255 where there is no person. Kinect gives a person a new number
when it has lost them, and there is one person in a recording, so all bodies of a frame are one.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool
from numpy.typing import NDArray

from mover.core.errors import InputError
from mover.core.types import Bodies, Camera, Masks
from mover.geometry.rle import area
from mover.geometry.rotations import affine
from mover.io.files.fields import At, read_json, reason
from mover.io.masks.instances import Instance, Instances, code_of
from mover.io.people.values import frame_numbers
from mover.io.scenes.placing import Matrix

SIZE = (1920, 1080)  # [px], of the colour images
FPS = 30.0
SCENES = (
    "MPH112", "MPH11", "MPH16", "MPH1Library", "MPH8", "N0Sofa", "N3Library", "N3Office",
    "N3OpenArea", "Werkraum",
)  # fmt: skip
"""The ten scenes on which the paper measures."""
BOOTHS = ("BasementSittingBooth", "N0SittingBooth")
"""Left out: a bench and its table that cannot be distinguished."""
VIDEOS, SHOTS = 51, 178  #: recordings of the ten scenes, and frames of the quantitative part
QUANTITATIVE = "vicon"
FEMALE = ("162", "3452", "159", "03403", "3403")
"""Subjects whose fits are of the female model; all others are male."""
Z_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  #: the scans' z up -> +y up
PAUSE = 60.0  # [s] between two videos of one capture: no person is tracked across it
FITS = ("PROXD", "PROX", "fittings/PROXD", "fittings/PROX", "fittings/RGB")
"""Where fitted bodies may lie; the first that is there counts."""
GIVEN_FITS = ("RGB", "PROX")
"""Fits of the quantitative part that the paper compares with, in fittings/."""


@dataclass(frozen=True)
class Recording:
    """One video of PROX."""

    root: Path
    name: str

    @property
    def scene(self) -> str:
        """The room: the first part of the name."""
        return self.name.split("_")[0]

    @property
    def subject(self) -> str:
        """Who is in it, by the number in the name; the name itself where it has none."""
        parts = self.name.split("_")
        return parts[1] if len(parts) > 1 else self.name

    @property
    def gender(self) -> str:
        """Of the person, by the number in the name."""
        return "female" if self.subject in FEMALE else "male"


def recordings_of(root: Path) -> list[str]:
    """Names of the recordings of a user's copy, those of the two booths left out.

    Raises:
        InputError: If there are none.
    """
    folder = root / "recordings"
    names = sorted(p.name for p in folder.iterdir() if p.is_dir()) if folder.is_dir() else []
    kept = [n for n in names if n.split("_")[0] not in BOOTHS]
    if not kept:
        raise InputError(f"{root}: has no recordings/<Scene>_<Subject>_<Sequence>, expected PROX")
    return kept


FOLDERS = {
    "Color": "recordings/{}/Color",
    "BodyIndexColor": "recordings/{}/BodyIndexColor",
    "keypoints": "keypoints/{}",
    "mosh": "fittings/mosh/{}/results",
    **{kind: f"{kind}/{{}}/results" for kind in FITS},
}
"""What a recording has for each of its frames, by the folder's pattern in the user's copy."""


@dataclass(frozen=True)
class Timeline:
    """Which frame of the capture each file of a recording is."""

    recording: Recording
    frames: Mapping[str, int]  #: by the name of the picture, without its ending
    stills: bool  #: each frame is a shot of its own, at a time of its own

    def files(self, kind: str) -> dict[int, Path]:
        """The files or folders of one kind of `FOLDERS` by frame, ascending."""
        return {self.frames[name]: path for name, path in named_files(self.recording, kind)}


def timelines(recordings: Sequence[Recording]) -> tuple[Timeline, ...]:
    """The frames of recordings of one room, one after the other.

    A video keeps its numbers, and a minute lies between two; stills are numbered in their order.

    Raises:
        InputError: If two files of a recording would be one frame, or it has none.
    """
    lines: list[Timeline] = []
    start = 0
    for recording in recordings:
        names = [name for kind in FOLDERS for name, _ in named_files(recording, kind)]
        if not names:
            where = ", ".join(f.format(recording.name) for f in tuple(FOLDERS.values())[:3])
            raise InputError(f"{recording.name}: has no frames, expected files in {where}, ...")
        numbers = frame_numbers(names, recording.name)
        first, last = min(numbers.values()), max(numbers.values())
        frames = {name: start + number - first for name, number in numbers.items()}
        stills = recording.scene == QUANTITATIVE
        lines.append(Timeline(recording, frames, stills))
        start += last - first + 1 + (0 if stills else round(PAUSE * FPS))
    return tuple(lines)


def named_files(recording: Recording, kind: str) -> list[tuple[str, Path]]:
    """Names of frames with their files or folders, of one kind of `FOLDERS`.

    Raises:
        InputError: If two files have one name.
    """
    folder = recording.root / FOLDERS[kind].format(recording.name)
    if not folder.is_dir():
        return []
    found: dict[str, Path] = {}
    for path in sorted(folder.iterdir()):
        name = path.name if path.is_dir() else path.stem
        if path.name.startswith(".") or not re.search(r"\d", name):
            continue
        name = name.removesuffix("_keypoints")
        if name in found:
            raise InputError(f"{folder}: {found[name].name} and {path.name} are one frame")
        found[name] = path
    return list(found.items())


def asked_for(root: Path, names: Sequence[str]) -> tuple[Recording, ...]:
    """The recordings that a user names: whole names, or a room for all of its recordings.

    Raises:
        InputError: If there is no such recording, none is named, or they are of several rooms.
    """
    known = recordings_of(root)
    if not names and len(known) == 1:
        names = known
    found: list[str] = []
    for name in names or ("",):
        same = [n for n in known if n == name or n.split("_")[0] == name]
        if not same:
            some = ", ".join(known[:4]) + (", ..." if len(known) > 4 else "")
            raise InputError(f"--recording: {name!r} is none of {len(known)} in {root}: {some}")
        found += same
    chosen = tuple(Recording(root, name) for name in dict.fromkeys(found))
    for other in chosen[1:]:
        if other.scene != chosen[0].scene:
            raise InputError(
                f"--recordings: {chosen[0].name} is of {chosen[0].scene}, {other.name} of"
                f" {other.scene}, expected recordings of one room"
            )
    return chosen


def world_of(cam2world: Matrix) -> tuple[Matrix, Matrix]:
    """Our world (+y up, origin at the camera) from the scan's frame (4, 4), and R_cam_world."""
    turn = Z_UP @ cam2world[:3, :3]
    return affine(Z_UP, -Z_UP @ cam2world[:3, 3]), turn.T


BODIES = 6  # that Kinect distinguishes
NO_PEOPLE = 255
MOST = 0.7  # of the picture that a person may fill


def body_indices(
    lines: Sequence[Timeline], tracks: Mapping[str, int]
) -> dict[int, Instance | None]:
    """The person in each frame that has a mask; None where there is no person in it."""
    found: dict[int, Instance | None] = {}
    for line in lines:
        for frame, path in line.files("BodyIndexColor").items():
            code, track = code_of(read_body_index(path)), tracks[line.recording.subject]
            person = Instance("person", None, code, frame=frame, track=track)
            found[frame] = None if code is None else person
    return found


def people_of(masks: Mapping[int, Instance | None], fps: float | None) -> At | None:
    """The fields of people.json; None where no frame has a person; stills have no `fps`."""
    items = tuple(person for person in masks.values() if person is not None)
    return Instances(items, SIZE, "BodyIndexColor").people_tree(fps) if items else None


def pixels_of(masks: Mapping[int, Instance | None], frame: int) -> float:
    """Pixels of people in a frame; infinite where it has no mask."""
    person = masks.get(frame)
    if person is None or person.mask is None:
        return 0.0 if frame in masks else float("inf")
    return float(area(Masks(SIZE[1], SIZE[0], (person.mask,)), 0))


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
    person = pixels < BODIES
    if person.mean() > MOST:
        share = f"{person.mean():.0%} of the picture is a body"
        raise InputError(f"{path}: {share}, expected {NO_PEOPLE} where there is no person")
    return person[:, ::-1]


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
    """OpenPose files of a recording by their place in the capture, in the flipped pictures.

    Third-party code says that those of the qualitative part are of the mirrored pictures and those
    of the quantitative part are not. Where the fitted `bodies` are known, in the frame of the
    camera of the flipped pictures, they decide instead.
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
        f"keypoints/{frame:06d}_keypoints.json": _flipped(at) if mirrored else dict(at.mapping())
        for frame, at in trees.items()
    }


def _triples(at: At) -> NDArray[np.float64]:
    """x, y and confidence."""
    values = [v.number() for v in at.items()]
    if len(values) % 3:
        at.refuse("triples of x, y, confidence")
    return np.array(values).reshape(-1, 3)


def _middle(at: At) -> float | None:
    """Mean x of what is seen of the first person."""
    people = at.get("people").items()
    if not people:
        return None
    joints = _triples(people[0].get(BODY))
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
    for person in at.get("people").items():
        row = dict(person.mapping())
        hands = {LEFT: person.maybe(RIGHT), RIGHT: person.maybe(LEFT)}
        parts = {BODY: person.maybe(BODY), HEAD: person.maybe(HEAD), **hands}
        for key, given in parts.items():
            if given is not None:
                pairs = PAIRS_25 if key == BODY else FACE if key == HEAD else ()
                row[key] = _mirror(_triples(given), pairs).ravel().tolist()
        people.append(row)
    return {**at.mapping(), "people": people}


def _mirror(joints: NDArray[np.float64], pairs: tuple[tuple[int, int], ...]) -> NDArray[np.float64]:
    """Joints of the flipped picture; those that are missing stay zeros."""
    order = np.arange(len(joints))
    for a, b in pairs:
        if max(a, b) < len(joints):
            order[a], order[b] = b, a
    out = joints[order].copy()
    out[:, 0] = np.where(out[:, 2] > 0, SIZE[0] - out[:, 0], 0.0)
    return out
