"""How people hold themselves (standing, sitting, lying, leaning back) and what of them touches.

World frame, +y up. People are distinguished by track; speeds are taken within a track over real
time. What touches is estimated from posture, motion and normals alone: sitting, lying, leaning
back, hands at rest and still soles. It stands in for POSA, whose weights cannot be shipped, and
does not say what is touched.
"""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.bodies.parts import LANDMARKS, SOLES, BodyParts, members
from mover.bodies.skeleton import SIDES
from mover.core.records import record
from mover.core.types import Bodies, rows_by_person
from mover.geometry.mesh import vertex_normals

LEVEL_THIGH = 37.0  # [degrees] from level, at most, of a sitter's thighs
UPRIGHT = 35.0  # [degrees] above level, at least, of an upright trunk
LYING = 24.0  # [degrees] from level, at most, of a trunk that lies
LOW_PELVIS = 0.78  # of its height when standing, at most, of a sitter's pelvis
HIGH_PELVIS = 1.15  # ... at least, of a person seated on something high, not standing on the floor
STILL_PELVIS = 0.3  # [m/s] at most, of a sitter's pelvis
ANKLE = 0.085  # height of the ankle joints over the floor when standing [legs, hip to ankle]
WINDOW = 0.1  # [s] before and after: long enough that trembling meshes are still
LONGEST_GAP = 1.0  # [s] between rows of a track that still give a speed


Places = Float[Tensor, "bodies landmarks 3"]
"""Of `LANDMARKS` [m]."""
Chance = Float[Tensor, "bodies verts"]
"""That a vertex touches something, and values like it."""
Some = Float[Tensor, "bodies some"]
"""The same of the vertices of a part."""


@record
class Postures:
    """Posture of each body; a body on the move between two of them has none."""

    standing: Bool[Tensor, " bodies"]
    sitting: Bool[Tensor, " bodies"]
    lying: Bool[Tensor, " bodies"]
    recline: Float[Tensor, " bodies"]
    """How far the trunk is tilted backwards from upright [rad]; negative: forwards."""


def landmarks(bodies: Bodies, parts: BodyParts) -> Places:
    """Places of `LANDMARKS` [m]: from the joints by name, else the middle of rings of vertices.

    NaN for a mesh of unknown topology without these joints.
    """
    names = bodies.joint_names
    if bodies.joints is not None and all(name in names for name in LANDMARKS):
        return bodies.joints[:, [names.index(name) for name in LANDMARKS]]
    if parts.rings.numel() == 0:
        return bodies.verts.new_full((bodies.verts.shape[0], len(LANDMARKS), 3), torch.nan)
    return bodies.verts[:, parts.rings].mean(2)


def at(places: Places, name: str) -> Float[Tensor, "bodies 3"]:
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
    for row in rows_by_person(bodies.frame, bodies.person):
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


Height = float | Float[Tensor, " bodies"]
"""Of the floor, everywhere or under each body [m]."""


def postures(bodies: Bodies, parts: BodyParts, ground: Height | None = None) -> Postures:
    """Posture of each body in the world.

    `ground` is the height of the floor [m]; where it is not known, each body's lowest point counts.
    """
    places = landmarks(bodies, parts)
    floor = bodies.verts[..., 1].amin(1) if ground is None else ground
    hips, trunk = at(places, "hips"), at(places, "neck") - at(places, "hips")
    thighs = torch.stack([at(places, f"{s}_knee") - at(places, f"{s}_hip") for s in SIDES], 1)
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


def _standing_hips(places: Places, bodies: Bodies) -> Float[Tensor, " bodies"]:
    """Height of the hips over the ground when the person stands straight [m], one per track."""
    bones = [
        (at(places, f"{s}_{a}") - at(places, f"{s}_{b}")).norm(dim=-1)
        for s in SIDES for a, b in (("hip", "knee"), ("knee", "ankle"))
    ]  # fmt: skip
    leg = ((bones[0] + bones[1]) + (bones[2] + bones[3])) / 2 * (1 + ANKLE)
    result = leg.clone()
    for person in bodies.person.unique():
        mine = bodies.person == person
        result[mine] = leg[mine].median()
    return result


def facing(places: Places) -> Float[Tensor, "bodies 3"]:
    """Level unit vector to the front of the pelvis and trunk; 0 where there is none."""
    left = _level(at(places, "left_hip") - at(places, "right_hip"))
    left = left + 0.5 * _level(at(places, "left_shoulder") - at(places, "right_shoulder"))
    up = torch.tensor([0.0, 1.0, 0.0]).to(left).expand_as(left)
    return _level(torch.linalg.cross(left, up))


def _level(vector: Float[Tensor, "bodies 3"]) -> Float[Tensor, "bodies 3"]:
    flat = vector * torch.tensor([1.0, 0.0, 1.0]).to(vector)
    return flat / flat.norm(dim=-1, keepdim=True).clamp_min(1e-9)


def headings(
    bodies: Bodies, parts: BodyParts, ground: Height | None = None
) -> Float[Tensor, "bodies 3"]:
    """Level unit vector to where each sitter faces: the pelvis' front and the thighs' way.

    Zero for people who do not sit.
    """
    places = landmarks(bodies, parts)
    knees = _level(at(places, "knees") - at(places, "hips"))
    both = _level(facing(places) + knees)
    sitting = postures(bodies, parts, ground).sitting
    return torch.where(sitting[:, None], both, torch.zeros_like(both))


FACING = (0.3, 0.7)  # cosine between normal and the direction of touch: never, surely
RECLINE = (0.12, 0.3)  # [rad] of the trunk behind upright: not leaning, surely leaning
LAYER = (0.07, 0.03)  # [m] from what reaches farthest: not touched by a flat surface, surely so
PALM = (0.04, 0.015)  # the same for a hand
STILL = (0.1, 0.3)  # [m/s] of hands: at rest, surely moving
STANCE = (0.3, 0.8)  # [m/s] of soles, which tremble more and swing faster
SURFACE = (0.25, 1.1)  # [m] over the ground: where hands find something to rest on
LAP = 0.17  # [m] from the middle of the own thigh: a hand there rests on the lap
LEVEL_ARM = 35.0  # [degrees] from level, at most, of a forearm that rests
SOLE = (0.03, 0.07)  # [m] over the lowest point of the body: stands on it, surely not
FLOATS = (0.08, 0.16)  # [m] of that point from the ground: on the floor, surely not
UNDERSIDE = 0.1  # [m] over the lowest point: where a body that lies on its front or side touches


def touching(bodies: Bodies, parts: BodyParts, ground: Height) -> Chance:
    """Chance that each vertex of people in the world (+y up) touches something.

    Raises:
        ValueError: If the bodies are not in the world.
    """
    if bodies.space != "world":
        raise ValueError(f"touching: bodies are in space '{bodies.space}', expected 'world'")
    pose = postures(bodies, parts, ground)
    places = landmarks(bodies, parts)
    normals = vertex_normals(bodies.verts, bodies.faces)
    down = _ramp(-normals[..., 1], *FACING)
    chance = torch.zeros_like(down)

    def add(part: Bool[Tensor, " verts"], found: Some) -> None:
        chance[:, part] = torch.maximum(chance[:, part], found)

    seat, back = members(parts, "seat", "left_thigh", "right_thigh"), members(parts, "back")
    low = down[:, seat] * pose.sitting[:, None]  # what faces down and is low enough
    add(seat, _flat(-bodies.verts[:, seat, 1], low, LAYER))
    add(back, _recline(bodies.verts[:, back], pose, places, normals[:, back]))
    if bool((pose.lying > 0).any()):
        add(torch.ones_like(seat), _lie(bodies, parts, pose, down))
    for name in ("left_palm", "right_palm", "left_forearm", "right_forearm"):
        part = members(parts, name)
        add(part, _rest_arm(name, bodies.verts[:, part], bodies, places, down[:, part], ground))
    for name in SOLES:
        part = members(parts, name)
        add(part, _stand(bodies, part, ground))
    return chance


def _ramp(value: Tensor, zero: float, one: float) -> Tensor:
    """0 up to `zero`, 1 from `one` on, smooth between; `one` may be the smaller."""
    share = ((value - zero) / (one - zero)).clamp(0, 1)
    return torch.nan_to_num(share * share * (3 - 2 * share))


def _flat(reach: Chance, chance: Chance, layer: tuple[float, float]) -> Chance:
    """Leave only the layer [m] that reaches farthest [m]: furniture is flatter than bodies."""
    could = torch.where(chance > 0.5, reach, torch.full_like(reach, -torch.inf))
    farthest = could.topk(min(5, could.shape[1]), dim=1).values[:, -1:]
    return chance * _ramp(farthest - reach, *layer)


def _recline(
    verts: Float[Tensor, "bodies verts 3"],
    pose: Postures,
    places: Places,
    normals: Float[Tensor, "bodies verts 3"],
) -> Chance:
    """Leaning back in a seat: what faces backwards of the back and reaches far enough."""
    front, trunk = facing(places), at(places, "neck") - at(places, "hips")
    behind = _ramp(-torch.einsum("bvi,bi->bv", normals, front), *FACING)
    lean = _ramp(pose.recline, *RECLINE) * pose.sitting
    axis = trunk / trunk.norm(dim=-1, keepdim=True).clamp_min(1e-9)
    backward = torch.linalg.cross(axis, torch.linalg.cross(axis, front))
    backward = torch.nan_to_num(backward / backward.norm(dim=-1, keepdim=True).clamp_min(1e-9))
    return _flat(torch.einsum("bvi,bi->bv", verts, backward), behind * lean[:, None], LAYER)


def _lie(bodies: Bodies, parts: BodyParts, pose: Postures, down: Chance) -> Chance:
    """Lying on the back: back, seat and thighs; else whatever lies lowest and faces down."""
    rear = members(parts, "back", "seat", "left_thigh", "right_thigh")
    spine = members(parts, "back")
    supine = (down * spine).sum(1) > 0.4 * spine.sum()
    height = bodies.verts[..., 1]
    lowest = height < height.amin(1, keepdim=True) + UNDERSIDE
    region = torch.where(supine[:, None], rear, lowest)
    return _flat(-height, down * region * pose.lying[:, None], (2 * LAYER[0], 2 * LAYER[1]))


def _rest_arm(
    name: str, verts: Tensor, bodies: Bodies, places: Places, down: Some, ground: Height
) -> Some:
    """A hand or forearm at rest on a surface, not on the own lap: what faces down of it."""
    side, _, kind = name.partition("_")
    middle = verts.mean(1)
    rest = _ramp(speeds(middle[:, None], bodies)[:, 0], STILL[1], STILL[0])
    height = middle[:, 1] - ground
    free = (from_lap(middle, places) > LAP) & (height > SURFACE[0]) & (height < SURFACE[1])
    if kind == "forearm":
        arm = at(places, f"{side}_wrist") - at(places, f"{side}_elbow")
        free = free & (elevation(arm).abs() < LEVEL_ARM)
    mostly = _ramp(down.mean(1), 0.2, 0.5)
    return _flat(-verts[..., 1], down * (rest * free * mostly)[:, None], PALM)


def from_lap(point: Float[Tensor, "bodies 3"], places: Places) -> Float[Tensor, " bodies"]:
    """Distance to the nearer of the own thighs' middle lines [m]."""
    ways: list[Tensor] = []
    for side in SIDES:
        hip, knee = at(places, f"{side}_hip"), at(places, f"{side}_knee")
        thigh = knee - hip
        along = ((point - hip) * thigh).sum(-1) / thigh.square().sum(-1).clamp_min(1e-9)
        nearest = hip + along.clamp(0, 1)[:, None] * thigh
        ways.append((point - nearest).norm(dim=-1))
    return torch.minimum(*ways)


def _stand(bodies: Bodies, part: Bool[Tensor, " verts"], ground: Height) -> Some:
    """Soles: hardly moving, and as low as the body reaches, which is about the ground.

    A body whose depth is wrong floats or sinks by some centimetres: its own lowest point shows
    which foot carries it, the ground only whether it stands on the floor at all.
    """
    height = bodies.verts[..., 1]
    lowest = height.amin(1, keepdim=True)
    floor = _ramp((lowest[:, 0] - ground).abs(), FLOATS[1], FLOATS[0])[:, None]
    near = _ramp(height[:, part] - lowest, SOLE[1], SOLE[0]) * floor
    middle = bodies.verts[:, part].mean(1, keepdim=True)
    rest = _ramp(speeds(middle, bodies)[:, 0], STANCE[1], STANCE[0])
    return near * rest[:, None]
