"""What those who sit tell besides the layout: how large the room is, how high its seats are."""

import math
from dataclasses import replace

from mover.bodies.corrected import in_world
from mover.core.records import rows_of
from mover.geometry.path import scaled
from mover.geometry.placement import larger
from mover.pipeline.outcome import (
    PeopleState,
    ReconstructionContext,
    SceneState,
    scale_spread,
)
from mover.stages.objects.room_scale import ScaleKnown, common_scale, seats_tell
from mover.stages.objects.seat_heights import SeatInputs, find_seat_heights, with_lifted_seats
from mover.stages.people.find_depth import nearer


def with_seats_lifted(
    context: ReconstructionContext, people: PeopleState, state: SceneState
) -> ReconstructionContext:
    """The seats of shapes that do not fit as high as people sit who are assigned to them."""
    if context.unfit is None or not bool(context.unfit.any()) or state.contacts is None:
        return context
    bodies = in_world(rows_of(people.bodies, people.kept), state.camera)
    lift = find_seat_heights(SeatInputs(
        context.prepared.objects, state.placed.layout, bodies, people.parts,
        state.ground, state.contacts.pairs, context.unfit,
    ))  # fmt: skip
    return replace(context, prepared=with_lifted_seats(context.prepared, lift))


def with_common_scale(
    context: ReconstructionContext, people: PeopleState, state: SceneState
) -> tuple[PeopleState, SceneState]:
    """The whole room larger or smaller where nothing but the furniture tells its scale."""
    given = state.descent[0].image.given
    spread, shared = scale_spread(context, people), context.capture.scene.size_spread
    if given is None or not spread:
        return people, state
    kept = in_world(rows_of(people.bodies, people.kept), state.camera)
    seats = seats_tell(kept, people.parts, state.ground) if context.config.seat_heights else None
    known = ScaleKnown(spread, shared, seats)
    scale, _ = common_scale(state.placed.layout, given, known)
    factor = math.exp(-scale)
    bodies = nearer(people.bodies, state.camera, state.ground, factor)
    layouts = (state.start, state.alone, state.placed.layout, state.placed.candidates)
    start, single, layout, candidates = (larger(x, factor) for x in layouts)
    placed = replace(state.placed, layout=layout, candidates=candidates)
    state = replace(
        state, ground=factor * state.ground, start=start, alone=single, placed=placed,
    )  # fmt: skip
    return replace(people, bodies=bodies, path=scaled(people.path, factor)), state
