"""Which annotation shows which object, by outlines in the image; and scenes in an odd world."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mover.core.types import Camera, Detection, Scene, SceneObject
from mover.furniture.library import canonical
from mover.geometry.boxes import iou2d
from mover.geometry.camera import NEAR, project, to_camera
from mover.geometry.placement import place_object
from mover.io.capture.parts import UNKNOWN
from mover.io.files.fields import At, get, items

LEAST = 0.1  # boxes of one class that share less are not of one thing
OTHER_CLASS = 0.5  # the same, of different classes
POOR, BETTER = 0.2, 0.4  # mean overlaps of boxes: a scene is odd if another world fits so much more
OTHERS: dict[str, Float[Tensor, "3 3"]] = {
    "mirrored (left and right are swapped)": torch.diag(torch.tensor([-1.0, 1.0, 1.0])),
    "upside down (+y is down)": torch.diag(torch.tensor([1.0, -1.0, -1.0])),
    "lying on its side (+z is up)": torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "behind the camera (+z is forward)": torch.diag(torch.tensor([-1.0, 1.0, -1.0])),
}
Box = tuple[float, ...]
Row = Mapping[str, Any]
"""An annotation of objects.json with the name of its category as `category_id`."""


def named_rows(at: At) -> list[dict[str, Any]]:
    """The annotations of objects.json with the names of their categories instead of ids."""
    names = {c.value["id"]: str(c.value["name"]) for c in items(get(at, "categories"))}
    return [
        {**item.value, "category_id": names[item.value["category_id"]]}
        for item in items(get(at, "annotations"))
    ]


def pair_rows(ours: Sequence[Row], theirs: Sequence[Row]) -> dict[int, int]:
    """Rows (`category_id`, `bbox`) that show one thing: those with the greatest sum of overlaps.

    Returns:
        Index in `theirs` by index in `ours`.
    """
    from scipy.optimize import linear_sum_assignment

    if not ours or not theirs:
        return {}
    boxes = [np.array([row["bbox"] for row in side], dtype=np.float64) for side in (ours, theirs)]
    a, b = (torch.from_numpy(box + np.pad(box[:, :2], ((0, 0), (2, 0)))) for box in boxes)
    shared = iou2d(*torch.broadcast_tensors(a[:, None], b[None])).numpy()
    names, others = ([row["category_id"] for row in side] for side in (ours, theirs))
    same = np.array([[UNKNOWN in (x, y) or canonical(x) == canonical(y) for y in others]
                     for x in names])  # fmt: skip
    gain = np.where(shared >= np.where(same, LEAST, OTHER_CLASS), shared + same, 0.0)
    rows, columns = linear_sum_assignment(gain, maximize=True)
    chosen = zip(rows.tolist(), columns.tolist(), strict=True)
    return {i: j for i, j in chosen if gain[i, j] > 0}


def linked(scene: Scene, at: At) -> dict[str, int]:
    """Annotation of each object that has none yet, by the objects' outlines in the image.

    Returns:
        Annotation id by object id, for those that find one.
    """
    used = {p.annotation for p in scene.objects}
    free = [row for row in named_rows(at) if row["id"] not in used]
    bare: list[dict[str, Any]] = []
    for piece in scene.objects:
        box = outline(piece, scene.camera) if piece.annotation is None else None
        if box is not None:
            x, y, right, bottom = box
            size = [x, y, right - x, bottom - y]
            bare.append({"id": piece.id, "category_id": piece.category, "bbox": size})
    return {bare[i]["id"]: free[j]["id"] for i, j in pair_rows(bare, free).items()}


def outline(
    piece: SceneObject, camera: Camera, turn: Float[Tensor, "3 3"] | None = None
) -> Box | None:
    """The rectangle around an object in the image, clipped to it; None where it is not visible.

    The world is turned by `turn` before the camera looks at it.
    """
    verts = place_object(piece).verts
    verts = to_camera(verts if turn is None else verts @ turn.mT, camera.R_cam_world)
    verts = verts[verts[:, 2] > NEAR]
    if not len(verts):
        return None
    pixels = project(verts, camera.K)
    size = torch.tensor([camera.width, camera.height], dtype=pixels.dtype)
    low, high = pixels.amin(0).clamp_min(0), torch.minimum(pixels.amax(0), size)
    if not bool((high > low).all()):
        return None
    return tuple(torch.cat([low, high]).double().numpy().tolist())


def overlap(
    scene: Scene, detections: tuple[Detection, ...], turn: Float[Tensor, "3 3"] | None = None
) -> float | None:
    """Mean overlap of objects' outlines and detections, the world turned first; None: no pair."""
    boxes = {d.id: d.box for d in detections}
    views = [
        (outline(p, scene.camera, turn), boxes[p.annotation])
        for p in scene.objects
        if p.annotation is not None and p.annotation in boxes
    ]
    values = [0.0 if ours is None else float(iou2d(torch.tensor(ours), b)) for ours, b in views]
    return sum(values) / len(values) if values else None


def odd_world(scene: Scene, detections: tuple[Detection, ...]) -> str | None:
    """The fault in the axes of a scene whose objects miss their detections; None without one."""
    own = overlap(scene, detections)
    if own is None or own >= POOR:
        return None
    found = {name: overlap(scene, detections, turn) or 0.0 for name, turn in OTHERS.items()}
    name, best = max(found.items(), key=lambda pair: pair[1])
    if best < BETTER:
        return None
    return (
        f"the scene seems {name}: mean overlap with the detections {own:.2f}, otherwise {best:.2f}"
    )
