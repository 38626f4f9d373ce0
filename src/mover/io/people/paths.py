"""Where a moving camera was, as SLAM and structure from motion write it.

Each reader gives the arrays of cameras.npz (`io.capture.camera_file`): poses from camera to world,
in OpenCV's axes, in whatever world and scale; and, where the file has it, the focal length in
widths of the image, which does not change when a tool looks at smaller images. Tools put the
principal point in the middle, so the image is twice as wide as it.
"""

import re
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mover.core.errors import InputError
from mover.core.files import reason, unreadable
from mover.core.records import BROKEN
from mover.geometry.rotations import affine
from mover.io.files.fields import At, existing
from mover.io.people import values as v
from mover.io.people.values import need

Array = NDArray[Any]


def read_vipe(path: Path) -> At:
    """ViPE: pose/NAME.npz (`data`, `inds`), and intrinsics/NAME.npz beside it."""
    folder = path / "pose" if (path / "pose").is_dir() else path
    file = v.only_file(folder, "ViPE's poses", "*.npz")
    at, lens = v.read_any(file), file.parent.parent / "intrinsics" / file.name
    focal = _focal(need(v.read_any(lens), "data"), 4) if lens.is_file() else None
    return _arrays(at.file, v.stacked(need(at, "data"), 4, 4), v.whole(need(at, "inds")), focal)


def read_megasam(path: Path) -> At:
    """MegaSaM: NAME_sgd_cvd_hr.npz, or NAME_droid.npz of its first stage."""
    at = v.read_one(path, "MegaSaM's result", "*_sgd_cvd_hr.npz")
    T = v.stacked(need(at, "cam_c2w"), 4, 4)
    return _arrays(at.file, T, focal=_focal(need(at, "intrinsic"), 9))


def read_vggt(path: Path) -> At:
    """VGGT: predictions.npz with `extrinsic` (N, 3, 4), world to camera, and `intrinsic`."""
    at = v.read_one(path, "VGGT's predictions", "*.npz")
    given = v.stacked(need(at, "extrinsic"), 3, 4)
    T = np.linalg.inv(affine(given[:, :, :3], given[:, :, 3]))
    return _arrays(at.file, T, focal=_focal(need(at, "intrinsic"), 9))


def _focal(at: At, count: int) -> Array:
    """Focal lengths in widths of the image, of matrices (9 numbers) or of fx, fy, cx, cy (4)."""
    lenses = v.stacked(at, count)
    return lenses[:, 0] / (2 * lenses[:, 2])


def read_slam(path: Path) -> At:
    """WHAM's and GVHMR's slam_results: DPVO's rows, or SimpleVO's matrices from world to camera.

    DPVO's rows are x y z and a quaternion x y z w.

    Raises:
        InputError: If it has another shape, or no camera was followed.
    """
    what = "slam_results.pth of WHAM or .pt of GVHMR"
    at = v.read_one(path, what, "**/slam_results.p*t*")
    value = v.numbers(at)
    if value.ndim == 3:
        return _arrays(at.file, np.linalg.inv(v.stacked(at, 4, 4)))
    row = v.rows(at, None, 7)
    if (row[:, :3] == 0).all() and (row[:, 3:] == [1, 0, 0, 0]).all():
        at.refuse("a camera that was followed (WHAM with its SLAM)", "WHAM's sign for none")
    return _arrays(at.file, affine(_turns(row[:, 3:], at.file), row[:, :3]))


def read_tum(path: Path) -> At:
    """A trajectory in TUM's format, `time x y z qx qy qz qw` a line, the time as frame number.

    The writer is evo's `write_tum_trajectory_file` (github.com/MichaelGrupp/evo), which DPVO uses.

    Raises:
        InputError: If a line has another form, or the times are seconds.
    """
    file = v.only_file(path, "a trajectory in TUM's format", "*.txt")
    table = _table([line for _, line in _lines(file)], file.name, 8)
    frame = table[:, 0]
    if (frame != np.round(frame)).any():
        odd = float(frame[frame != np.round(frame)][0])
        At(odd, file.name, "time").refuse("numbers of frames in place of seconds", f"{odd:g}")
    T = affine(_turns(table[:, 4:], file.name), table[:, 1:4])
    return _arrays(file.name, T, frame.astype(np.int64))


def read_colmap(path: Path) -> At:
    """COLMAP's text model: images.txt (world to camera), and the lens of cameras.txt beside it.

    The last number in a picture's name is its frame (colmap.github.io/format.html).

    Raises:
        InputError: If a line has another form, or two pictures are one frame.
    """
    file = path / "images.txt" if path.is_dir() else path
    if file.suffix == ".bin" or (not file.exists() and file.with_suffix(".bin").exists()):
        cure = "`colmap model_converter --output_type TXT` writes images.txt"
        raise InputError(f"{file.with_suffix('.bin').name}: is COLMAP's binary model; {cure}")
    # Each picture has two lines, the second, of its points, may be empty.
    known = [line.split(maxsplit=9) for number, line in _lines(file) if number % 2 == 0]
    names = {str(Path(row[9]).with_suffix("")): row for row in known if len(row) == 10}
    if len(names) < len(known) or not known:
        form = "IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, each picture once"
        At(len(known), file.name).refuse(form)
    numbered = v.frame_numbers(names, file.name)
    order = sorted(names, key=numbered.__getitem__)
    table = _table([" ".join(names[name][1:9]) for name in order], file.name, 8)
    T = np.linalg.inv(affine(_turns(np.roll(table[:, :4], -1, 1), file.name), table[:, 4:7]))
    frame, focal = np.array([numbered[name] for name in order]), None
    cameras = file.parent / "cameras.txt"
    if cameras.is_file():
        lenses = {words[0]: words for words in (line.split() for _, line in _lines(cameras))}
        used = [" ".join(lenses.get(names[name][8], [])[2:5]) for name in order]
        widths = _table(used, cameras.name, 3)
        focal = widths[:, 2] / widths[:, 0]
    return _arrays(file.name, T, frame, focal)


def _lines(file: Path) -> list[tuple[int, str]]:
    """The lines of a text file without comments, numbered."""
    try:
        text = existing(file).read_text(encoding="utf-8-sig")
    except BROKEN as error:
        raise unreadable(file, error, "text") from error
    lines = [line for line in text.splitlines() if not re.match(r"\s*#", line)]
    return [(number, line) for number, line in enumerate(lines) if line.strip()]


def _table(lines: list[str], name: str, width: int) -> NDArray[np.float64]:
    """So many finite numbers a line."""
    try:
        table = np.array([[float(word) for word in line.split()] for line in lines])
    except ValueError as error:
        raise InputError(f"{name}: has a line with another form ({reason(error)})") from error
    if table.ndim != 2 or table.shape[1] != width or not np.isfinite(table).all():
        At(table, name).refuse(f"lines of {width} finite numbers", f"shape {table.shape}")
    return table


def _turns(quaternions: Array, name: str) -> NDArray[np.float64]:
    """Rotations of quaternions x y z w."""
    from scipy.spatial.transform import Rotation

    if not np.abs(np.linalg.norm(quaternions, axis=1) - 1).max() < 0.01:
        At(quaternions, name).refuse("quaternions of length 1", "others")
    return Rotation.from_quat(quaternions).as_matrix()


def _arrays(name: str, T: Array, frame: Array | None = None, focal: Array | None = None) -> At:
    """The arrays of cameras.npz under the name of the tool's own file; by default of all frames."""
    found = {"frame": np.arange(len(T)) if frame is None else frame, "T_world_camera": T}
    if focal is not None:
        found["focal"] = np.repeat(focal, len(T)) if len(focal) == 1 else focal
    return At(found, name)
