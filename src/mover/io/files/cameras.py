"""Cameras as calibration tools write them, turned into the fields of camera.json."""

import math
import warnings
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import torch
from numpy.typing import NDArray

from mover.core.errors import InputError
from mover.geometry.camera import tilted
from mover.io.files.fields import (
    At,
    array,
    items,
    maybe,
    number,
    read_json,
    reason,
    refuse,
    vector,
)
from mover.io.files.schema import Positive, checked

LARGEST_TEXT = 1 << 20  # [bytes], of a calibration
HALF = 0.5  # [px], calibrations count from the centre of the first pixel
GUESSED = 0.055  # error of a focal length's logarithm by a network: 3-8 % (GeoCalib, WildCamera)
WIDEST = 175.0  # [degrees], of a pinhole camera


def read_camera_file(path: Path, size: tuple[int, int] | None) -> At:
    """The camera of a file of any known kind, in the fields of camera.json.

    Known are our own and nerfstudio's .json, 3 x 3 numbers in a text file (cam_K.txt), OpenCV's
    .json with `camera_mtx` (PROX, whose fits leave out its distortion `k`) and .xml with
    `Intrinsics`, MoGe's fov.json, GeoCalib's {"f", "roll", "pitch"} and
    SAM 3D Body's focal_length.json.

    Args:
        path: Of the file.
        size: Width and height of the image, which most of them lack [px].

    Raises:
        InputError: If the file cannot be understood, or the size is needed and not known.
    """
    if not path.is_file():
        raise InputError(f"{path}: there is no such file, expected a camera")
    match path.suffix.lower():
        case ".json":
            return camera_of_tree(read_json(path), size)
        case ".xml":
            return _of_opencv(path, size)
        case _:
            at = At(None, path.name)
            return with_intrinsics(read_intrinsics(path), size, at, shift=0.0)


def camera_of_tree(at: At, size: tuple[int, int] | None) -> At:
    """The fields of camera.json from a JSON object of any known kind."""
    if maybe(at, "fl_x") is not None:
        return At({"w": size[0], "h": size[1], **at.value} if size else at.value, at.file)
    if (mtx := maybe(at, "camera_mtx")) is not None:
        K = _checked(np.array([vector(row, 3) for row in items(mtx, 3)]), mtx)
        return with_intrinsics(K, size, mtx, shift=HALF)
    return _of_lens(at, _known(size, at))


def with_intrinsics(
    K: NDArray[np.float64], size: tuple[int, int] | None, at: At, *, shift: float
) -> At:
    """The fields of camera.json of a matrix whose principal point lacks a `shift` [px]."""
    w, h = _known(size, at)
    cx, cy = K[0, 2].item() + shift, K[1, 2].item() + shift
    return At({"w": w, "h": h, "fl_x": K[0, 0].item(), "fl_y": K[1, 1].item(), "cx": cx, "cy": cy},
              at.file)  # fmt: skip


def of_view(degrees: float, size: tuple[int, int], file: str) -> At:
    """The camera with this horizontal field of view and the principal point in the middle.

    Raises:
        InputError: If the angle is not that of a pinhole camera.
    """
    focal = _focal(At(degrees, file), size[0])
    return _centred(focal, focal, size, file)


def with_spread(at: At, spread: float) -> At:
    """The fields of camera.json with how far off the focal length may be, of its logarithm."""
    return At({**at.value, "focal_spread": spread}, at.file, at.field)


def guessed_view(degrees: float, size: tuple[int, int]) -> At:
    """The camera of `--fov`: an assumed horizontal angle of view, marked as such.

    Raises:
        InputError: If the angle is not that of a pinhole camera.
    """
    return with_spread(of_view(degrees, size, "--fov"), GUESSED)


def read_intrinsics(path: Path) -> NDArray[np.float64]:
    """The 3 x 3 numbers of a text file [fx 0 cx; 0 fy cy; 0 0 1]."""
    try:
        if path.stat().st_size > LARGEST_TEXT:
            raise ValueError("the file is too large")
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that an empty file is empty: its shape is refused
            K = np.atleast_2d(np.loadtxt(path, dtype=np.float64))
    except (OSError, ValueError) as error:
        raise InputError(
            f"{path.name}: cannot be read ({reason(error)}), expected 3 x 3 numbers"
        ) from error
    return _checked(array(At(K, path.name), (3, 3)), At(K.tolist(), path.name))


def tilt_of(pitch: float, roll: float) -> list[list[float]]:
    """R_cam_world of angles [rad]: diag(1, -1, -1) R_z(roll) R_x(-pitch)."""
    return tilted(*torch.tensor([pitch, roll], dtype=torch.float64)).tolist()


def _checked(K: NDArray[np.float64], at: At) -> NDArray[np.float64]:
    if [K[0, 1], K[1, 0], *K[2]] != [0, 0, 0, 0, 1] or K[0, 0] <= 0 or K[1, 1] <= 0:
        refuse(at, "intrinsics [fx 0 cx; 0 fy cy; 0 0 1]")
    return K


def _known(size: tuple[int, int] | None, at: At) -> tuple[int, int]:
    if size is None:
        refuse(at, "the size of the image beside it: give --image", "no width and height")
    return size


def _of_lens(at: At, size: tuple[int, int]) -> At:
    """A camera from a focal length or a field of view, with its tilt where the file has it."""
    tilt: dict[str, Any] = {}
    if (pitch := maybe(at, "pitch")) is not None and (roll := maybe(at, "roll")) is not None:
        tilt["R_cam_world"] = tilt_of(number(pitch, -1.6, 1.6), number(roll, -1.6, 1.6))
    focal = next((f for k in ("focal_length", "f", "focal") if (f := maybe(at, k))), None)
    across, up = maybe(at, "fov_x"), maybe(at, "fov_y")
    if focal is not None:
        fx = fy = checked(focal, Positive)
    elif across is not None:
        fx = _focal(across, size[0])
        fy = fx if up is None else _focal(up, size[1])
    else:
        known = "fl_x, camera_mtx, focal_length, f or fov_x"
        refuse(at, f"a camera with one of the fields {known}")
    return At({**_centred(fx, fy, size, at.file).value, **tilt}, at.file)


def _focal(at: At, side: int) -> float:
    """The focal length of an angle of view [degrees] along a side [px]."""
    return side / 2 / math.tan(math.radians(number(at, 1, WIDEST)) / 2)


def _centred(fx: float, fy: float, size: tuple[int, int], file: str) -> At:
    w, h = size
    return At({"w": w, "h": h, "fl_x": fx, "fl_y": fy, "cx": w / 2, "cy": h / 2}, file)


def _of_opencv(path: Path, size: tuple[int, int] | None) -> At:
    """OpenCV's FileStorage: `Intrinsics`, and in `CameraMatrix` [R | 0] of world and camera."""
    try:
        content = path.read_bytes()[: LARGEST_TEXT + 1]
        if len(content) > LARGEST_TEXT or b"<!DOCTYPE" in content or b"<!ENTITY" in content:
            raise ValueError("the file is too large or has entities")  # which could be bombs
        tree = ElementTree.fromstring(content)
    except (OSError, ValueError, ElementTree.ParseError) as error:
        raise InputError(
            f"{path.name}: cannot be read ({reason(error)}), expected OpenCV's XML"
        ) from error
    K = _checked(_of_node(tree, path, "Intrinsics", (3, 3)), At(None, path.name, "Intrinsics"))
    if tree.find("Distortion") is not None and _of_node(tree, path, "Distortion", None).any():
        refuse(At(None, path.name, "Distortion"), "zeros: undistort the images first", "a lens's")
    found = with_intrinsics(K, size, At(None, path.name), shift=HALF).value
    if tree.find("CameraMatrix") is not None:
        R = _of_node(tree, path, "CameraMatrix", (3, 4))[:, :3]
        found["R_cam_world"] = (R @ np.diag([1.0, -1.0, -1.0])).tolist()  # their world is y-down
    return At(found, path.name)


def _of_node(
    tree: ElementTree.Element, path: Path, name: str, shape: tuple[int, int] | None
) -> NDArray[np.float64]:
    at = At(None, path.name, name)
    node = tree.find(name)
    data = None if node is None else node.find("data")
    try:
        values = np.array((data.text or "").split() if data is not None else [], dtype=np.float64)
        values = values if shape is None else values.reshape(shape)
    except ValueError:
        return refuse(at, f"{shape} numbers", "something else")
    return array(At(values, path.name, name), values.shape)
