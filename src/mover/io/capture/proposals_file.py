"""proposed.json: supports that no detector saw, as a scene of their own beside the result."""

import dataclasses
from pathlib import Path
from typing import Annotated

from msgspec import Meta, Struct

from mover.core.types import Proposal, Room
from mover.io.capture.scene_file import read_scene, write_scene
from mover.io.files.fields import read_json
from mover.io.files.schema import Id, Number, Text, checked

PROPOSED = "proposed.json"


class ProposalFields(Struct, frozen=True):
    """What a row of proposed.json has beside the fields of an object."""

    id: Text
    piece: Text
    style: Id
    seed: Id
    certainty: Annotated[float, Meta(ge=0, le=1)]
    bodies: Id
    seconds: Number


class ProposedFields(Struct, frozen=True):
    """proposed.json."""

    objects: list[ProposalFields]


def write_proposals(room: Room, path: Path) -> None:
    """Write proposed.json; where nothing is proposed, one that is there goes."""
    if not room.proposals:
        path.unlink(missing_ok=True)
        return
    pieces = tuple(one.object for one in room.proposals)
    more = {
        one.object.id: {
            key: getattr(one, key)
            for key in ("piece", "style", "seed", "certainty", "bodies", "seconds")
        }
        for one in room.proposals
    }
    write_scene(dataclasses.replace(room.scene, objects=pieces), path, more)


def read_proposals(path: Path) -> tuple[Proposal, ...]:
    """What a result proposes; nothing where there is no such file."""
    if not path.is_file():
        return ()
    rows = checked(read_json(path), ProposedFields).objects
    return tuple(
        Proposal(piece, row.piece, row.style, row.seed, row.certainty, row.bodies, row.seconds)
        for piece, row in zip(read_scene(path).objects, rows, strict=True)
    )
