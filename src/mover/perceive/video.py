"""Frames of a video or of a folder of pictures as files, numbered by the clock.

A frame of number k was taken about k/fps after the chosen start. Phones' videos are uneven: where
one has no picture for a while, numbers are missing.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from mover.core.errors import InputError
from mover.core.files import instead, not_there, replacing
from mover.core.observe import Observer, Step, silent
from mover.core.records import fingerprint, record
from mover.io.files.images import opened
from mover.io.people.values import natural
from mover.perceive.config import PICTURES, FramesConfig, install

LARGEST_AREA = 1 << 26  # [px²], of a frame
QUALITY = 95  # of JPEG
USUAL_RATE = 30.0  # frames a second, where the video gives none
SAME_GAP = 0.2  # difference of two gaps between frames that are meant to be one
EARLY = 0.05  # of the time between two frames: how early the first may be taken

Picture = UInt8[np.ndarray, "h w 3"]
Timed = tuple[int, float, Callable[[], Picture]]
"""Number of a frame, when it was taken [s], and its pixels, upright: made when they are asked for.
"""


@record
class Clip:
    """Frames on disk, in order, named by their numbers: 000000.jpg ..."""

    folder: str
    width: int
    height: int
    time: Float[Tensor, " frames"]
    """When each was taken, from the start of the source [s]."""
    fps: float | None
    """Frames a second; None: unordered pictures."""
    origin: str = ""
    """What the pictures were made from: another source is another clip."""
    number: Int[Tensor, " frames"] | None = None
    """Number of each by the clock; None: they are counted."""
    index: Int[Tensor, " frames"] | None = None
    """Number of each in the source, from 0; None: it is not known."""

    @property
    def numbers(self) -> Int[Tensor, " frames"]:
        """Number of each frame."""
        return torch.arange(len(self.time)) if self.number is None else self.number

    @property
    def in_source(self) -> Int[Tensor, " frames"]:
        """Number of each in the source, from 0; as they are counted where that is not known."""
        return self.numbers if self.index is None else self.index

    def path(self, frame: int) -> Path:
        """The file of a frame, which is counted from 0 without gaps."""
        return Path(self.folder) / f"{int(self.numbers[frame]):06d}.jpg"

    def part(self, first: int, end: int) -> "Clip":
        """The frames from the first to before the end."""
        index = None if self.index is None else self.index[first:end]
        return replace(self, time=self.time[first:end], number=self.numbers[first:end], index=index)


@dataclass(frozen=True)
class TakeInputs:
    """Where frames come from and go to."""

    source: Path
    """A video, a folder of pictures, or one picture."""
    stamp: tuple[int, int]
    """Its size and when it was changed, so that another file is not taken for it."""
    folder: Path


def stamp_of(source: Path) -> tuple[int, int]:
    """Size [bytes] and time of change of a file; number of pictures and latest change of a folder.

    Raises:
        InputError: If there is nothing.
    """
    if source.is_dir():
        times = [p.stat().st_mtime_ns for p in pictures_of(source)]
        return len(times), max(times)
    if not source.is_file():
        raise InputError(f"{source}: {not_there(source)}, expected a video or a folder")
    stat = source.stat()
    return stat.st_size, stat.st_mtime_ns


def take_frames(inputs: TakeInputs, config: FramesConfig, observe: Observer = silent) -> Clip:
    """Write the chosen frames of a source as JPEG.

    Raises:
        InputError: If the source cannot be read, or its pictures differ in size.
    """
    for old in inputs.folder.glob("*.jpg"):  # of another source
        old.unlink()
    rows = list[tuple[float, int, int]]()
    size: tuple[int, int] | None = None
    fps = rate_of(inputs.source, config)
    for number, (index, time, pixels) in chosen(read_frames(inputs.source), config, fps):
        picture = pixels()
        found = picture.shape[1], picture.shape[0]
        if size is not None and found != size:
            raise InputError(
                f"{inputs.source.name}: frame {len(rows)} has {found[0]} x {found[1]} pixels, "
                f"expected {size[0]} x {size[1]} as the first"
            )
        size = found
        write_jpeg(picture, inputs.folder / f"{number:06d}.jpg")
        observe(Step("take_frames", len(rows), len(rows) + 1))
        rows.append((time, number, index))
    if size is None:
        raise InputError(f"{inputs.source.name}: has no frames, expected some in the chosen time")
    origin = fingerprint(inputs.stamp, str(inputs.source.resolve()), config)
    times, numbers, indices = (torch.tensor(column) for column in zip(*rows, strict=True))
    return Clip(str(inputs.folder), *size, times, fps, origin, numbers, indices)


def read_frames(source: Path) -> Iterator[Timed]:
    """Number, time [s] and pixels of each frame, upright.

    Raises:
        InputError: If it cannot be read.
    """
    if pictures := pictures_of(source):
        for index, path in enumerate(pictures):
            yield index, float(index), partial(read_picture, path)
        return
    try:
        with _opened(source) as container:
            stream = container.streams.video[0]
            context = stream.codec_context
            if context.width * context.height > LARGEST_AREA:
                raise ValueError(f"{context.width} x {context.height} pixels are too many")
            first = float((stream.start_time or 0) * stream.time_base)
            rate = float(stream.average_rate or USUAL_RATE)
            for index, frame in enumerate(container.decode(stream)):
                stamped = frame.pts is not None  # the frames of a bare stream are not
                time = float(frame.pts * frame.time_base) - first if stamped else index / rate
                yield index, time, partial(_upright, frame)
    except (OSError, ValueError) as error:  # av's errors are of both kinds
        raise _unreadable(source, error) from error


def chosen(
    frames: Iterator[Timed], config: FramesConfig, fps: float | None
) -> Iterator[tuple[int, Timed]]:
    """The frame nearest to each tick of the clock, with the tick's number; without a rate, all.

    A tick to which no frame is nearer than to the next has none: nothing was seen then.
    """
    best: tuple[int, float, Timed] | None = None
    for frame in frames:
        since = frame[1] - config.start
        if config.end and frame[1] > config.end:
            break
        tick = frame[0] if fps is None else round(since * fps)
        off = 0.0 if fps is None else abs(since * fps - tick)
        if since < -EARLY / (fps or 1.0) or (best is not None and tick < best[0]):
            continue
        if best is not None and tick > best[0]:
            yield best[0], best[2]
            best = None
        if best is None or off < best[1]:
            best = tick, off, frame
    if best is not None:
        yield best[0], best[2]


def pictures_of(source: Path) -> list[Path]:
    """The pictures of a folder, `2.jpg` before `10.jpg`; a picture itself; none of a video.

    Raises:
        InputError: If a folder has none.
    """
    if not source.is_dir():
        return [source] if source.suffix.lower() in PICTURES else []
    found = [p for p in source.iterdir() if p.suffix.lower() in PICTURES and p.is_file()]
    if not found:
        raise InputError(f"{source}: has no pictures, expected {', '.join(PICTURES[:3])} ...")
    return sorted(found, key=natural)


def read_picture(path: Path) -> Picture:
    """A picture, upright.

    Raises:
        InputError: If it cannot be read.
    """
    from PIL import ImageOps

    with opened(path, bombs="error") as picture:
        return np.array(ImageOps.exif_transpose(picture).convert("RGB"))


def write_jpeg(picture: Picture, path: Path) -> None:
    """Write a picture."""
    from PIL import Image

    with replacing(path) as part:
        Image.fromarray(picture).save(part, format="JPEG", quality=QUALITY)


def rate_of(source: Path, config: FramesConfig) -> float | None:
    """Frames a second of what is taken; None: of pictures in a folder it is not known."""
    if pictures_of(source):
        return None
    with _opened(source) as container:
        stream = container.streams.video[0]
        known = float(stream.average_rate or USUAL_RATE)
        if not config.fps or known < config.fps:  # a pause or a late end spoils the average
            try:
                packets = [p for p in container.demux(stream) if p.pts is not None]
            except (OSError, ValueError):  # decoding will say so
                packets = []
            gaps = np.diff(np.unique([float(p.pts * p.time_base) for p in packets]))
            if len(gaps):
                near = np.abs(gaps - np.median(gaps)) < SAME_GAP * np.median(gaps)
                known = 1 / float(gaps[near].mean())
    return min(known, config.fps) if config.fps else known


def _opened(source: Path) -> Any:  # noqa: ANN401
    """An open container with a video stream."""
    try:
        import av
    except ImportError as error:
        raise InputError(f"reading video needs PyAV: {install('perceive')}") from error
    try:
        container = av.open(str(source))
    except (OSError, ValueError) as error:
        raise _unreadable(source, error) from error
    if not container.streams.video:
        raise InputError(f"{source.name}: has no pictures, only sound, expected a video")
    return container


def _unreadable(source: Path, error: Exception) -> InputError:
    """The error of a video that cannot be opened or decoded; av names what its bytes are."""
    why = instead(source)
    if type(error) is ValueError:
        why = str(error)
    elif not why or "a video" in why:
        why = "it is unfinished, damaged or of another kind: copy it again"
    return InputError(f"{source.name}: cannot be read ({why}), expected a video")


def _upright(frame: Any) -> Picture:  # noqa: ANN401
    """A decoded frame's pixels, turned as its file says that it is shown."""
    turns = round(frame.rotation / 90) % 4
    return np.ascontiguousarray(np.rot90(frame.to_ndarray(format="rgb24"), turns))
