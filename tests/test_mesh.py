"""Meshes: topology, normals, even samples, fewer faces."""

import dataclasses

import manifold3d
import numpy as np
import pytest
import torch
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from mover.bodies.skinning import open_body, zero_pose
from mover.core.types import Mesh
from mover.geometry import mesh as m
from mover.geometry.mesh import coarser, farthest_first
from mover.geometry.nearest import nearest_points, to_surface
from mover.geometry.topology import manifold


def as_mesh(shape: trimesh.Trimesh) -> Mesh:
    return Mesh(torch.from_numpy(shape.vertices.copy()), torch.from_numpy(shape.faces.copy()))


def joined(*meshes: Mesh) -> Mesh:
    starts = np.cumsum([0] + [len(one.verts) for one in meshes]).tolist()
    faces = [one.faces + start for one, start in zip(meshes, starts, strict=False)]
    return Mesh(torch.cat([one.verts for one in meshes]), torch.cat(faces))


def sphere(level: int = 3, radius: float = 1.0) -> Mesh:
    return as_mesh(trimesh.creation.icosphere(level, radius))


def cube(low: tuple[float, float, float] = (0, 0, 0)) -> Mesh:
    one = as_mesh(trimesh.creation.box((1, 1, 1)))
    return Mesh(one.verts + 0.5 + torch.tensor(low, dtype=torch.float64), one.faces)


def welded(mesh: Mesh) -> Mesh:
    verts, place = torch.unique(mesh.verts, dim=0, return_inverse=True)
    return Mesh(verts, place[mesh.faces])


def two_cubes_on_one_edge() -> Mesh:
    """Solids that touch along an edge, so that four faces share it."""
    return welded(joined(cube(), cube((1, 1, 0))))


def test_box_and_used_ignore_what_no_face_refers_to():
    mesh = Mesh(torch.cat([torch.full((1, 3), 9.0), cube().verts.float()]), cube().faces + 1)
    low, high = m.box(m.used(mesh).verts)
    assert torch.equal(low, torch.zeros(3))
    assert torch.equal(high, torch.ones(3))
    assert torch.equal(m.used(mesh).verts[m.used(mesh).faces], mesh.verts[mesh.faces])


def test_signed_volume_is_that_of_trimesh_and_changes_sign_inside_out():
    shape = trimesh.creation.torus(1.0, 0.3)
    mesh = as_mesh(shape)
    moved = Mesh(mesh.verts + torch.tensor([5.0, -2.0, 9.0]).double(), mesh.faces)
    assert m.signed_volume(moved) == pytest.approx(shape.volume, rel=1e-9)
    assert m.signed_volume(Mesh(moved.verts, mesh.faces.flip(-1))) == pytest.approx(-shape.volume)


def test_a_surface_is_closed_only_if_each_edge_has_two_opposite_faces():
    faces = sphere().faces
    assert m.is_closed(faces)
    assert m.is_closed(faces.flip(-1))
    assert not m.is_closed(faces[1:])
    assert not m.is_closed(torch.cat([faces[:1].flip(-1), faces[1:]]))
    assert not m.is_closed(torch.cat([faces, faces[:1]]))
    assert not m.is_closed(torch.cat([faces, torch.zeros(1, 3, dtype=torch.long)]))
    assert not m.is_closed(faces[:0])
    assert not m.is_closed(two_cubes_on_one_edge().faces)


def test_vertex_normals_are_the_area_weighted_sum_of_a_naive_loop():
    mesh = as_mesh(trimesh.creation.cone(0.5, 2.0))
    naive = torch.zeros_like(mesh.verts)
    for a, b, c in mesh.faces.tolist():
        p, q, r = mesh.verts[[a, b, c]]
        for corner in (a, b, c):
            naive[corner] += torch.linalg.cross(q - p, r - p) / 2
    naive = naive / naive.norm(dim=-1, keepdim=True)
    torch.testing.assert_close(m.vertex_normals(mesh.verts, mesh.faces), naive)


def test_normals_of_flat_faces_are_zero_and_their_gradient_is_finite():
    verts = torch.zeros(3, 3, requires_grad=True)
    normals = m.face_normals(verts, torch.tensor([[0, 1, 2]]))
    normals.sum().backward()
    assert torch.equal(normals.detach(), torch.zeros(1, 3))
    assert verts.grad.isfinite().all()


def test_edges_of_a_closed_mesh_are_those_of_a_naive_loop():
    faces = as_mesh(trimesh.creation.torus(1.0, 0.3)).faces
    edges = m.edges_of(faces)
    assert len(edges) == len(faces) * 3 // 2
    owner = {}
    for face, row in enumerate(faces.tolist()):
        owner |= {(row[k], row[(k + 1) % 3]): face for k in range(3)}
    naive = {(a, b, f, owner[b, a]) for (a, b), f in owner.items() if a < b}
    assert {tuple(row) for row in edges.tolist()} == naive


def test_edges_that_four_faces_share_appear_twice_within_each_solid():
    mesh = two_cubes_on_one_edge()
    edges = m.edges_of(mesh.faces)
    assert len(edges) == 36
    assert edges[:, :2].unique(dim=0).shape[0] == 35
    assert ((edges[:, 2] < 12) == (edges[:, 3] < 12)).all()


def test_edges_of_an_open_or_inconsistent_mesh_are_refused():
    faces = sphere().faces
    with pytest.raises(ValueError, match="open"):
        m.edges_of(faces[1:])
    with pytest.raises(ValueError, match="winding"):
        m.edges_of(torch.cat([faces[:1].flip(-1), faces[1:]]))


def test_solids_that_touch_in_an_edge_come_apart():
    mesh = two_cubes_on_one_edge()
    verts, faces = manifold(mesh.verts.numpy(), mesh.faces.numpy())
    assert m.is_closed(torch.from_numpy(faces))
    assert len(verts) == 16
    assert trimesh.Trimesh(verts, faces, process=False).body_count == 2


def test_a_solid_whose_walls_meet_in_an_inner_edge_becomes_manifold():
    cells = {(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1, 2)}
    cells -= {(1, 0, 1), (0, 1, 1)}
    solid = voxels(cells)
    assert not m.is_closed(solid.faces)
    found = manifold(solid.verts.numpy(), solid.faces.numpy())
    mesh = Mesh(torch.from_numpy(found[0]), torch.from_numpy(found[1]))
    assert m.is_closed(mesh.faces)
    assert m.signed_volume(mesh) == pytest.approx(len(cells))
    assert trimesh.Trimesh(*found, process=False).body_count == 1


def voxels(cells: set[tuple[int, int, int]]) -> Mesh:
    """The surface of unit cubes; faces between two cubes are left out."""
    walls = joined(*[cube(cell) for cell in sorted(cells)])
    middle = walls.verts[walls.faces].mean(1) + m.face_normals(walls.verts, walls.faces) / 2
    free = [tuple(place) not in cells for place in middle.floor().long().tolist()]
    return welded(Mesh(walls.verts, walls.faces[torch.tensor(free)]))


@settings(max_examples=40, deadline=None)
@given(st.sets(st.tuples(*[st.integers(0, 2)] * 3), min_size=1, max_size=14))
def test_any_pile_of_cubes_becomes_manifold_with_its_volume(cells: set[tuple[int, int, int]]):
    solid = voxels(cells)
    found = manifold(solid.verts.numpy(), solid.faces.numpy())
    mesh = Mesh(torch.from_numpy(found[0]), torch.from_numpy(found[1]))
    assert m.is_closed(mesh.faces)
    assert m.signed_volume(mesh) == pytest.approx(len(cells))
    assert len(m.edges_of(solid.faces)) == len(solid.faces) * 3 // 2


def test_samples_lie_on_the_surface_with_its_normals_and_repeat_with_the_seed():
    mesh = as_mesh(trimesh.creation.box((2.0, 0.1, 1.0)))
    points, normals = m.sample_surface(mesh, 400, seed=3)
    assert to_surface(points, mesh.verts, mesh.faces).max() < 1e-12
    side = (points.abs() - torch.tensor([1.0, 0.05, 0.5])).abs().argmin(-1)
    at = torch.arange(400)
    assert torch.equal(normals[at, side].abs(), torch.ones(400, dtype=torch.float64))
    assert (normals[at, side] * points[at, side] > 0).all()
    assert torch.equal(points, m.sample_surface(mesh, 400, seed=3)[0])
    assert not torch.equal(points, m.sample_surface(mesh, 400, seed=4)[0])


def test_samples_are_even_whatever_the_triangles_are():
    fine, coarse = trimesh.creation.icosphere(5), trimesh.creation.icosphere(3)
    top = fine.slice_plane([0, 0, 0], [0, 1, 0])
    bottom = coarse.slice_plane([0, 0, 0], [0, -1, 0])
    points, _ = m.sample_surface(joined(as_mesh(top), as_mesh(bottom)), 600)
    apart = torch.cdist(points, points).fill_diagonal_(torch.inf).amin(1)
    side = (4 * np.pi / 600 * 2 / 3**0.5) ** 0.5  # of the hexagonal lattice of this density
    assert apart.min() > 0.6 * side
    assert abs(int((points[:, 1] > 0).sum()) - 300) < 15
    gaps, _ = nearest_points(sphere(4).verts, points)
    assert gaps.max() < 1.1 * side


def test_decimation_keeps_meshes_closed_and_in_their_box():
    mesh = as_mesh(trimesh.creation.icosphere(5))
    stretched = Mesh((mesh.verts * torch.tensor([1.0, 2.0, 0.2])).float(), mesh.faces)
    small = m.decimate(stretched, 1000)
    assert len(small.faces) <= 1000
    assert m.is_closed(small.faces)
    assert torch.equal(torch.stack(m.box(small.verts)), torch.stack(m.box(stretched.verts)))
    assert to_surface(stretched.verts, small.verts, small.faces).max() < 0.02
    assert m.signed_volume(small) == pytest.approx(m.signed_volume(stretched), rel=0.02)


def test_decimation_never_opens_a_mesh_that_cannot_be_made_simpler():
    thin = joined(*[cube((2.0 * k, 0, 0)) for k in range(40)])
    small = m.decimate(thin, 20)
    assert m.is_closed(small.faces)
    assert m.signed_volume(small) > 20
    assert m.decimate(cube(), 100) is not None
    assert torch.equal(m.decimate(cube(), 12).faces, cube().faces)


@pytest.mark.parametrize("kind", ["random", "grid", "line", "one place"])
def test_each_sample_is_the_farthest_from_those_before(kind: str):
    rng = torch.Generator().manual_seed(1)
    points = {
        "random": torch.rand(700, 3, generator=rng),
        "grid": torch.cartesian_prod(*[torch.arange(6.0)] * 3),  # many are equally far
        "line": torch.rand(100, 1, generator=rng) * torch.tensor([[1.0, 0.0, 0.0]]),
        "one place": torch.ones(5, 3),
    }[kind]
    count = min(150, len(points))
    expected, nearest = [0], torch.full((len(points),), torch.inf)
    for _ in range(count - 1):
        away = (points - points[expected[-1]]).square()
        nearest = torch.minimum(nearest, away[:, 0] + away[:, 1] + away[:, 2])
        expected.append(int((nearest == nearest.max()).nonzero()[0]))
    assert farthest_first(points, count).tolist() == expected


def test_a_solid_with_a_hollow_inside_becomes_as_light_as_one_without():
    shape = trimesh.creation.icosphere(subdivisions=5, radius=0.4)
    hollow = trimesh.creation.icosphere(subdivisions=1, radius=0.01)
    hollow.invert()
    both = trimesh.util.concatenate([shape, hollow])
    mesh = as_mesh(both)
    assert len(mesh.faces) > 20_000
    light = m.decimate(mesh, 1000)
    assert len(light.faces) <= 1000
    assert m.signed_volume(light) == pytest.approx(m.signed_volume(mesh), rel=0.01)


def test_a_hollow_whose_way_out_becomes_too_narrow_does_not_keep_a_mesh_heavy():
    solid = manifold3d.Manifold.cube((1.0, 1.0, 1.0), True)
    solid -= manifold3d.Manifold.cube((0.6, 0.6, 0.6), True)
    for size, place in (
        ((1.0, 0.02, 0.02), (0.0, 0.07, 0.09)),
        ((0.02, 1.0, 0.02), (0.11, 0.07, 0.09)),
        ((0.02, 0.02, 1.0), (0.11, 0.07, 0.09)),
    ):
        solid -= manifold3d.Manifold.cube(size, True).translate(place)
    made = solid.refine_to_length(0.04).to_mesh64()
    verts = torch.from_numpy(np.array(made.vert_properties)[:, :3])
    mesh = Mesh(verts, torch.from_numpy(np.array(made.tri_verts).astype(np.int64)))
    light = m.decimate(mesh, 60)
    assert len(light.faces) <= 60
    assert m.is_closed(light.faces)
    outside = mesh.verts.abs().amax(1) > 0.499
    assert to_surface(mesh.verts[outside], light.verts, light.faces).max() < 0.03


def test_coarser_bodies_stay_closed_and_near_the_skin_in_every_pose():
    model = open_body()
    pose = zero_pose(3, model)
    angles = 0.3 * torch.randn(2, 63, generator=torch.Generator().manual_seed(0))
    pose = dataclasses.replace(pose, body_pose=torch.cat([pose.body_pose[:1], angles]))
    verts, _ = model.posed(pose)
    few, faces = coarser(verts, model.faces, 4000)
    assert len(faces) <= 4000
    assert m.is_closed(faces)
    for body, thin in zip(verts, few, strict=True):
        away = to_surface(body, thin, faces)
        assert float(away.mean()) < 0.0015
        assert float(away.max()) < 0.02
    same, whole = coarser(few, faces, 4000)
    assert torch.equal(same, few)
    assert torch.equal(whole, faces)
