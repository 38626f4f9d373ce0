"""Does the camera stand still? Where it only sways, the frames are turned back onto one of them.

The method assumes one camera for all frames. A camera that turns a little about its centre (a hand,
a loose tripod) is undone exactly by a homography; one that walks is not, and gives a warning.
"""

from collections.abc import Sequence
from dataclasses import replace
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float, UInt8
from numpy.typing import NDArray
from torch import Tensor

from mover.core.errors import InputError
from mover.core.observe import Observer, Step, silent
from mover.core.records import record
from mover.perceive.config import SteadyConfig
from mover.perceive.video import Clip, read_picture, write_jpeg

WIDE = 480  # [px], frames are compared at this width
CLEARLY = 0.03  # share of pixels by which a farther start must be better
GRID = 4  # points along each side that measure a drift
FOCAL = 0.9  # of the larger side: a lens of 58 degrees, where none is known
POINTS, DETAIL, APART = 1000, 0.005, 5  # points that are followed: most, least detail, gap [px]
LEAST = 10  # points, fewer give no estimate
ROUGH = 3.0  # [px], how far points may be off a shift of the picture
NOISE = 0.3  # [px], of a point that was found again
LIGHT = 19  # [px], what changes over more is light
CUT, STAYS = 0.3, 5  # agreement that a cut takes at once, frames that it stays away at least
SAME = 0.4  # [contrast], two pixels that show the same differ by less

Grey = UInt8[np.ndarray, "h w"]
Matrix = NDArray[np.floating[Any]]


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


@record
class Overlay:
    """How a picture lies over the reference."""

    H: Float[Tensor, "3 3"]
    """Pixels of the picture from pixels of the reference."""
    agree: float
    """Share of the pixels with detail that are as bright as in the reference."""


def opencv() -> Any:  # noqa: ANN401
    """OpenCV, which follows points and turns pictures.

    Raises:
        InputError: If it is missing.
    """
    try:
        return import_module("cv2")
    except ImportError as error:
        raise InputError(
            "perceive needs OpenCV: pip install '.[perceive]' in mover's folder"
        ) from error


def align(
    reference: Grey, picture: Grey, start: Float[Tensor, "3 3"], focal: float | None = None
) -> Overlay:
    r"""How a camera turned (and zoomed) between two pictures.

        min_{R, z}  \sum_p  rho( H p - q ),   H = K diag(z, z, 1) R K^-1

    over points p with detail that OpenCV finds again at q (Lucas & Kanade over pyramids). rho is
    Cauchy's: people, who move otherwise than the room, hardly count. Four numbers instead of the
    eight of any homography, because the other four follow people where they fill a part of it.

    Args:
        reference: Brightness.
        picture: The same size.
        start: A first guess.
        focal: Of the lens [px]; it may be off by half.
    """
    from scipy.optimize import least_squares

    h, w = reference.shape
    f = focal or FOCAL * max(h, w)
    K = np.array([[f, 0, w / 2], [0, f, h / 2], [0, 0, 1.0]])
    points, places = _followed_points(reference, picture, start)
    rough, four = _rough(points, places, K)
    near = np.linalg.norm(_mapped(rough, points) - places, axis=1) < 2 * ROUGH
    if near.sum() < LEAST:
        return Overlay(start, 0.0)

    def off(four: Matrix) -> Matrix:
        return (_mapped(_turned(four, K), points[near]) - places[near]).ravel()

    found = least_squares(off, four, loss="cauchy", f_scale=NOISE)
    turned = _turned(found.x, K)
    H = torch.from_numpy(turned / turned[2, 2]).to(start)
    return Overlay(H, _agreement(reference, picture, H))


def _followed_points(
    reference: Grey, picture: Grey, start: Float[Tensor, "3 3"]
) -> tuple[Matrix, Matrix]:
    """Points with detail, and where they are in the picture [px]."""
    cv2 = opencv()
    corners = cv2.goodFeaturesToTrack(reference, POINTS, DETAIL, APART)
    if corners is None:
        return np.zeros((0, 2)), np.zeros((0, 2))
    guess = _mapped(start.double().numpy(), corners[:, 0] + 0.5) - 0.5
    places, found, _ = cv2.calcOpticalFlowPyrLK(
        reference, picture, corners, guess[:, None].astype(np.float32),
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )  # fmt: skip
    known = found[:, 0] > 0
    return corners[known, 0] + 0.5, places[known, 0] + 0.5


def _rough(points: Matrix, places: Matrix, K: Matrix) -> tuple[Matrix, Matrix]:
    """What most points agree on: a turn, zoom and shift of the picture, and the camera's four."""
    found = None
    if len(points) >= LEAST:
        found, _ = opencv().estimateAffinePartial2D(points, places, ransacReprojThreshold=ROUGH)
    if found is None:
        return np.eye(3), np.array([0.0, 0, 0, 1])
    rough = np.vstack([found, [0, 0, 1]])
    lens = np.linalg.inv(K) @ rough @ K
    roll = np.arctan2(lens[1, 0], lens[0, 0])
    return rough, np.array([-lens[1, 2], lens[0, 2], roll, np.hypot(lens[0, 0], lens[1, 0])])


def _turned(four: Matrix, K: Matrix) -> Matrix:
    """The homography of a turn about an axis [rad] and a zoom."""
    zoom = np.diag([four[3], four[3], 1])
    return K @ zoom @ opencv().Rodrigues(four[:3])[0] @ np.linalg.inv(K)


def _mapped(H: Matrix, points: NDArray[Any]) -> Matrix:
    return moved(torch.from_numpy(H), torch.from_numpy(points).double()).numpy()


def _agreement(reference: Grey, picture: Grey, H: Float[Tensor, "3 3"]) -> float:
    """Share of the pixels with detail that are as bright as in the reference."""
    cv2 = opencv()
    pair = reference.astype(np.float32), warp(picture.astype(np.float32), H, reference.shape)
    own, other = (x - cv2.blur(x, (LIGHT, LIGHT)) for x in pair)
    known = _known(reference.shape, H) > 0
    steep = np.hypot(cv2.Sobel(own, -1, 1, 0), cv2.Sobel(own, -1, 0, 1))
    used = known & (steep >= steep.mean())
    if used.sum() < LEAST:
        return 0.0
    contrast = np.sqrt(np.square(own[used]).mean())
    return float((np.abs(own - other)[used] < SAME * contrast).mean() * known.mean())


def moved(
    H: Float[Tensor, "*b 3 3"], points: Float[Tensor, "points 2"]
) -> Float[Tensor, "*b points 2"]:
    """Points under homographies."""
    flat = torch.cat([points, torch.ones_like(points[:, :1])], -1).to(H)
    image = flat @ H.mT
    return image[..., :2] / image[..., 2:]


def warp(picture: NDArray[Any], H: Float[Tensor, "3 3"], size: tuple[int, int]) -> NDArray[Any]:
    """The picture seen in the pixels of the reference; its border goes on where it ends.

    Args:
        picture: What is sampled.
        H: Its pixels from those of the reference.
        size: Height and width of the reference [px].
    """
    cv2 = opencv()
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    centred = _of_centres(H)
    return cv2.warpPerspective(
        picture, centred, size[::-1], flags=flags, borderMode=cv2.BORDER_REPLICATE
    )


def _known(size: tuple[int, int], H: Float[Tensor, "3 3"]) -> Matrix:
    """1 where `warp` samples a picture of this size, 0 where its border goes on."""
    cv2 = opencv()
    flags = cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP
    return cv2.warpPerspective(np.ones(size, np.float32), _of_centres(H), size[::-1], flags=flags)


def _of_centres(H: Float[Tensor, "3 3"]) -> Matrix:
    """The homography as OpenCV counts: whole numbers are the centres of pixels."""
    half = np.array([[1, 0, 0.5], [0, 1, 0.5], [0, 0, 1]])
    return np.linalg.inv(half) @ H.double().numpy() @ half


def find_drift(inputs: SteadyInputs, config: SteadyConfig, observe: Observer = silent) -> Drift:
    """Align every frame with the first, each from where the one before ended.

    Raises:
        InputError: If OpenCV is missing.
    """
    clip = inputs.clip
    count = len(clip.time)
    scale = min(1.0, WIDE / clip.width)
    first = _grey(clip.path(0), scale)
    fits = [Overlay(torch.eye(3), 1.0)]
    for frame in range(1, count):
        fits.append(_followed(first, _grey(clip.path(frame), scale), fits[-1]))
        observe(Step("find_drift", frame, count))
    grow = torch.diag(torch.tensor([1 / scale, 1 / scale, 1.0]))
    from_first = grow @ torch.stack([fit.H for fit in fits]) @ torch.linalg.inv(grow)
    agree = torch.tensor([fit.agree for fit in fits])
    return _judged(from_first, agree, (clip.height, clip.width), config)


def _followed(first: Grey, picture: Grey, before: Overlay) -> Overlay:
    """A frame on the first one: from where the frame before it lay, or from scratch.

    Stripes and tiles look similar when shifted, so that the nearest start counts unless a farther
    one is clearly better.
    """
    near = align(first, picture, before.H)
    if near.agree >= before.agree - CLEARLY:
        return near
    far = align(first, picture, torch.eye(3))
    return far if far.agree > near.agree + CLEARLY else near


def _judged(
    from_first: Tensor, agree: Tensor, size: tuple[int, int], config: SteadyConfig
) -> Drift:
    """Choose the reference frame and say what the camera did."""
    y, x = (torch.linspace(0, float(n), GRID) for n in size)
    points = torch.cartesian_prod(x, y)
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


def cuts_of(drift: Drift, config: SteadyConfig | None = None) -> list[int]:
    """Frames at which the picture is another one all at once and stays so: the video was cut.

    A camera that walks away loses its first picture little by little, and a person who passes close
    by gives it back.
    """
    least = (config or SteadyConfig()).agree
    agree = drift.agree.tolist()
    return [
        k
        for k in range(1, len(agree))
        if agree[k - 1] - agree[k] > CUT and max(agree[k : k + STAYS]) < least
    ]


def cut_warning(
    time: Float[Tensor, " frames"], cuts: Sequence[int], taken: tuple[int, int]
) -> str | None:
    """Where the video was cut, which part is used, and what to do; None: it was not cut.

    Args:
        time: Of each frame of the whole video [s].
        cuts: Frames that begin another shot.
        taken: First frame of the shot that is used, and the one after its last.
    """
    if not cuts:
        return None
    seconds = [float(time[k]) for k in cuts]
    shown = ", ".join(f"{second:.1f} s" for second in seconds[:5])
    first, last = float(time[taken[0]]), float(time[taken[1] - 1])
    return (
        f"the video is cut at {shown}: the method needs one shot, and the longest is used, "
        f"{first:.1f} to {last:.1f} s; another is chosen with --frames.end {seconds[0]:.1f} or "
        f"--frames.start {seconds[-1]:.1f}"
    )


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
                "assumes one that stands still, so choose a part of the video where it does "
                "(--frames.start, --frames.end), or give its poses to `mover run` (cameras.npz)"
            )


def steady_frames(clip: Clip, drift: Drift, folder: Path, observe: Observer = silent) -> Clip:
    """The frames as the reference frame's camera saw them; unchanged where the camera is still."""
    folder.mkdir(parents=True, exist_ok=True)
    steady = replace(clip, folder=str(folder))
    kept = {steady.path(frame) for frame in range(len(clip.time))}
    for old in {*folder.glob("[0-9]*.jpg")} - kept:  # of another video
        old.unlink()
    for frame in range(len(clip.time)):
        path = steady.path(frame)
        if drift.verdict == "still":
            path.unlink(missing_ok=True)
            path.write_bytes(clip.path(frame).read_bytes())
        else:
            size = clip.height, clip.width
            write_jpeg(warp(read_picture(clip.path(frame)), drift.H[frame], size), path)
        observe(Step("steady_frames", frame, len(clip.time)))
    return steady


def seen_share(drift: Drift, frame: int, size: tuple[int, int]) -> Float[Tensor, "h w"]:
    """1 where a steadied frame shows what its camera saw, 0 where only its border was repeated.

    Args:
        drift: Of the camera.
        frame: Which one.
        size: Height and width [px].
    """
    if drift.verdict == "still":
        return torch.ones(size)
    return torch.from_numpy(_known(size, drift.H[frame]))


def _grey(path: Path, scale: float) -> Grey:
    """Brightness of a frame at the working size."""
    brightness = read_picture(path).mean(-1).round().astype(np.uint8)
    size = [max(8, round(n * scale)) for n in brightness.shape]
    cv2 = opencv()
    return cv2.resize(brightness, size[::-1], interpolation=cv2.INTER_AREA)
