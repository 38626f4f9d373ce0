"""Does the camera stand still? Where it only sways, the frames are turned back onto one of them.

The method assumes one camera for all frames. A camera that turns a little about its centre (a hand,
a loose tripod) is undone exactly by a homography; one that walks is not, and is told.
"""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from ..minimize import Observer, Step, silent
from ..records import record
from .homography import Fit, align, moved, resized, warp
from .video import Clip, load_frame, write_jpeg

WIDE = 480  # [px], frames are compared at this width
FINE = 120  # [px], width from which on a near start is refined
CLEARLY = 0.03  # share of pixels by which a farther start must be better
GRID = 4  # points along each side that measure a drift


@dataclass(frozen=True)
class SteadyConfig:
    """What counts as still."""

    still: float = 0.002
    """Largest drift of a camera that stands still, as a share of the image's larger side."""
    small: float = 0.15
    """Largest drift that is undone; beyond it the camera walks."""
    agree: float = 0.35
    """Least share of pixels that must agree with the homography of a frame."""


@record
class Drift:
    """How the camera moved."""

    H: Float[Tensor, "frames 3 3"]
    """Pixels of each frame from pixels of the reference frame."""
    shift: Float[Tensor, " frames"]
    """Largest shift of a point of the image against the reference frame [px]."""
    agree: Float[Tensor, " frames"]
    """Share of the pixels with detail that are as bright as in the first frame."""
    reference: int
    """The frame that is nearest to all others."""
    total: float
    """Largest shift against the first frame [px]."""
    verdict: Literal["still", "sways", "moves"]


@record
class SteadyInputs:
    """The frames as they were taken."""

    clip: Clip
    focal: float | None = None
    """Of the lens [px]; None: unknown."""


def find_drift(inputs: SteadyInputs, config: SteadyConfig, observe: Observer = silent) -> Drift:
    """Align every frame with the first, each from where the one before ended."""
    clip = inputs.clip
    count = len(clip.time)
    scale = min(1.0, WIDE / clip.width)
    focal = None if inputs.focal is None else inputs.focal * scale
    first = last = _grey(clip.path(0), scale)
    fits = [Fit(torch.eye(3), 1.0)]
    for frame in range(1, count):
        picture = _grey(clip.path(frame), scale)
        fits.append(_followed((first, last, picture), fits[-1], focal))
        last = picture
        observe(Step("find_drift", frame, count))
    grow = torch.diag(torch.tensor([1 / scale, 1 / scale, 1.0]))
    from_first = grow @ torch.stack([fit.H for fit in fits]) @ torch.linalg.inv(grow)
    agree = torch.tensor([fit.agree for fit in fits])
    return _judged(from_first, agree, (clip.height, clip.width), config)


def _followed(pictures: tuple[Tensor, Tensor, Tensor], before: Fit, focal: float | None) -> Fit:
    """A frame on the first one: over the frame before it, from where that lay, or from scratch.

    Stripes and tiles look alike when shifted, so that the nearest start counts unless a farther one
    is clearly better.
    """
    first, last, picture = pictures
    near = align(last, picture, torch.eye(3), focal, coarsest=FINE)
    fits = [align(first, picture, near.H @ before.H, focal, coarsest=FINE)]
    if fits[0].agree < before.agree - CLEARLY:
        fits.append(align(first, picture, before.H, focal, coarsest=FINE))
        fits.append(align(first, picture, torch.eye(3), focal))
    best = max(fits, key=lambda fit: fit.agree)
    return best if best.agree > fits[0].agree + CLEARLY else fits[0]


def _judged(
    from_first: Tensor, agree: Tensor, size: tuple[int, int], config: SteadyConfig
) -> Drift:
    """Choose the reference frame and say what the camera did."""
    points = _points(size)
    places = moved(from_first, points)
    middle = places.median(0).values
    reference = int((places - middle).norm(dim=-1).amax(-1).argmin())
    turned = from_first @ torch.linalg.inv(from_first[reference])
    H = turned / turned[:, 2:, 2:]
    shift = (moved(H, points) - points).norm(dim=-1).amax(-1)
    side = max(size)
    lost = agree < config.agree
    verdict = "still"
    if float(shift.max()) > config.still * side:
        verdict = "sways"
    if float(shift.max()) > config.small * side or float(lost.float().mean()) > 0.1:
        verdict = "moves"
    total = float((places - points).norm(dim=-1).amax())
    return Drift(H, shift, agree, reference, total, verdict)


def warning_of(drift: Drift) -> str | None:
    """What a user should know."""
    far = f"{drift.total:.0f} px from the first frame"
    match drift.verdict:
        case "still":
            return None
        case "sways":
            return (
                f"the camera sways ({far} at most): all frames were turned onto frame "
                f"{drift.reference}"
            )
        case "moves":
            lost = int((drift.agree < SteadyConfig().agree).sum())
            return (
                f"the camera moves ({far}; {lost} frames do not fit a homography): the method "
                "assumes one that stands still, so choose a part of the video where it does"
            )


def steady_frames(clip: Clip, drift: Drift, folder: Path, observe: Observer = silent) -> Clip:
    """The frames as the reference frame's camera saw them; unchanged where the camera is still."""
    folder.mkdir(parents=True, exist_ok=True)
    for frame in range(len(clip.time)):
        path = folder / f"{frame:06d}.jpg"
        if drift.verdict == "still":
            path.unlink(missing_ok=True)
            path.write_bytes(clip.path(frame).read_bytes())
        else:
            picture, _ = warp(load_frame(clip.path(frame)), drift.H[frame], _size(clip))
            pixels = (picture * 255).round().clamp(0, 255).to(torch.uint8).numpy()
            write_jpeg(np.ascontiguousarray(pixels), path)
        observe(Step("steady_frames", frame, len(clip.time)))
    return Clip(str(folder), clip.width, clip.height, clip.time, clip.fps)


def seen_share(drift: Drift, frame: int, size: tuple[int, int]) -> Float[Tensor, "h w"]:
    """1 where a steadied frame shows what its camera saw, 0 where only its border was repeated.

    Args:
        drift: Of the camera.
        frame: Which one.
        size: Height and width [px].
    """
    if drift.verdict == "still":
        return torch.ones(size)
    return warp(torch.ones(*size, 1), drift.H[frame], size)[1]


def _size(clip: Clip) -> tuple[int, int]:
    return clip.height, clip.width


def _points(size: tuple[int, int]) -> Float[Tensor, "points 2"]:
    """An even grid over the image [px]."""
    y, x = (torch.linspace(0, float(n), GRID) for n in size)
    return torch.cartesian_prod(x, y)


def _grey(path: Path, scale: float) -> Float[Tensor, "h w"]:
    """Brightness of a frame at the working size."""
    return resized(load_frame(path).mean(-1), scale)
