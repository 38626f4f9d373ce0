"""What is known of a room: the capture that a perfect upstream would give, and the truth."""

from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.app.demo import rounded
from mover.bodies.skinning import open_body
from mover.core.records import map_tensors, record
from mover.core.types import (
    Bodies,
    BodyPose,
    Capture,
    Detection,
    Masks,
    Mesh,
    People,
    Scene,
    SceneObject,
)
from mover.furniture.library import canonical, make_piece
from mover.furniture.pieces import Furniture
from mover.geometry.warp_start import mapped
from mover_bench.rooms.compose import Plan, draw_plan, make_view
from mover_bench.rooms.config import ActConfig, RoomConfig
from mover_bench.rooms.motion import DOOR, Performance, Stage, Stop, Task, perform
from mover_bench.rooms.placed import ROOMY, Placed, free_of
from mover_bench.rooms.poses import (
    angles,
    facing,
    from_vector,
    jointed,
    make_person,
    rows,
    to_vector,
)
from mover_bench.rooms.render import Sight, box_of_mask, draw_bodies, encode, look_at, see
from mover_bench.rooms.resting import table_stand
from mover_bench.rooms.truth import GAPE, NONE, nearness


@contextmanager
def one_thread() -> Generator[None, None, None]:
    """Let torch use one thread inside the block (or the decorated function)."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)


@record
class KnownRoom:
    """A capture without noise, and the truth behind it."""

    capture: Capture  #: what a perfect upstream would give: true scene, camera, bodies and masks
    truth: Scene
    bodies: Bodies  #: in the camera frame, with pose parameters of the open body
    touching: Bool[Tensor, "bodies verts"]  #: skin within 1 cm of an object or of the floor
    touched: Int[Tensor, "bodies verts"]
    """What it touches: index of the object, -1 the floor, -2 nothing."""
    actions: tuple[str, ...]  #: what each body does
    furniture: tuple[Furniture, ...]  #: the objects in the order of `truth.objects`
    plan: Plan
    refused: tuple[str, ...]  #: rooms and tasks that were not true enough, with the reasons
    whole: Int[Tensor, " bodies"]  #: pixels that each body would fill if nothing occluded it


def rounded_bodies(bodies: Bodies) -> Bodies:
    """Positions and parameters so that the last bits of other machines do not show."""
    return map_tensors(lambda x: rounded(x) if x.is_floating_point() else x, bodies)


class RefusedError(Exception):
    """A draft of a room is not true enough or not rich enough."""


class NoRoomError(ValueError):
    """A seed of a set has no room."""


@record
class Actor:
    """One person and what they do."""

    stage: Stage
    performance: Performance

    @property
    def pose(self) -> BodyPose:
        """Of the open body in the frame of the floor, float64."""
        return angles(self.stage.person, self.performance.posture)


def build(
    plan: Plan, actors: tuple[Actor, ...], config: RoomConfig, name: str, refused: tuple[str, ...]
) -> KnownRoom:
    """Put people and furniture before the camera.

    Raises:
        RefusedError: If too little is visible or happens.
    """
    acts = [actor.performance for actor in actors]
    frames = max(len(act.labels) for act in acts)
    used = {(k, i) for k, act in enumerate(acts) for i in act.touched if i >= 0}
    if frames < config.least_frames or len(used) < config.least_touches:
        raise RefusedError(f"{frames} frames, {len(used)} pieces used")
    sight = see(plan)
    detections = _detections(plan, sight, config)
    rows = sorted((f, k) for k, act in enumerate(acts) for f in range(len(act.labels)))
    starts = np.cumsum([0, *(len(act.labels) for act in acts)])
    index = torch.tensor([int(starts[k]) + f for f, k in rows])
    model, pose = open_body(), in_camera(plan, actors, index)
    nears = [nearness(model.posed(a.pose)[0].numpy(), plan.pieces) for a in actors]
    verts, joints = model.posed(pose)
    distance = torch.cat([torch.from_numpy(n.distance).float() for n in nears])[index]
    nearest = torch.cat([torch.from_numpy(n.nearest) for n in nears])[index]
    touching = distance < GAPE
    frame, person = torch.tensor(rows).unbind(1)
    bodies = rounded_bodies(Bodies(
        verts, model.faces, joints, model.joint_names, frame, person, config.fps, "camera", pose
    ))  # fmt: skip
    scene = scene_of(plan)
    shown = visible(plan, bodies, lambda _: sight.depth)
    capture = Capture(
        name=name, scene=scene, camera_height=None, detections=detections,
        reference=sight.picture, reference_people=None, bodies=bodies, people=shown.people,
        touch=None, warnings=(),
    )  # fmt: skip
    return KnownRoom(
        capture=capture, truth=scene, bodies=bodies, touching=touching,
        touched=torch.where(touching, nearest, torch.full_like(nearest, NONE)),
        actions=tuple(acts[k].labels[f] for f, k in rows),
        furniture=tuple(piece.furniture for piece in plan.pieces), plan=plan, refused=refused,
        whole=shown.whole,
    )  # fmt: skip


def scene_of(plan: Plan) -> Scene:
    """The furniture in the world of the camera."""
    ground = -plan.view.height
    objects = tuple(
        SceneObject(
            piece.id, piece.furniture.category, piece.furniture.mesh, "", index, "ground",
            torch.tensor([float(piece.at[0]), ground, float(piece.at[1])]),
            torch.tensor(float(piece.heading)), torch.ones(3),
        )
        for index, piece in enumerate(plan.pieces, 1)
    )  # fmt: skip
    return Scene(plan.view.camera, ground, objects)


def _detections(plan: Plan, sight: Sight, config: RoomConfig) -> tuple[Detection, ...]:
    found = []
    for index, piece in enumerate(plan.pieces):
        mask = (sight.piece == index).numpy()
        if mask.sum() < config.least_pixels:
            raise RefusedError(f"{piece.id} is hidden: {int(mask.sum())} pixels")
        box = box_of_mask(mask)
        found.append(Detection(index + 1, piece.furniture.category, box, encode([mask]), 1.0))
    return tuple(found)


def in_camera(plan: Plan, actors: Sequence[Actor], index: Tensor) -> BodyPose:
    """Pose parameters in camera axes, float64; the root turns about the pelvis."""
    R = plan.view.camera.R_cam_world.double().numpy()
    eye = np.array([0.0, plan.view.height, 0.0])
    poses: list[BodyPose] = []
    for actor in actors:
        pose = actor.pose
        turn = R @ from_vector(pose.global_orient.numpy())
        pelvis = (actor.performance.posture.pelvis - eye) @ R.T
        transl = torch.from_numpy(pelvis - actor.stage.person.origin)
        poses.append(replace(pose, global_orient=torch.from_numpy(to_vector(turn)), transl=transl))
    names = ("betas", "global_orient", "body_pose", "transl")
    rows = {n: torch.cat([getattr(pose, n) for pose in poses])[index] for n in names}
    return replace(poses[0], **rows)


@record
class Shown:
    """What is seen of each body."""

    people: People  #: masks without what furniture or a nearer person hides
    whole: Int[Tensor, " bodies"]  #: pixels of the body by itself


def visible(plan: Plan, bodies: Bodies, furniture: Callable[[int], Tensor]) -> Shown:
    """What the camera sees of bodies in its axes; `furniture` is its depth in a frame [m]."""

    def at(frame: int) -> list[tuple[bytes, int]]:
        depth = furniture(frame)
        group = bodies.verts[bodies.frame == frame]
        views = [look_at(plan, verts, bodies.faces) for verts in group]
        nearest = depth.clone()
        for look in views:
            nearest[look.window] = torch.minimum(nearest[look.window], look.depth)
        found: list[tuple[bytes, int]] = []
        for look in views:
            whole = look.depth.isfinite()
            mask = torch.zeros_like(depth, dtype=torch.bool)
            mask[look.window] = whole & (look.depth <= nearest[look.window])
            found.append((encode([mask.numpy()]).counts[0], int(whole.sum())))
        return found

    # Rows are in the order of their frames.
    rows = [row for found in mapped(at, bodies.frame.unique().tolist()) for row in found]
    camera = plan.view.camera
    coded = Masks(camera.height, camera.width, tuple(mask for mask, _ in rows))
    people = People(coded, bodies.frame, bodies.person, {})
    return Shown(people, torch.tensor([count for _, count in rows]))


SITS = frozenset({"chair", "armchair", "office chair", "sofa", "stool", "bench"})
STANDS = frozenset({"table", "desk", "cabinet"})


def free_place(plan: Plan, rng: np.random.Generator) -> np.ndarray:
    """A place to stand with room around it, in view of the camera (x, z) [m].

    Raises:
        RefusedError: If there is none.
    """
    low, high = plan.walls[0] + 0.45, np.array([plan.walls[1, 0] - 0.45, -2.9])
    for _ in range(200):
        place = rng.uniform(low, high)
        if abs(place[0]) < 0.5 * -place[1] and free_of(place, plan.pieces, ROOMY):
            return place
    raise RefusedError("the room has no free floor")


def draw_tasks(
    plan: Plan, rng: np.random.Generator, length: float, acts: ActConfig
) -> tuple[Task, ...]:
    """Sit, lean, lie and stand at tables in random order; walk before and after.

    `length` is a factor on all times to stay.
    """
    uses = _uses(plan, rng, length)
    tasks = [uses[k] for k in rng.permutation(len(uses))]
    goals = [free_place(plan, rng).tolist() for _ in range(acts.walks)]
    walks = [Task("walk", goal=(x, z)) for x, z in goals]
    return (*walks[:1], *tasks[: acts.tasks], *walks[1:])


def _uses(plan: Plan, rng: np.random.Generator, length: float) -> list[Task]:
    """What can be done with each object, once."""
    tasks: list[Task] = []
    for index, piece in enumerate(plan.pieces):
        seat, name = piece.furniture, canonical(piece.furniture.category)
        stay, wide = length * float(rng.uniform(4.5, 6.5)), seat.seat_right - seat.seat_left
        if name in SITS:
            kind = "lean" if seat.back_height > 0 and rng.uniform() < 0.6 else "sit"
            room = wide / 2 - 0.3
            along = float(rng.uniform(-room, room)) if room > 0 else 0.0
            tasks.append(Task(kind, index, seconds=stay, along=along))
        if name == "bed" or (name == "sofa" and wide > 1.3 and rng.uniform() < 0.5):
            side, roll = (1 if rng.integers(2) else -1), name == "bed"
            tasks.append(Task("lie", index, seconds=stay, side=side, roll=roll))
        if name in STANDS and 0.65 < seat.top_height < 1.0:
            side = _open_side(plan, index, rng)
            tasks.append(Task("table", index, seconds=0.7 * stay, side=side))
    return tasks


def _open_side(plan: Plan, index: int, rng: np.random.Generator) -> int:
    sides = [0, 1, 2, 3] if plan.pieces[index].furniture.category == "table" else [0]
    others = tuple(p for k, p in enumerate(plan.pieces) if k != index)
    good = []
    for side in sides:
        place, heading = table_stand(plan.pieces, index, side, 0.0)
        door = place - DOOR * facing(np.array(heading))
        inside = (door > plan.walls[0] + 0.3).all() and (door < plan.walls[1] - 0.3).all()
        if inside and free_of(door, others, 0.3) and free_of(place, others, 0.25):
            good.append(side)
    return int(rng.choice(good)) if good else sides[0]


CLEAR = 0.25  # [m], between the joints of two people
MOST_WAIT = 24.0  # [s], before a person starts


@one_thread()
def make_room(seed: int, config: RoomConfig | None = None) -> KnownRoom:
    """A room in which everything is known; the same for the same seed and configuration.

    Raises:
        NoRoomError: If 60 drafts in a row had to be refused.
    """
    config = config or RoomConfig()
    refused: list[str] = []
    for draft in range(60):
        rng = np.random.default_rng([seed, draft])
        try:
            plan = draw_plan(rng, config)
            actors = cast(plan, config, rng, refused)
            return build(plan, actors, config, f"room_{seed}", tuple(refused))
        except RefusedError as error:
            refused.append(f"draft {draft}: {error}")
    raise NoRoomError(f"seed {seed}: 60 drafts were refused: {refused[-3:]}")


def cast(
    plan: Plan, config: RoomConfig, rng: np.random.Generator, refused: list[str]
) -> tuple[Actor, ...]:
    """The performances of all people."""
    if len(plan.pieces) < config.least_pieces:
        raise RefusedError(f"only {len(plan.pieces)} pieces fit")
    actors: list[Actor] = []
    for _ in range(6 * config.people):
        if len(actors) == config.people:
            break
        actor = _actor(plan, config, rng)
        wait = patience(actor, actors)
        if wait is not None:
            refused += actor.performance.refused
            acted = shown(actor.performance, wait, config.most_frames)
            actors.append(replace(actor, performance=acted))
    if len(actors) < config.people:
        raise RefusedError("people run into each other")
    return tuple(actors)


def _actor(plan: Plan, config: RoomConfig, rng: np.random.Generator) -> Actor:
    """A person of a random shape who does random things."""
    bounds = np.stack([plan.walls[0] + 0.25, plan.walls[1] - 0.25])
    adult = [float(b) for b in np.clip(rng.normal(0, 0.7, 4), -1.4, 1.4)] + [0.0] * 6
    stage = Stage(make_person(adult), plan.pieces, bounds, config.fps)
    tasks, place = draw_tasks(plan, rng, config.stay, config.acts), free_place(plan, rng)
    start = Stop(place, float(rng.uniform(-np.pi, np.pi)), place)
    return Actor(stage, perform(stage, tasks, start, rng, config.most_frames))


def patience(newcomer: Actor, others: list[Actor]) -> int | None:
    """Fewest frames to stand still first so that joints of two people keep `CLEAR`; None: never."""
    if not others:
        return 0
    own = jointed(newcomer.stage.person, newcomer.performance.posture)
    theirs = [jointed(o.stage.person, o.performance.posture) for o in others]
    for wait in range(0, int(MOST_WAIT * newcomer.stage.fps) + 1, 2):
        mine = np.concatenate([np.repeat(own[:1], wait, axis=0), own])
        if all(_clear(mine, joints) for joints in theirs):
            return wait
    return None


def _clear(a: np.ndarray, b: np.ndarray) -> bool:
    frames = min(len(a), len(b))
    middle = np.linalg.norm(a[:frames, 0] - b[:frames, 0], axis=-1)
    near = np.flatnonzero(middle < 2.0)
    gap = np.linalg.norm(a[near, :, None] - b[near, None], axis=-1)
    return bool(gap.size == 0 or gap.min() > CLEAR)


def shown(performance: Performance, wait: int, most: int) -> Performance:
    """The same after standing still for so many frames; at most `most` frames, unless that is 0."""
    order = np.maximum(np.arange(-wait, len(performance.labels)), 0)
    first = slice(0, most or None)
    return replace(
        performance, posture=rows(performance.posture, order[first]),
        labels=(("stand",) * wait + performance.labels)[first],
        touched=((-1,) * wait + performance.touched)[first],
    )  # fmt: skip


_DEMO: tuple[tuple[str, str, int, int, tuple[float, float, float]], ...] = (
    ("bed_0", "single bed", 0, 3, (-1.75, -5.08, 0.0)),
    ("nightstand_0", "nightstand", 0, 3, (-0.9, -5.92, 0.0)),
    ("shelf_0", "shelf", 2, 3, (-0.05, -5.98, 0.0)),
    ("cabinet_0", "cabinet", 1, 3, (0.95, -5.9, 0.0)),
    ("sofa_0", "sofa", 0, 6, (2.1, -4.72, -1.5708)),
    ("floor_lamp_0", "floor lamp", 0, 3, (1.72, -6.02, 0.0)),
    ("table_0", "table", 0, 3, (-0.98, -3.2, 0.05)),
    ("chair_0", "chair", 1, 3, (0.45, -3.9, 0.35)),
)
"""Id, piece, style, seed of the sizes, and (x, z, heading) of the demo's furniture."""


@one_thread()
def demo_room() -> KnownRoom:
    """A bed-sitting room whose tenant walks, sits, leans back, lies and stands at a table."""
    plan, actor = demo_plan()
    return build(plan, (actor,), RoomConfig(), "demo", actor.performance.refused)


def demo_plan() -> tuple[Plan, Actor]:
    """Its furniture, and what the tenant does."""
    pieces = tuple(
        Placed(name, make_piece(kind, np.random.default_rng(sizes), style), spot[:2], spot[2])
        for name, kind, style, sizes, spot in _DEMO
    )
    view = make_view((960, 540), 1.62, float(np.radians(-12.5)), float(np.radians(1.1)), 1.15)
    plan = Plan(pieces, view, (-2.75, -6.25), (2.75, -1.9))
    tasks = (
        Task("walk", goal=(1.1, -4.9)),
        Task("sit", 7, seconds=5.0),
        Task("lean", 4, seconds=5.0, along=0.3),
        Task("table", 6, seconds=4.0, side=2),
        Task("lie", 0, seconds=6.0, side=1, roll=True),
        Task("walk", goal=(0.9, -3.0)),
    )
    stage = Stage(make_person([0.0] * 10), pieces, np.array([[-2.5, -6.0], [2.5, -2.1]]), 5.0)
    start = Stop(np.array([0.9, -2.95]), 3.0, np.array([0.9, -2.95]))
    return plan, Actor(stage, perform(stage, tasks, start, np.random.default_rng(5)))


@one_thread()
def draw_frame(room: KnownRoom, frame: int) -> Float[Tensor, "h w 3"]:
    """A picture of the room with all people in it, in [0, 1]."""
    rows = torch.nonzero(room.bodies.frame == frame)[:, 0].tolist()
    meshes = [Mesh(room.bodies.verts[k], room.bodies.faces) for k in rows]
    return draw_bodies(room.plan, see(room.plan), meshes)
