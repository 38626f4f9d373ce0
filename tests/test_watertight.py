"""Closing: any soup becomes one solid in the same box."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from test_mesh import as_mesh, joined, sphere

from mover.core.types import Mesh
from mover.geometry import mesh as m
from mover.geometry.nearest import to_surface
from mover.geometry.volume import signed_distance
from mover.geometry.watertight import LARGE, close_mesh

DATA = Path(__file__).parents[2] / "shared" / "data"
REAL = [
    path
    for pattern in ("total3d_1/output/*.obj", "kaykit/*.obj", "photo_bench/meshes/*.glb")
    for path in sorted(DATA.glob(pattern))
]


def block(size: tuple[float, float, float], at: tuple[float, float, float] = (0, 0, 0)) -> Mesh:
    one = as_mesh(trimesh.creation.box(size))
    return Mesh(one.verts + torch.tensor(at, dtype=torch.float64), one.faces)


def inside_out(mesh: Mesh) -> Mesh:
    return Mesh(mesh.verts, mesh.faces.flip(-1))


def chair() -> list[Mesh]:
    legs = [block((0.05, 0.45, 0.05), (x, 0.225, z)) for x in (-0.2, 0.2) for z in (-0.2, 0.2)]
    return [
        block((0.45, 0.05, 0.45), (0, 0.45, 0)),
        block((0.45, 0.5, 0.05), (0, 0.7, -0.2)),
        *legs,
    ]


def check(source: Mesh, closed: Mesh) -> None:
    assert m.is_closed(closed.faces)
    assert m.signed_volume(closed) > 0
    assert len(m.edges_of(closed.faces)) == len(closed.faces) * 3 // 2
    low, high = m.box(m.used(source).verts)
    assert torch.stack(m.box(closed.verts)).allclose(torch.stack([low, high]), rtol=0, atol=1e-6)


def distances(source: Mesh, closed: Mesh) -> tuple[float, float]:
    """Mean distance of the visible source to the result and back, over the longest side.

    Walls inside walls are no surface of a solid: source points deeper than 0.5 % do not count.
    """
    low, high = m.box(m.used(source).verts)
    longest = float((high - low).max())
    there, _ = m.sample_surface(source, 1500)
    back, _ = m.sample_surface(closed, 1500)
    depth = signed_distance(there, closed.verts, closed.faces)
    visible = depth > -0.005 * longest
    back_to = to_surface(back, source.verts, source.faces)
    return float(depth[visible].abs().mean()) / longest, float(back_to.mean()) / longest


@pytest.mark.parametrize(
    "shape", [block((1, 2, 3)), sphere(radius=0.5), as_mesh(trimesh.creation.torus(1, 0.2))]
)
def test_closed_meshes_pass_through(shape: Mesh):
    closed = close_mesh(shape)
    assert torch.equal(closed.verts[closed.faces].sort(0)[0], shape.verts[shape.faces].sort(0)[0])
    check(shape, closed)


@pytest.mark.parametrize("every", [1, 3])
def test_inverted_and_scattered_faces_are_turned_over(every: int):
    shape = sphere(radius=0.5)
    turn = torch.arange(len(shape.faces)) % every == 0
    mixed = Mesh(shape.verts, torch.where(turn[:, None], shape.faces.flip(-1), shape.faces))
    closed = close_mesh(mixed)
    check(shape, closed)
    assert m.signed_volume(closed) == pytest.approx(m.signed_volume(shape))
    assert len(closed.faces) == len(shape.faces)


def test_unwelded_and_degenerate_triangles_and_unused_vertices_do_not_count():
    shape = sphere(radius=0.5)
    loose = Mesh(shape.verts[shape.faces].reshape(-1, 3), torch.arange(3 * 1280).reshape(-1, 3))
    far = torch.full((1, 3), 40.0, dtype=torch.float64)
    repeated = torch.tensor([[5, 5, 5], [7, 7, 9]])  # Total3D's way to remove a face
    dirty = Mesh(torch.cat([loose.verts, far]), torch.cat([loose.faces, repeated]))
    closed = close_mesh(dirty)
    check(shape, closed)
    assert (len(closed.verts), len(closed.faces)) == (642, 1280)


def test_parts_are_united_whichever_way_they_are_wound():
    parts = chair()
    mixed = joined(*[inside_out(part) if k % 2 else part for k, part in enumerate(parts)])
    closed = close_mesh(mixed)
    check(mixed, closed)
    slab = 0.45 * 0.45 * 0.05 + 0.45 * 0.5 * 0.05 - 0.45 * 0.05 * 0.025
    assert m.signed_volume(closed) == pytest.approx(slab + 4 * 0.05 * 0.05 * 0.425, rel=1e-6)
    there, back = distances(mixed, closed)
    assert there < 1e-4  # a few samples of inner walls are not deep enough to be left out
    assert back < 1e-6


@pytest.mark.parametrize("turn", [lambda mesh: mesh, inside_out])
def test_shells_inside_a_solid_disappear(turn: Callable[[Mesh], Mesh]):
    nested = joined(sphere(), turn(sphere(radius=0.5)))
    closed = close_mesh(nested)
    check(nested, closed)
    assert m.signed_volume(closed) == pytest.approx(m.signed_volume(sphere()))


def test_small_flat_holes_are_capped_exactly():
    post = block((0.1, 1.0, 0.1))
    bottom = (post.verts[post.faces][..., 1] < 0).all(-1)
    open_post = Mesh(post.verts, post.faces[~bottom])
    closed = close_mesh(open_post)
    check(post, closed)
    assert m.signed_volume(closed) == pytest.approx(0.01, rel=1e-9)
    assert len(closed.faces) < 20


def test_a_tub_stays_open_at_its_top():
    tub = block((1.0, 0.6, 0.7))
    lid = (tub.verts[tub.faces][..., 1] > 0).all(-1)
    closed = close_mesh(Mesh(tub.verts, tub.faces[~lid]))
    check(tub, closed)
    above = signed_distance(torch.tensor([[0.0, 0.2, 0.0]]).double(), closed.verts, closed.faces)
    assert above > 0.1


def test_open_tubs_in_one_another_are_closed():
    """Their winding numbers add up: beyond the opening it is that of matter, up to the border."""
    tubs = [block((1.0, 0.6, 0.5 - 0.01 * k)) for k in range(4)]
    lids = [(t.verts[t.faces][..., 1] > 0).all(-1) for t in tubs]
    soup = joined(*(Mesh(t.verts, t.faces[~lid]) for t, lid in zip(tubs, lids, strict=True)))
    check(soup, close_mesh(soup))


def test_double_sided_sheets_become_thin_solids():
    rng = np.random.default_rng(0)
    sheet = trimesh.creation.box((1.0, 0.0, 0.6)).subdivide_to_size(0.1)
    top = as_mesh(sheet)
    up = m.face_normals(top.verts, top.faces)[:, 1] > 0
    seat = Mesh(top.verts + torch.tensor([0, 0.4, 0]), top.faces[up])
    soup = joined(seat, *chair())
    soup = joined(soup, inside_out(soup))
    soup = Mesh(soup.verts, soup.faces[torch.from_numpy(rng.permutation(len(soup.faces)))])
    closed = close_mesh(soup)
    check(soup, closed)
    assert max(distances(soup, closed)) < 0.01
    small = m.decimate(closed, 1500)
    assert len(small.faces) < 3000
    check(soup, small)
    assert max(distances(soup, small)) < 0.01


def test_a_single_flat_sheet_keeps_its_outline():
    sheet = Mesh(
        torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 0, 2], [0, 0, 2]]),
        torch.tensor([[0, 1, 2], [0, 2, 3]]),
    )
    closed = close_mesh(sheet)
    assert m.is_closed(closed.faces)
    assert m.signed_volume(closed) > 0
    low, high = m.box(closed.verts)
    torch.testing.assert_close(low[[0, 2]], torch.tensor([0.0, 0.0]))
    torch.testing.assert_close(high[[0, 2]], torch.tensor([1.0, 2.0]))
    assert high[1] - low[1] < 2 / 96


@pytest.mark.slow
@pytest.mark.parametrize(("level", "share"), [(4, 0.03), (6, 0.02)], ids=["small", "large"])
def test_a_solid_with_missing_faces_is_filled_again(level: int, share: float):
    shape = sphere(level, 0.5)
    keep = torch.from_numpy(np.random.default_rng(0).random(len(shape.faces)) > share)
    assert (int(keep.sum()) > LARGE) == (level == 6)  # large meshes are made lighter first
    closed = close_mesh(Mesh(shape.verts, shape.faces[keep]))
    check(shape, closed)
    assert m.signed_volume(closed) == pytest.approx(m.signed_volume(shape), rel=0.02)
    assert max(distances(shape, closed)) < 0.005


def test_a_soup_of_crossing_triangles_is_closed():
    rng = np.random.default_rng(1)
    centers = rng.normal(size=(150, 1, 3)) * [1.0, 0.5, 0.3]
    soup = Mesh(
        torch.from_numpy((centers + 0.3 * rng.normal(size=(150, 3, 3))).reshape(-1, 3)).float(),
        torch.arange(450).reshape(-1, 3),
    )
    closed = close_mesh(soup, cells=64)
    check(soup, closed)
    assert closed.verts.dtype == torch.float32
    assert max(distances(soup, closed)) < 0.01


def test_meshes_without_area_or_with_nan_are_refused():
    line = torch.tensor([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
    for faces in (torch.tensor([[0, 1, 2]]), torch.zeros(0, 3, dtype=torch.long)):
        with pytest.raises(ValueError, match="no triangle"):
            close_mesh(Mesh(line, faces))
    with pytest.raises(ValueError, match="finite"):
        close_mesh(Mesh(line * torch.nan, torch.tensor([[0, 1, 2]])))


@pytest.mark.slow
@pytest.mark.skipif(not REAL, reason="shared/data is not there")
@pytest.mark.parametrize("path", REAL, ids=lambda path: f"{path.parent.name}-{path.stem}")
def test_real_meshes_become_closed_without_moving(path: Path):
    shape = trimesh.load(path, force="mesh", process=False)
    source = Mesh(
        torch.from_numpy(np.array(shape.vertices)), torch.from_numpy(np.array(shape.faces))
    )
    closed = close_mesh(source)
    check(source, closed)
    there, back = distances(source, closed)
    assert there < 0.01
    assert back < 0.01
    small = m.decimate(closed, 2000)
    assert m.is_closed(small.faces)
    assert len(small.faces) < 12000  # thin walls keep more than asked for
    assert max(distances(source, small)) < 0.012
