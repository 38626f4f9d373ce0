"""What is drawn and what comes of it, and how the kernels that draw are run.

A launch is a plain loop that lets go of Python's lock. A thread draws a few items at a time, one
after the other in the same working memory, and threads share nothing: the result does not depend on
their number.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from threading import local
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.core.records import record
from mover.geometry.warp_start import filled, kernels, launch, mapped, share, started, threads


@record
class Crops:
    """Pinhole windows of one size, one for each item."""

    K: Float[Tensor, "items 3 3"]  #: intrinsics of each window [px of the window]; no skew
    height: int  #: rows of each window [px]
    width: int  #: columns of each window [px]


@record
class Topology:
    """Padded triangles of closed meshes, counter-clockwise seen from outside."""

    faces: Int[Tensor, "items faces 3"]  #: vertices of each triangle; padding is (0, 0, 0)
    edges: Int[Tensor, "items edges 4"]
    """Two vertices and the two faces beside them; padding is zeros."""


@record
class Depths:
    """First and last surface on the ray of each pixel centre."""

    nearest: Float[Tensor, "*starts items h w"]
    """Camera z of the front-most surface [m]; 0 where not covered."""
    farthest: Float[Tensor, "*starts items h w"]
    """Camera z of the last surface [m]; 0 where not covered."""
    covered: Bool[Tensor, "*starts items h w"]
    """Whether the ray of the pixel centre meets both a front and a back."""


@record
class Layers:
    """Where rays enter and first leave closed bodies; not differentiable."""

    front: Float[Tensor, "items h w"]
    """Camera z of the nearest front-facing surface [m]; inf where there is none."""
    exit: Float[Tensor, "items h w"]
    """Camera z of the nearest back-facing surface [m]; -inf where there is none."""


@dataclass(frozen=True)
class Maps:
    """What was drawn (items, h, w); empty where it was not asked for."""

    image: Tensor
    nearest: Tensor
    farthest: Tensor
    covered: Tensor


@dataclass(frozen=True)
class Cuts:
    """Where the outlines of some items are cut between pixel centres."""

    group: range  #: the items
    table: Tensor  #: 4 numbers for each cut: see `kernels.scene`
    targets: Tensor  #: pixel that each cut moves; negative where it has no gradient


@dataclass(frozen=True)
class Trace:
    """What the gradients need to know of a drawing."""

    scene: Any  #: the items as the kernels read them: `kernels.scene.Items`
    near_face: Tensor  #: face that is seen first (items, h, w); unset where not covered
    far_face: Tensor  #: face that is seen last (items, h, w); unset where not covered
    cuts: tuple[Cuts, ...]


BORDER = 1  # [px], so that an outline just outside the window still moves the window's pixels
NOWHERE, FRONT, BEHIND = 0, 1, 2  # where backs are drawn, as in `kernels.items`
GROUPS = 3  # of items for each thread, so that none waits long for the last
KEPT = 1 << 22  # pixels up to which a thread keeps its working memory (72 bytes each)
CPU = torch.device("cpu")
_own = local()


def look(
    verts: Tensor, shape: Topology, views: Crops, silhouette: bool, depth: bool
) -> tuple[Maps, Trace]:
    """Silhouettes and depths, where they are asked for, of items in camera axes."""
    size = (len(verts), views.height, views.width)
    image, nearest, farthest = (
        verts.new_zeros(size if wanted else 0) for wanted in (silhouette, depth, depth)
    )
    maps = Maps(image, nearest, farthest, torch.zeros_like(nearest, dtype=torch.bool))
    near, far = (torch.empty_like(nearest, dtype=torch.int32) for _ in range(2))
    scene = _scene(verts, shape, views, BORDER)
    cuts = _draw(scene, _maps(maps, near, far), BEHIND if depth else NOWHERE)
    return maps, Trace(scene, near, far, cuts)


def first_hit(
    verts: Tensor, shape: Topology, views: Crops, depth: Tensor, face: Tensor, backs: int
) -> None:
    """Write the nearest surface and its face where there is one."""
    none = verts.new_zeros(0)
    packed = _maps(Maps(none, depth, none, none.bool()), face, face)
    _draw(_scene(verts, shape, views, 0), packed, backs)


def pull(maps: Maps, trace: Trace, grads: dict[str, Tensor | None], verts: Tensor) -> None:
    """Add the gradients of `image`, `nearest` and `farthest` to those of the vertices."""
    packed = _maps(maps, trace.near_face, trace.far_face)
    known = {name: g.contiguous().view(-1) for name, g in grads.items() if g is not None}
    known |= {f"has_{name}": name in known for name in grads}

    def pull_group(k: int) -> None:
        cuts, flat = trace.cuts[k], verts.view(-1, 3)
        given = _packed("Pull", cuts=cuts.table, targets=cuts.targets, verts=flat, **known)
        inputs = [trace.scene, packed, given, cuts.group.start, cuts.group.stop]
        launch(kernels("items", "cpu").pull_items, 1, inputs, CPU)

    share(pull_group, len(trace.cuts))


def _draw(scene: Any, maps: Any, backs: int) -> tuple[Cuts, ...]:  # noqa: ANN401
    """Fill the maps; the cuts of the outlines, by groups of items."""
    count = len(scene.verts) // scene.n_verts
    size = max(4, count // (GROUPS * threads()))
    groups = [range(k, min(k + size, count)) for k in range(0, count, size)]

    def draw_group(group: range) -> Cuts:
        scratch = _own_scratch(scene, len(group) if maps.silhouette else 0)
        inputs = [scene, scratch, maps, backs, group.start, group.stop]
        launch(kernels("items", "cpu").look_items, 1, inputs, CPU)
        number = int(started().to_torch(scratch.count)[1])
        listed = (started().to_torch(x)[:number].clone() for x in (scratch.cuts, scratch.targets))
        return Cuts(group, *listed)

    return tuple(mapped(draw_group, groups))


def _own_scratch(scene: Any, listed: int) -> Any:  # noqa: ANN401
    """The working memory of this thread, which kernels leave clean, for the cuts of some items."""
    grid = scene.height * scene.width
    room = [scene.n_verts, scene.n_faces, scene.n_edges, grid, 2 * listed * grid]
    if any(have < need for have, need in zip(getattr(_own, "room", [0]), room, strict=False)):
        _own.room, _own.scratch = room, scratch_of(room)
    scratch = _own.scratch
    if grid > KEPT:
        vars(_own).clear()
    started().to_torch(scratch.count).zero_()
    return scratch


def scratch_of(room: Sequence[int]) -> Any:  # noqa: ANN401
    """Working memory for so many vertices, faces, edges, pixels and cuts, zero where need be."""
    verts, faces, edges, pixels, cuts = room
    count = torch.zeros(2, dtype=torch.int32)

    def zeros(size: int) -> Tensor:
        """Zeros that take memory only where they are written."""
        return torch.from_numpy(np.zeros(size, dtype=np.int64))

    return _packed(
        "Scratch",
        screen=torch.empty(verts, 3),
        front=torch.empty(faces, dtype=torch.int8),
        near=zeros(pixels),
        far=zeros(pixels),
        pairs=zeros(2 * pixels),
        queue=count.new_empty(max(edges, faces)),
        cuts=count.new_empty(cuts, 4),
        targets=count.new_full((cuts,), -1),
        count=count,
    )


def _scene(verts: Tensor, shape: Topology, views: Crops, border: int) -> Any:  # noqa: ANN401
    """The items as the kernels read them; `border` [px] lies around the windows."""
    edges = shape.edges[:, : None if shape.faces.shape[1] else 0]
    faces, edges = (t.to(verts.device, torch.int64).contiguous() for t in (shape.faces, edges))
    return _packed(
        "Items",
        verts=verts.detach().contiguous().view(-1, 3),
        window=windows(views.K.to(verts), border),
        faces=faces.view(-1, 3),
        edges=edges.view(-1, 4),
        views=len(views.K),
        shapes=len(faces),
        n_verts=verts.shape[1],
        n_faces=faces.shape[1],
        n_edges=edges.shape[1],
        height=views.height + 2 * border,
        width=views.width + 2 * border,
        border=border,
    )


def windows(K: Tensor, border: int) -> Tensor:
    """Focal lengths and principal points in windows with a border [px]."""
    return torch.stack([K[:, 0, 0], K[:, 1, 1], K[:, 0, 2] + border, K[:, 1, 2] + border], -1)


def _maps(maps: Maps, near_face: Tensor, far_face: Tensor) -> Any:  # noqa: ANN401
    """The maps and the faces that are seen in them."""
    faces = {"near_face": near_face.view(-1), "far_face": far_face.view(-1)}
    flat = {name: value.view(-1) for name, value in vars(maps).items()} | faces
    drawn, both = maps.image.numel() > 0, maps.covered.numel() > 0
    hits = not drawn and not both
    return _packed("MapArrays", **flat, silhouette=drawn, depth=both, hits=hits)


def _packed(name: str, **fields: Any) -> Any:  # noqa: ANN401
    """The struct of that name in `kernels.scene`, see `filled`."""
    from mover.geometry.kernels import scene

    return filled(getattr(scene, name), **fields)
