"""Eq. 1 in its robust form as one kernel: the same numbers as `energy.scene_energy`, sooner.

Lines of walls are not in the kernel: only a few pieces stand along one, in the last descents.
"""

from collections.abc import Callable
from dataclasses import replace

import torch
from jaxtyping import Int
from torch import Tensor

from .energy import HumanCues, ImageCues, SceneConfig, SceneWeights, heard, scene_energy
from .energy_pack import TERMS, pricer_of, real_parts
from .energy_windows import window_pricing
from .geometry.priced_warp import price
from .geometry.raster_engine import engine
from .minimize import Energy
from .terms.contact_trees import trees_of
from .terms.silhouette import outline_root
from .terms.wall import Walls, some_walls, wall_term
from .types import Camera, Layout, Objects

Rows = Int[Tensor, " rows"]
PricedRows = Callable[[Layout, Rows | None], Energy]


def pricing(
    objects: Objects, camera: Camera, image: ImageCues, humans: HumanCues, config: SceneConfig
) -> Callable[[Layout], Energy]:
    """Eq. 1 as a function of the layout, by one kernel where that can do it.

    It can on a CPU in single precision, for the robust form and closed meshes.
    """
    priced = pricing_rows(objects, camera, image, humans, config)
    if priced is not None:
        return lambda layout: priced(layout, None)
    if config.weights.edge and image.outline is None:
        image = replace(image, outline=outline_root(image.masks))
    return window_pricing(objects, camera, image, humans, config) or (
        lambda layout: scene_energy(layout, objects, camera, image, humans, config)
    )


def pricing_rows(
    objects: Objects, camera: Camera, image: ImageCues, humans: HumanCues, config: SceneConfig
) -> PricedRows | None:
    """The same for some starts of some objects, by their numbers; None without the kernel.

    Rows count through (starts x objects); the layout has one row for each.
    """
    weights = heard(config.weights, image, humans)
    if humans.touches is not None and humans.trees is None and weights.contact:
        humans = replace(humans, trees=trees_of(objects, humans.touches))
    can = _knows(weights, config.form, humans) and _plain(objects, camera, image, humans)
    if not can or not _closed(objects):
        return None
    pricer = pricer_of(objects, camera, image, humans, replace(config, weights=weights))
    names = [(k, name) for k, name in enumerate(TERMS) if getattr(weights, name)]

    def energy(layout: Layout, rows: Rows | None) -> Energy:
        whole, parts = price(pricer, layout.t_world_object, layout.yaw, layout.log_scale, rows)
        each = parts.unbind(-1)
        return Energy({name: each[k] for k, name in names}, whole)

    if image.walls is None or not weights.wall:
        return energy
    return _with_walls(energy, objects, image.walls, weights.wall)


def _with_walls(kernel: PricedRows, objects: Objects, walls: Walls, weight: float) -> PricedRows:
    """The energy of the kernel and the price of standing off lines."""
    n = len(objects.ids)

    def energy(layout: Layout, rows: Rows | None) -> Energy:
        known = kernel(layout, rows)
        index = torch.arange(n) if rows is None else rows % n
        wall = weight * wall_term(layout, objects.size[index], some_walls(walls, index))
        return Energy({**known.parts, "wall": wall}, known.per_item + wall)

    return energy


def never_asks(objects: Objects) -> bool:
    """Whether Eq. 1 of such objects asks the host for nothing, so that a GPU can replay it.

    That is so where Warp draws: torch alone draws by lists whose lengths the host must know.
    """
    return engine() == "warp" and objects.verts.dtype == torch.float32


def _knows(weights: SceneWeights, form: str, humans: HumanCues) -> bool:
    """Whether the kernel has all terms that have a weight."""
    others = weights.edge or weights.offscreen or weights.free_space
    if engine() != "warp" or form != "robust" or others:
        return False
    touches = humans.touches
    if touches is not None and len(touches.object_of.unique()) != len(touches.object_of):
        return False
    return humans.trees is not None or not weights.contact


def _plain(objects: Objects, camera: Camera, image: ImageCues, humans: HumanCues) -> bool:
    """Whether all is constant, in single precision on a CPU, and seen by pinholes."""
    tensors = [objects.verts, objects.samples, camera.K, camera.R_cam_world]
    tensors += [image.boxes, image.views.K, image.masks, image.trust]
    if humans.depth is not None:
        tensors += [humans.depth.near, humans.depth.far]
    if humans.space is not None:
        tensors += [humans.space.volume.values]
    if humans.touches is not None:
        tensors += [humans.touches.points, humans.touches.weight, humans.touches.heading]
    here = all(x.dtype == torch.float32 and x.device.type == "cpu" for x in tensors)
    if not here or any(x.requires_grad for x in tensors) or not len(objects.ids):
        return False
    turned = float(torch.linalg.det(camera.R_cam_world)) > 0
    return turned and _pinhole(camera.K[None]) and _pinhole(image.views.K)


def _pinhole(K: Tensor) -> bool:
    """Whether there is no skew, and nothing is mirrored."""
    zero = torch.cat([K[:, 0, 1], K[:, 1, 0], K[:, 2, 0], K[:, 2, 1], K[:, 2, 2] - 1])
    return not bool(zero.any()) and bool((K[:, 0, 0] > 0).all() and (K[:, 1, 1] > 0).all())


def _closed(objects: Objects) -> bool:
    """Whether each edge lies between two faces that turn alike, as `topology.edges_of` has it."""
    _, faces, edges = real_parts(objects)
    if not bool((2 * edges.sum(-1) == 3 * faces.sum(-1)).all()) or not bool(faces.any(-1).all()):
        return False
    row, _ = torch.nonzero(edges, as_tuple=True)
    v0, v1, one, two = objects.edges[edges].unbind(-1)
    return bool(
        (_runs(objects.faces[row, one], v0, v1) & _runs(objects.faces[row, two], v1, v0)).all()
    )


def _runs(face: Tensor, tail: Tensor, head: Tensor) -> Tensor:
    """Whether a face runs from one vertex to the other."""
    after = face.roll(-1, -1)
    return ((face == tail[:, None]) & (after == head[:, None])).any(-1)
