r"""Correct the depth of people whose size is right: too near is too large for their mask.

Not in the paper. Bodies estimated frame by frame keep their size while one person is 2 % too near
or too far throughout; the floor under the feet, and the whole room with it, is then wrong by
1-2 cm. One factor a person moves the body along its pelvis' ray so that it fills its visible masks
best; the width of the mask's border is found with it, in every frame.

What masks cannot tell is a wrong size at a wrong depth. Only a known height does: then the person
is first scaled about the camera, which no picture sees.
"""

import dataclasses
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..bodies.parts import Parts
from ..geometry.camera import project
from ..geometry.raster import Views, layers
from ..geometry.runs import decode
from ..minimize import Observer, Step, silent
from ..records import record
from ..types import Bodies, Camera, Masks, People
from .find_soles import SolesConfig, straight_legs
from .mask_overlap import overlaps, small
from .person_masks import MaskTable, mask_table

SYSTEMATIC = 0.003  # error of the factor that more frames do not make smaller
LIKELY_SIZE = (0.8, 1.25)  # a body whose size is off by more is a mistake in the height


@record
class DepthInputs:
    """People in camera axes, and where they are seen."""

    bodies: Bodies
    parts: Parts
    keep: Bool[Tensor, " bodies"]
    """Which rows are sound, from `select_frames`."""
    people: People
    objects: Masks
    """Masks of all objects in the reference image: what they cover may hide a person."""
    camera: Camera


@dataclass(frozen=True)
class DepthConfig:
    """How the depth of people is searched for."""

    span: float = 0.09
    """Factors from 1 - span to 1 + span are tried."""
    factors: int = 13
    """How many."""
    every: int = 3
    """Use every so many of a person's frames ..."""
    most: int = 40
    """... and at most so many, spread over the video."""
    least: int = 5
    """Fewer frames than that tell nothing."""
    width: int = 240
    """Width of the pictures that are compared [px]."""
    seen: float = 0.7
    """Share of a body's picture that its mask has to fill, and that no object may cover."""
    inside: float = 0.97
    """Share of the body that has to be inside the image."""
    spread: float = 0.02
    """A factor less certain than that is not used."""


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
    found = torch.ones(3, len(tracks)) * torch.tensor([[1.0], [torch.inf], [1.0]])
    table = mask_table(inputs.people, bodies)
    free = _free_of_objects(inputs, config)
    for index, person in enumerate(tracks):  # each has its own frames
        rows = ((bodies.person == person) & inputs.keep).nonzero()[:, 0]
        size, note = _size(inputs, rows, str(person))
        rows = rows[torch.tensor([table.own[r] is not None for r in rows.tolist()]).bool()]
        curves = _curves(inputs, config, rows, table, free)
        *peak, weak = _peak(curves, config)
        found[:, index] = torch.tensor([*peak, size])
        warnings += note + [f"depth of person {person}: {w}" for w in weak]
        observe(Step("find_depth", index, len(tracks)))
    factor, spread, size = found.to(bodies.verts)
    person = torch.tensor(tracks, dtype=torch.long)
    return DepthFactors(person, factor, spread, size, tuple(warnings))


def apply_depth(bodies: Bodies, factors: DepthFactors) -> Bodies:
    """Move people to their true depth: scaled about the camera, then along the pelvis' ray.

    A changed size is beyond the pose's parameters, so they are dropped: the bodies stay meshes.
    """
    same = (bodies.person[:, None] == factors.person.to(bodies.person)).to(bodies.verts)
    factor, size = (
        1 + same @ (x.to(bodies.verts) - 1) for x in (factors.factor, factors.size)
    )  # people without a factor keep their place
    shift = (factor - 1)[:, None] * pelvis(bodies) * size[:, None]
    verts = bodies.verts * size[:, None, None] + shift[:, None]
    joints, pose = bodies.joints, bodies.pose
    if joints is not None:
        joints = joints * size[:, None, None] + shift[:, None]
    if pose is not None:
        resized = bool((factors.size != 1).any())
        pose = (
            None
            if resized
            else dataclasses.replace(pose, transl=pose.transl + shift.to(pose.transl))
        )
    return dataclasses.replace(bodies, verts=verts, joints=joints, pose=pose)


def pelvis(bodies: Bodies) -> Float[Tensor, "bodies 3"]:
    """The pelvis, or the middle of the vertices where no joint has that name [m]."""
    if bodies.joints is not None and "pelvis" in bodies.joint_names:
        return bodies.joints[:, bodies.joint_names.index("pelvis")]
    return bodies.verts.mean(1)


def _size(inputs: DepthInputs, rows: Int[Tensor, " rows"], person: str) -> tuple[float, list[str]]:
    """Known height over that of the upright body."""
    known = inputs.people.heights.get(person)
    if known is None:
        return 1.0, []
    up = inputs.camera.R_cam_world[:, 1].to(inputs.bodies.verts)
    straight = straight_legs(inputs.bodies, inputs.parts, up, SolesConfig()).all(1)
    standing = rows[straight[rows]]
    if not len(standing):
        return 1.0, [f"person {person} never stands straight: the known height is not used"]
    height = inputs.bodies.verts[standing] @ up
    tall = float((height.amax(1) - height.amin(1)).quantile(0.9))
    size = known / tall
    if not LIKELY_SIZE[0] < size < LIKELY_SIZE[1]:
        return 1.0, [f"person {person} is {tall:.2f} m tall, not {known:.2f} m: height not used"]
    return size, [f"person {person} is {tall:.2f} m tall and is scaled to {known:.2f} m"]


def _free_of_objects(inputs: DepthInputs, config: DepthConfig) -> Bool[Tensor, "h w"]:
    """Pixels of the small picture that no object covers."""
    covered = torch.zeros(inputs.people.masks.height, inputs.people.masks.width, dtype=torch.bool)
    for row in range(len(inputs.objects.counts)):
        covered = covered | decode(inputs.objects, row)
    return small(covered, config.width) < 0.05


def _curves(
    inputs: DepthInputs,
    config: DepthConfig,
    rows: Int[Tensor, " rows"],
    table: MaskTable,
    free: Bool[Tensor, "h w"],
) -> Float[Tensor, "used factors"]:
    """Overlap of silhouette and mask over the factors, for each body that is seen well."""
    curves: list[Tensor] = []
    for row in _spread_out(rows[:: config.every], inputs, config):  # masks are decoded one by one
        own, others = table.decode(row)
        known = free & (small(others, config.width) < 0.05)
        mask, drawn = small(own, config.width), _drawn(inputs, config, row, free)
        middle = drawn[config.factors // 2]
        seen = mask[middle & known].sum() / (middle & known).sum().clamp_min(1)
        open_share = (middle & known).sum() / middle.sum().clamp_min(1)
        if min(float(seen), float(open_share)) < config.seen:
            continue
        curves.append(overlaps(drawn, mask, known))
    return torch.stack(curves) if curves else torch.zeros(0, config.factors)


def _spread_out(rows: Int[Tensor, " rows"], inputs: DepthInputs, config: DepthConfig) -> list[int]:
    """Bodies that are inside the image, so many of them as wanted."""
    camera, verts = inputs.camera, inputs.bodies.verts[rows]
    pixels = project(verts, camera.K.to(verts))
    size = pixels.new_tensor([camera.width, camera.height])
    inside = ((pixels > 0) & (pixels < size)).all(-1).float().mean(1) >= config.inside
    rows = rows[inside]
    if len(rows) > config.most:
        rows = rows[torch.linspace(0, len(rows) - 1, config.most).round().long()]
    return rows.tolist()


def _drawn(
    inputs: DepthInputs, config: DepthConfig, row: int, like: Bool[Tensor, "h w"]
) -> Bool[Tensor, "factors h w"]:
    """Silhouettes of one body at all depths."""
    bodies, camera = inputs.bodies, inputs.camera
    factors = torch.linspace(1 - config.span, 1 + config.span, config.factors).to(bodies.verts)
    shift = (factors - 1)[:, None] * pelvis(bodies)[row]
    height, width = like.shape
    shrink = torch.tensor([width / camera.width, height / camera.height, 1.0]).diag()
    K = (shrink @ camera.K.float()).expand(config.factors, 3, 3)
    verts = bodies.verts[row] + shift[:, None]
    return layers(verts.float(), bodies.faces, Views(K, height, width)).front.isfinite()


def _peak(
    curves: Float[Tensor, "used factors"], config: DepthConfig
) -> tuple[float, float, list[str]]:
    """Best factor by a parabola, its spread, and why it may not be used."""
    unknown = 1.0, float("inf")
    if len(curves) < config.least:
        few = f"only {len(curves)} bodies are seen well enough, it stays as given"
        return *unknown, [few]
    total = curves.double().mean(0)
    best, reach = int(total.argmax()), max(2, config.factors // 6)
    low, high = max(0, best - reach), min(config.factors, best + reach + 1)
    grid = torch.linspace(-config.span, config.span, config.factors).double()
    x = grid[low:high] - grid[best]
    design = torch.stack([x.square(), x, torch.ones_like(x)], -1)
    bend, slope, _ = torch.linalg.lstsq(design, total[low:high]).solution.tolist()
    if bend >= 0 or best in (0, config.factors - 1):
        return *unknown, [
            f"more than {100 * config.span:.0f} % wrong or unclear, it stays as given"
        ]
    factor = 1 + float(grid[best]) - slope / (2 * bend)
    each = torch.linalg.lstsq(design, curves.double()[:, low:high].mT).solution
    lean = each[1] + 2 * each[0] * (factor - 1 - float(grid[best]))
    error = float(lean.std()) / len(curves) ** 0.5 / abs(2 * bend)
    spread = (error**2 + SYSTEMATIC**2) ** 0.5
    if spread > config.spread:
        return *unknown, [f"uncertain by {100 * spread:.1f} %, it stays as given"]
    return factor, spread, []
