"""Pictures: read the reference image, write it without loss."""

import warnings
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mover.core.errors import InputError
from mover.core.files import replacing
from mover.core.types import Camera
from mover.io.files.fields import At, reason, refuse
from mover.io.files.meshes import inside


@contextmanager
def opened(
    path: Path,
    at: At | None = None,
    expected: str = "a picture",
    bombs: Literal["error", "ignore"] = "ignore",
) -> Generator[Any, None, None]:
    """An open picture.

    Args:
        path: Its file.
        at: How messages call it; None: by its file.
        expected: What it should be.
        bombs: Whether a picture is refused that is large enough to make Pillow warn.
    """
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter(bombs, Image.DecompressionBombWarning)
            with Image.open(path) as picture:
                yield picture
    except (
        OSError, ValueError, SyntaxError, Image.DecompressionBombError,
        Image.DecompressionBombWarning,
    ) as error:  # fmt: skip
        if at is not None:
            refuse(at, expected, f"{str(at.value)!r}, which cannot be read ({reason(error)})")
        said = f"cannot be read ({reason(error)}), expected {expected}"
        raise InputError(f"{path.name}: {said}") from error


def read_image(at: At, folder: Path, camera: Camera) -> Float[Tensor, "h w 3"]:
    """The picture that a field names, upright, in [0, 1]; its size must be the camera's.

    Raises:
        InputError: If it is missing, cannot be read or has another size.
    """
    return read_image_file(at, inside(at, folder), camera)


def read_image_file(at: At, path: Path, camera: Camera) -> Float[Tensor, "h w 3"]:
    """A picture wherever it lies, upright, in [0, 1]; its size must be the camera's.

    Raises:
        InputError: If it cannot be read or has another size.
    """
    from PIL import ImageOps

    wanted, pixels = (camera.width, camera.height), None
    with opened(path, at) as picture:
        if sorted(picture.size) == sorted(wanted):
            picture = ImageOps.exif_transpose(picture).convert("RGB")
        size = picture.size
        if size == wanted:
            pixels = np.asarray(picture, dtype=np.float32)
    if pixels is None:
        expected = f"{camera.width} x {camera.height} pixels, as the camera has"
        refuse(at, expected, f"{str(at.value)!r} with {size[0]} x {size[1]} pixels")
    return torch.from_numpy(pixels / np.float32(255))


def image_size(path: Path) -> tuple[int, int]:
    """Width and height of a picture as it is stored [px]."""
    with opened(path) as picture:
        return picture.size


def write_image(image: Float[Tensor, "h w 3"], path: Path) -> None:
    """Write a picture as PNG, 8 bits a channel."""
    from PIL import Image

    pixels = (image.detach().cpu() * 255).round().clamp(0, 255).to(torch.uint8).numpy()
    with replacing(path) as part:
        Image.fromarray(pixels).save(part, format="PNG")


def mirrored_copy(path: Path, work: Path) -> Path:
    """A picture flipped left to right, as a new file in `work`."""
    from PIL import ImageOps

    work.mkdir(parents=True, exist_ok=True)
    target = work / f"mirrored_{path.stem}.jpg"
    with opened(path) as picture:
        ImageOps.mirror(picture.convert("RGB")).save(target, quality=95)
    return target
