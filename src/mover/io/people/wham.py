"""WHAM's wham_output.pkl: SMPL in the camera and in a world with +y up, by track.

The names of its command line and of its Python interface differ; both are read. Where the place
is not told (`trans`), the vertices tell it. WHAM takes the image's diagonal for the focal length
where it is not told another.
"""

import math
from pathlib import Path

import torch
from torch import Tensor

from mover.io.files.fields import At
from mover.io.people.found import Found, Known, joined, pose_of
from mover.io.people.lens import assumed_lens, up_of_roots
from mover.io.people.tracks import people_of
from mover.io.people.values import angles, either, frames_of, meshes, need, read_any, rows, tensor

SMPL_VERTS = 6890


def read_wham(path: Path, known: Known) -> Found:
    """Bodies of WHAM.

    Raises:
        InputError: If a key is missing or has the wrong shape.
    """
    at = read_any(path / "wham_output.pkl" if path.is_dir() else path)
    return joined([_person(track, person, known) for person, track in people_of(at)])


def _person(at: At, person: int, known: Known) -> Found:
    frame = frames_of(at, None, "frame_ids", "frame_id", "frames")
    count = len(frame)
    whole, root_world = _angles(at, count)
    verts = either(at, "verts", "verts_cam")
    place = (need if verts is None else either)(at, "trans", "trans_cam")
    betas = rows(need(at, "betas"), count, 10)
    told = None if place is None else rows(place, count, 3)
    return Found(
        model="smpl",
        frame=frame,
        person=torch.full_like(frame, person),
        pose=pose_of("smpl", known.gender, whole, betas, told),
        verts=meshes(verts, SMPL_VERTS, count),
        K=assumed_lens(known, math.hypot, count),
        up=None if root_world is None else up_of_roots(whole[:, :3], root_world),
    )


def _angles(at: At, count: int) -> tuple[Tensor, Tensor | None]:
    """Root and body in the camera, and the root in the world where it is told."""
    given = either(at, "pose")
    if given is not None:
        world = either(at, "pose_world")
        root = None if world is None else tensor(angles(world, count, 24)[:, :3])
        return tensor(angles(given, count, 24)), root
    need(at, "pose", "poses_body")
    root_cam = angles(need(at, "poses_root_cam"), count, 1)
    body = angles(need(at, "poses_body"), count, 23, 21)
    world = either(at, "poses_root_world")
    root = None if world is None else tensor(angles(world, count, 1))
    return torch.cat([tensor(root_cam), tensor(body)], 1), root
