"""Which annotation shows which object, by outlines in the image."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch

from mover.core.types import Scene
from mover.furniture.library import canonical
from mover.io.capture.agreement import assigned, in_image, outermost, outlines, pairwise_iou2d
from mover.io.capture.parts import UNKNOWN
from mover.io.files.fields import At

LEAST = 0.1  # boxes of one class that share less are not of one thing
OTHER_CLASS = 0.5  # the same, of different classes
Row = Mapping[str, Any]
"""An annotation of objects.json with the name of its category as `category_id`."""


def named_rows(at: At) -> list[dict[str, Any]]:
    """The annotations of objects.json with the names of their categories instead of ids."""
    names = {c.value["id"]: str(c.value["name"]) for c in at.get("categories").items()}
    return [
        {**item.value, "category_id": names[item.value["category_id"]]}
        for item in at.get("annotations").items()
    ]


def pair_rows(ours: Sequence[Row], theirs: Sequence[Row]) -> dict[int, int]:
    """Rows (`category_id`, `bbox`) that show one thing: those with the greatest sum of overlaps.

    Returns:
        Index in `theirs` by index in `ours`.
    """
    if not ours or not theirs:
        return {}
    boxes = [np.array([row["bbox"] for row in side], dtype=np.float64) for side in (ours, theirs)]
    a, b = (torch.from_numpy(box + np.pad(box[:, :2], ((0, 0), (2, 0)))) for box in boxes)
    shared = pairwise_iou2d(a, b).numpy()
    names, others = ([row["category_id"] for row in side] for side in (ours, theirs))
    same = np.array([[UNKNOWN in (x, y) or canonical(x) == canonical(y) for y in others]
                     for x in names])  # fmt: skip
    gain = np.where(shared >= np.where(same, LEAST, OTHER_CLASS), shared + same, 0.0)
    return dict(assigned(torch.from_numpy(gain), LEAST))


def linked(scene: Scene, at: At) -> dict[str, int]:
    """Annotation of each object that has none yet, by the objects' outlines in the image.

    Returns:
        Annotation id by object id, for those that find one.
    """
    used = {p.annotation for p in scene.objects}
    free = [row for row in named_rows(at) if row["id"] not in used]
    bare: list[dict[str, Any]] = []
    pieces = [outermost(piece) for piece in scene.objects if piece.annotation is None]
    for piece, box in zip(
        pieces, in_image(outlines(pieces, scene.camera), scene.camera).tolist(), strict=True
    ):
        x, y, right, bottom = box
        if x < right and y < bottom:
            size = [x, y, right - x, bottom - y]
            bare.append({"id": piece.id, "category_id": piece.category, "bbox": size})
    return {bare[i]["id"]: free[j]["id"] for i, j in pair_rows(bare, free).items()}
