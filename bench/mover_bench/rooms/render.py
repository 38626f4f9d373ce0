"""What the camera sees of a known room: instance masks with all occlusions, shaded pictures."""

from collections.abc import Sequence

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.core.records import record
from mover.core.types import Masks, Mesh
from mover.geometry import rle
from mover.geometry.raster import first_hit
from mover_bench.rooms.compose import Plan
from mover_bench.rooms.placed import corners, verts_on_floor

COLOURS: dict[str, tuple[float, float, float]] = {
    "chair": (0.72, 0.5, 0.3), "armchair": (0.36, 0.52, 0.44), "office chair": (0.28, 0.3, 0.36),
    "stool": (0.8, 0.62, 0.36), "bench": (0.62, 0.46, 0.32), "sofa": (0.33, 0.44, 0.6),
    "bed": (0.78, 0.76, 0.72), "table": (0.58, 0.41, 0.26), "desk": (0.66, 0.5, 0.36),
    "coffee table": (0.5, 0.36, 0.24), "shelf": (0.7, 0.6, 0.48), "cabinet": (0.62, 0.55, 0.5),
    "wardrobe": (0.76, 0.7, 0.62), "nightstand": (0.6, 0.48, 0.38), "floor lamp": (0.86, 0.8, 0.6),
}  # fmt: skip
SKIN = ((0.86, 0.62, 0.5), (0.55, 0.66, 0.82))
LIGHT = np.array([0.35, 0.85, 0.4]) / np.linalg.norm([0.35, 0.85, 0.4])


@record
class Sight:
    """Furniture as the camera sees it, without people."""

    depth: Float[Tensor, "h w"]  #: [m], infinite where there is none
    piece: Int[Tensor, "h w"]  #: index of the piece; -1: none
    picture: Float[Tensor, "h w 3"]  #: a shaded picture with floor and walls, in [0, 1]


@record
class Look:
    """One body alone, in a window of the image."""

    window: tuple[slice, slice]  #: rows and columns
    depth: Float[Tensor, "h w"]  #: [m], infinite where there is none
    face: Int[Tensor, "h w"]  #: -1: none


def encode(masks: Sequence[np.ndarray]) -> Masks:
    """Binary images (h, w), run-length encoded."""
    height, width = masks[0].shape
    return Masks(height, width, tuple(rle.encode(torch.from_numpy(mask)) for mask in masks))


def box_of_mask(mask: Bool[np.ndarray, "h w"]) -> Float[Tensor, "4"]:
    """x_min, y_min, x_max, y_max [px] of a mask that is not empty."""
    return rle.tight_box(torch.from_numpy(mask))


def see(plan: Plan) -> Sight:
    """Draw the furniture, the floor and the walls."""
    camera = plan.view.camera
    verts, faces, owner = furniture(plan)
    size = (camera.height, camera.width)
    depth, face = first_hit(plan.view.seen(verts), faces, camera.K, size)
    hit = face >= 0
    colours = torch.tensor(
        [COLOURS.get(p.furniture.category, (0.6, 0.6, 0.6)) for p in plan.pieces]
    )
    picture = _background(plan)
    picture[hit] = (colours[owner] * _shades(verts, faces)[:, None])[face[hit]].float()
    piece = torch.where(hit, owner[face.clamp_min(0)], torch.full_like(face, -1))
    return Sight(depth, piece, picture.clamp(0, 1))


def look_at(plan: Plan, verts_cam: Float[Tensor, "verts 3"], faces: Int[Tensor, "faces 3"]) -> Look:
    """A body alone, in the window that it fills."""
    camera = plan.view.camera
    nothing = Look((slice(0, 0), slice(0, 0)), torch.zeros(0, 0), torch.zeros(0, 0).long())
    if float(verts_cam[:, 2].max()) < 0.1:
        return nothing
    flat = verts_cam @ camera.K.mT
    pixel = flat[:, :2] / flat[:, 2:].clamp_min(0.05)
    size = torch.tensor([camera.width, camera.height])
    low = torch.minimum(pixel.amin(0).floor().long().clamp_min(0), size)
    high = torch.minimum(pixel.amax(0).ceil().long().clamp_min(0), size)
    if bool((high <= low).any()):
        return nothing
    (left, top), (right, bottom) = low.tolist(), high.tolist()
    K = camera.K - torch.tensor([[0, 0, left], [0, 0, top], [0, 0, 0]])
    part = first_hit(verts_cam, faces, K, (bottom - top, right - left))
    return Look((slice(top, bottom), slice(left, right)), *part)


def draw_bodies(plan: Plan, sight: Sight, bodies: list[Mesh]) -> Float[Tensor, "h w 3"]:
    """The picture of the room with people (in camera axes) in it."""
    picture, nearest = sight.picture.clone(), sight.depth.clone()
    R = plan.view.camera.R_cam_world
    for index, body in enumerate(bodies):
        look = look_at(plan, body.verts, body.faces)
        shade = _shades(body.verts @ R, body.faces)
        front = look.depth < nearest[look.window]
        colour = torch.tensor(SKIN[index % len(SKIN)])
        picture[look.window][front] = (shade[look.face[front]][:, None] * colour).float()
        nearest[look.window] = torch.minimum(nearest[look.window], look.depth)
    return picture.clamp(0, 1)


def furniture(plan: Plan) -> tuple[Tensor, Tensor, Tensor]:
    """Vertices on the floor, faces, and the piece of each face."""
    verts, faces, owner, start = [], [], [], 0
    for index, piece in enumerate(plan.pieces):
        one = verts_on_floor(piece)
        verts.append(one)
        faces.append(piece.furniture.mesh.faces + start)
        owner.append(torch.full((len(piece.furniture.mesh.faces),), index))
        start += len(one)
    return torch.cat(verts), torch.cat(faces), torch.cat(owner)


def _shades(verts: Tensor, faces: Tensor) -> Float[Tensor, " faces"]:
    """Brightness of each face under one lamp and a bright ceiling."""
    a, b, c = (verts[faces[:, k]] for k in range(3))
    normal = torch.cross(b - a, c - a, dim=-1)
    normal = normal / normal.norm(dim=-1, keepdim=True).clamp_min(1e-12)
    lamp = normal @ torch.from_numpy(LIGHT).to(normal)
    return 0.42 + 0.33 * lamp.clamp_min(0) + 0.3 * (0.5 + 0.5 * normal[:, 1])


def _background(plan: Plan) -> Float[Tensor, "h w 3"]:
    """Floorboards with soft shadows under the furniture, and three walls."""
    camera = plan.view.camera
    v, u = np.mgrid[0.5 : camera.height, 0.5 : camera.width]
    K = camera.K.double().numpy()
    rays = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones_like(u)], -1)
    rays = rays @ camera.R_cam_world.double().numpy()
    eye = np.array([0.0, plan.view.height, 0.0])
    walls = plan.walls
    planes = ((1, 0.0), (2, walls[0, 1]), (0, walls[0, 0]), (0, walls[1, 0]))
    with np.errstate(divide="ignore", invalid="ignore"):
        far = np.stack([(at - eye[axis]) / rays[..., axis] for axis, at in planes])
    far = np.where(far > 1e-6, far, np.inf)
    which = far.argmin(0)
    point = eye + rays * np.take_along_axis(far, which[None], 0)[0][..., None]
    board = np.floor(point[..., 0] / 0.14)
    grain = 0.03 * np.sin(12.9898 * board) + 0.015 * np.sin(3.0 * point[..., 2] + 7.0 * board)
    seam = np.where(np.abs(point[..., 0] / 0.14 - np.round(point[..., 0] / 0.14)) < 0.03, 0.9, 1.0)
    floor = np.array([0.71, 0.6, 0.47]) * ((1 + grain) * seam * _shadow(plan, point))[..., None]
    tone = np.array([1.0, 0.93, 0.86, 0.89])[which]
    foot = np.where((point[..., 1] < 0.09), 1.06, 1.0)
    wall = np.array([0.87, 0.86, 0.82]) * (tone * foot * (0.92 + 0.03 * point[..., 1]))[..., None]
    return torch.from_numpy(np.where((which == 0)[..., None], floor, wall)).float().clamp(0, 1)


def _shadow(plan: Plan, point: np.ndarray) -> np.ndarray:
    """Darkness of the floor beneath and beside the furniture, as a factor."""
    from scipy.ndimage import gaussian_filter, map_coordinates

    cell = 0.04
    low = plan.walls[0] - 0.5
    count = np.ceil((plan.walls[1] + 0.5 - low) / cell).astype(int)
    grid = low + cell * np.stack(np.meshgrid(*(np.arange(n) for n in count), indexing="ij"), -1)
    dark = np.zeros(grid.shape[:2])
    for piece in plan.pieces:
        box = corners(piece)
        edges = np.roll(box, -1, axis=0) - box
        off = grid[None] - box[:, None, None]
        side = edges[:, None, None, 0] * off[..., 1] - edges[:, None, None, 1] * off[..., 0]
        dark = np.maximum(dark, ((side >= 0).all(0) | (side <= 0).all(0)).astype(float))
    blurred = 0.55 * gaussian_filter(dark, 2.0) + 0.45 * gaussian_filter(dark, 7.0)
    at = np.moveaxis((point[..., [0, 2]] - low) / cell, -1, 0)
    return 1 - 0.5 * map_coordinates(blurred, at, order=1, mode="nearest")
