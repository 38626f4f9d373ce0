"""One job of a table: rebuild a capture of the user's as a row asks, and measure it.

Each job is a process (`python -m mover_bench.experiment.paper_job WORD ...`, see `TableJob.words`);
jobs of a capture share its finished stages, and a finished job is a file under a digest of its
inputs.
"""

import json
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import astuple, dataclass, replace
from pathlib import Path
from typing import Any

import torch

from mover.core.devices import Choice, device_of
from mover.core.errors import InputError
from mover.core.files import replacing
from mover.core.records import fingerprint
from mover.core.run import Run, sources
from mover.core.types import Bodies, Capture, Scene, SceneObject
from mover.evaluate.bodies import shared_rows
from mover.evaluate.evaluation import EvaluateConfig, EvaluatedBodies, evaluate, read_truth
from mover.extensions import reconstruct
from mover.io.capture.bodies_file import read_bodies, write_bodies
from mover.io.capture.folder import read_capture
from mover.io.capture.scene_file import read_scene
from mover.pipeline.result import to_world
from mover.stages.config import RefineBodiesConfig
from mover.stages.people.refine_bodies import ABLATION, refine_bodies
from mover_bench.experiment.measures import under_camera
from mover_bench.experiment.paper_rows import BASELINE, FITS, INITIAL, PLAIN, at_most, variants
from mover_bench.experiment.variants import Variant, withheld

DONE = "metrics.json"
FITTED = "fitted.npz"
BOXES = EvaluateConfig(boxes=True, feet="contacts")
"""The truth of both data sets is boxes; feet are those that touch the floor, as in the paper."""


@dataclass(frozen=True)
class TableJob:
    """One process of a table."""

    capture: Path
    out: Path  #: folder of all results
    preset: str
    name: str  #: a variant of `paper_rows.variants`
    steps: int = 0  #: at most so many steps of each descent; 0: as many as the preset has
    device: Choice = "cpu"
    vposer: str = ""  #: VPoser's weights: the bodies of the rows of people are fitted with them

    @property
    def words(self) -> tuple[str, ...]:
        """The command line of its process."""
        return tuple(map(str, astuple(self)))

    @staticmethod
    def of(words: Sequence[str]) -> "TableJob":
        """The inverse of `words`."""
        capture, out, preset, name, steps, device, vposer = words
        choice: Any = device
        return TableJob(Path(capture), Path(out), preset, name, int(steps), choice, vposer)

    @property
    def home(self) -> Path:
        """Where the jobs of its capture are, and the stages that they share."""
        return self.out / self.preset / self.capture.name

    @property
    def folder(self) -> Path:
        """Where its files are."""
        return self.home / self.name

    @property
    def variant(self) -> Variant:
        """Its settings."""
        return at_most(variants(self.preset)[self.name], self.steps)


def key_of(job: TableJob) -> str:
    """Digest of everything that a job's numbers depend on, but for the device."""
    files = [
        (path.relative_to(job.capture).as_posix(), path.stat().st_size, path.stat().st_mtime_ns)
        for path in sorted(job.capture.rglob("*"))
        if path.is_file() and path.parent.name != "frames"
    ]
    settings, fitted = job.variant, job.vposer if job.variant.row else ""
    return fingerprint(settings, job.name, fitted, json.dumps(files), sources("mover_bench"))


def do_job(job: TableJob) -> None:
    """Rebuild, measure, and write metrics.json."""
    given = read_capture(job.capture)
    if job.name == INITIAL:
        found = {"initial": measure(job.capture, given, given.scene, given.bodies)}
    elif job.name.startswith(FITS):
        people = read_bodies(fits_of(job))
        camera = read_scene(job.capture / "truth" / "scene.json").camera
        found = {"full": measure(job.capture, given, replace(given.scene, camera=camera), people)}
    else:
        found = rebuilt(job, given)
    about = {"key": key_of(job), "seconds": time.process_time()}
    with replacing(job.folder / DONE) as part:
        part.write_text(json.dumps({**about, **found}, indent=1, allow_nan=False))


def fits_of(job: TableJob) -> Path:
    """The bodies that PROX's authors fitted, where the user's copy has them."""
    return job.capture / "fits" / f"{job.name.removeprefix(FITS)}.npz"


def rebuilt(job: TableJob, given: Capture) -> dict[str, Any]:
    """The metrics of the room of a job, by stage."""
    variant = job.variant
    if variant.change:
        scene = disturb(given.scene, variant.change, torch.Generator().manual_seed(0))
        given = replace(given, scene=scene)
    if variant.row and job.vposer:
        given = replace(given, bodies=fitted(job, given), touch=None)
    capture = withheld(given, variant.given, variant.cut)
    room = reconstruct(capture, variant.config, Run(job.home, device=device_of(job.device)))
    if given.bodies is not None and (room.bodies is None or variant.cut is not None):
        room = under_camera(room, given, room.scene.camera)
    people = room.bodies
    if variant.row and people is not None:
        weights = RefineBodiesConfig(weights=ABLATION[variant.row])
        level = variant.row == "baseline"  # nothing of the room is known, not even where down is
        start = under_camera(room, capture, capture.scene.camera) if level else room
        people = refine_bodies(start, capture, weights).bodies
    scenes = {"full": room.scene}
    if job.name == PLAIN:  # other jobs have no rows of these
        scenes["image"] = room.image_only
    return {name: measure(job.capture, given, scene, people) for name, scene in scenes.items()}


def fitted(job: TableJob, given: Capture) -> Bodies:
    """Bodies that are fitted to the capture's keypoints with the paper's terms and VPoser, once.

    Raises:
        InputError: If there are no keypoints, or the body model is not known.
    """
    from mover.bodies import load_model
    from mover.fitting import FITS as PRESETS_OF_FITS
    from mover.fitting.bodies import FitInputs, fit_bodies
    from mover.fitting.unknowns import prior_of
    from mover.io.people.found import Known
    from mover.io.people.keypoints import keypoints_from

    kept, pose = job.home / BASELINE / FITTED, given.bodies and given.bodies.pose
    if kept.is_file():
        return read_bodies(kept)
    if pose is None:
        raise InputError(f"{job.capture}: bodies.npz has no parameters, so the model is not known")
    fps = None if given.bodies is None else given.bodies.fps
    keypoints = keypoints_from("openpose", job.capture / "keypoints", Known(fps=fps))
    model: Any = load_model(pose.model, pose.gender)
    prior = prior_of(Path(job.vposer))
    inputs = FitInputs(keypoints, given.scene.camera, model, prior=prior)
    bodies = fit_bodies(inputs, PRESETS_OF_FITS["paper"]).bodies
    kept.parent.mkdir(parents=True, exist_ok=True)
    write_bodies(bodies, kept)
    return bodies


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
        there = path / "bodies.npz"
        rows = None  # the scan is for the furniture alone
        if name == "truth":
            true_people = read_bodies(there) if there.is_file() else None
            rows = EvaluatedBodies(None, people, true_people, named_contacts(capture, people))
        true = read_truth(path)
        values = evaluate(capture.scene, scene, true, rows, BOXES, ("result",))["result"]
        if name == "truth":  # of boxes: their walls are no furniture
            found = {key: value for key, value in values.items() if key != "p2s"}
        elif "p2s" in values:
            found["p2s"] = values["p2s"]
    return found


def named_contacts(capture: Capture, people: Bodies | None) -> torch.Tensor | None:
    """The capture's contacts (POSA) of these bodies; None where some have none."""
    if people is None or capture.bodies is None or capture.touch is None:
        return None
    rows, given = shared_rows(people, capture.bodies)
    whole = len(rows) == len(people.frame) and people.verts.shape[1] == capture.touch.shape[1]
    return capture.touch[given] if whole else None


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
    torch.set_num_threads(1)
    do_job(TableJob.of(arguments))


if __name__ == "__main__":
    main(sys.argv[1:])
