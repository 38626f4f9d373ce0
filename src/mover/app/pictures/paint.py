"""Surfaces become a sheet of shaded, outlined pixels over any picture; below them lies a floor."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample, max_pool2d, normalize

from mover.app.pictures.eye import RenderCamera, floor_seen, seen_from
from mover.core.colours import colour, person_colour
from mover.core.records import map_tensors, record
from mover.core.types import Bodies, Scene
from mover.geometry.mesh import face_normals, vertex_normals
from mover.geometry.placement import place_object
from mover.geometry.raster import first_hit

FINE = 2  # drawn at twice the size and averaged: smooth edges
LIGHT = (0.35, 0.85, 0.40)  # from where a lamp shines, in the world
NO_OWNER = -1  # owner of a pixel that shows no surface
PERSON = 100_000  # owner of person 0; the furniture is counted from 0
SHARP = 0.85  # cosine between two surfaces whose edge is drawn
LINE, CREASE = 0.75, 0.25  # how opaque outlines and inner edges are


@record
class Surfaces:
    """Triangles in the world, each with a colour and the index of its owner."""

    verts: Float[Tensor, "verts 3"]
    """[m]"""
    faces: Int[Tensor, "faces 3"]
    normals: Float[Tensor, "faces 3"]
    """Unit vectors; of smooth skin the mean of the normals at the corners."""
    tint: Float[Tensor, "faces 3"]
    """In [0, 1]."""
    owner: Int[Tensor, " faces"]
    """Index of the object, or `PERSON` and the number of the track."""


@record
class Drawn:
    """What each pixel of an eye shows."""

    depth: Float[Tensor, "h w"]
    """Along the eye's axis [m], inf for nothing."""
    owner: Int[Tensor, "h w"]
    """As in `Surfaces`; `NO_OWNER` for nothing."""
    normal: Float[Tensor, "h w 3"]
    """Of the surface in the world, towards the eye."""
    tint: Float[Tensor, "h w 3"]


@record
class Ink:
    """How surfaces are drawn."""

    opacity: float
    """In [0, 1]; outlines are always seen."""
    thickness: int
    """Of outlines, in fine pixels."""
    ambient: float = 0.50
    """Brightness where no lamp shines."""
    lamp: float = 0.42
    """What the lamp adds at most."""
    fill: tuple[float, float, float] = (0.0, 0.16, 0.0)
    """A weak light from this direction in the world: its length is what it adds and takes."""


def furniture(scene: Scene) -> Surfaces:
    """All objects of a scene, in the colours of the report."""
    parts: list[Surfaces] = []
    for index, piece in enumerate(scene.objects):
        mesh = place_object(piece)
        verts, faces = mesh.verts.detach().float(), mesh.faces.long()
        parts.append(_coloured(verts, faces, face_normals(verts, faces), colour(index), index))
    return joined(parts)


def people(bodies: Bodies, rows: list[int]) -> Surfaces:
    """Some rows of the bodies, which are in the world."""
    return joined([skin(bodies.verts[row], bodies.faces, int(bodies.person[row])) for row in rows])


def skin(verts: Float[Tensor, "verts 3"], faces: Int[Tensor, "faces 3"], person: int) -> Surfaces:
    """One body, smooth, in the colour of a person."""
    verts, faces = verts.detach().float(), faces.long()
    normals = normalize(vertex_normals(verts, faces)[faces].sum(1), dim=-1)
    return _coloured(verts, faces, normals, person_colour(person), PERSON + person)


def joined(parts: list[Surfaces]) -> Surfaces:
    """Several surfaces as one."""
    if not parts:
        none = torch.zeros(0, 3)
        return Surfaces(none, none.long(), none, none, torch.zeros(0).long())
    starts = torch.tensor([0, *[len(p.verts) for p in parts]]).cumsum(0).tolist()
    return Surfaces(
        torch.cat([p.verts for p in parts]),
        torch.cat([p.faces + start for p, start in zip(parts, starts, strict=False)]),
        torch.cat([p.normals for p in parts]),
        torch.cat([p.tint for p in parts]),
        torch.cat([p.owner for p in parts]),
    )


def draw(surfaces: Surfaces, eye: RenderCamera) -> Drawn:
    """What the eye sees of the surfaces, whatever their winding."""
    size = (eye.height, eye.width)
    points = seen_from(eye, surfaces.verts)
    if not len(surfaces.faces):
        none = torch.zeros(*size, 3)
        return Drawn(none[..., 0] + torch.inf, none[..., 0].long() + NO_OWNER, none, none)
    depth, face = first_hit(points, surfaces.faces, eye.K, size)
    hit, index = (face >= 0)[..., None], face.clamp_min(0)
    middle = surfaces.verts[surfaces.faces].mean(1)
    away = ((middle - eye.t_world_eye) * surfaces.normals).sum(-1, keepdim=True) > 0
    normals = torch.where(away, -surfaces.normals, surfaces.normals)
    owner = torch.where(hit[..., 0], surfaces.owner[index], torch.full_like(index, NO_OWNER))
    return Drawn(depth, owner, normals[index] * hit, surfaces.tint[index] * hit)


def nearer(a: Drawn, b: Drawn) -> Drawn:
    """At each pixel the one of the two that is in front."""
    first = a.depth <= b.depth
    return Drawn(
        torch.where(first, a.depth, b.depth),
        torch.where(first, a.owner, b.owner),
        torch.where(first[..., None], a.normal, b.normal),
        torch.where(first[..., None], a.tint, b.tint),
    )


def cut(drawn: Drawn, left: int, top: int, right: int, bottom: int) -> Drawn:
    """A window of it [px]."""
    return map_tensors(lambda pixels: pixels[top:bottom, left:right], drawn)


def paint(drawn: Drawn, ink: Ink) -> Float[Tensor, "height width 4"]:
    """A sheet at 1 / `FINE` of the size: colour times opacity, and opacity.

    Args:
        drawn: With `FINE` pixels along each side of a pixel of the sheet.
        ink: How opaque surfaces are and how thick lines are.
    """
    lamp = normalize(torch.tensor(LIGHT), dim=0)
    shade = ink.ambient + ink.lamp * (drawn.normal @ lamp).clamp_min(0)
    shade = shade + drawn.normal @ torch.tensor(ink.fill)
    colours = (drawn.tint * shade[..., None]).clamp(0, 1)
    outline, crease = _lines(drawn, ink.thickness)
    colours = colours.lerp(drawn.tint * 0.40, CREASE * crease[..., None].float())
    colours = colours.lerp(drawn.tint * 0.40, LINE * outline[..., None].float())
    seen = (drawn.owner != NO_OWNER).float()
    alpha = torch.maximum(ink.opacity * seen, LINE * outline.float())[..., None]
    fine = torch.cat([colours * alpha, alpha], -1)
    return avg_pool2d(fine.permute(2, 0, 1), FINE).permute(1, 2, 0)


def fine_eye(eye: RenderCamera) -> RenderCamera:
    """The eye whose pictures `paint` shrinks."""
    K = eye.K * torch.tensor([FINE, FINE, 1.0])[:, None]
    size = (FINE * eye.width, FINE * eye.height)
    return RenderCamera(K, eye.R_eye_world, eye.t_world_eye, *size)


def over(
    sheet: Float[Tensor, "h w 4"], picture: Float[Tensor, "h w channels"]
) -> Float[Tensor, "h w channels"]:
    """A sheet on a picture (3 channels) or on another sheet (4 channels)."""
    return sheet[..., : picture.shape[-1]] + (1 - sheet[..., 3:]) * picture


def _coloured(
    verts: Tensor, faces: Tensor, normals: Tensor, tint: tuple[float, float, float], owner: int
) -> Surfaces:
    count = len(faces)
    return Surfaces(
        verts, faces, normals, torch.tensor(tint).expand(count, 3), torch.full((count,), owner)
    )


def _lines(drawn: Drawn, thickness: int) -> tuple[Bool[Tensor, "h w"], Bool[Tensor, "h w"]]:
    """Pixels beside another owner, and those beside a crease of their own object."""
    outline, crease = torch.zeros_like(drawn.owner).bool(), torch.zeros_like(drawn.owner).bool()
    for axis in (0, 1):
        n = drawn.owner.shape[axis] - 1
        here, there = drawn.owner.narrow(axis, 0, n), drawn.owner.narrow(axis, 1, n)
        bent = (drawn.normal.narrow(axis, 0, n) * drawn.normal.narrow(axis, 1, n)).sum(-1) < SHARP
        border = here != there
        outline.narrow(axis, 0, n).logical_or_(border)
        outline.narrow(axis, 1, n).logical_or_(border)
        stiff = (here != NO_OWNER) & (here < PERSON)
        crease.narrow(axis, 0, n).logical_or_(bent & ~border & stiff)
    wide = max_pool2d(outline[None, None].float(), 2 * thickness - 1, 1, thickness - 1)[0, 0] > 0
    return wide & (drawn.owner != NO_OWNER), crease


CELL = 0.03  # [m], of the map of shadows
MOST = 600  # cells along a side of it at most
BELOW = 60.0  # [m], from where the undersides are seen: nearly in parallel
REACH = 0.35  # [m], height over the floor at which a shadow has faded to 1/e
SOFT = (2, 7)  # cells that a shadow is blurred by: at the contact, around it
DARK = 0.55  # of the darkest shadow
METRE = 0.5  # opacity of the metre lines
EDGE = 1.2  # [m], how far the floor reaches beyond what stands on it
SKY, FLOOR = (0.955, 0.965, 0.98), (0.80, 0.785, 0.76)


@record
class GroundPatch:
    """The height of the floor and the rectangle of it that is drawn."""

    height: float
    """[m]"""
    low: Float[Tensor, "2"]
    """Smallest x and z [m]."""
    high: Float[Tensor, "2"]
    """Largest x and z [m]."""


def ground_under(points: Float[Tensor, "points 3"], height: float) -> GroundPatch:
    """The floor under everything."""
    flat = points[:, [0, 2]]
    return GroundPatch(height, flat.amin(0) - EDGE, flat.amax(0) + EDGE)


def backdrop(eye: RenderCamera, ground: GroundPatch) -> Float[Tensor, "h w 3"]:
    """A plain room: a floor that ends softly, and light around it."""
    spread = torch.linspace(1.0, 0.93, eye.height)[:, None, None]
    sky = (torch.tensor(SKY) * spread).expand(eye.height, eye.width, 3)
    points = floor_seen(eye, ground.height)[..., [0, 2]]
    return sky.lerp(torch.tensor(FLOOR), 0.75 * _inside(points, ground)[..., None])


def metre_lines(
    eye: RenderCamera, ground: GroundPatch, brightness: float
) -> Float[Tensor, "h w 4"]:
    """A sheet with lines at whole metres of the world, of one brightness in [0, 1]."""
    points = floor_seen(eye, ground.height)[..., [0, 2]]
    points = torch.where(points.isfinite(), points, 1e6)
    steps = [torch.gradient(points, dim=d)[0].abs() for d in (0, 1)]
    spread = torch.maximum(*steps).clamp_min(1e-6)
    near = ((points - points.round()).abs() / spread).amin(-1)
    coarse = (1 - spread.amax(-1) * 4).clamp(0, 1)
    alpha = METRE * (1.2 - near).clamp(0, 1) * coarse * _inside(points, ground)
    return torch.cat([(brightness * alpha)[..., None].expand(-1, -1, 3), alpha[..., None]], -1)


def shadows(eye: RenderCamera, ground: GroundPatch, surfaces: Surfaces) -> Float[Tensor, "h w 4"]:
    """A black sheet: dark where an underside is near the floor."""
    sheet = torch.zeros(eye.height, eye.width, 4)
    if not len(surfaces.faces):
        return sheet
    flat = surfaces.verts[:, [0, 2]]
    low, high = flat.amin(0) - 0.4, flat.amax(0) + 0.4
    darkness = _shadow_map(surfaces, ground.height, low, high)
    points = floor_seen(eye, ground.height)[..., [0, 2]]
    where = ((points - low) / (high - low) * 2 - 1).nan_to_num(9.0, 9.0, -9.0).clamp(-9, 9)
    sheet[..., 3] = grid_sample(
        darkness[None, None], where[None], align_corners=False, padding_mode="zeros"
    )[0, 0]
    return sheet


def _shadow_map(
    surfaces: Surfaces, floor: float, low: Tensor, high: Tensor
) -> Float[Tensor, "rows columns"]:
    """Darkness of the floor between two corners, x along the columns and z along the rows."""
    cell = max(CELL, float((high - low).max()) / MOST)
    columns, rows = ((high - low) / cell).ceil().int().tolist()
    scale = torch.tensor([columns, rows]) / (high - low)
    x, y, z = surfaces.verts.unbind(-1)
    depth = BELOW + (y - floor).clamp_min(0)
    middle = (low + high) / 2
    straight = torch.stack([(x - middle[0]) * depth, (z - middle[1]) * depth, depth], -1)
    K = torch.tensor([[scale[0], 0, columns / 2], [0, scale[1], rows / 2], [0, 0, 1]])
    seen, face = first_hit(straight, surfaces.faces, K, (rows, columns))
    dark = torch.where(face >= 0, (-(seen - BELOW) / REACH).exp(), 0.0)[None, None]
    near, wide = (avg_pool2d(avg_pool2d(dark, 2 * r + 1, 1, r), 2 * r + 1, 1, r) for r in SOFT)
    return (DARK * (0.6 * near + 0.4 * wide))[0, 0]


def _inside(points: Float[Tensor, "h w 2"], ground: GroundPatch) -> Float[Tensor, "h w"]:
    """1 on the shown part of the floor, fading to 0 at its border."""
    gap = torch.minimum(points - ground.low, ground.high - points).amin(-1)
    return (gap.nan_to_num(-1.0, -1.0, -1.0) / EDGE).clamp(0, 1)
