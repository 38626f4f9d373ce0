"""Measure the method on i3DB: from library furniture, from the true shapes, beside iMapper."""

import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mover.bodies.corrected import statures
from mover.bodies.skinning import open_body
from mover.core.errors import InputError
from mover.core.observe import Observer, silent
from mover.core.run import Run
from mover.core.types import Bodies, Camera, Capture, Detection, Scene, SceneObject
from mover.evaluate.scene import Pair, Together, iou3d, iou3d_aligned
from mover.fitting.bodies import FitInputs, fit_bodies
from mover.geometry.camera import pitch_roll, tilted
from mover.geometry.rle import decode
from mover.geometry.rotations import rot_y
from mover.perceive.config import LayoutConfig
from mover.perceive.layout import Picture, first_scene
from mover.perceive.standing import seen_from
from mover.pipeline.presets import PRESETS
from mover.pipeline.reconstruct import reconstruct
from mover_bench.cli import ExperimentArgs
from mover_bench.datasets.i3db import I3dbScene, read_i3db
from mover_bench.experiment.tables import judge_each, markdown

LEVEL = tilted(torch.tensor(0.0), torch.tensor(0.0))
POINTS = 1  # of surfaces, which are not compared
SAME_KIND = {"stool": "chair"}


def judge_i3db(args: ExperimentArgs, observe: Observer = silent) -> Path:
    """Measure the scenes below `args.source` with the preset that `args.variants` names first.

    The summary is OUT/i3db/summary.md; the numbers are the .json beside it.

    Raises:
        InputError: If there is no source, no scene in it, or no such preset.
    """
    if args.source is None or not args.source.is_dir():
        raise InputError("--source: expected the folder i3DB of amonszpart/iMapper for --set i3db")
    preset = args.variants[0]
    if preset not in PRESETS:
        raise InputError(f"--variants: {preset!r} is no preset; there are {', '.join(PRESETS)}")
    folders = sorted(path for path in args.source.iterdir() if (path / "gt").is_dir())
    if not folders:
        raise InputError(f"{args.source}: has no scene of i3DB, expected folders like Scene04/gt")
    torch.set_num_threads(1)
    out = args.out / "i3db"

    def judge(folder: Path) -> dict[str, Any]:
        return judge_scene(read_i3db(folder), Run(out / folder.name), preset)

    return judge_each(folders, judge, table_of, out, observe)


COLUMNS = {
    "first": "first scene", "run": "run from it", "given": "true shapes, wrongly placed",
    "run_given": "run from them", "imapper": "iMapper's own result", "run_pitch": "pitch [degrees]",
    "run_height": "camera height [share]", "stature": "stature [m]",
}  # fmt: skip
"""What the summary shows: IoU3D, errors of the camera of `run`, the fitted stature."""


def table_of(found: dict[str, dict[str, Any]]) -> str:
    """The numbers as a table, with the mean of each overlap over the scenes."""
    lines = [[name, *(f"{row[key]:.3f}" for key in COLUMNS)] for name, row in found.items()]
    overlaps = list(COLUMNS)[:5]
    means = [f"{sum(row[key] for row in found.values()) / len(found):.3f}" for key in overlaps]
    return markdown(["scene", *COLUMNS.values()], [*lines, ["mean", *means, "", "", ""]]) + "\n"


def judge_scene(scene: I3dbScene, run: Run, preset: str) -> dict[str, Any]:
    """Fit the people, find a first scene, reconstruct both starts, compare with the truth."""
    camera = replace(scene.truth.camera, R_cam_world=LEVEL)  # its tilt is not given
    model = open_body()
    bodies = fit_bodies(FitInputs(scene.keypoints, camera, model)).bodies
    tall = None if bodies.pose is None else statures(bodies.pose)
    assert tall is not None, "of the open body"
    first = first_scene(
        seen_from(picture_of(scene.detections, camera), bodies, run), LayoutConfig(), run
    )
    numbers: dict[str, Any] = {
        "stature": float(tall[0]),
        **overlaps("first", first.scene.objects, scene),
        **overlaps("imapper", by_kind(scene.imapper, scene.truth.objects), scene),
    }
    given = wrongly_placed(scene, camera)
    numbers |= overlaps("given", given.objects, scene)
    for name, start, tilt in (("run", first.scene, first.tilt), ("run_given", given, None)):
        capture = replace(capture_of(scene, start, bodies), tilt=tilt)
        room = reconstruct(capture, PRESETS[preset], run)
        numbers |= overlaps(name, room.scene.objects, scene)
        numbers |= camera_errors(name, room.scene, scene.truth)
    return numbers


def picture_of(detections: tuple[Detection, ...], camera: Camera) -> Picture:
    """What a picture without people shows: the masks of the furniture."""
    blank = torch.zeros(camera.height, camera.width, dtype=torch.bool)
    masks = [blank if found.mask is None else decode(found.mask, 0) for found in detections]
    return Picture(camera, detections, torch.stack(masks), blank, None, None)


def capture_of(scene: I3dbScene, start: Scene, bodies: Bodies) -> Capture:
    """The capture that starts from a scene."""
    return Capture(
        name=scene.name, scene=start, camera_height=None, detections=scene.detections,
        reference=None, reference_people=None, bodies=bodies, people=None, touch=None, warnings=(),
    )  # fmt: skip


def wrongly_placed(scene: I3dbScene, camera: Camera) -> Scene:
    """The true shapes at wrong distances, sizes and yaws, under a level camera."""
    rng = np.random.default_rng(int("".join(c for c in scene.name if c.isdigit()) or 0))
    common = rng.uniform(0.8, 1.2)
    carry = LEVEL.mT @ scene.truth.camera.R_cam_world
    wrong: list[SceneObject] = []
    for true in scene.truth.objects:
        scale = torch.from_numpy(rng.uniform(0.85, 1.15, 3)).float()
        far = common * float(np.clip(1 + 0.1 * rng.standard_normal(), 0.7, 1.3))
        turn = math.radians(rng.uniform(-20, 20))
        turn += math.pi / 2 * float(rng.choice([-1, 1])) if rng.random() < 0.15 else 0.0
        middle = (true.mesh.verts.amin(0) + true.mesh.verts.amax(0)) / 2
        centre = carry @ (rot_y(true.yaw) @ middle + true.t_world_object) * far
        front = carry @ rot_y(true.yaw)[:, 2]
        yaw = torch.atan2(front[0], front[2]) + turn
        t = centre - rot_y(yaw) @ (scale * middle)
        wrong.append(replace(true, t_world_object=t, yaw=yaw, scale=scale))
    return Scene(camera, None, tuple(wrong))


def by_kind(
    objects: Sequence[SceneObject], truth: Sequence[SceneObject]
) -> tuple[SceneObject, ...]:
    """The nearest object of the same category for each true one, under its annotation."""
    from scipy.optimize import linear_sum_assignment

    def kind(thing: SceneObject) -> str:
        return SAME_KIND.get(thing.category, thing.category)

    cost = np.array([[
        float((a.t_world_object - b.t_world_object).norm()) if kind(a) == kind(b) else 1e3
        for b in objects] for a in truth]).reshape(len(truth), len(objects))  # fmt: skip
    rows, columns = linear_sum_assignment(cost)
    return tuple(
        replace(objects[b], annotation=truth[a].annotation)
        for a, b in zip(rows, columns, strict=True) if cost[a, b] < 1e3
    )  # fmt: skip


def overlaps(name: str, objects: Sequence[SceneObject], scene: I3dbScene) -> dict[str, Any]:
    """Mean IoU3D, a missing object counting 0, as it is and after one similarity."""
    found = {thing.annotation: thing for thing in objects}
    camera, pairs = scene.truth.camera, list[Pair]()
    for true in scene.truth.objects:
        if true.annotation in found:
            pairs.append(Pair(found[true.annotation], camera, true, camera, POINTS))
    missing = len(scene.truth.objects) - len(pairs)
    mean = sum(iou3d(pair) for pair in pairs) / len(scene.truth.objects)
    return {name: mean, f"{name}_aligned": iou3d_aligned(Together(tuple(pairs), missing))}


def camera_errors(name: str, found: Scene, truth: Scene) -> dict[str, float]:
    """Errors of pitch and roll [degrees] and of the camera's height [share]."""
    ours, true = (pitch_roll(scene.camera.R_cam_world.double()) for scene in (found, truth))
    assert found.ground is not None
    assert truth.ground is not None
    return {
        f"{name}_pitch": math.degrees(float(ours[0] - true[0])),
        f"{name}_roll": math.degrees(float(ours[1] - true[1])),
        f"{name}_height": found.ground / truth.ground - 1,
    }
