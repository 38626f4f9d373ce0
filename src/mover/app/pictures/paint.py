"""Surfaces become shaded, outlined pixels over a picture, or over a plain floor with shadows.

A sheet is a picture of four channels: colour times opacity, and opacity.
"""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample, max_pool2d, normalize

from mover.app.pictures.eye import RenderCamera, floor_points, in_eye
from mover.core.colours import colour, person_colour
from mover.core.records import record
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
THICK = 550  # [px] of width for each fine pixel of an outline's thickness
OPACITY = 0.62  # of surfaces over a picture
FAINT = 0.6  # of the floor's lines over a picture
CELL = 0.03  # [m], of the map of shadows
MOST = 600  # cells along a side of it at most
BELOW = 60.0  # [m], from where the undersides are drawn: nearly in parallel
REACH = 0.35  # [m], height over the floor at which a shadow has faded to 1/e
SOFT = (2, 7)  # cells that a shadow is blurred by: at the contact, around it
DARK = 0.55  # of the darkest shadow
METRE = 0.5  # opacity of the metre lines
EDGE = 1.2  # [m], how far the floor reaches beyond what stands on it
SKY, FLOOR = (0.955, 0.965, 0.98), (0.80, 0.785, 0.76)


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

    owner: Int[Tensor, "h w"]
    """As in `Surfaces`; `NO_OWNER` for nothing."""
    normal: Float[Tensor, "h w 3"]
    """Of the surface in the world, towards the eye."""
    tint: Float[Tensor, "h w 3"]


@record
class GroundPatch:
    """The height of the floor and the rectangle of it that is drawn."""

    height: float
    """[m]"""
    low: Float[Tensor, "2"]
    """Smallest x and z [m]."""
    high: Float[Tensor, "2"]
    """Largest x and z [m]."""


def furniture(scene: Scene) -> Surfaces:
    """All objects of a scene, in the colours of the report."""
    parts: list[Surfaces] = []
    for index, item in enumerate(scene.objects):
        mesh = place_object(item)
        verts, faces = mesh.verts.detach().float(), mesh.faces.long()
        tint = torch.tensor(colour(index)).expand(len(faces), 3)
        owner = torch.full((len(faces),), index)
        parts.append(Surfaces(verts, faces, face_normals(verts, faces), tint, owner))
    return joined(parts)


def people(bodies: Bodies, rows: list[int]) -> Surfaces:
    """Some rows of the bodies, which are in the world."""
    return joined([skin(bodies.verts[row], bodies.faces, int(bodies.person[row])) for row in rows])


def skin(verts: Float[Tensor, "verts 3"], faces: Int[Tensor, "faces 3"], person: int) -> Surfaces:
    """One body, smooth, in the colour of a person."""
    verts, faces = verts.detach().float(), faces.long()
    normals = normalize(vertex_normals(verts, faces)[faces].sum(1), dim=-1)
    tint = torch.tensor(person_colour(person)).expand(len(faces), 3)
    return Surfaces(verts, faces, normals, tint, torch.full((len(faces),), PERSON + person))


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


def draw_picture(
    surfaces: Surfaces,
    eye: RenderCamera,
    ground: GroundPatch | None,
    base: Float[Tensor, "h w 3"] | None = None,
) -> tuple[Float[Tensor, "h w 3"], Drawn]:
    """Surfaces as an eye sees them: translucent over a picture, or solid in a plain room.

    Args:
        surfaces: Furniture and people.
        eye: From where.
        ground: The floor; None: none is drawn.
        base: A picture of the size of the eye's; None: a plain room.

    Returns:
        The picture, and what its pixels show in `FINE` pixels.
    """
    drawn = draw(surfaces, eye.finer(FINE))
    behind = base if base is not None else _sky(eye)
    if ground is not None and base is not None:
        free = avg_pool2d((drawn.owner == NO_OWNER).float()[None], FINE)[0, ..., None]
        behind = over(FAINT * metre_lines(eye, ground, 1.0) * free, behind)
    elif ground is not None:
        points = floor_points(eye, ground.height)[..., [0, 2]]
        floor = behind.lerp(torch.tensor(FLOOR), 0.75 * _inside(points, ground)[..., None])
        behind = over(shadows(eye, ground, surfaces), over(metre_lines(eye, ground, 0.58), floor))
    return over(paint(drawn, base is not None), behind).clamp(0, 1), drawn


def draw(surfaces: Surfaces, eye: RenderCamera) -> Drawn:
    """What the eye sees of the surfaces, whatever their winding."""
    size = (eye.height, eye.width)
    if not len(surfaces.faces):
        none = torch.zeros(*size, 3)
        return Drawn(none[..., 0].long() + NO_OWNER, none, none)
    _, face = first_hit(in_eye(eye, surfaces.verts), surfaces.faces, eye.K, size)
    hit, index = (face >= 0)[..., None], face.clamp_min(0)
    middle = surfaces.verts[surfaces.faces].mean(1)
    away = ((middle - eye.t_world_eye) * surfaces.normals).sum(-1, keepdim=True) > 0
    normals = torch.where(away, -surfaces.normals, surfaces.normals)
    owner = torch.where(hit[..., 0], surfaces.owner[index], torch.full_like(index, NO_OWNER))
    return Drawn(owner, normals[index] * hit, surfaces.tint[index] * hit)


def paint(drawn: Drawn, translucent: bool) -> Float[Tensor, "height width 4"]:
    """A sheet at 1 / `FINE` of the size of what is drawn.

    Args:
        drawn: With `FINE` pixels along each side of a pixel of the sheet.
        translucent: Over a picture: brighter, with a weak light from the video's camera.
    """
    ambient, lamp = (0.62, 0.48) if translucent else (0.50, 0.42)  # without and by the lamp
    fill = torch.tensor([0.0, 0.0, 0.12] if translucent else [0.0, 0.16, 0.0])
    facing = drawn.normal @ normalize(torch.tensor(LIGHT), dim=0)
    shade = ambient + lamp * facing.clamp_min(0) + drawn.normal @ fill
    colours = (drawn.tint * shade[..., None]).clamp(0, 1)
    outline, crease = _lines(drawn, max(1, round(drawn.owner.shape[1] / FINE / THICK)))
    colours = colours.lerp(drawn.tint * 0.40, CREASE * crease[..., None].float())
    colours = colours.lerp(drawn.tint * 0.40, LINE * outline[..., None].float())
    opacity = (OPACITY if translucent else 1.0) * (drawn.owner != NO_OWNER).float()
    alpha = torch.maximum(opacity, LINE * outline.float())[..., None]
    fine = torch.cat([colours * alpha, alpha], -1)
    return avg_pool2d(fine.permute(2, 0, 1), FINE).permute(1, 2, 0)


def over(
    sheet: Float[Tensor, "h w 4"], picture: Float[Tensor, "h w channels"]
) -> Float[Tensor, "h w channels"]:
    """A sheet on a picture (3 channels) or on another sheet (4 channels)."""
    return sheet[..., : picture.shape[-1]] + (1 - sheet[..., 3:]) * picture


def _lines(drawn: Drawn, thickness: int) -> tuple[Bool[Tensor, "h w"], Bool[Tensor, "h w"]]:
    """Pixels beside another owner, and those beside a crease of their own object."""
    outline, crease = torch.zeros_like(drawn.owner).bool(), torch.zeros_like(drawn.owner).bool()
    for axis in (0, 1):
        n = drawn.owner.shape[axis] - 1
        first, second = drawn.owner.narrow(axis, 0, n), drawn.owner.narrow(axis, 1, n)
        bent = (drawn.normal.narrow(axis, 0, n) * drawn.normal.narrow(axis, 1, n)).sum(-1) < SHARP
        border = first != second
        outline.narrow(axis, 0, n).logical_or_(border)
        outline.narrow(axis, 1, n).logical_or_(border)
        stiff = (first != NO_OWNER) & (first < PERSON)
        crease.narrow(axis, 0, n).logical_or_(bent & ~border & stiff)
    wide = max_pool2d(outline[None, None].float(), 2 * thickness - 1, 1, thickness - 1)[0, 0] > 0
    return wide & (drawn.owner != NO_OWNER), crease


def ground_under(points: Float[Tensor, "points 3"], height: float) -> GroundPatch:
    """The floor under everything."""
    flat = points[:, [0, 2]]
    return GroundPatch(height, flat.amin(0) - EDGE, flat.amax(0) + EDGE)


def _sky(eye: RenderCamera) -> Float[Tensor, "h w 3"]:
    spread = torch.linspace(1.0, 0.93, eye.height)[:, None, None]
    return (torch.tensor(SKY) * spread).expand(eye.height, eye.width, 3)


def metre_lines(
    eye: RenderCamera, ground: GroundPatch, brightness: float
) -> Float[Tensor, "h w 4"]:
    """A sheet with lines at whole metres of the world, of one brightness in [0, 1]."""
    points = floor_points(eye, ground.height)[..., [0, 2]]
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
    points = floor_points(eye, ground.height)[..., [0, 2]]
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
    away, face = first_hit(straight, surfaces.faces, K, (rows, columns))
    dark = torch.where(face >= 0, (-(away - BELOW) / REACH).exp(), 0.0)[None, None]
    near, wide = (avg_pool2d(avg_pool2d(dark, 2 * r + 1, 1, r), 2 * r + 1, 1, r) for r in SOFT)
    return (DARK * (0.6 * near + 0.4 * wide))[0, 0]


def _inside(points: Float[Tensor, "h w 2"], ground: GroundPatch) -> Float[Tensor, "h w"]:
    """1 on the shown part of the floor, fading to 0 at its border."""
    gap = torch.minimum(points - ground.low, ground.high - points).amin(-1)
    return (gap.nan_to_num(-1.0, -1.0, -1.0) / EDGE).clamp(0, 1)
