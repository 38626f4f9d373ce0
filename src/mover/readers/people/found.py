"""What a tool found: rows of people in camera axes, before faces, lens and gaps are settled."""

import dataclasses
from collections.abc import Mapping, Sequence

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ...records import InputError, record
from ...types import BodyPose

ROOT = 3  # angles of the root
UNKNOWN = torch.full((1, 3), torch.nan)
"""A place that a tool does not tell, but its vertices."""


@record
class Found:
    """People in the camera axes of each frame; a row may hold NaN where the tool failed."""

    model: str
    """Whose vertices: smpl, smplh, smplx or mhr."""
    frame: Int[Tensor, " bodies"]
    person: Int[Tensor, " bodies"]
    pose: BodyPose | None
    verts: Float[Tensor, "bodies verts 3"] | None
    """[m]."""
    joints: Float[Tensor, "bodies joints 3"] | None
    """As the model places them [m]."""
    pelvis: Float[Tensor, "bodies 3"] | None
    """Place of the pelvis where the tool tells it instead of `pose.transl` [m]."""
    K: Float[Tensor, "bodies 3 3"] | None
    """The lens that the tool assumed [px]."""
    up: Float[Tensor, "bodies 3"] | None
    """Away from the ground, where the tool knows gravity."""
    fps: float | None
    warnings: tuple[str, ...]


def found_rows(
    model: str, frame: Tensor, person: Tensor | int, pose: BodyPose | None, **more: object
) -> Found:
    """Rows of what was found; what is not given is not known."""
    rest: dict[str, object] = {
        "verts": None, "joints": None, "pelvis": None, "K": None, "up": None, "fps": None,
        "warnings": (),
    }  # fmt: skip
    who = torch.full_like(frame, person) if isinstance(person, int) else person
    values: dict[str, object] = {"model": model, "frame": frame, "person": who, "pose": pose}
    return Found(**(values | rest | more))  # pyright: ignore[reportArgumentType]


def pose_of_rows(
    model: str, gender: str, parts: Mapping[str, Tensor], extra: Mapping[str, Tensor]
) -> BodyPose:
    """Parameters from `whole` (root and body angles), `betas` and `transl`."""
    whole = parts["whole"]
    return BodyPose(
        model=model,
        gender=gender,
        betas=parts["betas"],
        global_orient=whole[:, :ROOT],
        body_pose=whole[:, ROOT:],
        transl=parts["transl"],
        extra=dict(extra),
    )


def joined(parts: Sequence[Found]) -> Found:
    """Rows of several people or frames together; all are of one tool.

    Raises:
        InputError: If their meshes have different numbers of vertices.
    """
    first = parts[0]
    sizes = sorted({part.verts.shape[1] for part in parts if part.verts is not None})
    if len(sizes) > 1:
        found = f"meshes of {' and of '.join(map(str, sizes))} vertices"
        raise InputError(f"the files hold {found}, expected one topology")
    if len(parts) == 1:
        return first
    values = {name: [getattr(part, name) for part in parts] for name in _TENSORS}
    whole = {
        name: None if any(v is None for v in each) else torch.cat(each)
        for name, each in values.items()
    }
    poses = [part.pose for part in parts if part.pose is not None]
    pose = _joined_poses(poses) if len(poses) == len(parts) else None
    warnings = tuple(dict.fromkeys(w for part in parts for w in part.warnings))
    return dataclasses.replace(first, **whole, pose=pose, warnings=warnings)


def _joined_poses(poses: Sequence[BodyPose]) -> BodyPose:
    """Parameters of several; shapes are filled up with zeros."""
    width = max(pose.betas.shape[1] for pose in poses)
    betas = [torch.nn.functional.pad(p.betas, (0, width - p.betas.shape[1])) for p in poses]
    names = set.intersection(*(set(pose.extra) for pose in poses))
    names = {n for n in names if len({p.extra[n].shape[1] for p in poses}) == 1}
    return dataclasses.replace(
        poses[0],
        betas=torch.cat(betas),
        **{name: torch.cat([getattr(p, name) for p in poses]) for name in _POSE},
        extra={name: torch.cat([p.extra[name] for p in poses]) for name in sorted(names)},
    )


def chosen(found: Found, index: Int[Tensor, " rows"]) -> Found:
    """Some rows."""
    values = {name: getattr(found, name) for name in _TENSORS}
    picked = {name: None if v is None else v[index] for name, v in values.items()}
    pose = None if found.pose is None else chosen_pose(found.pose, index)
    return dataclasses.replace(found, **picked, pose=pose)


def chosen_pose(pose: BodyPose, index: Int[Tensor, " rows"]) -> BodyPose:
    """Some rows of parameters."""
    extra = {name: value[index] for name, value in pose.extra.items()}
    values = {name: getattr(pose, name)[index] for name in ("betas", *_POSE)}
    return dataclasses.replace(pose, **values, extra=extra)


_TENSORS = ("frame", "person", "verts", "joints", "pelvis", "K", "up")
_POSE = ("global_orient", "body_pose", "transl")
