"""edits.json: a user's corrections of a room, in their order (docs/view.md)."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from ..edits import Add, Delete, Edit, Pin, Place, Placement, Relabel
from ..furniture.library import PIECES, STYLES
from .fields import (
    LAST_ID,
    At,
    choice,
    get,
    integer,
    items,
    maybe,
    number,
    plain,
    positive,
    read_json,
    refuse,
    text,
    vector,
    write_json,
)
from .scene_file import SAFE_ID, WORDS

FORMAT, VERSION = "mover-edits", 1


def read_edits(path: Path) -> tuple[Edit, ...]:
    """Read and check a list of edits; whether their objects exist shows when they are applied.

    Raises:
        InputError: If anything in it is wrong.
    """
    at = read_json(path)
    choice(get(at, "format"), (FORMAT,))
    integer(get(at, "version"), VERSION, VERSION)
    return tuple(_edit_of(item) for item in items(get(at, "edits")))


def write_edits(edits: tuple[Edit, ...], path: Path) -> None:
    """Write the list, all at once."""
    tree = {"format": FORMAT, "version": VERSION, "edits": [_edit_to_json(e) for e in edits]}
    write_json(tree, path)


def _edit_of(at: At) -> Edit:
    return _READ[choice(get(at, "do"), tuple(_READ))](at)


def _placement_of(at: At) -> Placement:
    return Placement(
        torch.tensor(vector(get(at, "translation"), 3)),
        torch.tensor(number(get(at, "yaw"))),
        torch.tensor([positive(v) for v in items(get(at, "scale"), 3)]),
        pitch=number(get(at, "pitch"), -1.6, 1.6),
        roll=number(get(at, "roll"), -3.2, 3.2),
    )


def _add_of(at: At) -> Add:
    name = get(at, "id")
    if not SAFE_ID.fullmatch(text(name)) or name.value.casefold() in WORDS:
        refuse(name, "letters, digits, '_', '-' or '.', not 'ground' or 'free'")
    piece = choice(get(at, "piece"), tuple(PIECES))
    annotation = maybe(at, "annotation")
    return Add(
        id=name.value,
        piece=piece,
        style=integer(get(at, "style"), 0, STYLES[piece] - 1),
        seed=integer(get(at, "seed"), 0, LAST_ID),
        annotation=None if annotation is None else integer(annotation, 0, LAST_ID),
        at=_placement_of(at),
    )


def _pin_of(at: At) -> Pin:
    pinned = get(at, "pinned")
    if not isinstance(pinned.value, bool):
        refuse(pinned, "true or false")
    return Pin(text(get(at, "id")), pinned.value)


_READ: dict[str, Callable[[At], Edit]] = {
    "place": lambda at: Place(text(get(at, "id")), _placement_of(at)),
    "relabel": lambda at: Relabel(text(get(at, "id")), text(get(at, "category"))),
    "pin": _pin_of,
    "delete": lambda at: Delete(text(get(at, "id"))),
    "add": _add_of,
}


def _edit_to_json(edit: Edit) -> dict[str, Any]:
    match edit:
        case Place():
            return {"do": "place", "id": edit.id, **_placement_to_json(edit.at)}
        case Relabel():
            return {"do": "relabel", "id": edit.id, "category": edit.category}
        case Pin():
            return {"do": "pin", "id": edit.id, "pinned": edit.pinned}
        case Delete():
            return {"do": "delete", "id": edit.id}
        case Add():
            shown = {} if edit.annotation is None else {"annotation": edit.annotation}
            made = {"piece": edit.piece, "style": edit.style, "seed": edit.seed, **shown}
            return {"do": "add", "id": edit.id, **made, **_placement_to_json(edit.at)}


def _placement_to_json(at: Placement) -> dict[str, Any]:
    return {
        "translation": plain(at.t_world_object), "yaw": plain(at.yaw), "scale": plain(at.scale),
        "pitch": at.pitch, "roll": at.roll,
    }  # fmt: skip
