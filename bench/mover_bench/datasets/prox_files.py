"""Files of PROX: calibration, cameras, scans, signed distances, names of frames and recordings."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from mover.core.errors import InputError
from mover.geometry.rotations import affine
from mover.geometry.volume import Volume
from mover.io.files.cameras import read_camera_file
from mover.io.files.fields import At, get, integer, read_json, refuse, text, vector
from mover.io.files.schema import rigid
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
VIDEOS, SHOTS = 51, 178
"""Recordings of the ten scenes, and frames of the quantitative part."""
QUANTITATIVE = "vicon"
FEMALE = ("162", "3452", "159", "03403", "3403")
"""Subjects whose fits are of the female model; all others are male."""
Z_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
"""The scans' z up -> +y up."""
UNEVEN = 1e-3  # [share], cells that differ by no more are cubes
MOST_CELLS = 512  # along an axis of a signed distance field


PAUSE = 60.0  # [s] between two videos of one capture: no person is tracked across it
FITS = ("PROXD", "PROX", "fittings/PROXD", "fittings/PROX", "fittings/RGB")
"""Where fitted bodies may lie; the first that is there counts."""


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
ENDINGS = ("_keypoints",)  # of names beside those of the pictures


@dataclass(frozen=True)
class Timeline:
    """Which frame of the capture each file of a recording is."""

    recording: Recording
    frames: Mapping[str, int]
    """By the name of the picture, without its ending."""
    stills: bool
    """Each frame is a shot of its own, at a time of its own."""

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
        for ending in ENDINGS:
            name = name.removesuffix(ending)
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


def lens_of(root: Path) -> At:
    """The colour camera; images are mirrored before it holds, and cx is not."""
    return read_camera_file(root / "calibration" / "Color.json", SIZE)


def scene_camera(root: Path, scene: str) -> Matrix:
    """cam2world: the scan's frame (z up) from the camera's (4, 4).

    Raises:
        InputError: If the file is missing or is no rigid transform.
    """
    return rigid(read_json(root / "cam2world" / f"{scene}.json"))


def world_of(cam2world: Matrix) -> tuple[Matrix, Matrix]:
    """Our world (+y up, origin at the camera) from the scan's frame (4, 4), and R_cam_world."""
    turn = Z_UP @ cam2world[:3, :3]
    return affine(Z_UP, -Z_UP @ cam2world[:3, 3]), turn.T


SCAN_SDF = "truth/scan_sdf.json"
"""Where a capture says which signed distance is that of its scan: it is too large for a copy."""


def scan_of(capture: Path) -> tuple[Volume, Matrix] | None:
    """The signed distance of the scan of a capture, and the true world from its frame (4, 4).

    Raises:
        InputError: If what the capture names is not there, or is wrong.
    """
    path = capture / SCAN_SDF
    if not path.is_file():
        return None
    at = read_json(path)
    root, scene = text(get(at, "root")), text(get(at, "scene"))
    return read_sdf(Path(root), scene), rigid(get(at, "world_scan"))


def read_sdf(root: Path, scene: str) -> Volume:
    """The signed distance of a scan in its own frame, negative inside [m].

    The array is [x, y, z]; min and max are the outer borders of the grid, as its cells are
    (max - min) / dim wide.

    Raises:
        InputError: If a file is missing, or the array is not dim³ numbers.
    """
    at = read_json(root / "sdf" / f"{scene}.json")
    dim = integer(get(at, "dim"), 2, MOST_CELLS)
    low, high = np.array(vector(get(at, "min"), 3)), np.array(vector(get(at, "max"), 3))
    path = root / "sdf" / f"{scene}_sdf.npy"
    values = _read_npy(path)
    if values.size != dim**3 or (high <= low).any():
        raise InputError(f"{path.name}: has {values.size} values, expected {dim}³ of {at.file}")
    cell = (high - low) / dim
    if np.ptp(cell) > UNEVEN * cell.max():
        refuse(get(at, "max"), "a grid of cubes")
    return Volume(
        values=torch.from_numpy(values.reshape(dim, dim, dim).astype(np.float32)),
        origin=torch.from_numpy((low + cell / 2).astype(np.float32)),
        cell=float(cell.mean()),
    )


def _read_npy(path: Path) -> NDArray[np.float64]:
    """The numbers of an .npy file."""
    from mover.io.files.npz import read_npy

    at = read_npy(path)
    if not isinstance(at.value, np.ndarray) or at.value.dtype.kind != "f":
        refuse(at, "floating-point numbers")
    return at.value
