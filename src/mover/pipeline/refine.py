"""Refine the people of a finished result with its room; find the contacts of bodies."""

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from jaxtyping import Float
from torch import Tensor

from mover.bodies.posa import load_posa, posa_contacts
from mover.core.errors import InputError
from mover.core.observe import Observer, silent
from mover.core.types import Bodies, Capture, Room
from mover.evaluate.evaluation import evaluate_people, read_truth
from mover.geometry.placement import standing_meshes
from mover.io.capture.bodies_file import read_bodies, write_bodies
from mover.io.capture.camera_file import camera_of
from mover.io.export.finished import read_finished
from mover.io.files.fields import At, read_json, write_json
from mover.io.files.meshes import read_mesh
from mover.io.formats import read
from mover.pipeline.result import to_world
from mover.stages.config import RefineBodiesConfig
from mover.stages.people.refine_bodies import RefinedBodies, refine_bodies

log = logging.getLogger(__name__)


def finished_room(out: Path) -> Room:
    """The room of a result folder, with its closed proxies and its people.

    Raises:
        InputError: If there is no result, or something in it is wrong.
    """
    done = read_finished(out)
    proxies = tuple(
        read_mesh(
            At(f"{piece.id}.glb", "scene.json", f"watertight mesh of '{piece.id}'"),
            out / "watertight",
        )[0]
        for piece in done.scene.objects
    )
    return Room(
        scene=done.scene, initial=done.scene, image_only=done.scene, bodies=done.bodies, kept=None,
        proxies=proxies, evidence=(), covariance=None, traces={}, warnings=(),
    )  # fmt: skip


def source_capture(out: Path, given: Path | None) -> Capture | None:
    """The capture that a result was made of: as given, else where its run.json says; None: gone."""
    if given is not None:
        return read("folder", given)
    log_file = out / "run.json"
    tree = read_json(log_file).value if log_file.is_file() else {}
    source = str(tree.get("source", "")) if isinstance(tree, Mapping) else ""
    if not source or not Path(source).exists():
        log.warning("the capture of %s is not there: no masks and no given contacts", out)
        return None
    return read(str(tree.get("source_format", "folder")), Path(source))


def refine_result(
    out: Path, config: RefineBodiesConfig, capture: Path | None = None, observe: Observer = silent
) -> RefinedBodies:
    """Refine the people of a result and write OUT/refined/bodies.npz.

    Raises:
        InputError: If the result lacks people or a floor, or cannot be read.
    """
    room = finished_room(out)
    if room.bodies is None:
        raise InputError(f"{out}: has no bodies.npz: there are no people to refine")
    found = refine_bodies(room, source_capture(out, capture), config, observe)
    write_bodies(found.bodies, out / "refined" / "bodies.npz")
    return found


def refined_room(room: Room, capture: Capture, observe: Observer = silent) -> Room:
    """The room with its people refined, where there are people and a floor."""
    if room.bodies is None or not len(room.bodies.frame) or room.scene.ground is None:
        return room
    found = refine_bodies(room, capture, RefineBodiesConfig(), observe)
    return replace(room, bodies=found.bodies)


def measure_people(out: Path, truth: Path | None = None) -> dict[str, dict[str, float]]:
    """How the people of a result move before and after their refinement, in refined/metrics.json.

    `truth` is the folder of the true scene and people, for their errors.

    Raises:
        InputError: If a file is missing or wrong.
    """
    room, true = finished_room(out), None if truth is None else _true_people(truth)
    pieces = zip(room.scene.objects, room.proxies, strict=True)
    solid = [s for piece, proxy in pieces for s in standing_meshes(replace(piece, mesh=proxy))]
    floor = room.scene.ground
    files = {"result": out / "bodies.npz", "refined": out / "refined" / "bodies.npz"}
    values = {
        name: evaluate_people(read_bodies(file), floor, solid, true) for name, file in files.items()
    }
    write_json(values, out / "refined" / "metrics.json")
    return values


def _true_people(truth: Path) -> Bodies:
    """The people of a truth, in its world."""
    scene, bodies = read_truth(truth), read_bodies(truth / "bodies.npz")
    return bodies if bodies.space == "world" else to_world(bodies, scene.camera)


def find_posa(
    bodies: Bodies, weights: Path, meshes: Path, samples: int, camera: Path | None
) -> Float[Tensor, "bodies verts"]:
    """Contacts by POSA, upright by the camera's pitch and roll where the bodies are in its axes.

    Raises:
        InputError: If a file is missing or wrong, or gravity is not known.
    """
    if bodies.space == "camera":
        if camera is None:
            raise InputError("bodies.npz: in the camera's axes; --camera must say where up is")
        bodies = to_world(bodies, camera_of(read_json(camera)))
    return posa_contacts(load_posa(weights, meshes), bodies, samples)


TERMS = {
    "camgp": ("under", "stand", "lock"), "sdf": ("sink",), "contact": ("touch",),
    "order": ("order",), "masks": ("outline",),
}  # fmt: skip
"""The terms of each kind of evidence."""


def without(config: RefineBodiesConfig, evidence: Sequence[str]) -> RefineBodiesConfig:
    """The settings without some of the evidence of `TERMS`."""
    zero: dict[str, Any] = {term: 0.0 for name in evidence for term in TERMS[name]}
    return replace(config, weights=replace(config.weights, **zero))
