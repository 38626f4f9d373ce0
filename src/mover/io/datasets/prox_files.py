"""Files of PROX: calibration, cameras, scans, signed distances, names of frames and recordings."""

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from mover.core.errors import InputError
from mover.geometry.volume import Volume
from mover.io.files.cameras import read_camera_file
from mover.io.files.fields import At, get, integer, read_json, refuse, vector
from mover.io.files.schema import rigid
from mover.io.scenes.placing import Matrix

SIZE = (1920, 1080)  # [px], of the colour images
FPS = 30.0
SCENES = (
    "MPH112", "MPH11", "MPH16", "MPH1Library", "MPH8", "N0Sofa", "N3Library", "N3Office",
    "N3OpenArea", "Werkraum",
)  # fmt: skip
"""The ten scenes on which the paper measures."""
BOOTHS = ("BasementSittingBooth", "N0SittingBooth")
"""Left out: a bench and its table that cannot be told apart."""
VIDEOS, SHOTS = 51, 178
"""Recordings of the ten scenes, and frames of the quantitative part."""
QUANTITATIVE = "vicon"
FEMALE = ("162", "3452", "159", "03403", "3403")
"""Subjects whose fits are of the female model; all others are male."""
Z_UP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
"""The scans' z up -> +y up."""
UNEVEN = 1e-3  # [share], cells that differ by no more are cubes
MOST_CELLS = 512  # along an axis of a signed distance field


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
    def gender(self) -> str:
        """Of the person, by the number in the name."""
        parts = self.name.split("_")
        return "female" if len(parts) > 1 and parts[1] in FEMALE else "male"


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


def frames_of(recording: Recording) -> dict[int, Path]:
    """Pictures by the number in their name, e.g. s001_frame_00001__00.00.00.023.jpg."""
    folder = recording.root / "recordings" / recording.name / "Color"
    if not folder.is_dir():
        return {}
    paths = sorted(p for p in folder.iterdir() if p.suffix.lower() in (".jpg", ".jpeg", ".png"))
    return {number_of(path): path for path in paths}


def number_of(path: Path) -> int:
    """The frame's number in the name of a file or folder.

    Raises:
        InputError: If it has none.
    """
    found = re.search(r"frame_?(\d{1,9})", path.name) or re.search(r"(\d{1,9})", path.name)
    if found is None:
        raise InputError(f"{path.name}: has no number of a frame, expected s001_frame_00001__...")
    return int(found[1])


def lens_of(root: Path) -> At:
    """The colour camera; images are mirrored before it holds, and cx is not.

    Raises:
        InputError: If the calibration is missing or wrong.
    """
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
    world = np.eye(4)
    world[:3, :3] = Z_UP
    world[:3, 3] = -Z_UP @ cam2world[:3, 3]
    return world, turn.T


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
