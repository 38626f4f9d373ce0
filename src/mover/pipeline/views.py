"""Further frames in which furniture is segmented, as views of the objects."""

import torch

from mover.core.types import Camera
from mover.geometry.path import is_still, poses_at
from mover.pipeline.outcome import PeopleState, ReconstructionContext
from mover.stages.camera.refine_camera import FurtherView
from mover.stages.objects.find_image_cues import ImageInputs, evidence_at, find_image_cues


def further_views(
    context: ReconstructionContext, people: PeopleState, camera: Camera
) -> tuple[FurtherView, ...]:
    """The frames from which the camera saw the objects from elsewhere, the farthest first."""
    capture, config = context.capture, context.config
    if is_still(people.path) or capture.furniture is None:
        return ()
    poses = poses_at(people.path, capture.furniture.frame.unique())
    chosen = [torch.zeros(3)]
    found: list[FurtherView] = []
    for _ in range(config.refine.views):
        away = torch.cdist(poses.t_reference_camera, torch.stack(chosen)).amin(1)
        best = int(away.argmax())
        if float(away[best]) < config.refine.apart:
            break
        chosen.append(poses.t_reference_camera[best])
        seen = evidence_at(capture, int(poses.frame[best]))
        unordered = torch.zeros(len(seen.boxes), len(seen.boxes), dtype=torch.bool)
        image = ImageInputs(camera, seen.boxes, seen.detected, seen.masks, seen.people, unordered)
        cues = context.run.stage(find_image_cues, image, config.image)
        R, t = poses.R_reference_camera[best], poses.t_reference_camera[best]
        found.append(FurtherView(R, t, cues))
    return tuple(found)
