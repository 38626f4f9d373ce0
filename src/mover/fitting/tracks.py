"""Which keypoints count, rows in the order of time, and stretches of a long video."""

import dataclasses

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.bodies.keypoints import LAYOUTS
from mover.bodies.skeleton import BODY, PARENTS
from mover.core.errors import InputError
from mover.core.records import record, rows_of
from mover.core.types import Camera, Keypoints
from mover.fitting.config import FitConfig, Stage
from mover.fitting.energy import Seen, Triples
from mover.fitting.limits import resting, spreads
from mover.fitting.unknowns import Rig

HALF = 0.5  # [s], over which motion in the image is measured, on either side
MARGIN = 20  # rows of its neighbours that a stretch solves as well, at most
ALONE = Triples(
    torch.zeros(0, 3, dtype=torch.long), torch.zeros(0), torch.zeros(0), torch.zeros(0, len(BODY))
)
"""No row has neighbours in time."""


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


def chosen(seen: Seen, rows: Int[Tensor, " rows"], triples: Triples = ALONE) -> Seen:
    """Some rows, with these neighbours."""
    return dataclasses.replace(rows_of(seen, rows, "bodies"), triples=triples)


# Rows of the same person in the order of time.


def tracks_of(
    frame: Int[Tensor, " rows"], person: Int[Tensor, " rows"]
) -> list[Int[Tensor, " track"]]:
    """Rows of each person, in the order of their frames."""
    found: list[Tensor] = []
    for one in person.unique().tolist():
        rows = torch.nonzero(person == one)[:, 0]
        found.append(rows[torch.argsort(frame[rows], stable=True)])
    return found


def triples_of(
    keypoints: Keypoints, speed: Float[Tensor, "rows joints"] | None, config: FitConfig
) -> Triples:
    """Neighbours in time of each person; none of unordered images and across long gaps.

    Args:
        keypoints: Their rows.
        speed: How fast the joints of each body seem to move [m/s]; None: not known.
        config: How much people accelerate.
    """
    if keypoints.fps is None:
        return ALONE
    found = [ALONE.rows]
    for rows in tracks_of(keypoints.frame, keypoints.person):
        found.append(torch.stack([rows[:-2], rows[1:-1], rows[2:]], 1))
    triples = torch.cat(found)
    time = keypoints.frame[triples].double() / keypoints.fps
    before, after = time[:, 1] - time[:, 0], time[:, 2] - time[:, 1]
    near = torch.maximum(before, after) <= config.longest_gap
    triples, before, after = triples[near], before[near], after[near]
    share = (after / (before + after)).float()
    expected = config.jitter + config.acceleration * before * after
    calm = expected[:, None].expand(-1, len(BODY))
    if speed is not None:
        factor = torch.tensor([config.agility, *[config.swing] * (len(BODY) - 1)])
        most = (config.calm + factor * speed.double()).clamp_max(config.acceleration)
        calm = config.jitter + most[triples[:, 1]] * (before * after)[:, None]
    return Triples(triples, share, expected.float(), calm.float())


def joint_speed(
    keypoints: Keypoints, there: Bool[Tensor, "rows layout"]
) -> Float[Tensor, "rows joints"]:
    """How fast each joint moves in the image, not less than most keypoints do [px/s].

    The pelvis moves as most keypoints, joints that the layout lacks as their parents do. Infinite
    where a joint is not seen and at the ends of a track.
    """
    each, names = image_speed(keypoints, there), LAYOUTS[keypoints.layout]
    most = each.nanmedian(1).values.nan_to_num(torch.inf)
    found = [most]
    for joint, parent in zip(BODY[1:], PARENTS[1 : len(BODY)], strict=True):
        known = joint in names
        own = each[:, names.index(joint)].nan_to_num(torch.inf) if known else found[parent]
        found.append(torch.maximum(own, most))
    return torch.stack(found, 1)


def image_speed(
    keypoints: Keypoints, there: Bool[Tensor, "rows layout"]
) -> Float[Tensor, "rows layout"]:
    """How fast each keypoint moves in the image [px/s].

    Between the means of half a second before and after; NaN where it is not seen in one of them.

    Args:
        keypoints: With a frame rate.
        there: Which of them count.
    """
    assert keypoints.fps is not None
    speed = torch.full(there.shape, torch.nan)
    ones = there[..., None].to(keypoints.points)
    known = torch.where(there[..., None], keypoints.points, torch.zeros_like(keypoints.points))
    for rows in tracks_of(keypoints.frame, keypoints.person):
        time = keypoints.frame[rows].to(known) / keypoints.fps
        clock = time[:, None, None].expand_as(known[rows]) * ones[rows]
        values = torch.cat([known[rows], clock[..., :1], ones[rows]], -1)
        past, coming = (_half(values, time, side) for side in (1, -1))
        gone = coming[..., :3] / coming[..., 3:] - past[..., :3] / past[..., 3:]
        speed[rows] = gone[..., :2].norm(dim=-1) / gone[..., 2]
    return speed


def _half(
    values: Float[Tensor, "track keypoints sums"], time: Float[Tensor, " track"], side: int
) -> Float[Tensor, "track keypoints sums"]:
    """Sums over the rows of half a second before (side 1) or after (-1) each row."""
    total = torch.zeros_like(values)
    for step in range(1, len(time)):  # as many as half a second has frames
        near = (time[step:] - time[:-step]) <= HALF
        if not bool(near.any()):
            break
        later, sooner = (slice(step, None), slice(None, -step))[:: 1 if side > 0 else -1]
        total[later] = total[later] + values[sooner] * near[:, None, None]
    return total


def every_so_often(
    frame: Int[Tensor, " rows"], person: Int[Tensor, " rows"], step: int
) -> tuple[Int[Tensor, " some"], Int[Tensor, " rows"]]:
    """Every so many rows of each track, and which of those is the nearest for each row."""
    picked: list[Tensor] = []
    nearest = torch.zeros(len(frame), dtype=torch.long)
    count = 0
    for rows in tracks_of(frame, person):
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


# Which keypoints count, and how much.


LOOSE = ("neck", "left_hip", "right_hip", "pelvis")
HAND = ("index", "middle", "ring", "pinky", "thumb")


def kind_of(name: str) -> str:
    """`body`, `hand` or `face`: whose weight a keypoint has."""
    if name.startswith("face_"):
        return "face"
    return "hand" if any(part in name for part in HAND) else "body"


def confidence_of(keypoints: Keypoints, config: FitConfig) -> Float[Tensor, "rows layout"]:
    """Confidence of keypoints, 0 where they are missing, not finite, or doubtful."""
    sure = keypoints.confidence.nan_to_num(0).clamp(0, 1)
    there = keypoints.points.isfinite().all(-1) & (sure >= config.least_confidence)
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
    rows = torch.nonzero(count >= config.least_joints)[:, 0]
    if not len(rows):
        found = f"{len(count)} rows with at most {int(count.max()) if len(count) else 0}"
        raise InputError(
            f"keypoints: {found} joints of the body, expected a row with {config.least_joints}"
        )
    left = len(count) - len(rows)
    text = f"{left} of {len(count)} rows have fewer than {config.least_joints} joints: left out"
    return rows, (text,) if left else ()


def seen_at_all(keypoints: Keypoints, config: FitConfig) -> Bool[Tensor, " layout"]:
    """Keypoints that some row sees and some stage looks at."""
    stages = config.stages
    wanted = {
        "body": True,
        "hand": any(stage.hand_joints > 0 for stage in stages),
        "face": any(stage.face_joints > 0 for stage in stages),
    }
    looked_at = torch.tensor([wanted[kind_of(n)] for n in LAYOUTS[keypoints.layout]])
    return (confidence_of(keypoints, config) > 0).any(0) & looked_at


def seen_of(keypoints: Keypoints, rig: Rig, camera: Camera, config: FitConfig) -> Seen:
    """What the fit looks at."""
    weight = confidence_of(keypoints, config)[:, rig.keypoints]
    pixels = keypoints.points[:, rig.keypoints]
    return Seen(
        pixels=torch.where(weight[..., None] > 0, pixels, torch.zeros_like(pixels)),
        weight=weight,
        K=camera.K.to(pixels),
        height=camera.height,
        up=camera.R_cam_world[:, 1].to(pixels),
        floor=None,
        triples=triples_of(keypoints, None, config),
        centre=resting(len(weight), pixels),
        spread=spreads(len(weight), pixels),
    )


def at_stage(seen: Seen, names: list[str], stage: Stage) -> Seen:
    """The same with the weights that hands and face have in a stage."""
    factor = {"body": 1.0, "hand": stage.hand_joints, "face": stage.face_joints}
    return dataclasses.replace(
        seen, weight=seen.weight * seen.weight.new_tensor([factor[kind_of(n)] for n in names])
    )


def stages_of(config: FitConfig, names: list[str]) -> tuple[Stage, ...]:
    """The stages, without a last one that differs in hands and faces that no keypoint shows."""
    *_, before, last = (Stage(), *config.stages)
    own = {"steps": before.steps, "hand_joints": before.hand_joints}
    similar = dataclasses.replace(last, face_joints=before.face_joints, **own) == before
    shown = any(kind_of(name) != "body" for name in names)
    return config.stages if shown or not similar or len(config.stages) < 2 else config.stages[:-1]
