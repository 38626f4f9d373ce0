"""Meshes whose shapes do not fit are bent towards the image; the others stay, to the bit."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from analytic import make_inputs
from test_export import textured

from mover.core.types import Cage, Camera, Mesh, Scene, SceneObject
from mover.energy.config import SceneConfig, only
from mover.energy.objective import HumanCues, scene_energy
from mover.geometry.cage import bent, even
from mover.io.capture.scene_file import read_scene, write_scene
from mover.io.export.scene_glb import write_glb
from mover.stages.config import BendConfig
from mover.stages.objects.bend_shapes import BendInputs, bend_shapes, told_of_shapes, with_shapes
from mover.stages.objects.prepare_objects import Prepared, to_objects

PRICE = SceneConfig(only(bbox=1.0, silhouette=1.0, scale=0.3), "robust")


def some_cage(offset: torch.Tensor) -> Cage:
    return Cage(torch.tensor([-1.0, 0.0, -2.0]), torch.tensor([1.0, 0.5, 2.0]), offset)


def control_points(cage: Cage) -> torch.Tensor:
    half = torch.linspace(0, 1, 3)
    grid = torch.stack(torch.meshgrid(half, half, half, indexing="ij"), -1)
    return cage.low + grid * (cage.high - cage.low)


def inside(cage: Cage, count: int = 50) -> torch.Tensor:
    share = torch.rand(count, 3, generator=torch.Generator().manual_seed(0))
    return cage.low + share * (cage.high - cage.low)


class TestCage:
    def test_control_points_moved_by_an_affine_map_move_everything_by_it(self):
        cage = some_cage(torch.zeros(3, 3, 3, 3))
        matrix = torch.tensor([[0.1, 0.2, 0.0], [0.0, -0.3, 0.1], [0.05, 0.0, 0.2]])
        away = torch.tensor([0.3, -0.1, 0.2])
        cage = replace(cage, offset=control_points(cage) @ matrix.mT + away)
        points = inside(cage)
        assert torch.allclose(bent(points, cage), points + points @ matrix.mT + away, atol=1e-5)

    def test_it_is_the_sum_over_control_points_of_a_naive_loop(self):
        g = torch.Generator().manual_seed(1)
        cage = some_cage(torch.randn(3, 3, 3, 3, generator=g))
        points = inside(cage, 5)
        u = (points - cage.low) / (cage.high - cage.low)

        def basis(k: int, x: float) -> float:
            return [(1 - x) ** 2, 2 * x * (1 - x), x**2][k]

        expected = points.clone()
        for row, share in enumerate(u.tolist()):
            for i, j, k in np.ndindex(3, 3, 3):
                weight = basis(i, share[0]) * basis(j, share[1]) * basis(k, share[2])
                expected[row] += weight * cage.offset[i, j, k]
        assert torch.allclose(bent(points, cage), expected, atol=1e-5)

    def test_what_a_placement_can_do_is_no_bending(self):
        points = control_points(some_cage(torch.zeros(3, 3, 3, 3)))
        g = torch.Generator().manual_seed(2)
        affine = points @ torch.randn(3, 3, generator=g) + torch.randn(3, generator=g)
        affine[..., 1] = 0.7 * points[..., 1]  # what leaves the floor flat can only stretch
        assert float(even(affine[None]).abs().max()) < 1e-5

    def test_bending_is_the_same_left_and_right_leaves_the_floor_and_is_found_once(self):
        free = torch.randn(2, 3, 3, 3, 3, generator=torch.Generator().manual_seed(3))
        part = even(free)
        mirror = torch.tensor([-1.0, 1.0, 1.0])
        assert torch.allclose(part.flip(1) * mirror, part, atol=1e-6)
        assert float(part[:, :, 0, :, 1].abs().max()) == 0
        assert torch.allclose(even(part), part, atol=1e-5)


def narrow(share: float) -> torch.Tensor:
    """A box that is narrower above and wider below."""
    x, y = torch.linspace(-1, 1, 3)[:, None, None], torch.linspace(-1, 1, 3)[None, :, None]
    offset = torch.zeros(3, 3, 3, 3)
    offset[..., 0] = (-share * x * y).expand(3, 3, 3)
    return offset


def given_narrow(share: float = 0.08):
    """Boxes are seen; the second of them is given as a frustum."""
    known = make_inputs()
    size = known.objects.size
    half = size[1] * torch.tensor([0.5, 0.0, 0.5])
    cage = Cage(-half, size[1] - half, narrow(share) * size[1])
    verts = known.objects.verts.clone()
    verts[1] = bent(verts[1], cage)
    size = size.clone()
    size[1] = verts[1].amax(0) - verts[1].amin(0)
    image = replace(known.image, given=None, measured=None)
    return replace(known, objects=replace(known.objects, verts=verts, size=size), image=image,
                   humans=HumanCues())  # fmt: skip


def found_with(loose: list[bool]):
    known = given_narrow()
    layout = type(known.starts)(*(x[0] for x in vars(known.starts).values()))
    inputs = BendInputs(known, PRICE, layout, torch.tensor(loose))
    return known, layout, bend_shapes(inputs, BendConfig())


def test_a_frustum_is_bent_to_the_box_that_is_seen_and_fits_then():
    known, layout, found = found_with([False, True, False])
    offset = found.offset[1]
    likeness = torch.nn.functional.cosine_similarity(
        offset.flatten(), -narrow(0.08).flatten(), dim=0
    )
    assert float(likeness) > 0.5
    left = [
        float(scene_energy(at, objects, known.camera, known.image, HumanCues(), PRICE).per_item[1])
        for objects, at in (
            (known.objects, layout),
            (lambda p: (p[0].objects, p[1]))(with_shapes(prepared_of(known), found)),
        )
    ]
    assert left[1] < 0.4 * left[0]


def prepared_of(known) -> Prepared:
    n = len(known.objects.ids)
    layout = type(known.starts)(*(x[0] for x in vars(known.starts).values()))
    return Prepared(known.objects, layout, torch.zeros(n, 3), torch.ones(n, 3), ())


def test_what_is_not_loose_stays_to_the_bit():
    known, layout, found = found_with([False, True, False])
    prepared, moved = with_shapes(prepared_of(known), found)
    for i in (0, 2):
        assert torch.equal(prepared.objects.verts[i], known.objects.verts[i])
        assert torch.equal(prepared.objects.size[i], known.objects.size[i])
        for a, b in zip(vars(moved).values(), vars(layout).values(), strict=True):
            assert torch.equal(a[i], b[i])
        assert not bool(found.offset[i].any())


def test_a_shape_is_bent_alike_alone_and_among_others():
    (_, _, alone), (_, _, among) = found_with([False, True, False]), found_with([True] * 3)
    assert torch.allclose(alone.offset[1], among.offset[1], atol=1e-6)
    for a, b in zip(vars(alone.layout).values(), vars(among.layout).values(), strict=True):
        assert torch.allclose(a[1], b[1], atol=1e-6)
    assert bool(among.offset[0].any())


def piece_of(mesh: Mesh, file: str) -> SceneObject:
    zero = torch.zeros(())
    return SceneObject(
        "box", "table", mesh, file, None, "ground", torch.zeros(3), zero, torch.ones(3)
    )


def test_the_users_mesh_and_the_proxy_are_bent_alike_and_told_of():
    known, _, found = found_with([False, True, False])
    center, scale = torch.tensor([[0.1, 0.2, 0.3]] * 3), torch.tensor([[2.0, 0.5, 1.0]] * 3)
    before = replace(prepared_of(known), center=center, scale=scale)
    prepared, layout = with_shapes(before, found)
    meshes = [Mesh(known.objects.verts[i] / scale[i] + center[i], known.objects.faces[i])
              for i in range(3)]  # fmt: skip
    pieces = tuple(piece_of(mesh, "") for mesh in meshes)
    out = to_objects(pieces, prepared, layout)
    own = (out[1].mesh.verts - center[1]) * scale[1]
    assert torch.allclose(own, prepared.objects.verts[1], atol=1e-5)
    low, high = own.amin(0), own.amax(0)
    assert torch.allclose(high - low, known.objects.size[1], atol=1e-5)
    assert torch.equal(prepared.objects.size, known.objects.size)
    assert torch.allclose((low + high)[[0, 2]], torch.zeros(2), atol=1e-5)
    assert float(low[1]) == pytest.approx(0, abs=1e-6)
    assert out[0] is not pieces[0]
    assert out[0].cage is None
    assert torch.equal(out[0].mesh.verts, meshes[0].verts)
    (sentence,) = told_of_shapes(out)
    assert sentence.startswith("box: its mesh does not fit the image and is bent, by up to")


@pytest.mark.parametrize("ending", [".glb", ".obj"])
def test_a_bent_file_keeps_its_faces_and_its_texture(tmp_path, ending):
    source = tmp_path / f"chair{ending}"
    shape = textured()
    scene = trimesh.Scene()
    turn = trimesh.transformations.rotation_matrix(0.3, [0, 1, 0], [1, 0, 0])
    scene.add_geometry(shape, transform=turn)
    scene.export(source)
    camera = Camera(torch.eye(3) * 500, torch.eye(3), 640, 480)
    whole = trimesh.load_scene(source, process=False).to_mesh()
    mesh = Mesh(torch.tensor(np.array(whole.vertices)).float(), torch.tensor(np.array(whole.faces)))
    low, high = mesh.verts.amin(0), mesh.verts.amax(0)
    cage = Cage(low, high, narrow(0.2) * (high - low))
    bent_mesh = Mesh(bent(mesh.verts, cage), mesh.faces)
    piece = replace(piece_of(bent_mesh, str(source)), cage=cage)
    before = source.read_bytes()
    write_scene(Scene(camera, 0.0, (piece,)), tmp_path / "out" / "scene.json")
    read = read_scene(tmp_path / "out" / "scene.json").objects[0]
    assert len(read.mesh.faces) == len(mesh.faces)
    ends = (read.mesh.verts.amin(0), read.mesh.verts.amax(0))
    for found, expected in zip(ends, (bent_mesh.verts.amin(0), bent_mesh.verts.amax(0)),
                               strict=True):  # fmt: skip
        assert torch.allclose(found, expected, atol=1e-4)
    part = next(iter(trimesh.load_scene(read.mesh_file).geometry.values()))
    assert part.visual.material.to_simple().image is not None
    assert source.read_bytes() == before
    write_glb(Scene(camera, 0.0, (piece,)), None, tmp_path / "room.glb")
    room = trimesh.load_scene(tmp_path / "room.glb").to_mesh()
    assert np.allclose(room.bounds[1][1], float(bent_mesh.verts.amax(0)[1]), atol=1e-4)
