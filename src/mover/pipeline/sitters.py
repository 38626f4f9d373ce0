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
    floor_now,
    is_pinned,
    scale_spread,
)
from mover.stages.objects.bend_shapes import with_lifted_seats
from mover.stages.objects.gather_given import UNFIT, prior_weights
from mover.stages.objects.room_scale import ScaleKnown, common_scale, seats_tell
from mover.stages.objects.seat_heights import SeatInputs, find_seat_heights
from mover.stages.people.find_depth import nearer


def with_seats_lifted(
    context: ReconstructionContext, people: PeopleState, state: SceneState
) -> ReconstructionContext:
    """The seats of loose shapes as high as people tell who are assigned to them."""
    config = context.config
    if not config.bend.seat or context.misfit is None or state.contacts is None:
        return context
    loose = (prior_weights(context.misfit) >= UNFIT) & ~is_pinned(context)
    if not bool(loose.any()):
        return context
    bodies = in_world(rows_of(people.bodies, people.kept), state.camera)
    inputs = SeatInputs(
        context.prepared.objects, state.placed.layout, bodies, people.parts,
        floor_now(context, state), state.contacts.pairs, loose,
    )  # fmt: skip
    found = context.run.stage(find_seat_heights, inputs, config.bend)
    return replace(context, prepared=with_lifted_seats(context.prepared, found.lift))


def with_common_scale(
    context: ReconstructionContext, people: PeopleState, state: SceneState
) -> tuple[PeopleState, SceneState]:
    """The whole room larger or smaller where nothing but the furniture tells its scale."""
    given = state.descent[0].image.given
    spread, shared = scale_spread(context, people), context.capture.scene.size_spread
    if given is None or not spread:
        return people, state
    kept = in_world(rows_of(people.bodies, people.kept), state.camera)
    floor = floor_now(context, state)
    seats = seats_tell(kept, people.parts, floor) if context.config.seat_heights else None
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
