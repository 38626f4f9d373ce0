"""keypoints.npz: the joints that a detector saw, by frame and person."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from ...types import Keypoints
from ..fields import At, array, choice, get, maybe, refuse
from ..npz_file import read_npz, write_npz
from .layouts import LAYOUTS


def write_keypoints(keypoints: Keypoints, path: Path) -> None:
    """Write keypoints as they are."""
    arrays: dict[str, NDArray[Any]] = {
        "layout": np.array(keypoints.layout),
        "frame": keypoints.frame.cpu().numpy(),
        "person": keypoints.person.cpu().numpy(),
        "points": keypoints.points.detach().cpu().numpy(),
        "confidence": keypoints.confidence.detach().cpu().numpy(),
    }
    if keypoints.fps is not None:
        arrays["fps"] = np.array(keypoints.fps)
    write_npz(arrays, path)


def read_keypoints(path: Path) -> Keypoints:
    """Read and check keypoints.npz.

    Raises:
        InputError: If anything in it is wrong.
    """
    at = read_npz(path)
    word = get(at, "layout")
    layout = choice(At(str(array(word, (), "text")), at.file, "layout"), tuple(LAYOUTS))
    frame = array(get(at, "frame"), ("B",), "whole").astype(np.int64)
    rows = len(frame)
    person = array(get(at, "person"), (rows,), "whole").astype(np.int64)
    if not rows or frame.min() < 0 or person.min() < 0:
        refuse(get(at, "frame"), "rows with frames and tracks from 0")
    points = array(get(at, "points"), (rows, LAYOUTS[layout], 2)).astype(np.float32)
    sure = get(at, "confidence")
    confidence = array(sure, (rows, LAYOUTS[layout])).astype(np.float32)
    if confidence.min() < 0 or confidence.max() > 1:
        refuse(sure, "numbers from 0 to 1", f"{confidence.min():g} to {confidence.max():g}")
    fps = maybe(at, "fps")
    return Keypoints(
        points=torch.from_numpy(points),
        confidence=torch.from_numpy(confidence),
        layout=layout,
        frame=torch.from_numpy(frame),
        person=torch.from_numpy(person),
        fps=None if fps is None else float(array(fps, ())[()]),
    )
