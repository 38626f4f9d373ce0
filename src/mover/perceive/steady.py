"""Does the camera stand still? Where it only sways, the frames are turned back onto one of them.

The method assumes one camera for all frames. A camera that turns a little about its centre (a hand,
a loose tripod) is undone exactly by a homography; one that walks is not, and gives a warning. Of a
video that is cut the longest shot is used.

The reference picture is put together from many frames, without people.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Bool, Float, UInt8
from numpy.typing import NDArray
from torch import Tensor

from mover.core.files import copy_whole
from mover.core.observe import Observer, Step, silent
from mover.core.records import record
from mover.core.types import Detection, Masks, People
from mover.geometry.crops import depth_in
from mover.geometry.rle import decode, encode, mask_boxes
from mover.perceive.networks import Finds
from mover.perceive.video import Clip, read_picture, write_jpeg

STILL = 0.002  # of the larger side: drift of a camera that stands still
SMALL = 0.15  # of the larger side: the largest drift that is undone; beyond it the camera walks
AGREE = 0.35  # least share of pixels that agree with the homography of a frame
LOST = 0.1  # share of frames that may agree less
WIDE = 480  # [px], frames are compared at this width
CLEARLY = 0.03  # share of pixels by which a farther start must be better
GRID = 4  # points along each side that measure a drift
POINTS, DETAIL, APART = 1000, 0.005, 5  # points that are followed: most, least detail, gap [px]
LEAST = 10  # points, fewer give no estimate
NOISE = 1.0  # [px], how far a point may be off that moves with the room
LIGHT = 19  # [px], what changes over more is light
SAME = 0.4  # [contrast], two pixels that show the same differ by less
CUT, STAYS = 0.3, 5  # agreement that a cut takes at once, frames that it stays away at least

Grey = UInt8[np.ndarray, "h w"]
Matrix = NDArray[np.floating[Any]]


@dataclass(frozen=True)
class Fit:
    """How a picture lies over the first of its shot."""

    H: Matrix
    """Pixels of the picture from pixels of the first."""
    agree: float
    """Share of the pixels with detail that are as bright as in the first."""


@record
class Drift:
    """How the camera moved in the longest shot."""

    H: Float[Tensor, "frames 3 3"]
    """Pixels of each frame from pixels of the reference frame."""
    agree: Float[Tensor, " frames"]
    """Share of the pixels with detail that are as bright as in the first frame."""
    reference: int
    """The frame that is nearest to all others."""
    total: float
    """Largest shift against the first frame [px]."""
    verdict: Literal["still", "sways", "moves"]
    first: int = 0
    """The frame of the video with which the shot starts."""
    cuts: tuple[int, ...] = ()
    """Frames of the video that start another shot."""


def align(first: Grey, picture: Grey, start: Matrix) -> Fit:
    """The homography between two pictures of one size, of points that are followed.

    OpenCV finds points with detail again (Lucas & Kanade over pyramids); a robust fit
    leaves out people, who move otherwise than the room.
    """
    import cv2

    corners: Any = cv2.goodFeaturesToTrack(first, POINTS, DETAIL, APART)
    if corners is None:
        return Fit(start, 0.0)
    points = corners[:, 0] + 0.5
    guess = np.ascontiguousarray(moved(start, points)[:, None] - 0.5, np.float32)
    places, found, _ = cv2.calcOpticalFlowPyrLK(
        first, picture, corners, guess, flags=cv2.OPTFLOW_USE_INITIAL_FLOW
    )
    known = found[:, 0] > 0
    if known.sum() < LEAST:
        return Fit(start, 0.0)
    fit: Any = cv2.findHomography(points[known], places[known, 0] + 0.5, cv2.USAC_ACCURATE, NOISE)[
        0
    ]
    return Fit(start, 0.0) if fit is None else Fit(fit, _agreement(first, picture, fit))


def _agreement(first: Grey, picture: Grey, H: Matrix) -> float:
    """Share of the pixels with detail that are as bright as in the first picture."""
    import cv2

    pair = first.astype(np.float32), warp(picture.astype(np.float32), H, first.shape)
    own, other = (x - cv2.blur(x, (LIGHT, LIGHT)) for x in pair)
    known = shown_by(H, first.shape)
    steep = np.hypot(cv2.Sobel(own, -1, 1, 0), cv2.Sobel(own, -1, 0, 1))
    used = known & (steep >= steep.mean())
    if used.sum() < LEAST:
        return 0.0
    contrast = np.sqrt(np.square(own[used]).mean())
    return float((np.abs(own - other)[used] < SAME * contrast).mean() * known.mean())


def moved(H: Matrix, points: Matrix) -> Matrix:
    """Points (n, 2) under a homography."""
    import cv2

    return cv2.perspectiveTransform(np.asarray(points, np.float64)[None], H)[0]


def warp(picture: NDArray[Any], H: Matrix, size: tuple[int, ...]) -> NDArray[Any]:
    """The picture in the pixels of the reference (height, width); its border goes on where it ends.

    H gives its pixels from those of the reference.
    """
    import cv2

    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    return cv2.warpPerspective(
        picture, _of_centres(H), size[::-1], flags=flags, borderMode=cv2.BORDER_REPLICATE
    )


def shown_by(H: Matrix, size: tuple[int, ...]) -> NDArray[np.bool_]:
    """Where `warp` samples a picture of this size; elsewhere its border goes on."""
    import cv2

    flags = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
    ones = np.ones(size, np.uint8)
    return cv2.warpPerspective(ones, _of_centres(H), size[::-1], flags=flags) > 0


def _of_centres(H: Matrix) -> Matrix:
    """The homography as OpenCV counts: whole numbers are the centres of pixels."""
    half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
    return np.linalg.inv(half) @ H @ half


def find_drift(clip: Clip, _config: None = None, observe: Observer = silent) -> Drift:
    """Align every frame with the first of its shot, each from where the one before ended."""
    starts, shots = [0], [_shot(clip, 0, observe)]
    while starts[-1] + len(shots[-1]) < len(clip.time):
        starts.append(starts[-1] + len(shots[-1]))
        shots.append(_shot(clip, starts[-1], observe))
    longest = max(range(len(shots)), key=lambda k: len(shots[k]))
    scale = min(1.0, WIDE / clip.width)
    grow = np.diag([1 / scale, 1 / scale, 1.0])
    H = np.stack([grow @ fit.H @ np.linalg.inv(grow) for fit in shots[longest]])
    drift = _judged(H, [fit.agree for fit in shots[longest]], (clip.width, clip.height))
    return replace(drift, first=starts[longest], cuts=tuple(starts[1:]))


def _shot(clip: Clip, start: int, observe: Observer) -> list[Fit]:
    """The frames of the shot that starts at a frame, laid over that frame.

    Stripes and tiles look similar when shifted, so that the nearest start counts unless a farther
    one is clearly better.
    """
    first, fits = _grey(clip, start), [Fit(np.eye(3), 1.0)]
    for frame in range(start + 1, len(clip.time)):
        picture, before = _grey(clip, frame), fits[-1]
        fit = align(first, picture, before.H)
        if fit.agree < before.agree - CLEARLY:
            far = align(first, picture, np.eye(3))
            fit = far if far.agree > fit.agree + CLEARLY else fit
        fits.append(fit)
        observe(Step("find_drift", frame, len(clip.time)))
        if first_cut([fit.agree for fit in fits[-STAYS - 1 :]]) == 1 and len(fits) > STAYS:
            return fits[:-STAYS]
    return fits[: first_cut([fit.agree for fit in fits])]


def first_cut(agree: Sequence[float]) -> int | None:
    """The frame at which the picture changes all at once and stays so: the video was cut.

    A camera that walks away loses its first picture little by little, and a person who passes close
    by gives it back.
    """
    frames = range(1, len(agree))
    cuts = (
        k for k in frames if agree[k - 1] - agree[k] > CUT and max(agree[k : k + STAYS]) < AGREE
    )
    return next(cuts, None)


def _judged(from_first: Matrix, agree: list[float], size: tuple[int, int]) -> Drift:
    """Choose the reference frame and say what the camera did; width and height are in pixels."""
    x, y = np.meshgrid(*(np.linspace(0, n, GRID) for n in size))
    points = np.stack([x.ravel(), y.ravel()], -1)
    places = np.stack([moved(H, points) for H in from_first])
    off = np.linalg.norm(places - np.median(places, axis=0), axis=-1).max(-1)
    reference = int(off.argmin())
    turned = from_first @ np.linalg.inv(from_first[reference])
    H = turned / turned[:, 2:, 2:]
    far = max(np.linalg.norm(moved(one, points) - points, axis=-1).max() for one in H)
    lost = np.mean(np.array(agree) < AGREE)
    verdict = "still" if far <= STILL * max(size) else "sways"
    if far > SMALL * max(size) or lost > LOST:
        verdict = "moves"
    total = float(np.linalg.norm(places - points, axis=-1).max())
    return Drift(torch.from_numpy(H).float(), torch.tensor(agree), reference, total, verdict)


def warnings_of(drift: Drift, time: Float[Tensor, " frames"]) -> list[str]:
    """What a user should know; `time` is that of each frame of the whole video [s]."""
    found: list[str] = []
    if drift.cuts:
        shots = [s for s in pairwise((0, *drift.cuts, len(time))) if s[1] - s[0] >= STAYS]
        ends = {k for shot in shots for k in shot}  # of black frames there are none
        seconds = [float(time[k]) for k in drift.cuts if k in ends or not shots]
        shown = ", ".join(f"{second:.1f} s" for second in seconds[:5])
        others = [f"--frames.end {time[end]:.1f}" for _, end in shots[:1] if end <= drift.first]
        others += [f"--frames.start {time[k]:.1f}" for k, _ in shots[-1:] if k > drift.first]
        choice = f"; another is chosen with {' or '.join(others)}" if others else ""
        first, last = (float(time[drift.first + k]) for k in (0, len(drift.agree) - 1))
        found.append(
            f"the video is cut at {shown}: the method needs one shot, and the longest is used, "
            f"{first:.1f} to {last:.1f} s{choice}"
        )
    far = f"{drift.total:.0f} px from the first frame"
    if drift.verdict == "sways":
        found.append(
            f"the camera sways ({far} at most): all frames were turned onto frame {drift.reference}"
        )
    if drift.verdict == "moves":
        lost = int((drift.agree < AGREE).sum())
        found.append(
            f"the camera moves ({far}; {lost} frames do not fit a homography): the method "
            "assumes one that stands still, so choose a part of the video where it does "
            "(--frames.start, --frames.end), or give its poses to `mover run` (cameras.npz)"
        )
    return found


def steady_frames(clip: Clip, drift: Drift, folder: Path, observe: Observer = silent) -> Clip:
    """The frames as the reference frame's camera saw them; unchanged where the camera is still."""
    steady = replace(clip, folder=str(folder))
    kept = {steady.path(frame) for frame in range(len(clip.time))}
    for old in {*folder.glob("[0-9]*.jpg")} - kept:  # of another video
        old.unlink()
    for frame in range(len(clip.time)):
        path = steady.path(frame)
        if drift.verdict == "still":
            copy_whole(clip.path(frame), path)
        else:
            H = drift.H[frame].double().numpy()
            write_jpeg(warp(read_picture(clip.path(frame)), H, (clip.height, clip.width)), path)
        observe(Step("steady_frames", frame, len(clip.time)))
    return steady


def _grey(clip: Clip, frame: int) -> Grey:
    """Brightness of a frame at the working size."""
    import cv2

    scale = min(1.0, WIDE / clip.width)
    brightness = read_picture(clip.path(frame)).mean(-1).round().astype(np.uint8)
    size = [max(8, round(n * scale)) for n in brightness.shape]
    return cv2.resize(brightness, size[::-1], interpolation=cv2.INTER_AREA)


FRAMES = 40  # most that are looked at, evenly over the video
LEAST_FRAMES = 3  # fewest frames that show a pixel; with fewer it is hidden
MARGIN = 0.008  # of the picture's width: how far beyond a mask a person may reach
STRIPS = 16  # parts in which the picture is put together, to save memory
THINGS = frozenset({
    "chair", "couch", "bed", "dining table", "bench", "toilet", "refrigerator", "potted plant",
    "oven", "tv",
})  # fmt: skip
"""COCO's classes that are furniture; cups and books are not."""
SAME_THING = 0.6  # overlap from which on two finds are one thing


@record
class Clean:
    """The reference picture."""

    picture: Float[Tensor, "h w 3"]
    """In [0, 1]."""
    hidden: Bool[Tensor, "h w"]
    """Pixels that no frame, or too few, show empty."""


def reference_of(clip: Clip, drift: Drift, tracks: People) -> Clean:
    """The room without people: the median of the frames that show a pixel empty.

    A person without a mask for some frames is in no median. Where too few frames show a pixel, it
    is that of the frame which shows most of the room. `drift` is what was undone in the clip.
    """
    size = clip.height, clip.width
    chosen = np.linspace(0, len(clip.time) - 1, min(len(clip.time), FRAMES)).round().astype(int)
    pictures, shown = list[NDArray[np.uint8]](), list[NDArray[np.bool_]]()
    for frame in chosen.tolist():
        hidden = np.zeros(size, dtype=bool)
        for row in (tracks.frame == frame).nonzero()[:, 0].tolist():
            hidden |= decode(tracks.masks, row).numpy()
        seen = ~grown(hidden, round(MARGIN * clip.width))
        if drift.verdict != "still":
            seen &= shown_by(drift.H[frame].double().numpy(), size)
        pictures.append(read_picture(clip.path(frame)))
        shown.append(seen)
    best = max(range(len(chosen)), key=lambda k: int(shown[k].sum()))
    if len(chosen) < LEAST_FRAMES:
        picture, hidden = pictures[best], ~shown[best]
    else:
        picture, hidden = median(np.stack(pictures), np.stack(shown))
        picture[hidden] = pictures[best][hidden]
    return Clean(torch.from_numpy(picture).float() / 255, torch.from_numpy(hidden))


def median(
    pictures: NDArray[np.uint8], shown: NDArray[np.bool_]
) -> tuple[NDArray[np.uint8], NDArray[np.bool_]]:
    """Median over the frames (n, h, w, 3) that show a pixel, and which pixels too few show."""
    found = np.empty(pictures.shape[1:], np.uint8)
    for rows in np.array_split(np.arange(len(found)), STRIPS):
        values = torch.from_numpy(pictures[:, rows]).float()
        values[torch.from_numpy(~shown[:, rows])] = torch.nan
        found[rows] = values.nanmedian(0).values.nan_to_num(0).byte().numpy()
    return found, shown.sum(0) < LEAST_FRAMES


def grown(mask: NDArray[np.bool_], steps: int) -> NDArray[np.bool_]:
    """A mask with a margin [px]."""
    if steps < 1 or not mask.any():
        return mask
    return depth_in(~mask) <= steps


def detections_in(finds: Finds) -> tuple[Detection, ...]:
    """Furniture as annotations; of finds that cover each other only the surest stays."""
    from pycocotools import mask as coco

    size, kept = [finds.masks.height, finds.masks.width], list[int]()
    codes: Any = [{"size": size, "counts": code} for code in finds.masks.counts]
    boxes, overlap = mask_boxes(finds.masks), coco.iou(codes, codes, [0] * len(codes))
    for row in finds.score.argsort(descending=True).tolist():
        if finds.category[row] in THINGS and not any(overlap[row][k] > SAME_THING for k in kept):
            kept.append(row)
    return tuple(
        Detection(
            id=k, category=finds.category[row], box=boxes[row],
            mask=replace(finds.masks, counts=(finds.masks.counts[row],)),
            score=float(finds.score[row]),
        )
        for k, row in enumerate(kept)
    )  # fmt: skip


def hidden_mask(clean: Clean) -> Masks | None:
    """Where people hide the room in the clean picture; None: nowhere."""
    if not bool(clean.hidden.any()):
        return None
    height, width = clean.hidden.shape
    return Masks(height, width, (encode(clean.hidden),))
