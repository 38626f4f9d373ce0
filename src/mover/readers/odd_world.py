"""Whether a scene lies in another world than it says: mirrored, upside down, or with z up."""

import torch
from jaxtyping import Float
from torch import Tensor

from ..geometry.boxes import iou2d
from ..geometry.camera import NEAR, project, to_camera
from ..geometry.placement import place_piece
from ..types import Camera, Detection, Scene

POOR, BETTER = 0.2, 0.4  # mean overlap of boxes: such a scene is odd if another world fits so well
OTHERS: dict[str, Float[Tensor, "3 3"]] = {
    "mirrored (left and right are swapped)": torch.diag(torch.tensor([-1.0, 1.0, 1.0])),
    "upside down (+y is down)": torch.diag(torch.tensor([1.0, -1.0, -1.0])),
    "lying on its side (+z is up)": torch.tensor([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
    "behind the camera (+z is forward)": torch.diag(torch.tensor([-1.0, 1.0, -1.0])),
}


def overlap(scene: Scene, detections: tuple[Detection, ...]) -> float | None:
    """Mean overlap of the objects' outlines and their detections; None without any pair."""
    return _overlap(scene, detections, torch.eye(3))


def odd_world(scene: Scene, detections: tuple[Detection, ...]) -> str | None:
    """What is wrong with the axes of a scene whose objects miss their detections; None: nothing.

    Args:
        scene: The initial scene.
        detections: What the image shows.
    """
    own = overlap(scene, detections)
    if own is None or own >= POOR:
        return None
    found = {name: _overlap(scene, detections, turn) or 0.0 for name, turn in OTHERS.items()}
    name = max(found, key=lambda key: found[key])
    if found[name] < BETTER:
        return None
    shares = f"mean overlap with the detections {own:.2f}, otherwise {found[name]:.2f}"
    return f"the scene seems {name}: {shares}"


def _overlap(
    scene: Scene, detections: tuple[Detection, ...], turn: Float[Tensor, "3 3"]
) -> float | None:
    """Mean overlap with the world turned or mirrored first."""
    boxes = {d.id: d.box for d in detections}
    values = [
        _share(place_piece(p).verts @ turn.mT, scene.camera, boxes[p.annotation])
        for p in scene.pieces
        if p.annotation is not None and p.annotation in boxes
    ]
    return sum(values) / len(values) if values else None


def _share(verts: Float[Tensor, "verts 3"], camera: Camera, box: Float[Tensor, "4"]) -> float:
    """Overlap of the outline of points in the world with a box."""
    cam = to_camera(verts, camera.R_cam_world)
    cam = cam[cam[:, 2] > NEAR]
    if not len(cam):
        return 0.0
    seen = project(cam, camera.K)
    size = torch.tensor([camera.width, camera.height]).to(seen)
    ours = torch.cat([seen.amin(0).clamp_min(0), torch.minimum(seen.amax(0), size)])
    return float(iou2d(ours, box))
