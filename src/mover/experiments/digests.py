"""Hashes of known rooms that are the same on every machine.

Numbers are counted in tenths of a millimetre (or of a milliradian) before they are hashed, so that
the last bits of another processor do not show. What the masks hold is not hashed: a pixel centre
may lie on an outline. Their number of pixels is kept instead and compared with `SLACK`.
"""

import hashlib
import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from torch import Tensor

from ..geometry.runs import decode
from ..rooms import KnownRoom
from ..types import Bodies, Capture, Masks, Scene

STEP = 1e-4  # [m], [rad]
SHIFT = 0.318  # of the counts: round figures lie far from where a count changes
SLACK = 1e-3  # share of the pixels of masks by which machines may differ


def truth_hash(room: KnownRoom) -> str:
    """Of the true scene, the true people, and what they do."""
    return _hash([*_scene(room.truth), list(room.actions), *_bodies(room.bodies)])


def capture_hash(capture: Capture) -> str:
    """Of what a method is given: scene, detections, people."""
    found = [[d.id, d.category, d.score] for d in capture.detections]
    boxes = [d.box for d in capture.detections]
    bodies = [] if capture.bodies is None else _bodies(capture.bodies)
    people = capture.people
    rows = [] if people is None else [people.frame.tolist(), people.person.tolist()]
    return _hash([*_scene(capture.scene), found, *boxes, *bodies, *rows])


def mask_pixels(capture: Capture) -> list[int]:
    """Pixels of all masks of objects, and of all masks of people."""
    objects = [_count(d.mask) for d in capture.detections if d.mask is not None]
    return [sum(objects), 0 if capture.people is None else _count(capture.people.masks)]


def differences(found: Mapping[str, Any], expected: Mapping[str, Any]) -> list[str]:
    """In which of `truth`, `capture` and `pixels` a room is another than it should be."""
    wrong = [name for name in ("truth", "capture") if found[name] != expected[name]]
    pixels = zip(found["pixels"], expected["pixels"], strict=True)
    return wrong + ["pixels"] * any(abs(a - b) > SLACK * max(a, b) for a, b in pixels)


def _scene(scene: Scene) -> list[Any]:
    camera = scene.camera
    parts: list[Any] = [camera.width, camera.height, camera.K, camera.R_cam_world, scene.ground]
    for piece in scene.pieces:
        parts += [piece.id, piece.category, piece.support, piece.annotation, piece.t_world_object,
                  piece.yaw, piece.scale, piece.mesh.verts, piece.mesh.faces]  # fmt: skip
    return parts


def _bodies(bodies: Bodies) -> list[Any]:
    assert bodies.pose is not None, "bodies of known rooms have parameters"
    pose = bodies.pose
    return [bodies.fps, bodies.frame, bodies.person, pose.betas, pose.global_orient,
            pose.body_pose, pose.transl]  # fmt: skip


def _count(masks: Masks) -> int:
    return sum(int(decode(masks, row).sum()) for row in range(len(masks.counts)))


def _hash(parts: Sequence[Any]) -> str:
    digest = hashlib.sha256()
    for part in parts:
        value: Any = part
        if isinstance(part, Tensor):
            value = part.detach().cpu().numpy()
        elif isinstance(part, float):
            value = np.array(part)
        if isinstance(value, np.ndarray):
            if value.dtype.kind == "f":
                value = np.floor(value.astype(np.float64) / STEP + SHIFT)
            digest.update(f"{value.shape}".encode())
            digest.update(np.ascontiguousarray(value.astype("<i8")).tobytes())
        else:
            digest.update(json.dumps(value).encode())
    return digest.hexdigest()[:16]
