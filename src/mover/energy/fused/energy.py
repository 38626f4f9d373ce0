"""Eq. 1 as a run uses it: the fused kernel for the terms that it has, torch for the rest."""

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from mover.core.observe import Energy
from mover.core.types import Camera, Layout, Objects
from mover.energy.config import SceneConfig
from mover.energy.fused.launch import FUSED, FusedEnergy, fused_cost, kernel_of, real_parts
from mover.energy.objective import (
    SCENE_TERMS,
    HumanCues,
    ImageCues,
    Rows,
    SceneEvidence,
    active_config,
    energy_of_terms,
)

EnergyOf = Callable[..., Energy]
"""Eq. 1 of a layout, and of the camera's rotation (3, 3) if it is another."""


def energy_function(
    objects: Objects, camera: Camera, image: ImageCues, humans: HumanCues, config: SceneConfig
) -> EnergyOf:
    """Eq. 1 as a function of the layout."""
    return energy_of_rows(objects, camera, image, humans, config)(None)


def energy_of_rows(
    objects: Objects, camera: Camera, image: ImageCues, humans: HumanCues, config: SceneConfig
) -> Callable[[Rows | None], EnergyOf]:
    """The same for some starts of some objects, by their numbers; None: for all.

    Rows count through (starts x objects); the layout has one row for each.
    """
    known = SceneEvidence(objects, camera, image, humans)
    config = active_config(config, known)
    kernel = fused_energy(known, config)
    left = [t for t in SCENE_TERMS if kernel is None or not t.fused]
    rest = [t for t in left if getattr(config.weights, t.name)]
    seen = known.bare() if all(t.bare for t in rest) else known

    def of(rows: Rows | None) -> EnergyOf:
        few = seen if rows is None or not rest else seen.some(rows)

        def energy(layout: Layout, R_cam_world: Tensor | None = None) -> Energy:
            here = few
            if R_cam_world is not None:
                here = replace(few, camera=replace(camera, R_cam_world=R_cam_world))
            if kernel is None:
                return energy_of_terms(rest, layout, here, config)
            whole, parts = fused_cost(kernel, layout, rows, R_cam_world)
            each = zip(FUSED, parts.unbind(-1), strict=True)
            found = Energy({k: x for k, x in each if getattr(config.weights, k)}, whole)
            if not rest:
                return found
            others = energy_of_terms(rest, layout, here, config)
            return Energy({**found.parts, **others.parts}, found.per_item + others.per_item)

        return energy

    return of


def fused_energy(known: SceneEvidence, config: SceneConfig) -> FusedEnergy | None:
    """The kernel with all that it needs to know, for active weights; None where it cannot help.

    It can on a CPU in single precision, for the robust form and closed meshes.
    """
    if config.form != "robust" or not _plain(known):
        return None
    touches = known.humans.touches
    once = touches is None or len(touches.object_of.unique()) == len(touches.object_of)
    if not once or not _closed(known.objects):
        return None
    return kernel_of(known, config)


def _plain(known: SceneEvidence) -> bool:
    """Whether all is constant, in single precision on a CPU, and seen by pinholes."""
    objects, camera, image, humans = known.objects, known.camera, known.image, known.humans
    tensors = [objects.verts, objects.samples, camera.K, camera.R_cam_world]
    tensors += [image.boxes, image.views.K, image.masks, image.trust]
    some = ((humans.depth, "near far"), (humans.space and humans.space.volume, "values"),
            (humans.touches, "points weight heading"))  # fmt: skip
    tensors += [getattr(x, n) for x, names in some if x is not None for n in names.split()]
    here = all(x.dtype == torch.float32 and x.device.type == "cpu" for x in tensors)
    if not here or any(x.requires_grad for x in tensors) or not len(objects.ids):
        return False
    K = torch.cat([camera.K[None], image.views.K])  # without skew; nothing is mirrored
    off = torch.stack([K[:, 0, 1], K[:, 1, 0], K[:, 2, 0], K[:, 2, 1], K[:, 2, 2] - 1])
    pinhole = not bool(off.any()) and bool((K[:, [0, 1], [0, 1]] > 0).all())
    return pinhole and float(torch.linalg.det(camera.R_cam_world)) > 0


def _closed(objects: Objects) -> bool:
    """Whether each edge lies between two faces of like direction (`topology.edges_of`)."""
    _, faces, edges = real_parts(objects)
    if not bool((2 * edges.sum(-1) == 3 * faces.sum(-1)).all()) or not bool(faces.any(-1).all()):
        return False
    row, _ = torch.nonzero(edges, as_tuple=True)
    v0, v1, one, two = objects.edges[edges].unbind(-1)
    runs = torch.ones_like(v0, dtype=torch.bool)
    for number, tail, head in ((one, v0, v1), (two, v1, v0)):  # each face along its edge
        face = objects.faces[row, number]
        runs &= ((face == tail[:, None]) & (face.roll(-1, -1) == head[:, None])).any(-1)
    return bool(runs.all())
