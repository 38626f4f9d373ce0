"""2D joints that OpenPose would see of the people of a known room."""

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor

from mover.bodies.keypoints import LAYOUTS, keypoints_of
from mover.bodies.skinning import open_body
from mover.core.types import Bodies, Camera, Keypoints
from mover.geometry.camera import project

LAYOUT = "openpose25"
LEGS = ("knee", "ankle", "toe", "heel")
NOISE = 3.0  # [px], standard deviation, of an image 960 wide
MISSING = 0.1  # share of the joints


def joints_seen(
    bodies: Bodies, camera: Camera, seated: Bool[Tensor, " bodies"], rng: np.random.Generator
) -> Keypoints:
    """Joints with noise, some missing, none outside of the image, and no legs of who sits.

    The true people are in the axes of the true camera.
    """
    assert bodies.joints is not None, "the open body has joints"
    points = keypoints_of(open_body(), bodies.verts, bodies.joints, LAYOUT)
    pixels = project(points, camera.K).double().numpy()
    seen = rng.uniform(size=pixels.shape[:2]) >= MISSING
    pixels = pixels + NOISE * rng.normal(size=pixels.shape)
    seen &= ((pixels >= 0) & (pixels < [camera.width, camera.height])).all(-1)
    legs = np.array([any(part in name for part in LEGS) for name in LAYOUTS[LAYOUT]])
    seen &= ~(legs & seated.numpy()[:, None])
    sure = np.where(seen, rng.uniform(0.5, 1.0, seen.shape), 0.0)
    return Keypoints(
        torch.from_numpy(pixels * seen[..., None]).float(), torch.from_numpy(sure).float(), LAYOUT,
        bodies.frame, bodies.person, bodies.fps,
    )  # fmt: skip
