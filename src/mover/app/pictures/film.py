"""Pictures on disk: a still as PNG or JPEG, a film as MP4 (H.264), and the pictures of a video."""

from collections.abc import Iterable, Iterator, Sequence
from fractions import Fraction
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, UInt8
from PIL import Image
from torch import Tensor

from mover.core.errors import InputError
from mover.core.files import replacing

FRAMES, VIDEO = "frames", "video.mp4"
QUALITY = {"crf": "18", "preset": "veryfast"}  # of H.264: nearly without visible loss


def save_still(picture: Float[Tensor, "h w 3"], path: Path) -> None:
    """Write a picture; the ending chooses the format."""
    with replacing(path) as part:
        Image.fromarray(pixels(picture)).save(part, quality=92)


def save_film(pictures: Iterable[Float[Tensor, "h w 3"]], rate: float, path: Path) -> int:
    """Write an .mp4 of so many pictures a second, which all have one even size; their number.

    Raises:
        InputError: If PyAV is not installed.
    """
    av = video_library(str(path))
    count = 0
    with replacing(path) as part, av.open(str(part), "w") as film:
        stream = film.add_stream("libx264", rate=Fraction(rate).limit_denominator(1001))
        stream.pix_fmt, stream.options = "yuv420p", dict(QUALITY)
        for picture in pictures:
            frame = av.VideoFrame.from_ndarray(pixels(picture), format="rgb24")
            if count == 0:
                stream.height, stream.width = picture.shape[:2]
            film.mux(stream.encode(frame))
            count += 1
        film.mux(stream.encode(None))
    return count


def video_library(why: str) -> Any:  # noqa: ANN401
    """PyAV.

    Raises:
        InputError: If it is not installed; `why` says what needs it.
    """
    if find_spec("av") is None:
        raise InputError(f"{why}: needs PyAV; pip install -e '.[render]' in mover's folder")
    import av

    return av


def pixels(picture: Float[Tensor, "h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """8 bits a channel."""
    return (picture.detach().cpu() * 255).round().clamp(0, 255).to(torch.uint8).numpy()


def video_pictures(
    capture: Path, frames: Sequence[int], size: tuple[int, int]
) -> Iterator[Float[Tensor, "h w 3"] | None]:
    """The pictures of rising numbers of a capture's video, None for those that are missing.

    The video is frames/000000.jpg, ... or video.mp4; `size` is the width and height that they get
    [px].
    """
    film = next((f for f in (capture / VIDEO, capture / FRAMES / VIDEO) if f.is_file()), None)
    if film is None:
        for frame in frames:
            names = (capture / FRAMES / f"{frame:06d}{ending}" for ending in (".jpg", ".png"))
            path = next((name for name in names if name.is_file()), None)
            if path is None:
                yield None
            else:
                with Image.open(path) as picture:
                    yield sized(picture, size)
        return
    with video_library(str(film)).open(str(film)) as video:
        decoded = enumerate(video.decode(video=0))
        for frame in frames:
            found = next((picture for number, picture in decoded if number == frame), None)
            yield None if found is None else sized(found.to_image(), size)


def sized(picture: Image.Image, size: tuple[int, int]) -> Float[Tensor, "h w 3"]:
    """A picture in [0, 1] at a width and height [px]."""
    small = picture.convert("RGB").resize(size, Image.Resampling.LANCZOS)
    return torch.from_numpy(np.asarray(small).copy()).float() / 255
