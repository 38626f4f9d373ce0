"""Measure a rebuilt room against the truth: objects and what they are like, camera, people."""

import json
import math
from dataclasses import asdict, replace
from typing import Any, Literal

import torch
from jaxtyping import Float
from torch import Tensor

from mover.core.observe import Observer, silent
from mover.core.records import record
from mover.core.run import Run, StageLog
from mover.core.types import Bodies, Camera, Capture, Room, Scene, SceneObject
from mover.evaluate.contact import TrueTouch, close_meshes, furniture_of
from mover.evaluate.evaluation import (
    EvaluateConfig,
    EvaluatedBodies,
    evaluate,
    evaluate_people,
    touch_in_truth,
)
from mover.evaluate.moves import measure_moves
from mover.evaluate.scene import unmatched
from mover.furniture.floor import floor_of
from mover.furniture.library import SEATS, STEP, TOPS, canonical
from mover.geometry.boxes import box_of
from mover.geometry.camera import to_camera
from mover.geometry.mesh import sample_surface
from mover.geometry.placement import place_object
from mover.geometry.raster import first_hit
from mover.geometry.rotations import wrap
from mover.geometry.watertight import close_mesh
from mover.io.capture.pose_file import into_camera
from mover.pipeline.outcome import to_world
from mover.pipeline.people import as_given
from mover.stages.config import RefineBodiesConfig
from mover.stages.objects.prepare_objects import find_regions
from mover.stages.people.refine_bodies import ABLATION, refine_bodies
from mover_bench.rooms.known import KnownRoom

WIDTH = 480  # [px] of the picture in which hidden shares are counted
BORDER = 3  # the wider picture is so many images wide and high
FLIPPED = math.radians(60)  # [rad]
PAUSE = 1.0  # [s]


@record
class Traits:
    """An object of the truth, for the rows of the tables."""

    id: str
    category: str
    touched: bool
    """People sit or lie on it, lean on it or lay a hand on it."""
    hidden: float
    """Share of what the image would show of it that other furniture hides; 1: all."""
    truncated: float = 0.0
    """Share of its picture that the border of the image cuts off; 1: all."""
    flipped: bool = False
    """The initial guess of its yaw is wrong by more than `FLIPPED`; false where there is none."""
    stays: int = 0
    """How often people use it: stretches of touch, with a second or more without between them."""


def traits_of(room: KnownRoom, initial: Scene) -> tuple[Traits, ...]:
    """What each object of a known room is, who uses it, and how well it is seen and guessed."""
    used = set(room.touched.unique().tolist())
    hidden, cut = hidden_shares(room.truth), truncated_shares(room.truth)
    guesses = {piece.id: piece for piece in initial.objects}
    return tuple(
        Traits(
            piece.id,
            piece.category,
            index in used,
            hidden[index],
            cut[index],
            is_flipped(piece, guesses.get(piece.id)),
            stays_at(room, index),
        )
        for index, piece in enumerate(room.truth.objects)
    )


def is_flipped(truth: SceneObject, guess: SceneObject | None) -> bool:
    """Whether a guess looks another way."""
    return guess is not None and float(wrap(guess.yaw - truth.yaw).abs()) > FLIPPED


def stays_at(room: KnownRoom, index: int) -> int:
    """How often people come to touch an object, each person for themselves."""
    bodies = room.bodies
    pause = PAUSE * (bodies.fps or 1.0)
    touching = (room.touched == index).any(1)
    count = 0
    for person in bodies.person.unique():
        frames = bodies.frame[touching & (bodies.person == person)].sort().values
        count += min(len(frames), 1) + int((frames.diff() > pause).sum())
    return count


def truncated_shares(scene: Scene) -> tuple[float, ...]:
    """Share of each object's pixels, seen alone in a wider picture, that are not in the image."""
    camera = scene.camera
    zoom = WIDTH / BORDER / camera.width
    height, width = (max(1, round(zoom * side)) for side in (camera.height, camera.width))
    size = (BORDER * height, BORDER * width)
    top, left = (BORDER - 1) * height // 2, (BORDER - 1) * width // 2
    smaller = torch.tensor([[width / camera.width], [height / camera.height], [1.0]])
    aside = torch.tensor([[0.0, 0.0, left], [0.0, 0.0, top], [0.0, 0.0, 0.0]])
    K = camera.K * smaller + aside
    shares: list[float] = []
    for piece in scene.objects:  # meshes differ in their number of triangles
        seen = _depth(piece, camera, K, size).isfinite()
        inside = int(seen[top : top + height, left : left + width].sum())
        shares.append(round(1 - inside / max(1, int(seen.sum())), 4))
    return tuple(shares)


def hidden_shares(scene: Scene) -> tuple[float, ...]:
    """Share of each object's pixels within the image that other objects hide."""
    alone = torch.stack(_depths(scene)) if scene.objects else torch.zeros(0, 1, 1)
    covered = alone.isfinite()
    seen = covered & (alone <= alone.amin(0, keepdim=True)) if len(alone) else covered
    whole, left = covered.sum((1, 2)), seen.sum((1, 2))
    shares = torch.where(whole > 0, 1 - left / whole.clamp_min(1), torch.ones_like(whole).float())
    return tuple(round(share, 4) for share in shares.tolist())


def _depths(scene: Scene) -> list[Float[Tensor, "h w"]]:
    """Depth of each object drawn alone in a small picture [m], inf where it is not."""
    camera = scene.camera
    zoom = min(1.0, WIDTH / camera.width)
    size = (max(1, round(camera.height * zoom)), max(1, round(camera.width * zoom)))
    zooms = torch.tensor([size[1] / camera.width, size[0] / camera.height, 1.0]).to(camera.K)
    return [_depth(piece, camera, camera.K * zooms[:, None], size) for piece in scene.objects]


def _depth(
    piece: SceneObject, camera: Camera, K: Float[Tensor, "3 3"], size: tuple[int, int]
) -> Float[Tensor, "h w"]:
    """Depth of an object drawn alone [m], inf where it is not."""
    mesh = place_object(piece)
    verts = to_camera(mesh.verts.to(camera.K), camera.R_cam_world)
    return first_hit(verts, mesh.faces, K, size)[0]


GIVEN, TRUE_GIVEN, TRUE_ROOM, TRUTH = "given", "true given", "true room", "true people"
TRAITS = ("id", "category", "touched", "hidden", "truncated", "flipped", "stays")
NEAR = 0.6  # [m] from the middle of a seat, at most, of its proposal
SURFACE = 4000  # points that tell the height of a seat
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
        "initial": (capture.scene, None if capture.bodies is None else as_given(capture)),
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
        "proposed": measure_proposals(trial, room),
        "moved": measure_moves(trial.truth, room.scene, _fps(trial)),
        "warnings": list(room.warnings),
    }


def _fps(trial: Trial) -> float | None:
    return None if trial.bodies is None else trial.bodies.fps


def measure_proposals(trial: Trial, room: Room) -> dict[str, Any]:
    """How what was not given, and is used, is proposed, and what else is.

    A proposal is that of the nearest piece of its sort (seats and steps, or tables) within `NEAR`;
    others are false.
    """
    given = {piece.id for piece in trial.capture.scene.objects}
    turn = trial.truth.camera.R_cam_world.mT @ room.scene.camera.R_cam_world
    places = [turn @ box_of(one.object).center for one in room.proposals]
    sorts = [_sort(one.object) for one in room.proposals]
    claimed: set[int] = set()
    rows: list[dict[str, Any]] = []
    for seat, traits in zip(trial.truth.objects, trial.traits, strict=True):
        sort = _sort(seat)
        used = traits.touched if sort == "rest" else f"hand {seat.id}" in trial.doing
        if seat.id in given or not used or sort is None:
            continue
        away = [float((at - box_of(seat).center)[[0, 2]].norm()) for at in places]
        near = [k for k, gap in enumerate(away) if gap < NEAR and sorts[k] == sort]
        row = {"id": seat.id, "category": seat.category, "found": bool(near)}
        if near:
            best = min(near, key=lambda k: away[k])
            height = seat_height(room.proposals[best].object) - seat_height(seat)
            row |= {"centre": away[best], "height": height}
        claimed.update(near)
        rows.append(row)
    return {"withheld": rows, "false": len(places) - len(claimed)}


def _sort(piece: SceneObject) -> Literal["rest", "hands"] | None:
    """What a piece carries: people at rest, or hands; None: nothing."""
    kind = canonical(piece.category)
    return "rest" if kind in {*SEATS, STEP} else "hands" if kind in TOPS else None


def seat_height(piece: SceneObject) -> float:
    """Of the surface that carries, over the piece's foot [m]."""
    mesh = place_object(piece)
    points, normals = sample_surface(mesh, SURFACE)
    points = points - torch.tensor([0.0, float(mesh.verts[:, 1].min()), 0.0])
    top = find_regions(points, normals, canonical(piece.category)).top
    return float(top[:, 1].median())


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
    return to_world(into_camera(room.bodies, room.scene.camera.R_cam_world), camera)


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
        room = under_camera(room, trial.capture, trial.capture.scene.camera)
    elif row in (TRUE_GIVEN, TRUE_ROOM):
        room = in_true_room(trial, room)
    weights = ABLATION.get(PROX if row == TRUE_ROOM else row)
    found = room.bodies
    if weights is not None:
        found = refine_bodies(room, trial.capture, RefineBodiesConfig(weights=weights)).bodies
    if row == TRUTH:
        found, scene = to_world(trial.bodies, trial.truth.camera), trial.truth
    return judge_people(trial, scene, found)


def judge_people(trial: Trial, scene: Scene, found: Bodies | None) -> dict[str, Any]:
    """The metrics of people in a room against the true ones."""
    assert found is not None, "the people were carried into a room"
    assert trial.bodies is not None, "a known room has true people"
    truth = to_world(trial.bodies, trial.truth.camera)
    solid = furniture_of(scene.objects, close_meshes(scene.objects))
    values = evaluate_people(found, floor_of(scene), solid, truth)
    return {"initial": {}, "image": {}, "full": values, "objects": [], "warnings": []}


def timing(stages: list[StageLog]) -> list[dict[str, Any]]:
    """What each stage cost, without the measuring."""
    ours = judge.__name__, truly.__name__
    return [asdict(stage) for stage in stages if stage.name not in ours]


def carry_all(room: Room, capture: Capture) -> Room:
    """The room with all people of the capture in its world, whatever part was given."""
    return under_camera(room, capture, room.scene.camera)


def under_camera(room: Room, capture: Capture, camera: Camera) -> Room:
    """The same room seen by another camera, with the people as they were given."""
    scene = replace(room.scene, camera=camera)
    return replace(room, scene=scene, bodies=to_world(as_given(capture), camera), kept=None)


def in_true_room(trial: Trial, room: Room) -> Room:
    """The true room, with the people as they were given."""
    proxies = tuple(close_mesh(piece.mesh) for piece in trial.truth.objects)
    room = replace(room, proxies=proxies, scene=trial.truth)
    return under_camera(room, trial.capture, trial.truth.camera)
