import numpy as np
import pytest
import torch
import trimesh
from analytic import FACES, box_verts
from reference import use_threads

from mover.core.types import Layout, Mesh, SceneObject
from mover.furniture.library import BACKS, PIECES, SEATS, make_piece
from mover.geometry.mesh import box, signed_volume
from mover.geometry.placement import place, place_object
from mover.geometry.topology import is_closed
from mover.stages.config import PrepareConfig
from mover.stages.objects.prepare_objects import (
    PrepareInputs,
    prepare_objects,
    proxy_meshes,
    to_objects,
)

LIGHT = PrepareConfig(cells=48, samples=200, region=100)


def piece_of(mesh, category="chair", name="a", **fields):
    values = {
        "t_world_object": torch.tensor([0.4, -1.2, -3.0]), "yaw": torch.tensor(0.7),
        "scale": torch.tensor([1.1, 0.9, 1.2]),
    } | fields  # fmt: skip
    return SceneObject(name, category, mesh, "", None, "ground", **values)


def off_centre_box():
    """A mesh whose origin is far from its box."""
    verts = box_verts((0.5, 0.8, 0.4)).float() + torch.tensor([1.0, -2.0, 0.5])
    return Mesh(verts, FACES)


FEW = ("chair", "sofa", "single bed", "table", "shelf")
ALL = [name if name in FEW else pytest.param(name, marks=pytest.mark.slow) for name in PIECES]


@pytest.mark.parametrize("name", ALL)
def test_seats_backs_and_tops_are_where_the_furniture_has_them(name):
    made = make_piece(name, np.random.default_rng(3))
    found = prepare_objects(
        PrepareInputs((piece_of(made.mesh, made.category, scale=torch.ones(3)),)), LIGHT
    )
    objects = found.objects
    top = objects.top[0]
    if made.category in SEATS:
        assert abs(float(top[:, 1].median()) - made.seat_height) < 0.03
    elif made.top_height > 0:
        assert abs(float(top[:, 1].median()) - made.top_height) < 0.03
    assert bool(objects.has_back[0]) == (made.category in BACKS)
    if made.category in BACKS:
        assert float(objects.back[0, :, 1].min()) > made.seat_height
        assert float(objects.back[0, :, 2].mean()) < float(top[:, 2].mean())


def test_a_layout_and_back_gives_the_same_placement_whatever_the_origin():
    pieces = (piece_of(off_centre_box()),)
    prepared = prepare_objects(PrepareInputs(pieces), LIGHT)
    back = to_objects(pieces, prepared, prepared.start)
    torch.testing.assert_close(back[0].t_world_object, pieces[0].t_world_object)
    torch.testing.assert_close(back[0].scale, pieces[0].scale)


def test_proxy_and_mesh_stand_in_the_same_place_after_any_move():
    pieces = (piece_of(off_centre_box()),)
    prepared = prepare_objects(PrepareInputs(pieces), LIGHT)
    layout = Layout(
        torch.tensor([[0.1, -1.5, -2.0]]), torch.tensor([2.0]), torch.tensor([[0.1, -0.2, 0.3]])
    )
    restored = to_objects(pieces, prepared, layout)[0]
    low, high = box(place_object(restored).verts)
    verts = place(prepared.objects.verts, layout)[0]
    plow, phigh = box(verts)
    torch.testing.assert_close(low, plow, atol=2e-5, rtol=0)
    torch.testing.assert_close(high, phigh, atol=2e-5, rtol=0)
    assert abs(float(low[1]) + 1.5) < 1e-5


def test_open_and_inverted_meshes_become_closed_proxies():
    mesh = off_centre_box()
    holed = Mesh(mesh.verts, mesh.faces[2:].flip(-1))
    prepared = prepare_objects(PrepareInputs((piece_of(holed),)), LIGHT)
    proxy = proxy_meshes(prepared)[0]
    assert is_closed(proxy.faces)
    assert signed_volume(proxy) > 0


def test_objects_prepared_beside_each_other_are_those_prepared_one_by_one():
    sphere = trimesh.creation.icosphere(4)
    shapes = []
    for k in range(4):
        bumps = 0.4 + 0.02 * np.sin((3 + k) * sphere.vertices)
        faces = torch.from_numpy(sphere.faces[300 * k :].copy())  # open
        shapes.append(Mesh(torch.from_numpy(sphere.vertices * bumps).float(), faces))
    inputs = PrepareInputs(tuple(piece_of(m, name=str(k)) for k, m in enumerate(shapes)))
    config = PrepareConfig(cells=16, faces=400, samples=100)
    made = []
    for count in (4, 1):
        with use_threads(count):
            made.append(prepare_objects(inputs, config).objects)
    assert torch.equal(made[0].verts, made[1].verts)
    assert torch.equal(made[0].faces, made[1].faces)


def test_supports_name_the_carrying_object():
    table = piece_of(off_centre_box(), "table", "table")
    lamp = SceneObject("lamp", "lamp", off_centre_box(), "", None, "table", *(
        torch.zeros(3), torch.tensor(0.0), torch.ones(3)))  # fmt: skip
    prepared = prepare_objects(PrepareInputs((table, lamp)), LIGHT)
    assert prepared.objects.supports.tolist() == [-1, 0]
