"""Measure a reconstructed known room against the truth: objects, camera, people."""

from collections import Counter
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Bool
from torch import Tensor

from mover.core.records import record
from mover.core.types import Bodies, Camera, Capture, Room, Scene, SceneObject
from mover.evaluate.evaluation import EvaluateConfig, EvaluatedBodies, evaluate
from mover.evaluate.scene import Pair, iou3d, unmatched
from mover.extensions.moving_camera import bodies_as_given
from mover.furniture.library import SEATS, canonical
from mover.geometry.boxes import box_of
from mover.geometry.mesh import sample_surface
from mover.geometry.placement import changes, place_object, placed_at
from mover.pipeline.result import to_world
from mover.stages.objects.prepare_objects import find_regions

NEAR = 0.6  # [m] from the middle of a seat, at most, of its proposal
SOON = 5  # frames after a true change, by which a video of any rate shows the object at rest
SURFACE = 4000  # points that give the height of a seat


@record
class Trial:
    """A known room as the method gets it, and the truth."""

    capture: Capture  #: with noise
    truth: Scene
    bodies: Bodies | None  #: the true people
    used: tuple[bool, ...] = ()
    """Which true objects people sit or lie on, lean on or lay a hand on."""
    touching: Bool[Tensor, "bodies verts"] | None = None
    """Which skin of the capture's bodies truly touches an object or the floor."""


class Judge:
    """Measures scenes of a trial; the initial one once."""

    def __init__(self, trial: Trial, config: EvaluateConfig | None = None) -> None:
        self.trial = trial
        self.config = replace(config or EvaluateConfig(), by_place=False)  # names are known
        people = None if trial.capture.bodies is None else bodies_as_given(trial.capture)
        self.initial = self.scene(trial.capture.scene, people)

    def scene(self, scene: Scene, people: Bodies | None) -> dict[str, Any]:
        """All metrics of a scene: `result` and `objects`."""
        bodies = EvaluatedBodies(None, people, self.trial.bodies)
        given, truth = self.trial.capture.scene, self.trial.truth
        return evaluate(given, scene, truth, bodies, self.config, ("result",))

    def room(self, room: Room) -> dict[str, Any]:
        """All metrics of the initial scene, of Stage 1 and of the full method, object by object.

        Stage 1 has camera, ground and people of the full method: only the furniture differs.
        """
        found = {
            "initial": self.initial,
            "image": self.scene(room.image_only, room.bodies),
            "full": self.scene(room.scene, room.bodies),
        }
        objects = [
            {"id": thing.id, "category": thing.category}
            | {stage: measured["objects"][row]["result"] for stage, measured in found.items()}
            for row, thing in enumerate(self.trial.truth.objects)
        ]
        scenes = self.trial.capture.scene, room.scene, self.trial.truth
        fps = None if room.bodies is None else room.bodies.fps
        return {
            **{stage: measured["result"] for stage, measured in found.items()},
            "objects": objects,
            "unmatched": unmatched(*scenes, by_place=False),
            "proposed": measure_proposals(self.trial, room),
            "moved": measure_moves(self.trial.truth, room.scene, fps),
            "warnings": list(room.warnings),
        }


def measure_moves(truth: Scene, found: Scene, fps: float | None = None) -> dict[str, Any]:
    """Whether objects that are moved stand where they should when, and move when they should.

    Of `objects` that are truly moved: IoU3D in each true stay, how far the nearest change is from
    each true one [s; frames without `fps`] (None: none is), mean IoU3D while a person moves it;
    `false`: how many others are moved by mistake.
    """
    pieces = {piece.id: piece for piece in found.objects}
    rows: list[dict[str, Any]] = []
    for true in truth.objects:
        piece = pieces.get(true.id)
        if not true.segments or piece is None:
            continue
        stays = [segment.frame + SOON for segment in true.segments if segment.mover is None]
        held = [segment.frame for segment in true.segments if segment.mover is not None]
        shared = {
            frame: iou3d(Pair(
                placed_at(piece, frame), found.camera, placed_at(true, frame), truth.camera, 1
            ))
            for frame in (*stays, *held)
        }  # fmt: skip
        late = [
            min((abs(change - when) / (fps or 1.0) for change in changes(piece)), default=None)
            for when in changes(true)
        ]
        on_the_way = sum(shared[frame] for frame in held) / len(held) if held else None
        row = {"iou3d": [shared[frame] for frame in stays], "late": late, "on_the_way": on_the_way}
        rows.append({"id": true.id} | row)
    still = {true.id for true in truth.objects if not true.segments}
    return {"objects": rows, "false": sum(bool(p.segments) for p in found.objects if p.id in still)}


def measure_proposals(trial: Trial, room: Room) -> dict[str, Any]:
    """How well seats that were not given, and are used, are proposed, and what else is.

    A proposal is that of the nearest seat within `NEAR`; others are false.
    """
    given = {thing.id for thing in trial.capture.scene.objects}
    turn = trial.truth.camera.R_cam_world.mT @ room.scene.camera.R_cam_world
    centres = [turn @ box_of(one.proposed).center for one in room.proposals]
    claimed: Counter[int] = Counter()
    rows: list[dict[str, Any]] = []
    for seat, used in zip(trial.truth.objects, trial.used, strict=True):
        if seat.id in given or not used or canonical(seat.category) not in SEATS:
            continue
        away = [float((at - box_of(seat).center)[[0, 2]].norm()) for at in centres]
        near = [k for k, gap in enumerate(away) if gap < NEAR]
        row = {"id": seat.id, "category": seat.category, "found": bool(near)}
        if near:
            best = min(near, key=lambda k: away[k])
            height = seat_height(room.proposals[best].proposed) - seat_height(seat)
            row |= {"centre": away[best], "height": height}
        claimed.update(near)
        rows.append(row)
    return {"withheld": rows, "false": len(centres) - len(claimed)}


def seat_height(seat: SceneObject) -> float:
    """Of the surface that bears people, over the seat's foot [m]."""
    mesh = place_object(seat)
    points, normals = sample_surface(mesh, SURFACE)
    points = points - torch.tensor([0.0, float(mesh.verts[:, 1].min()), 0.0])
    top, _ = find_regions(points, normals, canonical(seat.category))
    return float(top[:, 1].median())


def under_camera(room: Room, capture: Capture, camera: Camera) -> Room:
    """The same room seen by another camera, with all people of the capture as they were given."""
    scene = replace(room.scene, camera=camera)
    return replace(room, scene=scene, bodies=to_world(bodies_as_given(capture), camera), kept=None)
