"""Which given body is which person of the keypoints."""

import dataclasses
import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mover.bodies import load_model
from mover.bodies.keypoints import LAYOUTS
from mover.bodies.skeleton import BODY
from mover.bodies.smpl_model import skin_of_model
from mover.bodies.transfer import copy_pose
from mover.core.errors import InputError
from mover.core.types import Bodies, Keypoints
from mover.fitting.config import FitConfig, Stage
from mover.fitting.energy import Seen, Weighed, body_energy
from mover.fitting.limits import resting
from mover.fitting.prior import nearest_rotations, same
from mover.fitting.start import Begun, before, unknowns_at, where_seen
from mover.fitting.tracks import chosen
from mover.fitting.unknowns import Frame, Rig, points_of, solve
from mover.geometry.camera import project
from mover.geometry.rotations import axis_angle

Boxes = dict[int, dict[int, Tensor]]


def start_rows(
    start: Bodies, keypoints: Keypoints, K: Float[Tensor, "3 3"]
) -> Int[Tensor, " rows"]:
    """The row of `start` for each row of the keypoints: the same person, the nearest frame.

    People are paired by where they are in the image.

    Raises:
        InputError: If a person of the keypoints has no body.
    """
    pairs = _pairs(start, keypoints, K)
    found = torch.zeros(len(keypoints.frame), dtype=torch.long)
    for row, (frame, person) in enumerate(
        zip(keypoints.frame.tolist(), keypoints.person.tolist(), strict=True)
    ):
        if person not in pairs:
            raise InputError(
                f"bodies to start from: there is none for person {person} of the keypoints "
                f"(there are tracks {sorted(set(start.person.tolist()))})"
            )
        own = torch.nonzero(start.person == pairs[person])[:, 0]
        found[row] = own[(start.frame[own] - frame).abs().argmin()]
    return found


def _pairs(start: Bodies, keypoints: Keypoints, K: Float[Tensor, "3 3"]) -> dict[int, int]:
    """For each person of the keypoints, the track of the bodies that lies nearest."""
    from scipy.optimize import linear_sum_assignment

    points = start.joints if start.joints is not None else start.verts[:, ::50]
    theirs = _middles(project(points, K.to(points)), start.frame, start.person)
    seen = keypoints.points.where(keypoints.confidence[..., None] > 0, torch.nan)
    ours = _middles(seen, keypoints.frame, keypoints.person)
    people, tracks = sorted(ours), sorted(theirs)
    cost = torch.tensor([[_apart(ours[p], theirs[t]) for t in tracks] for p in people])
    rows, columns = linear_sum_assignment(cost.clamp_max(1e6).numpy())
    return {people[r]: tracks[c] for r, c in zip(rows, columns, strict=True)}


def _middles(
    pixels: Float[Tensor, "rows points 2"],
    frame: Int[Tensor, " rows"],
    person: Int[Tensor, " rows"],
) -> Boxes:
    """Middle of each person in each frame [px]."""
    found: Boxes = {}
    middle = pixels.nanmean(1)
    for row, (f, p) in enumerate(zip(frame.tolist(), person.tolist(), strict=True)):
        found.setdefault(p, {})[f] = middle[row]
    return found


def _apart(ours: dict[int, Tensor], theirs: dict[int, Tensor]) -> float:
    """Mean distance in the frames that both have [px]; large where there is none."""
    shared = [f for f in ours if f in theirs]
    if not shared:
        return 1e6
    far = torch.stack([(ours[f] - theirs[f]).norm() for f in shared])
    return float(far.nan_to_num(1e6).mean())


# Where a fit begins that is given bodies of another tool: their pose, under the true camera.


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
    frame = Frame(rig, root, torch.zeros(len(angles), dtype=torch.long))
    at = where_seen(unknowns_at(angles, before(angles)), frame, seen, names)
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
    at = unknowns_at(angles, middle)
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
    return nearest_rotations(b.mT @ a)
