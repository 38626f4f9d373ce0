"""What people rest on that is not in a finished room."""

from dataclasses import replace

import torch

from mover.bodies.corrected import in_world
from mover.core.records import rows_of
from mover.core.run import Run
from mover.core.types import Capture, Room
from mover.pipeline.outcome import PeopleState, ReconstructionContext, SceneState
from mover.pipeline.presets import Config
from mover.stages.contacts.assign_contacts import ContactInputs, find_contacts
from mover.stages.contacts.gather_cues import GatherInputs, hidden_by_unknown
from mover.stages.contacts.propose_supports import leans_on_nothing, propose_supports
from mover.stages.contacts.resting import KnownTops, ProposeInputs, known_tops
from mover.stages.objects.find_image_cues import image_evidence


def with_proposals(
    room: Room,
    capture: Capture,
    config: Config,
    run: Run,
    people: PeopleState | None,
    known: KnownTops,
) -> Room:
    """The room with what people rest on that is not in it."""
    camera, floor = room.scene.camera, room.scene.ground
    if people is None or floor is None or not config.propose.use:
        return room
    bodies = in_world(rows_of(people.bodies, people.kept), camera)
    given = None if capture.touch is None else capture.touch[people.kept]
    contacts = ContactInputs(bodies, people.parts, floor, given)
    chance = run.stage(find_contacts, contacts, config.contacts).probability
    inputs = ProposeInputs(bodies, people.parts, chance, floor, camera, known)
    if leans_on_nothing(inputs, config.propose):
        sight = GatherInputs(
            bodies, capture.people, image_evidence(capture).masks, camera, people.path
        )
        inputs = replace(inputs, hidden=hidden_by_unknown(sight, config.gather))
    return replace(room, proposals=run.stage(propose_supports, inputs, config.propose).found)


def told_of_proposals(room: Room) -> Room:
    """The room with a sentence for each proposal."""
    sentences = (
        f"{one.object.id}: people rest for {one.seconds:.0f} s on nothing that is known; a"
        f" {one.object.category} is proposed there (certainty {one.certainty:.2f})"
        for one in room.proposals
    )
    return replace(room, warnings=(*room.warnings, *sentences))


def tops_of(context: ReconstructionContext, state: SceneState) -> KnownTops:
    """What of the placed room can carry people, and how far rays of the image are free."""
    maps = None if state.cues is None else state.cues.maps
    known = known_tops(
        context.prepared.objects, state.placed.layout, context.seen.masks, state.camera
    )
    free = known.free if maps is None else torch.maximum(known.free, maps.free.to(known.free))
    return replace(known, free=free)
