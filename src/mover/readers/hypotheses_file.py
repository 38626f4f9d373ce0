"""hypotheses.json: other ways in which the objects of a first scene may stand."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch

from ..geometry.rotations import wrap
from ..types import Piece, Scene
from .fields import (
    At,
    Warn,
    choice,
    get,
    integer,
    items,
    listed,
    mapping,
    number,
    plain,
    positive,
    refuse,
    vector,
    write_json,
)
from .mesh_file import write_mesh
from .scene_file import LoadMesh

FILE, FORMAT, VERSION = "hypotheses.json", "mover-hypotheses", 1
MOST = 16  # of one object
SAME = 0.01  # [m] and [rad]: the first row of an object is its place in the scene


def hypotheses_of(at: At, load: LoadMesh, scene: Scene, warn: Warn) -> tuple[Piece, ...]:
    """Other places and shapes of the scene's objects; a piece's id is that of its object.

    The first row of each object is the one that the scene has. Where it is not, the scene came
    from elsewhere or was changed since, and the object's rows are left out with a warning.

    Args:
        at: The content of the file.
        load: Gives the mesh that a field names.
        scene: The scene beside the file.
        warn: Takes what is odd but not wrong.

    Raises:
        InputError: If a field is wrong.
    """
    choice(get(at, "format"), (FORMAT,))
    integer(get(at, "version"), VERSION, VERSION)
    objects, own = get(at, "objects"), {piece.id: piece for piece in scene.pieces}
    found: list[Piece] = []
    stale: list[str] = []
    for name in mapping(objects):
        rows = items(get(objects, name))
        if len(rows) > MOST:
            refuse(get(objects, name), f"at most {MOST} hypotheses", f"{len(rows)}")
        if name not in own or not rows or not _is_at(rows[0], own[name]):
            stale.append(name)
            continue
        found += [_row_of(row, own[name], load) for row in rows[1:]]
    if stale:
        warn(f"{at.file}: not of this scene, so not used: {listed('object', stale)}")
    return tuple(found)


def _is_at(row: At, piece: Piece) -> bool:
    """Whether a row is where the scene has the object."""
    place = torch.tensor(vector(get(row, "translation"), 3))
    turn = wrap(torch.tensor(number(get(row, "yaw"))) - piece.yaw)
    return float((place - piece.t_world_object).norm()) < SAME and float(turn.abs()) < SAME


def _row_of(row: At, piece: Piece, load: LoadMesh) -> Piece:
    """The object in another place and shape."""
    mesh, file = load(get(row, "mesh"))
    return replace(
        piece,
        mesh=mesh,
        mesh_file=file,
        t_world_object=torch.tensor(vector(get(row, "translation"), 3)),
        yaw=torch.tensor(number(get(row, "yaw"))),
        scale=torch.tensor([positive(v) for v in items(get(row, "scale"), 3)]),
    )


def write_hypotheses(
    folder: Path, groups: Mapping[str, Sequence[Piece]], energies: Mapping[str, Sequence[float]]
) -> None:
    """Write hypotheses.json beside a scene.json that is written already, and their meshes.

    Args:
        folder: The capture folder.
        groups: Of each object, best first; the first is the one in the scene.
        energies: What is left of the image terms at each, where that is known.
    """
    scene = json.loads((folder / "scene.json").read_text())
    meshes = {row["id"]: row["mesh"] for row in scene["objects"]}
    rows: dict[str, list[dict[str, Any]]] = {}
    for name, group in groups.items():
        names = [meshes[name]]
        for rank, piece in enumerate(group[1:], 1):
            names.append(f"meshes/other/{name}_{rank}.glb")
            write_mesh(piece.mesh, folder / names[-1])
        rows[name] = [
            {"mesh": mesh, "translation": plain(piece.t_world_object), "yaw": plain(piece.yaw),
             "scale": plain(piece.scale)}
            for mesh, piece in zip(names, group, strict=True)
        ]  # fmt: skip
        for row, energy in zip(rows[name], energies.get(name, ()), strict=False):
            row["energy"] = energy
    write_json({"format": FORMAT, "version": VERSION, "objects": rows}, folder / FILE)
