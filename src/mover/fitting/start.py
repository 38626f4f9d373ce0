"""Where a fit begins: orientation, posture and place of each body from its keypoints alone.

Each row is tried upright and facing the camera, turned left, right and away, standing and sitting;
the direction of the observed trunk gives the tilt in the image; and lying on its back. The
place follows from the torso by linear least squares under the true camera. All are fitted without
shape for a few steps, and along a track the cheapest sequence is kept whose bodies move as bodies
can. Rows that are not upright then are tried lying on either side and on the belly, too.

Seen along the body, a lying person looks nearly the same from the feet as from the head (depths
reversed about the pelvis), so that single frames lay a body the wrong way round. But lying people
do not turn end for end: the majority of each stretch of lying decides the direction, and hypotheses
against it are excluded.

Where another tool found bodies, a fit starts from their poses instead.
"""

import dataclasses
import math
from collections.abc import Mapping, Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.bodies.skeleton import BODY
from mover.bodies.smpl_files import ANGLES, as_smplx, find_matrix, load_smpl, read_matrix
from mover.core.errors import InputError
from mover.core.observe import Energy
from mover.core.records import record, rows_of, with_rows
from mover.core.types import Bodies, BodyPose, Camera, Keypoints, rows_by_person
from mover.energy.body_terms import robust_square
from mover.fitting import FitConfig, Stage
from mover.fitting.energy import LIES, NEIGHBOURS, SITS, FitState, Seen, trunk_of
from mover.fitting.priors import HIPS, KNEES, resting, spreads
from mover.fitting.tracks import best_path, every_so_often
from mover.fitting.unknowns import Frame, Rig, Unknowns, place_of, points_of, solve
from mover.geometry.camera import project
from mover.geometry.rotations import axis_angle, rot_x, rot_y, rot_z

YAWS = (0.0, 0.5 * math.pi, math.pi, 1.5 * math.pi)
BACK, OTHERS = (0.0,), (0.5 * math.pi, -0.5 * math.pi, math.pi)
"""Roll of a lying person: on the back, on either side and on the belly [rad]."""
STANDING = {"hip": (0, -10.0), "knee": (0, 15.0), "elbow": (1, -25.0)}
"""Axes and left angles [degrees] of an upright person, between quiet standing (nearly straight) and
the mean of a gait cycle (hips 10, knees 20; Perry, Burnfield: Gait Analysis, 2010)."""
SEATED = {"hip": (0, -80.0), "knee": (0, 85.0)}
"""Of a seated person."""
LEGS = math.radians(18)  # by which hips and knees differ from both, as over a gait cycle
ARMS = ("shoulder",)
"""Hang by their weight where the trunk is upright; those of lying people may be anywhere."""
TORSO = ("left_shoulder", "right_shoulder", "left_hip", "right_hip")
START = Stage(pose=12.0, shape=5.0, smooth=0.0)
NEAR = math.radians(15)  # how far each angle may be from that of a body to start from
JUMP = 0.25  # [m], joints about the pelvis between rows of a track that hypotheses explain
REACH, SPEED = 0.3, 1.5  # [m], [m/s], how far a hypothesis misplaces a pelvis, how fast it moves
SWITCH = 10.0  # weight of such a move, in squared standard deviations of the pose
BEFORE = 3.5  # [m], depth of a body that its keypoints do not constrain
NEAREST, FARTHEST = 0.4, 40.0  # [m]
START_FPS = 6.0  # hypotheses are tried so many times a second
STRAIN = 4.0  # largest cost of a jump, so that a track may start again
NEVER = 1e4  # what a hypothesis costs that cannot be
LEVEL, SLOPE = math.radians(5), math.radians(15)
"""Standard deviation of a lying body's slope, and the slope at half of the largest cost [rad]."""

Track = tuple[Int[Tensor, " _"], Float[Tensor, " _"] | None]
"""Rows of a person in the order of time, and their times [s]; None: unknown."""


@record
class FitStart:
    """Where all rows begin."""

    at: Unknowns
    root: Float[Tensor, "bodies 3 3"]
    centre: Float[Tensor, "bodies 63"]  #: the pose that is expected [rad]
    spread: Float[Tensor, "bodies 63"]  #: how far from it each angle may be [rad]


@record
class Guess:
    """A hypothesis that is tried for every row."""

    pose: Float[Tensor, "63"]  #: angles of the body [rad]
    spread: Float[Tensor, "63"]  #: how far from them each may be [rad]
    root: Float[Tensor, "3 3"]  #: the root's rotation in the world
    upright: bool  #: tilted in the image as the trunk is seen there


@record
class Tried(FitStart):
    """A hypothesis that was fitted to rows."""

    cost: Float[Tensor, " bodies"]
    joints: Float[Tensor, "bodies joints 3"]  #: of the body, in camera axes [m]


def upright_guesses(like: Tensor) -> list[Guess]:
    """Standing and sitting people who face four ways."""
    turns, usual = rot_y(torch.tensor(YAWS).to(like)).unbind(0), spreads(1, like)[0].clone()
    usual[[*HIPS, *KNEES]] = LEGS
    poses = [_posed(angles, like) for angles in (STANDING, SEATED)]
    return [Guess(pose, usual, turn, True) for pose in poses for turn in turns]


def _posed(angles: Mapping[str, tuple[int, float]], like: Tensor) -> Float[Tensor, "63"]:
    """A resting body with some joints turned symmetrically on both sides."""
    pose = resting(1, like)[0]
    for name, (axis, angle) in angles.items():
        for side, sign in (("left", 1.0), ("right", -1.0 if axis else 1.0)):
            pose[3 * (BODY.index(f"{side}_{name}") - 1) + axis] = sign * math.radians(angle)
    return pose


def lying_guesses(like: Tensor, rolls: tuple[float, ...]) -> list[Guess]:
    """People lying with the head in four directions, rolled as far."""
    pose, spread = resting(1, like)[0], spreads(1, like, ARMS)[0]
    turns = rot_y(torch.tensor(YAWS).to(like)).unbind(0)
    back = rot_x(torch.tensor(-0.5 * math.pi).to(like))
    sides = [rot_z(torch.tensor(angle).to(like)) @ back for angle in rolls]
    return [Guess(pose, spread, turn @ side, False) for side in sides for turn in turns]


def before(pose: Float[Tensor, "bodies code"]) -> Unknowns:
    """Bodies in this pose before the camera, all of one person's usual shape."""
    none, pelvis = pose.new_zeros(len(pose), 0), pose.new_tensor([[0, 0, BEFORE]])
    place = place_of(pelvis.expand(len(pose), -1))
    return Unknowns(torch.zeros_like(place), pose, place, pose.new_zeros(1, 1), none, none)


def where_seen(at: Unknowns, frame: Frame, seen: Seen) -> Unknowns:
    """Bodies that are `before` the camera, put where it sees their keypoints."""
    origin = points_of(at, frame).keypoints - at.code.new_tensor([0, 0, BEFORE])
    torso = torch.tensor([n in TORSO for n in frame.rig.names], device=origin.device)
    enough = ((seen.weight > 0) & torso).sum(1, keepdim=True) >= 3
    weight = torch.where(enough & ~torso, 0.2 * seen.weight, seen.weight)
    pelvis = placed(origin, seen.pixels, weight, seen.K)
    return dataclasses.replace(at, place=place_of(pelvis))


def placed(
    points: Float[Tensor, "bodies keypoints 3"],
    pixels: Float[Tensor, "bodies keypoints 2"],
    weight: Float[Tensor, "bodies keypoints"],
    K: Float[Tensor, "3 3"],
) -> Float[Tensor, "bodies 3"]:
    """Where the origin of points must be for them to be seen at these pixels [m].

    Linear least squares under the true camera: what turns weak perspective into perspective.
    """
    rays = (pixels - K[:2, 2]) / torch.stack([K[0, 0], K[1, 1]])
    left = torch.cat([torch.eye(2).to(rays).expand(*rays.shape, 2), -rays[..., None]], -1)
    right = rays * points[..., 2:] - points[..., :2]
    left, right = left * weight[..., None, None], right * weight[..., None]
    left, right = left.flatten(1, 2).double(), right.flatten(1).double()
    faint = 1e-6 * torch.eye(3).to(left)
    goal = (left.mT @ right[..., None])[..., 0] + 1e-6 * BEFORE * faint.new_tensor([0, 0, 1.0])
    place = torch.linalg.solve(left.mT @ left + faint, goal).to(points)
    depth = place[:, 2]
    good = (depth > NEAREST) & (depth < FARTHEST) & place.isfinite().all(-1)
    seen = (rays * weight[..., None]).sum(1) / weight.sum(1).clamp_min(1e-9)[:, None]
    ahead = torch.cat([seen, torch.ones_like(seen[:, :1])], -1) * BEFORE
    return torch.where(good[:, None], place, ahead)


def tilt_of(
    points: Float[Tensor, "bodies keypoints 3"], seen: Seen, names: tuple[str, ...]
) -> Float[Tensor, " bodies"]:
    """Angle in the image from the trunk of a hypothesis to the one that is seen [rad]."""
    weight, angles = (seen.weight > 0).to(points), list[Tensor]()
    there = torch.ones(len(points), dtype=torch.bool, device=points.device)
    for place in (points[..., :2], seen.pixels):
        ends: list[Tensor] = []
        for part in ("shoulder", "hip"):
            index = [k for k, name in enumerate(names) if name.endswith(part)]
            share = weight[:, index]
            there = there & (share.sum(1) > 0)
            total = (place[:, index] * share[..., None]).sum(1)
            ends.append(total / share.sum(1, keepdim=True).clamp_min(1e-9))
        x, y = (ends[0] - ends[1]).unbind(-1)
        angles.append(torch.atan2(y, x))
    return torch.where(there, angles[1] - angles[0], 0.0)


def begin(
    keypoints: Keypoints, seen: Seen, rig: Rig, camera: Camera, config: FitConfig
) -> FitStart:
    """Start from keypoints alone: the best of all hypotheses, row by row and along each track."""
    fps, like = keypoints.fps, seen.pixels
    step = 1 if fps is None else max(1, round(fps / START_FPS))
    rows, nearest = every_so_often(keypoints.frame, keypoints.person, step)
    R = camera.R_cam_world.to(like)
    tracks = [
        (track, None if fps is None else keypoints.frame[rows][track] / fps)
        for track in rows_by_person(keypoints.frame[rows], keypoints.person[rows])
    ]

    def tried(guess: Guess, rows: Int[Tensor, " some"]) -> Tried:
        some = dataclasses.replace(rows_of(seen, rows, "bodies"), motion=None)
        return _tried(guess, some, R, rig, config)

    tries = [tried(g, rows) for g in (*upright_guesses(like), *lying_guesses(like, BACK))]
    best = _followed(tries, tracks, seen.up)
    trunks = torch.stack([trunk_of(one.joints) for one in tries])
    lies = trunks[best, torch.arange(len(best))] @ seen.up <= SITS
    for track, time in tracks:
        if time is not None:  # and the rows shortly before and after
            near = (time[:, None] - time).abs() <= NEIGHBOURS
            lies[track] = (near & lies[track]).any(1)
    down = lies.nonzero()[:, 0]
    if len(down):
        for guess in lying_guesses(like, OTHERS):  # no other row may take these
            none = dataclasses.replace(tries[0], cost=torch.full_like(tries[0].cost, torch.inf))
            tries.append(with_rows(none, down, tried(guess, rows[down]), "bodies"))
        best = _followed(tries, tracks, seen.up)
    found = rows_of(tries[0], nearest, "bodies")
    for number, one in enumerate(tries):
        own = (best[nearest] == number).nonzero()[:, 0]
        found = with_rows(found, own, rows_of(one, nearest[own], "bodies"), "bodies")
    return found


def _tried(guess: Guess, seen: Seen, R: Float[Tensor, "3 3"], rig: Rig, config: FitConfig) -> Tried:
    """One hypothesis fitted to all rows."""
    body = guess.pose.expand(len(seen.pixels), -1)
    at = before(body)
    spread = guess.spread.expand_as(body)
    narrow = 2 * (seen.spread / spread).log().sum(-1)
    seen = dataclasses.replace(seen, centre=body, spread=spread)
    root = (R @ guess.root).expand(len(body), -1, -1)
    frame = Frame(rig, root, torch.zeros(len(body), dtype=torch.long))
    if guess.upright:
        tilt = tilt_of(points_of(at, frame).keypoints, seen, rig.names)
        frame = dataclasses.replace(frame, root=rot_z(tilt) @ root)
    state = FitState(where_seen(at, frame, seen), frame, seen, config)

    def energy(u: Unknowns) -> Energy:
        return dataclasses.replace(state, at=u).energy(START)

    at = solve(energy, state.at, config.start_steps, ("turn", "code", "place"))
    cost = energy(at).per_item / START.pose**2 - narrow
    joints = points_of(at, frame).joints[:, :22]
    if not guess.upright:
        slope = (trunk_of(joints) @ seen.up).clamp(-1, 1).asin()
        cost = cost + robust_square(slope.square(), SLOPE) / LEVEL**2
    return Tried(at, frame.root, body, spread, cost, joints)


def _followed(
    tries: list[Tried], tracks: Sequence[Track], up: Float[Tensor, "3"]
) -> Int[Tensor, " bodies"]:
    """The hypothesis of each row, along each track; lying people do not turn end for end."""
    cost = torch.stack([one.cost for one in tries], 1)
    joints = torch.stack([one.joints for one in tries], 1)
    best = torch.zeros(len(cost), dtype=torch.long)
    for track, time in tracks:
        best[track] = _path(cost[track], joints[track], time)
        if time is not None:
            against = turned_round(trunk_of(joints[track]), best[track], up)
            best[track] = _path(cost[track] + NEVER * against, joints[track], time)
    return best


def turned_round(
    trunks: Float[Tensor, "rows tries 3"], best: Int[Tensor, " rows"], up: Float[Tensor, "3"]
) -> Bool[Tensor, "rows tries"]:
    """Hypotheses that lie against the way of most of the stretch of lying that a row is in.

    `trunks` point from pelvis to neck, `best` is the hypothesis of each row, in the order of time.
    """
    lies = (trunks @ up).abs() < LIES
    own = trunks[torch.arange(len(best)), best]
    rise = own @ up
    against = torch.zeros_like(lies)
    stretch = (rise > SITS).long().cumsum(0)
    for one in stretch.unique():
        rows = (stretch == one) & (rise <= SITS)
        head = own[rows & (rise.abs() < LIES)].sum(0)
        against[rows] = lies[rows] & (trunks[rows] @ head < 0)
    return against


def _path(
    cost: Float[Tensor, "rows tries"],
    joints: Float[Tensor, "rows tries joints 3"],
    time: Float[Tensor, " rows"] | None,
) -> Int[Tensor, " rows"]:
    """The hypotheses of a track: cheap ones whose joints stay near from frame to frame."""
    if time is None or len(cost) < 2:
        return cost.argmin(1)
    gone = joints[:-1, :, None] - joints[1:, None]
    about = (gone - gone[..., :1, :]).norm(dim=-1).mean(-1)
    reach = REACH + SPEED * time.diff()[:, None, None]
    strain = (about / JUMP).square() + (gone[..., 0, :].norm(dim=-1) / reach).square()
    return best_path(cost, SWITCH * strain.clamp_max(STRAIN))


def start_rows(
    start: Bodies, keypoints: Keypoints, K: Float[Tensor, "3 3"]
) -> Int[Tensor, " rows"]:
    """The row of `start` for each row of the keypoints: the same person, the nearest frame.

    People are paired by where they are in the image; each has to have a body.
    """
    from scipy.optimize import linear_sum_assignment

    points = start.joints if start.joints is not None else start.verts[:, ::50]
    theirs = project(points, K.to(points)).nanmean(1)
    seen = keypoints.points.where(keypoints.confidence[..., None] > 0, torch.nan)
    ours = seen.nanmean(1)
    people, tracks = keypoints.person.unique().tolist(), start.person.unique().tolist()
    mine = [(keypoints.person == one).nonzero()[:, 0] for one in people]
    other = [(start.person == one).nonzero()[:, 0] for one in tracks]
    cost = np.full((len(people), len(tracks)), 1e6)  # mean distance in the frames of both [px]
    for k, other_k in np.ndindex(cost.shape):
        a, b = mine[k], other[other_k]
        _, i, j = np.intersect1d(
            keypoints.frame[a].numpy(), start.frame[b].numpy(), return_indices=True
        )
        if len(i):
            far = (ours[a[i]] - theirs[b[j]]).norm(dim=-1).nan_to_num(1e6)
            cost[k, other_k] = min(1e6, float(far.mean()))
    pairs = dict(zip(*(x.tolist() for x in linear_sum_assignment(cost)), strict=True))
    found = torch.zeros(len(keypoints.frame), dtype=torch.long)
    for k, rows in enumerate(mine):
        if k not in pairs:
            raise InputError(
                f"bodies to start from: there is none for person {people[k]} of the keypoints "
                f"(there are tracks {tracks})"
            )
        own = other[pairs[k]]
        apart = (start.frame[own] - keypoints.frame[rows][:, None]).abs()
        found[rows] = own[apart.argmin(1)]
    return found


def begin_from(start: Bodies, keypoints: Keypoints, seen: Seen, rig: Rig) -> FitStart:
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
    frame = Frame(rig, root, torch.zeros(len(angles), dtype=torch.long))
    at = where_seen(before(angles), frame, seen)
    return FitStart(at, root, angles, torch.full_like(seen.spread, NEAR))


def _by_matrix(pose: BodyPose) -> BodyPose:
    """SMPL-X parameters of SMPL bodies where the official matrix is there."""
    path = find_matrix()
    if path is None:
        return pose
    smpl, smplx = (load_smpl(name, pose.gender) for name in ("smpl", "smplx"))
    return as_smplx(pose, smpl, smplx, read_matrix(path))
