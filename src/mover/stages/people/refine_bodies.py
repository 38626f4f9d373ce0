"""Refine the bodies with the room that they helped to find (Sec. "HPS estimation", after PROX).

With the parameters of a body model the pose is refined, bare meshes are moved as a whole. Rows are
taken a few hundred at a time, in the order of their tracks, with neighbours on both sides that are
moved along and thrown away, so that memory does not grow with the video.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.bodies.corrected import (
    Correction,
    MovedSkin,
    Puppet,
    corrected,
    moved,
    no_correction,
    normals_after,
    puppet_of,
)
from mover.bodies.parts import PARTS, parts_of
from mover.bodies.posture import postures, touching
from mover.bodies.skeleton import SIDES
from mover.core.errors import InputError
from mover.core.observe import Energy, Observer, silent
from mover.core.records import map_tensors, record, rows_of, with_rows
from mover.core.types import Bodies, Camera, Capture, Room
from mover.energy.body_contact import Matches, Skin, gather_matches
from mover.energy.body_terms import (
    ANGLE,
    Bounds,
    Neighbours,
    Outline,
    body_energy,
    depth_share,
    gather_neighbours,
)
from mover.energy.config import REFINE, BodyWeights
from mover.energy.minimize import minimize
from mover.geometry.camera import to_camera
from mover.geometry.path import is_still
from mover.geometry.placement import changes, mover_at, placed_at
from mover.geometry.volume import Volume
from mover.stages.config import RefineBodiesConfig
from mover.stages.masks import MaskTable, mask_table
from mover.stages.people.body_evidence import (
    Picked,
    SeenBodies,
    Surroundings,
    gather_outlines,
    order_bounds,
    pick,
    resting_soles,
    sure_masks,
    surroundings_of,
)
from mover.stages.people.plant_feet import plant_feet

RHOS = (0.15, 0.06)  # [m], where a contact costs half of the most, in the first and last round


@dataclass(frozen=True)
class BodyEvidence:
    """What is known about some rows of the bodies."""

    camera: Camera
    floor: float
    """Its height in the world [m]."""
    furniture: Volume | None
    near: Neighbours
    soles: Bool[Tensor, "feet picked"]
    """Which picked vertices they are."""
    rest: Float[Tensor, "bodies feet"]
    """Chance that each is at rest and carries the body."""
    even: Bool[Tensor, " picked"]
    """Points of the skin that lie evenly over the body."""
    rho: float = 0.1
    """Of the contact [m]."""
    matches: Matches | None = None
    bounds: Bounds | None = None
    outline: Outline | None = None


@dataclass(frozen=True)
class MovedBodies:
    """The bodies after a correction, and what several terms need of them."""

    by: Correction
    puppet: Puppet
    known: BodyEvidence

    def has(self, name: str) -> bool:
        """Whether the evidence of a term is there."""
        if name in ("given", "feet"):
            return name == "given" or bool(self.known.soles.any())
        found = getattr(self.known, name, None)
        return len(found.body) > 0 if isinstance(found, Matches | Outline) else found is not None

    @cached_property
    def now(self) -> MovedSkin:
        """Where picked vertices and joints are [m]."""
        return moved(self.puppet, self.by)

    def in_camera(self, points: Float[Tensor, "*any 3"]) -> Float[Tensor, "*any 3"]:
        """Points of the world in camera axes [m]."""
        return to_camera(points, self.known.camera.R_cam_world)

    @cached_property
    def points_cam(self) -> Float[Tensor, "bodies points 3"]:
        """Joints in camera axes [m]."""
        return self.in_camera(self.now.points)

    @cached_property
    def start_cam(self) -> Float[Tensor, "bodies points 3"]:
        """The same before the correction [m]."""
        return self.in_camera(self.puppet.points)

    @cached_property
    def share(self) -> Float[Tensor, " bodies"]:
        """Logarithm of the factor by which depths have changed."""
        return depth_share(self.points_cam[:, 0], self.start_cam[:, 0])

    @cached_property
    def angles(self) -> Float[Tensor, "bodies angles"]:
        """All by which the body was turned [rad]."""
        return torch.cat([self.by.turn, self.by.angles], -1)

    @cached_property
    def even(self) -> Float[Tensor, "bodies even 3"]:
        """Points that lie evenly over the skin [m]."""
        return self.now.skin[:, self.known.even]

    @cached_property
    def feet(self) -> tuple[Float[Tensor, "bodies feet 3"], Float[Tensor, "bodies feet 3"]]:
        """Middle of each sole, and its middle again at the height of its lower half [m]."""
        middles, lows = list[Tensor](), list[Tensor]()
        for own in self.known.soles:  # two feet
            sole = self.now.skin[:, own]
            middle = sole.mean(1) if sole.shape[1] else self.now.points[:, 0]
            heights = sole[..., 1].sort(1).values[:, : max(1, (sole.shape[1] + 1) // 2)]
            low = heights.mean(1) if sole.shape[1] else middle[:, 1]
            middles.append(middle)
            lows.append(torch.stack([middle[:, 0], low, middle[:, 2]], -1))
        return torch.stack(middles, 1), torch.stack(lows, 1)


@dataclass(frozen=True)
class RefineScene:
    """All people, and what is known before anything moves."""

    bodies: Bodies
    picked: Picked
    room: Surroundings
    chance: Float[Tensor, "bodies picked"]
    rest: Float[Tensor, "bodies feet"]
    lying: Bool[Tensor, " bodies"]
    masks: MaskTable | None


def scene_of(room: Room, capture: Capture | None, weights: BodyWeights) -> RefineScene:
    """All people and the room, before anything moves.

    Raises:
        InputError: If the room has no bodies or no floor.
    """
    bodies, floor = room.bodies, room.scene.ground
    if bodies is None or not len(bodies.frame) or floor is None:
        lack = "bodies" if floor is not None else "floor"
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
    chance = given if given is not None else touching(bodies, parts, floor)
    lying = postures(bodies, parts, floor).lying
    # without the soles, which the floor holds, and forearms, which seem to rest in the air
    without = torch.tensor([PARTS.index(f"{s}_{p}") for s in SIDES for p in ("sole", "forearm")])
    chance = torch.where(torch.isin(picked.part, without), 0.0, chance[:, picked.index].float())
    return RefineScene(
        bodies, picked, surroundings, chance, resting_soles(bodies, parts, lying), lying,
        None if people is None else mask_table(people, bodies),
    )  # fmt: skip


def gathered(
    scene: RefineScene,
    rows: Int[Tensor, " rows"],
    bodies: Bodies,
    state: MovedBodies,
    weights: BodyWeights,
    sure: Bool[Tensor, "2 rows h w"] | None,
) -> BodyEvidence:
    """Contacts, occlusion bounds and outline targets at the current poses of some rows.

    `bodies` are these rows as they were given; `sure` are their masks if the order counts.
    """
    known, puppet, room = state.known, state.puppet, scene.room
    with torch.no_grad():
        now, normals = state.now, normals_after(puppet, state.by)
    matches, bounds, outline = None, None, None
    if weights.touch:
        skin = Skin(  # errors of poses count where they are not corrected
            points=now.skin, normals=normals, chance=scene.chance[rows], group=scene.picked.group,
            track=known.near.track, pivot=now.points[:, 0], flat=scene.lying[rows],
            bent=ANGLE if puppet.model is None else 0.0,
        )  # fmt: skip
        matches = gather_matches(skin, room.surface, room.furniture)
    if sure is not None:
        even = scene.picked.even
        bounds = order_bounds(room, sure, now.skin[:, even], normals[:, even])
    if weights.outline and scene.masks is not None:
        whole = replace(bodies, pose=None) if puppet.model is None else bodies
        verts = state.in_camera(corrected(whole, state.by).verts)
        skin = verts[:, scene.picked.index]
        seen = SeenBodies(verts, bodies.faces, skin, room.camera, room.front)
        outline = gather_outlines(seen, scene.masks, rows)
    return replace(known, matches=matches, bounds=bounds, outline=outline)


SMOOTHED = BodyWeights(angles=1.0, image=1.0, range=1.0, smooth=1.0, steady=0.5)
"""No room at all: smooth in time, near to what was given."""
FLOOR = replace(SMOOTHED, under=1.0, stand=1.0, lock=1.0)
ABLATION = {
    "baseline": SMOOTHED,
    "+CamGP": FLOOR,
    "+CamGP+SDF": replace(FLOOR, sink=1.0),
    "+CamGP+Contact": replace(FLOOR, touch=1.0),
    "+CamGP+SDF+Contact": replace(FLOOR, sink=1.0, touch=1.0),
    "masks": replace(SMOOTHED, outline=1.0),
    "masks+CamGP": replace(FLOOR, outline=1.0),
    "masks+CamGP+SDF+Contact": replace(FLOOR, outline=1.0, sink=1.0, touch=1.0),
    "all": REFINE,
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
    room: Room, capture: Capture | None, config: RefineBodiesConfig, observe: Observer = silent
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
        ids, touch = {piece.id for piece, _ in still}, capture.touch
        given = tuple(piece for piece in capture.scene.objects if piece.id in ids)
        capture = replace(
            capture, scene=replace(capture.scene, objects=given),
            touch=None if touch is None else touch[rows],
        )  # fmt: skip
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
    found, energy = no_correction(scene.bodies), torch.zeros(len(order))
    for first in range(0, len(order), config.rows):
        inner = torch.tensor(order[first : first + config.rows])
        start = max(0, first - config.overlap)
        rows = torch.tensor(order[start : first + config.rows + config.overlap])
        by, left = _refine(scene, rows, config, observe)
        keep = torch.arange(first - start, first - start + len(inner))
        found = with_rows(found, inner, rows_of(by, keep))
        energy[inner] = left[keep]
    bodies, shift = corrected(scene.bodies, found), found.shift
    if config.weights.lock:  # soles at rest are put still
        planted = plant_feet(bodies, parts_of(bodies), scene.room.floor)
        shift = shift + (planted.verts - bodies.verts).mean(1)
        bodies = planted
    return RefinedBodies(bodies, shift, energy)


def _refine(
    scene: RefineScene, rows: Int[Tensor, " rows"], config: RefineBodiesConfig, observe: Observer
) -> tuple[Correction, Float[Tensor, " rows"]]:
    """Some rows, in rounds: first moved as a whole, then with their pose."""
    bodies, room, picked = rows_of(scene.bodies, rows), scene.room, scene.picked
    puppet = puppet_of(bodies, picked.index)
    stiff = replace(puppet, model=None, pose=None)
    known = BodyEvidence(
        room.camera, room.floor, room.firm,
        gather_neighbours(bodies.frame, bodies.person, bodies.fps),
        torch.stack([picked.part == 0, picked.part == 1]), scene.rest[rows], picked.even,
    )  # fmt: skip
    by, left = no_correction(stiff), torch.zeros(len(rows))
    total = config.places + config.rounds
    masks = scene.masks if config.weights.order else None
    sure = None if masks is None else sure_masks(masks, room.camera, rows)
    for turn in range(total):
        now, method = (stiff, config.place) if turn < config.places else (puppet, config.method)
        by = _started(now, by)
        share = turn / max(1, total - 1)
        rho = RHOS[0] * (RHOS[1] / RHOS[0]) ** share
        moved = MovedBodies(by, now, known)
        known = gathered(scene, rows, bodies, moved, config.weights, sure)
        state = MovedBodies(by, now, replace(known, rho=rho))

        def energy(by: Correction, state: MovedBodies = state) -> Energy:
            return body_energy(replace(state, by=by), config.weights)

        found = minimize(energy, by, method, observe, "refine_bodies")
        by, left = found.at, found.value
    return _started(puppet, by), left


def _started(puppet: Puppet, by: Correction) -> Correction:
    """The same correction with the angles of this puppet, which were not free before."""
    none = no_correction(puppet)
    same = none.angles.shape == by.angles.shape
    return by if same else replace(none, shift=by.shift, turn=by.turn)
