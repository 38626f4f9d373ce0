"""One table of the tools that find bodies: a row says where everything lies in their files.

All give SMPL, SMPL-H, SMPL-X or MHR in OpenCV camera axes, but AMASS, whose world has +z up. From
the worlds of the others (+y up) gravity alone is taken. Sources: the writers' own code, as of 2026.
"""

import dataclasses
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from mover.bodies.smpl_model import FLAT
from mover.core.types import BodyPose
from mover.io.capture.pose_file import GENDERS, moved
from mover.io.files.fields import At, get, refuse
from mover.io.people import sources
from mover.io.people.found import Found, Known, joined
from mover.io.people.lens import (
    assumed_lens,
    cameras_of,
    from_crop,
    from_image,
    from_pixels,
    image_lens,
    lens,
    lens_of,
    movement,
    up_of_roots,
)
from mover.io.people.sources import Person
from mover.io.people.values import (
    angles,
    either,
    need,
    numbers,
    one_number,
    rows,
    stacked,
    tensor,
    whole,
)

Names = tuple[str, ...]
Lens = Callable[[Person, int, Known], Tensor | None]
Gravity = Callable[[Person, Tensor, Tensor], tuple[Tensor | None, Names]]
"""Up in the camera for the rows, from their roots and frames; and warnings."""

VERTS = {"smpl": 6890, "smplh": 6890, "smplx": 10475}
JOINTS = {"smpl": (24,), "smplh": (52, 22), "smplx": (55, 25, 22)}
HANDS = {
    "smpl": {}, "smplh": {"left_hand_pose": (66, 111), "right_hand_pose": (111, 156)},
    "smplx": {
        "jaw_pose": (66, 69), "left_hand_pose": (75, 120), "right_hand_pose": (120, 165),
    },
}  # fmt: skip
"""Columns behind the body where all joints are in one field; hands count from the flat hand."""
EXTRA = ("left_hand_pose", "right_hand_pose", "jaw_pose", "expression")
CODE = 32  # numbers of a VPoser code
SHAPES = 10  # coefficients where none are given
FOCAL = 5000.0  # [px], SMPLify-X's default, and of HMR2's crops
CROP = 256.0  # [px], a side of these crops
LEAST_OFFSET = 1e-4  # [m], a plane through the origin has no direction


@dataclass(frozen=True)
class Tool:
    """Where a tool keeps what a body needs; several names of a field are all in use."""

    model: str
    people: Callable[..., list[Person]]
    """Finds the people in the files: their fields, and the fields of the camera."""
    rotations: Names = ()
    """All joints in one field."""
    parts: tuple[Names, Names] = ((), ())
    """The root and the body, where they are two fields."""
    shape: Names = ("betas",)
    widths: tuple[int, ...] = ()
    """Of the shape; empty: any."""
    shapeless: bool = False
    """The shape may be missing."""
    translation: Names | Callable[[At, int, Known], Tensor] = ("transl",)
    camera: Names = ()
    """Rotation and translation from the tool's world into the camera, where bodies lie in it."""
    frames: Names = ()
    verts: Names = ()
    centred: bool = False
    """The vertices lie about the origin of the body."""
    lens: Lens = lambda *_: None
    gravity: Gravity = lambda *_: (None, ())
    rate: Names = ()
    """Frames a second."""
    space: Literal["camera", "world"] = "camera"


def read(path: Path, known: Known, tool: str) -> Found:
    """Bodies that a tool found, as its row of the table says."""
    row = TOOLS[tool]
    return joined([_rows(row, person, known) for person in row.people(path, known)])


def _rows(tool: Tool, person: Person, known: Known) -> Found:
    """The rows of one person."""
    at, model = person.at, person.model or tool.model
    if model == "mhr":
        return _mesh(person, known)
    frames = whole(need(at, *tool.frames)) if tool.frames else None
    turns, extra = _turns(tool, at, model, None if frames is None else len(frames), known)
    count = len(turns)
    if frames is None:
        frames = np.arange(person.frame, person.frame + count)
    body = 72 if model == "smpl" else 66
    given = either(at, *tool.verts)
    verts = None if given is None else tensor(rows(given, count, VERTS[model] * 3))
    verts = None if verts is None else verts.reshape(count, -1, 3)
    place = _translation(tool, at, count, known, given is None)
    shape = (either if tool.shapeless else need)(at, *tool.shape)
    betas = np.zeros((count, SHAPES)) if shape is None else rows(shape, count, *tool.widths)
    pose = BodyPose(
        model=model, gender=known.gender or _gender(at), betas=tensor(betas),
        global_orient=turns[:, :3], body_pose=turns[:, 3:body], transl=place, extra=extra,
    )  # fmt: skip
    if tool.camera:
        pose = _in_camera(pose, at, tool.camera)
    frame = torch.from_numpy(frames)
    up, warnings = tool.gravity(person, turns[:, :3], frame)
    rate = either(at, *tool.rate)
    return Found(
        model, frame, torch.full_like(frame, person.track), pose,
        verts=verts if verts is None or not tool.centred else verts + place[:, None],
        K=tool.lens(person, count, known), up=up, fps=None if rate is None else one_number(rate),
        space=tool.space, warnings=warnings,
    )  # fmt: skip


def _turns(
    tool: Tool, at: At, model: str, count: int | None, known: Known
) -> tuple[Float[Tensor, "rows angles"], dict[str, Tensor]]:
    """Angles of root and body, and those of hands and face."""
    given = either(at, *tool.rotations)
    if given is not None:
        turns = tensor(angles(given, count, *JOINTS[model]))
        inside = {k: (a, b) for k, (a, b) in HANDS[model].items() if turns.shape[1] >= b}
        extra = {name: turns[:, a:b] for name, (a, b) in inside.items()}
        if "left_hand_pose" in extra:
            extra[FLAT] = torch.ones(len(turns), 1)
        return turns, extra
    roots, bodies = tool.parts
    body = need(at, *tool.rotations, *bodies)
    root = tensor(angles(need(at, *roots), count, 1))
    count = len(root)
    codes = numbers(body)
    if codes.ndim and codes.shape[-1] == CODE:
        turned = _decoded(body, rows(body, count), known)
    elif model == "smpl":
        turned = tensor(angles(body, count, 23, 21))
    else:
        turned = tensor(angles(body, count, 21, 23))[:, :63]
    found = {n: tensor(rows(v, count)) for n in EXTRA if (v := either(at, n)) is not None}
    return torch.cat([root, turned], 1), found


def _decoded(at: At, codes: NDArray[np.float64], known: Known) -> Tensor:
    """VPoser's codes as angles, where its weights are known."""
    if known.decode is None:
        refuse(
            at,
            "63 angles: SMPLify-X stored VPoser's code, which its decoder turns into angles "
            "(vposer.decode(body_pose, output_type='aa')); store these instead, or name VPoser's "
            "weights (--vposer)",
            f"{CODE} numbers",
        )
    with torch.no_grad():
        return known.decode(tensor(codes))


def _translation(
    tool: Tool, at: At, count: int, known: Known, needed: bool
) -> Float[Tensor, "rows 3"]:
    """`transl` of each row; NaN where the vertices show it, 0 where the camera has it."""
    if not isinstance(tool.translation, tuple):
        return tool.translation(at, count, known)
    given = either(at, *tool.translation)
    if given is not None:
        return tensor(rows(given, count, 3))
    if needed:
        need(at, *tool.translation, *tool.camera[1:])
    return torch.full((count, 3), 0.0 if tool.camera else torch.nan)


def _in_camera(pose: BodyPose, at: At, names: Names) -> BodyPose:
    count = len(pose.transl)
    turn, shift = (either(at, name) for name in names)
    flat = np.eye(3).reshape(1, 9).repeat(count, 0) if turn is None else rows(turn, count, 9)
    t = np.zeros((count, 3)) if shift is None else rows(shift, count, 3)
    return moved(pose, tensor(flat).reshape(-1, 3, 3), tensor(t))


def _gender(at: At) -> str:
    given = either(at, "gender")
    if given is None:
        return "neutral"
    value: Any = given.value.tolist() if isinstance(given.value, np.ndarray) else given.value
    while isinstance(value, list) and len(value) == 1:
        value = value[0]
    word = value.decode(errors="replace") if isinstance(value, bytes) else str(value)
    if word not in GENDERS:
        refuse(given, "one of " + ", ".join(GENDERS))
    return word


def _mesh(person: Person, known: Known) -> Found:
    """SAM 3D Body: vertices about the origin of the body, whose camera_t is added [m]."""
    at, frame = person.at, torch.tensor([person.frame])
    given, place = need(at, "pred_vertices"), rows(need(at, "pred_cam_t"), 1, 3)
    verts = numbers(given)
    if verts.ndim == 3 and len(verts) == 1:
        verts = verts[0]
    if verts.ndim != 2 or verts.shape[1] != 3 or not len(verts):
        refuse(given, "an array of shape (vertices, 3)", f"shape {verts.shape}")
    who = torch.full_like(frame, person.track)
    K = _lens_of_joints(at, place, known)
    return Found("mhr", frame, who, None, verts=tensor((verts + place)[None]), K=K)


def _lens_of_joints(at: At, place: NDArray[np.float64], known: Known) -> Tensor | None:
    """SAM 3D Body: by joints in space and in the image, else by the focal length."""
    joints, pixels = either(at, "pred_keypoints_3d"), either(at, "pred_keypoints_2d")
    if joints is not None and pixels is not None:
        points = stacked(joints, 3) + place
        image = rows(pixels, len(points), 2)
        if np.isfinite(points).all() and np.isfinite(image).all():
            return lens_of(tensor(points), tensor(image))[None]
    focal = either(at, "focal_length")
    if focal is not None:
        return assumed_lens(dataclasses.replace(known, focal=None), one_number(focal), 1)
    return None if known.focal is None else assumed_lens(known, known.focal, 1)


# What single tools know of their camera.


def _crops(at: At, count: int, known: Known) -> Float[Tensor, "bodies 3"]:
    """PARE and VIBE: the position under the true lens, by joints in the image, else by the crop."""
    assert known.camera is not None
    K, size = known.camera.K.double(), (known.camera.width, known.camera.height)
    joints, pixels = either(at, "joints3d", "smpl_joints3d"), either(at, "smpl_joints2d")
    if joints is not None and pixels is not None:
        points = torch.from_numpy(_in_space(joints, count))
        flat = rows(pixels, count, points.shape[1] * 2, points.shape[1] * 3)
        image = torch.from_numpy(flat.reshape(count, points.shape[1], -1)[..., :2].copy())
        return from_pixels(points, image, K).float()
    crop, box = either(at, "pred_cam"), either(at, "bboxes")
    if crop is not None and box is not None:
        square = torch.from_numpy(rows(box, count, 4)[:, :3].copy())
        return from_crop(torch.from_numpy(rows(crop, count, 3).copy()), square, K).float()
    wanted = ("orig_cam",) if pixels is None else ("orig_cam", "joints3d")
    image = torch.from_numpy(rows(need(at, *wanted), count, 4).copy())
    return from_image(image, K, size).float()


def _in_space(at: At, count: int) -> NDArray[np.float64]:
    """Points of each body [m]."""
    flat = rows(at, count)
    if flat.shape[1] % 3:
        refuse(at, f"points of shape ({count}, n, 3)", f"shape {numbers(at).shape}")
    return flat.reshape(count, -1, 3).copy()


def _lens_of_file(person: Person, count: int, _: Known) -> Tensor | None:
    """GVHMR and SLAHMR: the lens as a matrix or four numbers beside the people."""
    assert person.source is not None
    K, four = either(person.source, "K_fullimg"), either(person.source, "intrins")
    if K is not None:
        return tensor(rows(K, count, 9)).reshape(-1, 3, 3)
    if four is None:
        return None
    fx, fy, cx, cy = stacked(four, 4)[0].tolist()
    return torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]).expand(count, 3, 3)


def _lens_of_camera(person: Person, count: int, _: Known) -> Tensor | None:
    """TRAM's camera.npy, and the camera in PromptHMR's results."""
    at = person.source
    if at is None or either(at, "people") is None:
        return None if at is None else image_lens(at, count)
    camera = either(at, "camera", "camera_world")
    return None if camera is None else image_lens(camera, count)


def _lens_of_size(person: Person, count: int, known: Known) -> Tensor | None:
    """PHALP: crops of 256 px at 5000 px, the image padded to a square."""
    assert person.source is not None
    sizes = either(person.source, "size")
    if sizes is None:
        return assumed_lens(known, lambda *size: FOCAL / CROP * max(size), count)
    pairs = stacked(sizes, 2)
    height, width = pairs[min(person.source.value["row"], len(pairs) - 1)].tolist()
    return lens(known.focal or FOCAL / CROP * max(width, height), width, height).float()[None]


def _up_by_root(person: Person, root: Tensor, _: Tensor) -> tuple[Tensor | None, Names]:
    """WHAM, GVHMR: one body's root in the camera and in a world with +y up."""
    given = either(person.at, "pose_world", "poses_root_world")
    if person.source is not None:
        world = either(person.source, "smpl_params_global", "body_params_global")
        given = None if world is None else need(world, "global_orient")
    if given is None:
        return None, ()
    return up_of_roots(root, tensor(angles(given, len(root), 1, 24)[:, :3])), ()


def _up_by_camera(person: Person, _: Tensor, frame: Tensor) -> tuple[Tensor | None, Names]:
    """PromptHMR and TRAM: the cameras of all frames, in a world with +y up."""
    at = person.source
    world = None if at is None else either(at, "camera_world")
    turn = None if at is None else either(at, "world_cam_R")
    if world is not None:
        R, t = cameras_of(need(world, "Rcw"), need(world, "Tcw"), frame)
        return R[frame][..., 1], movement(R, t)
    if at is not None and turn is not None:
        back, place = cameras_of(turn, need(at, "world_cam_T"), frame)
        warnings = movement(back.mT, -(back.mT @ place[..., None])[..., 0])
        return back[frame, 1], warnings
    return None, ()


def _up_by_floor(person: Person, root: Tensor, _: Tensor) -> tuple[Tensor | None, Names]:
    """SLAHMR: the ground's plane, normal times offset; its sign is that with -y up."""
    assert person.source is not None
    R = tensor(rows(get(person.at, "cam_R"), len(root), 9)).reshape(-1, 3, 3)
    t = tensor(rows(get(person.at, "cam_t"), len(root), 3))
    up, plane = torch.tensor([0.0, -1.0, 0.0]), either(person.source, "floor_plane")
    if plane is not None:
        planes = stacked(plane, 4 if numbers(plane).shape[-1:] == (4,) else 3)[:, :3]
        normal = tensor(planes[min(person.at.value["row"], len(planes) - 1)])
        if normal.isfinite().all() and normal.norm() > LEAST_OFFSET:
            up = normal / normal.norm()
            up = -up if up[1] > 0 else up
    return (R @ up[:, None])[..., 0], movement(R, t)


HMR2 = Tool(
    "smpl", sources.phalp, parts=(("global_orient",), ("body_pose",)), widths=(10,),
    translation=("camera",), lens=_lens_of_size,
)  # fmt: skip
CROPS = Tool(
    "smpl", sources.pare, ("pose", "pred_pose"), shape=("betas", "pred_shape"), widths=(10,),
    translation=_crops, frames=("frame_ids",), verts=("verts", "smpl_vertices"), centred=True,
)  # fmt: skip
GVHMR = Tool(
    "smplx", sources.gvhmr, parts=(("global_orient",), ("body_pose",)), shapeless=True,
    lens=_lens_of_file, gravity=_up_by_root,
)  # fmt: skip
PROX = Tool(
    "smplx", sources.smplifyx, parts=(("global_orient",), ("body_pose",)),
    camera=("camera_rotation", "camera_translation"),
)  # fmt: skip
TOOLS = {
    "4dhumans": HMR2,
    "amass": Tool(
        "smplx", sources.amass, ("poses",), translation=("trans",), camera=("turn", "shift"),
        rate=("mocap_frame_rate", "mocap_framerate"), space="world",
    ),
    "gem": GVHMR,
    "gvhmr": GVHMR,
    "pare": CROPS,
    "phalp": HMR2,
    "prompthmr": Tool(
        "smplx", sources.prompthmr, ("rotmat", "pose"), shape=("shape", "betas"),
        widths=(10, 11, 16), translation=("trans", "transl"), frames=("frames",),
        lens=_lens_of_camera, gravity=_up_by_camera,
    ),
    "prox": PROX,
    "sam3dbody": Tool("mhr", sources.sam3dbody),
    "slahmr": Tool(
        "smplh", sources.slahmr, parts=(("root_orient",), ("pose_body",)), translation=("trans",),
        camera=("cam_R", "cam_t"), frames=("frames",), lens=_lens_of_file, gravity=_up_by_floor,
    ),
    "smplifyx": dataclasses.replace(
        PROX, lens=lambda _, count, known: assumed_lens(known, FOCAL, count)
    ),
    "tram": Tool(
        "smpl", sources.tram, ("pred_rotmat", "pred_pose"), shape=("pred_shape",), widths=(10,),
        translation=("pred_trans",), frames=("frame", "frames"), lens=_lens_of_camera,
        gravity=_up_by_camera,
    ),
    "vibe": CROPS,
    "wham": Tool(
        "smpl", sources.wham, ("pose",), (("poses_root_cam",), ("poses_body",)), widths=(10,),
        translation=("trans", "trans_cam"), frames=("frame_ids", "frame_id", "frames"),
        verts=("verts", "verts_cam"), gravity=_up_by_root,
        lens=lambda _, count, known: assumed_lens(known, math.hypot, count),
    ),
}  # fmt: skip
"""The tools by name; `mover.io.formats` lists them."""
