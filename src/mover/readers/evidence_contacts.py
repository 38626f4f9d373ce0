"""In how many frames somebody seems to touch each object: for `mover check`."""

from jaxtyping import Bool
from torch import Tensor

from ..bodies.parts import members, parts_of
from ..bodies.touch import touching
from ..bodies.world import in_world
from ..geometry.camera import project
from ..types import Capture
from .masks import decode

FEWEST = 5  # touching vertices inside a mask that make a frame with contact
UNSURE = 0.5  # chance from which on a vertex touches


def contact_frames(capture: Capture) -> tuple[int, ...]:
    """Frames in which touching skin (soles aside) is seen inside each object's mask.

    The first guess of the camera says where up is, and the lowest feet where the floor is.
    """
    pieces, bodies = capture.scene.pieces, capture.bodies
    if bodies is None:
        return (0,) * len(pieces)
    R = capture.scene.camera.R_cam_world
    parts = parts_of(bodies, R[:, 1])
    if capture.touch is not None:
        chance = capture.touch
    else:
        world = in_world(bodies, capture.scene.camera)
        floor = float(world.verts[..., 1].amin(1).quantile(0.05))
        chance = touching(world, parts, floor)
    chance = chance * ~members(parts, "left_sole", "right_sole")
    known = {d.id: d for d in capture.detections}
    found = [known.get(-1 if p.annotation is None else p.annotation) for p in pieces]
    masks = [None if d is None or d.mask is None else decode(d.mask, 0) for d in found]
    frames = [set[int]() for _ in pieces]
    for row in range(len(bodies.frame)):
        skin = bodies.verts[row][chance[row] > UNSURE]
        if len(skin) < FEWEST:
            continue
        pixels = project(skin, capture.scene.camera.K).long()
        for i, mask in enumerate(masks):
            if mask is not None and _inside(mask, pixels) >= FEWEST:
                frames[i].add(int(bodies.frame[row]))
    return tuple(len(f) for f in frames)


def _inside(mask: Bool[Tensor, "h w"], pixels: Tensor) -> int:
    x, y = pixels.unbind(-1)
    shown = (x >= 0) & (x < mask.shape[1]) & (y >= 0) & (y < mask.shape[0])
    return int(mask[y[shown], x[shown]].sum())
