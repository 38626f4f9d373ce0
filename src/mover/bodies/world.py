"""Bodies from the camera's axes into those of the world."""

import dataclasses

from ..geometry.camera import to_world
from ..types import Bodies, Camera


def in_world(bodies: Bodies, camera: Camera) -> Bodies:
    """Bodies from camera axes into the world (vertices and joints; parameters stay behind)."""
    verts, joints = bodies.verts, bodies.joints
    if bodies.space == "camera":
        R = camera.R_cam_world.to(verts)
        verts = to_world(verts, R)
        joints = None if joints is None else to_world(joints, R.to(joints))
    return dataclasses.replace(bodies, verts=verts, joints=joints, space="world", pose=None)
