"""contacts.npz of a result: which parts of bodies touch which objects; as tables for learners."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from mover.core.errors import InputError
from mover.core.types import ContactLabels
from mover.io.export.finished import Exported, Finished, Up, tracks_of
from mover.io.export.solids import AXES, floor_height
from mover.io.files.fields import read_npz, write_npz

FORMAT, FILE = "mover-contact-labels", "contacts.npz"
SURE = 0.5  # confidence from which `object_contact` says yes
INDICES = ("frame", "person", "part", "object")
REALS = {"position": (3,), "normal": (3,), "gap": (), "confidence": ()}


def write_labels(labels: ContactLabels, path: Path) -> None:
    """Write the labels of a result."""
    arrays: dict[str, NDArray[Any]] = {
        name: getattr(labels, name).numpy().astype(np.int64) for name in INDICES
    }
    arrays |= {name: getattr(labels, name).float().numpy() for name in REALS}
    names = {"parts": np.array(labels.parts), "objects": np.array(labels.objects)}
    write_npz({"format": np.array(FORMAT), **arrays, **names}, path)


def read_labels(path: Path) -> ContactLabels:
    """Read them back.

    Raises:
        InputError: If there are none, or something in them is wrong.
    """
    if not path.is_file():
        raise InputError(f"{path}: not found; `mover run` writes it for results with people")
    at = read_npz(path)
    found = at.value
    missing = [n for n in (*INDICES, *REALS, "parts", "objects") if n not in found]
    if missing or str(found.get("format", "")) != FORMAT:
        lacks = f"lacks {', '.join(missing)}" if missing else "is of another format"
        raise InputError(f"{path.name}: {lacks}, expected the labels that `mover run` writes")
    rows = len(at.get("frame").indices("rows"))
    return ContactLabels(
        **{name: torch.from_numpy(at.get(name).indices(rows)) for name in INDICES},
        **{name: torch.from_numpy(at.get(name).array((rows, *n))) for name, n in REALS.items()},
        parts=tuple(found["parts"].tolist()),
        objects=tuple(found["objects"].tolist()),
    )


def export_contacts(finished: Finished, folder: Path, up: Up = "y") -> Exported:
    """Write `contacts_<person>.npz`: a table of frames, parts of the body and objects.

    Rows are the frames in which the person is seen; positions and normals are NaN where nothing is
    touched. With z up the floor is at 0.

    Raises:
        InputError: If the result has no labels.
    """
    labels, bodies = read_labels(finished.out / FILE), finished.bodies
    if bodies is None:
        raise InputError("--to contacts: the result has no bodies")
    if up == "z":
        turn = AXES.to(labels.position)
        shift = torch.tensor([0.0, 0.0, floor_height(finished.scene)]).to(labels.position)
        position, normal = labels.position @ turn.mT - shift, labels.normal @ turn.mT
        labels = dataclasses.replace(labels, position=position, normal=normal)
    files: list[Path] = []
    for track in tracks_of(bodies):
        kept = (labels.person == track.person) & torch.isin(labels.frame, track.frame)
        rows = torch.searchsorted(track.frame, labels.frame[kept])
        cells = rows, labels.part[kept], labels.object[kept]
        contact = torch.zeros(len(track.frame), len(labels.parts), len(labels.objects))
        contact[cells] = labels.confidence[kept].float()
        spots = {key: torch.full((*contact.shape, 3), torch.nan) for key in ("position", "normal")}
        for name, table in spots.items():
            table[cells] = getattr(labels, name)[kept].float()
        arrays = {
            "frame": track.frame.numpy(), "fps": np.array(finished.clock[1]),
            "parts": np.array(labels.parts), "objects": np.array(labels.objects),
            "contact": contact.numpy(), "object_contact": (contact.amax(1) >= SURE).numpy(),
            "up_axis": np.array(up), **{name: table.numpy() for name, table in spots.items()},
        }  # fmt: skip
        files.append(folder / f"contacts_{track.person}.npz")
        write_npz(arrays, files[-1])
    note = f"object_contact is a confidence of {SURE:g} or more of any part"
    return Exported(tuple(files), (note,))
