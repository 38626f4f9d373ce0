"""One job of a paper's table: rebuild a capture of the user's as a row asks, and measure it.

Each job is a process (`python -m mover_bench.experiment.paper_job WORD ...`, see `TableJob.words`);
jobs of a capture share its finished stages, and a finished job is a file under a digest of its
inputs.

Source of the published numbers: Yi et al., "Human-Aware Object Placement for Visual Environment
Reconstruction" (MOVER), CVPR 2022, its tables and its supplement: quoted, never computed here.
Measured on PROX and PiGraphs, which cannot be shared, so that they are not comparable with numbers
on known rooms. None: not printed.
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
from mover.core.files import replacing, sources
from mover.core.records import fingerprint
from mover.core.run import Run
from mover.core.types import Bodies, Capture, Scene, SceneObject
from mover.evaluate.bodies import shared_rows
from mover.evaluate.evaluation import EvaluateConfig, EvaluatedBodies, evaluate, read_truth
from mover.extensions import reconstruct
from mover.io.capture.bodies_file import read_bodies, write_bodies
from mover.io.capture.folder import read_capture
from mover.io.capture.scene_file import read_scene
from mover.pipeline.presets import PRESETS
from mover.pipeline.result import to_world
from mover.stages.config import RefineBodiesConfig
from mover.stages.people.refine_bodies import ABLATION, refine_bodies
from mover_bench.datasets import pigraphs, prox_files
from mover_bench.experiment.job import under_camera
from mover_bench.experiment.variants import (
    LENGTHS,
    SEGMENTS,
    TERMS,
    Cut,
    Variant,
    at_most,
    with_terms,
    withheld,
)
from mover_bench.rooms.config import CHANGES

PLAIN, INITIAL, BASELINE, FITS = "full", "initial", "people-baseline", "fits-"
"""Jobs: the whole method; the given scene alone; bodies without a room; names of given fits."""
NOISES = {kind: CHANGES[kind].levels[:0:-1] for kind in ("scale", "place", "turn")}
"""Largest uniform errors of the initial scene: share of the size, [m], [degrees]."""


@dataclass(frozen=True)
class TableRow:
    """A row of ours."""

    label: str
    job: str  #: name of its job, or its first words where a row is the mean of several
    stage: str = "full"  #: initial, image or full
    protocol: str = ""  #: how the paper made it, and what is done here
    detected: bool = False  #: on the captures with detected boxes and masks


def variants(preset: str) -> dict[str, Variant]:
    """All jobs of a preset by name."""
    config = PRESETS[preset]
    people = {"baseline": "baseline", "camgp": "+CamGP", "sdf": "+CamGP+SDF",
              "contact": "+CamGP+SDF+Contact"}  # fmt: skip
    cuts = {
        f"length-{seconds}-{k}": Cut(seconds, (k + 0.5) / SEGMENTS)
        for seconds in LENGTHS
        for k in range(SEGMENTS)
    }
    noises = [(kind, level) for kind, levels in NOISES.items() for level in levels]
    return {
        PLAIN: Variant(config),
        INITIAL: Variant(config),
        **{FITS + kind: Variant(config) for kind in prox_files.GIVEN_FITS},
        **{name: with_terms(config, name) for name in TERMS},
        "contact-depth": with_terms(config, "contact", "depth"),
        **{f"people-{name}": Variant(config, row=row) for name, row in people.items()},
        **{name: Variant(config, cut=cut) for name, cut in cuts.items()},
        **{f"noise-{k}-{x:g}": Variant(config, change=f"{k}={x:g}") for k, x in noises},
    }


ABLATION_ROWS = (
    TableRow("initial", INITIAL, "initial", "the first scene as it is given"),
    TableRow("Stage 1 + camera", PLAIN, "image", "the image alone, under the camera of the feet"),
    TableRow("+ contact", "contact"),
    TableRow("+ depth", "depth"),
    TableRow("+ collision", "collision"),
    TableRow("+ contact, depth", "contact-depth"),
    TableRow("full", PLAIN),
)
"""Tab. 2, its ablation and Tab. 4: one job for each way of the second stage."""
DETECTED = (
    TableRow("initial, detected", INITIAL, "initial", "boxes and masks of a detector", True),
    TableRow("full, detected", PLAIN, "full", "", True),
)
PEOPLE = (
    *(
        TableRow(f"{kind}, given fits", FITS + kind, "full", "the copy's own fits, in its scan")
        for kind in prox_files.GIVEN_FITS
    ),
    TableRow(
        "baseline", BASELINE, "full",
        "the paper: batch SMPLify-X; here with --vposer the same terms, else the capture's bodies,"
        " refined without a room",
    ),
    TableRow("+ CamGP", "people-camgp", "full", "in the room that is found with these bodies"),
    TableRow("+ CamGP + SDF", "people-sdf"),
    TableRow("+ CamGP + SDF + Contact", "people-contact"),
)  # fmt: skip
"""Tab. 5: bodies refined in the estimated room, below the fits that the user's copy has."""
_SPREAD = "segments of each recording, evenly spread; std: theirs, mean over recordings"
LONGER = tuple(TableRow(f"{s} s", f"length-{s}-", "full", f"{SEGMENTS} {_SPREAD}") for s in LENGTHS)
DISTURBED = tuple(
    TableRow(f"{kind} ± {level:g}", f"noise-{kind}-{level:g}", "full", "uniform noise, one draw")
    for kind, levels in NOISES.items()
    for level in levels
)
"""Tab. 7: the paper disturbs one video (Werkraum_03301_01); here all that are there."""

Quoted = Mapping[str, tuple[float | None, ...]]
"""Printed rows by their labels: the first columns of a table."""
SCENE: Quoted = {
    "HolisticMesh, PointRend": (0.211, 0.410, 0.648, 0.990, 0.369),
    "Total3D, PointRend": (0.246, 0.319, 0.522, 0.974, 0.510),
    "MOVER, PointRend": (0.309, 0.221, 0.777, 0.977, 0.612),
    "HolisticMesh": (0.267, 0.237, 0.745, 0.988, 0.491),
    "Total3D": (0.196, 0.369, 0.227, 0.963, 0.440),
    "MOVER, camera": (0.374, 0.206, 0.859, 0.979, 0.738),
    "MOVER, camera, contact": (0.381, 0.205, 0.904, 0.980, 0.773),
    "MOVER, camera, depth": (0.393, 0.194, 0.907, 0.983, 0.638),
    "MOVER, camera, collision": (0.383, 0.199, 0.903, 0.984, 0.674),
    "MOVER, camera, contact, depth": (0.389, 0.199, 0.904, 0.983, 0.697),
    "MOVER": (0.383, 0.199, 0.898, 0.986, 0.673),
}
"""PROX qualitative; annotated boxes and masks unless PointRend is named."""
STILLS: Quoted = {
    "Total3D": (0.063, 0.409, 0.342, 0.940, 0.436),
    "HolisticMesh": (0.239, 0.133, 0.533, 0.948, 0.951),
    "MOVER": (0.390, 0.095, 0.862, 0.972, 0.934),
}
GRAPHS: Quoted = {
    "Cooperative": (0.686, 0.214), "Holistic++": (0.751, 0.249), "HolisticMesh": (0.756, 0.263),
    "MOVER": (0.792, 0.278),
}  # fmt: skip
CAMERA: Quoted = {
    "Total3D": (0.059, 0.031, 0.045, 0.316, 0.167),
    "MOVER": (0.042, 0.034, 0.038, 0.100, 0.112),
}
BODIES: Quoted = {
    "RGB, scanned scene": (0.22027, 0.21806, 0.07324, 0.06080),
    "PROX, scanned scene": (0.16708, 0.16651, 0.07197, 0.06114),
    "HolisticMesh": (0.19078, 0.19221, 0.07272, 0.06101),
    "MOVER, baseline": (0.21962, 0.22250, 0.07592, 0.06834),
    "MOVER, +CamGP": (0.17641, 0.18009, 0.07341, 0.06733),
    "MOVER, +CamGP+SDF": (0.17598, 0.17998, 0.07396, 0.06829),
    "MOVER, +CamGP+SDF+Contact": (0.17437, 0.17831, 0.07360, 0.06789),
}
LENGTH: Quoted = {
    "10 s": (0.389, 0.018), "20 s": (0.395, 0.015), "30 s": (0.407, 0.010),
    "whole (51 s)": (0.424, None),
}  # fmt: skip
"""Mean and std of IoU3D over ten segments of one video of each scene."""
NOISE: Quoted = {
    "scale ± 0": (0.417,), "scale ± 0.05": (0.4105,), "scale ± 0.15": (0.3805,),
    "scale ± 0.25": (0.345,), "place ± 0": (0.417,), "place ± 0.1": (0.415,),
    "place ± 0.2": (0.416,), "place ± 0.3": (0.4175,), "turn ± 0": (0.417,),
    "turn ± 15": (0.4205,), "turn ± 30": (0.418,), "turn ± 45": (0.4205,),
}  # fmt: skip
"""One video. (The table prints 0.05 % and 10 m where 5 % and 10 cm must be meant.)"""


@dataclass(frozen=True)
class Part:
    """One table of the paper: its columns, our rows and the published ones."""

    title: str
    columns: tuple[str, ...]
    ours: tuple[TableRow, ...]
    quoted: Quoted
    note: str = ""


@dataclass(frozen=True)
class PaperTable:
    """The tables of one data set."""

    title: str
    expected: str  #: on what the paper measures
    count: int  #: recordings of it
    parts: tuple[Part, ...]
    factor: float = 1.0  #: on the overlaps: the paper prints some in percent


STD = "iou3d_std"
OVERLAPS = ("iou3d", "p2s", "iou2d", "non_collision", "contact")
ERRORS = ("pje", "v2v", "p_pje", "p_v2v")
TILTS = ("pitch_error", "roll_error", "mean_tilt",
         "ground_penetration_frequency", "ground_penetration_distance")  # fmt: skip
BOX_NOTE = (
    "IoU2D compares the 3D boxes in the image, as the truth is boxes; P2S is measured from what the"
    " scan has inside them, without the floor."
)
FEET_NOTE = (
    "Foot contacts are those of contacts.npz (POSA), else estimated from the bodies; more than 1 cm"
    " below the floor counts. Angles in radians."
)
CAPSULES = (
    "As imported, people are capsules about Kinect's joints and have no masks: no depth order, and"
    " no contact but of soles. The paper has SMPLify-X's bodies: `mover fit` the pictures first."
)
ENDS = (ABLATION_ROWS[0], ABLATION_ROWS[-1])
TABLES: dict[str, PaperTable] = {
    "prox": PaperTable(
        "PROX qualitative",
        f"{prox_files.VIDEOS} videos of {len(prox_files.SCENES)} scenes, without the two booths",
        prox_files.VIDEOS,
        (
            Part("Scenes and interaction", OVERLAPS, (*ABLATION_ROWS, *DETECTED), SCENE, BOX_NOTE),
            Part("Camera and ground", TILTS, ENDS, CAMERA, FEET_NOTE),
            Part("Length of the video", ("iou3d", STD), (*LONGER, ABLATION_ROWS[-1]), LENGTH),
            Part("Noise on the initial scene", ("iou3d",), (*DISTURBED, ABLATION_ROWS[-1]), NOISE),
        ),
    ),
    "prox-quantitative": PaperTable(
        "PROX quantitative",
        f"{prox_files.SHOTS} frames of one scene",
        1,
        (
            Part("Scenes and interaction", OVERLAPS, ABLATION_ROWS, STILLS, BOX_NOTE),
            Part("People [mm]", ERRORS, PEOPLE, BODIES),
        ),
    ),
    "pigraphs": PaperTable(
        "PiGraphs",
        f"{pigraphs.VIDEOS} videos of {pigraphs.ROOMS} scenes; overlaps in percent",
        pigraphs.VIDEOS,
        (
            Part(
                "Scenes",
                ("iou2d", "iou3d"),
                (*ABLATION_ROWS[:2], ABLATION_ROWS[-1]),
                GRAPHS,
                CAPSULES,
            ),
        ),
        100.0,
    ),
}
"""The tables by name."""


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
    name: str  #: of a job of `variants`
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
