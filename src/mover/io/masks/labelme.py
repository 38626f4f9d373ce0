"""labelme's JSON: polygons, rectangles, circles, and the masks of its AI tools."""

import base64
import dataclasses
import io
import math
import warnings
from typing import Any

import numpy as np
from msgspec import Struct

from mover.io.files.fields import At
from mover.io.files.schema import Side, Text, checked
from mover.io.masks.instances import Instance, Instances, Size, code_in, code_of

CORNERS = 64  # of the polygon that stands for a circle
WITHOUT_AREA = ("point", "points", "line", "linestrip")


class LabelmeFields(Struct, frozen=True, rename="camel"):
    """A file of labelme: one picture."""

    image_width: Side
    image_height: Side
    shapes: list[Any]


class ShapeFields(Struct, frozen=True):
    """One of its shapes."""

    label: Text
    points: list[tuple[float, float]]
    shape_type: str = "polygon"
    group_id: int | None = None
    mask: str | None = None


def labelme_instances(at: At) -> Instances:
    """Labelme's areas; shapes of one label and `group_id` are one object."""
    from pycocotools import mask as coco

    tree = checked(at, LabelmeFields)
    size = tree.image_width, tree.image_height
    groups: dict[tuple[str, int | None], list[Any]] = {}
    items = at.get("shapes").items()
    areas = [x for x in items if x.mapping().get("shape_type") not in WITHOUT_AREA] or items
    for index, item in enumerate(areas):
        shape = checked(item, ShapeFields)
        kind = item.get("shape_type").choice(("polygon", "rectangle", "circle", "mask"))
        key = str(shape.label), -1 - index if shape.group_id is None else shape.group_id
        if kind == "mask":
            code = _pasted(item, shape, size)
        else:
            outline = [[v for point in _outline(kind, shape.points) for v in point]]
            code = code_in(dataclasses.replace(item.get("points"), value=outline), size)
        known = groups.setdefault(key, [])
        if code is not None:
            known.append({"size": [size[1], size[0]], "counts": code})
    found: list[Instance] = []
    for (label, _), codes in groups.items():
        whole: Any = coco.merge(codes) if codes else {}
        found.append(Instance(label, None, whole.get("counts")))
    said = f"{at.file}: {len(items) - len(areas)} shapes of points or lines are passed over"
    return Instances(tuple(found), size, at.file, notes=(said,) if areas != items else ())


def _outline(kind: str, points: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """The corners of a polygon, of a rectangle by two, or of a circle by middle and border."""
    if kind == "polygon" or len(points) != 2:
        return points
    (x0, y0), (x1, y1) = points
    if kind == "rectangle":
        return [(x0, y0), (x1, y0), (x1, y1), (x0, y1)]
    wide, turns = math.hypot(x1 - x0, y1 - y0), (math.tau * k / CORNERS for k in range(CORNERS))
    return [(x0 + wide * math.cos(turn), y0 + wide * math.sin(turn)) for turn in turns]


def _pasted(item: At, shape: ShapeFields, size: Size) -> bytes | None:
    """The mask of labelme's AI tools: a PNG in base64, whose first pixel lies at `points[0]`."""
    from PIL import Image

    (width, height), points = size, item.get("points")
    if not shape.points or not all(0 <= v < m for v, m in zip(shape.points[0], size, strict=True)):
        points.refuse("the corner of a mask in the image first")
    x, y = (int(v) for v in shape.points[0])
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            png = io.BytesIO(base64.b64decode(shape.mask or "", validate=True))
            with Image.open(png, formats=["PNG"]) as picture:
                if picture.width > width or picture.height > height:
                    item.get("mask").refuse("a mask no larger than the image", f"{picture.size}")
                pixels = np.asarray(picture.convert("L")) > 0
    except (
        OSError, ValueError, SyntaxError, Image.DecompressionBombError,
        Image.DecompressionBombWarning,
    ):  # fmt: skip
        item.get("mask").refuse("a PNG in base64", "what cannot be read")
    whole = np.zeros((height, width), dtype=bool)
    part = pixels[: height - y, : width - x]
    whole[y : y + part.shape[0], x : x + part.shape[1]] = part
    return code_of(whole)
