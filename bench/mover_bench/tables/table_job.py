"""One job of a table: rebuild a capture of the user's as a row asks, and measure it.

Each job is a process (`python -m mover_bench.tables.table_job CAPTURE OUT PRESET NAME`); jobs of a
capture share its finished stages, and a finished job is a file under a digest of its inputs.
"""

import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from mover.core.files import replacing
from mover.core.records import fingerprint
from mover.core.run import Run, sources
from mover.core.types import Bodies, Capture, Scene, SceneObject
from mover.evaluate.evaluation import EvaluateConfig, EvaluatedBodies, evaluate
from mover.extensions import reconstruct
from mover.io.capture.bodies_file import read_bodies
from mover.io.capture.camera_file import camera_of
from mover.io.capture.folder import read_capture
from mover.io.capture.scene_file import read_scene
from mover.io.files.fields import read_json
from mover.pipeline.result import to_world
from mover.stages.config import RefineBodiesConfig
from mover.stages.people.refine_bodies import ABLATION, refine_bodies
from mover_bench.experiment.measures import under_camera
from mover_bench.experiment.variants import withheld
from mover_bench.tables.rows import PLAIN, variants

DONE = "metrics.json"
BOXES = EvaluateConfig(boxes=True, feet="contacts")
"""The truth of both data sets is boxes; feet are those that touch the floor, as in the paper."""


@dataclass(frozen=True)
class TableJob:
    """One process of a table."""

    capture: Path
    out: Path
    """Folder of all results."""
    preset: str
    name: str
    """A variant of `rows.variants`."""

    @property
    def home(self) -> Path:
        """Where the jobs of its capture are, and the stages that they share."""
        return self.out / self.preset / self.capture.name

    @property
    def folder(self) -> Path:
        """Where its files are."""
        return self.home / self.name


def key_of(job: TableJob) -> str:
    """Digest of everything that a job's numbers depend on."""
    files = [
        (path.relative_to(job.capture).as_posix(), path.stat().st_size, path.stat().st_mtime_ns)
        for path in sorted(job.capture.rglob("*"))
        if path.is_file() and path.parent.name != "frames"
    ]
    settings = variants(job.preset)[job.name]
    return fingerprint(settings, job.name, json.dumps(files), sources("mover_bench"))


def do_job(job: TableJob) -> None:
    """Rebuild, measure, and write metrics.json."""
    variant = variants(job.preset)[job.name]
    given = read_capture(job.capture)
    if variant.change:
        scene = disturb(given.scene, variant.change, torch.Generator().manual_seed(0))
        given = replace(given, scene=scene)
    capture = withheld(given, variant.given, variant.cut)
    room = reconstruct(capture, variant.config, Run(job.home))
    if given.bodies is not None and (room.bodies is None or variant.cut is not None):
        room = under_camera(room, given, room.scene.camera)
    people = room.bodies
    if variant.row and people is not None:
        weights = RefineBodiesConfig(weights=ABLATION[variant.row])
        level = variant.row == "baseline"  # nothing of the room is known, not even where down is
        start = under_camera(room, capture, capture.scene.camera) if level else room
        people = refine_bodies(start, capture, weights).bodies
    scenes = {"full": (room.scene, people)}
    if job.name == PLAIN:  # other jobs have no rows of these
        scenes |= {"initial": (given.scene, given.bodies), "image": (room.image_only, people)}
    measured = {name: measure(job.capture, given, *scene) for name, scene in scenes.items()}
    with replacing(job.folder / DONE) as part:
        part.write_text(json.dumps({"key": key_of(job), **measured}, indent=1, allow_nan=False))


def measure(
    folder: Path, capture: Capture, scene: Scene, people: Bodies | None
) -> Mapping[str, Any]:
    """The metrics of one scene against truth/, and P2S against truth_scan/ where there is one."""
    if people is not None and people.space == "camera":
        people = to_world(people, scene.camera)
    found: dict[str, float] = {}
    for name in ("truth", "truth_scan"):
        path = folder / name
        if not (path / "scene.json").is_file():
            continue
        own = path / "camera.json"
        camera = camera_of(read_json(own)) if own.exists() else None
        true = read_scene(path / "scene.json", camera)
        there = path / "bodies.npz"
        rows = EvaluatedBodies(None, people, read_bodies(there) if there.is_file() else None)
        if name == "truth_scan":
            rows = EvaluatedBodies(None, None, None)
        values = evaluate(capture.scene, scene, true, rows, BOXES, ("result",))["result"]
        if name == "truth":
            values.pop("p2s", None)  # of boxes: their walls are no furniture
            found |= values
        elif "p2s" in values:
            found["p2s"] = values["p2s"]
    return found


def disturb(scene: Scene, change: str, generator: torch.Generator) -> Scene:
    """The initial scene with uniform noise on every object, as `scale=0.25`."""
    kind, _, level = change.partition("=")

    def drawn(count: int) -> torch.Tensor:
        return float(level) * (2 * torch.rand(count, generator=generator) - 1)

    def changed(thing: SceneObject) -> SceneObject:
        if kind == "scale":
            return replace(thing, scale=thing.scale * (1 + drawn(3)).to(thing.scale))
        if kind == "place":
            return replace(thing, t_world_object=thing.t_world_object + drawn(3))
        return replace(thing, yaw=thing.yaw + drawn(1)[0].deg2rad().to(thing.yaw))

    return replace(scene, objects=tuple(changed(thing) for thing in scene.objects))


def main(arguments: Sequence[str]) -> None:
    """Do the job that is named on the command line."""
    capture, out, preset, name = arguments
    torch.set_num_threads(1)
    do_job(TableJob(Path(capture), Path(out), preset, name))


if __name__ == "__main__":
    main(sys.argv[1:])
