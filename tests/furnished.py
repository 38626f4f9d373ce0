"""A finished result without a run: library furniture on a floor, and the open body in motion."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from little_room import GROUND, camera

import mover.io.export.solids
from mover.bodies.skinning import open_body, zero_pose
from mover.core.types import Bodies, BodyPose, Scene, SceneObject, Segment
from mover.furniture.library import make_piece
from mover.io.capture.bodies_file import write_bodies
from mover.io.capture.scene_file import write_scene

SPOTS = {
    "chair": (0.9, -2.6, 0.3), "sofa": (-1.6, -4.2, 0.8), "table": (0.4, -4.6, -0.1),
    "shelf": (2.4, -4.4, -1.2), "floor lamp": (-2.6, -2.6, 0.0),
}  # fmt: skip
FPS = 10.0


@pytest.fixture(scope="module", autouse=True)
def along_the_axes():
    """CoACD takes seconds where the cuts along the axes leave hollows: it has a test of its own."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(mover.io.export.solids, "find_spec", lambda _: None)
        yield


def furnished(
    names: tuple[str, ...] = tuple(SPOTS), seed: int = 0, ground: float = GROUND
) -> Scene:
    """Pieces of the library on the floor, none near another."""
    rng = np.random.default_rng(seed)
    pieces: list[SceneObject] = []
    for name in names:
        x, z, yaw = SPOTS[name]
        mesh = make_piece(name, rng).mesh
        key = f"{name.replace(' ', '_')}_0"
        t = torch.tensor([x, ground, z])
        pieces.append(
            SceneObject(key, name, mesh, "", None, "ground", t, torch.tensor(yaw), torch.ones(3))
        )
    return Scene(camera(), ground, tuple(pieces))


def moved(scene: Scene, frame: int) -> Scene:
    """The first object stands elsewhere and turned from a frame on."""
    first, *others = scene.objects
    there = first.t_world_object + torch.tensor([0.3, 0.0, 1.0])
    stays = (Segment(0, first.t_world_object, first.yaw), Segment(frame, there, first.yaw + 1))
    objects = (dataclasses.replace(first, segments=stays), *others)
    return dataclasses.replace(scene, objects=objects)


def moving_pose(frames: int, person: int = 0, pace: float = 1.0) -> BodyPose:
    """Angles that swing, of another rhythm in each joint, on a curved way."""
    model = open_body()
    pose = zero_pose(frames, model)
    time = pace * torch.arange(frames) / FPS
    rhythm = 1 + torch.arange(63) % 5
    body = 0.25 * torch.sin(rhythm * time[:, None] + torch.arange(63))
    hand = 0.1 * torch.sin(2 * time[:, None] + torch.arange(45))
    root = torch.stack([0.1 * time.sin(), 0.8 * time + person, 0.05 * time.cos()], -1)
    place = torch.stack([0.8 * time.sin() + person, -0.55 + 0 * time, -3 - 0.5 * time], -1)
    betas = torch.zeros_like(pose.betas)
    betas[:, 0] = 0.5 - person
    return dataclasses.replace(
        pose, betas=betas, body_pose=body, global_orient=root, transl=place,
        extra={"left_hand_pose": hand},
    )  # fmt: skip


def bodies_of(pose: BodyPose, space: str = "world") -> Bodies:
    """The open body in a pose, every second frame of a video, one person."""
    model = open_body()
    verts, joints = model.posed(pose)
    frame = 2 * torch.arange(len(verts)) + 4
    person = torch.zeros(len(verts), dtype=torch.long)
    return Bodies(verts, model.faces, joints, model.joint_names, frame, person, FPS, space, pose)


def two_people(frames: int = 12) -> Bodies:
    """The second comes later, leaves for two seconds, and comes back."""
    first, second = bodies_of(moving_pose(frames)), bodies_of(moving_pose(frames, 1))
    late = second.frame + 10 + 30 * (torch.arange(frames) >= frames // 2)
    pose = first.pose
    names = ("betas", "global_orient", "body_pose", "transl")
    both = {n: torch.cat([getattr(pose, n), getattr(second.pose, n)]) for n in names}
    hands = torch.cat([b.extra["left_hand_pose"] for b in (pose, second.pose)])
    return dataclasses.replace(
        first,
        verts=torch.cat([first.verts, second.verts]),
        joints=torch.cat([first.joints, second.joints]),
        frame=torch.cat([first.frame, late]),
        person=torch.arange(2).repeat_interleave(frames),
        pose=dataclasses.replace(pose, **both, extra={"left_hand_pose": hands}),
    )


def write_out(out: Path, scene: Scene, bodies: Bodies | None = None) -> Path:
    """The files of a result that exporters read."""
    write_scene(scene, out / "scene.json")
    if bodies is not None:
        write_bodies(bodies, out / "bodies.npz")
    return out


def similar(bodies: Bodies, size: float) -> Bodies:
    """The same people seen in other axes and grown about the new origin, without parameters."""
    c, s = math.cos(0.4), math.sin(0.4)
    turn = torch.tensor([[1.0, 0, 0], [0, c, -s], [0, s, c]]) @ torch.diag(
        torch.tensor([1.0, -1, -1])
    )
    verts, joints = (size * x @ turn.mT for x in (bodies.verts, bodies.joints))
    return dataclasses.replace(bodies, verts=verts, joints=joints, pose=None)
