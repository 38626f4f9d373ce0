"""Which keypoints count, rows in the order of time, and stretches of a long video."""

import dataclasses

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.bodies.keypoints import LAYOUTS
from mover.bodies.skeleton import BODY, PARENTS
from mover.core.errors import InputError
from mover.core.records import record
from mover.core.types import Camera, Keypoints, rows_by_person
from mover.energy.body_terms import gather_neighbours
from mover.fitting import FitConfig, Stage
from mover.fitting.energy import Seen, TrackMotion
from mover.fitting.priors import kind_of, resting, spreads
from mover.fitting.unknowns import Rig

HALF = 0.5  # [s], over which motion in the image is measured, on either side
MARGIN = 20  # rows of its neighbours that a stretch solves as well, at most
CALM = 0.05  # acceleration of a body whose picture stands still [m/s²],
AGILITY = 2.0  # what each m/s, across the view, adds to that of a pelvis [1/s],
SWING = 4.0  # and to that of other joints: arms swing [1/s]
LEAST_CONFIDENCE = 0.1  # keypoints below are missing
LEAST_JOINTS = 4  # rows with fewer keypoints of the body are left out
LOOSE = ("neck", "left_hip", "right_hip", "pelvis")
"""Keypoints that detectors place elsewhere."""


@record
class Window:
    """Rows that are solved together, with their neighbours in time."""

    rows: Int[Tensor, " rows"]
    keep: Bool[Tensor, " rows"]
    """Rows that are taken from this window; its neighbours have the others."""


def windows_of(keypoints: Keypoints, config: FitConfig) -> list[Window]:
    """One window of all rows; or first some rows of the whole video, and then its stretches."""
    count = len(keypoints.frame)
    order = torch.argsort(keypoints.frame, stable=True)
    if count <= config.chunk:
        return [Window(order, torch.ones(count, dtype=torch.bool))]
    spread = torch.linspace(0, count - 1, config.chunk // 2).round().long().unique()
    found = [Window(order[spread], torch.ones(len(spread), dtype=torch.bool))]
    margin = min(MARGIN, config.chunk // 4)
    inner = max(1, config.chunk - 2 * margin)
    for first in range(0, count, inner):
        low, high = max(0, first - margin), min(count, first + inner + margin)
        place = torch.arange(low, high)
        keep = (place >= first) & (place < first + inner)
        found.append(Window(order[low:high], keep))
    return found


def motion_of(
    keypoints: Keypoints, speed: Float[Tensor, "rows joints"] | None, config: FitConfig
) -> TrackMotion:
    """Neighbours in time of each person, and how much they accelerate.

    `speed` is how fast the joints of each body seem to move [m/s]; None: not known.
    """
    near = gather_neighbours(keypoints.frame, keypoints.person, keypoints.fps)
    time = near.steps.prod(1)
    expected = config.jitter + config.acceleration * time
    calm = expected[:, None].expand(-1, len(BODY))
    if speed is not None:
        factor = torch.tensor([AGILITY, *[SWING] * (len(BODY) - 1)])
        most = (CALM + factor * speed.double()).clamp_max(config.acceleration)
        calm = config.jitter + most[near.triples[:, 1]] * time[:, None]
    return TrackMotion(near, expected.float(), calm.float())


def joint_speed(
    keypoints: Keypoints, there: Bool[Tensor, "rows layout"]
) -> Float[Tensor, "rows joints"]:
    """How fast each joint moves in the image, not less than most keypoints that count do [px/s].

    The pelvis moves as most keypoints, joints that the layout lacks as their parents do. Infinite
    where a joint is not seen and at the ends of a track. There has to be a frame rate.
    """
    assert keypoints.fps is not None
    each, names = torch.full(there.shape, torch.nan), LAYOUTS[keypoints.layout]
    ones = there[..., None].to(keypoints.points)
    known = torch.where(there[..., None], keypoints.points, 0.0)
    for rows in rows_by_person(keypoints.frame, keypoints.person):
        time = keypoints.frame[rows].to(known) / keypoints.fps
        clock = time[:, None, None] * ones[rows]
        sums = torch.cat([known[rows], clock, ones[rows]], -1)
        past, coming = torch.zeros_like(sums), torch.zeros_like(sums)  # half a second of each side
        for step in range(1, len(time)):
            near = ((time[step:] - time[:-step]) <= HALF)[:, None, None]
            if not bool(near.any()):
                break
            past[step:] += sums[:-step] * near
            coming[:-step] += sums[step:] * near
        gone = coming[..., :3] / coming[..., 3:] - past[..., :3] / past[..., 3:]
        each[rows] = gone[..., :2].norm(dim=-1) / gone[..., 2]
    most = each.nanmedian(1).values.nan_to_num(torch.inf)
    found = [most]
    for joint, parent in zip(BODY[1:], PARENTS[1 : len(BODY)], strict=True):
        seen = joint in names
        own = each[:, names.index(joint)].nan_to_num(torch.inf) if seen else found[parent]
        found.append(torch.maximum(own, most))
    return torch.stack(found, 1)


def every_so_often(
    frame: Int[Tensor, " rows"], person: Int[Tensor, " rows"], step: int
) -> tuple[Int[Tensor, " some"], Int[Tensor, " rows"]]:
    """Every so many rows of each track, and which of those is the nearest for each row."""
    picked: list[Tensor] = []
    nearest = torch.zeros(len(frame), dtype=torch.long)
    count = 0
    for rows in rows_by_person(frame, person):
        some = rows[torch.arange(min(step // 2, len(rows) - 1), len(rows), step)]
        way = (frame[rows][:, None] - frame[some][None]).abs()
        nearest[rows] = count + way.argmin(1)
        picked.append(some)
        count += len(some)
    return torch.cat(picked), nearest


def best_path(
    cost: Float[Tensor, "rows options"], step: Float[Tensor, "steps options options"]
) -> Int[Tensor, " rows"]:
    """The option of each row with the least sum of costs and steps (Viterbi)."""
    total, came = cost[0], list[Tensor]()
    for k in range(1, len(cost)):
        least, origin = (total[:, None] + step[k - 1]).min(0)
        came.append(origin)
        total = least + cost[k]
    path = [int(total.argmin())]
    for origin in reversed(came):
        path.append(int(origin[path[-1]]))
    return torch.tensor(path[::-1])


def confidence_of(keypoints: Keypoints, config: FitConfig) -> Float[Tensor, "rows layout"]:
    """Confidence of keypoints, 0 where they are missing, not finite, or below the least."""
    sure = keypoints.confidence.nan_to_num(0).clamp(0, 1)
    there = keypoints.points.isfinite().all(-1) & (sure >= LEAST_CONFIDENCE)
    factor = [config.loose if n in LOOSE else 1.0 for n in LAYOUTS[keypoints.layout]]
    # A hand that is written twice (as wrist of the body and of the hand) counts twice.
    return torch.where(there, sure, torch.zeros_like(sure)) * sure.new_tensor(factor)


def usable_rows(
    keypoints: Keypoints, config: FitConfig
) -> tuple[Int[Tensor, " some"], tuple[str, ...]]:
    """Rows with enough keypoints of the body, and a warning where others are left out.

    Raises:
        InputError: If there is none.
    """
    body = torch.tensor([kind_of(name) == "body" for name in LAYOUTS[keypoints.layout]])
    count = ((confidence_of(keypoints, config) > 0) & body).sum(1)
    rows = torch.nonzero(count >= LEAST_JOINTS)[:, 0]
    if not len(rows):
        found = f"{len(count)} rows with at most {int(count.max()) if len(count) else 0}"
        raise InputError(
            f"keypoints: {found} joints of the body, expected a row with {LEAST_JOINTS}"
        )
    left = len(count) - len(rows)
    text = f"{left} of {len(count)} rows have fewer than {LEAST_JOINTS} joints: left out"
    return rows, (text,) if left else ()


def seen_at_all(keypoints: Keypoints, config: FitConfig) -> Bool[Tensor, " layout"]:
    """Keypoints that some row sees and some stage looks at."""
    factors = [factors_of(stage) for stage in config.stages]
    wanted = [any(f[kind_of(name)] > 0 for f in factors) for name in LAYOUTS[keypoints.layout]]
    return (confidence_of(keypoints, config) > 0).any(0) & torch.tensor(wanted)


def seen_of(keypoints: Keypoints, rig: Rig, camera: Camera, config: FitConfig) -> Seen:
    """What the fit looks at."""
    weight = confidence_of(keypoints, config)[:, rig.keypoints]
    pixels = keypoints.points[:, rig.keypoints]
    return Seen(
        pixels=torch.where(weight[..., None] > 0, pixels, torch.zeros_like(pixels)), weight=weight,
        K=camera.K.to(pixels), height=camera.height, up=camera.R_cam_world[:, 1].to(pixels),
        floor=None, motion=motion_of(keypoints, None, config), centre=resting(len(weight), pixels),
        spread=spreads(len(weight), pixels),
    )  # fmt: skip


def factors_of(stage: Stage) -> dict[str, float]:
    """Factors on the confidence of keypoints in a stage, by what they belong to."""
    return {"body": 1.0, "hand": stage.hand_joints, "face": stage.face_joints}


def stages_of(config: FitConfig, names: tuple[str, ...]) -> tuple[Stage, ...]:
    """The stages, without a last one that differs in hands and faces that no keypoint shows."""
    *_, before, last = (Stage(), *config.stages)
    own = {"steps": before.steps, "hand_joints": before.hand_joints}
    similar = dataclasses.replace(last, face_joints=before.face_joints, **own) == before
    shown = any(kind_of(name) != "body" for name in names)
    return config.stages if shown or not similar or len(config.stages) < 2 else config.stages[:-1]
