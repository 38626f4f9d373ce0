"""Find the focal length: people have to be seen where their bodies are.

Not in the paper, which takes the lens as given. A body at (X, Y, Z) is seen at c + f (X, Y) / Z,
so that under a lens that is said to be too long everybody is drawn too far from the middle of the
image, the more the farther out. One factor for the whole video brings drawn bodies and masks
together (`fit_zoom`), against a prior on its logarithm. The depth of people takes no part: a body
that is too near or too far lies on the same ray.

What nothing here can tell: bodies that were fitted to the image under the same wrong lens are
seen where they are. Then the factor is 1, and the people's depth is wrong with the lens.
"""

import dataclasses

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import pad

from mover.core.observe import Observer, Step, silent
from mover.core.records import record
from mover.core.types import Bodies, Camera, People
from mover.geometry.raster import Crops, layers
from mover.stages.config import FocalConfig
from mover.stages.contacts.assign_contacts import evenly
from mover.stages.cover import Cover, clear
from mover.stages.masks import MaskTable, mask_table, small, uncovered

# How much longer the lens is than it was said to be: a robust line through where people are seen.
#
#     m - c = z (b - c) + h o
#
# m: middle of a person's mask, b: of the drawn body, c: the principal point, h: the body's height
# in the image, z: true focal length over the given one, o: what masks of one person are off on
# average, in body heights, because bodies are bent by mistake or outlines too wide.

OFFSET = 0.03  # of a body's height: usual size of `o`
SYSTEMATIC = 0.002  # error of the logarithm that more frames do not make smaller
NOISE = 0.005  # of a body's height: middles are never more exact than that
TURNS = 20  # enough for the weights of the robust price to settle
GAUSS = 1.4826  # standard deviation over the median of absolute deviations


@record
class Sightings:
    """Where people are drawn and where they are seen."""

    drawn: Float[Tensor, "rows 2"]
    """Middle of each drawn body, from the principal point [px]."""
    seen: Float[Tensor, "rows 2"]
    """Middle of its mask, from the principal point [px]."""
    height: Float[Tensor, " rows"]
    """Of the drawn body [px]."""
    person: Int[Tensor, " rows"]
    moment: Int[Tensor, " rows"]
    """Rows of one person and moment err together."""


def fit_zoom(sightings: Sightings, spread: float) -> tuple[float, float]:
    """The factor z and the standard deviation of its logarithm.

    Args:
        sightings: Of all people.
        spread: Standard deviation of log z before anybody is seen. Where people say little, z
            stays near 1 and its spread near this.

    Returns:
        Maximum a posteriori under the robust price of Geman and McClure; the weight of the rows is
        divided by how much rows of one moment err together.
    """
    rows, target = _lines(sightings)
    trust = torch.full((rows.shape[1],), OFFSET**-2, dtype=torch.float64)
    trust[0] = spread**-2
    centre = torch.zeros_like(trust)
    centre[0] = 1.0
    _, group = torch.stack([sightings.person, sightings.moment], -1).unique(
        dim=0, return_inverse=True
    )
    at, shared = centre, 1.0
    weight = torch.ones(len(target), dtype=torch.float64)
    for _ in range(TURNS):
        residual = target - rows @ at
        noise = max(GAUSS * float(residual.abs().median()), NOISE)
        weight = noise**-2 / (1 + (residual / (2 * noise)).square()).square()
        shared = _together(rows[:, 0] * weight * residual, group.repeat_interleave(2))
        hessian = rows.mT @ (weight[:, None] * rows) / shared + trust.diag()
        at = torch.linalg.solve(hessian, rows.mT @ (weight * target) / shared + trust * centre)
    hessian = rows.mT @ (weight[:, None] * rows) / shared + trust.diag()
    error = float(torch.linalg.inv(hessian)[0, 0]) ** 0.5 / float(at[0])
    return float(at[0]), min((error**2 + SYSTEMATIC**2) ** 0.5, spread)


def _lines(sightings: Sightings) -> tuple[Float[Tensor, "lines unknowns"], Float[Tensor, " lines"]]:
    """One line for each row and axis, in body heights: factor, then two offsets a person."""
    height = sightings.height.double()[:, None]
    people, person = sightings.person.unique(return_inverse=True)
    own = torch.nn.functional.one_hot(person, len(people)).double()
    drawn = (sightings.drawn.double() / height).reshape(-1, 1)
    axes = torch.eye(2, dtype=torch.float64)
    offsets = (own[:, None, :, None] * axes[None, :, None, :]).reshape(len(drawn), -1)
    return torch.cat([drawn, offsets], 1), (sightings.seen.double() / height).reshape(-1)


def _together(pull: Float[Tensor, " lines"], group: Int[Tensor, " lines"]) -> float:
    """Variance of the sum of pulls over what it would be if none erred with another; at least 1."""
    each = float(pull.square().sum())
    sums = torch.zeros(int(group.max()) + 1, dtype=pull.dtype).index_add(0, group, pull)
    return max(1.0, float(sums.square().sum()) / each) if each > 0 else 1.0


EDGE = 0.1  # of the image's width: people may be drawn so far from where they are seen
NEAREST = 0.2  # [m], bodies that reach nearer to the camera are not looked at
TOGETHER = 1.0  # [s] in which errors of a pose stay the same


@record
class FocalInputs:
    """People in camera axes, and where they are seen."""

    bodies: Bodies
    keep: Bool[Tensor, " bodies"]
    """Which rows are sound, from `select_frames`."""
    people: People
    objects: Cover
    """All objects: what they cover may hide a person."""
    camera: Camera


@record
class Focal:
    """The lens, as people tell it."""

    zoom: float
    """True focal length over the given one; 1 where nothing is known."""
    spread: float
    """Standard deviation of its logarithm."""
    sightings: int
    """Bodies that were compared."""
    warnings: tuple[str, ...]


def find_focal(inputs: FocalInputs, config: FocalConfig, observe: Observer = silent) -> Focal:
    """Compare where people are drawn with where they are seen.

    Raises:
        ValueError: If `spread` is not above 0.
    """
    if config.spread <= 0:
        raise ValueError(f"find_focal: spread {config.spread}, expected above 0")
    table = mask_table(inputs.people, inputs.bodies)
    free = clear(inputs.objects, config.width)
    found: list[tuple[int, Tensor]] = []
    for row in _rows(inputs, config, table):
        there = free(int(inputs.bodies.frame[row]))
        places = _sighting(inputs, config, row, table, there)
        if places is not None:
            found.append((row, places))
    observe(Step("find_focal", 0, 1))
    if len(found) < config.least:
        few = f"{len(found)} of at least {config.least} bodies are seen well enough"
        told = f"focal length: {few}, it stays as given"
        return Focal(1.0, config.spread, len(found), (told,))
    chosen = torch.tensor([row for row, _ in found])
    zoom, spread = fit_zoom(_sightings(inputs, chosen, torch.stack([p for _, p in found])),
                            config.spread)  # fmt: skip
    told = f"focal length: {100 * (zoom - 1):+.1f} +- {100 * spread:.1f} % by the people"
    return Focal(zoom, spread, len(found), (told,) if abs(zoom - 1) > 2 * spread else ())


def zoomed(camera: Camera, zoom: float) -> Camera:
    """The camera with a longer lens."""
    K = camera.K.clone()
    K[0, 0], K[1, 1] = K[0, 0] * zoom, K[1, 1] * zoom
    return dataclasses.replace(camera, K=K)


def _rows(inputs: FocalInputs, config: FocalConfig, table: MaskTable) -> list[int]:
    """Sound bodies in front of the camera that have a mask, at most so many a person."""
    bodies, chosen = inputs.bodies, list[int]()
    masked = torch.tensor([own is not None for own in table.own]).bool().to(bodies.verts.device)
    good = (bodies.verts[..., 2] > NEAREST).all(-1) & inputs.keep & masked
    for person in bodies.person.unique():
        mine = (good & (bodies.person == person)).nonzero()[:, 0]
        chosen += evenly(mine, config.most).tolist()
    return chosen


def _sighting(
    inputs: FocalInputs,
    config: FocalConfig,
    row: int,
    table: MaskTable,
    free: Bool[Tensor, "h w"],
) -> Float[Tensor, "5"] | None:
    """Middle of the drawn body, the same moved to where it is seen, and its height [px].

    None if too little of it is seen.
    """
    camera, shrink = inputs.camera, config.width / inputs.camera.width
    own, others = table.decode(row)
    mask = small(own, config.width)
    edge = round(EDGE * config.width)
    known = (free & uncovered(others, config.width)) | (mask > 0.5)
    drawn = _drawn(inputs, row, mask.shape, edge)
    mask, known = (pad(x.to(mask), [edge] * 4) for x in (mask, known))
    shift = best_shift(drawn.float(), mask, known, edge, config.seen)
    if shift is None:
        return None
    middle = _middle(drawn.float()) - edge - camera.K[:2, 2].to(mask) * shrink
    lines = drawn.any(1).nonzero()[:, 0]
    height = (lines[-1] - lines[0] + 1).to(mask)
    return torch.cat([middle, middle + shift, height[None]]) / shrink


def best_shift(
    drawn: Float[Tensor, "h w"],
    mask: Float[Tensor, "h w"],
    known: Float[Tensor, "h w"],
    most: int,
    least: float,
) -> Float[Tensor, "2"] | None:
    """By how much a picture has to move to overlap best with a mask, x before y [px].

    All three have a margin of `most` pixels in which nothing is known.

    Returns:
        None if the best overlap of the known pixels, or the share of the picture that the mask
        then fills, is below `least`, or where the best shift is the largest one.
    """
    shape, mask = (drawn.shape[-2], drawn.shape[-1]), mask * known
    spectrum = torch.fft.rfft2(drawn).conj()
    both, inside = (
        torch.fft.irfft2(spectrum * torch.fft.rfft2(x), s=shape).roll((most, most), (0, 1))
        for x in (mask, known)
    )
    both, inside = (x[: 2 * most + 1, : 2 * most + 1] for x in (both, inside))
    score = both / (mask.sum() + inside - both).clamp_min(1)
    best = int(score.argmax())
    y, x = divmod(best, 2 * most + 1)
    filled = float(both[y, x]) / max(1.0, float(drawn.sum()))
    if min(float(score[y, x]), filled) < least or {0, 2 * most} & {x, y}:
        return None
    fine = torch.stack([_peak(score[y, x - 1 : x + 2]), _peak(score[y - 1 : y + 2, x])])
    return fine + torch.tensor([x - most, y - most]).to(fine)


def _peak(values: Float[Tensor, "3"]) -> Float[Tensor, ""]:
    """Where the parabola through three neighbours is highest, from the middle one."""
    low, middle, high = values.unbind()
    return (0.5 * (high - low) / (2 * middle - low - high).clamp_min(1e-9)).clamp(-0.5, 0.5)


def _drawn(inputs: FocalInputs, row: int, shape: torch.Size, edge: int) -> Bool[Tensor, "h w"]:
    """Silhouette of one body in a smaller picture with a margin."""
    camera, (height, width) = inputs.camera, shape
    shrink = torch.tensor([width / camera.width, height / camera.height, 1.0]).diag()
    K = shrink @ camera.K.float()
    K[:2, 2] += edge
    views = Crops(K[None], height + 2 * edge, width + 2 * edge)
    verts = inputs.bodies.verts[row : row + 1].float()
    return layers(verts, inputs.bodies.faces, views).front.isfinite()[0]


def _middle(picture: Float[Tensor, "h w"]) -> Float[Tensor, "2"]:
    """Centre of what is set, x before y [px]."""
    y, x = (torch.arange(n).to(picture) + 0.5 for n in picture.shape)
    mass = picture.sum()
    return torch.stack([(picture.sum(0) * x).sum(), (picture.sum(1) * y).sum()]) / mass


def _sightings(
    inputs: FocalInputs, rows: Int[Tensor, " rows"], places: Float[Tensor, "rows 5"]
) -> Sightings:
    """The evidence, with moments of `TOGETHER`; without a frame rate each frame is one."""
    bodies = inputs.bodies
    frame = bodies.frame[rows].cpu()
    moment = frame if bodies.fps is None else (frame / (bodies.fps * TOGETHER)).floor().long()
    return Sightings(places[:, :2], places[:, 2:4], places[:, 4], bodies.person[rows].cpu(), moment)
