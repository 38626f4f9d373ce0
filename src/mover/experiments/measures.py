"""Measure a rebuilt room against the truth: objects, interaction, camera, and the people."""

import json
from dataclasses import asdict, replace
from typing import Any

from ..evaluate import EvaluateConfig, EvaluatedBodies, evaluate, touch_in_truth
from ..geometry.watertight import close_mesh
from ..metrics_bodies import POSE_METRICS, gather_twins
from ..metrics_contact import TrueTouch
from ..metrics_motion import MOTION_METRICS, gather_gait
from ..metrics_pairs import unmatched
from ..metrics_scene import measure as measured
from ..minimize import Observer, silent
from ..outcome import carried
from ..readers.pose_file import into_camera
from ..records import record
from ..run import Run, StageLog
from ..stages.refine_bodies import ABLATION, RefineBodiesConfig, refine_bodies
from ..types import Bodies, Camera, Capture, Room, Scene
from .traits import Traits

GIVEN, TRUE_GIVEN, TRUE_ROOM = "given", "true given", "true room"
TRAITS = ("id", "category", "touched", "hidden", "truncated", "flipped", "stays")
PROX = "+CamGP+SDF+Contact"  # what refines bodies in the true room


@record
class Trial:
    """A known room as the method gets it, and the truth."""

    capture: Capture
    """With noise."""
    truth: Scene
    bodies: Bodies | None
    """The true people."""
    traits: tuple[Traits, ...]
    """Of the true objects, in their order."""
    doing: tuple[str, ...] = ()
    """How each true body uses what: `sit chair_0`; empty: it uses nothing."""


@record
class Judged:
    """A scene that is compared with the truth."""

    initial: Scene
    result: Scene
    truth: Scene
    bodies: EvaluatedBodies


@record
class Beside:
    """True people beside the true furniture."""

    touch: TrueTouch | None


@record
class Verdict:
    """The metrics of a scene."""

    text: str
    """What metrics.json would hold."""


def judge(inputs: Judged, config: EvaluateConfig, observe: Observer = silent) -> Verdict:
    """All metrics of a scene, as a stage: equal scenes of a room are measured once."""
    del observe
    scenes = inputs.initial, inputs.result, inputs.truth
    return Verdict(json.dumps(evaluate(*scenes, inputs.bodies, config, ("result",))))


def truly(inputs: Judged, config: EvaluateConfig, observe: Observer = silent) -> Beside:
    """How the true people touch the true room, as a stage: all jobs of a room measure it once."""
    del observe
    return Beside(touch_in_truth(inputs.truth, inputs.bodies, config))


def measure(
    trial: Trial, room: Room, run: Run, densities: EvaluateConfig | None = None
) -> dict[str, Any]:
    """All metrics of the initial scene, of Stage 1 and of the full method, object by object.

    Stage 1 has camera, ground and people of the full method: only the furniture differs.
    """
    capture = trial.capture
    asked = {
        "initial": (capture.scene, capture.bodies),
        "image": (room.image_only, room.bodies),
        "full": (room.scene, room.bodies),
    }
    found = {
        name: _judged(trial, scene, people, run, densities)
        for name, (scene, people) in asked.items()
    }
    objects = [
        {name: getattr(traits, name) for name in TRAITS}
        | {name: verdict["objects"][place]["result"] for name, verdict in found.items()}
        for place, traits in enumerate(trial.traits)
    ]
    return {
        **{name: verdict["result"] for name, verdict in found.items()},
        "objects": objects,
        "unmatched": unmatched(capture.scene, room.scene, trial.truth, by_place=False),
        "warnings": list(room.warnings),
    }


def measure_true_room(
    trial: Trial, room: Room, run: Run, densities: EvaluateConfig | None = None
) -> dict[str, Any]:
    """The true room with the people of a rebuilt one: what their own errors cost."""
    people = seen_from(trial.truth.camera, room)
    return _judged(trial, trial.truth, people, run, densities)["result"]


def _judged(
    trial: Trial, scene: Scene, people: Bodies | None, run: Run, densities: EvaluateConfig | None
) -> dict[str, Any]:
    config = replace(densities or EvaluateConfig(), by_place=False)  # it is known who is who
    given, truth = trial.capture, trial.truth
    rows = EvaluatedBodies(None, given.bodies, trial.bodies)  # no job loses any of them
    known = run.stage(truly, Judged(given.scene, truth, truth, rows), config)
    bodies = EvaluatedBodies(None, people, trial.bodies, known.touch)
    asked = Judged(given.scene, scene, truth, bodies)
    return json.loads(run.stage(judge, asked, config).text)


def seen_from(camera: Camera, room: Room) -> Bodies | None:
    """The people of a room in the world of another camera that sees them alike."""
    if room.bodies is None:
        return None
    return carried(into_camera(room.bodies, room.scene.camera.R_cam_world), camera)


def measure_truth(trial: Trial, densities: EvaluateConfig | None = None) -> dict[str, float]:
    """The metrics of the truth itself: people touch and even sink into true furniture, too."""
    bodies = EvaluatedBodies(None, trial.bodies, trial.bodies)
    scenes = trial.truth, trial.truth, trial.truth
    return evaluate(*scenes, bodies, densities, ("result",))["result"]


def measure_people(trial: Trial, room: Room, row: str) -> dict[str, Any]:
    """The people against the true ones, refined as a row of the paper's table of bodies says."""
    assert trial.capture.bodies is not None, "a known room has people"
    assert trial.bodies is not None, "a known room has true people"
    scene = room.scene
    if row in (GIVEN, "baseline"):  # nothing of the room is known, not even where down is
        room = _under(room, trial.capture, trial.capture.scene.camera)
    elif row in (TRUE_GIVEN, TRUE_ROOM):
        room = _true_room(trial, room)
    weights = ABLATION.get(PROX if row == TRUE_ROOM else row)
    found = room.bodies
    if weights is not None:
        found = refine_bodies(room, trial.capture, RefineBodiesConfig(weights=weights)).bodies
    assert found is not None, "the people were carried into a room"
    truth = carried(trial.bodies, trial.truth.camera)
    twins = gather_twins(found, truth)
    assert twins is not None, "known people are paired by frame"
    gait = gather_gait(found, truth, scene.ground)
    values = measured(POSE_METRICS, twins) | measured(MOTION_METRICS, gait)
    return {"initial": {}, "image": {}, "full": values, "objects": [], "warnings": []}


def timing(stages: list[StageLog]) -> list[dict[str, Any]]:
    """What each stage cost, without the measuring."""
    ours = judge.__name__, truly.__name__
    return [asdict(stage) for stage in stages if stage.name not in ours]


def carry_all(room: Room, capture: Capture) -> Room:
    """The room with all people of the capture in its world, whatever part was given."""
    return _under(room, capture, room.scene.camera)


def _under(room: Room, capture: Capture, camera: Camera) -> Room:
    """The same room seen by another camera, with the people as they were given."""
    assert capture.bodies is not None, "a known room has people"
    scene = replace(room.scene, camera=camera)
    return replace(room, scene=scene, bodies=carried(capture.bodies, camera), kept=None)


def _true_room(trial: Trial, room: Room) -> Room:
    proxies = tuple(close_mesh(piece.mesh) for piece in trial.truth.pieces)
    room = replace(room, proxies=proxies, scene=trial.truth)
    return _under(room, trial.capture, trial.truth.camera)
