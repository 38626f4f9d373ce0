"""Pictures: the reference image, and its depth as networks give it."""

import logging
import math
import warnings
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal, NoReturn

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from mover.core.errors import InputError
from mover.core.files import not_there, reason, replacing, unreadable
from mover.core.types import Camera, DepthImage
from mover.io.files.fields import At, read_npy, read_npz
from mover.io.files.meshes import inside

log = logging.getLogger(__name__)


@contextmanager
def opened(
    path: Path,
    at: At | None = None,
    expected: str = "a picture",
    bombs: Literal["error", "ignore"] = "ignore",
) -> Generator[Any, None, None]:
    """An open picture, which messages call by `at`, else by its file.

    With `bombs="error"` a picture is refused that is large enough to make Pillow warn.
    """
    from PIL import Image

    try:
        if not path.is_file():
            raise FileNotFoundError(f"it {not_there(path, 'does not exist')}")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            with Image.open(path) as picture:
                (w, h), most = picture.size, Image.MAX_IMAGE_PIXELS or math.inf
                if bombs == "error" and w * h > most:
                    raise ValueError(f"it is too large: {w} x {h} pixels, at most {most} are read")
                yield picture
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        if at is not None:
            at.refuse(expected, f"{str(at.value)!r}, which cannot be read ({reason(error, path)})")
        raise unreadable(path, error, expected) from error


def read_image(at: At, folder: Path, camera: Camera) -> Float[Tensor, "h w 3"]:
    """The picture that a field names, upright, in [0, 1]; its size must be the camera's."""
    return read_image_file(at, inside(at, folder), camera)


def read_image_file(at: At, path: Path, camera: Camera) -> Float[Tensor, "h w 3"]:
    """A picture wherever it lies, upright, in [0, 1]; its size must be the camera's."""
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
        found = "" if str(at.value) == at.file else f"{str(at.value)!r} with "
        cure = "; is it the camera's picture, uncut and unscaled (--camera, --fov)?"
        at.refuse(expected + cure, f"{found}{size[0]} x {size[1]} pixels")
    return torch.from_numpy(pixels / np.float32(255))


def image_size(path: Path) -> tuple[int, int]:
    """Width and height of a picture as it is shown: upright, as its EXIF says [px]."""
    with opened(path) as picture:
        sideways = picture.getexif().get(ORIENTATION, 1) >= 5
        return picture.size[::-1] if sideways else picture.size


def write_image(image: Float[Tensor, "h w 3"], path: Path) -> None:
    """Write a picture as PNG, 8 bits a channel."""
    from PIL import Image

    pixels = (image.detach().cpu() * 255).round().clamp(0, 255).to(torch.uint8).numpy()
    with replacing(path) as part:
        Image.fromarray(pixels).save(part, format="PNG")


# Depth of the picture, as Depth Anything, MoGe, UniDepth, Depth Pro or MiDaS give it.


ORIENTATION = 0x0112  # of EXIF: from 5 on the picture lies on its side
DEPTH, DISPARITY = "depth", "disparity"
INVERSE = (DISPARITY, "disp", "inverse_depth", "inv_depth")
NAMES = ("depth", "depth_metric", "metric_depth", "predicted_depth", "depths", "arr_0")
FARTHEST = 100.0  # [m], what is farther is sky or nonsense
MILLIMETRES = 1000.0
FEWEST_KNOWN = 0.05  # share of the pixels whose depth is known
NEAREST = 0.3  # [m], median of a room
SAME_SHAPE = 0.03  # networks cut sides to multiples of 8 or 14 pixels
ENDINGS = (".npy", ".npz", ".png")


def find_depth_file(folder: Path) -> tuple[Path, bool] | None:
    """The measured depth in a capture's folder, and whether it is metric; None: there is none.

    `depth/` holds metres (millimetres in a PNG), `disparity/` the inverse depth of a relative
    network; the file is of the reference picture, or the first by name.

    Raises:
        InputError: If both are there, or a folder holds no depth map.
    """
    there = [name for name in (DEPTH, DISPARITY) if (folder / name).is_dir()]
    if not there:
        return None
    if len(there) == 2:
        raise InputError(f"{folder.name}: has {DEPTH}/ and {DISPARITY}/, expected one of the two")
    files = sorted(p for p in (folder / there[0]).iterdir() if p.suffix.lower() in ENDINGS)
    if not files:
        raise InputError(f"{there[0]}/: has no depth map, expected 000000{' or '.join(ENDINGS)}")
    number = reference_frame(folder)
    named = (p for p in files if p.stem.isdigit() and int(p.stem) == number)
    return next(named, files[0]), there[0] == DEPTH


def reference_frame(folder: Path) -> int:
    """The frame that a capture's reference picture shows, by cameras.npz; 0 without it."""
    if not (folder / "cameras.npz").is_file():
        return 0
    at = read_npz(folder / "cameras.npz")
    given = at.maybe("reference") or at.maybe("frame")
    value = np.zeros(1) if given is None else np.asarray(given.value).reshape(-1)
    return int(value[0]) if value.size and value.dtype.kind in "iu" else 0


def write_depth_image(depth: DepthImage, folder: Path) -> None:
    """Write it into a capture's folder."""
    values = depth.values.detach().cpu().numpy()
    place = folder / (DEPTH if depth.metric else DISPARITY) / "000000.npy"
    with replacing(place) as part, part.open("wb") as file:
        np.save(file, values, allow_pickle=False)


def read_depth(
    path: Path, camera: Camera, *, metric: bool = True, frame: int = 0
) -> Float[Tensor, "h w"]:
    """Distance along the view of each pixel [m], or inverse depth; NaN where it is unknown.

    `.npz` and `.npy` hold metres (`depth`, or MoGe's `points`, whose z counts), of one frame or of
    all (MegaSaM, VGGT), of which `frame` is taken; `.png` with 16 bits holds millimetres. Another
    resolution of the same shape is stretched. Inverse depth is known up to a factor and a shift,
    and larger where nearer.
    """
    match path.suffix.lower():
        case ".png":
            values = _of_png(path, metric)
        case ".npz":
            values = _of_npz(path, NAMES if metric else (*INVERSE, *NAMES), metric, frame)
        case ".npy":
            values = _of_frame(read_npy(path), frame)
        case _:
            raise InputError(f"{path.name}: is no depth map, expected .npz, .npy or .png")
    known = np.isfinite(values) & (values > 0) & (values < (FARTHEST if metric else np.inf))
    if known.mean() < FEWEST_KNOWN or (metric and np.median(values[known]) < NEAREST):
        _refuse_depth(path, values[np.isfinite(values)], known, metric=metric)
    depth = torch.from_numpy(np.where(known, values, np.nan).astype(np.float32))
    h, w = depth.shape
    if abs(w * camera.height - h * camera.width) > SAME_SHAPE * w * camera.height:
        shape = f"{camera.width} x {camera.height} pixels"
        raise InputError(f"{path.name}: has {w} x {h} values, expected the shape of {shape}")
    rows = ((torch.arange(camera.height) + 0.5) * h / camera.height).long()
    columns = ((torch.arange(camera.width) + 0.5) * w / camera.width).long()
    return depth[rows][:, columns]


def _refuse_depth(
    path: Path, values: NDArray[np.float64], known: NDArray[np.bool_], *, metric: bool
) -> NoReturn:
    """Say why a depth map cannot be one of a room."""
    middle = float(np.median(values)) if values.size else math.nan
    wanted = f"distances of {NEAREST:g} to {FARTHEST:g} m" if metric else "values above 0"
    cures = {
        "divide by 1000, if it is in millimetres": middle > 500,
        "negate it": middle < 0,
        "divide by 100, if it is in centimetres": FARTHEST <= middle <= 500,
        f"or {DISPARITY}/ in place of {DEPTH}/, if it is inverse depth": known.any(),
    }
    cure = next((f"; {text}" for text, fits in cures.items() if metric and fits), "")
    found = f"has {100 * known.mean():.0f} % usable values (median of all {middle:.3g})"
    raise InputError(f"{path.name}: {found}, expected {wanted}{cure}")


def _of_npz(path: Path, names: tuple[str, ...], metric: bool, frame: int) -> NDArray[np.float64]:
    at = read_npz(path)
    points = at.maybe("points")
    found = next((v for n in names if (v := at.maybe(n)) is not None), None)
    if found is None and metric and points is not None and np.ndim(points.value) == 3:
        return np.asarray(points.value, dtype=np.float64)[..., 2]
    if found is None:
        wanted = f"one of the arrays {', '.join(names)} or points"
        for name in {*INVERSE} & {*at.value}:
            wanted += f"; {name!r} is inverse depth: into {DISPARITY}/"
        at.refuse(wanted, f"{', '.join(at.value)}")
    return _of_frame(found, frame)


def _of_frame(at: At, frame: int) -> NDArray[np.float64]:
    """The depth map of a frame, where there is one for each; axes of length 1 are left out."""
    value = np.asarray(at.value)
    while value.ndim > 2 and 1 in (value.shape[0], value.shape[-1]):
        value = value[0] if value.shape[0] == 1 else value[..., 0]
    if value.ndim == 3 and value.shape[-1] > 4:
        if frame >= len(value):
            at.refuse(f"a depth map of frame {frame}", f"{len(value)} frames")
        log.warning("depth maps of %d frames: that of frame %d is used", len(value), frame)
        value = value[frame]
    if value.dtype.kind == "f":  # unknown pixels may be NaN or infinite
        value = np.where(np.isfinite(value), value, 0)
    return at.holding(value).array(("h", "w")).astype(np.float64)


def _of_png(path: Path, metric: bool) -> NDArray[np.float64]:
    kind = "a depth map" if metric else "a map of inverse depth"
    with opened(path, expected=kind, bombs="error") as picture:
        mode, values = picture.mode, np.asarray(picture, dtype=np.float64)
    expected = "" if values.ndim == 2 else "one grey value, larger where nearer"
    if metric and not mode.startswith("I"):
        expected = "16 bits of millimetres (8 bits or colours have no unit)"
    if expected:
        raise InputError(f"{path.name}: has {mode} pixels, expected {expected}")
    return values / MILLIMETRES if metric else values
