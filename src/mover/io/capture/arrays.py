"""A capture from arrays, for notebooks and other readers; the checks are the same."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from mover.core.types import Camera, Capture, Masks, Mesh, People
from mover.geometry.rle import encode, tight_box
from mover.io.capture.annotations_file import people_to_json
from mover.io.capture.folder import build_capture
from mover.io.capture.parts import Parts
from mover.io.capture.scene_file import scene_tree
from mover.io.files.fields import At
from mover.io.files.meshes import mesh_of
from mover.io.masks.coco import annotations_tree

Numbers = Tensor | NDArray[Any] | np.generic | Sequence[Any] | float
"""One number or many, of any library."""
FILE = "arrays"
"""How messages call what has no file."""


@dataclass(frozen=True)
class ObjectArrays:
    """One object: x_world = R_y(yaw) @ (scale * vertex) + translation."""

    id: str
    category: str
    vertices: Numbers
    """(vertices, 3) in its own frame: +y up, +z front [m]."""
    faces: Numbers
    """(faces, 3)."""
    translation: Numbers
    """[m]."""
    yaw: Numbers
    """About +y [rad]."""
    scale: Numbers = (1.0, 1.0, 1.0)
    support: str = "ground"
    """`ground`, `free` or the id of the object that carries it."""
    mask: Numbers | None = None
    """(h, w) of booleans: its pixels in the reference image."""
    box: Numbers | None = None
    """x_min, y_min, x_max, y_max [px]; by default that of the mask."""
    score: float = 1.0
    mesh_file: str = ""
    """The file that the mesh is from, where it has one."""


@dataclass(frozen=True)
class PeopleArrays:
    """Visible masks of people."""

    masks: Numbers
    """(rows, h, w) of booleans."""
    frame: Numbers
    person: Numbers
    heights: Mapping[str, float] | None = None
    """Known body heights by track [m]."""
    reference: Numbers | None = None
    """(people, h, w) of booleans: people in the reference image."""


def capture_from_arrays(
    camera: Mapping[str, Any],
    objects: Sequence[ObjectArrays],
    *,
    bodies: Mapping[str, Any] | None = None,
    people: PeopleArrays | None = None,
    image: Numbers | None = None,
    name: str = "arrays",
) -> Capture:
    """Make a capture in memory.

    Args:
        camera: The fields of camera.json: w, h, fl_x, fl_y, cx, cy, R_cam_world, height.
        objects: The initial scene with what the reference image shows of it.
        bodies: The arrays of bodies.npz, and `probability` of contacts.npz.
        people: Visible masks in the frames.
        image: (h, w, 3), the reference image, bytes or from 0 to 1.
        name: Of the capture.

    Raises:
        InputError: If anything is wrong.
    """
    arrays = None if bodies is None else {k: np.asarray(v) for k, v in bodies.items()}
    at = None if arrays is None else At(arrays, FILE, "bodies")
    return build_capture(
        Parts(
            name=name,
            camera=At({k: np.asarray(v).tolist() for k, v in camera.items()}, FILE, "camera"),
            scene=_scene(objects),
            objects=At(_annotations(objects), FILE),
            people=None if people is None else At(_people(people), FILE, "people"),
            bodies=at,
            contacts=at if arrays is not None and "probability" in arrays else None,
            load_mesh=partial(_load_mesh, objects),
            load_image=None if image is None else partial(_load_image, image),
            no_image=FILE,
        )
    )


def _load_mesh(objects: Sequence[ObjectArrays], at: At) -> tuple[Mesh, str]:
    """The mesh of an object that is named by its index."""
    given, field = objects[int(at.value)], f"objects[{at.value}]"
    verts = At(np.asarray(given.vertices), FILE, f"{field}.vertices").array(("V", 3))
    faces = At(np.asarray(given.faces), FILE, f"{field}.faces")
    return mesh_of(verts, faces.array(("F", 3), "whole"), faces), given.mesh_file


def _scene(objects: Sequence[ObjectArrays]) -> At:
    """The content of scene.json, where a mesh is named by its index."""
    rows = [
        {
            "id": o.id, "category": o.category, "mesh": str(i), "support": o.support,
            "annotation": None if o.mask is None and o.box is None else i,
            "translation": np.asarray(o.translation).tolist(),
            "yaw": np.asarray(o.yaw).tolist(), "scale": np.asarray(o.scale).tolist(),
        }
        for i, o in enumerate(objects)
    ]  # fmt: skip
    return scene_tree(rows, FILE)


def _annotations(objects: Sequence[ObjectArrays]) -> dict[str, Any]:
    """The content of objects.json."""
    rows: list[dict[str, Any]] = []
    for i, o in enumerate(objects):
        if o.mask is None and o.box is None:
            continue
        row: dict[str, Any] = {"id": i, "image_id": 0, "category_id": o.category}
        box = o.box
        if o.mask is not None:
            mask = _masks(o.mask, f"objects[{i}].mask", "h, w")
            if not mask.any():
                field = At(o.mask, FILE, f"objects[{i}].mask")
                field.refuse("a mask with pixels", "an empty mask")
            box = tight_box(mask).tolist() if box is None else box
            row["segmentation"] = {"size": list(mask.shape), "counts": encode(mask)}
        x, y, right, bottom = At(np.asarray(box), FILE, f"objects[{i}].box").array((4,)).tolist()
        score = np.asarray(o.score).tolist()
        rows.append({**row, "bbox": [x, y, right - x, bottom - y], "score": score})
    return annotations_tree(rows, {})


def _masks(value: Numbers, field: str, axes: str) -> Tensor:
    """One mask or several."""
    given: NDArray[Any] = np.asarray(value)
    if given.dtype != np.bool_ or given.ndim != len(axes.split()):
        At(given, FILE, field).refuse(f"an array of booleans of shape ({axes})")
    return torch.from_numpy(given)


def _people(people: PeopleArrays) -> dict[str, Any]:
    """The content of people.json."""
    masks, hidden = _coded(people.masks, "people.masks"), people.reference
    frame, person = (
        torch.from_numpy(At(np.asarray(value), FILE, f"people.{name}").indices(len(masks.counts)))
        for name, value in (("frame", people.frame), ("person", people.person))
    )
    reference = None if hidden is None else _coded(hidden, "people.reference")
    heights = {} if people.heights is None else At(people.heights, FILE, "people.heights").mapping()
    tree = people_to_json(People(masks, frame, person, {}), reference, None, ())
    return {**tree, "info": {"heights": heights}}


def _coded(value: Numbers, field: str) -> Masks:
    """The run-length codes of several masks."""
    masks = _masks(value, field, "rows, h, w")
    return Masks(masks.shape[1], masks.shape[2], tuple(encode(mask) for mask in masks))


def _load_image(image: Numbers, camera: Camera) -> Float[Tensor, "h w 3"]:
    """The reference image in [0, 1]."""
    at = At(np.asarray(image), FILE, "image")
    value = at.array((camera.height, camera.width, 3)).astype(np.float32)
    if at.value.dtype == np.uint8:
        value = value / np.float32(255)
    if value.min() < 0 or value.max() > 1:
        at.refuse("bytes, or numbers from 0 to 1")
    return torch.from_numpy(value)
