"""Where a moving camera was, as SLAM and structure from motion write it.

Each reader gives the arrays of cameras.npz (`io.capture.camera_file`): poses from camera to world,
in OpenCV's axes, in whatever world and scale; and, where the file has it, the focal length in
widths of the image, which does not change when a tool looks at smaller images. Tools put the
principal point in the middle, so the image is twice as wide as it.

A tool that assumed another lens put the body where it gives the same pixels under that lens; under
the true one it keeps the pixel of its middle and its size in pixels.
"""

import math
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from mover.core.devices import lstsq
from mover.core.errors import InputError
from mover.core.files import BROKEN, reason, unreadable
from mover.core.types import Camera
from mover.geometry.rotations import affine, axis_angle
from mover.io.files.fields import At, existing
from mover.io.people import values as v
from mover.io.people.found import Known
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


SAME_LENS = 1e-4  # relative difference of focal lengths that is none
TURNED = math.radians(5)  # cameras whose up-vectors spread more are not taken to stand still
TRAVELLED = 0.1  # [m], the same for their positions


def lens(fx: float, fy: float, cx: float, cy: float) -> At:
    """The nine numbers of a pinhole camera [px]."""
    return At(np.array([[fx, 0, cx, 0, fy, cy, 0, 0, 1]]), "the lens")


def assumed_lens(
    known: Known, focal: Callable[[float, float], float], size: Sequence[float] | None = None
) -> At | None:
    """The lens that most tools assume: the principal point is the image's middle.

    The user's focal length goes before the tool's, `focal` of width and height [px]; without a
    `size` [px] that of the user's camera counts, and without either the lens is not known.
    """
    if size is None and known.camera is not None:
        size = known.camera.width, known.camera.height
    if size is None:
        return None
    f = known.focal or focal(*size)
    return lens(f, f, size[0] / 2, size[1] / 2)


def own_lens(given: At | None, known: Known) -> tuple[At | None, tuple[str, ...]]:
    """The lens of the files, else that of the user's focal length, else what to say of it."""
    if given is not None or known.focal is not None or known.camera is None:
        return given or assumed_lens(known, lambda *_: 1.0), ()
    return None, ("has no lens, so the true one is taken for the tool's: --focal gives that [px]",)


def from_weak(crop: Float[Tensor, "bodies 4"], camera: Camera) -> Float[Tensor, "bodies 3"]:
    """Position of bodies by weak perspective of the whole image: s_x, s_y, p, q [m].

    A point (x, y) of the body is at (s_x (x + p), s_y (y + q)) of an image that spans -1 to 1.
    """
    half = torch.tensor([camera.width, camera.height], dtype=torch.float64) / 2
    K, scale = camera.K.double(), crop[:, :2].double()
    pixels = (scale * crop[:, 2:].double() + 1) * half
    f, c = K[[0, 1], [0, 1]], K[:2, 2]
    depth = (f / (scale * half).clamp_min(1e-9)).mean(-1, keepdim=True)
    return torch.cat([(pixels - c) / f * depth, depth], -1).float()


def refocused(
    middle: Float[Tensor, "bodies 3"], used: Float[Tensor, "bodies 3 3"], K: Float[Tensor, "3 3"]
) -> Float[Tensor, "bodies 3"]:
    """Shift that keeps position and size in the image under another lens; 0 under the same."""
    if not (used - K).abs().amax() > SAME_LENS * K[0, 0]:
        return torch.zeros_like(middle)
    pixel = torch.einsum("bij,bj->bi", used, middle)
    pixel = pixel[:, :2] / pixel[:, 2:]
    f, f_used = K[[0, 1], [0, 1]], used[:, [0, 1], [0, 1]]
    depth = middle[:, 2:] * (f / f_used).mean(-1, keepdim=True)
    return torch.cat([(pixel - K[:2, 2]) / f * depth, depth], -1) - middle


def lens_of(points: Float[Tensor, "points 3"], pixels: Float[Tensor, "points 2"]) -> At:
    """The lens that sees these points in camera axes at these pixels, by least squares [px]."""
    rays = (points[:, :2] / points[:, 2:]).double()
    centre = torch.eye(2).double().repeat_interleave(len(rays), 0)  # first all x, then all y
    left = torch.cat([rays.T.reshape(-1, 1), centre], 1)
    f, cx, cy = lstsq(left, pixels.double().T.flatten()).tolist()
    return lens(f, f, cx, cy)


def tilting(
    root_cam: Float[Tensor, "rows 3"], root_world: Float[Tensor, "rows 3"]
) -> tuple[str, ...]:
    """A warning if gravity turns in the camera: by one body's root in it and in a world (+y up).

    The spread is the angle to the normalised median that nine of ten rows keep.
    """
    up = (axis_angle(root_cam.double()) @ axis_angle(root_world.double()).mT)[..., 1]
    up = up[up.isfinite().all(-1)]
    if not len(up):
        return ()
    middle = torch.nn.functional.normalize(up.median(0).values, dim=0)
    spread = float((up @ middle).clamp(-1, 1).acos().quantile(0.9))
    text = f"its gravity turns by {spread:.2f} rad: does the camera move?"
    return (text,) if spread > TURNED else ()


def movement(
    R_cam_world: Float[np.ndarray, "frames 3 3"], t: Float[np.ndarray, "frames 3"]
) -> tuple[str, ...]:
    """A warning if the camera of a tool (x_cam = R x + t) does not stand still."""
    turn = np.trace(R_cam_world @ R_cam_world[0].T, axis1=1, axis2=2)
    angle = float(np.arccos(np.clip((turn - 1) / 2, -1, 1)).max())
    centre = -np.einsum("tji,tj->ti", R_cam_world, t)
    way = float(np.linalg.norm(centre - centre[0], axis=1).max())
    if angle < TURNED and way < TRAVELLED:
        return ()
    path = f"turns by up to {math.degrees(angle):.1f} degrees and travels {way:.2f} m"
    return (f"the camera {path}: give its poses, too (`mover import --cameras`)",)
