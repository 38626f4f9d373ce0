"""Pictures: read the reference image, write it without loss."""

import warnings
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from mover.core.errors import InputError
from mover.core.files import replacing
from mover.core.types import Camera
from mover.io.files.fields import At, reason, refuse
from mover.io.files.meshes import inside


def read_image(at: At, folder: Path, camera: Camera) -> Float[Tensor, "h w 3"]:
    """The picture that a field names, upright, in [0, 1]; its size must be the camera's.

    Raises:
        InputError: If it is missing, cannot be read or has another size.
    """
    return read_image_file(at, inside(at, folder), camera)


def read_image_file(at: At, path: Path, camera: Camera) -> Float[Tensor, "h w 3"]:
    """A picture wherever it lies, upright, in [0, 1]; its size must be the camera's.

    Args:
        at: How messages call it.
        path: Its file.
        camera: Of the size that it must have.

    Raises:
        InputError: If it cannot be read or has another size.
    """
    from PIL import Image, ImageOps

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(path) as picture:
                sides = sorted(picture.size)
                if sides == sorted((camera.width, camera.height)):
                    upright = ImageOps.exif_transpose(picture)
                    picture = upright.convert("RGB")
                size, pixels = picture.size, None
                if size == (camera.width, camera.height):
                    pixels = np.asarray(picture, dtype=np.float32)
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        refuse(at, "a picture", f"{str(at.value)!r}, which cannot be read ({reason(error)})")
    if pixels is None:
        expected = f"{camera.width} x {camera.height} pixels, as the camera has"
        refuse(at, expected, f"{str(at.value)!r} with {size[0]} x {size[1]} pixels")
    return torch.from_numpy(pixels / np.float32(255))


def image_size(path: Path) -> tuple[int, int]:
    """Width and height of a picture as it is stored [px].

    Raises:
        InputError: If it is missing or cannot be read.
    """
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(path) as picture:
                return picture.size
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise InputError(
            f"{path.name}: cannot be read ({reason(error)}), expected a picture"
        ) from error


def write_image(image: Float[Tensor, "h w 3"], path: Path) -> None:
    """Write a picture as PNG, 8 bits a channel."""
    from PIL import Image

    pixels = (image.detach().cpu() * 255).round().clamp(0, 255).to(torch.uint8).numpy()
    with replacing(path) as part:
        Image.fromarray(pixels).save(part, format="PNG")


def mirrored_copy(path: Path, work: Path) -> Path:
    """A picture flipped left to right, as a new file in `work`.

    Raises:
        InputError: If it cannot be read.
    """
    from PIL import Image, ImageOps

    target = work / f"mirrored_{path.stem}.jpg"
    try:
        with Image.open(path) as picture:
            ImageOps.mirror(picture.convert("RGB")).save(target, quality=95)
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise InputError(
            f"{path.name}: cannot be read ({reason(error)}), expected a picture"
        ) from error
    return target
