"""Windows drawn and priced in one go on a CPU: a thread has one item after the other.

An evaluation gives the prices and how they change with the vertices. Items share nothing, so that
the result does not depend on the number of threads.
"""

from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, UInt8
from torch import Tensor
from torch.autograd.function import once_differentiable

from ..records import record
from .kernels.start import kernels, started
from .raster_engine import threads
from .raster_records import Topology, Views
from .raster_torch import BORDER
from .raster_warp import items_of
from .raster_warp_cpu import share
from .raster_warp_pack import array, desk_of, pack_scene, room_of
from .raster_warp_records import Items

PRICES = 4  # squares, ring, bounds, free space


@record
class Evidence:
    """What the windows of the objects know."""

    mask: Float[Tensor, "objects h w"]
    keep: Bool[Tensor, "objects h w"]
    """What counts in squares and ring."""
    ring: Float[Tensor, "objects h w"] | None
    """Weight of the ring at each pixel; None: it has no price."""
    near: Float[Tensor, "objects h w"] | None
    """Lower bound of the nearest surface inside the mask; None: depths have no price [m]."""
    far: Float[Tensor, "objects h w"] | None
    """Upper bound inside the mask [m]."""
    free: Float[Tensor, "objects h w"] | None
    """Lower bound outside the mask; None: there is none [m]."""
    rules: UInt8[Tensor, "objects h w"] | None
    """1 where `near` and `far` may hold, 2 where `free` may."""


@dataclass(frozen=True)
class Rules:
    """How the windows are priced."""

    reach: int = 0
    """Of the ring, to all sides [px]."""
    back: bool = False
    """The upper bound is that of the farthest surface, else of the nearest."""
    shrink: tuple[int, int] = (0, 0)
    """Steps by which what is drawn shrinks before bounds, and before free space, hold [px]."""
    limit: tuple[float, float] = (float("inf"), float("inf"))
    """Most that a pixel can be out of bounds, and out of free space [m]."""


@dataclass(frozen=True)
class Windows:
    """Evidence as the kernel reads it, the shapes that are drawn, and memory of the threads."""

    panes: Any
    """`kernels.panes.Panes`."""
    shape: Topology
    views: Views
    benches: list[Any]
    """`kernels.panes.Bench` of each thread that is not at work."""


def windows(shape: Topology, views: Views, evidence: Evidence, rules: Rules) -> Windows:
    """Pack what stays as it is while the objects move (float32, on a CPU)."""
    panes = kernels("panes", "cpu").Panes()
    keep, mask = evidence.keep.float(), evidence.mask
    panes.pixels, panes.objects = views.height * views.width, len(mask)
    panes.empty = array((keep * mask).double().square().sum((-2, -1)), "float64")
    panes.mask, panes.keep = _flat(mask), _flat(keep)
    panes.ring = 0 if evidence.ring is None else rules.reach
    panes.depth = evidence.near is not None
    for name, values in (
        ("weight", evidence.ring),
        ("near", evidence.near),
        ("far", evidence.far),
        ("free", evidence.free),
    ):
        setattr(panes, name, _flat(mask.new_zeros(0) if values is None else values))
    if evidence.rules is not None:
        panes.rules = array(evidence.rules.contiguous().view(-1), "uint8")
    panes.back = rules.back
    panes.limit, panes.shrink = rules.limit, rules.shrink
    return Windows(panes, shape, views, [])


def prices(
    verts_cam: Float[Tensor, "*starts objects verts 3"], held: Windows
) -> Float[Tensor, "*starts objects 4"]:
    """Squares [px], ring, and depths out of bounds and of free space [m px], by object.

    They are differentiable once, in the vertices in camera axes [m].
    """
    found = _Prices.apply(verts_cam, held)
    assert isinstance(found, Tensor)
    return found


class _Prices(torch.autograd.Function):
    """Keeps the change with the vertices."""

    @staticmethod
    def forward(ctx: Any, verts: Tensor, held: Windows) -> Tensor:  # noqa: ANN401
        axes, count = verts.shape[:-2], verts.shape[-2]
        rows = verts.detach().reshape(-1, count, 3)
        price = rows.new_empty(len(rows), PRICES)
        grads = rows.new_empty(len(rows), PRICES, count, 3)
        if rows.numel():
            _run(rows, held, price, grads)
        ctx.save_for_backward(grads)
        return price.view(*axes, PRICES)

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any,  # noqa: ANN401
        *grads: Tensor,
    ) -> tuple[Tensor, None]:
        (slopes,) = ctx.saved_tensors
        items, _, count, _ = slopes.shape
        pulled = grads[0].reshape(items, 1, PRICES) @ slopes.view(items, PRICES, -1)
        return pulled.view(*grads[0].shape[:-1], count, 3), None


def _run(rows: Tensor, held: Windows, price: Tensor, grads: Tensor) -> None:
    """Price all items, on as many threads as are wanted."""
    module, panes = kernels("windows", "cpu"), kernels("panes", "cpu")
    items = items_of(rows, held.shape, held.views, BORDER)
    scene, bill = pack_scene(items), panes.Bill()
    bill.price = started().from_torch(price)
    bill.grads = started().from_torch(grads, dtype=started().vec3)
    parts = min(threads(), len(rows))
    cuts = [len(rows) * k // parts for k in range(parts + 1)]

    def one(part: int) -> None:
        bench = held.benches.pop() if held.benches else _bench(panes, items)
        inputs = [scene, held.panes, bench, bill, started().vec2i(cuts[part], cuts[part + 1])]
        started().launch(module.price_windows, 1, inputs, device="cpu")
        held.benches.append(bench)

    share(one, parts)


def _bench(panes: Any, items: Items) -> Any:  # noqa: ANN401
    """Working memory for one item."""
    from .kernels.scene import Maps, Scene

    room = room_of(items)
    verts, faces, edges, grid = room
    bench, scene, maps = panes.Bench(), Scene(), Maps()
    scene.verts, scene.window = (
        array(torch.zeros(n, k), f"vec{k}") for n, k in ((verts, 3), (1, 4))
    )
    scene.faces = array(torch.zeros(faces, 3, dtype=torch.int64), "vec3l")
    scene.edges = array(torch.zeros(edges, 4, dtype=torch.int64), "vec4l")
    scene.views = scene.shapes = 1
    scene.n_verts, scene.n_faces, scene.n_edges = verts, faces, edges
    scene.height, scene.width = items.height + 2 * items.border, items.width + 2 * items.border
    scene.border = items.border
    bench.scene, bench.scratch = scene, desk_of(room, 2 * grid, torch.device("cpu")).scratch
    for name in ("image", "rows", "slope"):
        setattr(bench, name, array(torch.zeros(items.height * items.width), "float32"))
    for name in ("squares", "rings", "bounds", "frees"):
        setattr(bench, name, array(torch.zeros(verts, 3), "vec3"))
    maps.image = bench.image
    bench.maps = maps
    return bench


def _flat(values: Tensor) -> Any:  # noqa: ANN401
    return array(values.float().contiguous().view(-1), "float32")
