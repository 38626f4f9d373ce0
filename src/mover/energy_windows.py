"""Eq. 1 as in `paper` and `release` with the windows drawn and priced in one go."""

from collections.abc import Callable
from dataclasses import replace

import torch
from torch import Tensor

from .energy import HumanCues, ImageCues, SceneConfig, SceneWeights, heard, scene_energy
from .geometry.placement import place_in
from .geometry.raster import Topology
from .geometry.raster_engine import engine
from .geometry.windows_warp import Evidence, Rules, Windows, prices, windows
from .minimize import Energy
from .terms.depth import CLAMP, eroded
from .terms.factors import factors
from .terms.silhouette import RING, outline_root
from .types import Camera, Layout, Objects

DRAWN = ("silhouette", "edge", "depth", "free_space")  # in the order of the kernel's prices


def window_pricing(
    objects: Objects, camera: Camera, image: ImageCues, humans: HumanCues, config: SceneConfig
) -> Callable[[Layout], Energy] | None:
    """Eq. 1 as a function of the layout; None where the kernel cannot help.

    It can on a CPU in single precision, for the forms `paper` and `release`. The values are those
    of `energy.scene_energy`.
    """
    w = heard(config.weights, image, humans)
    if config.form == "robust" or not any(getattr(w, name) for name in DRAWN):
        return None
    if engine() != "warp" or not _plain(objects, camera, image, humans):
        return None
    held = _windows(objects, image, humans, config, w)
    rest = replace(config, weights=replace(config.weights, **dict.fromkeys(DRAWN, 0.0)))
    many = factors(objects, humans.touches if w.contact else None, config.form)
    area = torch.ones_like(image.trust) if humans.depth is None else humans.depth.area
    factor = torch.stack(
        [image.trust, torch.full_like(area, 0.5), many.depth * area, area], -1
    ) * torch.tensor([getattr(w, name) for name in DRAWN])

    def energy(layout: Layout) -> Energy:
        others = scene_energy(layout, objects, camera, image, humans, rest).parts
        drawn = prices(place_in(objects.verts, layout, camera.R_cam_world), held) * factor
        each = {**dict(zip(DRAWN, drawn.unbind(-1), strict=True)), **others}
        return Energy({name: each[name] for name in vars(w) if getattr(w, name)})

    return energy


def _plain(objects: Objects, camera: Camera, image: ImageCues, humans: HumanCues) -> bool:
    """Whether all is constant, and in single precision on a CPU."""
    tensors = [objects.verts, camera.R_cam_world, image.views.K, image.masks, image.trust]
    if humans.depth is not None:
        tensors += [humans.depth.near, humans.depth.far, humans.depth.free, humans.depth.area]
    here = all(x.dtype == torch.float32 and x.device.type == "cpu" for x in tensors)
    return here and not any(x.requires_grad for x in tensors) and objects.verts.numel() > 0


def _windows(
    objects: Objects, image: ImageCues, humans: HumanCues, config: SceneConfig, w: SceneWeights
) -> Windows:
    """What the windows know, as the kernel reads it."""
    root = None
    if w.edge:
        root = outline_root(image.masks) if image.outline is None else image.outline
    near = far = free = codes = None
    if w.depth or w.free_space:
        assert humans.depth is not None
        near, far, free = humans.depth.near, humans.depth.far, humans.depth.free
        codes = _codes(image, humans, config, w)
    release = config.form == "release"
    shrink, limit = ((1, 2), CLAMP) if release else ((0, 2), float("inf"))
    rules = Rules(RING // 2, release, shrink, (limit, CLAMP))
    return windows(
        Topology(objects.faces, objects.edges),
        image.views,
        Evidence(image.masks, image.keep, root, near, far, free, codes),
        rules,
    )


def _codes(image: ImageCues, humans: HumanCues, config: SceneConfig, w: SceneWeights) -> Tensor:
    """1 where depths are bounded inside the mask, 2 where space is free outside."""
    depth = humans.depth
    assert depth is not None
    inside, outside = image.masks > 0.5, image.masks <= 0.5
    if config.form == "release":
        inside = eroded(inside, 1)
    codes = torch.zeros_like(inside, dtype=torch.uint8)
    if w.depth:
        codes[inside & (depth.near.isfinite() | depth.far.isfinite())] = 1
    if w.free_space:
        codes[eroded(outside, 2) & depth.free.isfinite()] = 2
    return codes
