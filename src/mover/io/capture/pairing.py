"""Which annotation shows which object, by outlines in the image; and scenes in an odd world."""

from collections.abc import Sequence

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
POOR, BETTER = (
    0.2,
    0.4,
)  # mean overlap of boxes: a scene is odd if another world fits so much better
OTHERS: dict[str, Float[Tensor, "3 3"]] = {
    "mirrored (left and right are swapped)": torch.diag(torch.tensor([-1.0, 1.0, 1.0])),
    "upside down (+y is down)": torch.diag(torch.tensor([1.0, -1.0, -1.0])),
    "lying on its side (+z is up)": torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "behind the camera (+z is forward)": torch.diag(torch.tensor([-1.0, 1.0, -1.0])),
}
Box = tuple[float, ...]


def pair_boxes(
    ours: Sequence[tuple[str, Box]], theirs: Sequence[tuple[str, Box]]
) -> dict[int, int]:
    """Pairs of (category, box) that show one thing: those with the greatest sum of overlaps.

    Args:
        ours: Category and x_min, y_min, x_max, y_max [px].
        theirs: The same of another file.

    Returns:
        Index in `theirs` by index in `ours`.
    """
    from scipy.optimize import linear_sum_assignment

    if not ours or not theirs:
        return {}
    a, b = (torch.tensor([box for _, box in side], dtype=torch.float64) for side in (ours, theirs))
    shared = iou2d(*torch.broadcast_tensors(a[:, None], b[None])).numpy()
    same = np.array(
        [[UNKNOWN in (x, y) or canonical(x) == canonical(y) for y, _ in theirs] for x, _ in ours]
    )
    gain = np.where(shared >= np.where(same, LEAST, OTHER_CLASS), shared + same, 0.0)
    rows, columns = linear_sum_assignment(gain, maximize=True)
    chosen = zip(rows.tolist(), columns.tolist(), strict=True)
    return {i: j for i, j in chosen if gain[i, j] > 0}


def known_boxes(at: At) -> list[tuple[str, Box]]:
    """Category and box of each annotation of objects.json, which was checked before."""
    names = {c.value["id"]: str(c.value["name"]) for c in items(get(at, "categories"))}
    found: list[tuple[str, Box]] = []
    for item in items(get(at, "annotations")):
        x, y, w, h = item.value["bbox"]
        found.append((names[item.value["category_id"]], (x, y, x + w, y + h)))
    return found


def linked(scene: Scene, at: At) -> dict[str, int]:
    """Annotation of each object that has none yet, by the objects' outlines in the image.

    Returns:
        Annotation id by object id, for those that find one.
    """
    used = {p.annotation for p in scene.objects}
    keys = [row.value["id"] for row in items(get(at, "annotations"))]
    free = [row for row in zip(keys, known_boxes(at), strict=True) if row[0] not in used]
    bare = [
        (p, box)
        for p in scene.objects
        if p.annotation is None and (box := outline(p, scene.camera)) is not None
    ]
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
    return tuple(torch.cat([low, high]).double().numpy().tolist())


def overlap(scene: Scene, detections: tuple[Detection, ...]) -> float | None:
    """Mean overlap of the objects' outlines and their detections; None without any pair."""
    return _overlap(scene, detections, torch.eye(3))


def odd_world(scene: Scene, detections: tuple[Detection, ...]) -> str | None:
    """The fault in the axes of a scene whose objects miss their detections; None without one."""
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
