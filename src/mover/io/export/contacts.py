"""contacts.npz of a result: which parts of bodies touch which objects; as tables for learners."""

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from mover.core.contact_labels import ContactLabels
from mover.core.errors import InputError
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

    Rows are the frames in which the person is seen; positions and normals are NaN where nothing is
    touched.

    Args:
        finished: The result.
        folder: Where the files go.
        up: y: the world of scene.json; z: that of simulators, with the floor at 0.

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
        row_of = {frame: k for k, frame in enumerate(track.frame.tolist())}
        of_person = (labels.person == track.person).tolist()
        kept = [k for k, frame in enumerate(labels.frame.tolist())
                if of_person[k] and frame in row_of]  # fmt: skip
        rows = np.array([row_of[int(labels.frame[k])] for k in kept], np.int64)
        cells = rows, labels.part[kept].numpy(), labels.object[kept].numpy()
        shape = (len(track.frame), len(labels.parts), len(labels.objects))
        contact = np.zeros(shape, np.float32)
        contact[cells] = labels.confidence[kept].numpy()
        spots = {key: np.full((*shape, 3), np.nan, np.float32) for key in ("position", "normal")}
        for name, table in spots.items():
            table[cells] = getattr(labels, name)[kept].numpy()
        arrays = {
            "frame": track.frame.numpy(),
            "fps": np.array(bodies.fps or FPS),
            "parts": np.array(labels.parts),
            "objects": np.array(labels.objects),
            "contact": contact,
            "object_contact": contact.max(1) >= SURE,
            "up_axis": np.array(up),
            **spots,
        }
        files.append(folder / f"contacts_{track.person}.npz")
        write_npz(arrays, files[-1])
    share = f"object_contact is a confidence of {SURE:g} or more of any part"
    return Exported(tuple(files), (share,))
