"""Methods that follow people through a video: GVHMR and GEM, PromptHMR, TRAM, WHAM.

All give SMPL or SMPL-X in OpenCV camera axes, and a world with +y up, from which only gravity is
taken. GVHMR, GEM and WHAM tell a body's root in both: together they say which way is up in the
camera. PromptHMR's world turns into the camera; TRAM's `world_cam_R` turns the camera into the
world. The hands of PromptHMR count from the flat hand. WHAM's command line and Python interface
name things differently (both are read); where the place is not told (`trans`), the vertices tell
it; it takes the image's diagonal for the focal length where it is not told another.
"""

import dataclasses
import math
from pathlib import Path

import torch
from torch import Tensor

from mover.bodies.smpl_model import FLAT
from mover.io.files.fields import At
from mover.io.people.found import Found, Known, joined, people_of, people_rows
from mover.io.people.lens import assumed_lens, cameras_of, movement, told_lens, up_of_roots
from mover.io.people.values import (
    angles,
    either,
    files_of,
    frames_of,
    meshes,
    need,
    read_any,
    rows,
    tensor,
    wide,
)

INCAM = ("smpl_params_incam", "body_params_incam")
GLOBAL = ("smpl_params_global", "body_params_global")
FILES = ("hmr4d_results.pt", "smpl_params.pt")
SHAPES = 10  # coefficients where none are given
SMPL_VERTS = 6890
BODY = 66  # angles of root and body
EXTRA = {
    "jaw_pose": slice(66, 69), "left_hand_pose": slice(75, 120), "right_hand_pose": slice(120, 165),
}  # fmt: skip
"""Columns of PromptHMR's angles behind them."""


def read_gvhmr(path: Path, known: Known) -> Found:
    """Bodies of GVHMR or GEM: one person, a row for each frame of the video."""
    inside = [path / name for name in FILES if (path / name).is_file()]
    at = read_any(path if path.is_file() or not inside else inside[0])
    body = need(at, *INCAM)
    whole = _root_and_body(body)
    count = len(whole)
    given, world, K = either(body, "betas"), either(at, *GLOBAL), either(at, "K_fullimg")
    betas = torch.zeros(count, SHAPES) if given is None else wide(given, count)
    place = rows(need(body, "transl"), count, 3)
    return people_rows(
        known, "smplx", torch.arange(count), 0, (whole, betas, place),
        K=None if K is None else tensor(rows(K, count, 9)).reshape(-1, 3, 3),
        up=None if world is None else up_of_roots(whole[:, :3], _root_and_body(world)[:, :3]),
    )  # fmt: skip


def _root_and_body(at: At) -> Tensor:
    body = angles(need(at, "body_pose"), None, 21, 23)[:, :63]
    root = angles(need(at, "global_orient"), len(body), 1)
    return torch.cat([tensor(root), tensor(body)], 1)


def read_prompthmr(path: Path, known: Known) -> Found:
    """Bodies of PromptHMR."""
    at = read_any(path / "results.pkl" if path.is_dir() else path)
    people = people_of(need(at, "people"))
    return joined([_of_prompthmr(one, person, at, known) for person, one in people])


def _of_prompthmr(at: At, person: int, source: At, known: Known) -> Found:
    body = need(at, "smplx_cam")
    turns = tensor(angles(need(body, "rotmat", "pose"), None, 55, 25, 22))
    count = len(turns)
    frame = frames_of(at, count, "frames")
    betas = rows(need(body, "shape", "betas"), count, 10, 11, 16)
    place = rows(need(body, "trans", "transl"), count, 3)
    extra = {k: turns[:, part] for k, part in EXTRA.items() if turns.shape[1] >= part.stop}
    if "left_hand_pose" in extra:
        extra[FLAT] = torch.ones(count, 1)
    seen, world = either(source, "camera", "camera_world"), either(source, "camera_world")
    found = people_rows(
        known, "smplx", frame, person, (turns[:, :BODY], betas, place), extra,
        K=None if seen is None else told_lens(seen, count),
    )  # fmt: skip
    if world is None:
        return found
    R, t = cameras_of(need(world, "Rcw"), need(world, "Tcw"), frame)
    return dataclasses.replace(found, up=R[frame][..., 1], warnings=movement(R, t))


def read_tram(path: Path, known: Known) -> Found:
    """Bodies of TRAM: a folder with camera.npy and hps/hps_track_<k>.npy.

    Raises:
        InputError: If a file or key is missing or has the wrong shape.
    """
    tracks = files_of(path, "hps/hps_track_*.npy", "TRAM's results")
    camera = (path if path.is_dir() else path.parent.parent) / "camera.npy"
    at = read_any(camera) if camera.is_file() else None
    return joined([_of_tram(read_any(f), k, at, known) for k, f in enumerate(tracks)])


def _of_tram(at: At, person: int, camera: At | None, known: Known) -> Found:
    whole = angles(need(at, "pred_rotmat", "pred_pose"), None, 24)
    count = len(whole)
    frame = frames_of(at, count, "frame", "frames")
    betas, place = (rows(need(at, f"pred_{k}"), count, n) for k, n in (("shape", 10), ("trans", 3)))
    found = people_rows(
        known, "smpl", frame, person, (whole, betas, place),
        K=None if camera is None else told_lens(camera, count),
    )  # fmt: skip
    turn = None if camera is None else either(camera, "world_cam_R")
    if camera is None or turn is None:
        return found
    R, t = cameras_of(turn, need(camera, "world_cam_T"), frame)
    warnings = movement(R.mT, -(R.mT @ t[..., None])[..., 0])
    return dataclasses.replace(found, up=R[frame, 1], warnings=warnings)


def read_wham(path: Path, known: Known) -> Found:
    """Bodies of WHAM."""
    at = read_any(path / "wham_output.pkl" if path.is_dir() else path)
    return joined([_of_wham(track, person, known) for person, track in people_of(at)])


def _of_wham(at: At, person: int, known: Known) -> Found:
    frame = frames_of(at, None, "frame_ids", "frame_id", "frames")
    count = len(frame)
    whole, root_world = _wham_angles(at, count)
    verts = either(at, "verts", "verts_cam")
    place = (need if verts is None else either)(at, "trans", "trans_cam")
    betas = rows(need(at, "betas"), count, 10)
    told = None if place is None else rows(place, count, 3)
    return people_rows(
        known, "smpl", frame, person, (whole, betas, told),
        verts=meshes(verts, SMPL_VERTS, count),
        K=assumed_lens(known, math.hypot, count),
        up=None if root_world is None else up_of_roots(whole[:, :3], root_world),
    )  # fmt: skip


def _wham_angles(at: At, count: int) -> tuple[Tensor, Tensor | None]:
    """Root and body in the camera, and the root in the world where it is told."""
    given = either(at, "pose")
    if given is not None:
        whole, world, joints = tensor(angles(given, count, 24)), either(at, "pose_world"), 24
    else:
        need(at, "pose", "poses_body")
        root_cam = angles(need(at, "poses_root_cam"), count, 1)
        body = angles(need(at, "poses_body"), count, 23, 21)
        whole = torch.cat([tensor(root_cam), tensor(body)], 1)
        world, joints = either(at, "poses_root_world"), 1
    return whole, None if world is None else tensor(angles(world, count, joints)[:, :3])
