"""People who are fitted to keypoints: the paper's chain keypoints -> fit -> room -> refinement.

A job of this chain is given the 2D joints of the true people with a detector's errors, and bodies
of a regressor to start from (the paper: PARE). `fit --preset paper` makes the bodies of the
capture, the room is rebuilt from them, and `refine --preset paper` fits them again in it.
"""

from dataclasses import replace
from typing import Any

import numpy as np
import torch

from mover.bodies.skinning import open_body
from mover.core.observe import Observer, silent
from mover.core.records import record
from mover.core.run import Run
from mover.core.types import Bodies, Camera, Keypoints, Room
from mover.fitting.bodies import FitInputs, fit_bodies
from mover.fitting.config import FitConfig
from mover.fitting.presets import FITS, PAPER_ROOM, at_most, without
from mover.fitting.prior import ANGLES
from mover.pipeline.refit import refit_bodies
from mover.stages.config import RefineBodiesConfig
from mover.stages.people.refine_bodies import refine_bodies
from mover_bench.rooms.seen import joints_seen
from mover_bench.studies.measures import Trial, in_true_room, judge_people, under_camera

STEPS = 100  # iterations of a stage of the fit at most, a third of the preset's
BASELINE, ROBUST, TRUE_ROOM = "baseline", "robust", "true room"
LACKS: dict[str, tuple[str, ...]] = {
    "camgp": ("sdf", "contact"), "sdf": ("contact",), "contact": (), TRUE_ROOM: (),
}  # fmt: skip
"""Which of the room's terms the rows of the table lack."""


@record
class Sighting:
    """What people are fitted to."""

    keypoints: Keypoints
    camera: Camera
    """The first guess of it."""
    start: Bodies
    """Of a regressor, in the camera's axes."""


def fit_people(inputs: Sighting, config: FitConfig, observe: Observer = silent) -> Bodies:
    """Batch SMPLify-X of the whole video, as a stage."""
    given = FitInputs(inputs.keypoints, inputs.camera, open_body(), inputs.start)
    return fit_bodies(given, config, observe).bodies


def sighted(trial: Trial, seed: int) -> Keypoints:
    """What a detector sees of the people of a trial."""
    assert trial.bodies is not None, "a known room has true people"
    seated = torch.tensor([doing.startswith("sit") for doing in trial.doing])
    rng = np.random.default_rng([seed, 25])
    return joints_seen(trial.bodies, trial.truth.camera, seated, rng)


def fitted_trial(trial: Trial, seed: int, run: Run) -> Trial:
    """The trial with the bodies that keypoints give, in place of the regressor's."""
    capture = trial.capture
    assert capture.bodies is not None, "a known room has people"
    inputs = Sighting(sighted(trial, seed), capture.scene.camera, capture.bodies)
    bodies = run.stage(fit_people, inputs, at_most(FITS["paper"], STEPS))
    return replace(trial, capture=replace(capture, bodies=bodies, touch=None))


def measure_fitted(trial: Trial, room: Room, row: str, seed: int) -> dict[str, Any]:
    """The people against the true ones, fitted again as a row of the paper's table says."""
    if row == BASELINE:  # under the camera that was guessed
        room = under_camera(room, trial.capture, trial.capture.scene.camera)
    elif row == TRUE_ROOM:
        room = in_true_room(trial, room)
    found = room.bodies
    if row == ROBUST:
        found = refine_bodies(room, trial.capture, RefineBodiesConfig()).bodies
    elif row in LACKS:
        config = at_most(without(PAPER_ROOM, *LACKS[row]), STEPS)
        found = refit_bodies(room, sighted(trial, seed), None, (config, ANGLES)).bodies
    return judge_people(trial, room.scene, found)
