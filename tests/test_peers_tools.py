"""The peers' calls: their conventions, where the package itself is not at hand."""

import sys
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest
import torch
from torch import Tensor

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks"))

import peers_tools
from engine import Room

from mover.geometry import raster
from mover.geometry.raster import Crops, Topology

SIZE = 32


@pytest.fixture
def wedge() -> Room:
    """A closed tetrahedron, alike from no two sides, near a corner of its window."""
    verts = torch.tensor([[[0.0, 0, 3], [0.9, 0.1, 3.4], [0.1, 0.5, 3.2], [0.3, 0.2, 2.5]]])
    faces = torch.tensor([[[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]]])
    K = torch.tensor([[[61.3, 0, 6.37], [0, 59.1, 10.21], [0, 0, 1]]])
    views, edges = Crops(K, SIZE, SIZE), torch.zeros(1, 0, 4, dtype=torch.long)
    mask = torch.zeros(1, SIZE, SIZE)
    return Room(verts, Topology(faces, edges), views, mask, mask, mask.bool())


def naive(
    meshes: SimpleNamespace, size: int, _: float, layers: int, perspective_correct: bool
) -> tuple[Tensor, ...]:
    """Triangles pixel by pixel, in the published screen: x to the left, y up, both from -1 to 1."""
    assert perspective_correct
    depth = torch.full((len(meshes.verts), size, size, layers), -1.0)
    line = 1 - (2 * torch.arange(size) + 1) / size
    y, x = torch.meshgrid(line, line, indexing="ij")
    rows = []
    for verts, faces in zip(meshes.verts, meshes.faces, strict=True):
        found = []
        for a, b, c in verts[faces]:
            area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
            v = ((x - a[0]) * (c[1] - a[1]) - (y - a[1]) * (c[0] - a[0])) / area
            w = ((b[0] - a[0]) * (y - a[1]) - (b[1] - a[1]) * (x - a[0])) / area
            z = 1 / ((1 - v - w) / a[2] + v / b[2] + w / c[2])
            inside = (v > 0) & (w > 0) & (v + w < 1)
            found.append(torch.where(inside, z, torch.inf))
        rows.append(torch.stack(found, -1).sort(-1).values[..., :layers])
    found = torch.stack(rows)
    depth[..., : found.shape[-1]] = torch.where(found.isfinite(), found, -1.0)
    hit = torch.where(depth > 0, 0, -1)
    return hit, depth, torch.zeros(()), torch.where(depth > 0, -depth, 1.0)


def test_pytorch3d_is_asked_for_the_same_pixels(wedge, monkeypatch):
    parts = ("pytorch3d", "renderer", "mesh", "rasterize_meshes")
    for end in range(1, len(parts) + 1):
        monkeypatch.setitem(sys.modules, ".".join(parts[:end]), ModuleType(parts[end - 1]))
    structures = ModuleType("structures")
    structures.Meshes = lambda verts, faces: SimpleNamespace(verts=verts, faces=faces)
    monkeypatch.setitem(sys.modules, "pytorch3d.structures", structures)
    sys.modules[".".join(parts)].rasterize_meshes = naive
    image, first = peers_tools.pytorch3d(wedge)
    seen = raster.depths(wedge.verts, wedge.shape, wedge.views)
    assert seen.covered.sum() > 30
    assert torch.equal(image > 0.5, seen.covered)
    torch.testing.assert_close(first[seen.covered], seen.nearest[seen.covered])


def test_rays_go_through_pixel_centres_and_the_box_holds_all_that_is_seen(wedge):
    every = torch.from_numpy(peers_tools.rays(wedge.views))
    assert (every[..., 2] == 1).all()
    pixel = every @ wedge.views.K[0].T
    centre = torch.arange(SIZE) + 0.5
    torch.testing.assert_close(pixel[..., 0], centre.expand(SIZE, SIZE), rtol=0, atol=1e-4)
    torch.testing.assert_close(pixel[..., 1], centre[:, None].expand(SIZE, SIZE), rtol=0, atol=1e-4)
    rows, columns = peers_tools.boxed(wedge.verts[0], wedge.views)
    seen = raster.depths(wedge.verts, wedge.shape, wedge.views).covered[0].clone()
    assert seen.sum() > 30
    seen[rows, columns] = False
    assert not seen.any()


def test_deodr_covers_the_same_centres_and_its_band_lies_outside(wedge):
    pytest.importorskip("deodr")
    with torch.no_grad():
        ours = raster.silhouettes(wedge.verts, wedge.shape, wedge.views)
        seen = raster.depths(wedge.verts, wedge.shape, wedge.views).covered
    hard, soft = peers_tools.deodr(wedge, 1e-3)[0], peers_tools.deodr(wedge)[0]
    assert torch.equal(hard > 0.5, seen)
    assert (soft >= hard - 1e-6).all()
    assert soft.sum() > 1.02 * ours.sum()
