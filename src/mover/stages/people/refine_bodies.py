"""Refine the bodies with the room that they helped to find (Sec. "HPS estimation", after PROX).

With the parameters of a body model the pose is refined, bare meshes are moved as a whole. Rows are
taken a few hundred at a time, in the order of their tracks, with neighbours on both sides that are
moved along and thrown away, so that memory does not grow with the video.
"""

from dataclasses import dataclass, replace
from functools import partial

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.bodies.corrected import (
    Correction,
    Puppet,
    corrected,
    moved,
    no_correction,
    normals_after,
    puppet_of,
)
from mover.bodies.parts import parts_of
from mover.bodies.posture import postures, touching
from mover.bodies.skin import PARTS
from mover.core.errors import InputError
from mover.core.observe import Observer, silent
from mover.core.records import map_tensors, record, rows_of, with_rows
from mover.core.types import Bodies, Capture, Room
from mover.energy.body_contact import Matches, Skin, gather_matches
from mover.energy.body_terms import ANGLE, Bounds, Outline, gather_neighbours
from mover.energy.config import BodyWeights, MatchConfig
from mover.energy.minimize import minimize
from mover.geometry.camera import to_camera
from mover.geometry.path import is_still
from mover.geometry.placement import changes, mover_at, placed_at
from mover.stages.config import RefineBodiesConfig
from mover.stages.people.body_energy import BodyEvidence, SolePoints, body_energy
from mover.stages.people.body_evidence import (
    Picked,
    Surroundings,
    Watched,
    order_bounds,
    pick,
    resting_soles,
    surroundings_of,
    watched_of,
)
from mover.stages.people.body_outlines import SeenBodies, gather_outlines
from mover.stages.people.plant_feet import plant_feet

SIDES = ("left", "right")


@dataclass(frozen=True)
class RefineScene:
    """All people, and what is known before anything moves."""

    bodies: Bodies
    picked: Picked
    room: Surroundings
    chance: Float[Tensor, "bodies picked"]
    rest: Float[Tensor, "bodies feet"]
    lying: Bool[Tensor, " bodies"]
    watched: Watched | None


@dataclass(frozen=True)
class MovedRows:
    """Some rows where they are now."""

    rows: Int[Tensor, " rows"]
    bodies: Bodies
    """As they were given."""
    puppet: Puppet
    by: Correction


def scene_of(room: Room, capture: Capture | None, weights: BodyWeights) -> RefineScene:
    """All people and the room, before anything moves.

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
    moves = capture is not None and not is_still(capture.path)  # masks are seen from elsewhere
    people = None if capture is None or not asked or moves else capture.people
    given = None if capture is None else capture.touch
    if given is not None and given.shape != bodies.verts.shape[:2]:
        given = None
    chance = given if given is not None else touching(bodies, parts, surroundings.floor)
    lying = postures(bodies, parts, surroundings.floor).lying
    rest = resting_soles(bodies, parts, lying)
    # without the soles, which the floor holds, and forearms, which seem to rest in the air
    without = torch.tensor([PARTS.index(f"{s}_{p}") for s in SIDES for p in ("sole", "forearm")])
    chance = torch.where(torch.isin(picked.part, without), 0.0, chance[:, picked.index].float())
    watched = watched_of(surroundings, people, bodies)
    return RefineScene(bodies, picked, surroundings, chance, rest, lying, watched)


def known_of(scene: RefineScene, bodies: Bodies, rows: Int[Tensor, " rows"]) -> BodyEvidence:
    """What does not change while the bodies move."""
    room = scene.room
    soles = torch.stack([scene.picked.part == 0, scene.picked.part == 1])
    return BodyEvidence(
        camera=room.camera, floor=room.floor, furniture=room.firm,
        near=gather_neighbours(bodies.frame, bodies.person, bodies.fps),
        feet=SolePoints(soles, scene.rest[rows]), matches=None, bounds=None, rho=0.1,
        even=scene.picked.even,
    )  # fmt: skip


def looked(
    scene: RefineScene,
    moved_rows: MovedRows,
    known: BodyEvidence,
    weights: BodyWeights,
    match: MatchConfig,
) -> BodyEvidence:
    """Gather contacts, occlusion bounds and outline targets again at the current poses."""
    puppet, by, rows = moved_rows.puppet, moved_rows.by, moved_rows.rows
    with torch.no_grad():
        now, normals = moved(puppet, by), normals_after(puppet, by)
    matches: Matches | None = None
    bounds: Bounds | None = None
    if weights.touch:
        skin = Skin(  # errors of poses count where they are not corrected
            points=now.skin, normals=normals, chance=scene.chance[rows], group=scene.picked.group,
            track=known.near.track, pivot=now.points[:, 0], flat=scene.lying[rows],
            bent=ANGLE if puppet.model is None else 0.0,
        )  # fmt: skip
        matches = gather_matches(skin, scene.room.surface, match, scene.room.furniture)
    if weights.order and scene.watched is not None:
        even = scene.picked.even
        bounds = order_bounds(scene.watched, rows, now.skin[:, even], normals[:, even])
    outline: Outline | None = None
    if weights.outline and scene.watched is not None:
        outline = _outlines(scene, moved_rows)
    return replace(known, matches=matches, bounds=bounds, outline=outline)


def _outlines(scene: RefineScene, moved_rows: MovedRows) -> Outline:
    """The outlines of the bodies where they stand now, against their masks."""
    assert scene.watched is not None
    room, bodies, rows = scene.room, moved_rows.bodies, moved_rows.rows
    rigid = moved_rows.puppet.model is None
    whole = corrected(replace(bodies, pose=None) if rigid else bodies, moved_rows.by)
    verts = to_camera(whole.verts, room.camera.R_cam_world)
    skin = verts[:, scene.picked.index]
    seen = SeenBodies(verts, bodies.faces, skin, room.camera, room.front)
    return gather_outlines(seen, scene.watched.table, rows)


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
    """What is left of the cost [nats]."""


def refine_bodies(
    room: Room,
    capture: Capture | None,
    config: RefineBodiesConfig,
    observe: Observer = silent,
) -> RefinedBodies:
    """Move the people of a room so that they agree with its floor and furniture.

    Furniture that is moved stands, for the people of each time between two moves, where it stood
    then; no motion is smoothed over a move. The capture gives masks and known contacts;
    without it there is no depth order.

    Raises:
        InputError: If the room has no bodies or no floor.
    """
    times = sorted({frame for piece in room.scene.objects for frame in changes(piece)})
    if room.bodies is None or not times:
        return _refined(room, capture, config, observe)
    time = torch.bucketize(room.bodies.frame, torch.tensor(times), right=True)
    bodies = map_tensors(lambda x: x.float() if x.is_floating_point() else x, room.bodies)
    found = RefinedBodies(bodies, torch.zeros(len(time), 3), torch.zeros(len(time)))
    for now in time.unique():
        rows = (time == now).nonzero()[:, 0]
        part, given = _at_one_time(room, capture, rows)
        found = with_rows(found, rows, _refined(part, given, config, observe))
    return found


def _at_one_time(
    room: Room, capture: Capture | None, rows: Int[Tensor, " rows"]
) -> tuple[Room, Capture | None]:
    """The room with some of its people, and its furniture where it stands while they are there.

    Objects that people move in that time are left out: they follow hands or the seated body.
    """
    assert room.bodies is not None
    bodies = rows_of(room.bodies, rows)
    now = int(bodies.frame.min())
    pairs = zip(room.scene.objects, room.proxies, strict=True)
    still = [(placed_at(p, now), proxy) for p, proxy in pairs if mover_at(p, now) is None]
    scene = replace(room.scene, objects=tuple(piece for piece, _ in still))
    room = replace(room, proxies=tuple(proxy for _, proxy in still))
    if capture is not None:
        ids = {piece.id for piece, _ in still}
        given = tuple(piece for piece in capture.scene.objects if piece.id in ids)
        capture = replace(capture, scene=replace(capture.scene, objects=given))
    if capture is not None and capture.touch is not None:
        capture = replace(capture, touch=capture.touch[rows])
    return replace(room, scene=scene, bodies=bodies, kept=None), capture


def _refined(
    room: Room, capture: Capture | None, config: RefineBodiesConfig, observe: Observer
) -> RefinedBodies:
    """The people of a room whose furniture stays where it is."""
    scene = scene_of(room, capture, config.weights)
    order = sorted(
        range(len(scene.bodies.frame)),
        key=lambda k: (int(scene.bodies.person[k]), int(scene.bodies.frame[k])),
    )
    found: Correction | None = None
    energy = torch.zeros(len(order))
    for first in range(0, len(order), config.rows):
        inner = order[first : first + config.rows]
        start = max(0, first - config.overlap)
        rows = torch.tensor(order[start : first + config.rows + config.overlap])
        by, left = _refine(scene, rows, config, observe)
        keep = slice(first - start, first - start + len(inner))
        found = _put(found, by, torch.tensor(inner), keep, len(order))
        energy[inner] = left[keep]
    assert found is not None, "bodies have at least one row"
    bodies, shift = corrected(scene.bodies, found), found.shift
    if config.plant and config.weights.lock:
        planted = plant_feet(bodies, parts_of(bodies), scene.room.floor)
        shift = shift + (planted.verts - bodies.verts).mean(1)
        bodies = planted
    return RefinedBodies(bodies, shift, energy)


def _refine(
    scene: RefineScene, rows: Int[Tensor, " rows"], config: RefineBodiesConfig, observe: Observer
) -> tuple[Correction, Float[Tensor, " rows"]]:
    """Some rows, in rounds: first moved as a whole, then with their pose."""
    bodies = rows_of(scene.bodies, rows)
    puppet = puppet_of(bodies, scene.picked.index)
    stiff = replace(puppet, model=None, pose=None)
    by, known = no_correction(stiff), known_of(scene, bodies, rows)
    left = torch.zeros(len(rows))
    total = config.places + config.rounds
    for turn in range(total):
        now, method = (stiff, config.place) if turn < config.places else (puppet, config.method)
        by = _started(now, by)
        share = turn / max(1, total - 1)
        rho = config.rhos[0] * (config.rhos[1] / config.rhos[0]) ** share
        moved_rows = MovedRows(rows, bodies, now, by)
        known = replace(looked(scene, moved_rows, known, config.weights, config.match), rho=rho)
        energy = partial(body_energy, puppet=now, known=known, weights=config.weights)
        found = minimize(energy, by, method, observe, "refine_bodies")
        by, left = found.at, found.value
    return _started(puppet, by), left


def _started(puppet: Puppet, by: Correction) -> Correction:
    """The same correction with the angles of this puppet, which were not free before."""
    none = no_correction(puppet)
    if none.angles.shape == by.angles.shape:
        return by
    return replace(none, shift=by.shift, turn=by.turn)


def _put(
    whole: Correction | None, part: Correction, rows: Int[Tensor, " rows"], keep: slice, count: int
) -> Correction:
    """Write the kept rows of a part into the correction of all people."""

    def into(name: str) -> Tensor:
        value = getattr(part, name)[keep]
        before = value.new_zeros(count, value.shape[1]) if whole is None else getattr(whole, name)
        return before.index_copy(0, rows, value)

    return Correction(into("shift"), into("turn"), into("angles"))
