"""Write a room to disk: scene, meshes, proxies, bodies, log and report (docs/data.md)."""

import dataclasses
import json
import platform
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch

from mover import __version__
from mover.app.report.page import ReportContent, write_report
from mover.bodies.corrected import in_world
from mover.core import records
from mover.core.devices import CPU, named
from mover.core.files import replacing
from mover.core.run import Run
from mover.core.settings import read_settings
from mover.core.types import Bodies, Capture, Room, Scene
from mover.extensions.missing_seats import PROPOSED, write_proposals
from mover.extensions.moving_camera import bodies_as_given
from mover.io.capture.bodies_file import write_bodies
from mover.io.capture.edits import Edit, write_edits
from mover.io.capture.scene_file import write_scene
from mover.io.export.contacts import write_labels
from mover.io.export.scene_glb import write_glb
from mover.io.files.fields import read_json
from mover.pipeline.presets import Config
from mover.pipeline.result import label_inputs
from mover.stages.contacts.label_contacts import label_contacts

POINTS = 500  # of a trace, about, that run.json keeps


@dataclasses.dataclass(frozen=True)
class Origin:
    """Where a result comes from, so that it can be computed again."""

    source: str = ""  #: full path of the capture
    format: str = "folder"
    edits: tuple[Edit, ...] = ()  #: what the user changed in it before
    refine: bool = False  #: whether the people were refined with the room at the end
    device: torch.device = CPU  #: where the heavy stages computed


def write_results(
    capture: Capture,
    room: Room,
    config: Config,
    run: Run,
    origin: Origin | None = None,
    *,
    report: bool = True,
) -> None:
    """Write everything but metrics.json; the page last, unless more is added to it."""
    import trimesh

    origin, out = origin or Origin(), run.folder
    write_scene(room.initial, out / "initial.json")
    if room.bodies is not None:
        write_bodies(room.bodies, out / "bodies.npz")
        write_bodies(initial_bodies(capture), out / "initial_bodies.npz")
        labels = run.stage(label_contacts, label_inputs(room), None)
        write_labels(labels, out / "contacts.npz")
    for item, proxy in zip(room.scene.objects, room.proxies, strict=True):
        shape = trimesh.Trimesh(proxy.verts.numpy(), proxy.faces.numpy(), process=False)
        with replacing(out / "watertight" / f"{item.id}.glb") as part:
            shape.export(part)
    write_glb(room.scene, room.bodies, out / "scene.glb")
    if origin.edits:
        write_edits(origin.edits, out / "edits.json")
    _write_log(room, config, run, origin)
    write_proposals(room, out / PROPOSED)
    evidence = {e.id: {"evidence": dataclasses.asdict(e)} for e in room.evidence}
    write_scene(room.scene, out / "scene.json", evidence)
    if report:
        write_report(out, report_of(capture, room, config, run))


def write_truth(scene: Scene, bodies: Bodies, folder: Path) -> None:
    """The truth of a known room, for `mover evaluate`."""
    write_bodies(bodies, folder / "bodies.npz")
    write_scene(scene, folder / "scene.json")


def initial_bodies(capture: Capture) -> Bodies:
    """The bodies in the world of the initial camera."""
    return in_world(bodies_as_given(capture), capture.scene.camera)


def report_of(
    capture: Capture,
    room: Room,
    config: Config,
    run: Run,
    *,
    truth: Scene | None = None,
    metrics: dict[str, Any] | None = None,
) -> ReportContent:
    """What the report shows."""
    scenes, people = {"initial": room.initial, "result": room.scene}, dict[str, Bodies]()
    if truth is not None:
        scenes["truth"] = truth
    if room.bodies is not None:
        people = {"initial": initial_bodies(capture), "result": room.bodies}
    return ReportContent(
        title=capture.name.encode("utf-8", "surrogateescape").decode("utf-8", "replace"),
        image=capture.reference,
        scenes=scenes,
        bodies=people,
        metrics=metrics,
        warnings=room.warnings,
        estimates=room.estimates,
        stages=[dataclasses.asdict(s) for s in run.stages],
        config=records.plain(config),
        objects=[
            {k: v for k, v in row.items() if k != "terms"}
            | {f"energy of {term}": value for term, value in row["terms"].items()}
            for row in map(dataclasses.asdict, room.evidence)
        ],
        command=command_line(),
    )


def command_line() -> str:
    """What was typed, in letters of UTF-8 whatever the locale is."""
    typed = " ".join(["mover", *sys.argv[1:]])
    return typed.encode("utf-8", "surrogateescape").decode("utf-8", "replace")


def _write_log(room: Room, config: Config, run: Run, origin: Origin) -> None:
    log = {
        "format": "mover-run",
        "version": __version__,
        "command": command_line(),
        "source": origin.source,
        "source_format": origin.format,
        "edits": len(origin.edits),
        "people_refined": origin.refine,
        "python": platform.python_version(),
        "torch": torch.__version__,
        "device": named(run.device),
        "threads": torch.get_num_threads(),
        "config": records.plain(config),
        "stages": [dataclasses.asdict(s) for s in run.stages],
        "warnings": list(room.warnings),
        "estimates": list(room.estimates),
        "evidence": [dataclasses.asdict(e) for e in room.evidence],
        "camera_covariance": None if room.covariance is None else room.covariance.tolist(),
        "traces": {
            name: trace[:: max(1, len(trace) // POINTS)].tolist()
            for name, trace in room.traces.items()
        },
    }
    with replacing(run.folder / "run.json") as part:
        part.write_text(json.dumps(log, indent=1))


def read_config(path: Path) -> Config:
    """The configuration of an earlier run, from its run.json.

    Raises:
        InputError: If there is none, or a setting in it is wrong.
    """
    at = read_json(path).get("config")
    if not isinstance(at.value, Mapping):
        at.refuse("the settings of a run {...}")
    return read_settings(Config, at.value, f"{path}: config")
