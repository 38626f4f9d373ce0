"""contacts.npz of a result: who touches what, and the same as tables for learners."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from mover.core.contact_labels import ContactLabels
from mover.core.errors import InputError
from mover.core.types import Bodies
from mover.io.export.finished import Exported, Finished, Up
from mover.io.export.people import FPS, tracks_of
from mover.io.export.solids import AXES, floor_height
from mover.io.files.npz import read_npz, write_npz

FORMAT, FILE = "mover-contact-labels", "contacts.npz"
SURE = 0.5  # confidence from which `object_contact` says yes
WIDTHS = {"position": (3,), "normal": (3,), "gap": (), "confidence": ()}
INDICES = ("frame", "person", "part", "object")


def write_labels(labels: ContactLabels, path: Path) -> None:
    """Write the labels of a result."""
    arrays: dict[str, NDArray[Any]] = {
        name: getattr(labels, name).numpy().astype(np.int64) for name in INDICES
    }
    arrays |= {name: getattr(labels, name).float().numpy() for name in WIDTHS}
    names = {"parts": np.array(labels.parts), "objects": np.array(labels.objects)}
    write_npz({"format": np.array(FORMAT), **arrays, **names}, path)


def read_labels(path: Path) -> ContactLabels:
    """Read them back.

    Raises:
        InputError: If there are none, or something in them is wrong.
    """
    if not path.is_file():
        raise InputError(f"{path}: not found; `mover run` writes it for results with people")
    found = read_npz(path).value
    missing = [n for n in (*INDICES, *WIDTHS, "parts", "objects") if n not in found]
    if missing or str(found.get("format", "")) != FORMAT:
        lacks = f"lacks {', '.join(missing)}" if missing else "is of another format"
        raise InputError(f"{path.name}: {lacks}, expected the labels that `mover run` writes")
    rows = len(found["frame"])
    for name, width in {**dict.fromkeys(INDICES, ()), **WIDTHS}.items():
        if found[name].shape != (rows, *width):
            expected = f"expected {(rows, *width)}"
            raise InputError(f"{path.name}: '{name}' has shape {found[name].shape}, {expected}")
    return ContactLabels(
        **{name: torch.from_numpy(found[name]) for name in (*INDICES, *WIDTHS)},
        parts=tuple(found["parts"].tolist()),
        objects=tuple(found["objects"].tolist()),
    )


def export_contacts(finished: Finished, folder: Path, up: Up = "y") -> Exported:
    """Write `contacts_<person>.npz`: a table of frames, parts of the body and objects.

    Args:
        finished: The result.
        folder: Where the files go.
        up: y: the world of scene.json; z: that of simulators, with the floor at 0.

    Raises:
        InputError: If the result has no labels.
    """
    labels = read_labels(finished.out / FILE)
    if finished.bodies is None:
        raise InputError("--to contacts: the result has no bodies")
    if up == "z":
        labels = _upright(labels, floor_height(finished.scene))
    files: list[Path] = []
    for track in tracks_of(finished.bodies):
        mine = labels.person == track.person
        files.append(folder / f"contacts_{track.person}.npz")
        arrays = _tables(labels, mine, track.frame, finished.bodies)
        write_npz({**arrays, "up_axis": np.array(up)}, files[-1])
    share = f"object_contact is a confidence of {SURE:g} or more of any part"
    return Exported(tuple(files), (share,))


def _upright(labels: ContactLabels, floor: float) -> ContactLabels:
    turn = AXES.to(labels.position)
    place = labels.position @ turn.mT - torch.tensor([0.0, 0.0, floor]).to(labels.position)
    return dataclasses.replace(labels, position=place, normal=labels.normal @ turn.mT)


def _tables(
    labels: ContactLabels, mine: torch.Tensor, frame: torch.Tensor, bodies: Bodies
) -> dict[str, NDArray[Any]]:
    """One person; rows are the frames in which they are seen, NaN where nothing is touched."""
    row_of = {int(f): k for k, f in enumerate(frame)}
    row = np.array([row_of.get(int(f), -1) for f in labels.frame[mine]], np.int64)
    known = row >= 0
    at = row[known], labels.part[mine].numpy()[known], labels.object[mine].numpy()[known]
    shape = (len(frame), len(labels.parts), len(labels.objects))
    sure = np.zeros(shape, np.float32)
    sure[at] = labels.confidence[mine].numpy()[known]
    places = {name: np.full((*shape, 3), np.nan, np.float32) for name in ("position", "normal")}
    for name, table in places.items():
        table[at] = getattr(labels, name)[mine].numpy()[known]
    return {
        "frame": frame.numpy(),
        "fps": np.array(bodies.fps or FPS),
        "parts": np.array(labels.parts),
        "objects": np.array(labels.objects),
        "contact": sure,
        "object_contact": sure.max(1) >= SURE,
        **places,
    }
