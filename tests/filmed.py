"""Small films of a textured room, and finders that know people and chairs by their colours.

What stands for the networks looks at the pictures that the program hands it, so that a picture
which is turned, cut or taken at another time gives other masks and joints.
"""

import struct
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from mover.core.observe import Observer, silent
from mover.core.types import Keypoints, Masks, People
from mover.geometry.rle import decode, encode, tight_box
from mover.perceive.capture import Finders
from mover.perceive.config import FramesConfig, ModelsConfig, PerceiveConfig
from mover.perceive.networks import PERSON, Finds, JointsInputs
from mover.perceive.video import (
    Clip,
    TakeInputs,
    read_picture,
    stamp_of,
    take_frames,
    write_jpeg,
)

COLOURS = {PERSON: (225, 30, 200), "chair": (20, 190, 60)}
W, H = 128, 96
LARGE = (2 * H, 3 * W)  # of the world, of which a camera sees a part
NEAR = 70  # how far a pixel may be off its colour
FIGURE = np.array([
    (0.5, 0.08), (0.53, 0.06), (0.47, 0.06), (0.56, 0.08), (0.44, 0.08), (0.65, 0.2), (0.35, 0.2),
    (0.7, 0.36), (0.3, 0.36), (0.72, 0.5), (0.28, 0.5), (0.6, 0.52), (0.4, 0.52), (0.6, 0.74),
    (0.4, 0.74), (0.6, 0.96), (0.4, 0.96),
])  # fmt: skip
"""COCO's 17 joints of somebody who stands and faces the camera, in the box of the mask."""

Pixels = np.ndarray


@cache
def world(seed: int = 0) -> Pixels:
    """Patches of grey and brown, larger than a picture."""
    rng = np.random.default_rng(seed)
    grey = rng.integers(40, 215, (LARGE[0] // 8, LARGE[1] // 8, 1))
    small = np.repeat(grey, 3, axis=2).astype(np.uint8)
    return np.array(Image.fromarray(small).resize(LARGE[::-1], Image.Resampling.BICUBIC))


@dataclass(frozen=True)
class Shot:
    """What a camera sees."""

    seed: int = 0
    """Of the world."""
    chair: bool = True
    person: bool = True
    tall: bool = False
    """Portrait."""
    look: tuple[int, int] = (0, 0)
    """Where in the world the picture begins [px]."""

    @property
    def size(self) -> tuple[int, int]:
        """Height and width [px]."""
        return (W, H) if self.tall else (H, W)

    def at(self, time: float) -> Pixels:
        """The picture at a time [s]: who walks goes `walk(time)` px to the right."""
        (h, w), (x, y) = self.size, self.look
        picture = world(self.seed)[y : y + h, x : x + w].copy()
        if self.chair:
            picture[h - 40 : h - 12, w - 34 : w - 10] = COLOURS["chair"]
        if self.person:
            left = round(walk(time))
            picture[h - 70 : h - 8, left : left + 20] = COLOURS[PERSON]
        return picture


def walk(time: float) -> float:
    """Left end of who walks [px]."""
    return 4 + (12 * time) % (W - 40)


def write_film(
    path: Path, pictures: Iterable[Pixels], times: Iterable[int], rate: int = 30
) -> Path:
    """A film (.mp4) whose pictures have these time stamps, in 1/rate seconds."""
    av = pytest.importorskip("av")
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=rate)
        stream.pix_fmt, stream.codec_context.time_base = "yuv420p", Fraction(1, rate)
        stream.options = {"crf": "16", "preset": "ultrafast"}
        for picture, time in zip(pictures, times, strict=True):
            if not stream.codec_context.is_open:
                stream.height, stream.width = picture.shape[:2]
            frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")
            frame.pts, frame.time_base = time, Fraction(1, rate)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def filmed(path: Path, shot: Shot, times: Sequence[int], rate: int = 30) -> Path:
    """A film of one shot."""
    return write_film(path, (shot.at(t / rate) for t in times), times, rate)


def turned_film(path: Path, pictures: list[Pixels], times: Iterable[int], turns: int) -> Path:
    """A film in the pixels of a turned sensor, with the matrix that turns them back.

    Phones write the turn into the matrix of the track header (tkhd; ISO/IEC 14496-12, 8.3.2): a
    quarter to the right is 0 1 0, -1 0 0, h 0 1 in rows, with 16 bits behind the point.
    """
    write_film(path, (np.rot90(picture, turns) for picture in pictures), times)
    h, w = np.rot90(pictures[0][..., 0], turns).shape
    matrix = {
        0: (1, 0, 0, 1, 0, 0), 1: (0, 1, -1, 0, h, 0), 2: (-1, 0, 0, -1, w, h),
        3: (0, -1, 1, 0, 0, w),
    }[turns]  # fmt: skip
    a, b, c, d, x, y = (value << 16 for value in matrix)
    raw = path.read_bytes()
    at = raw.index(b"tkhd") - 4 + 48
    turn = struct.pack(">9i", a, b, 0, c, d, 0, x, y, 1 << 30)
    path.write_bytes(raw[:at] + turn + raw[at + len(turn) :])
    return path


def take(source: Path, folder: Path, config: FramesConfig | None = None) -> Clip:
    """The frames that the program takes of a film or a folder."""
    return take_frames(TakeInputs(source, stamp_of(source), folder), config or FramesConfig())


def clip_of(folder: Path, pictures: Iterable[Pixels]) -> Clip:
    """Pictures as the frames of a clip, five a second."""
    folder.mkdir(exist_ok=True)
    sizes = list[tuple[int, ...]]()
    for k, picture in enumerate(pictures):
        write_jpeg(np.ascontiguousarray(picture), folder / f"{k:06d}.jpg")
        sizes.append(picture.shape)
    h, w, _ = sizes[0]
    return Clip(str(folder), w, h, torch.arange(len(sizes)) / 5, 5.0)


def instances(clip: Clip, _config: PerceiveConfig, _observe: Observer = silent) -> Finds:
    """Whatever has the colour of a person or a chair."""
    found = list[tuple[int, str, torch.Tensor]]()
    for frame in range(len(clip.time)):
        picture = read_picture(clip.path(frame)).astype(int)
        for category, colour in COLOURS.items():
            mask = torch.from_numpy(np.abs(picture - colour).max(-1) < NEAR)
            if int(mask.sum()) > 100:
                found.append((frame, category, mask))
    masks = Masks(clip.height, clip.width, tuple(encode(m) for *_, m in found))
    frames = torch.tensor([frame for frame, *_ in found], dtype=torch.long)
    return Finds(masks, frames, tuple(c for _, c, _ in found), torch.full((len(found),), 0.9))


def joints(inputs: JointsInputs, _config: ModelsConfig, _observe: Observer = silent) -> Keypoints:
    """A figure in the box of each mask."""
    rows = range(len(inputs.tracks.frame))
    boxes = torch.stack([tight_box(decode(inputs.tracks.masks, k)) for k in rows])
    low, high = boxes[:, None, :2], boxes[:, None, 2:]
    points = low + (high - low) * torch.from_numpy(FIGURE).float()
    return Keypoints(
        points=points, confidence=torch.full(points.shape[:2], 0.9), layout="coco17",
        frame=inputs.tracks.frame, person=inputs.tracks.person, fps=inputs.clip.fps,
    )  # fmt: skip


def no_network(inputs: object, _config: object, _observe: Observer = silent) -> People:
    raise AssertionError(f"a network is asked for {inputs}")


FINDERS = Finders(instances, joints)
NO_FINDERS = Finders(no_network, no_network, no_network)
