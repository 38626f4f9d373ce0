"""A closed mesh from an Occupancy Network: multiresolution extraction and marching cubes."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from ..types import Mesh
from .mesh import box, fit_box, sample_surface, used
from .occupancy import OccupancyNetwork

OUTSIDE = -1e6  # logit beyond the box, so that every surface closes
AT_ONCE = 100_000  # points that the network sees

Inside = Callable[[Float[Tensor, "points 3"]], Float[Tensor, " points"]]


@dataclass(frozen=True)
class ExtractConfig:
    """As MOVER runs it."""

    coarse: int = 32
    """Cells along a side at first."""
    levels: int = 2
    """How often cells are halved near the surface."""
    padding: float = 0.1
    """The box is larger than the unit cube by this."""
    threshold: float = 0.2
    """Probability of the surface."""
    points: int = 2048
    """Points of the cloud that is encoded."""


def extract(inside: Inside, config: ExtractConfig) -> Mesh:
    """The surface of a field, found cell by cell where it changes sign.

    Args:
        inside: Logits of points in the unit cube about the origin.
        config: How fine.

    Raises:
        ValueError: If nothing is inside.
    """
    import igl

    limit = float(np.log(config.threshold) - np.log1p(-config.threshold))
    field = refined(lambda p: inside(p) - limit, config)
    if not bool((field > 0).any()):
        raise ValueError("extract: nothing is inside")
    padded = torch.nn.functional.pad(field, (1,) * 6, value=OUTSIDE).double().numpy()
    n = padded.shape[0]
    axis = np.arange(n, dtype=np.float64)
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")  # x runs fastest, as igl has it
    grid = np.stack([x.ravel(), y.ravel(), z.ravel()], -1)
    values = np.maximum(padded, -20.0).transpose(2, 1, 0).ravel()
    places, faces, _ = igl.marching_cubes(-values, grid, n, n, n, isovalue=0.0)
    size = (1 + config.padding) / (n - 3)
    verts = (torch.from_numpy(np.asarray(places)) - 1) * size - (1 + config.padding) / 2
    return Mesh(verts.float(), torch.from_numpy(np.asarray(faces, dtype=np.int64)))


def refined(field: Inside, config: ExtractConfig) -> Float[Tensor, "n n n"]:
    """Values on the finest grid; away from the surface they are interpolated from coarser ones.

    Cells whose corners differ in sign are halved. Where a new value changes the sign of a cell that
    was taken for uniform, its corners are evaluated, too, until nothing changes: what hangs
    together with anything found is found wholly.
    """
    cells = config.coarse
    values = _evaluated(field, _all(cells + 1), cells, config)
    values = values.reshape(cells + 1, cells + 1, cells + 1)
    for _ in range(config.levels):
        split = _mixed(values)
        cells *= 2
        values = torch.nn.functional.interpolate(
            values[None, None], size=(cells + 1,) * 3, mode="trilinear", align_corners=True
        )[0, 0]
        known = torch.zeros_like(values, dtype=torch.bool)
        known[::2, ::2, ::2] = True
        wanted = _corners(split.repeat_interleave(2, 0).repeat_interleave(2, 1)
                          .repeat_interleave(2, 2)) & ~known  # fmt: skip
        while bool(wanted.any()):
            index = wanted.nonzero()
            values[wanted] = _evaluated(field, index, cells, config)
            known = known | wanted
            wanted = _corners(_mixed(values)) & ~known
    return values


def _all(n: int) -> Int[Tensor, "points 3"]:
    axis = torch.arange(n)
    return torch.cartesian_prod(axis, axis, axis)


def _evaluated(
    field: Inside, index: Int[Tensor, "points 3"], cells: int, config: ExtractConfig
) -> Float[Tensor, " points"]:
    """The field at grid points."""
    size = 1 + config.padding
    points = index.float() * (size / cells) - size / 2
    return torch.cat([field(part) for part in points.split(AT_ONCE)])


def _mixed(values: Float[Tensor, "n n n"]) -> Bool[Tensor, "m m m"]:
    """Cells whose corners differ in sign."""
    inside = (values > 0)[None, None].float()
    most = torch.nn.functional.max_pool3d(inside, 2, stride=1)
    least = -torch.nn.functional.max_pool3d(-inside, 2, stride=1)
    return (most != least)[0, 0]


def _corners(cells: Bool[Tensor, "m m m"]) -> Bool[Tensor, "n n n"]:
    """Grid points that are corners of the cells."""
    padded = torch.nn.functional.pad(cells[None, None].float(), (1,) * 6)
    return torch.nn.functional.max_pool3d(padded, 2, stride=1)[0, 0] > 0


def occupied_mesh(
    network: OccupancyNetwork, mesh: Mesh, config: ExtractConfig | None = None
) -> Mesh:
    """What the network makes of a mesh: closed, in the same box.

    The points that it sees are spread evenly over the surface, in the axes and the size of its
    training data (ShapeNet's: our x and z change places, the longest side is one).

    Raises:
        ValueError: If the network finds nothing inside.
    """
    config = config or ExtractConfig()
    source = used(mesh)
    low, high = box(source.verts)
    middle, longest = (low + high) / 2, (high - low).max()
    points, _ = sample_surface(source, config.points)
    cloud = _swapped((points - middle) / longest).float()
    with torch.no_grad():
        code = network.encoder(cloud[None])
        found = extract(lambda p: network.decoder(p[None], code)[0], config)
    verts = _swapped(found.verts).to(mesh.verts)
    faces = found.faces.flip(-1)  # the change of axes is a mirror
    return fit_box(Mesh(verts, faces), low, high)


def _swapped(points: Float[Tensor, "points 3"]) -> Float[Tensor, "points 3"]:
    return points[:, [2, 1, 0]]
