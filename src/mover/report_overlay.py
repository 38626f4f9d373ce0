"""Furniture over the reference image: tinted, shaded, outlined and named."""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor
from torch.nn.functional import avg_pool2d, max_pool2d, normalize

from .geometry.camera import to_camera
from .geometry.placement import place_piece
from .geometry.raster import first_hit
from .report_colours import colour, css, person_colour
from .types import Camera, Mesh, Scene

FINE = 2  # drawn at twice the size and averaged: smooth edges
TINT, LINE, CREASE = 0.62, 0.95, 0.30  # how opaque surfaces, outlines and inner edges are
SHARP = 0.85  # cosine between two faces whose edge is drawn
MARGIN = 0.6  # [m], how far the floor's grid reaches beyond the furniture
NOBODY = -1  # owner of a pixel that shows no surface


@dataclass(frozen=True)
class Drawn:
    """What each fine pixel shows."""

    owner: Int[Tensor, "h w"]
    """Index of the object, one more than the last object for people, -1 for nothing."""
    normal: Float[Tensor, "h w 3"]
    """Unit normal towards the camera, in camera axes; 0 for nothing."""


def draw_overlay(
    image: Float[Tensor, "h w 3"] | None, scene: Scene, bodies: Mesh | None = None
) -> Float[Tensor, "height width 3"]:
    """Draw the furniture of `scene` over `image`, which shows the whole view of its camera.

    Args:
        image: The reference image in [0, 1], of any resolution; None: a neutral backdrop.
        scene: The furniture and its camera.
        bodies: People to draw with it, in the scene's world [m].
    """
    if image is None:
        image = backdrop(scene.camera.height, scene.camera.width)
    height, width = image.shape[:2]
    surface, owner = _surfaces(scene, bodies)
    if not len(surface.faces):
        return image
    drawn = _look(surface, owner, _resized(scene.camera, FINE * height, FINE * width))
    floor = (drawn.owner == NOBODY).to(image)
    fine = image.lerp(_grid(image, scene), avg_pool2d(floor[None], FINE)[0, ..., None])
    fine = fine.repeat_interleave(FINE, 0).repeat_interleave(FINE, 1)
    shrunk = avg_pool2d(_paint(fine, drawn, scene).permute(2, 0, 1), FINE).permute(1, 2, 0)
    return _name(shrunk.clamp(0, 1), drawn.owner[::FINE, ::FINE], scene)


def backdrop(height: int, width: int) -> Float[Tensor, "height width 3"]:
    """A neutral picture, a little lighter above."""
    fade = torch.linspace(0.93, 0.80, height)[:, None, None]
    return fade.expand(height, width, 3) * torch.tensor([0.985, 0.99, 1.0])


def _resized(camera: Camera, height: int, width: int) -> Camera:
    zoom = torch.tensor([width / camera.width, height / camera.height, 1.0]).to(camera.K)
    return Camera(camera.K * zoom[:, None], camera.R_cam_world, width, height)


def _surfaces(scene: Scene, bodies: Mesh | None) -> tuple[Mesh, Int[Tensor, " faces"]]:
    """All surfaces as one mesh in camera axes, and the owner of each face."""
    meshes = [place_piece(p) for p in scene.pieces] + ([bodies] if bodies is not None else [])
    if not meshes:
        return Mesh(torch.zeros(0, 3), torch.zeros(0, 3, dtype=torch.long)), torch.zeros(0).long()
    starts = torch.tensor([0, *[len(m.verts) for m in meshes]]).cumsum(0).tolist()
    faces = torch.cat([m.faces.long() + s for m, s in zip(meshes, starts, strict=False)])
    verts = torch.cat([m.verts for m in meshes]).to(scene.camera.R_cam_world)
    owner = torch.cat([torch.full((len(m.faces),), i) for i, m in enumerate(meshes)])
    return Mesh(to_camera(verts, scene.camera.R_cam_world), faces), owner


def _look(surface: Mesh, owner: Int[Tensor, " faces"], camera: Camera) -> Drawn:
    size = (camera.height, camera.width)
    _, face = first_hit(surface.verts, surface.faces, camera.K, size)
    a, b, c = surface.verts[surface.faces].unbind(1)
    normals = normalize(torch.linalg.cross(b - a, c - a), dim=-1)
    away = (normals * (a + b + c)).sum(-1, keepdim=True) > 0
    normals = torch.where(away, -normals, normals)
    hit, index = face >= 0, face.clamp_min(0)
    seen = torch.where(hit, owner[index], torch.full_like(index, NOBODY))
    return Drawn(seen, normals[index] * hit[..., None])


def _paint(fine: Tensor, drawn: Drawn, scene: Scene) -> Float[Tensor, "h w 3"]:
    tints = [colour(i) for i in range(len(scene.pieces))] + [person_colour(0), (0.0, 0.0, 0.0)]
    tint = torch.tensor(tints).to(fine)[drawn.owner]  # NOBODY reads the last row
    light = normalize(scene.camera.R_cam_world @ torch.tensor([0.35, 0.85, 0.45]).to(fine), dim=0)
    shade = (
        0.62 + 0.48 * (drawn.normal @ light).clamp_min(0) - 0.12 * drawn.normal[..., 2:3][..., 0]
    )
    seen = (drawn.owner != NOBODY)[..., None]
    picture = torch.where(seen, fine.lerp((tint * shade[..., None]).clamp(0, 1), TINT), fine)
    outline, inside = _lines(drawn, max(1, round(fine.shape[1] / 1100)))
    dark = tint * 0.45
    picture = picture.lerp(dark, CREASE * inside[..., None].to(fine))
    return picture.lerp(tint * 0.55, LINE * outline[..., None].to(fine))


def _lines(drawn: Drawn, thickness: int) -> tuple[Bool[Tensor, "h w"], Bool[Tensor, "h w"]]:
    """Fine pixels of objects beside another owner, and those beside a crease of their own."""
    outline, crease = torch.zeros_like(drawn.owner).bool(), torch.zeros_like(drawn.owner).bool()
    for axis in (0, 1):
        n = drawn.owner.shape[axis] - 1
        here, there = drawn.owner.narrow(axis, 0, n), drawn.owner.narrow(axis, 1, n)
        bent = (drawn.normal.narrow(axis, 0, n) * drawn.normal.narrow(axis, 1, n)).sum(-1) < SHARP
        border = here != there
        outline.narrow(axis, 0, n).logical_or_(border)
        outline.narrow(axis, 1, n).logical_or_(border)
        crease.narrow(axis, 0, n).logical_or_(bent & ~border & (here != NOBODY))
    wide = max_pool2d(outline[None, None].float(), 2 * thickness - 1, 1, thickness - 1)[0, 0] > 0
    return wide & (drawn.owner != NOBODY), crease


def _grid(image: Float[Tensor, "h w 3"], scene: Scene) -> Float[Tensor, "h w 3"]:
    """Faint lines on the floor, one metre apart, around the furniture."""
    if scene.ground is None or not scene.pieces or scene.ground >= 0:
        return image
    height, width = image.shape[:2]
    camera = _resized(scene.camera, height, width)
    rows, columns = torch.arange(height) + 0.5, torch.arange(width) + 0.5
    v, u = torch.meshgrid(rows.to(image), columns.to(image), indexing="ij")
    rays = torch.stack([u, v, torch.ones_like(u)], -1) @ torch.linalg.inv(camera.K).mT.to(image)
    rays = rays @ camera.R_cam_world.to(image)
    reach = scene.ground / rays[..., 1].clamp_max(-1e-4)
    floor = (rays * reach[..., None])[..., [0, 2]]
    spread = torch.maximum(*(torch.gradient(floor, dim=d)[0].abs() for d in (0, 1)))
    near = ((floor - floor.round()).abs() / spread.clamp_min(1e-6)).amin(-1)
    stands = torch.cat([place_piece(p).verts[:, [0, 2]] for p in scene.pieces])
    low, high = stands.amin(0) - MARGIN, stands.amax(0) + MARGIN
    inside = ((floor > low) & (floor < high)).all(-1) & (rays[..., 1] < -1e-4)
    strength = 0.30 * (1.2 - near).clamp(0, 1) * inside * (1 - spread.amax(-1) * 4).clamp(0, 1)
    return image.lerp(torch.ones_like(image), strength[..., None])


def _name(picture: Tensor, owner: Int[Tensor, "h w"], scene: Scene) -> Float[Tensor, "h w 3"]:
    """Write each visible object's id over its middle."""
    import numpy as np
    from PIL import Image, ImageDraw, ImageFont

    canvas = Image.fromarray((picture * 255).round().byte().numpy())
    pen = ImageDraw.Draw(canvas)
    size = max(10.0, picture.shape[1] / 80)
    font = ImageFont.load_default(size)
    taken: list[tuple[float, float, float, float]] = []
    for index, piece in enumerate(scene.pieces):
        pixels = (owner == index).nonzero()
        if len(pixels) < size * size:
            continue
        y, x = pixels.double().mean(0).tolist()
        box = _free_place(x, y, pen.textlength(piece.id, font), size, taken)
        taken.append(box)
        pen.rounded_rectangle(box, size * 0.45, fill=css(_deep(colour(index))))
        middle = ((box[0] + box[2]) / 2, (box[1] + box[3]) / 2)
        pen.text(middle, piece.id, fill="white", font=font, anchor="mm")
    return torch.from_numpy(np.asarray(canvas).copy()).to(picture) / 255


def _deep(rgb: tuple[float, float, float]) -> tuple[float, float, float]:
    r, g, b = (0.72 * c for c in rgb)
    return r, g, b


def _free_place(
    x: float, y: float, length: float, size: float, taken: list[tuple[float, float, float, float]]
) -> tuple[float, float, float, float]:
    """Box of a label around (x, y) [px], moved down until it covers no other."""
    half = (length / 2 + 0.55 * size, 0.75 * size)
    box = (x - half[0], y - half[1], x + half[0], y + half[1])
    while any(box[0] < b[2] and b[0] < box[2] and box[1] < b[3] and b[1] < box[3] for b in taken):
        box = (box[0], box[1] + 0.5 * size, box[2], box[3] + 0.5 * size)
    return box
