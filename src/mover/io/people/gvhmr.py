"""GVHMR's hmr4d_results.pt and GEM's smpl_params.pt: SMPL-X in the camera and on the ground.

`incam` is in OpenCV camera axes; `global` is in a world with +y up, from which only gravity is
taken: both roots of a frame tell which way is up in its camera.
"""

from pathlib import Path

import torch

from mover.io.files.fields import At
from mover.io.people.found import Found, Known, pose_of
from mover.io.people.lens import up_of_roots
from mover.io.people.values import angles, either, need, read_any, rows, tensor, wide

INCAM = ("smpl_params_incam", "body_params_incam")
GLOBAL = ("smpl_params_global", "body_params_global")
FILES = ("hmr4d_results.pt", "smpl_params.pt")
SHAPES = 10  # coefficients where none are given


def read_gvhmr(path: Path, known: Known) -> Found:
    """Bodies of GVHMR or GEM: one person, a row for each frame of the video.

    Raises:
        InputError: If a key is missing or has the wrong shape.
    """
    inside = [path / name for name in FILES if (path / name).is_file()]
    at = read_any(path if path.is_file() or not inside else inside[0])
    body = need(at, *INCAM)
    whole = _whole(body)
    count = len(whole)
    given, world, K = either(body, "betas"), either(at, *GLOBAL), either(at, "K_fullimg")
    betas = torch.zeros(count, SHAPES) if given is None else wide(given, count)
    place = rows(need(body, "transl"), count, 3)
    return Found(
        model="smplx",
        frame=torch.arange(count),
        person=torch.zeros(count, dtype=torch.long),
        pose=pose_of("smplx", known.gender, whole, betas, place),
        K=None if K is None else tensor(rows(K, count, 9)).reshape(-1, 3, 3),
        up=None if world is None else up_of_roots(whole[:, :3], _whole(world)[:, :3]),
    )


def _whole(at: At) -> torch.Tensor:
    """Root and body angles."""
    body = angles(need(at, "body_pose"), None, 21, 23)[:, :63]
    root = angles(need(at, "global_orient"), len(body), 1)
    return torch.cat([tensor(root), tensor(body)], 1)
