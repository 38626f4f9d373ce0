"""Correct the depth of people whose size is right: too near is too large for their mask.

Not in the paper. Bodies estimated frame by frame keep their size while one person is 2 % too near
or too far throughout; the floor under the feet, and the whole room with it, is then wrong by 1-2
cm. One factor a person moves the body along its pelvis' ray: the mean of that at which it fills
its visible masks best, each with the border that suits it, and that at which it is as high in the
image as they are (`compare_extents`), by their certainty. An error of the pose makes the first too
great (smaller bodies overlap better) and the second too small (bent bodies are lower): both are
corrected for it (`peak_of`), since one of them is often missing.

Masks do not show a wrong size at a wrong depth. A known height does: then the person is first
scaled about the camera, which no picture sees.
"""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.bodies.corrected import has_mean_shape, larger, statures
from mover.bodies.parts import BodyParts
from mover.core.devices import lstsq
from mover.core.observe import Observer, Step, silent
from mover.core.records import record
from mover.core.types import Bodies, Camera, People
from mover.geometry.camera import project
from mover.geometry.raster import Crops, fronts
from mover.geometry.warp_start import mapped
from mover.stages.camera.find_foot_contacts import straight_legs
from mover.stages.config import DepthConfig
from mover.stages.contacts.assign_contacts import evenly, in_turns
from mover.stages.cover import Cover, covered
from mover.stages.masks import (
    Extents,
    MaskTable,
    compare_extents,
    mask_table,
    overlaps,
    small,
    uncovered,
)

# Errors of the pose bias both factors as far as bodies cannot be made to fill their masks: the
# misfit, one minus the best overlap. Learnt on known rooms: overlaps put people too far, by 1 %
# from a misfit of 0.3 on; heights, as bent bodies are lower, too near by 1 % there and more beyond.

SYSTEMATIC = 0.003  # error of the factor that more frames do not make smaller

COMMON = 0.006  # of a factor whose bias is corrected: what is left of it, and differs by person
FREE, FULL = 0.05, 0.3  # misfits from which on overlaps are biased, and are so no more than there
FAR = 0.04  # of the factor by overlaps, for a misfit
BENT, NEAR = 0.15, 0.07  # misfit from which on heights are biased, and how much


@dataclass(frozen=True)
class Peak:
    """What overlaps, or overlaps and heights, say of a person's depth."""

    factor: float
    """True depth over the given one."""
    spread: float
    """Standard deviation of `factor`; inf where nothing is known."""
    misfit: float
    """One minus the best mean overlap of bodies and masks; `FULL` where none was compared."""
    warnings: tuple[str, ...] = ()
    """Why the factor may not be used."""


def peak_of(curves: Float[Tensor, "used factors"], config: DepthConfig) -> Peak:
    """Best factor by a parabola, its spread, and why it may not be used."""
    factors = curves.shape[1]
    if len(curves) < config.least:
        return _unknown(f"{len(curves)} of at least {config.least} bodies are seen well enough")
    total = curves.double().mean(0)
    best, reach = int(total.argmax()), max(2, factors // 6)
    low, high = max(0, best - reach), min(factors, best + reach + 1)
    grid = torch.linspace(-config.span, config.span, factors).double()
    x = grid[low:high] - grid[best]
    design = torch.stack([x.square(), x, torch.ones_like(x)], -1)
    bend, slope, _ = lstsq(design, total[low:high]).tolist()
    if bend >= 0 or best in (0, factors - 1):
        return _unknown(f"more than {100 * config.span:.0f} % wrong or unclear")
    factor = 1 + float(grid[best]) - slope / (2 * bend)
    each = lstsq(design, curves.double()[:, low:high].mT)
    lean = each[1] + 2 * each[0] * (factor - 1 - float(grid[best]))
    error = float(lean.std()) / len(curves) ** 0.5 / abs(2 * bend)
    spread = (error**2 + SYSTEMATIC**2) ** 0.5
    if spread > config.spread:
        return _unknown(f"uncertain by {100 * spread:.1f} %")
    misfit = 1 - float(total.max())
    farther = FAR * max(0.0, min(misfit, FULL) - FREE)
    return Peak(factor - farther, spread, misfit)


def _unknown(why: str) -> Peak:
    return Peak(1.0, float("inf"), FULL, (f"{why}, it stays as given",))


RIGHT = 0.003  # a body whose size is off by less has the known height
LIKELY_SIZE = (0.8, 1.25)  # a body whose size is off by more is a mistake in the height


@record
class DepthInputs:
    """People in camera axes, and where they are seen."""

    bodies: Bodies
    parts: BodyParts
    keep: Bool[Tensor, " bodies"]
    """Which rows are sound, from `select_frames`."""
    people: People
    objects: Cover
    """All objects: what they cover may hide a person."""
    camera: Camera


@record
class DepthFactors:
    """By how much each person is too near."""

    person: Int[Tensor, " people"]
    """Tracks."""
    factor: Float[Tensor, " people"]
    """True depth of the pelvis over the given one; 1 where nothing is known."""
    spread: Float[Tensor, " people"]
    """Standard deviation of `factor`; inf where nothing is known."""
    size: Float[Tensor, " people"]
    """True size over the given one, from a known height; 1 where none is known."""
    warnings: tuple[str, ...]


def find_depth(
    inputs: DepthInputs, config: DepthConfig = DepthConfig(), observe: Observer = silent
) -> DepthFactors:
    """Compare every person's silhouettes at several depths with the visible masks."""
    bodies, warnings = inputs.bodies, []
    tracks = bodies.person.unique().tolist()
    found = torch.ones(3, len(tracks))
    table = mask_table(inputs.people, bodies)
    blocked = covered(inputs.objects)
    made_small = cache(lambda mask: uncovered(mask, config.width))  # one for a still camera

    def free(frame: int) -> Tensor:
        return made_small(blocked(frame))

    for index, person in enumerate(tracks):  # each has its own frames
        rows = ((bodies.person == person) & inputs.keep).nonzero()[:, 0]
        size, note = _size(inputs, rows, str(person))
        rows = rows[torch.tensor([table.own[r] is not None for r in rows.tolist()]).bool()]
        peak = peak_of(_curves(inputs, config, rows, table, free), config)
        some = evenly(rows, config.whole)
        heights = compare_extents(bodies, some, inputs.camera, table, blocked)
        peak = _with_heights(peak, heights, config)
        found[:, index] = torch.tensor([peak.factor, peak.spread, size])
        warnings += note + [f"depth of person {person}: {w}" for w in peak.warnings]
        observe(Step("find_depth", index, len(tracks)))
    factor, spread, size = found.to(bodies.verts)
    person = torch.tensor(tracks, dtype=torch.long)
    return DepthFactors(person, factor, spread, size, tuple(warnings))


def apply_depth(bodies: Bodies, factors: DepthFactors) -> Bodies:
    """Move people to their true depth: scaled about the camera, then along the pelvis' ray."""
    same = (bodies.person[:, None] == factors.person.to(bodies.person)).to(bodies.verts)
    both = factors.factor, factors.size  # people without a factor keep their position
    factor, size = (1 + same @ (x.to(bodies.verts) - 1) for x in both)
    bodies = larger(bodies, size) if bool((size != 1).any()) else bodies
    return shifted(bodies, (factor - 1)[:, None] * pelvis(bodies))


def shifted(bodies: Bodies, shift: Float[Tensor, "bodies 3"]) -> Bodies:
    """Each body moved by its own vector [m]."""
    joints, pose, by = bodies.joints, bodies.pose, shift[:, None]
    if pose is not None:
        pose = dataclasses.replace(pose, transl=pose.transl + shift.to(pose.transl))
    joints = None if joints is None else joints + by
    return dataclasses.replace(bodies, verts=bodies.verts + by, joints=joints, pose=pose)


def are_shapeless(bodies: Bodies) -> bool:
    """Whether all bodies have the mean shape of their model, as far as it is known."""
    return bodies.mean_shape or (bodies.pose is not None and has_mean_shape(bodies.pose))


def size_spread(bodies: Bodies, shapeless: float) -> float:
    """How far off all sizes may be together (of the logarithm); 0: they are trusted.

    Args:
        bodies: With what their maker says of it.
        shapeless: The same of bodies of the mean shape; 0: all are trusted.
    """
    if shapeless and bodies.size_spread is not None:
        return bodies.size_spread
    return shapeless if are_shapeless(bodies) else 0.0


def nearer(bodies: Bodies, camera: Camera, ground: float, factor: float) -> Bodies:
    """People moved as if the whole room were larger by a factor: the floor below them is.

    They keep their size and stand as high above the floor, whose height is the one before.
    """
    R = camera.R_cam_world.to(bodies.verts)
    below = pelvis(bodies) @ R
    below = torch.stack([below[:, 0], torch.full_like(below[:, 1], ground), below[:, 2]], -1)
    return shifted(bodies, (factor - 1) * (below @ R.mT))


def pelvis(bodies: Bodies) -> Float[Tensor, "bodies 3"]:
    """The pelvis, or the middle of the vertices where no joint has that name [m]."""
    if bodies.joints is not None and "pelvis" in bodies.joint_names:
        return bodies.joints[:, bodies.joint_names.index("pelvis")]
    return bodies.verts.mean(1)


def _with_heights(peak: Peak, found: Extents | None, config: DepthConfig) -> Peak:
    """The mean of both factors by their certainty; the one that there is if the other is missing.

    Heights are too low where bodies do not fit their masks: they count as so much higher.
    """
    used = [(peak.factor, peak.spread)] if peak.spread <= config.spread else []
    if found is not None and found.frames >= config.least and abs(found.factor - 1) <= config.span:
        spread = (found.spread**2 + SYSTEMATIC**2) ** 0.5
        if spread <= config.spread:
            used.append((found.factor + NEAR * max(0.0, peak.misfit - BENT), spread))
    if not used:
        return peak
    weights = [1 / (spread**2 + COMMON**2) for _, spread in used]
    mean = sum(w * factor for w, (factor, _) in zip(weights, used, strict=True)) / sum(weights)
    return Peak(mean, sum(weights) ** -0.5, peak.misfit)


def _size(inputs: DepthInputs, rows: Int[Tensor, " rows"], person: str) -> tuple[float, list[str]]:
    """Known height over that of the body's shape, or of a mesh where it stands upright."""
    bodies, known = inputs.bodies, inputs.people.heights.get(person)
    if known is None:
        return 1.0, []
    of_shapes = None if bodies.pose is None else statures(bodies.pose)
    if of_shapes is not None:
        heights = of_shapes[rows]
    else:
        up = inputs.camera.R_cam_world[:, 1].to(bodies.verts)
        rows = rows[straight_legs(bodies, inputs.parts, up).all(1)[rows]]
        along = bodies.verts[rows] @ up
        heights = along.amax(1) - along.amin(1)
    if not len(rows):
        return 1.0, [f"person {person} never stands straight: the known height is not used"]
    tall = float(heights.quantile(0.9))
    size = known / tall
    if not LIKELY_SIZE[0] < size < LIKELY_SIZE[1]:
        return 1.0, [f"person {person} is {tall:.2f} m tall, not {known:.2f} m: height not used"]
    note = f"person {person} is {tall:.2f} m tall and is scaled to {known:.2f} m"
    return size, [note] if abs(size - 1) > RIGHT else []


def _curves(
    inputs: DepthInputs,
    config: DepthConfig,
    rows: Int[Tensor, " rows"],
    table: MaskTable,
    free_in: Callable[[int], Bool[Tensor, "h w"]],
) -> Float[Tensor, "used factors"]:
    """Overlap of silhouette and mask over the factors, for each body that is seen well."""
    factors = torch.linspace(1 - config.span, 1 + config.span, config.factors)

    def curve(row: int) -> Tensor | None:
        own, others = table.decode(row)
        free = free_in(int(inputs.bodies.frame[row]))
        known = free & uncovered(others, config.width) if table.others[row] else free
        mask = small(own, config.width)
        middle = _drawn(inputs, row, free, torch.ones(1))[0]
        seen = mask[middle & known].sum() / (middle & known).sum().clamp_min(1)
        open_share = (middle & known).sum() / middle.sum().clamp_min(1)
        if min(float(seen), float(open_share)) < config.seen:
            return None
        return overlaps(_drawn(inputs, row, free, factors), mask, known)

    pixels = project(inputs.bodies.verts[rows], inputs.camera.K.to(inputs.bodies.verts))
    size = pixels.new_tensor([inputs.camera.width, inputs.camera.height])
    inside = ((pixels > 0) & (pixels < size)).all(-1).float().mean(1) >= config.inside
    tried = evenly(rows[inside], config.whole)
    first = evenly(tried, config.most)
    others = tried[~torch.isin(tried, first)]  # stand in for bodies that are hidden
    asked = torch.cat([first, others[in_turns(len(others))]]).tolist()
    curves: list[Tensor] = []
    while asked and len(curves) < config.most:  # no more than may be needed
        left = config.most - len(curves)
        curves += [found for found in mapped(curve, asked[:left]) if found is not None]
        asked = asked[left:]
    return torch.stack(curves) if curves else torch.zeros(0, config.factors)


def _drawn(
    inputs: DepthInputs, row: int, like: Bool[Tensor, "h w"], factors: Float[Tensor, " factors"]
) -> Bool[Tensor, "factors h w"]:
    """Silhouettes of one body at some depths."""
    bodies, camera = inputs.bodies, inputs.camera
    shift = (factors.to(bodies.verts) - 1)[:, None] * pelvis(bodies)[row]
    height, width = like.shape
    shrink = torch.tensor([width / camera.width, height / camera.height, 1.0]).diag()
    K = (shrink @ camera.K.float()).expand(len(factors), 3, 3)
    verts = bodies.verts[row] + shift[:, None]
    return fronts(verts.float(), bodies.faces, Crops(K, height, width)).isfinite()
