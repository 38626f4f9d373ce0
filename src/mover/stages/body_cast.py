"""Everybody who is refined, and what is found about them each time they have moved."""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from torch import Tensor

from ..bodies.corrected import Correction, Moved, Puppet, corrected, moved, normals_after
from ..bodies.parts import PARTS, parts_of
from ..bodies.touch import touching
from ..geometry.camera import to_camera
from ..records import InputError, map_tensors
from ..terms.body_contact import MatchConfig, Matches, Skin, gather_matches
from ..terms.body_order import Bounds
from ..terms.body_outline import Outline
from ..terms.body_start import ANGLE
from ..terms.body_time import gather_neighbours
from ..types import Bodies, Capture, Room
from .body_energy import BodyWeights, Evidence, Feet
from .body_evidence import (
    Picked,
    Surroundings,
    Watched,
    order_bounds,
    pick,
    resting_soles,
    surroundings_of,
    watched_of,
)
from .body_outlines import Seen, gather_outlines

SIDES = ("left", "right")


@dataclass(frozen=True)
class Cast:
    """Everybody, and what is known before anything moves."""

    bodies: Bodies
    picked: Picked
    room: Surroundings
    chance: Float[Tensor, "bodies picked"]
    rest: Float[Tensor, "bodies feet"]
    watched: Watched | None


@dataclass(frozen=True)
class Acted:
    """Some rows where they are now."""

    rows: Int[Tensor, " rows"]
    bodies: Bodies
    """As they were given."""
    puppet: Puppet
    by: Correction


def cast_of(room: Room, capture: Capture | None, weights: BodyWeights) -> Cast:
    """Everybody and the room, before anything moves.

    Raises:
        InputError: If the room has no bodies or no floor.
    """
    bodies, ground = room.bodies, room.scene.ground
    if bodies is None or not len(bodies.frame) or ground is None:
        lack = "bodies" if ground is not None else "floor"
        raise InputError(f"the room has no {lack}: there is nothing to refine")
    bodies = map_tensors(lambda x: x.float() if x.is_floating_point() else x, bodies)
    parts = parts_of(bodies)
    picked = pick(bodies, parts)
    surroundings = surroundings_of(room, capture)
    asked = weights.order or weights.outline
    people = None if capture is None or not asked else capture.people
    given = None if capture is None else capture.touch
    if given is not None and given.shape != bodies.verts.shape[:2]:
        given = None
    chance = given if given is not None else touching(bodies, parts, ground)
    rest = resting_soles(bodies, parts, ground)
    return Cast(
        bodies, picked, surroundings, _furniture_only(chance[:, picked.index].float(), picked),
        rest, watched_of(surroundings, people, bodies),
    )  # fmt: skip


def _furniture_only(chance: Tensor, picked: Picked) -> Tensor:
    """Without the soles, which the floor holds, and forearms, which seem to rest in the air."""
    without = torch.tensor([PARTS.index(f"{s}_{p}") for s in SIDES for p in ("sole", "forearm")])
    return torch.where(torch.isin(picked.part, without), torch.zeros_like(chance), chance)


def known_of(cast: Cast, bodies: Bodies, rows: Int[Tensor, " rows"]) -> Evidence:
    """What does not change while the bodies move."""
    room = cast.room
    soles = torch.stack([cast.picked.part == 0, cast.picked.part == 1])
    return Evidence(
        camera=room.camera, ground=room.ground, furniture=room.furniture,
        near=gather_neighbours(bodies.frame, bodies.person, bodies.fps),
        feet=Feet(soles, cast.rest[rows]), matches=None, bounds=None, rho=0.1,
        even=cast.picked.even,
    )  # fmt: skip


def looked(
    cast: Cast, acted: Acted, known: Evidence, weights: BodyWeights, match: MatchConfig
) -> Evidence:
    """Look anew for what the skin touches, what hides it, and where outlines should go."""
    puppet, by, rows = acted.puppet, acted.by, acted.rows
    with torch.no_grad():
        now, normals = moved(puppet, by), normals_after(puppet, by)
    matches: Matches | None = None
    bounds: Bounds | None = None
    if weights.touch:
        skin = _skin(cast, acted, known, now, normals)
        matches = gather_matches(skin, cast.room.surface, match, cast.room.furniture)
    if weights.order and cast.watched is not None:
        even = cast.picked.even
        bounds = order_bounds(cast.watched, rows, now.skin[:, even], normals[:, even])
    outline: Outline | None = None
    if weights.outline and cast.watched is not None:
        outline = _outlines(cast, acted)
    return replace(known, matches=matches, bounds=bounds, outline=outline)


def _skin(cast: Cast, acted: Acted, known: Evidence, now: Moved, normals: Tensor) -> Skin:
    """The skin where it is now; errors of poses count where they are not corrected."""
    return Skin(
        points=now.skin, normals=normals, chance=cast.chance[acted.rows], group=cast.picked.group,
        track=known.near.track, pivot=now.points[:, 0],
        bent=ANGLE if acted.puppet.model is None else 0.0,
    )  # fmt: skip


def _outlines(cast: Cast, acted: Acted) -> Outline:
    """The outlines of the bodies where they stand now, against their masks."""
    assert cast.watched is not None
    room, bodies, rows = cast.room, acted.bodies, acted.rows
    rigid = acted.puppet.model is None
    whole = corrected(replace(bodies, pose=None) if rigid else bodies, acted.by)
    verts = to_camera(whole.verts, room.camera.R_cam_world)
    skin = verts[:, cast.picked.index]
    seen = Seen(verts, bodies.faces, skin, room.camera, room.front)
    return gather_outlines(seen, cast.watched.table, rows)
