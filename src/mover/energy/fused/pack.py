"""What the kernel of Eq. 1 is given: objects without padding, windows with a border, people."""

from typing import Any

import torch
from torch import Tensor

from mover.core.types import Objects
from mover.energy import human_terms, image_terms, prior_terms
from mover.energy.config import SceneConfig, SceneWeights
from mover.energy.fused.launch import BORDER, FUSED, BufferSize, FusedEnergy
from mover.energy.objective import HumanCues, ImageCues, SceneEvidence
from mover.geometry.raster.draw import windows as lens_of
from mover.geometry.volume import field_of
from mover.geometry.warp_start import array, started

BRICK = 8  # [cells], as in `Volume.busy`
CALM = 2  # a brick without bodies, as in `kernels.simple`


def kernel_of(known: SceneEvidence, config: SceneConfig) -> FusedEnergy:
    """The kernel of Eq. 1 with all that it needs to know."""
    from mover.energy.fused.kernels.data import KernelInput

    wp, weights = started(), config.weights
    objects, camera, image, humans = known.objects, known.camera, known.image, known.humans
    queries, share, ends = _queries(objects, humans, weights)
    things, counts = _things(objects, ends)
    data = KernelInput()
    data.things = things
    data.windows = _windows(image, humans, weights)
    data.people = _people(known, weights, queries, share)
    data.boxes = array(image.boxes.contiguous(), "vec4")
    data.within = array((image.sides != image_terms.UNKNOWN).float(), "vec4")
    costs = torch.tensor([0.0, torch.inf, 0.0, image_terms.HIDDEN])  # by what is known of a side
    data.beyond = array(costs[image.sides], "vec4")
    data.facts = wp.from_torch(_facts(objects, image, humans, weights))
    turn = camera.R_cam_world.detach().clone()
    data.turn = array(turn[None], "mat33")
    K = camera.K.tolist()
    data.lens = wp.vec4(K[0][0], K[1][1], K[0][2], K[1][2])
    data.weights = tuple(getattr(weights, name) for name in FUSED)
    data.soft, data.rho = image_terms.SOFT, prior_terms.DISTANCE_RHO
    data.sizes, data.growth = (prior_terms.LOWEST, prior_terms.HIGHEST), config.growth
    views = image.views
    verts, faces, edges = (int(c.max()) for c in counts)
    shifts = 1 if image.borders is None else len(image.borders.shifts)
    size = BufferSize(
        verts, faces, edges, views.height + 2 * BORDER, views.width + 2 * BORDER, shifts
    )
    return FusedEnergy(data, size, counts[1], camera.R_cam_world, turn)


def _things(objects: Objects, queries: Tensor) -> tuple[Any, list[Tensor]]:
    """The objects without padding, and how many vertices, faces and edges each has."""
    from mover.energy.fused.kernels.data import ObjectData

    real = real_parts(objects)
    counts = [r.sum(-1) for r in real]
    n, samples = objects.samples.shape[:2]
    per = torch.full((n,), samples)
    starts = [torch.cat([c.new_zeros(1), c.cumsum(0)]) for c in (*counts, per)]
    things = ObjectData()
    things.verts = array(objects.verts.detach()[real[0]], "vec3")
    things.faces = array(objects.faces[real[1]].int(), "vec3i")
    things.edges = array(objects.edges[real[2]].int(), "vec4i")
    things.samples = array(objects.samples.detach().reshape(-1, 3).contiguous(), "vec3")
    things.starts = started().from_torch(torch.stack([*starts, queries], -1).int().contiguous())
    return things, counts


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

    views, windows = image.views, ImageData()
    mask, keep = image.masks.detach(), image.keep.to(image.masks)
    windows.lens = array(lens_of(views.K.detach(), BORDER), "vec4")
    shifts, masks = mask.new_zeros(1), mask.unsqueeze(0)
    if image.borders is not None:
        shifts, masks = image.borders.shifts, image.borders.masks.detach()
    windows.shifts, windows.loose = array(shifts.contiguous(), "float32"), image_terms.BORDER_WEIGHT
    windows.mask, windows.keep = _grid(masks, 0.0), _grid(keep, 0.0)
    gain = torch.nn.functional.pad((keep * (1 - 2 * masks)).double(), [BORDER + 1, *[BORDER] * 3])
    windows.gain = array(gain.cumsum(-1).view(-1), "float64")  # of the pixels of a row before each
    windows.empty = array((keep * masks.double().square()).sum((-2, -1)).view(-1), "float64")
    area = (masks * keep).sum((-2, -1)).clamp_min(1)
    windows.trust = array((image.trust / area).view(-1).contiguous(), "float32")
    lower, upper, bounded = _bounds(mask, humans, weights)
    windows.lower, windows.upper = lower, upper
    windows.bounded = array(bounded, "vec4i")
    windows.limit, windows.fewest = human_terms.CLAMP, human_terms.FEWEST
    return windows


def _grid(maps: Tensor, border: float) -> Any:  # noqa: ANN401
    """Maps with a border, flat."""
    padded = torch.nn.functional.pad(maps, [BORDER] * 4, value=border)
    return array(padded.contiguous().view(-1), "float32")


def _bounds(mask: Tensor, humans: HumanCues, weights: SceneWeights) -> tuple[Any, Any, Tensor]:
    """Lowest and highest depth of each pixel, and the rows and columns that have any."""
    n = len(mask)
    if humans.depth is None or not weights.depth:
        nothing = torch.zeros(n, 4, dtype=torch.int32)
        return *(array(mask.new_zeros(1), "float32") for _ in range(2)), nothing
    near, far = humans.depth.near, humans.depth.far
    known = (mask > 0.5) & (near < far) & (near.isfinite() | far.isfinite())
    lower = torch.where(known, near - human_terms.DEPTH_MARGIN, torch.inf)
    ends: list[Tensor] = []  # first row of each mask that is bounded and the one after the last
    for lines in (known.any(2), known.any(1)):
        size, number = lines.shape[1], torch.arange(lines.shape[1])
        ends.append(torch.where(lines, number, size).amin(1))
        ends.append(torch.where(lines, number + 1, 0).amax(1))
    upper = _grid(far + human_terms.DEPTH_MARGIN, 0.0)
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

    people = HumanData()
    people.queries, people.share = array(queries, "vec3"), array(share, "float32")
    people.rho = human_terms.CONTACT_RHO
    objects = known.objects
    people.top, people.back = (
        array(x.detach().contiguous(), "vec3") for x in (objects.top, objects.back)
    )
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
    touches: human_terms.ContactPoints | None = humans.touches
    if touches is not None:
        facts[touches.object_of, 3:5] = touches.heading
        facts[touches.object_of, 5] = (touches.heading.square().sum(-1) > 0).to(facts)
    return facts
