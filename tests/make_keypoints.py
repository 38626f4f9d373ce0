"""2D joints of people whose truth is known."""

from dataclasses import replace

import numpy as np
import torch

from mover.bodies.keypoints import LAYOUTS, keypoints_of, spots_of
from mover.bodies.skeleton import BODY
from mover.bodies.skinning import SkinnedBody, open_body, zero_pose
from mover.core.types import Bodies, BodyPose, Camera, Keypoints
from mover.geometry.camera import project, tilted
from mover.geometry.rotations import rot_y

WIDTH, HEIGHT = 960, 540
K = torch.tensor([[760.0, 0, 470], [0, 770, 280], [0, 0, 1]])
CAMERA = Camera(K, tilted(torch.tensor(-0.15), torch.tensor(0.03)), WIDTH, HEIGHT)


def walker(frames=12, fps=5.0, yaw=0.6, model=None, tall=0.8) -> tuple[BodyPose, torch.Tensor]:
    """Somebody who walks across the room with swinging limbs: pose in camera axes, and frames."""
    from scipy.spatial.transform import Rotation

    t = torch.arange(frames) / fps
    rest = zero_pose(frames, model or open_body())
    angles = torch.zeros(frames, 21, 3)
    swing = 0.45 * torch.sin(5.5 * t)
    for side, sign in (("left", 1.0), ("right", -1.0)):
        at = {n: BODY.index(f"{side}_{n}") - 1 for n in ("hip", "knee", "shoulder", "elbow")}
        angles[:, at["hip"], 0] = -0.15 - sign * swing
        angles[:, at["knee"], 0] = 0.5 + 0.3 * sign * swing
        angles[:, at["shoulder"], 2] = -sign * 1.15
        angles[:, at["shoulder"], 1] = sign * 0.5 * swing
        angles[:, at["elbow"], 1] = -sign * 0.5
    way = rot_y(torch.tensor(yaw))
    root = (CAMERA.R_cam_world @ way).expand(frames, 3, 3)
    vector = torch.from_numpy(Rotation.from_matrix(root.numpy()).as_rotvec()).float()
    start = torch.tensor([-0.3, -0.55, -4.0])
    path = start + 0.9 * (t - t.mean())[:, None] * (way @ torch.tensor([0, 0, 1.0]))
    betas = rest.betas.clone()
    betas[:, 0] = tall
    pose = BodyPose(
        rest.model, "neutral", betas, vector, angles.reshape(frames, 63),
        path @ CAMERA.R_cam_world.mT, {},
    )  # fmt: skip
    return pose, torch.arange(frames)


def as_bodies(pose: BodyPose, frame: torch.Tensor, fps: float | None = 5.0, person=0) -> Bodies:
    model = open_body()
    verts, joints = model.posed(pose)
    who = torch.full_like(frame, person)
    names = model.joint_names
    return Bodies(verts, model.faces, joints, names, frame, who, fps, "camera", pose)


def seen(bodies: Bodies, layout="openpose25", noise=0.0, missing=0.0, seed=0) -> Keypoints:
    """What a detector would say."""
    rng = np.random.default_rng(seed)
    points = keypoints_of(open_body(), bodies.verts, bodies.joints, layout)
    pixels = project(points, CAMERA.K)
    pixels = pixels + torch.from_numpy(noise * rng.normal(size=pixels.shape)).float()
    there = torch.from_numpy(rng.uniform(size=pixels.shape[:2]) >= missing)
    there = there & spots_of(open_body(), layout).there
    shown = torch.where(there[..., None], pixels, torch.zeros_like(pixels))
    return Keypoints(shown, there.float(), layout, bodies.frame, bodies.person, bodies.fps)


def leg_columns(layout="openpose25") -> list[int]:
    legs = ("knee", "ankle", "toe", "heel")
    return [k for k, n in enumerate(LAYOUTS[layout]) if any(part in n for part in legs)]


def rest_pose(bodies: int, model: SkinnedBody) -> BodyPose:
    """So many people of the mean shape (ten numbers) in the zero pose, `transl` zero."""
    if model.pose_dirs is None:
        return zero_pose(bodies, model)
    zero = zero_pose(bodies, model)
    return replace(zero, gender=model.gender, betas=zero.betas[:, :10].clone())


def random_pose(model, bodies=2, seed=0, size=0.4):
    """People in random poses, shapes and places, with all angles that the model has."""
    generator = torch.Generator().manual_seed(seed)

    def some(*shape, size=size):
        return size * torch.randn(*shape, generator=generator)

    zero = rest_pose(bodies, model)
    extra = {}
    if model.name != "smpl":
        extra = {f"{side}_hand_pose": some(bodies, 45) for side in ("left", "right")}
    if model.name == "smplx":
        extra |= {name: some(bodies, 3) for name in ("jaw_pose", "leye_pose", "reye_pose")}
        extra["expression"] = some(bodies, 10, size=1.0)
    return replace(
        zero, betas=some(*zero.betas.shape, size=1.0), global_orient=some(bodies, 3, size=1.0),
        body_pose=some(*zero.body_pose.shape), transl=some(bodies, 3, size=1.0), extra=extra,
    )  # fmt: skip


def keypoints_at(frame, fps, points=None):
    """Keypoints of one person at some moments."""
    count = len(frame)
    points = torch.zeros(count, 17, 2) if points is None else points
    person = torch.zeros(count, dtype=torch.long)
    return Keypoints(points, torch.ones(count, 17), "coco17", frame, person, fps)
