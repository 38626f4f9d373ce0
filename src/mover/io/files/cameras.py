"""Cameras as calibration tools write them, turned into the fields of camera.json."""

import logging
import math
import re
import struct
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from mover.core.errors import InputError
from mover.core.files import unreadable
from mover.core.types import Tilt
from mover.geometry.camera import tilted
from mover.io.files.fields import LARGEST, At, existing, read_json, read_npy, read_npz
from mover.io.files.images import ORIENTATION, opened
from mover.io.files.schema import Positive, Side, checked

log = logging.getLogger(__name__)

LARGEST_TEXT = 1 << 20  # [bytes], of a calibration
HALF = 0.5  # [px], calibrations count from the centre of the first pixel
GUESSED = 0.055  # error of a focal length's logarithm by a network: 3-8 % (GeoCalib, WildCamera)
BY_EXIF = 0.05  # the same of a photo, whose picture a video's frames may be a part of
BY_GRAVITY = 1.0  # error of pitch and roll of a phone that is held still [degrees]
WIDEST = 175.0  # [degrees], of a pinhole camera
WIDEST_TILT = 0.5  # [rad], an error of the tilt that is as good as none
SAME_FORMAT = 0.01  # difference of two ratios of width and height
STRAIGHT = 2.0  # [px], a lens that moves the corners by less is left as it is
MATRIX = (
    "camera_mtx", "Intrinsics", "camera_matrix", "Camera_Matrix", "cameraMatrix",
    "intrinsic_matrix", "intrinsics", "mtx", "K",
)  # fmt: skip
"""Names of [fx 0 cx; 0 fy cy; 0 0 1] in files of PROX, OpenCV, ROS and Open3D, or of four."""
BENT = (
    "Distortion", "distortion_coefficients", "Distortion_Coefficients", "distCoeffs", "dist_coeffs",
    "dist_coeff", "distortion_coeffs", "dist", "coeffs",
)  # fmt: skip
"""Names of k1, k2, p1, p2, k3, ... of OpenCV."""
SIDES = (
    ("w", "width", "image_width", "image_Width"),
    ("h", "height", "image_height", "image_Height"),
)
FOUR = (("fx",), ("fy",), ("ppx", "cx"), ("ppy", "cy"))
"""Names of the four numbers of a lens where they stand by themselves, as RealSense has them."""
FOCAL = ("focal_length", "f", "focal")
COLMAP = {
    "SIMPLE_PINHOLE": 3, "PINHOLE": 4, "SIMPLE_RADIAL": 4, "RADIAL": 5, "OPENCV": 8,
    "OPENCV_FISHEYE": 8, "FULL_OPENCV": 12, "FOV": 5, "SIMPLE_RADIAL_FISHEYE": 4,
    "RADIAL_FISHEYE": 5, "THIN_PRISM_FISHEYE": 12,
}  # fmt: skip
"""COLMAP's models in the order of their numbers, and how many numbers each has."""
ONE_FOCAL = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")
XML = (
    r"<(?P<a>\w+)[^<>]*>\s*(<(?!data)\w+>[^<]*</\w+>\s*){0,9}<data>(?P<data>[^<]*)"
    r"|<(?P<b>\w+)>(?P<one>[^<]+)</"
)
YAML = r"^(?P<a>\w+):((?!^\w).)*?data:\s*\[(?P<data>[^]]*)|^ *(?P<b>\w+):\s*\[?(?P<one>[^][\n]+)"
"""Matrices with `data`, and numbers by themselves."""
CURVED = r"^ *(camera|distortion)_model: *(omni|ds|eucm|equidistant|fov|fisheye|kannala)\w*"
"""Lenses of Kalibr and ROS that are not straight."""
Size = tuple[int, int] | None


def read_camera_file(path: Path, size: Size) -> At:
    """The camera of a file of any known kind, in the fields of camera.json.

    Known are our own and nerfstudio's .json, 3 x 3 numbers in a text file (cam_K.txt), COLMAP's
    cameras.txt and cameras.bin or their folder, calibrations of OpenCV, ROS and Kalibr (.xml, .yml,
    .json), PROX's `camera_mtx` (whose fits leave out its distortion `k`), .json of RealSense and
    Open3D, MoGe's fov.json, GeoCalib's {"f", "roll", "pitch"}, SAM 3D Body's focal_length.json, and
    photos whose EXIF has the focal length.

    Args:
        path: Of the file.
        size: Width and height of the image, which most of them lack, and to which the camera is
            scaled [px].

    Raises:
        InputError: If the file cannot be understood, the lens is not straight, its pictures have
            another shape, or the size is needed and not known.
    """
    return in_pixels_of(size, _read_camera(path, size))


def in_pixels_of(size: Size, at: At) -> At:
    """The fields of camera.json in the pixels of an image of the same shape, if of another size."""
    own = at.maybe("w"), at.maybe("h")
    if size is None or None in own:
        return at
    (w, h), (width, height) = (checked(side, Side) for side in own if side), size
    if (w, h) == size:
        return at
    found = f"is of pictures of {w} x {h} pixels"
    if abs(w * height - h * width) > SAME_FORMAT * w * height:
        cure = f"the shape of the image, {width} x {height} (its own lens, or --fov)"
        raise InputError(f"{at.file}: {found}, expected {cure}")
    log.warning("%s: %s; it is scaled to the image of %d x %d", at.file, found, width, height)
    zoom = {"fl_x": width / w, "cx": width / w, "fl_y": height / h, "cy": height / h}
    scaled = {k: f * at.get(k).number() for k, f in zoom.items() if k in at.value}
    return at.holding({**at.value, **scaled, "w": width, "h": height})


def _read_camera(path: Path, size: Size) -> At:
    """The camera in the pixels of the file's own pictures, where it has their size."""
    if path.is_dir():
        files = (path / name for name in ("cameras.txt", "cameras.bin", "camera.json"))
        path = next((file for file in files if file.is_file()), path)
    match existing(path, "a camera").suffix.lower():
        case ".json":
            return camera_of_tree(read_json(path), size)
        case ".xml" | ".yml" | ".yaml":
            tree = _of_text(path)
            if tree.maybe(*MATRIX) is None:
                tree.refuse(f"a matrix of the camera ({', '.join(MATRIX)})", "none")
            return camera_of_tree(tree, size)
        case ".npz" | ".npy":  # np.savez(..., mtx=, dist=), or the matrix alone
            tree = read_npz(path).value if path.suffix == ".npz" else {"mtx": read_npy(path).value}
            tree = {key: np.asarray(value).tolist() for key, value in tree.items()}
            return camera_of_tree(At(tree, path.name), size)
        case ".jpg" | ".jpeg" | ".png" | ".tif" | ".tiff" | ".webp":
            if (photo := camera_of_photo(path, size)) is None:
                cure = "expected one (or --fov DEGREES)"
                raise InputError(f"{path.name}: has no focal length in its EXIF, {cure}")
            return photo
        case _:
            if rows := _colmap_rows(path):
                return _of_colmap(rows, path.name)
            return _of_matrix(read_intrinsics(path), size, At({}, path.name), shift=0.0)


def camera_of_tree(at: At, size: Size) -> At:
    """The fields of camera.json from a mapping of any known kind."""
    if at.maybe("fl_x") is not None:
        return At({"w": size[0], "h": size[1], **at.value} if size else at.value, at.file)
    given = at.maybe(*MATRIX)
    if given is not None and not (isinstance(given.value, Mapping) and "fx" in given.value):
        return _of_matrix(_checked(_numbers(given), given), size, at)
    found = [(way, one) for way, one in _objects(at) if {"fx", "fy"} <= one.value.keys()]
    if not found:
        return _of_lens(at, size)
    # Of several, the colour camera's.
    one = next((one for way, one in found if re.search("colou?r|rgb", way, re.I)), found[0][1])
    four = [one.maybe(*names) for names in FOUR]
    if None in four:
        one.refuse("a lens with fx, fy, ppx, ppy or cx, cy")
    lens = one.holding([n.value for n in four if n])
    sides = {k: n for names in SIDES for k in names if (n := at.value.get(k)) is not None}
    beside = one.holding({**sides, **one.value})  # the size may stand outside
    return _of_matrix(_checked(_numbers(lens), lens), size, beside)


def _objects(at: At, way: str = "", depth: int = 3) -> Iterator[tuple[str, At]]:
    """An object and those inside it, with their names."""
    if isinstance(at.value, Mapping):
        yield way, at
        for key in at.value if depth else ():
            yield from _objects(At(at.value[key], at.file, str(key)), f"{way} {key}", depth - 1)


def _numbers(at: At) -> NDArray[np.float64]:
    """The numbers of lists in lists, or of OpenCV's {"data": [...]}, one after another."""
    value: Any = at.value.get("data") if isinstance(at.value, Mapping) else at.value
    flat = np.array(value, dtype=object).ravel()
    return np.array([at.holding(one).number() for one in flat])


def _of_matrix(K: NDArray[np.float64], size: Size, at: At, shift: float = HALF) -> At:
    """A camera from its matrix, and the size, the distortion and the pose beside it in `at`.

    The principal point of the matrix lacks a `shift` [px]; `size` counts where the file has none.
    """
    sides = [at.maybe(*names) for names in SIDES]
    if None not in sides:
        w, h = (checked(s.holding(int(_numbers(s)[0])), Side) for s in sides if s)
        size = w, h
    if (bent := at.maybe(*BENT)) is not None:
        _check_straight(_numbers(bent), K, size, bent)
    fx, fy, cx, cy = (K[i, j].item() for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    found = _lens(at, size, fx, fy, (cx + shift, cy + shift))
    if (seen := at.maybe("CameraMatrix")) is None:
        return found
    R = _numbers(seen)  # of the authors of MOVER: [R | t] of a world that is y-down
    if R.size != 12:
        seen.refuse("3 x 4 numbers", f"{R.size}")
    turn = (R.reshape(3, 4)[:, :3] @ np.diag([1.0, -1.0, -1.0])).tolist()
    return At({**found.value, "R_cam_world": turn}, found.file)


def _check_straight(bent: NDArray[np.float64], K: NDArray[np.float64], size: Size, at: At) -> None:
    """Refuse a lens that moves the corners of the image by more than `STRAIGHT`."""
    if not bent.any():
        return
    k1, k2, p1, p2, k3, *_ = [*bent.tolist(), *[0.0] * 5]
    w, h = size or (2 * K[0, 2], 2 * K[1, 2])
    r = math.hypot(w / 2 / K[0, 0], h / 2 / K[1, 1])
    moved = abs(k1 * r**3 + k2 * r**5 + k3 * r**7) + 3 * (abs(p1) + abs(p2)) * r**2
    if moved * K[0, 0] > STRAIGHT or bent[5:].any():
        far = f"a distortion that moves the corners by {moved * K[0, 0]:.3g} px"
        at.refuse("a straight lens: undistort the images first", far)
    log.warning("%s: its distortion (%.2g px at the corners) is left out", at.file, moved * K[0, 0])


def _lens(
    at: At, size: Size, fx: float, fy: float, centre: tuple[float, float] | None = None
) -> At:
    """The fields of camera.json; without a centre, the principal point is the image's middle."""
    if size is None:
        at.refuse("the size of the image beside it: give --image", "no width and height")
    (w, h), (cx, cy) = size, centre or (size[0] / 2, size[1] / 2)
    return At({"w": w, "h": h, "fl_x": fx, "fl_y": fy, "cx": cx, "cy": cy}, at.file)


def of_view(degrees: float, size: tuple[int, int], file: str) -> At:
    """The camera with this horizontal field of view and the principal point in the middle."""
    return _of_lens(At({"fov_x": degrees}, file), size)


def with_spread(at: At, spread: float) -> At:
    """The fields of camera.json with how far off the focal length may be, of its logarithm."""
    return at.holding({**at.value, "focal_spread": spread})


def guessed_view(degrees: float, size: tuple[int, int]) -> At:
    """The camera of `--fov`: an assumed horizontal angle of view, marked as such."""
    return with_spread(of_view(degrees, size, "--fov"), GUESSED)


def read_intrinsics(path: Path) -> NDArray[np.float64]:
    """The 3 x 3 numbers of a text file [fx 0 cx; 0 fy cy; 0 0 1]."""
    words = [word for row in _rows(path) for word in row]
    try:
        numbers = np.array([float(word) for word in words])
    except ValueError as error:
        why = f"it is text, {' '.join(words)[:40]!r}"
        raise unreadable(path, why, "3 x 3 numbers, or COLMAP's cameras.txt") from error
    return _checked(numbers, At(numbers.tolist(), path.name))


def _checked(values: NDArray[np.float64], at: At) -> NDArray[np.float64]:
    """A matrix of intrinsics from nine numbers, of which Open3D's go down the columns, or four."""
    if values.size == 4 and not isinstance(at.value[0], list):
        fx, fy, cx, cy = values
        values = np.array([fx, 0, cx, 0, fy, cy, 0, 0, 1])
    given = values.reshape(3, 3) if values.size == 9 else np.zeros((3, 3))
    turned = given[0, 2] == given[1, 2] == 0 and given[2, 0] > 0
    K = given.T if turned else given
    usual = [K[0, 1], K[1, 0], *K[2]] == [0, 0, 0, 0, 1] and K[0, 0] > 0 and K[1, 1] > 0
    if not usual or not np.abs(K).max() <= LARGEST:
        at.refuse("3 x 3 numbers, intrinsics [fx 0 cx; 0 fy cy; 0 0 1]")
    return K


def _of_lens(at: At, size: Size) -> At:
    """A camera from a focal length or a field of view, with its tilt where the file has it."""
    pitch, roll = at.maybe("pitch"), at.maybe("roll")
    focal, across, up = at.maybe(*FOCAL), at.maybe("fov_x"), at.maybe("fov_y")
    tilt: dict[str, Any] = {}
    if pitch is not None and roll is not None:  # diag(1, -1, -1) R_z(roll) R_x(-pitch)
        angles = [pitch.number(-1.6, 1.6), roll.number(-1.6, 1.6)]
        tilt["R_cam_world"] = tilted(*torch.tensor(angles, dtype=torch.float64)).tolist()
    fx = 0.0 if focal is None else checked(focal, Positive)
    lens = _lens(at, size, fx, fx).value if focal or across else {}
    if across is not None and focal is None:
        views = ("fl_x", "w", across), ("fl_y", "h", up) if up else ("fl_y", "w", across)
        for name, side, view in views:
            lens[name] = lens[side] / 2 / math.tan(math.radians(view.number(1, WIDEST)) / 2)
    elif focal is None:
        known = f"fl_x, fx, {', '.join(MATRIX)}, {', '.join(FOCAL[:2])} or fov_x"
        at.refuse(f"a camera with one of the fields {known}")
    return At({**lens, **tilt}, at.file)


# Texts of OpenCV's FileStorage, of ROS and of COLMAP.


def _text(path: Path) -> str:
    """The text of a calibration."""
    try:
        if path.stat().st_size > LARGEST_TEXT:
            raise ValueError("it is too large for a calibration")
        return path.read_text(encoding="utf-8-sig")
    except (OSError, ValueError) as error:
        raise unreadable(path, error, "a camera") from error


def _rows(path: Path) -> list[list[str]]:
    """The words of the lines that are no comments."""
    lines = (line.partition("#")[0] for line in _text(path).splitlines())
    return [words for line in lines if (words := line.replace(",", " ").split())]


def _of_text(path: Path) -> At:
    """The matrices and numbers of OpenCV's XML or YAML, or of ROS's or Kalibr's YAML, by name."""
    text, found = _text(path), dict[str, Any]()
    if "<!ENTITY" in text:
        raise InputError(f"{path.name}: has entities, expected OpenCV's XML")
    if curved := re.search(CURVED, text, re.M):
        cure = "a straight lens: undistort the images first"
        raise InputError(f"{path.name}: has '{curved[0].strip()}', expected {cure}")
    if len(cameras := re.findall(r"^cam\d+(?=:)", text, re.M)) > 1:
        raise InputError(f"{path.name}: has {' and '.join(cameras)}, expected the one of the video")
    for match in re.finditer(XML if path.suffix.lower() == ".xml" else YAML, text, re.M | re.S):
        name, words = match["a"] or match["b"], (match["data"] or match["one"] or "").split()
        words = [word.strip(",") for word in words if word != ","]
        try:
            found[name] = [float(word) for word in words]
        except ValueError:
            if name in (*MATRIX, *BENT):
                At(" ".join(words), path.name, name).refuse("numbers")
    if not found:
        raise unreadable(path, "it has no numbers with names", "OpenCV's calibration")
    if len(size := found.get("resolution", ())) == 2:  # of Kalibr
        found |= {"width": size[:1], "height": size[1:]}
    return At(found, path.name)


def _colmap_rows(path: Path) -> list[list[str]]:
    """Rows CAMERA_ID MODEL WIDTH HEIGHT PARAMS of COLMAP's cameras.txt or .bin; none of others."""
    if path.suffix.lower() != ".bin":
        rows = _rows(path)
        return rows if all(len(row) > 4 and row[1] in COLMAP for row in rows) else []
    models, found = list(COLMAP), list[list[str]]()
    try:
        data = path.read_bytes()
        (count,), place = struct.unpack_from("<Q", data), 8
        for _ in range(count):
            camera, model, w, h = struct.unpack_from("<iiQQ", data, place)
            size = COLMAP[models[model]]
            values = struct.unpack_from(f"<{size}d", data, place + 24)
            found.append([str(v) for v in (camera, models[model], w, h, *values)])
            place += 24 + 8 * size
    except (OSError, struct.error, IndexError) as error:
        raise unreadable(path, error, "cameras.bin") from error
    return found


def _of_colmap(rows: list[list[str]], file: str) -> At:
    """The one lens of COLMAP's cameras."""
    lenses = {tuple(row[1:]) for row in rows}
    if len(lenses) > 1:
        cure = "one for all pictures (--ImageReader.single_camera 1)"
        raise InputError(f"{file}: has {len(lenses)} cameras, expected {cure}")
    model, *rest = lenses.pop()
    at = At(rest, file, model)
    try:
        w, h, *values = (float(word) for word in rest)
    except ValueError:
        at.refuse("numbers")
    if len(values) != COLMAP[model]:
        at.refuse(f"{COLMAP[model]} numbers", f"{len(values)}")
    if "FISHEYE" in model or model == "FOV":
        cure = "a straight lens: undistort the images (colmap image_undistorter)"
        at.refuse(cure, "a fisheye's")
    fx, fy, cx, cy, *bent = values[:1] * (model in ONE_FOCAL) + values
    K, size = _checked(np.array([fx, fy, cx, cy]), at), (int(w), int(h))
    return _of_matrix(K, size, At({"coeffs": bent}, file, model), shift=0.0)


def with_known(
    at: At, tilt: tuple[float, ...] = (), height: float | None = None, photo: Path | None = None
) -> At:
    """The fields of camera.json with what else is known of the camera.

    Args:
        at: The fields.
        tilt: Pitch, roll and how far off they may be (1 if it is missing) [degrees], or nothing.
        height: Of the camera above the floor [m].
        photo: The reference image, whose EXIF may say the tilt where nothing else does.

    Raises:
        InputError: If the tilt has other numbers.
    """
    known: dict[str, Any] = {}
    if tilt:
        known = _tilt(tilt)
    elif photo is not None and at.maybe("R_cam_world") is None:
        known = tilt_of_photo(photo)
    if height is not None:
        known["height"] = height
    return at.holding({**at.value, **known})


def _tilt(degrees: tuple[float, ...]) -> dict[str, Any]:
    """The fields of a tilt that a user gives."""
    numbers = (*degrees, BY_GRAVITY)[:3] if len(degrees) == 2 else degrees
    bounds = zip(numbers, ((-89, 89), (-180, 180), (1e-3, 180)), strict=False)
    if len(numbers) != 3 or not all(low <= n <= high for n, (low, high) in bounds):
        raise InputError(
            f"--tilt: has {' '.join(f'{n:g}' for n in degrees)}, expected pitch (below 0: looks"
            f" down), roll and, if not {BY_GRAVITY:g}, how far off they may be [degrees]"
        )
    pitch, roll, off = (math.radians(angle) for angle in numbers)
    return tilt_fields(Tilt(pitch, roll, min(off, WIDEST_TILT)))


def tilt_fields(tilt: Tilt) -> dict[str, Any]:
    """`R_cam_world` and `tilt_spread` of camera.json."""
    R = tilted(*torch.tensor([tilt.pitch, tilt.roll], dtype=torch.float64))
    return {"R_cam_world": R.tolist(), "tilt_spread": tilt.spread}


# Photos: EXIF has the focal length as on 35 mm film, and Apple's maker note which way is down.

FULL_FRAME = math.hypot(36, 24)  # [mm], diagonal to which "equivalent" focal lengths refer
EXIF, FOCAL_35, LENS_NAME, MAKER_NOTE = 0x8769, 0xA405, 0xA434, 0x927C
APPLE, ACCELERATION = b"Apple iOS\0", 8
STEEPEST = 80.0  # [degrees]: nothing is level in a picture of the floor
SIDEWAYS = 45.0  # [degrees] of roll: the picture was turned since, without its maker note
STILL = 0.1  # [g] by which a phone at rest may differ from 1
SIDES_UP = {1: ((0, -1), (1, 0)), 3: ((0, 1), (-1, 0)), 6: ((1, 0), (0, 1)), 8: ((-1, 0), (0, -1))}
"""Right and up of the upright picture in axes of the phone (right, top), by EXIF's orientation."""


def camera_of_photo(path: Path, size: Size) -> At | None:
    """The lens of a photo's EXIF in pictures of a size [px]; None: it has no focal length.

    The 35 mm equivalent refers to the diagonal, so it holds for any format and either way up.

    Raises:
        InputError: If it is no picture.
    """
    with opened(path) as picture:
        found: Any = picture.getexif().get_ifd(EXIF).get(FOCAL_35)
    if found is None or not 1 <= float(found) <= 2000:
        return None
    focal = float(found) / FULL_FRAME * math.hypot(*(size or (0, 0)))
    return with_spread(_lens(At({}, path.name), size, focal, focal), BY_EXIF)


def tilt_of_photo(path: Path) -> dict[str, Any]:
    """Fields of camera.json with the tilt, where an iPhone's photo says it; else none.

    Tag 8 of Apple's maker note is the acceleration that the phone feels in units of g, whose
    numbers are those of gravity along (right, top, out of the screen); see ExifTool's Apple.pm.

    Raises:
        InputError: If it is no picture.
    """
    with opened(path) as picture:
        exif: Any = picture.getexif()
        details, sides = exif.get_ifd(EXIF), SIDES_UP.get(exif.get(ORIENTATION, 1))
    gravity = _acceleration(details.get(MAKER_NOTE))
    if gravity is None or sides is None or "front" in str(details.get(LENS_NAME)):
        return {}
    (right, top), out = gravity[:2], gravity[2]
    across, up = (x * right + y * top for x, y in sides)
    angles = math.atan2(out, math.hypot(across, up)), math.atan2(across, -up)
    pitch, roll = (math.degrees(angle) for angle in angles)
    level = abs(pitch) <= STEEPEST and abs(roll) <= SIDEWAYS
    return _tilt((pitch, roll)) if level else {}


def _acceleration(note: object) -> list[float] | None:
    """The three numbers of Apple's maker note; None: it has none, or the phone moved."""
    if not isinstance(note, bytes) or not note.startswith(APPLE):
        return None
    order = "<" if note[12:14] == b"II" else ">"
    try:
        (count,) = struct.unpack_from(order + "H", note, 14)
        for k in range(count):
            tag, kind, many, place = struct.unpack_from(order + "HHII", note, 16 + 12 * k)
            if (tag, kind, many) == (ACCELERATION, 10, 3):
                words = struct.unpack_from(order + "6i", note, place)
                found = [a / b for a, b in zip(words[::2], words[1::2], strict=True)]
                return found if abs(math.hypot(*found) - 1) < STILL else None
    except (struct.error, ZeroDivisionError):
        pass
    return None
