"""Lenses and gravity of other tools: from weak perspective and assumed lenses to the true camera.

A network that sees a square crop of side b [px] about (x, y) estimates the scale s of a body and
its position (p, q) there. Under a camera of focal length f and principal point c the body is at

    t_z = 2 f / (s b),   t_x = p + 2 (x - c_x) / (s b),   t_y = q + 2 (y - c_y) / (s b)

A tool that assumed another lens put the body where it gives the same pixels under that lens; under
the true one it keeps the pixel of its middle and its size in pixels.
"""

import math
from collections.abc import Callable

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mover.core.errors import InputError
from mover.geometry.camera import tilted
from mover.geometry.rotations import axis_angle
from mover.io.files.fields import At
from mover.io.people.found import Known
from mover.io.people.values import need, one_number, rows, stacked, tensor

SAME_LENS = 1e-4  # relative difference of focal lengths that is none
TURNED = math.radians(5)  # cameras whose up-vectors spread more are not taken to stand still
TRAVELLED = 0.1  # [m], the same for their positions


def lens(
    focal: float | Tensor, width: float | Tensor, height: float | Tensor
) -> Float[Tensor, "3 3"]:
    """The lens that most tools assume: the principal point is the image's middle [px]."""
    f, w, h = (float(v) for v in (focal, width, height))
    return torch.tensor([[f, 0, w / 2], [0, f, h / 2], [0, 0, 1]], dtype=torch.float64)


def assumed_lens(
    known: Known, focal: float | Callable[[int, int], float], count: int
) -> Float[Tensor, "rows 3 3"] | None:
    """The lens that a tool assumed; None where the size of the image is not known.

    Args:
        known: The user's focal length goes before the tool's.
        focal: The tool's own, or a function of width and height [px].
        count: Rows.
    """
    if known.camera is None:
        return None
    size = known.camera.width, known.camera.height
    own = focal if isinstance(focal, int | float) else focal(*size)
    return lens(known.focal or own, *size).float().expand(count, 3, 3)


def image_lens(at: At, count: int) -> Float[Tensor, "rows 3 3"]:
    """The lens that a file gives as `img_focal` and `img_center` [px]."""
    focal = one_number(need(at, "img_focal"))
    cx, cy = stacked(need(at, "img_center"), 2)[0].tolist()
    return torch.tensor([[focal, 0, cx], [0, focal, cy], [0, 0, 1]]).expand(count, 3, 3)


def from_crop(
    crop: Float[Tensor, "bodies 3"], box: Float[Tensor, "bodies 3"], K: Float[Tensor, "3 3"]
) -> Float[Tensor, "bodies 3"]:
    """Position of bodies that a network saw in square crops [m].

    Args:
        crop: s, p, q.
        box: Centre x, y and side of the square [px].
        K: The true lens.
    """
    size = (crop[:, 0] * box[:, 2]).clamp_min(1e-9)
    f, c = torch.stack([K[0, 0], K[1, 1]]), K[:2, 2]
    depth = 2 * f.mean() / size
    flat = crop[:, 1:] + (box[:, :2] - c) / f * depth[:, None]
    return torch.cat([flat, depth[:, None]], -1)


def from_image(
    whole: Float[Tensor, "bodies 4"], K: Float[Tensor, "3 3"], size: tuple[int, int]
) -> Float[Tensor, "bodies 3"]:
    """Position of bodies by weak perspective of the whole image: s_x, s_y, p, q [m].

    A point (x, y) of the body is at (s_x (x + p), s_y (y + q)) of an image that spans -1 to 1.
    """
    half = torch.tensor(size, dtype=whole.dtype) / 2
    pixels = (whole[:, :2] * whole[:, 2:] + 1) * half
    f, c = torch.stack([K[0, 0], K[1, 1]]), K[:2, 2]
    depth = (f / (whole[:, :2] * half).clamp_min(1e-9)).mean(-1)
    return torch.cat([(pixels - c) / f * depth[:, None], depth[:, None]], -1)


def from_pixels(
    joints: Float[Tensor, "bodies joints 3"],
    pixels: Float[Tensor, "bodies joints 2"],
    K: Float[Tensor, "3 3"],
) -> Float[Tensor, "bodies 3"]:
    """Position of bodies whose joints are seen at these pixels, by linear least squares [m]."""
    rays = (pixels - K[:2, 2]) / torch.stack([K[0, 0], K[1, 1]])
    one, none = torch.ones_like(rays[..., 0]), torch.zeros_like(rays[..., 0])
    left = torch.stack(
        [torch.stack([one, none, -rays[..., 0]], -1), torch.stack([none, one, -rays[..., 1]], -1)],
        -2,
    ).flatten(1, 2)
    right = (rays * joints[..., 2:] - joints[..., :2]).flatten(1)
    normal = left.mT @ left
    return torch.linalg.solve(normal, (left.mT @ right[..., None])[..., 0])


def refocused(
    middle: Float[Tensor, "bodies 3"], used: Float[Tensor, "bodies 3 3"], K: Float[Tensor, "3 3"]
) -> Float[Tensor, "bodies 3"]:
    """Shift that keeps position and size of bodies in the image under another lens [m]."""
    pixel = torch.einsum("bij,bj->bi", used, middle)
    pixel = pixel[:, :2] / pixel[:, 2:]
    f = torch.stack([K[0, 0], K[1, 1]])
    f_used = torch.stack([used[:, 0, 0], used[:, 1, 1]], -1)
    depth = middle[:, 2] * (f / f_used).mean(-1)
    there = torch.cat([(pixel - K[:2, 2]) / f * depth[:, None], depth[:, None]], -1)
    return there - middle


def differs(used: Float[Tensor, "bodies 3 3"], K: Float[Tensor, "3 3"]) -> bool:
    """Whether the lenses are not the same."""
    return bool((used - K).abs().amax() > SAME_LENS * K[0, 0])


def up_of_roots(
    root_cam: Float[Tensor, "bodies 3"], root_world: Float[Tensor, "bodies 3"]
) -> Float[Tensor, "bodies 3"]:
    """Up in the camera, from one body's root in camera axes and in a world with +y up."""
    R_cam_world = axis_angle(root_cam.double()) @ axis_angle(root_world.double()).mT
    return R_cam_world[..., 1].float()


def mean_up(up: Float[Tensor, "bodies 3"]) -> tuple[Float[Tensor, "3"] | None, float]:
    """The one direction that a camera at rest has, and the spread about it [rad].

    The middle is the normalised median; the spread is the angle that nine of ten keep. None without
    a row that has it.
    """
    known = up[up.isfinite().all(-1) & (up.norm(dim=-1) > 0)].double()
    if not len(known):
        return None, 0.0
    middle = torch.nn.functional.normalize(known.median(0).values, dim=0)
    cosine = torch.nn.functional.normalize(known, dim=-1) @ middle
    spread = cosine.clamp(-1, 1).acos().quantile(0.9)
    return middle.float(), float(spread)


def level(up: Float[Tensor, "3"]) -> Float[Tensor, "3 3"]:
    """R_cam_world of the camera that sees this as up, without heading."""
    x, y, z = (up / up.norm()).unbind()
    return tilted(z.clamp(-1, 1).asin(), torch.atan2(-x, -y))


def movement(
    R_cam_world: Float[Tensor, "frames 3 3"], t: Float[Tensor, "frames 3"]
) -> tuple[str, ...]:
    """A warning if the camera of a tool (x_cam = R x + t) does not stand still."""
    if len(R_cam_world) < 2:
        return ()
    R, shift = R_cam_world.double(), t.double()
    turn = R @ R[:1].mT
    cosine = (turn.diagonal(dim1=-2, dim2=-1).sum(-1) - 1) / 2
    angle = float(cosine.clamp(-1, 1).acos().max())
    centre = -(R.mT @ shift[..., None])[..., 0]
    way = float((centre - centre[0]).norm(dim=-1).max())
    if angle < TURNED and way < TRAVELLED:
        return ()
    path = f"turns by up to {math.degrees(angle):.1f} degrees and travels {way:.2f} m"
    return (f"the camera {path}: give its poses, too (`mover import --cameras`)",)


def cameras_of(
    turn: At, place: At, frame: Int[Tensor, " rows"]
) -> tuple[Float[Tensor, "frames 3 3"], Float[Tensor, "frames 3"]]:
    """Rotations and positions of a camera in all frames of a video.

    Raises:
        InputError: If they have other shapes, or do not reach to the last frame of the bodies.
    """
    R = tensor(stacked(turn, 3, 3))
    last = int(frame.max())
    if last >= len(R):
        named = f"field '{turn.field}' has {len(R)} frames, the bodies name {last}"
        raise InputError(f"{turn.file}: {named}")
    return R, tensor(rows(place, len(R), 3))


def lens_of(
    points: Float[Tensor, "points 3"], pixels: Float[Tensor, "points 2"]
) -> Float[Tensor, "3 3"]:
    """The lens that sees these points in camera axes at these pixels, by least squares [px]."""
    rays = (points[:, :2] / points[:, 2:]).double()
    one, none = torch.ones(len(rays)).double(), torch.zeros(len(rays)).double()
    left = torch.cat(
        [torch.stack([rays[:, 0], one, none], 1), torch.stack([rays[:, 1], none, one], 1)]
    )
    right = pixels.double().T.reshape(-1, 1)
    f, cx, cy = torch.linalg.lstsq(left, right).solution[:, 0].tolist()
    return torch.tensor([[f, 0, cx], [0, f, cy], [0, 0, 1]])
