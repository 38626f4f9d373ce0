"""The lens and the first guess of pitch and roll: from a file, the picture's EXIF, or an angle."""

import math
import warnings
from pathlib import Path
from typing import Any

from ..readers.any_camera import of_view, read_camera_file
from ..readers.fields import At, reason
from ..records import InputError

FULL_FRAME = math.hypot(36, 24)  # [mm], diagonal to which "equivalent" focal lengths refer
USUAL = 60.0  # [degrees], horizontal field of view of phones held level, where nothing is known
EXIF_IFD, FOCAL_35 = 0x8769, 0xA405


def lens_of(
    size: tuple[int, int], *, file: Path | None, fov: float | None, photo: Path | None
) -> tuple[At, str | None]:
    """The fields of camera.json, and a warning where the lens is a guess.

    Args:
        size: Width and height of the frames [px].
        file: A calibration of any known kind; GeoCalib's also tells pitch and roll.
        fov: Horizontal field of view [degrees].
        photo: A picture whose EXIF tells the focal length.

    Raises:
        InputError: If what is given cannot be used.
    """
    if file is not None:
        return read_camera_file(file, size), None
    if fov is not None:
        return of_view(fov, size, "--fov"), None
    focal = None if photo is None else exif_focal(photo, size)
    if focal is not None:
        return _centred(focal, size), None
    text = (
        f"the lens is not known: {USUAL:.0f} degrees across are assumed; give --camera FILE or "
        "--fov DEGREES (GeoCalib, MoGe and others tell both lens and tilt)"
    )
    return of_view(USUAL, size, "assumed"), text


def exif_focal(photo: Path, size: tuple[int, int]) -> float | None:
    """Focal length of a picture's EXIF [px]; None: it tells none.

    The 35 mm equivalent refers to the diagonal, so it holds for any format and either way up.

    Raises:
        InputError: If it is no picture.
    """
    from PIL import Image

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(photo) as picture:
                found: Any = picture.getexif().get_ifd(EXIF_IFD).get(FOCAL_35)
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise InputError(
            f"{photo.name}: cannot be read ({reason(error)}), expected a picture"
        ) from error
    if found is None or not 1 <= float(found) <= 2000:
        return None
    return float(found) / FULL_FRAME * math.hypot(*size)


def _centred(focal: float, size: tuple[int, int]) -> At:
    w, h = size
    fields = {"w": w, "h": h, "fl_x": focal, "fl_y": focal, "cx": w / 2, "cy": h / 2}
    return At(fields, "EXIF")
