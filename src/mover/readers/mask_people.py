"""People who hide furniture in the reference image, for people.json."""

from pathlib import Path
from typing import Any

from .fields import At, read_json
from .instances import Instances


def with_reference_people(people: At | None, found: Instances, folder: Path) -> At:
    """people.json with these masks as the people of the reference image.

    Args:
        people: The fields that are to be written; None: those of the folder, or none.
        found: Their masks.
        folder: The capture.
    """
    if people is None and (folder / "people.json").exists():
        people = read_json(folder / "people.json")
    empty = {"images": [], "annotations": [], "categories": [{"id": 1, "name": "person"}]}
    tree: dict[str, Any] = dict(empty if people is None else people.value)
    size = found.size or (0, 0)
    tree["reference_people"] = [
        {"segmentation": {"size": [size[1], size[0]], "counts": item.mask.decode("ascii")}}
        for item in found.items
        if item.mask is not None
    ]
    return At(tree, found.file)
