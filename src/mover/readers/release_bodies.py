"""Bodies and contacts of the authors' release: SMPL-X meshes in a world with y down."""

from pathlib import Path
from typing import Any

import numpy as np

from ..records import InputError
from .fields import At
from .instances_arrays import read_array
from .placing import FLIP, Matrix
from .total3d_files import read_shape

FPS = 30.0
STAGES = ("smplifyx_results_st2*", "smplifyx_results_st0*", "*")
CONTACTS = "*_sample_00.npy"


def body_arrays(folder: Path, R: Matrix | None, notes: list[str]) -> tuple[At | None, int]:
    """The arrays of bodies.npz in the camera's frame, and the number of frame 0.

    Args:
        folder: The sequence.
        R: R_cam_world of the world of the meshes, whose y is down; None: not known.
        notes: Takes what is odd.

    Raises:
        InputError: If a mesh cannot be read or has another topology than the first.
    """
    paths = _meshes(folder)
    if not paths or R is None:
        return None, 1
    numbers = [int(p.stem) for p in paths]
    verts: list[Matrix] = []
    faces = read_shape(paths[0])[1]
    for path in paths:
        points, own = read_shape(path)
        if own.shape != faces.shape or len(points) != len(verts[0] if verts else points):
            raise InputError(f"{path.name}: has another topology, expected that of {paths[0].name}")
        verts.append(points @ FLIP @ R.T)
    notes.append(f"{len(paths)} bodies are those of {paths[0].parent.parent.name}")
    arrays: dict[str, Any] = {
        "vertices": np.stack(verts).astype(np.float32),
        "faces": faces,
        "frame": np.array(numbers) - numbers[0],
        "person": np.zeros(len(numbers), dtype=np.int64),
        "space": np.array("camera"),
        "fps": np.array(FPS),
    }
    return At(arrays, paths[0].parent.name), numbers[0]


def _meshes(folder: Path) -> list[Path]:
    """The meshes of the last stage that has any, by number."""
    for stage in STAGES:
        for home in sorted(folder.glob(f"{stage}/meshes")):
            kinds = [p for p in home.iterdir() if p.suffix in (".obj", ".ply")]
            paths = [p for p in kinds if p.stem.isdecimal()]
            if paths:
                return sorted(paths, key=lambda p: int(p.stem))
    return []


def contact_arrays(folder: Path, bodies: At | None, notes: list[str]) -> At | None:
    """The arrays of contacts.npz, where there is one file for each body.

    Raises:
        InputError: If a file cannot be read.
    """
    if bodies is None:
        return None
    rows, count = bodies.value["vertices"].shape[:2]
    home = next(iter(sorted({p.parent for p in folder.rglob(CONTACTS)})), None)
    if home is None:
        return None
    paths = [home / f"{frame:06d}_sample_00.npy" for frame in bodies.value["frame"].tolist()]
    there = [path for path in paths if path.is_file()]
    if len(there) < rows:
        notes.append(f"contacts: only {len(there)} of {rows} bodies have a file, so none is used")
        return None
    values = [read_array(path) for path in paths]
    for at in values:
        if at.value.dtype.kind != "f" or at.value.size != count:
            raise InputError(f"{at.file}: has shape {at.value.shape}, expected ({count}, 1)")
    stack = np.stack([at.value.reshape(-1) for at in values]).astype(np.float32)
    return At({"probability": stack.clip(0, 1)}, home.name)
