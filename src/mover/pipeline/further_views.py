"""Further frames of a moving camera whose masks of the furniture count in the image terms."""

from dataclasses import replace

import torch

from mover.core.types import Camera
from mover.energy.objective import FurtherView, ImageCues
from mover.geometry.path import is_still, poses_at
from mover.pipeline.outcome import PeopleState, ReconstructionContext
from mover.stages.objects.find_image_cues import ImageInputs, evidence_at, find_image_cues
from mover.stages.objects.gather_given import believed_sides


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
        sides = believed_sides(cues.sides, torch.zeros_like(cues.trust))
        R, t = poses.R_reference_camera[best], poses.t_reference_camera[best]
        found.append(FurtherView(R, t, replace(cues, sides=sides)))
    return tuple(found)


def with_views(image: ImageCues, views: tuple[FurtherView, ...]) -> ImageCues:
    """The reference image's cues with those of further frames, whose sides are believed alike."""
    weight = torch.zeros_like(image.trust) if image.given is None else image.given.weight

    def alike(cues: ImageCues) -> ImageCues:
        return replace(cues, sides=believed_sides(cues.sides, weight, cues.beside))

    return replace(image, further=tuple(replace(v, image=alike(v.image)) for v in views))


def larger_views(views: tuple[FurtherView, ...], factor: float) -> tuple[FurtherView, ...]:
    """The views from cameras that are so many times as far away."""
    return tuple(replace(v, t_reference_camera=factor * v.t_reference_camera) for v in views)
