"""Where a moving camera was, as tools tell it: SLAM, networks that see all frames, body trackers.

Each reader gives the arrays of cameras.npz (`io.capture.camera_file`): poses from camera to world,
in OpenCV's axes, in whatever world and scale; and, where it is told, the focal length in widths of
the image, which does not change when a tool looks at smaller images. Tools put the principal point
in the middle, so the image is twice as wide as it. DPVO's rows are x y z and a quaternion x y z w.
"""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mover.geometry.rotations import affine
from mover.io.files.fields import At, refuse
from mover.io.people.values import (
    either,
    need,
    numbers,
    one_number,
    only_file,
    read_any,
    rows,
    stacked,
    whole,
)

Array = NDArray[Any]


def read_vipe(path: Path) -> At:
    """ViPE: pose/NAME.npz (`data`, `inds`), and intrinsics/NAME.npz beside it."""
    folder = path / "pose" if (path / "pose").is_dir() else path
    at = read_any(only_file(folder, "*.npz", "ViPE's poses"))
    T = stacked(need(at, "data"), 4, 4)
    frame = whole(need(at, "inds"), len(T))
    lens = folder.parent / "intrinsics" / at.file if folder.is_dir() else path.parent.parent
    lens = lens if lens.suffix else lens / "intrinsics" / at.file
    focal = None
    if lens.is_file():
        told = need(read_any(lens), "data")
        focal = rows(told, None, 4)
        if len(focal) != len(T):
            refuse(told, f"{len(T)} rows, as there are poses", f"{len(focal)}")
        focal = _in_widths(focal[:, 0], focal[:, 2])
    return _arrays(at, T, frame, focal)


def read_megasam(path: Path) -> At:
    """MegaSaM: NAME_sgd_cvd_hr.npz, or NAME_droid.npz of its first stage."""
    at = read_any(only_file(path, "*_sgd_cvd_hr.npz", "MegaSaM's result"))
    T = stacked(need(at, "cam_c2w"), 4, 4)
    K = rows(need(at, "intrinsic"), None, 9, 3).reshape(-1, 9)
    return _arrays(at, T, None, _in_widths(K[:, 0], K[:, 2]))


def read_tram(path: Path) -> At:
    """TRAM: camera.npy (`pred_cam_R`, `pred_cam_T`: camera to world)."""
    at = read_any(path / "camera.npy" if path.is_dir() else path)
    T = _joined(need(at, "pred_cam_R"), need(at, "pred_cam_T"))
    return _arrays(at, T, None, _told_focal(at))


def read_prompthmr(path: Path) -> At:
    """PromptHMR: `camera_world` of results.pkl (`Rwc`, `Twc`, or the way back)."""
    at = read_any(path / "results.pkl" if path.is_dir() else path)
    world = need(at, "camera_world")
    turn = either(world, "Rwc")
    if turn is None:
        back = _joined(need(world, "Rcw"), need(world, "Tcw"))
        return _arrays(at, np.linalg.inv(back), None, _told_focal(world))
    return _arrays(at, _joined(turn, need(world, "Twc")), None, _told_focal(world))


def read_slam(path: Path) -> At:
    """WHAM's and GVHMR's slam_results: DPVO's rows, or SimpleVO's matrices from world to camera.

    Raises:
        InputError: If it has another shape, or no camera was followed.
    """
    at = read_any(
        only_file(path, "**/slam_results.p*t*", "slam_results.pth of WHAM or .pt of GVHMR")
    )
    value = numbers(at)
    if value.ndim == 3:
        return _arrays(at, np.linalg.inv(stacked(at, 4, 4)), None, None)
    row = rows(at, None, 7)
    if (row[:, :3] == 0).all() and (row[:, 3:] == [1, 0, 0, 0]).all():
        refuse(at, "a camera that was followed (WHAM with its SLAM)", "WHAM's sign for none")
    return _arrays(at, _of_quaternions(row), None, None)


def read_vggt(path: Path) -> At:
    """VGGT: predictions.npz (`extrinsic`: world to camera, `intrinsic`)."""
    return _of_network(path, "predictions.npz", "extrinsic", "intrinsic", inverse=True)


def read_da3(path: Path) -> At:
    """Depth Anything 3: exports/npz/results.npz (`extrinsics`: world to camera, `intrinsics`)."""
    return _of_network(path, "**/results.npz", "extrinsics", "intrinsics", inverse=True)


def read_mapanything(path: Path) -> At:
    """MapAnything: predictions.npz (`extrinsic`: camera to world, `intrinsic`)."""
    return _of_network(path, "predictions.npz", "extrinsic", "intrinsic", inverse=False)


def _of_network(path: Path, pattern: str, pose: str, lens: str, *, inverse: bool) -> At:
    """A network that sees all frames at once: matrices of three or four rows, and lenses."""
    at = read_any(only_file(path, pattern, f"a file with '{pose}'"))
    given = need(at, pose)
    upper = rows(given, None, 12, 16)[:, :12]
    last = np.tile([0.0, 0, 0, 1], (len(upper), 1))
    T = np.concatenate([upper, last], 1).reshape(-1, 4, 4)
    K = rows(need(at, lens), len(T), 9)
    return _arrays(at, np.linalg.inv(T) if inverse else T, None, _in_widths(K[:, 0], K[:, 2]))


def _joined(turn: At, place: At) -> Array:
    R = stacked(turn, 3, 3)
    return affine(R, rows(place, len(R), 3))


def _of_quaternions(row: Array) -> Array:
    from scipy.spatial.transform import Rotation

    return affine(Rotation.from_quat(row[:, 3:]).as_matrix(), row[:, :3])


def _told_focal(at: At) -> Array:
    """`img_focal` and `img_center` of TRAM and PromptHMR."""
    middle = numbers(need(at, "img_center")).reshape(-1)
    return _in_widths(np.array([one_number(need(at, "img_focal"))]), middle[:1])


def _in_widths(focal: Array, middle: Array) -> Array:
    return focal / (2 * middle)


def _arrays(at: At, T: Array, frame: Array | None, focal: Array | None) -> At:
    """The arrays of cameras.npz under the name of the tool's own file."""
    found = {"frame": np.arange(len(T)) if frame is None else frame, "T_world_camera": T}
    if focal is not None:
        found["focal"] = np.broadcast_to(focal, (len(T),)).copy()
    return At(found, at.file)
