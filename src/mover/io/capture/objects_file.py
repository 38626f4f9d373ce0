"""objects.json: the instances in the reference image."""

from typing import Any

import torch
from jaxtyping import Float
from msgspec import Struct
from torch import Tensor

from mover.core.types import Camera, Detection, Masks
from mover.geometry.rle import area, decode, tight_box
from mover.io.files.fields import At, Warn, get, items, listed, maybe, plain, refuse, unique
from mover.io.files.schema import Box, Id, Share, checked
from mover.io.masks.coco import categories_of, category_of, check_image, mask_of, segmentation

LEAST_OVERLAP = 0.3  # of a box and the box of its mask; below, they are not of one thing


class AnnotationFields(Struct, frozen=True):
    """One of `annotations`; the image, the categories and the masks are COCO's (io/masks)."""

    id: Id
    image_id: Id
    bbox: Box
    score: Share | None = None


def detections_of(at: At, camera: Camera, warn: Warn) -> tuple[Detection, ...]:
    """The instances of objects.json.

    Raises:
        InputError: If a field is wrong.
    """
    image = check_image(items(get(at, "images"), 1)[0], camera)
    names = categories_of(get(at, "categories"))
    seen: set[object] = set()
    found: list[Detection] = []
    for item in items(get(at, "annotations")):
        row = checked(item, AnnotationFields)
        if row.image_id != image:
            refuse(get(item, "image_id"), f"{image}, the id of the one image")
        detection = _detection(item, row, camera, (names, warn))
        unique(get(item, "id"), seen, detection.id, "an id")
        found.append(detection)
    bare = [d.id for d in found if d.mask is None]
    if bare:
        warn(f"{at.file}: {listed('annotation', bare)} without segmentation, only the box counts")
    return tuple(found)


def _detection(
    at: At, row: AnnotationFields, camera: Camera, told: tuple[dict[int, str], Warn]
) -> Detection:
    """One annotation, with the names of categories and who takes warnings."""
    names, warn = told
    box = _box_of(get(at, "bbox"), row.bbox, camera, warn)
    mask = mask_of(at, camera, warn)
    if mask is not None:
        _check_mask(at, mask, box, warn)
    category = category_of(get(at, "category_id"), names)
    return Detection(row.id, category, box, mask, 1.0 if row.score is None else row.score)


def image_name(at: At) -> At | None:
    """The field that names the reference image, None if it is not given."""
    return maybe(items(get(at, "images"), 1)[0], "file_name")


def _box_of(at: At, box: Box, camera: Camera, warn: Warn) -> Float[Tensor, "4"]:
    """x_min, y_min, x_max, y_max of a COCO box [px]."""
    x, y, w, h = box
    if w <= 0 or h <= 0:
        refuse(at, "[x, y, w, h] with w, h above 0")
    if x >= camera.width or y >= camera.height or x + w <= 0 or y + h <= 0:
        refuse(at, f"a box inside the image of {camera.width} x {camera.height}")
    if x < -1 or y < -1 or x + w > camera.width + 1 or y + h > camera.height + 1:
        warn(f"{at.place} reaches beyond the image")
    return torch.tensor([x, y, x + w, y + h])


def _check_mask(at: At, mask: Masks, box: Float[Tensor, "4"], warn: Warn) -> None:
    """Refuse an empty mask, warn of one that is elsewhere than its box."""
    if not area(mask, 0):
        refuse(get(at, "segmentation"), "a mask with pixels", "an empty mask")
    tight = tight_box(decode(mask, 0))
    low, high = torch.maximum(box[:2], tight[:2]), torch.minimum(box[2:], tight[2:])
    common = (high - low).clamp_min(0).prod()
    union = (box[2:] - box[:2]).prod() + (tight[2:] - tight[:2]).prod() - common
    if common < LEAST_OVERLAP * union:
        warn(f"{at.place} has a box and a mask in different places")


def _corners_to_json(box: Float[Tensor, "4"]) -> list[float]:
    """COCO's [x, y, w, h]."""
    x, y, right, bottom = plain(box)
    return [x, y, right - x, bottom - y]


def detections_to_json(
    detections: tuple[Detection, ...], camera: Camera, file_name: str | None
) -> dict[str, Any]:
    """The content of objects.json."""
    names = list(dict.fromkeys(d.category for d in detections))
    image: dict[str, Any] = {"id": 0, "width": camera.width, "height": camera.height}
    annotations: list[dict[str, Any]] = []
    for d in detections:
        mask = {} if d.mask is None else {"segmentation": segmentation(d.mask, 0)}
        place = {"id": d.id, "image_id": 0, "category_id": names.index(d.category) + 1}
        score = {"bbox": _corners_to_json(d.box), "score": d.score}
        annotations.append({**place, **score, **mask})
    return {
        "images": [image if file_name is None else {**image, "file_name": file_name}],
        "categories": [{"id": i + 1, "name": name} for i, name in enumerate(names)],
        "annotations": annotations,
    }
