"""What a real camera makes of a reference picture: not all lines are a room's, none is straight."""

import io
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from mover.core.types import Capture
from mover_bench.rooms.config import NoiseConfig

LENGTH = (0.03, 0.15)  # of the picture's width: longer side of what lies about
FLAT = (0.1, 0.6)  # its shorter side over the longer one
BLUR = 0.8  # [px]
QUALITY = 80  # of a JPEG


def worn_picture(capture: Capture, noise: NoiseConfig, rng: np.random.Generator) -> Capture:
    """The capture with things that lie about askew, a lens that bends lines, grain and JPEG."""
    if capture.reference is None or not (noise.things or noise.distortion or noise.grain):
        return capture
    picture = (255 * capture.reference.double().numpy()).round()
    picture = _littered(picture, noise.things, rng)
    picture = _bent(picture, capture.scene.camera.K, float(rng.normal(0, noise.distortion)))
    if noise.grain:
        picture = _compressed(picture, 255 * noise.grain, rng)
    return replace(capture, reference=torch.from_numpy(picture / 255).float())


def _littered(
    picture: NDArray[np.float64], count: int, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Rectangles of any direction and colour over the picture."""
    import cv2

    height, width = picture.shape[:2]
    for _ in range(count):
        middle = rng.uniform([0, 0], [width, height])
        angle, long = rng.uniform(0, np.pi), rng.uniform(*LENGTH) * width
        u = np.array([np.cos(angle), np.sin(angle)]) * long / 2
        v = np.array([-u[1], u[0]]) * rng.uniform(*FLAT)
        corners = np.array([middle - u - v, middle + u - v, middle + u + v, middle - u + v])
        colour = rng.uniform(40, 220, 3).tolist()
        cv2.fillConvexPoly(picture, corners.round().astype(np.int32), colour)
    return picture


def _bent(picture: NDArray[np.float64], K: Float[Tensor, "3 3"], k1: float) -> NDArray[np.float64]:
    """The picture under radial distortion that was not corrected."""
    import cv2

    if not k1:
        return picture
    lens, bend = K.double().numpy(), np.array([k1, 0.0, 0.0, 0.0])
    size = picture.shape[1], picture.shape[0]
    maps = cv2.initUndistortRectifyMap(lens, bend, np.eye(3), lens, size, cv2.CV_32FC1)
    bent = cv2.remap(picture, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(bent, np.float64)


def _compressed(
    picture: NDArray[np.float64], grain: float, rng: np.random.Generator
) -> NDArray[np.float64]:
    """The picture out of focus, with noise, from a JPEG."""
    import cv2
    from PIL import Image

    soft = cv2.GaussianBlur(picture, (0, 0), BLUR) + rng.normal(0, grain, picture.shape)
    file = io.BytesIO()
    Image.fromarray(soft.clip(0, 255).astype(np.uint8)).save(file, "jpeg", quality=QUALITY)
    return np.asarray(Image.open(file), np.float64)
