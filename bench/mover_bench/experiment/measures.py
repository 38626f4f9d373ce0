"""Measure a reconstructed known room against the truth: objects, camera, people."""

import math
from collections import Counter
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from mover.core.records import record
from mover.core.types import Bodies, Camera, Capture, Room, Scene, SceneObject
from mover.evaluate.contact import TrueTouch
from mover.evaluate.evaluation import EvaluateConfig, EvaluatedBodies, evaluate, touch_in_truth
from mover.evaluate.scene import unmatched
from mover.extensions.moved_furniture.measure import measure_moves
from mover.extensions.moving_camera import bodies_as_given
from mover.furniture.library import SEATS, canonical
from mover.geometry.boxes import box_of
from mover.geometry.camera import to_camera
from mover.geometry.mesh import sample_surface
from mover.geometry.placement import place_object
from mover.geometry.raster import first_hit
from mover.geometry.rotations import wrap
from mover.pipeline.result import to_world
from mover.stages.objects.prepare_objects import find_regions
from mover_bench.rooms.known import KnownRoom

WIDTH = 480  # [px] of the picture in which occluded shares are counted
FLIPPED = math.radians(60)  # [rad]
NEAR = 0.6  # [m] from the middle of a seat, at most, of its proposal
SURFACE = 4000  # points that give the height of a seat


@record
class Traits:
    """An object of the truth, for the rows of the tables."""

    id: str
    category: str
    touched: bool
    """People sit or lie on it, lean on it or lay a hand on it."""
    hidden: float
    """Share of what the image would show of it that other furniture occludes; 1: all."""
    flipped: bool = False
    """The initial yaw is wrong by more than `FLIPPED`; false where there is none."""


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


def traits_of(room: KnownRoom, initial: Scene) -> tuple[Traits, ...]:
    """What each object of a known room is, whether people use it, how well it is seen and given."""
    used = set(room.touched.unique().tolist())
    hidden = hidden_shares(room.truth)
    given = {thing.id: thing for thing in initial.objects}
    return tuple(
        Traits(
            thing.id,
            thing.category,
            index in used,
            hidden[index],
            is_flipped(thing, given.get(thing.id)),
        )
        for index, thing in enumerate(room.truth.objects)
    )


def is_flipped(truth: SceneObject, initial: SceneObject | None) -> bool:
    """Whether an initial object looks another way."""
    return initial is not None and float(wrap(initial.yaw - truth.yaw).abs()) > FLIPPED


def hidden_shares(scene: Scene) -> tuple[float, ...]:
    """Share of each object's pixels within the image that other objects occlude."""
    depths = torch.stack(_depths(scene)) if scene.objects else torch.zeros(0, 1, 1)
    covered = depths.isfinite()
    front = covered & (depths <= depths.amin(0, keepdim=True)) if len(depths) else covered
    whole, left = covered.sum((1, 2)), front.sum((1, 2))
    shares = torch.where(whole > 0, 1 - left / whole.clamp_min(1), torch.ones_like(whole).float())
    return tuple(round(share, 4) for share in shares.tolist())


def _depths(scene: Scene) -> list[Float[Tensor, "h w"]]:
    """Depth of each object drawn by itself in a small picture [m], inf where it is not."""
    camera = scene.camera
    zoom = min(1.0, WIDTH / camera.width)
    size = (max(1, round(camera.height * zoom)), max(1, round(camera.width * zoom)))
    zooms = torch.tensor([size[1] / camera.width, size[0] / camera.height, 1.0]).to(camera.K)
    meshes = [place_object(thing) for thing in scene.objects]
    return [
        first_hit(
            to_camera(mesh.verts.to(camera.K), camera.R_cam_world),
            mesh.faces,
            camera.K * zooms[:, None],
            size,
        )[0]
        for mesh in meshes
    ]


class Judge:
    """Measures scenes of a trial; what they share is measured once."""

    def __init__(self, trial: Trial, config: EvaluateConfig | None = None) -> None:
        self.trial = trial
        self.config = replace(config or EvaluateConfig(), by_place=False)  # names are known
        self.touch: TrueTouch | None = None
        given = trial.capture.bodies
        if given is not None:
            bodies = EvaluatedBodies(None, given, trial.bodies)
            self.touch = touch_in_truth(trial.truth, bodies, self.config)
        people = None if given is None else bodies_as_given(trial.capture)
        self.initial = self.scene(trial.capture.scene, people)

    def scene(self, scene: Scene, people: Bodies | None) -> dict[str, Any]:
        """All metrics of a scene: `result` and `objects`."""
        bodies = EvaluatedBodies(None, people, self.trial.bodies, self.touch)
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
            {name: getattr(traits, name) for name in ABOUT}
            | {stage: measured["objects"][row]["result"] for stage, measured in found.items()}
            for row, traits in enumerate(self.trial.traits)
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


ABOUT = ("id", "category", "touched", "hidden", "flipped")


def measure_proposals(trial: Trial, room: Room) -> dict[str, Any]:
    """How well seats that were not given, and are used, are proposed, and what else is.

    A proposal is that of the nearest seat within `NEAR`; others are false.
    """
    given = {thing.id for thing in trial.capture.scene.objects}
    turn = trial.truth.camera.R_cam_world.mT @ room.scene.camera.R_cam_world
    centres = [turn @ box_of(one.object).center for one in room.proposals]
    claimed: Counter[int] = Counter()
    rows: list[dict[str, Any]] = []
    for seat, traits in zip(trial.truth.objects, trial.traits, strict=True):
        if seat.id in given or not traits.touched or canonical(seat.category) not in SEATS:
            continue
        away = [float((at - box_of(seat).center)[[0, 2]].norm()) for at in centres]
        near = [k for k, gap in enumerate(away) if gap < NEAR]
        row = {"id": seat.id, "category": seat.category, "found": bool(near)}
        if near:
            best = min(near, key=lambda k: away[k])
            height = seat_height(room.proposals[best].object) - seat_height(seat)
            row |= {"centre": away[best], "height": height}
        claimed.update(near)
        rows.append(row)
    return {"withheld": rows, "false": len(centres) - len(claimed)}


def seat_height(seat: SceneObject) -> float:
    """Of the surface that bears people, over the seat's foot [m]."""
    mesh = place_object(seat)
    points, normals = sample_surface(mesh, SURFACE)
    points = points - torch.tensor([0.0, float(mesh.verts[:, 1].min()), 0.0])
    top = find_regions(points, normals, canonical(seat.category)).top
    return float(top[:, 1].median())


def under_camera(room: Room, capture: Capture, camera: Camera) -> Room:
    """The same room seen by another camera, with all people of the capture as they were given."""
    scene = replace(room.scene, camera=camera)
    return replace(room, scene=scene, bodies=to_world(bodies_as_given(capture), camera), kept=None)
