"""Where a fit begins that is given bodies of another tool: their pose, under the true camera."""

import dataclasses
import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..bodies import load_model
from ..bodies.keypoints import LAYOUTS
from ..bodies.skeleton import BODY
from ..bodies.smpl_model import skin_of_model
from ..bodies.transfer import copy_pose
from ..geometry.rotations import axis_angle
from ..records import InputError
from ..types import Bodies, Keypoints
from .config import FitConfig, Stage
from .energy import Seen, Weighed, body_energy
from .limits import resting
from .pairing import start_rows
from .prior import same
from .rig import Rig
from .solve import solve
from .start import BEFORE, Begun, chosen, placed, torso_first, unknowns_at
from .unknowns import Frame, place_of, points_of

TRUNK = ("pelvis", "left_hip", "right_hip", "neck", "left_shoulder", "right_shoulder")
LIFTED = Stage(pose=1.0, shape=100.0, smooth=0.0, steps=60)


def begin_from(
    start: Bodies, keypoints: Keypoints, seen: Seen, rig: Rig, config: FitConfig
) -> Begun:
    """Start from bodies with parameters of any model, or with joints.

    Raises:
        InputError: If they have neither, are not in the camera frame, or somebody is missing.
    """
    if start.space != "camera":
        raise InputError("bodies to start from: 'space' is 'world', expected 'camera'")
    rows = start_rows(start, keypoints, seen.K)
    if start.pose is not None:
        angles, root = _angles_of(start, rows, rig)
        return _placed(angles, root, seen, rig, (keypoints, config))
    names = start.joint_names
    if start.joints is None or not all(name in names for name in TRUNK):
        raise InputError(
            "bodies to start from: have neither parameters nor joints, expected 'body_pose' ... "
            f"or 'joints' with {', '.join(TRUNK)}"
        )
    return _lifted(start, rows, keypoints, seen, rig, config)


def _angles_of(
    start: Bodies, rows: Int[Tensor, " rows"], rig: Rig
) -> tuple[Float[Tensor, "rows angles"], Float[Tensor, "rows 3 3"]]:
    """Angles of the body in the fitted model, and the rotation of the root."""
    pose = start.pose
    assert pose is not None
    if pose.model != rig.model.name:
        source = load_model(pose.model, pose.gender)
        assert skin_of_model(source) is not None
        target = load_model(rig.model.name)
        pose = copy_pose(pose, source, target)  # pyright: ignore[reportArgumentType]
    return pose.body_pose[rows, :63].float(), axis_angle(pose.global_orient[rows].float())


def _placed(
    angles: Float[Tensor, "rows angles"],
    root: Float[Tensor, "rows 3 3"],
    seen: Seen,
    rig: Rig,
    by: tuple[Keypoints, FitConfig],
) -> Begun:
    """Bodies in these poses where the camera sees them."""
    names = [LAYOUTS[by[0].layout][k] for k in rig.keypoints.tolist()]
    before = angles.new_tensor([[0, 0, BEFORE]]).expand(len(angles), -1)
    at = unknowns_at(angles, before, (1, 1))
    frame = Frame(rig, root, torch.zeros(len(angles), dtype=torch.long))
    found = points_of(at, frame, same).keypoints - before[:, None]
    pelvis = placed(found, seen.pixels, torso_first(seen.weight, names), seen.K)
    at = dataclasses.replace(at, place=place_of(pelvis))
    return Begun(at, root, angles, torch.full_like(seen.spread, math.radians(by[1].near)))


def _lifted(
    start: Bodies,
    rows: Int[Tensor, " rows"],
    keypoints: Keypoints,
    seen: Seen,
    rig: Rig,
    config: FitConfig,
) -> Begun:
    """Bodies whose joints are known in 3D, up to their place."""
    assert start.joints is not None
    index = [start.joint_names.index(n) if n in start.joint_names else -1 for n in BODY]
    known = torch.tensor([k >= 0 for k in index])
    given = start.joints[rows][:, [max(k, 0) for k in index]].float()
    given = torch.where(known[:, None], given, torch.nan)
    angles = resting(len(rows), given)
    person = torch.zeros(len(rows), dtype=torch.long)
    eye = torch.eye(3).to(given).expand(len(rows), -1, -1)
    middle = given[:, 0]
    at = unknowns_at(angles, middle, (1, 1))
    with torch.no_grad():
        own = points_of(at, Frame(rig, eye, person), same).joints[:, : len(BODY)]
    root = _trunk_turn(own, given)
    blind = dataclasses.replace(
        chosen(seen, torch.arange(len(rows))), weight=torch.zeros_like(seen.weight), joints=given
    )
    by = Weighed(LIFTED, dataclasses.replace(config, limits=1.0), same, learned=False)
    frame = Frame(rig, root, person)
    at = solve(
        lambda u: body_energy(u, frame, blind, by), at, LIFTED.steps, ("turn", "code", "place")
    )
    return _placed(at.code, axis_angle(at.turn) @ root, seen, rig, (keypoints, config))


def _trunk_turn(
    own: Float[Tensor, "rows joints 3"], given: Float[Tensor, "rows joints 3"]
) -> Float[Tensor, "rows 3 3"]:
    """The rotation that lays one trunk onto the other (Kabsch)."""
    index = [BODY.index(name) for name in TRUNK]
    a, b = own[:, index] - own[:, :1], given[:, index] - given[:, :1]
    u, _, vt = torch.linalg.svd(b.mT @ a)
    flip = torch.ones_like(u[:, 0])
    flip = torch.cat([flip[:, :2], torch.linalg.det(u @ vt)[:, None]], -1)
    return (u * flip[:, None]) @ vt
