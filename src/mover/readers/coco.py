"""What every COCO file has: images, categories, masks of annotations."""

from typing import Any

from ..types import Camera, Masks
from .fields import LAST_ID, At, Warn, get, integer, items, maybe, refuse, text, unique
from .masks import from_coco, leaves_image


def check_image(at: At, camera: Camera) -> int:
    """The id of an image, whose size must be the camera's."""
    for key, size in (("width", camera.width), ("height", camera.height)):
        given = maybe(at, key)
        if given is not None and integer(given) != size:
            refuse(given, f"{size}, as the camera has")
    return integer(get(at, "id"))


def categories_of(at: At) -> dict[int, str]:
    """Names by id."""
    names: dict[int, str] = {}
    seen: set[object] = set()
    for item in items(at):
        key = integer(get(item, "id"), 0, LAST_ID)
        unique(get(item, "id"), seen, key, "an id")
        names[key] = text(get(item, "name"))
    return names


def category_of(at: At, names: dict[int, str]) -> str:
    """The name of a category."""
    key = integer(at, 0, LAST_ID)
    if key not in names:
        refuse(at, "the id of one of the categories")
    return names[key]


def mask_of(at: At, camera: Camera, warn: Warn) -> Masks | None:
    """The mask of an annotation, None without segmentation."""
    given = maybe(at, "segmentation")
    if given is None:
        return None
    size = camera.height, camera.width
    code = from_coco(given.value, *size, given.place)
    if leaves_image(given.value, *size):
        warn(f"{given.place} leaves the image and was clipped")
    return Masks(*size, (code,))


def segmentation(masks: Masks, index: int) -> dict[str, Any]:
    """The JSON object of a mask."""
    counts = masks.counts[index].decode("ascii")
    return {"size": [masks.height, masks.width], "counts": counts}
