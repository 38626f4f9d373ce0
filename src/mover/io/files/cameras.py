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
from mover.core.files import reason
from mover.geometry.camera import tilted
from mover.io.files.fields import LARGEST, At, maybe, number, read_json, refuse
from mover.io.files.schema import Positive, Side, checked

log = logging.getLogger(__name__)

LARGEST_TEXT = 1 << 20  # [bytes], of a calibration
HALF = 0.5  # [px], calibrations count from the centre of the first pixel
GUESSED = 0.055  # error of a focal length's logarithm by a network: 3-8 % (GeoCalib, WildCamera)
WIDEST = 175.0  # [degrees], of a pinhole camera
STRAIGHT = 2.0  # [px], a lens that moves the corners by less is left as it is
MATRICES = (
    "Intrinsics", "camera_matrix", "Camera_Matrix", "cameraMatrix", "intrinsic_matrix",
    "intrinsics", "mtx", "K",
)  # fmt: skip
"""Names of [fx 0 cx; 0 fy cy; 0 0 1] in files of OpenCV, ROS and Open3D, or of fx fy cx cy."""
BENT = (
    "Distortion", "distortion_coefficients", "Distortion_Coefficients", "distCoeffs", "dist_coeffs",
    "dist_coeff", "dist", "coeffs",
)  # fmt: skip
"""Names of k1, k2, p1, p2, k3, ... of OpenCV."""
SIDES = (
    ("w", "width", "image_width", "image_Width"),
    ("h", "height", "image_height", "image_Height"),
)
COLMAP = {
    "SIMPLE_PINHOLE": 3, "PINHOLE": 4, "SIMPLE_RADIAL": 4, "RADIAL": 5, "OPENCV": 8,
    "OPENCV_FISHEYE": 8, "FULL_OPENCV": 12, "FOV": 5, "SIMPLE_RADIAL_FISHEYE": 4,
    "RADIAL_FISHEYE": 5, "THIN_PRISM_FISHEYE": 12,
}  # fmt: skip
"""COLMAP's models in the order of their numbers, and how many numbers each has."""
XML = (
    r"<(?P<a>\w+)[^<>]*>\s*(<(?!data)\w+>[^<]*</\w+>\s*){0,9}<data>(?P<data>[^<]*)"
    r"|<(?P<b>\w+)>(?P<one>[^<]+)</"
)
YAML = r"^(?P<a>\w+):((?!^\w).)*?data:\s*\[(?P<data>[^]]*)|^(?P<b>\w+):\s*\[?(?P<one>[^][\n]+)"
"""Matrices with `data`, and numbers by themselves."""
ONE_FOCAL = ("SIMPLE_PINHOLE", "SIMPLE_RADIAL", "RADIAL")


def read_camera_file(path: Path, size: tuple[int, int] | None) -> At:
    """The camera of a file of any known kind, in the fields of camera.json.

    Known are our own and nerfstudio's .json, 3 x 3 numbers in a text file (cam_K.txt), COLMAP's
    cameras.txt and cameras.bin or their folder, calibrations of OpenCV and ROS (.xml, .yml, .json),
    PROX's `camera_mtx` (whose fits leave out its distortion `k`), .json of RealSense and Open3D,
    MoGe's fov.json, GeoCalib's {"f", "roll", "pitch"} and SAM 3D Body's focal_length.json.

    Args:
        path: Of the file.
        size: Width and height of the image, which most of them lack [px].

    Raises:
        InputError: If the file cannot be understood, the lens is not straight, or the size is
            needed and not known.
    """
    if path.is_dir():
        files = (path / name for name in ("cameras.txt", "cameras.bin", "camera.json"))
        path = next((file for file in files if file.is_file()), path)
    if not path.is_file():
        raise InputError(f"{path}: there is no such file, expected a camera")
    match path.suffix.lower():
        case ".json":
            return camera_of_tree(read_json(path), size)
        case ".xml" | ".yml" | ".yaml":
            tree = _of_text(path)
            given = _named(tree, MATRICES)
            if given is None:
                refuse(tree, f"a matrix of the camera ({', '.join(MATRICES)})", "none")
            return _of_matrix(tree, given, size)
        case _:
            rows = colmap_rows(path)
            if rows:
                return _of_colmap(rows, path.name)
            return with_intrinsics(read_intrinsics(path), size, At(None, path.name), shift=0.0)


def camera_of_tree(at: At, size: tuple[int, int] | None) -> At:
    """The fields of camera.json from a JSON object of any known kind."""
    if maybe(at, "fl_x") is not None:
        return At({"w": size[0], "h": size[1], **at.value} if size else at.value, at.file)
    if (mtx := maybe(at, "camera_mtx")) is not None:
        return with_intrinsics(_checked(_numbers(mtx), mtx), size, mtx, shift=HALF)
    if (given := _named(at, MATRICES)) is not None:
        return _of_matrix(at, given, size)
    found = [(way, one) for way, one in _objects(at) if {"fx", "fy"} <= one.value.keys()]
    if found:  # of several, the colour camera's
        one = next((one for way, one in found if re.search("colou?r|rgb", way, re.I)), found[0][1])
        middle = [_named(one, (f"pp{axis}", f"c{axis}")) for axis in "xy"]
        four = [maybe(one, "fx"), maybe(one, "fy"), *middle]
        if None in four:
            refuse(one, "a lens with fx, fy, ppx, ppy or cx, cy")
        return _of_matrix(one, At([n.value for n in four if n], one.file, one.field), size)
    return _of_lens(at, size)


def _objects(at: At, way: str = "", depth: int = 3) -> Iterator[tuple[str, At]]:
    """An object and those inside it, with their names."""
    if isinstance(at.value, Mapping):
        yield way, at
        for key in at.value if depth else ():
            yield from _objects(At(at.value[key], at.file, str(key)), f"{way} {key}", depth - 1)


def _named(at: At, names: tuple[str, ...]) -> At | None:
    """The first of these fields that is there."""
    return next((found for name in names if (found := maybe(at, name)) is not None), None)


def _numbers(at: At) -> NDArray[np.float64]:
    """The numbers of lists in lists, or of OpenCV's {"data": [...]}, one after another."""
    value: Any = at.value.get("data") if isinstance(at.value, Mapping) else at.value
    flat = np.array(value, dtype=object).ravel()
    return np.array([number(At(one, at.file, at.field)) for one in flat])


def _of_matrix(at: At, given: At, size: tuple[int, int] | None) -> At:
    """A camera from its matrix, and the size and the distortion beside it."""
    sides = [_named(at, names) for names in SIDES]
    if size is None and None not in sides:
        w, h = (checked(At(int(_numbers(s)[0]), s.file, s.field), Side) for s in sides if s)
        size = w, h
    K = _checked(_numbers(given), given)
    bent = _named(at, BENT)
    if bent is not None:
        _check_straight(_numbers(bent), K, size, bent)
    found = with_intrinsics(K, size, given, shift=HALF)
    seen = maybe(at, "CameraMatrix")
    if seen is not None:  # of the authors of MOVER: [R | t] of a world that is y-down
        R = _numbers(seen)
        if R.size != 12:
            refuse(seen, "3 x 4 numbers", f"{R.size}")
        turn = (R.reshape(3, 4)[:, :3] @ np.diag([1.0, -1.0, -1.0])).tolist()
        found = At({**found.value, "R_cam_world": turn}, found.file)
    return found


def _check_straight(
    bent: NDArray[np.float64], K: NDArray[np.float64], size: tuple[int, int] | None, at: At
) -> None:
    """Refuse a lens that moves the corners of the image by more than `STRAIGHT`."""
    if not bent.any():
        return
    k1, k2, p1, p2, k3, *_ = [*bent.tolist(), *[0.0] * 5]
    w, h = size or (2 * K[0, 2], 2 * K[1, 2])
    r = math.hypot(w / 2 / K[0, 0], h / 2 / K[1, 1])
    moved = abs(k1 * r**3 + k2 * r**5 + k3 * r**7) + 3 * (abs(p1) + abs(p2)) * r**2
    if moved * K[0, 0] > STRAIGHT or bent[5:].any():
        far = f"a distortion that moves the corners by {moved * K[0, 0]:.3g} px"
        refuse(at, "a straight lens: undistort the images first", far)
    log.warning("%s: its distortion (%.2g px at the corners) is left out", at.file, moved * K[0, 0])


def with_intrinsics(
    K: NDArray[np.float64], size: tuple[int, int] | None, at: At, *, shift: float
) -> At:
    """The fields of camera.json of a matrix whose principal point lacks a `shift` [px]."""
    w, h = _known(size, at)
    cx, cy = K[0, 2].item() + shift, K[1, 2].item() + shift
    return At({"w": w, "h": h, "fl_x": K[0, 0].item(), "fl_y": K[1, 1].item(), "cx": cx, "cy": cy},
              at.file)  # fmt: skip


def of_view(degrees: float, size: tuple[int, int], file: str) -> At:
    """The camera with this horizontal field of view and the principal point in the middle."""
    focal = _focal(At(degrees, file), size[0])
    return _centred(focal, focal, size, file)


def with_spread(at: At, spread: float) -> At:
    """The fields of camera.json with how far off the focal length may be, of its logarithm."""
    return At({**at.value, "focal_spread": spread}, at.file, at.field)


def guessed_view(degrees: float, size: tuple[int, int]) -> At:
    """The camera of `--fov`: an assumed horizontal angle of view, marked as such."""
    return with_spread(of_view(degrees, size, "--fov"), GUESSED)


def read_intrinsics(path: Path) -> NDArray[np.float64]:
    """The 3 x 3 numbers of a text file [fx 0 cx; 0 fy cy; 0 0 1]."""
    words = [word for line in _text(path).splitlines() for word in _words(line)]
    try:
        numbers = np.array([float(word) for word in words])
    except ValueError as error:
        expected = "3 x 3 numbers, or COLMAP's cameras.txt"
        why = reason(ValueError(f"it is text, {' '.join(words)[:40]!r}"), path)
        raise InputError(f"{path.name}: cannot be read ({why}), expected {expected}") from error
    return _checked(numbers, At(numbers.tolist(), path.name))


def _words(line: str) -> list[str]:
    """The words of a line without its comment."""
    return line.partition("#")[0].replace(",", " ").split()


def tilt_of(pitch: float, roll: float) -> list[list[float]]:
    """R_cam_world of angles [rad]: diag(1, -1, -1) R_z(roll) R_x(-pitch)."""
    return tilted(*torch.tensor([pitch, roll], dtype=torch.float64)).tolist()


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
        refuse(at, "3 x 3 numbers, intrinsics [fx 0 cx; 0 fy cy; 0 0 1]")
    return K


def _known(size: tuple[int, int] | None, at: At) -> tuple[int, int]:
    if size is None:
        refuse(at, "the size of the image beside it: give --image", "no width and height")
    return size


def _of_lens(at: At, size: tuple[int, int] | None) -> At:
    """A camera from a focal length or a field of view, with its tilt where the file has it."""
    tilt: dict[str, Any] = {}
    if (pitch := maybe(at, "pitch")) is not None and (roll := maybe(at, "roll")) is not None:
        tilt["R_cam_world"] = tilt_of(number(pitch, -1.6, 1.6), number(roll, -1.6, 1.6))
    focal = _named(at, ("focal_length", "f", "focal"))
    across, up = maybe(at, "fov_x"), maybe(at, "fov_y")
    if focal is None and across is None:
        known = f"fl_x, fx, camera_mtx, {', '.join(MATRICES)}, focal_length, f or fov_x"
        refuse(at, f"a camera with one of the fields {known}")
    size = _known(size, at)
    if focal is not None:
        fx = fy = checked(focal, Positive)
    else:
        assert across is not None
        fx = _focal(across, size[0])
        fy = fx if up is None else _focal(up, size[1])
    return At({**_centred(fx, fy, size, at.file).value, **tilt}, at.file)


def _focal(at: At, side: int) -> float:
    """The focal length of an angle of view [degrees] along a side [px]."""
    return side / 2 / math.tan(math.radians(number(at, 1, WIDEST)) / 2)


def _centred(fx: float, fy: float, size: tuple[int, int], file: str) -> At:
    w, h = size
    return At({"w": w, "h": h, "fl_x": fx, "fl_y": fy, "cx": w / 2, "cy": h / 2}, file)


# Texts of OpenCV's FileStorage, of ROS and of COLMAP.


def _text(path: Path) -> str:
    """The text of a calibration."""
    try:
        if path.stat().st_size > LARGEST_TEXT:
            raise ValueError("it is too large for a calibration")
        return path.read_text(encoding="utf-8-sig")
    except (OSError, ValueError) as error:
        why = reason(error, path)
        raise InputError(f"{path.name}: cannot be read ({why}), expected a camera") from error


def _of_text(path: Path) -> At:
    """The matrices and numbers of OpenCV's XML or YAML, or of ROS's YAML, by name."""
    text, found = _text(path), dict[str, Any]()
    if "<!ENTITY" in text:
        raise InputError(f"{path.name}: has entities, expected OpenCV's XML")
    for match in re.finditer(XML if path.suffix.lower() == ".xml" else YAML, text, re.M | re.S):
        name, words = match["a"] or match["b"], (match["data"] or match["one"] or "").split()
        words = [word.strip(",") for word in words if word != ","]
        try:
            found[name] = [float(word) for word in words]
        except ValueError:
            if name in (*MATRICES, *BENT):
                refuse(At(" ".join(words), path.name, name), "numbers")
    if not found:
        why = reason(ValueError("it has no numbers with names"), path)
        raise InputError(f"{path.name}: cannot be read ({why}), expected OpenCV's calibration")
    return At(found, path.name)


def colmap_rows(path: Path) -> list[list[str]]:
    """Rows CAMERA_ID MODEL WIDTH HEIGHT PARAMS of COLMAP's cameras.txt or .bin; none of others."""
    if path.suffix.lower() != ".bin":
        rows = [words for line in _text(path).splitlines() if (words := _words(line))]
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
        why = reason(error, path)
        raise InputError(f"{path.name}: cannot be read ({why}), expected cameras.bin") from error
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
        refuse(at, "numbers")
    if len(values) != COLMAP[model]:
        refuse(at, f"{COLMAP[model]} numbers", f"{len(values)}")
    if "FISHEYE" in model or model == "FOV":
        refuse(
            at, "a straight lens: undistort the images (colmap image_undistorter)", "a fisheye's"
        )
    fx, fy, cx, cy, *bent = values[:1] * (model in ONE_FOCAL) + values
    K, size = _checked(np.array([fx, fy, cx, cy]), at), (int(w), int(h))
    _check_straight(np.array(bent), K, size, at)
    return with_intrinsics(K, size, at, shift=0.0)
