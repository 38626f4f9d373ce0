"""What is known of a room: the capture that a perfect upstream would give, and the truth."""

from collections.abc import Callable, Generator, Iterable
from contextlib import contextmanager

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.app.demo import rounded
from mover.bodies.skinning import open_body
from mover.core.records import map_tensors, record
from mover.core.types import Bodies, BodyPose, Capture, Detection, Masks, People, Scene, SceneObject
from mover.furniture.pieces import Furniture
from mover.geometry.rle import decode
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
    """Skin within 1 cm of a piece or of the floor."""
    touched: Int[Tensor, "bodies verts"]
    """What it touches: index of the piece, -1 the floor, -2 nothing."""
    actions: tuple[str, ...]
    """What each body does."""
    furniture: tuple[Furniture, ...]
    """The pieces in the order of `truth.objects`."""
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
class Acted:
    """One person, frame by frame, in the frame of the floor."""

    pose: BodyPose
    """Of the open body, float64."""
    pelvis: Float[np.ndarray, "frames 3"]
    """[m]"""
    origin: Float[np.ndarray, "3"]
    """The pelvis of the rest shape: what `transl` leaves out [m]."""
    labels: tuple[str, ...]
    """What is done in each frame."""
    touched: tuple[int, ...]
    """Index of the piece in use in each frame, or -1."""


@record
class Actor:
    """One person and what they do."""

    stage: Stage
    performance: Performance

    @property
    def acted(self) -> Acted:
        """The person frame by frame."""
        person, act = self.stage.person, self.performance
        pose = angles(person, act.posture)
        return Acted(pose, act.posture.pelvis, person.origin, act.labels, act.touched)


def build(
    plan: Plan,
    actors: tuple[Actor, ...],
    config: RoomConfig,
    name: str,
    refused: tuple[str, ...],
) -> KnownRoom:
    """Put people and furniture before the camera.

    Raises:
        RefusedError: If too little is seen or happens.
    """
    acts = tuple(actor.acted for actor in actors)
    _check(acts, config)
    sight = see(plan)
    detections = _detections(plan, sight, config)
    crowd = _crowd(plan, acts, config.fps)
    scene = _scene(plan)
    shown = visible(plan, crowd.bodies, lambda _: sight.depth)
    capture = Capture(
        name=name, scene=scene, camera_height=None, detections=detections,
        reference=sight.picture, reference_people=None, bodies=crowd.bodies,
        people=shown.people, touch=None, warnings=(),
    )  # fmt: skip
    furniture = tuple(piece.furniture for piece in plan.pieces)
    return KnownRoom(
        capture=capture, truth=scene, bodies=crowd.bodies, touching=crowd.touching,
        touched=crowd.touched, actions=crowd.actions, furniture=furniture, plan=plan,
        refused=refused, whole=shown.whole,
    )  # fmt: skip


def _check(acts: tuple[Acted, ...], config: RoomConfig) -> None:
    """Whether there is enough to see."""
    frames = max(len(a.labels) for a in acts)
    used = {(k, i) for k, a in enumerate(acts) for i in a.touched if i >= 0}
    if frames < config.least_frames or len(used) < config.least_touches:
        raise RefusedError(f"{frames} frames, {len(used)} pieces used")


def _scene(plan: Plan) -> Scene:
    pieces = []
    for index, piece in enumerate(plan.pieces):
        x, z = piece.place.tolist()
        place = torch.tensor([x, piece.height - plan.view.height, z])
        pieces.append(
            SceneObject(
                piece.id, piece.furniture.category, piece.furniture.mesh, "", index + 1,
                piece.support, place, torch.tensor(float(piece.heading)), torch.ones(3),
            )
        )  # fmt: skip
    return Scene(plan.view.camera, -plan.view.height, tuple(pieces))


def _detections(plan: Plan, sight: Sight, config: RoomConfig) -> tuple[Detection, ...]:
    found = []
    for index, piece in enumerate(plan.pieces):
        mask = (sight.piece == index).numpy()
        if mask.sum() < config.least_pixels:
            raise RefusedError(f"{piece.id} is hidden: {int(mask.sum())} pixels")
        box = box_of_mask(mask)
        found.append(Detection(index + 1, piece.furniture.category, box, encode([mask]), 1.0))
    return tuple(found)


@record
class _Crowd:
    """Everybody, row by row."""

    bodies: Bodies
    touching: Bool[Tensor, "bodies verts"]
    touched: Int[Tensor, "bodies verts"]
    actions: tuple[str, ...]


def _crowd(plan: Plan, acts: tuple[Acted, ...], fps: float) -> _Crowd:
    """Everybody in camera axes, how near they are to what, and what they do."""
    model = open_body()
    rows = [(f, k) for k, a in enumerate(acts) for f in range(len(a.labels))]
    order = sorted(range(len(rows)), key=lambda k: rows[k])
    index = torch.tensor(order)
    pose = in_camera(plan, acts, index)

    def near() -> list[Nearness]:
        return [nearness(model.posed(a.pose)[0].numpy(), plan.pieces) for a in acts]

    nears, (verts, joints) = beside(near, lambda: model.posed(pose))
    distance = torch.cat([torch.from_numpy(n.distance).float() for n in nears])[index]
    nearest = torch.cat([torch.from_numpy(n.nearest) for n in nears])[index]
    labels = [name for a in acts for name in a.labels]
    bodies = Bodies(
        verts=rounded(verts),
        faces=model.faces,
        joints=rounded(joints),
        joint_names=model.joint_names,
        frame=torch.tensor([rows[k][0] for k in order]),
        person=torch.tensor([rows[k][1] for k in order]),
        fps=fps,
        space="camera",
        pose=map_tensors(rounded, pose),
    )
    touching = distance < GAPE
    touched = torch.where(touching, nearest, torch.full_like(nearest, NONE))
    return _Crowd(bodies, touching, touched, tuple(labels[k] for k in order))


def in_camera(plan: Plan, acts: tuple[Acted, ...], index: Tensor) -> BodyPose:
    """Pose parameters in camera axes, float64; the root turns about the pelvis."""
    R = plan.view.camera.R_cam_world.double().numpy()
    eye = np.array([0.0, plan.view.height, 0.0])
    fields: dict[str, list[Tensor]] = {
        n: [] for n in ("betas", "global_orient", "body_pose", "transl")
    }
    for act in acts:
        turn = R @ from_vector(act.pose.global_orient.numpy())
        pelvis = (act.pelvis - eye) @ R.T
        fields["betas"].append(act.pose.betas)
        fields["body_pose"].append(act.pose.body_pose)
        fields["global_orient"].append(torch.from_numpy(to_vector(turn)))
        fields["transl"].append(torch.from_numpy(pelvis - act.origin))
    rows = {n: torch.cat(parts)[index] for n, parts in fields.items()}
    return BodyPose(model="makehuman", gender="neutral", extra={}, **rows)


@record
class Shown:
    """What is seen of everybody, row by row."""

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


def pieces_seen(
    people: People | None, frames: Iterable[int], piece: Callable[[int], Tensor], least: int = 1
) -> People:
    """Masks of at least so many pixels of the furniture in some frames, as `furniture.json` has it.

    `piece` is the index of the piece at each pixel of a frame, -1 for none, without people; the
    rows' `person` is the number of an annotation.
    """
    assert people is not None, "a known room has masks"
    rows: list[tuple[int, int]] = []
    masks: list[np.ndarray] = []
    for frame in frames:
        seen = piece(frame).clone()
        for row in (people.frame == frame).nonzero()[:, 0].tolist():
            seen[decode(people.masks, row)] = -1
        for index in seen.unique().tolist():
            mask = seen == index
            if index >= 0 and int(mask.sum()) >= least:
                rows.append((frame, index + 1))
                masks.append(mask.numpy())
    frame, number = torch.tensor(rows).unbind(1)
    return People(encode(masks), frame, number, {})
