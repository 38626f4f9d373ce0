"""Eq. 1 in its robust form by one kernel on a CPU: a thread sums one item after the other.

An evaluation gives the terms and their gradient at once. Items, the starts of all objects, share
nothing, so that the result does not depend on the number of threads.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from threading import Lock
from typing import Any

import torch
from jaxtyping import Float, Int
from torch import Tensor
from torch.autograd.function import once_differentiable

from mover.core.types import Layout, Objects
from mover.energy import human_terms, image_terms, prior_terms
from mover.energy.config import SceneConfig, SceneWeights
from mover.energy.objective import SCENE_TERMS, HumanCues, ImageCues, SceneEvidence
from mover.geometry.raster.draw import scratch_of
from mover.geometry.raster.draw import windows as lens_of
from mover.geometry.volume import field_of
from mover.geometry.warp_start import filled, kernels, share, started, threads

KERNELS = "mover.energy.fused.kernels"
BORDER = 1  # [px], as in the rasterisers
FUSED = tuple(t.name for t in SCENE_TERMS if t.fused)
"""Terms of the kernel, in the order of `kernels.data.BBOX` and those after it."""
TERMS = len(FUSED)
IMAGE = [FUSED.index(name) for name in ("bbox", "silhouette", "depth")]  # change with the camera
UNKNOWNS = 7  # of an item: position, yaw, logarithms of the scale
YAW, TURN_X, TURN_Z = 3, 7, 8  # columns of `kernels.data.Slope`
SLOPES = 9
FIRST = 3  # position of the first item among the arguments of the kernel


@dataclass
class FusedEnergy:
    """The kernel and its memory, for layouts of one evidence; it is used by one at a time."""

    data: Any  #: `kernels.data.KernelInput`
    workspace: Callable[[], Any]  #: new `kernels.data.Workspace`, one for each thread
    effort: Tensor  #: how much work each object is, roughly
    camera: Tensor  #: from the world to the camera, where nothing else is asked for
    turn: Tensor  #: the same as it is now; memory of the kernel
    buffers: "_Buffers | None" = None  #: memory for the most items so far
    lock: Any = field(default_factory=Lock)


@dataclass
class _Buffers:
    """Memory for all starts of all objects, and a launch for each thread."""

    rows: Tensor  #: which items `order` is about
    order: Tensor
    layout: Tensor
    parts: Tensor
    slopes: Tensor
    whole: Tensor
    slope: Tensor
    launches: tuple[Any, ...]


def fused_cost(
    fused: FusedEnergy,
    layout: Layout,
    rows: Int[Tensor, " objects"] | None = None,
    turn: Float[Tensor, "3 3"] | None = None,
) -> tuple[Float[Tensor, "*starts objects"], Float[Tensor, "*starts objects terms"]]:
    """The sum of the terms and the terms, with their weights; differentiable once.

    `rows` says which of (starts x objects) the layout holds, each at most once (None: all, in their
    order); `turn` is the rotation from the world to the camera, if it is another than the kernel's.
    """
    at = torch.cat([layout.t_world_object, layout.yaw.unsqueeze(-1), layout.log_scale], -1)
    whole, parts = _Cost.apply(at, fused, rows, turn)
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
            buffers = _run(fused, flat, rows)
            ctx.save_for_backward(buffers.slope[rows], buffers.slopes[rows], flat[:, :3], turn)
            whole, parts = buffers.whole[rows], buffers.parts[rows]
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
            found = whole.unsqueeze(-1) * slope[:, :UNKNOWNS].view(*whole.shape, -1)
        if parts is not None:
            more = (parts.unsqueeze(-1) * slopes[..., :UNKNOWNS].view(*parts.shape, -1)).sum(-2)
            found = more if found is None else found + more
        if turn is None:
            return found, None, None, None
        each = slopes.new_zeros(slopes.shape[:2])
        for grad, last in ((whole, 1), (parts, TERMS)):
            each = each if grad is None else each + grad.reshape(-1, last)
        return found, None, None, _of_camera(each[:, IMAGE, None] * slopes[:, IMAGE], place, turn)


def _of_camera(slopes: Tensor, place: Tensor, turn: Tensor) -> Tensor:
    """Change with the camera's rotation R: under dR = R [w], dE = < R [sum X x F] / 2, dR >."""
    pull = slopes.sum(1)
    arm = torch.cross(place, pull[:, :3], dim=-1) + pull[:, [TURN_X, YAW, TURN_Z]]
    x, y, z = arm.sum(0).unbind()
    none = torch.zeros_like(x)
    skew = torch.stack([none, -z, y, z, none, -x, -y, x, none]).view(3, 3)
    return 0.5 * turn @ skew


def _run(fused: FusedEnergy, layout: Tensor, rows: Tensor) -> _Buffers:
    """Sum these rows, the largest objects first, on as many threads as are wanted."""
    count = min(threads(), max(len(rows), 1))
    need = int(rows.max()) + 1 if len(rows) else 0
    buffers = fused.buffers
    if buffers is None or len(buffers.layout) < need or len(buffers.launches) < count:
        fused.buffers = buffers = _buffers_of(fused, need, count)
    if not torch.equal(buffers.rows, rows):
        effort = fused.effort[rows % max(1, len(fused.effort))]
        buffers.order[: len(rows)] = rows[effort.argsort(descending=True, stable=True)]
        buffers.rows = rows.clone()
    buffers.layout[rows] = layout
    todo = iter(_chunks(len(rows), count))

    def work(thread: int) -> None:
        launch = buffers.launches[thread]
        for first, stop in todo:
            for k, value in ((FIRST, first), (FIRST + 1, stop)):
                launch.set_param_at_index_from_ctype(k, value)
            launch.launch()

    share(work, count)
    return buffers


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
    from mover.energy.fused.kernels.data import ItemCosts

    kernel, launch = kernels("cost", "cpu", KERNELS).cost_items, started().launch
    memory = {
        "order": torch.zeros(items, dtype=torch.int32), "layout": torch.empty(items, UNKNOWNS),
        "parts": torch.empty(items, TERMS), "slopes": torch.empty(items, TERMS, SLOPES),
        "whole": torch.empty(items), "slope": torch.empty(items, SLOPES),
    }  # fmt: skip
    answer = filled(ItemCosts, **memory)
    inputs = [[fused.data, fused.workspace(), answer, 0, 0] for _ in range(count)]
    launches = tuple(launch(kernel, 1, row, device="cpu", record_cmd=True) for row in inputs)
    return _Buffers(**memory, rows=torch.zeros(0, dtype=torch.long), launches=launches)


def _workspace(verts: int, faces: int, edges: int, size: tuple[int, int], shifts: int) -> Any:  # noqa: ANN401
    """`kernels.data.Workspace` of a thread, for items of at most so many parts.

    The size is height and width of a grid, with the border [px]; `shifts` is how many borders each
    mask may have.
    """
    from mover.energy.fused.kernels.data import Workspace
    from mover.geometry.kernels.scene import Items

    height, width = size
    grid, stride, across = height * width, (width // 8 + 1) * 8, -(-width // 64)
    words = torch.zeros(height * stride // 8, dtype=torch.int64)
    seen, behind = torch.zeros(2, height * across, dtype=torch.int64)
    scene = filled(
        Items, verts=torch.zeros(verts, 3), window=torch.zeros(1, 4), views=1, shapes=1,
        n_verts=verts, n_faces=faces, n_edges=edges, height=height, width=width, border=BORDER,
    )  # fmt: skip
    return filled(
        Workspace, scene=scene, scratch=scratch_of((verts, faces, edges, grid, 2 * grid)),
        stride=stride, across=across,
        words=words, steps=words.view(torch.uint8),  # one memory, seen by words and by bytes
        seen=seen, behind=behind, pairs=torch.empty(2 * grid, dtype=torch.int32),
        keys=torch.empty(2 * grid, dtype=torch.int64), crossings=torch.empty(2 * grid, 4),
        shift=torch.zeros(grid), moved=torch.zeros(2 * grid),
        squares=torch.zeros(shifts, dtype=torch.float64),
    )  # fmt: skip


BRICK = 8  # [cells], as in `Volume.busy`
CALM = 2  # a brick without bodies, as in `kernels.simple`


def kernel_of(known: SceneEvidence, config: SceneConfig) -> FusedEnergy:
    """The kernel of Eq. 1 with all that it needs to know."""
    from mover.energy.fused.kernels.data import KernelInput

    weights, turn = config.weights, known.camera.R_cam_world.detach().clone()
    objects, camera, image, humans = known.objects, known.camera, known.image, known.humans
    queries, share, ends = _queries(objects, humans, weights)
    things, counts = _things(objects, ends)
    costs = torch.tensor([0.0, torch.inf, 0.0, image_terms.HIDDEN])  # by what is known of a side
    data = filled(
        KernelInput, things=things, windows=_windows(image, humans, weights),
        people=_people(known, weights, queries, share), boxes=image.boxes.contiguous(),
        within=(image.sides != image_terms.UNKNOWN).float(), beyond=costs[image.sides],
        facts=_facts(objects, image, humans, weights), turn=turn[None],
        lens=started().vec4(*lens_of(camera.K[None], 0)[0].tolist()),
        weights=tuple(getattr(weights, name) for name in FUSED),
        soft=image_terms.SOFT, sizes=(prior_terms.LOWEST, prior_terms.HIGHEST),
        growth=config.growth, rho=prior_terms.DISTANCE_RHO,
    )  # fmt: skip
    verts, faces, edges = (int(c.max()) for c in counts)
    size = image.views.height + 2 * BORDER, image.views.width + 2 * BORDER
    shifts = 1 if image.borders is None else len(image.borders.shifts)
    workspace = partial(_workspace, verts, faces, edges, size, shifts)
    return FusedEnergy(data, workspace, counts[1], camera.R_cam_world, turn)


def _things(objects: Objects, queries: Tensor) -> tuple[Any, list[Tensor]]:
    """The objects without padding, and how many vertices, faces and edges each has."""
    from mover.energy.fused.kernels.data import ObjectData

    real = real_parts(objects)
    counts = [r.sum(-1) for r in real]
    n, samples = objects.samples.shape[:2]
    per = torch.full((n,), samples)
    starts = [torch.cat([c.new_zeros(1), c.cumsum(0)]) for c in (*counts, per)]
    return filled(
        ObjectData, verts=objects.verts[real[0]], faces=objects.faces[real[1]].int(),
        edges=objects.edges[real[2]].int(), samples=objects.samples.reshape(-1, 3).contiguous(),
        starts=torch.stack([*starts, queries], -1).int().contiguous(),
    ), counts  # fmt: skip


def real_parts(objects: Objects) -> list[Tensor]:
    """Which vertices, faces and edges do not pad; up to the last real one of each object."""
    real = [
        objects.real_verts,
        objects.faces[..., 0] != objects.faces[..., 1],
        objects.edges[..., 0] != objects.edges[..., 1],
    ]
    return [r.flip(-1).cummax(-1).values.flip(-1) if r.numel() else r for r in real]


def _windows(image: ImageCues, humans: HumanCues, weights: SceneWeights) -> Any:  # noqa: ANN401
    from mover.energy.fused.kernels.data import ImageData

    mask, keep = image.masks.detach(), image.keep.to(image.masks)
    shifts, masks = mask.new_zeros(1), mask.unsqueeze(0)
    if image.borders is not None:
        shifts, masks = image.borders.shifts, image.borders.masks.detach()
    gain = torch.nn.functional.pad((keep * (1 - 2 * masks)).double(), [BORDER + 1, *[BORDER] * 3])
    area = (masks * keep).sum((-2, -1)).clamp_min(1)
    lower, upper, bounded = _bounds(mask, humans, weights)
    return filled(
        ImageData, lens=lens_of(image.views.K, BORDER), shifts=shifts.contiguous(),
        loose=image_terms.BORDER_WEIGHT, mask=_grid(masks), keep=_grid(keep),
        gain=gain.cumsum(-1).view(-1),  # of the pixels of a row before each
        empty=(keep * masks.double().square()).sum((-2, -1)).view(-1),
        trust=(image.trust / area).view(-1).contiguous(), lower=lower, upper=upper,
        bounded=bounded, limit=human_terms.CLAMP, fewest=human_terms.FEWEST,
    )  # fmt: skip


def _grid(maps: Tensor, border: float = 0.0) -> Tensor:
    """Maps with a border, flat."""
    padded = torch.nn.functional.pad(maps, [BORDER] * 4, value=border)
    return padded.contiguous().view(-1)


def _bounds(mask: Tensor, humans: HumanCues, weights: SceneWeights) -> tuple[Tensor, ...]:
    """Lowest and highest depth of each pixel, and the rows and columns that have any."""
    if humans.depth is None or not weights.depth:
        return mask.new_zeros(1), mask.new_zeros(1), torch.zeros(len(mask), 4, dtype=torch.int32)
    near, far = humans.depth.near, humans.depth.far
    known = (mask > 0.5) & (near < far) & (near.isfinite() | far.isfinite())
    lower = torch.where(known, near - human_terms.DEPTH_MARGIN, torch.inf)
    ends: list[Tensor] = []  # first row of each mask that is bounded and the one after the last
    for lines in (known.any(2), known.any(1)):
        size, number = lines.shape[1], torch.arange(lines.shape[1])
        ends.append(torch.where(lines, number, size).amin(1))
        ends.append(torch.where(lines, number + 1, 0).amax(1))
    upper = _grid(far + human_terms.DEPTH_MARGIN)
    return _grid(lower, torch.inf), upper, (torch.stack(ends, -1) + BORDER).int()


def _queries(
    objects: Objects, humans: HumanCues, weights: SceneWeights
) -> tuple[Tensor, Tensor, Tensor]:
    """Skin that touches, object by object; its share in the cost; where each object begins."""
    n, touches = len(objects.ids), humans.touches
    if touches is None or not weights.contact:
        none = torch.zeros(1, 3)
        return none, none[:, 0].contiguous(), torch.zeros(n + 1, dtype=torch.long)
    weight = touches.weight
    part = torch.tensor(human_terms.CONTACT_SHARE).to(weight)
    whole = weight.sum(-1, keepdim=True).clamp_min(1e-9)
    full = (touches.bodies / human_terms.ENOUGH).clamp_max(1)[:, None, None]
    share = weight / whole * part[:, None] * full * torch.tensor([1.0, -1.0, 1.0, -1.0])[:, None]
    order = touches.object_of.argsort()
    share, points = share[order].flatten(1), touches.points[order].flatten(1, 2)
    count = torch.zeros(n + 1, dtype=torch.long)
    count[touches.object_of[order] + 1] = (share != 0).sum(-1)
    asking = share != 0
    few, shares = points[asking].contiguous(), share[asking].contiguous()
    return few, shares, count.cumsum(0)


def _people(known: SceneEvidence, weights: SceneWeights, queries: Tensor, share: Tensor) -> Any:  # noqa: ANN401
    from mover.energy.fused.kernels.data import HumanData

    people = filled(
        HumanData, queries=queries, share=share, rho=human_terms.CONTACT_RHO,
        top=known.objects.top.contiguous(), back=known.objects.back.contiguous(),
    )  # fmt: skip
    if weights.collision and known.humans.space is not None:
        volume = known.humans.space.volume
        some = volume.values[::BRICK, ::BRICK, ::BRICK]
        x, y, z = volume.busy.shape
        calm = (volume.busy == 0) & (some[:x, :y, :z] >= 0)  # bricks without bodies
        people.field = field_of(volume, torch.where(calm, CALM, 1).to(torch.uint8))
    return people


def _facts(objects: Objects, image: ImageCues, humans: HumanCues, weights: SceneWeights) -> Tensor:
    """See `kernels.data.SIZE` and those after it."""
    n, boxes = len(objects.ids), image.boxes
    share = human_terms.collision_share(objects, humans.touches if weights.contact else None)
    facts = torch.zeros(n, 6)
    facts[:, 0] = (boxes[:, 2:] - boxes[:, :2]).clamp_min(1).prod(-1).sqrt()
    facts[:, 1] = share * human_terms.SAMPLES / max(1, objects.samples.shape[1])
    if image.distance is not None:
        facts[:, 2] = image.distance.clamp_min(1e-3).log()
    if (touches := humans.touches) is not None:
        facts[touches.object_of, 3:5] = touches.heading
        facts[touches.object_of, 5] = (touches.heading.square().sum(-1) > 0).to(facts)
    return facts
