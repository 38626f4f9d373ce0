"""How people hold themselves: standing, sitting, lying, leaning back; where sitters face.

World frame, +y up. People are told apart by track; speeds are taken within a track over real time.
"""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..records import record
from ..types import Bodies
from .parts import LANDMARKS, Parts

LEVEL_THIGH = 37.0  # [degrees] from level, at most, of a sitter's thighs
UPRIGHT = 35.0  # [degrees] above level, at least, of an upright trunk
LYING = 24.0  # [degrees] from level, at most, of a trunk that lies
LOW_PELVIS = 0.78  # of its height when standing, at most, of a sitter's pelvis
HIGH_PELVIS = 1.15  # ... at least, of who sits on something high: there nobody stands on the floor
STILL_PELVIS = 0.3  # [m/s] at most, of a sitter's pelvis
ANKLE = 0.085  # height of the ankle joints over the floor when standing [legs, hip to ankle]
WINDOW = 0.1  # [s] before and after: long enough that trembling meshes are still
LONGEST_GAP = 1.0  # [s] between rows of a track that still give a speed


@record
class Postures:
    """Posture of each body; a body on the move between two of them has none."""

    standing: Bool[Tensor, " bodies"]
    sitting: Bool[Tensor, " bodies"]
    lying: Bool[Tensor, " bodies"]
    recline: Float[Tensor, " bodies"]
    """How far the trunk is tilted backwards from upright [rad]; negative: forwards."""


def landmarks(bodies: Bodies, parts: Parts) -> Float[Tensor, "bodies landmarks 3"]:
    """Places of `LANDMARKS` [m]: from the joints by name, else the middle of rings of vertices.

    NaN where a mesh could not be matched to a human body.
    """
    names = bodies.joint_names
    if bodies.joints is not None and all(name in names for name in LANDMARKS):
        return bodies.joints[:, [names.index(name) for name in LANDMARKS]]
    if parts.rings.numel() == 0:
        return bodies.verts.new_full((bodies.verts.shape[0], len(LANDMARKS), 3), torch.nan)
    return bodies.verts[:, parts.rings].mean(2)


def at(places: Float[Tensor, "bodies landmarks 3"], name: str) -> Float[Tensor, "bodies 3"]:
    """One landmark [m]; `hips` and so on is the middle of left and right."""
    if name in LANDMARKS:
        return places[:, LANDMARKS.index(name)]
    joint = name.removesuffix("s")
    return (at(places, f"left_{joint}") + at(places, f"right_{joint}")) / 2


def speeds(
    points: Float[Tensor, "bodies points 3"], bodies: Bodies
) -> Float[Tensor, "bodies points"]:
    """Speed of points on each body [m/s], over the frames about it in its track.

    0 where nothing is known: unordered images, or no other frame of the track within a second.
    """
    result = torch.zeros_like(points[..., 0])
    if bodies.fps is None:
        return result
    for person in bodies.person.unique().tolist():
        row = torch.nonzero(bodies.person == person)[:, 0]
        row = row[torch.argsort(bodies.frame[row])]
        time = bodies.frame[row].double() / bodies.fps
        first, last = _window(time)
        way = (points[row[last]] - points[row[first]]).norm(dim=-1)
        seconds = (time[last] - time[first]).clamp_min(1e-6)
        result[row] = way / seconds[:, None].to(way)
    return result


def _window(time: Float[Tensor, " rows"]) -> tuple[Int[Tensor, " rows"], Int[Tensor, " rows"]]:
    """First and last row near each moment: within `WINDOW`, else the neighbours if near enough."""
    index, step = torch.arange(len(time), device=time.device), time.diff()
    joined = torch.cat([step.new_full((1,), torch.inf), step, step.new_full((1,), torch.inf)])
    before = index - (joined[:-1] <= LONGEST_GAP).long()
    after = index + (joined[1:] <= LONGEST_GAP).long()
    early = torch.searchsorted(time, time - WINDOW - 1e-6)
    late = torch.searchsorted(time, time + WINDOW + 1e-6, right=True) - 1
    return torch.minimum(early, before), torch.maximum(late, after)


def elevation(vector: Float[Tensor, "*batch 3"]) -> Float[Tensor, "*batch"]:
    """Angle above level [degrees]."""
    return torch.rad2deg(torch.atan2(vector[..., 1], vector[..., [0, 2]].norm(dim=-1)))


def postures(bodies: Bodies, parts: Parts, ground: float | None = None) -> Postures:
    """Posture of each body in the world.

    `ground` is the height of the floor [m]; where it is not known, each body's lowest point counts.
    """
    places = landmarks(bodies, parts)
    floor = bodies.verts[..., 1].amin(1) if ground is None else ground
    hips, trunk = at(places, "hips"), at(places, "neck") - at(places, "hips")
    thighs = torch.stack(
        [at(places, f"{s}_knee") - at(places, f"{s}_hip") for s in ("left", "right")], 1
    )
    level = elevation(thighs).abs().amax(1) < LEVEL_THIGH
    rise = elevation(trunk)
    height = (hips[:, 1] - floor) / _standing_hips(places, bodies)
    low, high = height < LOW_PELVIS, height > HIGH_PELVIS
    still = speeds(hips[:, None], bodies)[:, 0] < STILL_PELVIS
    sitting = level & (low | high) & still & (rise > UPRIGHT)
    steep = elevation(-thighs).amin(1) > LEVEL_THIGH
    lying = (rise.abs() < LYING) & still & ~steep
    standing = steep & ~low & (rise > UPRIGHT)
    front = facing(places)
    back = torch.atan2(-(trunk * front).sum(-1), trunk[:, 1])
    return Postures(standing, sitting, lying, back)


def _standing_hips(
    places: Float[Tensor, "bodies landmarks 3"], bodies: Bodies
) -> Float[Tensor, " bodies"]:
    """Height of the hips over the ground when the person stands straight [m], one per track."""
    legs = [
        (at(places, f"{s}_hip") - at(places, f"{s}_knee")).norm(dim=-1)
        + (at(places, f"{s}_knee") - at(places, f"{s}_ankle")).norm(dim=-1)
        for s in ("left", "right")
    ]
    leg = (legs[0] + legs[1]) / 2 * (1 + ANKLE)
    result = leg.clone()
    for person in bodies.person.unique():
        mine = bodies.person == person
        result[mine] = leg[mine].median()
    return result


def facing(places: Float[Tensor, "bodies landmarks 3"]) -> Float[Tensor, "bodies 3"]:
    """Level unit vector to the front of the pelvis and trunk; 0 where there is none."""
    left = _level(at(places, "left_hip") - at(places, "right_hip"))
    left = left + 0.5 * _level(at(places, "left_shoulder") - at(places, "right_shoulder"))
    up = torch.tensor([0.0, 1.0, 0.0]).to(left).expand_as(left)
    return _level(torch.linalg.cross(left, up))


def _level(vector: Float[Tensor, "bodies 3"]) -> Float[Tensor, "bodies 3"]:
    flat = vector * torch.tensor([1.0, 0.0, 1.0]).to(vector)
    return flat / flat.norm(dim=-1, keepdim=True).clamp_min(1e-9)


def headings(
    bodies: Bodies, parts: Parts, ground: float | None = None
) -> Float[Tensor, "bodies 3"]:
    """Level unit vector to where each sitter faces: the pelvis' front and the thighs' way.

    Zero for people who do not sit.
    """
    places = landmarks(bodies, parts)
    knees = _level(at(places, "knees") - at(places, "hips"))
    both = _level(facing(places) + knees)
    sitting = postures(bodies, parts, ground).sitting
    return torch.where(sitting[:, None], both, torch.zeros_like(both))
