"""Which annotation of one file is which of another, and which object of the scene it shows."""

import dataclasses
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from mover.core.types import Camera, Detection, Scene, SceneObject
from mover.furniture.library import canonical
from mover.geometry.boxes import iou2d
from mover.geometry.camera import NEAR, project, to_camera
from mover.geometry.placement import place_object
from mover.io.capture.parts import UNKNOWN
from mover.io.files.fields import At, get, items
from mover.io.masks.coco import annotations_tree

LEAST = 0.1  # boxes of one class that share less are not of one thing
OTHER_CLASS = 0.5  # the same, of different classes
Box = tuple[float, ...]


def pair_boxes(
    ours: Sequence[tuple[str, Box]], theirs: Sequence[tuple[str, Box]]
) -> dict[int, int]:
    """Pairs of (category, box) that show one thing: those with the greatest sum of overlaps.

    Args:
        ours: Category and x_min, y_min, x_max, y_max [px].
        theirs: The same of another file.

    Returns:
        Place in `theirs` by place in `ours`.
    """
    from scipy.optimize import linear_sum_assignment

    if not ours or not theirs:
        return {}
    a, b = (torch.tensor([box for _, box in side], dtype=torch.float64) for side in (ours, theirs))
    pairs = torch.broadcast_tensors(a[:, None], b[None])
    shared = iou2d(*pairs).numpy()
    same = np.array([[_alike(x, y) for y, _ in theirs] for x, _ in ours])
    gain = np.where(shared >= np.where(same, LEAST, OTHER_CLASS), shared + same, 0.0)
    rows, columns = linear_sum_assignment(gain, maximize=True)
    chosen = zip(rows.tolist(), columns.tolist(), strict=True)
    return {i: j for i, j in chosen if gain[i, j] > 0}


def _alike(a: str, b: str) -> bool:
    """One class, or a thing without a name."""
    return UNKNOWN in (a, b) or canonical(a) == canonical(b)


def known_boxes(at: At) -> list[tuple[str, Box]]:
    """Category and box of each annotation of objects.json, which was checked before."""
    names = {c.value["id"]: str(c.value["name"]) for c in items(get(at, "categories"))}
    found: list[tuple[str, Box]] = []
    for item in items(get(at, "annotations")):
        x, y, w, h = item.value["bbox"]
        found.append((names[item.value["category_id"]], (x, y, x + w, y + h)))
    return found


def merged(primary: At, secondary: At, *, newer: bool, keep: frozenset[int] | None) -> At:
    """The annotations of two files as one; the first file's ids count.

    Args:
        primary: objects.json whose ids the scene names.
        secondary: The other one, of the same image.
        newer: The second file is the newer one: its boxes and masks win.
        keep: Of the first file, ids to keep although the second has no partner; None: all.
    """
    pairs = pair_boxes(known_boxes(primary), known_boxes(secondary))
    ours, theirs = _named_rows(primary), _named_rows(secondary)
    rows: list[dict[str, Any]] = []
    for i, row in enumerate(ours):
        if i in pairs:
            rows.append(_joined(row, theirs[pairs[i]], newer))
        elif keep is None or row["id"] in keep:
            rows.append(row)
    taken = set(pairs.values())
    free = max((row["id"] for row in ours), default=-1) + 1
    for j, row in enumerate(theirs):
        if j not in taken:
            rows.append({**row, "id": free})
            free += 1
    return _tree(primary, rows)


def _named_rows(at: At) -> list[dict[str, Any]]:
    """Annotations with the name of their category instead of its id."""
    names = {c.value["id"]: str(c.value["name"]) for c in items(get(at, "categories"))}
    return [
        {**item.value, "category_id": names[item.value["category_id"]]}
        for item in items(get(at, "annotations"))
    ]


def _joined(row: dict[str, Any], other: dict[str, Any], newer: bool) -> dict[str, Any]:
    """One annotation of two: masks before boxes, the newer before the older."""
    first, second = (other, row) if newer else (row, other)
    if "segmentation" in second and "segmentation" not in first:
        first, second = second, first
    name = row["category_id"] if row["category_id"] != UNKNOWN else other["category_id"]
    return {**second, **first, "id": row["id"], "category_id": name}


def _tree(like: At, rows: Sequence[Mapping[str, Any]]) -> At:
    """objects.json of named rows."""
    return At(annotations_tree(rows, items(get(like, "images"))[0].value), like.file)


def linked(scene: Scene, at: At) -> dict[str, int]:
    """Annotation of each object that has none yet, by the objects' outlines in the image.

    Returns:
        Annotation id by object id, for those that find one.
    """
    used = {p.annotation for p in scene.objects}
    rows = [(row.value["id"], box) for row, box in zip(
        items(get(at, "annotations")), known_boxes(at), strict=True)]  # fmt: skip
    free = [(key, box) for key, box in rows if key not in used]
    bare = [(p, box) for p in scene.objects if p.annotation is None
            and (box := outline(p, scene.camera)) is not None]  # fmt: skip
    pairs = pair_boxes([(p.category, box) for p, box in bare], [box for _, box in free])
    return {bare[i][0].id: free[j][0] for i, j in pairs.items()}


def outline(
    piece: SceneObject, camera: Camera, turn: Float[Tensor, "3 3"] | None = None
) -> Box | None:
    """The rectangle around an object in the image, clipped to it; None where it is not seen.

    Args:
        piece: The object.
        camera: That looks at it.
        turn: Of the world before that.
    """
    verts = place_object(piece).verts
    verts = to_camera(verts if turn is None else verts @ turn.mT, camera.R_cam_world)
    verts = verts[verts[:, 2] > NEAR]
    if not len(verts):
        return None
    seen = project(verts, camera.K)
    size = torch.tensor([camera.width, camera.height], dtype=seen.dtype)
    low, high = seen.amin(0).clamp_min(0), torch.minimum(seen.amax(0), size)
    if not bool((high > low).all()):
        return None
    corners: NDArray[np.float64] = torch.cat([low, high]).double().numpy()
    return tuple(corners.tolist())


def with_links(scene: Scene, links: Mapping[str, int]) -> Scene:
    """The scene with these annotations."""
    pieces = [
        dataclasses.replace(p, annotation=links.get(p.id, p.annotation)) for p in scene.objects
    ]
    return dataclasses.replace(scene, objects=tuple(pieces))


# Whether a scene lies in another world than it says: mirrored, upside down, or with z up.


POOR, BETTER = 0.2, 0.4  # mean overlap of boxes: such a scene is odd if another world fits so well
OTHERS: dict[str, Float[Tensor, "3 3"]] = {
    "mirrored (left and right are swapped)": torch.diag(torch.tensor([-1.0, 1.0, 1.0])),
    "upside down (+y is down)": torch.diag(torch.tensor([1.0, -1.0, -1.0])),
    "lying on its side (+z is up)": torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "behind the camera (+z is forward)": torch.diag(torch.tensor([-1.0, 1.0, -1.0])),
}


def overlap(scene: Scene, detections: tuple[Detection, ...]) -> float | None:
    """Mean overlap of the objects' outlines and their detections; None without any pair."""
    return _overlap(scene, detections, torch.eye(3))


def odd_world(scene: Scene, detections: tuple[Detection, ...]) -> str | None:
    """What is wrong with the axes of a scene whose objects miss their detections; None: nothing."""
    own = overlap(scene, detections)
    if own is None or own >= POOR:
        return None
    found = {name: _overlap(scene, detections, turn) or 0.0 for name, turn in OTHERS.items()}
    name = max(found, key=lambda key: found[key])
    if found[name] < BETTER:
        return None
    shares = f"mean overlap with the detections {own:.2f}, otherwise {found[name]:.2f}"
    return f"the scene seems {name}: {shares}"


def _overlap(
    scene: Scene, detections: tuple[Detection, ...], turn: Float[Tensor, "3 3"]
) -> float | None:
    """Mean overlap with the world turned or mirrored first."""
    boxes = {d.id: d.box for d in detections}
    views = [
        (outline(p, scene.camera, turn), boxes[p.annotation])
        for p in scene.objects
        if p.annotation is not None and p.annotation in boxes
    ]
    values = [0.0 if ours is None else float(iou2d(torch.tensor(ours), b)) for ours, b in views]
    return sum(values) / len(values) if values else None
