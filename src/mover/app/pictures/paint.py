"""Surfaces become a sheet of shaded, outlined pixels that lies over any picture."""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d, normalize

from mover.app.pictures.eye import RenderCamera, finer, part_of, seen_from
from mover.core.colours import colour, person_colour
from mover.core.records import record
from mover.core.types import Bodies, Scene
from mover.geometry.mesh import vertex_normals
from mover.geometry.placement import place_object
from mover.geometry.raster import first_hit

FINE = 2  # drawn at twice the size and averaged: smooth edges
LIGHT = (0.35, 0.85, 0.40)  # from where a lamp shines, in the world
NOBODY = -1  # owner of a pixel that shows no surface
PERSON = 100_000  # owner of person 0; the furniture is counted from 0
SHARP = 0.85  # cosine between two surfaces whose edge is drawn
LINE, CREASE = 0.75, 0.25  # how opaque outlines and inner edges are


@record
class Surfaces:
    """Triangles in the world, each with a colour and somebody that it belongs to."""

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
    """As in `Surfaces`; `NOBODY` for nothing."""
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
        parts.append(_coloured(verts, faces, _face_normals(verts, faces), colour(index), index))
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
        return Drawn(none[..., 0] + torch.inf, none[..., 0].long() + NOBODY, none, none)
    depth, face = first_hit(points, surfaces.faces, eye.K, size)
    hit, index = (face >= 0)[..., None], face.clamp_min(0)
    middle = surfaces.verts[surfaces.faces].mean(1)
    away = ((middle - eye.t_world_eye) * surfaces.normals).sum(-1, keepdim=True) > 0
    normals = torch.where(away, -surfaces.normals, surfaces.normals)
    owner = torch.where(hit[..., 0], surfaces.owner[index], torch.full_like(index, NOBODY))
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
    rows, columns = slice(top, bottom), slice(left, right)
    return Drawn(
        drawn.depth[rows, columns], drawn.owner[rows, columns], drawn.normal[rows, columns],
        drawn.tint[rows, columns],
    )  # fmt: skip


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
    seen = (drawn.owner != NOBODY).float()
    alpha = torch.maximum(ink.opacity * seen, LINE * outline.float())[..., None]
    fine = torch.cat([colours * alpha, alpha], -1)
    return avg_pool2d(fine.permute(2, 0, 1), FINE).permute(1, 2, 0)


def fine_eye(eye: RenderCamera) -> RenderCamera:
    """The eye whose pictures `paint` shrinks."""
    return finer(eye, FINE)


def fine_part(eye: RenderCamera, window: tuple[int, int, int, int]) -> RenderCamera:
    """The fine eye of a window (left, top, right, bottom) of the coarse picture [px]."""
    left, top, right, bottom = (FINE * edge for edge in window)
    return part_of(fine_eye(eye), left, top, right, bottom)


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


def _face_normals(verts: Tensor, faces: Tensor) -> Float[Tensor, "faces 3"]:
    a, b, c = verts[faces].unbind(1)
    return normalize(torch.linalg.cross(b - a, c - a), dim=-1)


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
        stiff = (here != NOBODY) & (here < PERSON)
        crease.narrow(axis, 0, n).logical_or_(bent & ~border & stiff)
    wide = max_pool2d(outline[None, None].float(), 2 * thickness - 1, 1, thickness - 1)[0, 0] > 0
    return wide & (drawn.owner != NOBODY), crease
