"""A fit that starts from the bodies of another tool: which of them is whom, and their poses."""

import math

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mover.bodies.keypoints import LAYOUTS
from mover.bodies.smpl_files import load_smpl
from mover.bodies.transfer import ANGLES, as_smplx, find_matrix, read_matrix
from mover.core.errors import InputError
from mover.core.types import Bodies, BodyPose, Keypoints
from mover.fitting.config import FitConfig
from mover.fitting.energy import Seen
from mover.fitting.start import FitStart, before, unknowns_at, where_seen
from mover.fitting.unknowns import Frame, Rig
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


def begin_from(
    start: Bodies, keypoints: Keypoints, seen: Seen, rig: Rig, config: FitConfig
) -> FitStart:
    """Start from bodies with parameters: their pose, under the true camera.

    SMPL bodies start a fit of SMPL-X by the official matrix where the user has it (the paper's way
    from PARE), else by the angles of the joints that both models have.

    Raises:
        InputError: If they have no parameters, are not in the camera frame, or a person is missing.
    """
    if start.space != "camera":
        raise InputError("bodies to start from: 'space' is 'world', expected 'camera'")
    rows, pose = start_rows(start, keypoints, seen.K), start.pose
    if pose is None or pose.body_pose.shape[1] < ANGLES:
        raise InputError("bodies to start from: have no parameters, expected 'body_pose' ...")
    if (pose.model, rig.model.name) == ("smpl", "smplx"):
        pose = _by_matrix(pose)
    angles = pose.body_pose[rows, :ANGLES].float()
    root = axis_angle(pose.global_orient[rows].float())
    names = [LAYOUTS[keypoints.layout][k] for k in rig.keypoints.tolist()]
    frame = Frame(rig, root, torch.zeros(len(angles), dtype=torch.long))
    at = where_seen(unknowns_at(angles, before(angles)), frame, seen, names)
    return FitStart(at, root, angles, torch.full_like(seen.spread, math.radians(config.near)))


def _by_matrix(pose: BodyPose) -> BodyPose:
    """SMPL-X parameters of SMPL bodies where the official matrix is there."""
    path = find_matrix()
    if path is None:
        return pose
    smpl, smplx = (load_smpl(name, pose.gender) for name in ("smpl", "smplx"))
    return as_smplx(pose, smpl, smplx, read_matrix(path))
