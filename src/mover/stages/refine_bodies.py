"""Refine the bodies with the room that they helped to find (Sec. "HPS estimation", after PROX).

With the parameters of a body model the pose is refined, bare meshes are moved as a whole. Rows are
taken a few hundred at a time, in the order of their tracks, with neighbours on both sides that are
moved along and thrown away, so that memory does not grow with the video.
"""

from dataclasses import dataclass, field, replace
from functools import partial

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..bodies.corrected import (
    Correction,
    Puppet,
    corrected,
    moved,
    no_correction,
    normals_after,
    puppet_of,
)  # fmt: skip
from ..bodies.parts import parts_of
from ..bodies.thinned import pose_rows
from ..bodies.touch import touching
from ..minimize import Adam, Observer, minimize, silent
from ..records import InputError, map_tensors, record
from ..terms.body_contact import MatchConfig, Matches, Skin, gather_matches
from ..terms.body_order import Bounds
from ..terms.body_time import gather_neighbours
from ..types import Bodies, Capture, Room
from .body_energy import BodyWeights, Evidence, Feet, body_energy
from .body_evidence import (
    Picked,
    Surroundings,
    Watched,
    order_bounds,
    pick,
    resting_soles,
    surroundings_of,
    watched_of,
)  # fmt: skip


@dataclass(frozen=True)
class RefineBodiesConfig:
    """How bodies are refined with the room."""

    weights: BodyWeights = field(default_factory=BodyWeights)
    match: MatchConfig = field(default_factory=MatchConfig)
    method: Adam = field(default_factory=lambda: Adam(25, 0.01, 0.003, beta2=0.98))
    """The descent of one round."""
    rounds: int = 5
    """How often contacts and depth order are looked for anew."""
    rhos: tuple[float, float] = (0.15, 0.06)
    """Distances at which a contact pays half, in the first and in the last round [m]."""
    rows: int = 512
    """Bodies that are moved at once."""
    overlap: int = 12
    """Rows on both sides that are moved along."""


SMOOTHED = BodyWeights(under=0.0, stand=0.0, lock=0.0, sink=0.0, touch=0.0, order=0.0)
"""No room at all: smooth in time, near to what was given."""
ABLATION = {
    "baseline": SMOOTHED,
    "+CamGP": replace(SMOOTHED, under=1.0, stand=1.0, lock=1.0),
    "+CamGP+SDF": replace(BodyWeights(), touch=0.0, order=0.0),
    "+CamGP+Contact": replace(BodyWeights(), sink=0.0, order=0.0),
    "+CamGP+SDF+Contact": replace(BodyWeights(), order=0.0),
    "all": BodyWeights(),
}
"""Weights of the paper's table; `all` adds the depth order, which the paper's does not have."""


@record
class RefinedBodies:
    """People whose bodies agree with the room."""

    bodies: Bodies
    """All rows, in the world of the room."""
    shift: Float[Tensor, "bodies 3"]
    """How far each pelvis has moved [m]."""
    energy: Float[Tensor, " bodies"]
    """What is left of the price [nats]."""


@dataclass(frozen=True)
class _Cast:
    """Everybody, and what is known before anything moves."""

    bodies: Bodies
    picked: Picked
    room: Surroundings
    chance: Float[Tensor, "bodies picked"]
    rest: Float[Tensor, "bodies feet"]
    watched: Watched | None


def refine_bodies(
    room: Room,
    capture: Capture | None,
    config: RefineBodiesConfig,
    observe: Observer = silent,
) -> RefinedBodies:
    """Move the people of a room so that they agree with its floor and furniture.

    Args:
        room: The estimated room; its bodies are in its world, with a pose where it may be refined.
        capture: Gives masks and known contacts; without it there is no depth order.
        config: Weights and settings.
        observe: Called after each step.

    Raises:
        InputError: If the room has no bodies or no floor.
    """
    cast = _cast(room, capture, config)
    order = sorted(
        range(len(cast.bodies.frame)),
        key=lambda k: (int(cast.bodies.person[k]), int(cast.bodies.frame[k])),
    )
    found: Correction | None = None
    energy = torch.zeros(len(order))
    for first in range(0, len(order), config.rows):
        inner = order[first : first + config.rows]
        start = max(0, first - config.overlap)
        rows = torch.tensor(order[start : first + config.rows + config.overlap])
        by, left = _refine(cast, rows, config, observe)
        keep = slice(first - start, first - start + len(inner))
        found = _put(found, by, torch.tensor(inner), keep, len(order))
        energy[inner] = left[keep]
    assert found is not None, "bodies have at least one row"
    return RefinedBodies(corrected(cast.bodies, found), found.shift, energy)


def _cast(room: Room, capture: Capture | None, config: RefineBodiesConfig) -> _Cast:
    bodies, ground = room.bodies, room.scene.ground
    if bodies is None or not len(bodies.frame) or ground is None:
        lack = "bodies" if ground is not None else "floor"
        raise InputError(f"the room has no {lack}: there is nothing to refine")
    bodies = map_tensors(lambda x: x.float() if x.is_floating_point() else x, bodies)
    parts = parts_of(bodies)
    picked = pick(bodies, parts)
    surroundings = surroundings_of(room, capture)
    people = None if capture is None or not config.weights.order else capture.people
    given = None if capture is None else capture.touch
    if given is not None and given.shape != bodies.verts.shape[:2]:
        given = None
    chance = given if given is not None else touching(bodies, parts, ground)
    rest = resting_soles(bodies, parts, ground)
    return _Cast(
        bodies, picked, surroundings, _furniture_only(chance[:, picked.index].float(), picked),
        rest, watched_of(surroundings, people, bodies),
    )  # fmt: skip


def _furniture_only(chance: Tensor, picked: Picked) -> Tensor:
    """Without the soles, which the floor holds."""
    return torch.where((picked.part == 0) | (picked.part == 1), torch.zeros_like(chance), chance)


def _refine(
    cast: _Cast, rows: Int[Tensor, " rows"], config: RefineBodiesConfig, observe: Observer
) -> tuple[Correction, Float[Tensor, " rows"]]:
    """Some rows, in rounds: find what touches and what hides, descend, find it anew."""
    bodies = _take(cast.bodies, rows)
    puppet = puppet_of(bodies, cast.picked.index)
    by, left = no_correction(puppet), torch.zeros(len(rows))
    known = _known(cast, bodies, rows)
    for turn in range(config.rounds):
        share = turn / max(1, config.rounds - 1)
        rho = config.rhos[0] * (config.rhos[1] / config.rhos[0]) ** share
        known = replace(_looked(cast, puppet, by, rows, known, config), rho=rho)
        energy = partial(body_energy, puppet=puppet, known=known, weights=config.weights)
        found = minimize(energy, by, config.method, observe, "refine_bodies")
        by, left = found.at, found.value
    return by, left


def _known(cast: _Cast, bodies: Bodies, rows: Int[Tensor, " rows"]) -> Evidence:
    """What does not change while the bodies move."""
    room = cast.room
    soles = torch.stack([cast.picked.part == 0, cast.picked.part == 1])
    return Evidence(
        camera=room.camera, ground=room.ground, furniture=room.furniture,
        near=gather_neighbours(bodies.frame, bodies.person, bodies.fps),
        feet=Feet(soles, cast.rest[rows]), matches=None, bounds=None, rho=0.1,
        even=cast.picked.even,
    )  # fmt: skip


def _looked(
    cast: _Cast, puppet: Puppet, by: Correction, rows: Tensor, known: Evidence,
    config: RefineBodiesConfig,
) -> Evidence:  # fmt: skip
    """Look anew for what the skin touches and for what hides it."""
    with torch.no_grad():
        now, normals = moved(puppet, by), normals_after(puppet, by)
    matches: Matches | None = None
    bounds: Bounds | None = None
    if config.weights.touch:
        skin = Skin(now.skin, normals, cast.chance[rows], cast.picked.group)
        matches = gather_matches(skin, cast.room.surface, config.match)
    if config.weights.order and cast.watched is not None:
        even = cast.picked.even
        bounds = order_bounds(cast.watched, rows, now.skin[:, even], normals[:, even])
    return replace(known, matches=matches, bounds=bounds)


def _take(bodies: Bodies, rows: Int[Tensor, " rows"]) -> Bodies:
    pose = None if bodies.pose is None else pose_rows(bodies.pose, rows)
    joints = None if bodies.joints is None else bodies.joints[rows]
    return replace(
        bodies, verts=bodies.verts[rows], joints=joints, frame=bodies.frame[rows],
        person=bodies.person[rows], pose=pose,
    )  # fmt: skip


def _put(
    whole: Correction | None, part: Correction, rows: Int[Tensor, " rows"], keep: slice, count: int
) -> Correction:
    """Write the kept rows of a part into the correction of everybody."""

    def into(name: str) -> Tensor:
        value = getattr(part, name)[keep]
        before = value.new_zeros(count, value.shape[1]) if whole is None else getattr(whole, name)
        return before.index_copy(0, rows, value)

    return Correction(into("shift"), into("turn"), into("angles"))
