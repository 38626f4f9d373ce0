"""Eq. 1 in its robust form by one kernel on a CPU: a thread sums one item after the other.

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

from mover.geometry.raster.draw import scratch_of
from mover.geometry.warp_start import array, filled, kernels, share, started, threads

KERNELS = "mover.energy.fused.kernels"
BORDER = 1  # [px], as in the rasterisers
TERMS = 8
IMAGE = [0, 1, 3]  # box, silhouette and depth order: what changes with the camera
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
class FusedEnergy:
    """The kernel and its memory, for layouts of one evidence; it is used by one at a time."""

    given: Any
    """`kernels.given.Given`."""
    room: Room
    effort: Tensor
    """How much work each object is, roughly."""
    asked: int
    """Number of skin points that ask what they touch."""
    camera: Tensor
    """From the world to the camera, where nothing else is asked for."""
    turn: Tensor
    """The same as it is now; memory of the kernel."""
    buffers: list["_Buffers"] = field(default_factory=list)
    """Memory for the most items so far."""
    lock: Any = field(default_factory=Lock)


@dataclass(frozen=True)
class _Buffers:
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


def fused_cost(
    fused: FusedEnergy,
    t_world_object: Float[Tensor, "*starts objects 3"],
    yaw: Float[Tensor, "*starts objects"],
    log_scale: Float[Tensor, "*starts objects 3"],
    rows: Int[Tensor, " objects"] | None = None,
    turn: Float[Tensor, "3 3"] | None = None,
) -> tuple[Float[Tensor, "*starts objects"], Float[Tensor, "*starts objects terms"]]:
    """The sum of the terms and the terms, with their weights; differentiable once.

    Args:
        fused: The kernel and its memory.
        t_world_object: Places [m].
        yaw: [rad].
        log_scale: Logarithms of the scales.
        rows: Which these are among the starts of all objects, counted through, each at most once;
            None: all, in their order.
        turn: From the world to the camera, a rotation, if it is another than the kernel's.
    """
    layout = torch.cat([t_world_object, yaw.unsqueeze(-1), log_scale], -1)
    whole, parts = _Cost.apply(layout, fused, rows, turn)
    return whole, parts


class _Cost(torch.autograd.Function):
    """Keeps the gradient of each term."""

    @staticmethod
    def forward(
        ctx: Any,  # noqa: ANN401
        layout: Tensor,
        fused: FusedEnergy,
        rows: Tensor | None,
        turn: Tensor | None,
    ) -> tuple[Tensor, Tensor]:
        axes = layout.shape[:-1]
        flat = layout.reshape(-1, layout.shape[-1])
        rows = torch.arange(len(flat)) if rows is None else rows
        with fused.lock:
            fused.turn.copy_(fused.camera if turn is None else turn)
            held = _run(fused, flat, rows)
            ctx.save_for_backward(held.slope[rows], held.slopes[rows], flat[:, :3], turn)
            whole, parts = held.whole[rows], held.parts[rows]
        ctx.set_materialize_grads(False)
        return whole.view(axes), parts.view(*axes, -1)

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride]
        ctx: Any,  # noqa: ANN401
        *grads: Tensor | None,
    ) -> tuple[Tensor | None, None, None, Tensor | None]:
        slope, slopes, place, turn = ctx.saved_tensors
        whole, parts = grads
        found = None
        if whole is not None:
            found = whole.unsqueeze(-1) * slope[:, :7].view(*whole.shape, -1)
        if parts is not None:
            more = (parts.unsqueeze(-1) * slopes[..., :7].view(*parts.shape, -1)).sum(-2)
            found = more if found is None else found + more
        if turn is None:
            return found, None, None, None
        each = slopes.new_zeros(slopes.shape[:2])
        for grad, last in ((whole, 1), (parts, TERMS)):
            each = each if grad is None else each + grad.reshape(-1, last)
        return found, None, None, _of_camera(each[:, IMAGE, None] * slopes[:, IMAGE], place, turn)


def _of_camera(slopes: Tensor, place: Tensor, turn: Tensor) -> Tensor:
    """Change with the camera's rotation R of what the image says.

    Under dR = R [w], points X of the world move by w x X before the camera, so that with forces F
    dE = w . sum X x F = < R [sum X x F] / 2, dR >.
    """
    pull = slopes.sum(1)
    arm = torch.cross(place, pull[:, :3], dim=-1) + pull[:, [7, 3, 8]]
    x, y, z = arm.sum(0).unbind()
    none = torch.zeros_like(x)
    skew = torch.stack([none, -z, y, z, none, -x, -y, x, none]).view(3, 3)
    return 0.5 * turn @ skew


def _run(fused: FusedEnergy, layout: Tensor, rows: Tensor) -> _Buffers:
    """Sum these rows, the largest objects first, on as many threads as are wanted."""
    count = min(threads(), max(len(rows), 1))
    held = _seated(fused, rows, count)
    held.layout[rows] = layout
    todo = iter(_chunks(len(rows), count))

    def work(thread: int) -> None:
        launch = held.launches[thread]
        for first, stop in todo:
            for k, value in ((FIRST, first), (FIRST + 1, stop)):
                launch.set_param_at_index_from_ctype(k, value)
            launch.launch()

    share(work, count)
    return held


def _seated(fused: FusedEnergy, rows: Tensor, count: int) -> _Buffers:
    """Memory in which these rows are next; that of the last call where it is large enough."""
    need = int(rows.max()) + 1 if len(rows) else 0
    held = next(iter(fused.buffers), None)
    if held is None or len(held.layout) < need or len(held.launches) < count:
        held = _buffers_of(fused, need, count)
        fused.buffers[:] = [held]
    if not held.rows or not torch.equal(held.rows[0], rows):
        effort = fused.effort[rows % max(1, len(fused.effort))]
        held.order[: len(rows)] = rows[effort.argsort(descending=True, stable=True)]
        held.rows[:] = [rows.clone()]
    return held


def _chunks(items: int, threads: int) -> list[tuple[int, int]]:
    """Ranges of items, long ones first, so that no thread waits long for the last."""
    found, at = [], 0
    while at < items:
        size = max(1, (items - at) // (3 * threads)) if threads > 1 else items
        found.append((at, at + size))
        at += size
    return found


def _buffers_of(fused: FusedEnergy, items: int, count: int) -> _Buffers:
    """Memory for so many items, and so many launches."""
    from mover.energy.fused.kernels.given import Answer

    kernel, launch = kernels("cost", "cpu", KERNELS).cost_items, started().launch
    n = max(1, len(fused.effort))
    layout, whole = torch.empty(items, 7), torch.empty(items)
    parts, slope = torch.empty(items, TERMS), torch.empty(items, 9)
    slopes = torch.empty(items, TERMS, 9)
    order = torch.zeros(items, dtype=torch.int32)
    held = torch.full((max(1, fused.asked * -(-items // n)),), -1, dtype=torch.int32)
    fused.given.people.held = array(held, "int32")
    answer = filled(
        Answer, order=order, layout=layout, parts=parts, slopes=slopes, whole=whole, slope=slope
    )
    launches = tuple(
        launch(
            kernel,
            1,
            [fused.given, _workspace(fused.room), answer, 0, 0],
            device="cpu",
            record_cmd=True,
        )
        for _ in range(count)
    )
    return _Buffers([], order, layout, parts, slopes, whole, slope, launches)


def _workspace(room: Room) -> Any:  # noqa: ANN401
    """`kernels.given.Workspace` of a thread."""
    from mover.energy.fused.kernels.given import Workspace
    from mover.geometry.kernels.scene import Scene

    grid = room.height * room.width
    space, scene = Workspace(), Scene()
    scene.verts = array(torch.zeros(room.verts, 3), "vec3")
    scene.window = array(torch.zeros(1, 4), "vec4")
    scene.views = scene.shapes = 1
    scene.n_verts, scene.n_faces, scene.n_edges = room.verts, room.faces, room.edges
    scene.height, scene.width, scene.border = room.height, room.width, BORDER
    sizes = room.verts, room.faces, room.edges, grid, 2 * grid
    space.scene, space.scratch = scene, scratch_of(sizes)
    _marks(space, room)
    space.pairs = array(torch.empty(2 * grid, dtype=torch.int32), "int32")
    space.keys = array(torch.empty(2 * grid, dtype=torch.int64), "uint64")
    space.crossings = array(torch.empty(2 * grid, 4), "vec4")
    space.shift = array(torch.zeros(grid), "float32")
    space.moved = array(torch.zeros(2 * grid), "float32")
    space.squares = array(torch.zeros(room.shifts, dtype=torch.float64), "float64")
    return space


def _marks(space: Any, room: Room) -> None:  # noqa: ANN401
    """The memory of what is covered; two arrays are one, seen by bytes and by words."""
    space.stride, space.across = (room.width // 8 + 1) * 8, -(-room.width // 64)
    words = torch.zeros(room.height * space.stride // 8, dtype=torch.int64)
    space.words, space.steps = array(words, "uint64"), array(words.view(torch.uint8), "uint8")
    bits = torch.zeros(2, room.height * space.across, dtype=torch.int64)
    space.seen, space.behind = (array(b, "uint64") for b in bits)
