"""SLAHMR's *_world_results.npz: SMPL-H in a world, with the cameras (x_cam = R x + t).

Its world has the first camera's axes, so that -y is roughly up; the ground's plane, normal times
offset, tells it exactly, up to a sign that -y decides.
"""

import dataclasses
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from ...records import InputError
from ..fields import At, refuse
from .files import natural, read_any
from .found import Found, chosen, found_rows, joined, pose_of_rows
from .gravity import movement
from .known import Known
from .rigid import moved
from .tracks import people_of
from .values import either, need, numbers, one_number, stacked, tensor

LEAST_OFFSET = 1e-4  # [m], a plane through the origin tells no direction
UP = (0.0, -1.0, 0.0)


def read_slahmr(path: Path, known: Known) -> Found:
    """Bodies of SLAHMR, in the cameras of their frames; of a folder the last result.

    Raises:
        InputError: If a key is missing or has the wrong shape.
    """
    if path.is_dir():
        files = sorted(path.rglob("*_world_results.npz"), key=natural)
        if not files:
            raise InputError(f"{path}: has no *_world_results.npz, expected SLAHMR's results")
        path = files[-1]
    at = read_any(path)
    place = numbers(need(at, "trans"))
    if place.ndim != 3 or not place.size:
        raise InputError(f"{at.file}: field 'trans' has shape {place.shape}, expected (B, T, 3)")
    people, frames = place.shape[:2]
    found = [_person(at, who, (people, frames), known) for who in range(people)]
    return joined(_seen(found, path))


def _seen(found: list[Found], path: Path) -> list[Found]:
    """Tracks by their numbers, in the frames where they were seen, as track_info.json tells."""
    for folder in (path.parent, path.parent.parent):
        if (folder / "track_info.json").is_file():
            break
    else:
        return found
    at = need(read_any(folder / "track_info.json"), "tracks")
    named: list[Found] = []
    for track, one in people_of(at):
        index = int(one_number(need(one, "index")))
        mask = numbers(need(one, "vis_mask")).reshape(-1) > 0
        if not 0 <= index < len(found) or len(mask) != len(found[index].frame) or not mask.any():
            continue
        rows_seen = chosen(found[index], torch.from_numpy(mask).nonzero()[:, 0])
        who = torch.full_like(rows_seen.person, track)
        named.append(dataclasses.replace(rows_seen, person=who))
    return named or found


def _of(at: At, who: int, shape: tuple[int, int], width: int) -> Tensor:
    """The rows of one person: told for each frame and person, each frame, or each person."""
    people, frames = shape
    value = numbers(at)
    if value.size == people * frames * width:
        return tensor(value.reshape(people, frames, width)[who])
    if value.size == frames * width:
        return tensor(value.reshape(frames, width))
    if value.size not in (people * width, width):
        refuse(at, f"({people}, {frames}, {width}) numbers", f"shape {value.shape}")
    one = value.reshape(-1, width)
    return tensor(one[min(who, len(one) - 1)][None].repeat(frames, 0))


def _person(at: At, who: int, shape: tuple[int, int], known: Known) -> Found:
    _, frames = shape
    frame = torch.arange(frames)
    root = _of(need(at, "root_orient"), who, shape, 3)
    body = _of(need(at, "pose_body"), who, shape, 63)
    betas = need(at, "betas")
    shapes = stacked(betas, 1).size if numbers(betas).ndim < 2 else numbers(betas).shape[-1]
    parts = {
        "whole": torch.cat([root, body], 1),
        "betas": _of(betas, who, shape, shapes),
        "transl": _of(need(at, "trans"), who, shape, 3),
    }
    pose = pose_of_rows("smplh", known.gender or "neutral", parts, {})
    R, t = _cameras(at, who, shape)
    up = (R @ _up(at, who)[:, None])[..., 0]
    return found_rows(
        "smplh", frame, who, moved(pose, R, t), up=up, K=_lens(at, frames), warnings=movement(R, t)
    )


def _cameras(at: At, who: int, shape: tuple[int, int]) -> tuple[Tensor, Tensor]:
    """World to camera in each frame."""
    turn, place = need(at, "cam_R"), need(at, "cam_t")
    R, t = _of(turn, who, shape, 9), _of(place, who, shape, 3)
    return R.reshape(-1, 3, 3), t


def _up(at: At, who: int) -> Tensor:
    """Away from the ground, in SLAHMR's world."""
    plane = either(at, "floor_plane")
    if plane is not None:
        planes = stacked(plane, 4 if numbers(plane).shape[-1:] == (4,) else 3)[:, :3]
        normal = tensor(planes[min(who, len(planes) - 1)])
        if normal.isfinite().all() and normal.norm() > LEAST_OFFSET:
            normal = normal / normal.norm()
            return -normal if normal[1] > 0 else normal
    return torch.tensor(UP)


def _lens(at: At, frames: int) -> Any:  # noqa: ANN401
    """The lens of its video."""
    given = either(at, "intrins")
    if given is None:
        return None
    fx, fy, cx, cy = stacked(given, 4)[0].tolist()
    return torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]).expand(frames, 3, 3)
