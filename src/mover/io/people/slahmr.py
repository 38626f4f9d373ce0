"""SLAHMR's *_world_results.npz: SMPL-H in a world, with the cameras (x_cam = R x + t).

Its world has the first camera's axes, so that -y is roughly up; the ground's plane, normal times
offset, tells it exactly, up to a sign that -y decides.
"""

import dataclasses
from pathlib import Path

import torch
from torch import Tensor

from mover.core.errors import InputError
from mover.io.files.fields import At, refuse
from mover.io.people.found import Found, Known, chosen, joined, people_rows, shifted
from mover.io.people.lens import movement
from mover.io.people.tracks import people_of
from mover.io.people.values import (
    either,
    files_of,
    need,
    numbers,
    one_number,
    read_any,
    stacked,
    tensor,
)

LEAST_OFFSET = 1e-4  # [m], a plane through the origin tells no direction
UP = (0.0, -1.0, 0.0)


def read_slahmr(path: Path, known: Known) -> Found:
    """Bodies of SLAHMR, in the cameras of their frames; of a folder the last result.

    Raises:
        InputError: If a key is missing or has the wrong shape.
    """
    path = files_of(path, "**/*_world_results.npz", "SLAHMR's results")[-1]
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
    def told(name: str, width: int) -> Tensor:
        return _of(need(at, name), who, shape, width)

    betas = numbers(need(at, "betas"))
    shapes = betas.size if betas.ndim < 2 else betas.shape[-1]
    whole = torch.cat([told("root_orient", 3), told("pose_body", 63)], 1)
    R, t = told("cam_R", 9).reshape(-1, 3, 3), told("cam_t", 3)
    rows = whole, told("betas", shapes), told("trans", 3)
    found = people_rows(
        known, "smplh", torch.arange(shape[1]), who, rows,
        K=_lens(at, shape[1]), up=(R @ _up(at, who)[:, None])[..., 0], warnings=movement(R, t),
    )  # fmt: skip
    return shifted(found, R, t)


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


def _lens(at: At, frames: int) -> Tensor | None:
    given = either(at, "intrins")
    if given is None:
        return None
    fx, fy, cx, cy = stacked(given, 4)[0].tolist()
    return torch.tensor([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]).expand(frames, 3, 3)
