"""Every metric of the paper, before and after: how far a scene is from the truth.

Definitions, matching rules and sampling densities: docs/metrics.md.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import torch
from jaxtyping import Float, Int
from torch import Tensor

from mover.bodies.corrected import in_world
from mover.bodies.parts import SOLES, members, parts_of
from mover.core.records import record
from mover.core.run import Run
from mover.core.settings import Count, Metres, int_in
from mover.core.types import Bodies, Scene
from mover.evaluate import scene as compare
from mover.evaluate.bodies import (
    GROUND_METRICS,
    POSE_METRICS,
    TOUCH_METRICS,
    Furniture,
    Standing,
    Touch,
    close_meshes,
    feet_places,
    furniture_of,
    gather_touch,
    gather_truth,
    gather_twins,
    soles_of,
)
from mover.evaluate.stability import PHYSICS_METRICS, lacking, settle
from mover.geometry.placement import StandingMesh
from mover.geometry.warp_start import mapped
from mover.io.capture.bodies_file import read_bodies
from mover.io.capture.camera_file import camera_of
from mover.io.capture.scene_file import read_scene
from mover.io.files.fields import read_json, write_json

METRICS: dict[str, compare.Metric[Any]] = {
    **compare.OBJECT_METRICS,
    **compare.HARM_METRICS,
    **compare.SCENE_METRICS,
    **TOUCH_METRICS,
    **compare.CAMERA_METRICS,
    **GROUND_METRICS,
    **POSE_METRICS,
}
"""By name; with `PHYSICS_METRICS` all that metrics.json can hold."""
FIRST = ("iou3d", "p2s", "pitch_error", "non_collision", "contact_f1", "pje")
"""The six that the demo prints; its report has all."""


@dataclass(frozen=True)
class EvaluateConfig:
    """How densely the metrics are measured."""

    samples: Annotated[int, int_in(100, 10_000_000)] = 10_000
    """Points on each true surface, of equal area, for the distance to the estimated one."""
    bodies: Count = 100
    """At most so many bodies, spread evenly over the rows, for contact and collision."""
    reach: Metres = 0.05
    """A vertex touches furniture that is at most so far away [m]."""
    ground_tolerance: Metres = 0.01
    """How far a sole may be under the floor before it counts as penetration [m]."""
    by_place: bool = True
    """Objects that bear no true name are paired by place; False: they are false."""
    boxes: bool = False
    """The true objects are boxes without meshes: 3D boxes are compared in the image (IoU2D)."""
    feet: Literal["soles", "contacts"] = "soles"
    """What may be under the floor: all soles, or the foot contacts of still bodies (paper)."""


@record
class EvaluatedBodies:
    """The people of the three scenes, in the camera's or the world's frame; None: not known."""

    initial: Bodies | None
    result: Bodies | None
    truth: Bodies | None
    named: Float[Tensor, "bodies verts"] | None = None
    """Chance that a vertex of `result` touches something (POSA), for feet that are contacts."""


@record
class _Populated:
    """A scene and its people, in one world."""

    scene: Scene
    bodies: Bodies | None
    soles: Int[Tensor, " soles"]  #: The vertices under their feet
    furniture: tuple[StandingMesh, ...]
    """The closed objects where they stand; none where there are no people."""


def evaluate(
    initial: Scene,
    result: Scene,
    truth: Scene,
    bodies: EvaluatedBodies | None = None,
    config: EvaluateConfig | None = None,
    sides: Sequence[str] = compare.SIDES,
) -> dict[str, Any]:
    """Measure a scene before (`initial`) and after (`result`), or one of them, against the truth.

    `bodies` are the people of the three; without them their metrics are absent.

    Returns:
        What metrics.json holds: the means `initial` and `result`, and each of the `objects`.
    """
    config = config or EvaluateConfig()
    bodies = bodies or EvaluatedBodies(None, None, None)
    before, after, true = _populate((initial, result, truth), bodies)
    both = dict(zip(compare.SIDES, (before, after), strict=True))
    asked = {key: both[key] for key in compare.SIDES if key in sides}
    scenes = before.scene, after.scene, true.scene
    matched = dict(zip(compare.SIDES, compare.pairs(*scenes, config.by_place), strict=True))
    objects = compare.measure_objects(scenes, matched, sides, config.samples, config.boxes)
    people, touch = after.bodies or before.bodies, None
    if true.bodies is not None and people is not None:
        touch = gather_truth(true.bodies, true.furniture, people, config.bodies, config.reach)

    def of(key: str) -> dict[str, float]:
        judged = asked[key]
        found, camera = matched[key], judged.scene.camera
        known = [t for t in true.scene.objects if t.id in found]
        there = tuple(compare.Pair(found[t.id], camera, t, true.scene.camera, 0) for t in known)
        together = compare.Together(there, len(true.scene.objects) - len(there))
        values = compare.means_of(objects, key) | compare.measure(compare.SCENE_METRICS, together)
        values |= compare.measure(compare.CAMERA_METRICS, compare.Sight(judged.scene, true.scene))
        if judged.bodies is None:
            return values
        near = gather_touch(judged.bodies, judged.furniture, touch, config.bodies, config.reach)
        feet = judged.bodies.verts[:, judged.soles] if len(judged.soles) else None
        if config.feet == "contacts":
            named = bodies.named if judged is after else None
            feet = feet_places(judged.bodies, judged.scene.camera, named)
        return values | _people(
            judged.bodies, near, feet, judged.scene.ground, config.ground_tolerance, true.bodies
        )

    return dict(zip(asked, mapped(of, list(asked)), strict=True)) | {"objects": objects}


def evaluate_folder(
    out: Path, truth: Path, config: EvaluateConfig | None = None, physics: bool = True
) -> dict[str, Any]:
    """Measure the result folder `out` against the folder `truth` and write out/metrics.json.

    With `physics` both scenes are simulated as well; their convex parts are kept in out/stages.
    """
    initial_people, people, true_people = mapped(
        lambda path: read_bodies(path) if path.exists() else None,
        [out / "initial_bodies.npz", out / "bodies.npz", truth / "bodies.npz"],
    )
    bodies = EvaluatedBodies(initial_people, people, true_people)
    initial, result = read_scene(out / "initial.json"), read_scene(out / "scene.json")
    true = read_truth(truth)
    metrics = evaluate(initial, result, true, bodies, config)
    metrics["unmatched"] = compare.unmatched(initial, result, true)
    if physics and (missing := lacking()) is not None:
        metrics["not_measured"] = dict.fromkeys(PHYSICS_METRICS, missing)
    elif physics:
        for side, scene in zip(compare.SIDES, (initial, result), strict=True):
            metrics[side] |= compare.measure(PHYSICS_METRICS, settle(scene, Run(out)))
    write_json(metrics, out / "metrics.json")
    return metrics


def read_truth(folder: Path) -> Scene:
    """The true scene in a folder, for its own camera where it has one."""
    own = folder / "camera.json"
    return read_scene(folder / "scene.json", camera_of(read_json(own)) if own.exists() else None)


def table(metrics: Mapping[str, Any], shown: Sequence[str] | None = None) -> str:
    """The metrics before and after as plain text, all or those `shown`, then each object."""
    initial, result = metrics["initial"], metrics["result"]
    lines = [f"{'metric':34}{'before':>10}{'after':>10}{'best':>8}"]
    for name, metric in (METRICS | PHYSICS_METRICS).items():
        if (shown is None or name in shown) and (name in initial or name in result):
            title = f"{name} [{metric.unit}]" if metric.unit in ("m", "rad") else name
            values = _cell(initial, name) + _cell(result, name)
            lines.append(f"{title:34}{values}{metric.best:8.0f}")
    lines += ["", f"{'object':34}{'iou3d before, after':>20}{'center_error [m]':>20}"]
    for item in metrics["objects"]:
        cells = "".join(
            _cell(item[key], name)
            for name in ("iou3d", "center_error")
            for key in ("initial", "result")
        )
        lines.append(f"{item['id']:34.34}{cells}")
    for name, ids in metrics.get("unmatched", {}).items():
        lines += [f"{name}: {', '.join(ids)}"] if ids else []
    lines += [f"{n} is not measured: {why}" for n, why in metrics.get("not_measured", {}).items()]
    return "\n".join(lines)


def evaluate_people(
    bodies: Bodies, floor: float | None, furniture: Furniture, truth: Bodies | None = None
) -> dict[str, float]:
    """How people of a room fit its floor [m] and closed furniture, and how wrong they are.

    Floor and truth (people in the world of the true room) may not be known.
    """
    soles = members(parts_of(bodies), *SOLES)
    feet = bodies.verts[:, soles] if bool(soles.any()) else None
    config = EvaluateConfig()
    near = gather_touch(bodies, furniture, None, config.bodies, config.reach)
    return _people(bodies, near, feet, floor, config.ground_tolerance, truth)


def _people(
    bodies: Bodies,
    near: Touch,
    feet: Float[Tensor, "bodies points 3"] | None,
    floor: float | None,
    tolerance: float,
    truth: Bodies | None,
) -> dict[str, float]:
    """The metrics of a scene's people; what they or the truth do not give is left out."""
    values = compare.measure(TOUCH_METRICS, near)
    if floor is not None and feet is not None:
        values |= compare.measure(GROUND_METRICS, Standing(feet[..., 1] - floor, tolerance))
    twins = None if truth is None else gather_twins(bodies, truth)
    return values | ({} if twins is None else compare.measure(POSE_METRICS, twins))


def _cell(values: Mapping[str, float], name: str) -> str:
    return f"{values[name]:10.3f}" if name in values else f"{'-':>10}"


def _populate(scenes: tuple[Scene, Scene, Scene], people: EvaluatedBodies) -> list[_Populated]:
    """Scenes and people in double precision and in one world; no rows are no people."""
    rows = [
        b if b and len(b.frame) else None for b in (people.initial, people.result, people.truth)
    ]
    peopled = list(zip(scenes, rows, strict=True))
    closed = close_meshes(item for scene, b in peopled if b is not None for item in scene.objects)
    found: list[_Populated] = []
    for scene, b in peopled:
        soles, furniture = torch.zeros(0, dtype=torch.long), ()
        if b is not None:
            soles = soles_of(b, scene.camera)
            furniture = compare.doubled(tuple(furniture_of(scene.objects, closed)))
        world = None if b is None else in_world(compare.doubled(b), scene.camera)
        found.append(_Populated(compare.doubled(scene), world, soles, furniture))
    return found
