"""The camera of camera.json and scene.json, and where a moving one was (cameras.npz)."""

import dataclasses
from typing import Annotated, Any

import numpy as np
import torch
from msgspec import Meta, Struct, to_builtins
from numpy.typing import NDArray

from mover.core.types import STILL, Bodies, Camera, CameraPath, Tilt
from mover.geometry.camera import heading, pitch_roll
from mover.geometry.rotations import affine, rot_y
from mover.io.files.fields import LAST_INDEX, At, Warn, plain
from mover.io.files.schema import Number, Positive, Rows, Share, Side, checked, rotation

LARGEST_AREA = 1 << 27  # [px²]; the overlay of a larger one takes more than 6 GB
DISTORTION = ("k1", "k2", "k3", "k4", "k5", "k6", "p1", "p2")
STEEPEST = 1.4  # [rad], beyond it a camera has no heading to speak of
NO_TURN = 1e-6  # [rad]
LEVEL = torch.diag(torch.tensor([1.0, -1.0, -1.0]))


class CameraFields(Struct, frozen=True, omit_defaults=True):
    """camera.json, and `camera` of scene.json; lengths in pixels, the height above the floor [m].

    The spread of the focal length is the standard deviation of its logarithm; `focal_by_lines`
    says that the lines of the reference picture are in it, so that they do not count again. That
    of the tilt [rad] says that pitch and roll were measured, and how well.
    """

    w: Side
    h: Side
    fl_x: Positive
    fl_y: Positive
    cx: Number
    cy: Number
    R_cam_world: Rows | None = None
    height: Annotated[float, Meta(ge=0.1, le=20)] | None = None
    focal_spread: Share | None = None
    focal_by_lines: bool = False
    tilt_spread: Annotated[float, Meta(ge=1e-4, le=0.5)] | None = None


def camera_of(at: At, other: Camera | None = None) -> Camera:
    """The camera of a JSON object, with its rotation as given (its heading is kept).

    Args:
        at: The object.
        other: Its rotation is taken where `at` has none; without it the camera is level.
    """
    if at.maybe("w") is None and at.maybe("objects") is not None:
        at.refuse("a camera with 'w' and 'h'", "a scene (is it scene.json?)")
    lens = checked(at, CameraFields)
    if lens.w * lens.h > LARGEST_AREA:
        found = f"{lens.w} x {lens.h}"
        at.get("w").refuse(f"at most {LARGEST_AREA} pixels: scale image, masks and lens", found)
    for key in DISTORTION:
        given = at.maybe(key)
        if given is not None and checked(given, Number) != 0:
            given.refuse("an image without distortion (0): undistort the images first")
    K = torch.tensor([[lens.fl_x, 0.0, lens.cx], [0.0, lens.fl_y, lens.cy], [0.0, 0.0, 1.0]])
    if lens.R_cam_world is not None:
        turn = torch.from_numpy(rotation(at.get("R_cam_world")).astype(np.float32))
    else:
        turn = LEVEL if other is None else other.R_cam_world
    return Camera(K, turn, lens.w, lens.h)


def measured_tilt(at: At) -> Tilt | None:
    """The tilt of a JSON object that says how well it was measured; else None."""
    spread = checked(at, CameraFields).tilt_spread
    if spread is None:
        return None
    if at.maybe("R_cam_world") is None:
        at.get("tilt_spread").refuse("'R_cam_world' beside it, which it is the spread of", "none")
    pitch, roll = (float(angle) for angle in pitch_roll(camera_of(at).R_cam_world.double()))
    return Tilt(pitch, roll, spread)


def turned(camera: Camera) -> tuple[Camera, float]:
    """The camera in the world without heading, and the angle that turns the world so [rad]."""
    R = camera.R_cam_world.double()
    angle = heading(R)
    if abs(angle) < NO_TURN:
        return camera, 0.0
    R_new = R @ rot_y(torch.tensor(angle, dtype=R.dtype)).mT
    return dataclasses.replace(camera, R_cam_world=R_new.to(camera.R_cam_world)), angle


def check_attitude(camera: Camera, place: str, warn: Warn) -> None:
    """Warn of a camera that stands on its head or looks straight up or down."""
    pitch, roll = (float(v) for v in pitch_roll(camera.R_cam_world))
    if abs(pitch) > STEEPEST:
        warn(f"{place}: the camera looks straight up or down (pitch {pitch:.2f} rad)")
    elif abs(roll) > STEEPEST:
        axes = "x_cam = R_cam_world @ x_world, world +y up, camera x right, y down, z forward"
        warn(f"{place}: the camera is turned on its side or head (roll {roll:.2f} rad); {axes}")


def camera_to_json(camera: Camera, **more: Any) -> dict[str, Any]:  # noqa: ANN401
    """The JSON object of a camera; `more` are the other fields of `CameraFields`."""
    K, R, size = plain(camera.K), plain(camera.R_cam_world), (camera.width, camera.height)
    return to_builtins(CameraFields(*size, K[0][0], K[1][1], K[0][2], K[1][2], R, **more))


# cameras.npz: where a moving camera was in the frames, in any world and any scale.


RIGID = 1e-2  # a matrix that is off by more is no rotation
ZOOM = 0.05  # of the focal length: more is another lens
NEXT = 5  # frames between two bodies whose motion is compared
LESS = 0.25  # of the squared motion of people: other poses are meant
STILL_POSES = 1e-9  # poses that differ by less are one


def path_of(at: At, camera: Camera, bodies: Bodies | None, warn: Warn) -> CameraPath:
    """The path of named arrays, in the axes of the reference image's camera.

    Args:
        at: `frame`, `T_world_camera`; optional `reference` (the frame that the reference image
            shows, else the first) and `focal` (focal lengths in widths of the image).
        camera: Of the reference image.
        bodies: People whose frames must have a pose.
        warn: Takes what is odd.

    Raises:
        InputError: If a field is wrong, a body's frame lies outside, or the lens zooms.
    """
    frame = at.get("frame").array(("N",), "whole")
    if not len(frame) or (np.diff(frame) <= 0).any() or frame[0] < 0 or frame[-1] > LAST_INDEX:
        at.get("frame").refuse(f"rising frames from 0 to {LAST_INDEX}")
    T = _poses(at.get("T_world_camera"), len(frame))
    _check_lens(at, len(frame), camera, warn)
    given, first = at.maybe("reference"), 0
    if given is not None:
        number = int(given.array((), "whole"))
        if number not in frame:
            given.refuse("a frame that has a pose", f"{number}")
        first = int(np.flatnonzero(frame == number)[0])
    for end in () if bodies is None else (int(bodies.frame.min()), int(bodies.frame.max())):
        if not frame[0] <= end <= frame[-1]:
            reach = f"frames {frame[0]} to {frame[-1]}"
            at.get("frame").refuse(f"poses for all bodies, also for frame {end}", reach)
    relative = np.linalg.inv(T[first]) @ T
    if bodies is not None and bodies.space == "camera" and (odd := _other_poses(T, frame, bodies)):
        warn(f"{at.file}: people move far less under other poses; {odd}?")
    if np.abs(relative - np.eye(4)).max() < STILL_POSES:
        return STILL
    R, t = (
        torch.from_numpy(x.astype(np.float32)) for x in (relative[:, :3, :3], relative[:, :3, 3])
    )
    return CameraPath(torch.from_numpy(frame.astype(np.int64)), R, t)


def _other_poses(T: NDArray[np.float64], frame: NDArray[np.int64], bodies: Bodies) -> str:
    """In which other axes the poses seem to be: in those people hardly move from frame to frame."""
    order = torch.argsort(bodies.person * (LAST_INDEX + 1) + bodies.frame).numpy()
    row = np.searchsorted(frame, bodies.frame.numpy()[order]).clip(max=len(frame) - 1)
    place = bodies.verts.mean(1).double().numpy()[order]
    near = np.diff(bodies.person.numpy()[order]) == 0
    near &= np.abs(np.diff(bodies.frame.numpy()[order])) <= NEXT
    flip = np.diag([1.0, -1, -1, 1])
    ways = {"": T, "are they from world to camera": np.linalg.inv(T),
            "are they those of OpenGL (y up, z backward)": T @ flip,
            "are they from world to camera, in OpenGL's axes": np.linalg.inv(flip @ T)}  # fmt: skip
    moves: dict[str, float] = {}
    for name, poses in ways.items():
        turned = np.diff((poses[row, :3, :3] @ place[..., None])[..., 0], axis=0)[near]
        way = np.diff(poses[row, :3, 3], axis=0)[near]
        scale = max(0.0, -(turned * way).sum() / max((way * way).sum(), 1e-12))
        moves[name] = float(np.square(turned + scale * way).sum())
    best = min(moves, key=moves.__getitem__)
    return best if moves[best] < LESS * moves[""] else ""


def _poses(at: At, count: int) -> NDArray[np.float64]:
    """Rigid poses, exactly so."""
    T = at.array((count, 4, 4)).astype(np.float64)
    u, size, v = np.linalg.svd(T[:, :3, :3])
    bad = (np.abs(size - 1) > RIGID).any(1) | (np.linalg.det(T[:, :3, :3]) < 0)
    bad |= np.abs(T[:, 3] - [0, 0, 0, 1]).max(1) > RIGID
    if bad.any():
        which = int(np.argmax(bad))
        at.refuse(
            "poses of rotation and translation, last row 0 0 0 1",
            f"one that is not rigid at [{which}]",
        )
    T[:, :3, :3], T[:, 3] = u @ v, [0, 0, 0, 1]
    return T


def _check_lens(at: At, count: int, camera: Camera, warn: Warn) -> None:
    """One lens sees all frames and the reference image."""
    given = at.maybe("focal")
    if given is None:
        return
    focal = given.array((count,)).astype(np.float64)
    if focal.min() <= 0 or focal.max() / focal.min() > 1 + ZOOM:
        found = f"{focal.min():.3g} to {focal.max():.3g}"
        given.refuse("one focal length above 0 for all frames (no zoom)", found)
    own, usual = float(camera.K[0, 0]) / camera.width, float(np.median(focal))
    if abs(usual / own - 1) > ZOOM:
        warn(
            f"{at.file}: its focal length is {usual:.3g} widths of the image, that of camera.json"
            f" {own:.3g}: people's depths fit camera.json"
        )


def path_to_arrays(path: CameraPath) -> dict[str, NDArray[Any]]:
    """The arrays of a file; its world is that of the reference image's camera."""
    T = affine(path.R_reference_camera.numpy(), path.t_reference_camera.numpy())
    at_home = np.abs(T - np.eye(4)).max((1, 2))
    reference = path.frame.numpy()[int(at_home.argmin())]
    return {"frame": path.frame.numpy(), "T_world_camera": T, "reference": np.array(reference)}
