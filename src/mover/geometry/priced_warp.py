"""Eq. 1 in its robust form by one kernel on a CPU: a thread prices one item after the other.

An evaluation gives the terms and their gradient at once. Items, the starts of all objects, share
nothing, so that the result does not depend on the number of threads.
"""

from dataclasses import dataclass, field
from threading import Lock
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from .kernels.start import kernels, started
from .raster_engine import threads
from .raster_warp_cpu import share
from .raster_warp_pack import array, desk_of

BORDER = 1  # [px], as in the rasterisers
TERMS = 8
FIRST = 3  # place of the first item among the arguments of the kernel


@dataclass(frozen=True)
class Room:
    """What one item needs at most."""

    verts: int
    faces: int
    edges: int
    height: int
    """Rows of a grid, with the border [px]."""
    width: int
    """Columns of a grid, with the border [px]."""
    shifts: int = 1
    """How many borders each mask may have."""


@dataclass
class Pricer:
    """The kernel and its memory, for layouts of one evidence; it is used by one at a time."""

    given: Any
    """`kernels.given.Given`."""
    room: Room
    effort: Tensor
    """How much work each object is, roughly."""
    asked: int
    """Number of skin points that ask what they touch."""
    held: list["_Bench"] = field(default_factory=list)
    """Memory for the most items so far."""
    lock: Any = field(default_factory=Lock)


@dataclass(frozen=True)
class _Bench:
    """Memory for all starts of all objects, and a launch for each thread."""

    rows: list[Tensor]
    """Which items `order` is about."""
    order: Tensor
    layout: Tensor
    parts: Tensor
    slopes: Tensor
    whole: Tensor
    slope: Tensor
    launches: tuple[Any, ...]


def price(
    pricer: Pricer,
    t_world_object: Float[Tensor, "*starts objects 3"],
    yaw: Float[Tensor, "*starts objects"],
    log_scale: Float[Tensor, "*starts objects 3"],
    rows: Int[Tensor, " objects"] | None = None,
) -> tuple[Float[Tensor, "*starts objects"], Float[Tensor, "*starts objects terms"]]:
    """The sum of the terms and the terms, with their weights; differentiable once.

    Args:
        pricer: The kernel and its memory.
        t_world_object: Places [m].
        yaw: [rad].
        log_scale: Logarithms of the scales.
        rows: Which these are among the starts of all objects, counted through, each at most once;
            None: all, in their order.
    """
    layout = torch.cat([t_world_object, yaw.unsqueeze(-1), log_scale], -1)
    whole, parts = _Price.apply(layout, pricer, rows)
    return whole, parts


class _Price(torch.autograd.Function):
    """Keeps the gradient of each term."""

    @staticmethod
    def forward(
        ctx: Any,  # noqa: ANN401
        layout: Tensor,
        pricer: Pricer,
        rows: Tensor | None,
    ) -> tuple[Tensor, Tensor]:
        axes = layout.shape[:-1]
        flat = layout.reshape(-1, layout.shape[-1])
        rows = torch.arange(len(flat)) if rows is None else rows
        with pricer.lock:
            bench = _run(pricer, flat, rows)
            ctx.save_for_backward(bench.slope[rows], bench.slopes[rows])
            whole, parts = bench.whole[rows], bench.parts[rows]
        ctx.set_materialize_grads(False)
        return whole.view(axes), parts.view(*axes, -1)

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any,  # noqa: ANN401
        *grads: Tensor | None,
    ) -> tuple[Tensor | None, None, None]:
        slope, slopes = ctx.saved_tensors
        whole, parts = grads
        found = None
        if whole is not None:
            found = whole.unsqueeze(-1) * slope.view(*whole.shape, -1)
        if parts is not None:
            more = (parts.unsqueeze(-1) * slopes.view(*parts.shape, -1)).sum(-2)
            found = more if found is None else found + more
        return found, None, None


def _run(pricer: Pricer, layout: Tensor, rows: Tensor) -> _Bench:
    """Price these rows, the largest objects first, on as many threads as are wanted."""
    count = min(threads(), max(len(rows), 1))
    bench = _seated(pricer, rows, count)
    bench.layout[rows] = layout
    todo = iter(_chunks(len(rows), count))

    def work(thread: int) -> None:
        launch = bench.launches[thread]
        for first, stop in todo:
            for k, value in ((FIRST, first), (FIRST + 1, stop)):
                launch.set_param_at_index_from_ctype(k, value)
            launch.launch()

    share(work, count)
    return bench


def _seated(pricer: Pricer, rows: Tensor, count: int) -> _Bench:
    """Memory in which these rows are next; that of the last call where it is large enough."""
    need = int(rows.max()) + 1 if len(rows) else 0
    bench = next(iter(pricer.held), None)
    if bench is None or len(bench.layout) < need or len(bench.launches) < count:
        bench = _bench(pricer, need, count)
        pricer.held[:] = [bench]
    if not bench.rows or not torch.equal(bench.rows[0], rows):
        effort = pricer.effort[rows % max(1, len(pricer.effort))]
        bench.order[: len(rows)] = rows[effort.argsort(descending=True, stable=True)]
        bench.rows[:] = [rows.clone()]
    return bench


def _chunks(items: int, threads: int) -> list[tuple[int, int]]:
    """Ranges of items, long ones first, so that no thread waits long for the last."""
    found, at = [], 0
    while at < items:
        size = max(1, (items - at) // (3 * threads)) if threads > 1 else items
        found.append((at, at + size))
        at += size
    return found


def _bench(pricer: Pricer, items: int, count: int) -> _Bench:
    """Memory for so many items, and so many launches."""
    from .kernels.given import Answer

    kernel, launch = kernels("priced", "cpu").price_items, started().launch
    n = max(1, len(pricer.effort))
    layout, whole = torch.empty(items, 7), torch.empty(items)
    parts, slope = torch.empty(items, TERMS), torch.empty(items, 7)
    slopes = torch.empty(items, TERMS, 7)
    order = torch.zeros(items, dtype=torch.int32)
    pricer.given.people.held = array(
        torch.full((max(1, pricer.asked * -(-items // n)),), -1, dtype=torch.int32), "int32"
    )
    answer = Answer()
    answer.order = array(order, "int32")
    answer.layout, answer.parts = (started().from_torch(x) for x in (layout, parts))
    answer.slopes, answer.slope = (_slopes(x) for x in (slopes, slope))
    answer.whole = array(whole, "float32")
    launches = tuple(
        launch(
            kernel,
            1,
            [pricer.given, _desk(pricer.room), answer, 0, 0],
            device="cpu",
            record_cmd=True,
        )
        for _ in range(count)
    )
    return _Bench([], order, layout, parts, slopes, whole, slope, launches)


def _slopes(values: Tensor) -> Any:  # noqa: ANN401
    from .kernels.given import Slope

    return started().from_torch(values, dtype=Slope)


def _desk(room: Room) -> Any:  # noqa: ANN401
    """`kernels.given.Desk` of a thread."""
    from .kernels.given import Desk
    from .kernels.scene import Scene

    grid = room.height * room.width
    desk, scene = Desk(), Scene()
    scene.verts = array(torch.zeros(room.verts, 3), "vec3")
    scene.window = array(torch.zeros(1, 4), "vec4")
    scene.views = scene.shapes = 1
    scene.n_verts, scene.n_faces, scene.n_edges = room.verts, room.faces, room.edges
    scene.height, scene.width, scene.border = room.height, room.width, BORDER
    sizes = room.verts, room.faces, room.edges, grid
    desk.scene, desk.scratch = scene, desk_of(sizes, 2 * grid, torch.device("cpu")).scratch
    _marks(desk, room)
    desk.pairs = array(torch.empty(2 * grid, dtype=torch.int32), "int32")
    desk.keys = array(torch.empty(2 * grid, dtype=torch.int64), "uint64")
    desk.crossings = array(torch.empty(2 * grid, 4), "vec4")
    desk.shift = array(torch.zeros(grid), "float32")
    desk.moved = array(torch.zeros(2 * grid), "float32")
    desk.squares = array(torch.zeros(room.shifts, dtype=torch.float64), "float64")
    return desk


def _marks(desk: Any, room: Room) -> None:  # noqa: ANN401
    """The memory of what is covered; two arrays are one, seen by bytes and by words."""
    desk.stride, desk.across = (room.width // 8 + 1) * 8, -(-room.width // 64)
    words = torch.zeros(room.height * desk.stride // 8, dtype=torch.int64)
    desk.words, desk.steps = array(words, "uint64"), array(words.view(torch.uint8), "uint8")
    bits = torch.zeros(2, room.height * desk.across, dtype=torch.int64)
    desk.seen, desk.behind = (array(b, "uint64") for b in bits)
