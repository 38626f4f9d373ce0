"""Surfaces in front of a camera become shaded, outlined pixels over a picture.

A sheet is a picture of four channels: colour times opacity, and opacity.
"""

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import avg_pool2d, normalize

from mover.core.colours import colour, person_colour
from mover.core.records import record
from mover.core.types import Bodies, Camera, Scene
from mover.geometry.camera import to_camera
from mover.geometry.mesh import face_normals, vertex_normals
from mover.geometry.placement import place_object
from mover.geometry.raster import first_hit
from mover.stages.masks import widened

FINE = 2  # drawn at twice the size and averaged: smooth edges
LIGHT = (0.35, 0.85, 0.40)  # from where a lamp shines, in the world
NO_OWNER = -1  # owner of a pixel that shows no surface
PERSON = 100_000  # owner of person 0; the furniture is counted from 0
SHARP = 0.85  # cosine between two surfaces whose edge is drawn
LINE, CREASE = 0.75, 0.25  # how opaque outlines and inner edges are
THICK = 550  # [px] of width for each fine pixel of an outline's thickness
OPACITY = 0.62  # of surfaces
AMBIENT, LAMP, FILL = 0.62, 0.48, 0.12  # light of the room, the lamp and the camera
METRE, FAINT = 0.5, 0.6  # opacity of the floor's lines, and their brightness
EDGE = 1.2  # [m], how far the floor reaches beyond what stands on it


@record
class Surfaces:
    """Triangles in the world, each with a colour and the index of its owner."""

    verts: Float[Tensor, "verts 3"]  #: [m]
    faces: Int[Tensor, "faces 3"]
    normals: Float[Tensor, "faces 3"]
    """Unit vectors; of smooth skin the mean of the normals at the corners."""
    tint: Float[Tensor, "faces 3"]  #: in [0, 1]
    owner: Int[Tensor, " faces"]  #: index of the object, or `PERSON` and the number of the track


@record
class Drawn:
    """What each pixel of an eye shows."""

    owner: Int[Tensor, "h w"]  #: as in `Surfaces`; `NO_OWNER` for nothing
    face: Int[Tensor, "h w"]  #: the first one; any for nothing
    normals: Float[Tensor, "faces 3"]
    """Of the surfaces in the world, towards the eye."""
    tint: Float[Tensor, "faces 3"]


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
    """Some rows of the bodies, which are in the world, smooth, in the colours of the people."""
    parts: list[Surfaces] = []
    for row in rows:
        verts, faces = bodies.verts[row].detach().float(), bodies.faces.long()
        person = int(bodies.person[row])
        normals = normalize(vertex_normals(verts, faces)[faces].sum(1), dim=-1)
        tint = torch.tensor(person_colour(person)).expand(len(faces), 3)
        owner = torch.full((len(faces),), PERSON + person)
        parts.append(Surfaces(verts, faces, normals, tint, owner))
    return joined(parts)


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
    surfaces: Surfaces, camera: Camera, base: Float[Tensor, "h w 3"], ground: float | None = None
) -> tuple[Float[Tensor, "h w 3"], Int[Tensor, "fine_h fine_w"]]:
    """Surfaces over a picture `base` of a camera, of any size.

    The lines of the floor are drawn where its height `ground` [m] is known. Also returned are the
    owners of the pixels, `FINE` along each side of one.
    """
    camera = sized_camera(camera, base.shape[1], base.shape[0])
    drawn = draw(surfaces, sized_camera(camera, FINE * camera.width, FINE * camera.height))
    if ground is not None and ground < 0 and len(surfaces.verts):
        free = avg_pool2d((drawn.owner == NO_OWNER).float()[None], FINE)[0, ..., None]
        flat = surfaces.verts[:, [0, 2]]
        lines = metre_lines(camera, ground, flat.amin(0) - EDGE, flat.amax(0) + EDGE)
        base = over(FAINT * lines * free, base)
    return over(paint(drawn), base).clamp(0, 1), drawn.owner


def sized_camera(camera: Camera, width: int, height: int) -> Camera:
    """The same view in pictures of another size [px]."""
    zoom = torch.tensor([width / camera.width, height / camera.height, 1.0])
    K = camera.K.detach().float() * zoom[:, None]
    return Camera(K, camera.R_cam_world.detach().float(), width, height)


def draw(surfaces: Surfaces, camera: Camera) -> Drawn:
    """What the camera sees of the surfaces, whatever their winding."""
    size = (camera.height, camera.width)
    if not len(surfaces.faces):
        none = torch.zeros(size, dtype=torch.long)
        return Drawn(none + NO_OWNER, none, torch.zeros(1, 3), torch.zeros(1, 3))
    points = to_camera(surfaces.verts, camera.R_cam_world)
    face = first_hit(points, surfaces.faces, camera.K, size)[1]
    owner = torch.where(face >= 0, surfaces.owner[face.clamp_min(0)], NO_OWNER)
    away = (surfaces.verts[surfaces.faces].mean(1) * surfaces.normals).sum(-1, keepdim=True) > 0
    normals = torch.where(away, -surfaces.normals, surfaces.normals)
    return Drawn(owner, face.clamp_min(0), normals, surfaces.tint)


def paint(drawn: Drawn) -> Float[Tensor, "height width 4"]:
    """A sheet at 1 / `FINE` of the size of what is drawn."""
    facing = (drawn.normals @ normalize(torch.tensor(LIGHT), dim=0)).clamp_min(0)
    shade = AMBIENT + LAMP * facing + FILL * drawn.normals[:, 2]
    colours, dark = (drawn.tint * shade[:, None]).clamp(0, 1)[drawn.face], drawn.tint * 0.40
    outline, crease = _lines(drawn, max(1, round(drawn.owner.shape[1] / FINE / THICK)))
    for line, opacity in ((crease, CREASE), (outline, LINE)):
        colours[line] = colours[line].lerp(dark[drawn.face[line]], opacity)
    alpha = torch.where(outline, LINE, torch.where(drawn.owner != NO_OWNER, OPACITY, 0.0))
    fine = torch.cat([colours.mul_(alpha[..., None]), alpha[..., None]], -1)
    return avg_pool2d(fine.permute(2, 0, 1), FINE).permute(1, 2, 0)


def over(sheet: Float[Tensor, "h w 4"], picture: Float[Tensor, "h w 3"]) -> Float[Tensor, "h w 3"]:
    """A sheet on a picture."""
    return sheet[..., :3] + (1 - sheet[..., 3:]) * picture


def _lines(drawn: Drawn, thickness: int) -> tuple[Bool[Tensor, "h w"], Bool[Tensor, "h w"]]:
    """Pixels beside another owner, and those beside a crease of their own object."""
    outline, crease = torch.zeros_like(drawn.owner).bool(), torch.zeros_like(drawn.owner).bool()
    for axis in (0, 1):
        n = drawn.owner.shape[axis] - 1
        first, second = drawn.owner.narrow(axis, 0, n), drawn.owner.narrow(axis, 1, n)
        border = first != second
        outline.narrow(axis, 0, n).logical_or_(border)
        outline.narrow(axis, 1, n).logical_or_(border)
        one, other = drawn.face.narrow(axis, 0, n), drawn.face.narrow(axis, 1, n)
        inner = (one != other) & ~border & (first != NO_OWNER) & (first < PERSON)
        at = inner.nonzero(as_tuple=True)
        inner[at] = (drawn.normals[one[at]] * drawn.normals[other[at]]).sum(-1) < SHARP
        crease.narrow(axis, 0, n).logical_or_(inner)
    return widened(outline[None], thickness - 1)[0] & (drawn.owner != NO_OWNER), crease


def floor_points(camera: Camera, height: float) -> Float[Tensor, "h w 3"]:
    """Where the ray of each pixel meets the plane y = `height` [m]; inf where it never does."""
    rows, columns = torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5
    v, u = torch.meshgrid(rows, columns, indexing="ij")
    rays = torch.stack([u, v, torch.ones_like(u)], -1) @ torch.linalg.inv(camera.K).mT
    rays = rays @ camera.R_cam_world
    along = height / torch.where(rays[..., 1].abs() < 1e-6, 1e-6, rays[..., 1])
    return torch.where((along > 0)[..., None], rays * along[..., None], torch.inf)


def metre_lines(
    camera: Camera, height: float, low: Float[Tensor, "2"], high: Float[Tensor, "2"]
) -> Float[Tensor, "h w 4"]:
    """A sheet with white lines at whole metres of the floor, fading at two corners (x, z) [m]."""
    points = floor_points(camera, height)[..., [0, 2]]
    points = torch.where(points.isfinite(), points, 1e6)
    steps = [torch.gradient(points, dim=d)[0].abs() for d in (0, 1)]
    spread = torch.maximum(*steps).clamp_min(1e-6)
    near = ((points - points.round()).abs() / spread).amin(-1)
    coarse = (1 - spread.amax(-1) * 4).clamp(0, 1)
    inside = (torch.minimum(points - low, high - points).amin(-1) / EDGE).clamp(0, 1)
    alpha = METRE * (1.2 - near).clamp(0, 1) * coarse * inside
    return alpha[..., None].expand(-1, -1, 4)
