"""What is known of a room: the capture that a perfect upstream would give, and the truth."""

from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Int
from torch import Tensor

from mover.app.demo import rounded
from mover.bodies.skinning import open_body
from mover.core.records import map_tensors, record
from mover.core.types import Bodies, BodyPose, Capture, Detection, Masks, People, Scene, SceneObject
from mover.furniture.pieces import Furniture
from mover.geometry.warp_start import beside, mapped
from mover_bench.rooms.compose import Plan
from mover_bench.rooms.config import RoomConfig
from mover_bench.rooms.motion import Performance, Stage
from mover_bench.rooms.poses import angles
from mover_bench.rooms.render import Sight, box_of_mask, encode, look_at, see
from mover_bench.rooms.truth import GAPE, NONE, Nearness, nearness
from mover_bench.rooms.turns import from_vector, to_vector


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

    capture: Capture
    """What a perfect upstream would give: true scene, camera, bodies and masks."""
    truth: Scene
    bodies: Bodies
    """In the camera frame, with pose parameters of the open body."""
    touching: Bool[Tensor, "bodies verts"]
    """Skin within 1 cm of an object or of the floor."""
    touched: Int[Tensor, "bodies verts"]
    """What it touches: index of the object, -1 the floor, -2 nothing."""
    actions: tuple[str, ...]
    """What each body does."""
    furniture: tuple[Furniture, ...]
    """The objects in the order of `truth.objects`."""
    plan: Plan
    refused: tuple[str, ...]
    """Rooms and tasks that were not true enough, with the reasons."""
    whole: Int[Tensor, " bodies"]
    """Pixels that each body would fill if nothing occluded it."""


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

    def near() -> list[Nearness]:
        return [nearness(model.posed(a.pose)[0].numpy(), plan.pieces) for a in actors]

    nears, (verts, joints) = beside(near, lambda: model.posed(pose))
    distance = torch.cat([torch.from_numpy(n.distance).float() for n in nears])[index]
    nearest = torch.cat([torch.from_numpy(n.nearest) for n in nears])[index]
    touching = distance < GAPE
    bodies = Bodies(
        verts=rounded(verts), faces=model.faces, joints=rounded(joints),
        joint_names=model.joint_names, frame=torch.tensor([f for f, _ in rows]),
        person=torch.tensor([k for _, k in rows]), fps=config.fps, space="camera",
        pose=map_tensors(rounded, pose),
    )  # fmt: skip
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
    objects = []
    for index, piece in enumerate(plan.pieces):
        x, z = piece.place.tolist()
        t = torch.tensor([x, piece.height - plan.view.height, z])
        objects.append(
            SceneObject(
                piece.id, piece.furniture.category, piece.furniture.mesh, "", index + 1,
                piece.support, t, torch.tensor(float(piece.heading)), torch.ones(3),
            )
        )  # fmt: skip
    return Scene(plan.view.camera, -plan.view.height, tuple(objects))


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

    people: People
    """Masks without what furniture or a nearer person hides."""
    whole: Int[Tensor, " bodies"]
    """Pixels of the body by itself."""


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
