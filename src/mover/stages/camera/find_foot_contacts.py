"""Find the soles that carry people: still feet under straight legs (Sec. 3.2, C^feet).

Departure: The paper takes every foot vertex that a network calls a contact. But feet of people who
sit or lie hang in the air or lie on furniture; here a foot counts only if it is the lower one, does
not move, and its leg is straight, which is judged without knowing the floor. Where no person ever
stands like this, the best there is counts, with a warning.
"""

import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mover.bodies.parts import SOLES, BodyParts, members
from mover.bodies.posture import at, landmarks
from mover.bodies.skeleton import SIDES
from mover.core.observe import Observer, Step, silent
from mover.core.records import record
from mover.core.types import Bodies, Camera, rows_by_person
from mover.energy.human_terms import FootContacts
from mover.stages.config import FootContactConfig

KNEE, HIP = 145.0, 140.0  # [degrees], a leg is straight whose knee and hip are opened wider ...
UPRIGHT = 60.0  # [degrees] ... and that leans less
POINTS = 4  # lowest vertices of a sole that count
TOUCHING = 0.5  # the paper's threshold
WITHIN = 0.5  # [s] between two frames that still show whether a foot moved
FAR_ENOUGH = 0.15  # [s] between them, at least, where the video has them: jitter is no motion
JITTER = 0.03  # [m] that a still foot seems to move
TALL = 0.9  # of a person's usual height, from head to foot: who is lower does not stand
USUAL = 0.95  # quantile of the heights that is called usual


@record
class FootContactInputs:
    """People, in camera axes, and a rough idea of where up is."""

    bodies: Bodies
    parts: BodyParts
    keep: Bool[Tensor, " bodies"]
    """Which rows are sound, from `select_frames`."""
    camera: Camera
    """Its pitch and roll may be off by several degrees."""
    touch: Float[Tensor, "bodies verts"] | None = None
    """Chance that a vertex touches something, where the user knows it."""


@record
class _LowerFeet:
    """The lower foot of each body."""

    points: Float[Tensor, "bodies points 3"]
    carries: Bool[Tensor, " bodies"]
    """Its leg is straight, as far as can be seen."""
    still: Bool[Tensor, " bodies"]


def find_foot_contacts(
    inputs: FootContactInputs,
    config: FootContactConfig = FootContactConfig(),
    observe: Observer = silent,
) -> FootContacts:
    """Collect the lowest points of the feet that carry people.

    Raises:
        ValueError: If the bodies are not in camera axes.
    """
    bodies = inputs.bodies
    if bodies.space != "camera":
        raise ValueError(f"find_foot_contacts needs bodies in 'camera' space, not '{bodies.space}'")
    sound = inputs.keep if bool(inputs.keep.any()) else torch.ones_like(inputs.keep)
    if not len(bodies.frame):
        none = bodies.frame
        return FootContacts(bodies.verts.new_zeros(0, 3), none, none, ())
    if config.given and inputs.touch is not None:
        named = (inputs.touch > TOUCHING) & members(inputs.parts, *SOLES) & inputs.keep[:, None]
        row, vert = named.nonzero().unbind(1)
        if len(row):
            return FootContacts(bodies.verts[row, vert], bodies.person[row], bodies.frame[row], ())
    feet = _lower_feet(inputs, config)
    use, warnings = _best_evidence(feet, sound)
    observe(Step("find_foot_contacts", 0, 1))
    count = feet.points.shape[1]
    return FootContacts(
        points_cam=feet.points[use].reshape(-1, 3),
        person=bodies.person[use].repeat_interleave(count),
        frame=bodies.frame[use].repeat_interleave(count),
        warnings=warnings,
    )


def _best_evidence(
    feet: _LowerFeet, sound: Bool[Tensor, " bodies"]
) -> tuple[Bool[Tensor, " bodies"], tuple[str, ...]]:
    """The strictest choice that leaves something, and what to say about it."""
    bent = "no person ever stands on a straight leg: the lowest still feet give the floor"
    levels = (
        (feet.carries & feet.still, ""),
        (feet.carries, "no standing foot is ever still: moving feet give the floor"),
        (feet.still, bent),
        (sound, "no foot is ever still: the lowest point of every body gives the floor"),
    )
    for chosen, warning in levels:
        if bool((chosen & sound).any()):
            return chosen & sound, (warning,) if warning else ()
    raise AssertionError("some body is sound")


def _lower_feet(inputs: FootContactInputs, config: FootContactConfig) -> _LowerFeet:
    """Points, posture and motion of the lower foot of each body."""
    bodies, up = inputs.bodies, inputs.camera.R_cam_world[:, 1].to(inputs.bodies.verts)
    straight = straight_legs(bodies, inputs.parts, up)
    points, still, height = [], [], []
    soles = [members(inputs.parts, f"{side}_sole") for side in SIDES]
    feet = [bodies.verts[:, sole] if bool(sole.any()) else bodies.verts for sole in soles]
    count = min(POINTS, *(verts.shape[1] for verts in feet))  # of each foot
    for verts in feet:
        lowest = (verts @ up).topk(count, dim=1, largest=False)
        points.append(verts.take_along_dim(lowest.indices[..., None], 1))
        height.append(lowest.values.mean(1))
        still.append(_still(verts.mean(1), bodies, config.speed))
    right = (height[1] < height[0]).long()
    return _LowerFeet(
        torch.stack(points, 1).take_along_dim(right[:, None, None, None], 1)[:, 0],
        straight.take_along_dim(right[:, None], 1)[:, 0],
        torch.stack(still, 1).take_along_dim(right[:, None], 1)[:, 0],
    )


def straight_legs(
    bodies: Bodies, parts: BodyParts, up: Float[Tensor, "3"]
) -> Bool[Tensor, "bodies sides"]:
    """Whether each leg, left and right, stands straight; `up` may be off by several degrees.

    Of a mesh without landmarks: whether the body reaches about as high as its person usually does.
    """
    places = landmarks(bodies, parts)
    if bool(places.isnan().any()):
        return _tall(bodies, up)[:, None].expand(-1, 2)
    legs: list[Tensor] = []
    for side in SIDES:
        hip, knee, ankle = (at(places, f"{side}_{joint}") for joint in ("hip", "knee", "ankle"))
        trunk = at(places, "neck") - at(places, "hips")
        lean = _angle(hip - ankle, up.expand_as(hip))
        bent = _angle(hip - knee, ankle - knee) < KNEE
        sits = _angle(knee - hip, trunk) < HIP
        legs.append(~bent & ~sits & (lean < UPRIGHT))
    return torch.stack(legs, 1)


def _angle(a: Float[Tensor, "bodies 3"], b: Float[Tensor, "bodies 3"]) -> Float[Tensor, " bodies"]:
    """Angle between vectors [degrees]."""
    across = torch.linalg.cross(a, b).norm(dim=-1)
    return torch.rad2deg(torch.atan2(across, (a * b).sum(-1)))


def _tall(bodies: Bodies, up: Float[Tensor, "3"]) -> Bool[Tensor, " bodies"]:
    """Whether a body reaches about as high as its person usually does."""
    height = bodies.verts @ up
    reach = height.amax(1) - height.amin(1)
    tall = torch.zeros_like(reach, dtype=torch.bool)
    for person in bodies.person.unique():
        mine = bodies.person == person
        tall[mine] = reach[mine] >= TALL * reach[mine].quantile(USUAL)
    return tall


def _still(
    foot: Float[Tensor, "bodies 3"], bodies: Bodies, speed: float
) -> Bool[Tensor, " bodies"]:
    """Whether a foot rests, seen from the nearest useful frame before or after; unknown: yes."""
    still = torch.ones(len(foot), dtype=torch.bool, device=foot.device)
    if bodies.fps is None:
        return still
    for rows in rows_by_person(bodies.frame, bodies.person):
        time = bodies.frame[rows].to(foot.dtype) / bodies.fps
        still[rows] = _rests(foot[rows], time, speed)
    return still


def _rests(
    foot: Float[Tensor, "frames 3"], time: Float[Tensor, " frames"], speed: float
) -> Bool[Tensor, " frames"]:
    """Whether a foot hardly moves to the frame before, or to the one after."""
    last = len(time) - 1
    after = torch.searchsorted(time, time + FAR_ENOUGH - 1e-4).clamp_max(last)
    before = (torch.searchsorted(time, time - FAR_ENOUGH + 1e-4, right=True) - 1).clamp_min(0)
    known = rests = torch.zeros_like(time, dtype=torch.bool)
    for other in (before, after):
        wait = (time - time[other]).abs()
        near = (wait > 0) & (wait <= WITHIN)
        known = known | near
        rests = rests | near & ((foot - foot[other]).norm(dim=-1) < JITTER + speed * wait)
    return rests | ~known
