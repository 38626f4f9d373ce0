"""Masks as tools write them: COCO, detectron2, MOVER, SA-V and SAM 3 as JSON; PNG; npz."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path

from mover.core.errors import InputError
from mover.io.capture.parts import Hints, Parts
from mover.io.files.fields import At, read_json
from mover.io.files.images import image_size
from mover.io.masks.instances import Instances, fitted, is_person, objects_tree
from mover.io.masks.instances_json import coco_instances, list_instances, masklets, sam3_instances
from mover.io.masks.instances_pixels import read_mask_arrays, read_mask_pictures

DETECTIONS = "detections.json"


def read_instances(path: Path, names: Mapping[str, str], size: tuple[int, int] | None) -> Instances:
    """The instances of any known file or folder of masks.

    Args:
        path: A .json, .npz or .png file, or a folder.
        names: Categories where the source has none: by number, file name or index.
        size: Width and height of the image, for sources that do not tell it [px].

    Raises:
        InputError: If the masks are wrong or of no known kind.
    """
    if path.is_dir():
        return _read_folder(path, names, size)
    match path.suffix.lower():
        case ".json":
            return _of_json(read_json(path), names, size)
        case ".npz" | ".npy":
            return read_mask_arrays(path, names)
        case ".png":
            return read_mask_pictures([path], path, names, size)
        case _:
            kinds = ".json, .npz, .npy, .png or a folder of pictures"
            raise InputError(f"{path}: is no file of masks, expected {kinds}")


def _of_json(at: At, names: Mapping[str, str], size: tuple[int, int] | None) -> Instances:
    """JSON, told apart by its keys."""
    keys = set(at.value) if isinstance(at.value, dict) else set[str]()
    if "annotations" in keys:
        return coco_instances(at, names, size)
    if "masklet" in keys:
        return masklets(at, names)
    if "pred_masks" in keys:
        return sam3_instances(at, names)
    if isinstance(at.value, list):
        return list_instances(at, names, size)
    known = "COCO's 'annotations', a list of detections, SA-V's 'masklet' or SAM 3's 'pred_masks'"
    raise InputError(f"{at.file}: has the keys {sorted(keys)[:5]}, expected {known}")


def _read_folder(folder: Path, names: Mapping[str, str], size: tuple[int, int] | None) -> Instances:
    """A folder of pictures, or one with detections.json for each numbered frame."""
    frames = sorted(p for p in folder.iterdir() if p.is_dir() and (p / DETECTIONS).is_file())
    if frames:
        return _frame_folders(frames, folder, names, size)
    pictures = sorted(p for p in folder.iterdir() if p.suffix.lower() == ".png")
    if not pictures:
        expected = f"pictures (.png), or folders of frames with {DETECTIONS}"
        raise InputError(f"{folder}: has no masks, expected {expected}")
    return read_mask_pictures(pictures, folder, names, size)


def _frame_folders(
    frames: list[Path], folder: Path, names: Mapping[str, str], size: tuple[int, int] | None
) -> Instances:
    """MOVER's and detectron2's `<frame>/detections.json`; frames are numbered from the first."""
    found: list[Instances] = []
    first = 1 if frames[0].name.isdecimal() and int(frames[0].name) == 1 else 0
    for index, frame in enumerate(frames):
        number = int(frame.name) - first if frame.name.isdecimal() else index
        one = list_instances(read_json(frame / DETECTIONS), names, size)
        items = tuple(dataclasses.replace(item, frame=number) for item in one.items)
        found.append(dataclasses.replace(one, items=items))
    sizes = {one.size for one in found if one.size is not None}
    if len(sizes) > 1:
        raise InputError(f"{folder}: has images of {len(sizes)} sizes, expected one")
    everything = tuple(item for one in found for item in one.items)
    return Instances(everything, sizes.pop() if sizes else size, folder.name)


def mask_parts(source: Path, hints: Hints) -> Parts:
    """What a file of masks knows: the objects, and the people of the reference image."""
    size = None if hints.image is None else image_size(hints.image)
    found = fitted(read_instances(source, hints.names, size), size)
    things = [item for item in found.items if not is_person(item)]
    return Parts(name=source.stem, objects=objects_tree(found, things))
