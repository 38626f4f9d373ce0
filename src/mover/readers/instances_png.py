"""Masks as pictures: label maps, one file for each thing, or alpha channels."""

import re
import warnings
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..records import InputError
from .fields import At, mapping, read_json, reason, text
from .instances import Instance, Instances, code_of
from .parts import UNKNOWN

LABELS = "labels.json"
NOT_MASKS = frozenset({"image", "rgb", "input", "reference", "depth"})
"""Names of pictures that lie beside masks."""
MOST_LABELS = 256


def read_mask_pictures(
    paths: Sequence[Path], source: Path, names: Mapping[str, str], size: tuple[int, int] | None
) -> Instances:
    """Masks of pictures; a category is looked up in labels.json, `names`, then the file name.

    A picture with an alpha channel that is not full is one mask. One with two values is one mask;
    one with more is a label map (a pixel is the number of a thing, 0 is nothing). Pictures whose
    names are numbers of six digits or more, all label maps, are frames of a video.

    Raises:
        InputError: If a picture cannot be read or sizes differ.
    """
    table = {**_labels(source), **names}
    paths = [p for p in paths if p.stem.lower() not in NOT_MASKS]
    video = len(paths) > 1 and all(re.fullmatch(r"[0-9]{5,8}", p.stem) for p in paths)
    found: list[Instance] = []
    sizes: set[tuple[int, int]] = set()
    for path in paths:
        pixels = read_labels(path)
        sizes.add((pixels.shape[1], pixels.shape[0]))
        found += _of_picture(pixels, path, table, int(path.stem) if video else None)
    if len(sizes) > 1:
        raise InputError(f"{source.name}: has pictures of {len(sizes)} sizes, expected one")
    return Instances(tuple(found), sizes.pop() if sizes else size, source.name)


def _labels(source: Path) -> dict[str, str]:
    """Categories of labels.json beside the pictures, by number or file name."""
    path = (source if source.is_dir() else source.parent) / LABELS
    if not path.is_file():
        return {}
    at = read_json(path)
    return {key: text(At(value, at.file, key)) for key, value in mapping(at).items()}


def read_labels(path: Path) -> NDArray[np.int64]:
    """The numbers of a picture of labels (h, w): palette or grey values, or alpha above 0.

    Raises:
        InputError: If it cannot be read.
    """
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", Image.DecompressionBombWarning)
            with Image.open(path) as picture:
                return _numbers(picture)
    except (
        OSError, ValueError, SyntaxError, Image.DecompressionBombError,
        Image.DecompressionBombWarning,
    ) as error:  # fmt: skip
        raise InputError(
            f"{path.name}: cannot be read ({reason(error)}), expected a picture of masks"
        ) from error


def _numbers(picture: Any) -> NDArray[np.int64]:  # noqa: ANN401
    """The labels of an open picture."""
    if picture.mode in ("RGBA", "LA", "PA"):
        alpha = np.asarray(picture.getchannel("A"))
        if (alpha < 255).any():
            return (alpha > 0).astype(np.int64)
        picture = picture.convert("RGB")
    pixels = np.asarray(picture).astype(np.int64)
    if pixels.ndim == 3:
        pixels = pixels[..., 0] + 256 * pixels[..., 1] + 65536 * pixels[..., 2]
    return pixels


def _of_picture(
    pixels: NDArray[np.int64], path: Path, table: Mapping[str, str], frame: int | None
) -> list[Instance]:
    """The things of one picture."""
    values = [v for v in np.unique(pixels).tolist() if v != 0]
    if len(values) > MOST_LABELS:
        found = f"{len(values)} different values"
        raise InputError(f"{path.name}: has {found}, expected at most {MOST_LABELS} labels")
    if len(values) == 1 and frame is None:
        name = table.get(path.stem) or _named(path.stem)
        return [Instance(name, None, code_of(pixels == values[0]))]
    return [
        Instance(
            category=table.get(str(value), UNKNOWN),
            box=None,
            mask=code_of(pixels == value),
            frame=frame or 0,
            track=value if frame is not None else None,
        )
        for value in values
    ]


def _named(stem: str) -> str:
    """`chair` of chair_0, 03_chair or chair."""
    words = re.sub(r"[0-9]+", " ", stem).replace("_", " ").replace("-", " ").split()
    plain = " ".join(word for word in words if word.lower() not in ("mask", "masks"))
    return plain or UNKNOWN
