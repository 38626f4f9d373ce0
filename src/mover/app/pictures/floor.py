"""The floor under a room: a lit plane, lines one metre apart, soft shadows of what stands on it."""

import torch
from jaxtyping import Float
from torch import Tensor
from torch.nn.functional import avg_pool2d, grid_sample

from mover.app.pictures.eye import RenderCamera, floor_seen
from mover.app.pictures.paint import Surfaces
from mover.core.records import record
from mover.geometry.raster import first_hit

CELL = 0.03  # [m], of the map of shadows
MOST = 600  # cells along a side of it at most
BELOW = 60.0  # [m], from where the undersides are seen: nearly in parallel
REACH = 0.35  # [m], height over the floor at which a shadow has faded to 1/e
SOFT = (2, 7)  # cells that a shadow is blurred by: at the contact, around it
DARK = 0.55  # of the darkest shadow
LINE = 0.5  # opacity of the metre lines
EDGE = 1.2  # [m], how far the floor reaches beyond what stands on it
SKY, FLOOR = (0.955, 0.965, 0.98), (0.80, 0.785, 0.76)


@record
class Ground:
    """The floor's height and what part of it is shown."""

    height: float
    """[m]"""
    low: Float[Tensor, "2"]
    """Smallest x and z [m]."""
    high: Float[Tensor, "2"]
    """Largest x and z [m]."""


def ground_under(points: Float[Tensor, "points 3"], height: float) -> Ground:
    """The floor under everything."""
    flat = points[:, [0, 2]]
    return Ground(height, flat.amin(0) - EDGE, flat.amax(0) + EDGE)


def backdrop(eye: RenderCamera, ground: Ground) -> Float[Tensor, "h w 3"]:
    """A plain room: a floor that ends softly, and light around it."""
    spread = torch.linspace(1.0, 0.93, eye.height)[:, None, None]
    sky = (torch.tensor(SKY) * spread).expand(eye.height, eye.width, 3)
    points = floor_seen(eye, ground.height)[..., [0, 2]]
    return sky.lerp(torch.tensor(FLOOR), 0.75 * _inside(points, ground)[..., None])


def metre_lines(eye: RenderCamera, ground: Ground, brightness: float) -> Float[Tensor, "h w 4"]:
    """A sheet with lines at whole metres of the world, of one brightness in [0, 1]."""
    points = floor_seen(eye, ground.height)[..., [0, 2]]
    points = torch.where(points.isfinite(), points, 1e6)
    steps = [torch.gradient(points, dim=d)[0].abs() for d in (0, 1)]
    spread = torch.maximum(*steps).clamp_min(1e-6)
    near = ((points - points.round()).abs() / spread).amin(-1)
    coarse = (1 - spread.amax(-1) * 4).clamp(0, 1)
    alpha = LINE * (1.2 - near).clamp(0, 1) * coarse * _inside(points, ground)
    return torch.cat([(brightness * alpha)[..., None].expand(-1, -1, 3), alpha[..., None]], -1)


def shadows(eye: RenderCamera, ground: Ground, surfaces: Surfaces) -> Float[Tensor, "h w 4"]:
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


def _inside(points: Float[Tensor, "h w 2"], ground: Ground) -> Float[Tensor, "h w"]:
    """1 on the shown part of the floor, fading to 0 at its border."""
    gap = torch.minimum(points - ground.low, ground.high - points).amin(-1)
    return (gap.nan_to_num(-1.0, -1.0, -1.0) / EDGE).clamp(0, 1)
