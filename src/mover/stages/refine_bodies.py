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

from ..bodies.corrected import Correction, Puppet, corrected, no_correction, puppet_of
from ..bodies.thinned import pose_rows
from ..minimize import Adam, Observer, minimize, silent
from ..records import record
from ..terms.body_contact import MatchConfig
from ..types import Bodies, Capture, Room
from .body_cast import Acted, Cast, cast_of, known_of, looked
from .body_energy import BodyWeights, body_energy


@dataclass(frozen=True)
class RefineBodiesConfig:
    """How bodies are refined with the room."""

    weights: BodyWeights = field(default_factory=BodyWeights)
    match: MatchConfig = field(default_factory=MatchConfig)
    place: Adam = field(default_factory=lambda: Adam(60, 0.02, 0.004, beta2=0.98))
    """The descent of one round that moves bodies as a whole."""
    places: int = 2
    """How many of these rounds come first."""
    method: Adam = field(default_factory=lambda: Adam(25, 0.01, 0.003, beta2=0.98))
    """The descent of one round that changes poses too."""
    rounds: int = 3
    """How often contacts and depth order are looked for anew."""
    rhos: tuple[float, float] = (0.15, 0.06)
    """Distances at which a contact pays half, in the first and in the last round [m]."""
    rows: int = 512
    """Bodies that are moved at once."""
    overlap: int = 12
    """Rows on both sides that are moved along."""


SMOOTHED = BodyWeights(under=0.0, stand=0.0, lock=0.0, sink=0.0, touch=0.0, order=0.0, outline=0.0)
"""No room at all: smooth in time, near to what was given."""
ABLATION = {
    "baseline": SMOOTHED,
    "+CamGP": replace(SMOOTHED, under=1.0, stand=1.0, lock=1.0),
    "+CamGP+SDF": replace(BodyWeights(), touch=0.0, order=0.0, outline=0.0),
    "+CamGP+Contact": replace(BodyWeights(), sink=0.0, order=0.0, outline=0.0),
    "+CamGP+SDF+Contact": replace(BodyWeights(), order=0.0, outline=0.0),
    "masks": replace(SMOOTHED, outline=1.0),
    "masks+CamGP": replace(SMOOTHED, under=1.0, stand=1.0, lock=1.0, outline=1.0),
    "masks+CamGP+SDF+Contact": replace(BodyWeights(), order=0.0),
    "all": BodyWeights(),
}
"""Weights of the paper's table, the same with the outlines of masks, and with the depth order."""


@record
class RefinedBodies:
    """People whose bodies agree with the room."""

    bodies: Bodies
    """All rows, in the world of the room."""
    shift: Float[Tensor, "bodies 3"]
    """How far each pelvis has moved [m]."""
    energy: Float[Tensor, " bodies"]
    """What is left of the price [nats]."""


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
    cast = cast_of(room, capture, config.weights)
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


def _refine(
    cast: Cast, rows: Int[Tensor, " rows"], config: RefineBodiesConfig, observe: Observer
) -> tuple[Correction, Float[Tensor, " rows"]]:
    """Some rows, in rounds: first moved as a whole, then with their pose."""
    bodies = _take(cast.bodies, rows)
    puppet = puppet_of(bodies, cast.picked.index)
    stiff = replace(puppet, model=None, pose=None)
    by, known = no_correction(stiff), known_of(cast, bodies, rows)
    left = torch.zeros(len(rows))
    total = config.places + config.rounds
    for turn in range(total):
        now, method = (stiff, config.place) if turn < config.places else (puppet, config.method)
        by = _begun(now, by)
        share = turn / max(1, total - 1)
        rho = config.rhos[0] * (config.rhos[1] / config.rhos[0]) ** share
        acted = Acted(rows, bodies, now, by)
        known = replace(looked(cast, acted, known, config.weights, config.match), rho=rho)
        energy = partial(body_energy, puppet=now, known=known, weights=config.weights)
        found = minimize(energy, by, method, observe, "refine_bodies")
        by, left = found.at, found.value
    return _begun(puppet, by), left


def _begun(puppet: Puppet, by: Correction) -> Correction:
    """The same correction with the angles of this puppet, which were not free before."""
    none = no_correction(puppet)
    if none.angles.shape == by.angles.shape:
        return by
    return replace(none, shift=by.shift, turn=by.turn)


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
