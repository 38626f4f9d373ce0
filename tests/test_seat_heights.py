"""Seats of meshes that do not fit are put where people sit; feet, backs and the rest stay."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from figures import ARMS_DOWN, SEATED, people, pose, turned
from test_export import textured

from mover.bodies.parts import members, parts_of
from mover.core.records import rows_of
from mover.core.types import Bodies, Camera, Mesh, Scene, SceneObject, SeatStretch
from mover.furniture.library import catalogue
from mover.geometry.placement import place_object
from mover.io.capture.scene_file import read_scene, write_scene
from mover.io.export.scene_glb import write_glb
from mover.stages.config import PrepareConfig
from mover.stages.objects.prepare_objects import (
    Prepared,
    PrepareInputs,
    prepare_objects,
    proxy_meshes,
    to_objects,
)
from mover.stages.objects.seat_heights import (
    LOWEST,
    SeatInputs,
    find_seat_heights,
    seat_warnings,
    with_lifted_seats,
)

FLOOR = 0.0
WEIGHTED = 1 / (1 + (0.025 / 0.07) ** 2)
SITTERS = people(pose(SEATED, 5), fps=5.0)
PARTS = parts_of(SITTERS)
CARRIED = members(PARTS, "seat", "left_thigh", "right_thigh")
MIDDLE = SITTERS.verts[0, CARRIED].mean(0)


def seat_height(bodies: Bodies) -> float:
    """How high the seat of the first of them is."""
    return float(bodies.verts[0, CARRIED, 1].quantile(LOWEST))


def furniture(higher: float, *categories: str) -> tuple[tuple[SceneObject, ...], Prepared]:
    """Pieces below the sitters, the seat of the first so much higher than they sit."""
    pieces = []
    for k, category in enumerate(categories):
        shape = catalogue(category)[0]
        low, high = shape.mesh.verts.amin(0), shape.mesh.verts.amax(0)
        grown = (seat_height(SITTERS) + higher) / shape.seat_height
        base = grown * (low + high) / 2 * torch.tensor([1.0, 0.0, 1.0])
        place = MIDDLE * torch.tensor([1.0, 0.0, 1.0]) - base
        pieces.append(SceneObject(
            f"{category}_{k}", category, shape.mesh, "", None, "ground", place, torch.tensor(0.0),
            torch.full((3,), grown),
        ))  # fmt: skip
    return tuple(pieces), prepare_objects(PrepareInputs(tuple(pieces)), PrepareConfig())


def asked(prepared: Prepared, bodies: Bodies, unfit: bool = True) -> SeatInputs:
    rows = torch.arange(len(bodies.frame))
    pairs = torch.stack([rows, torch.zeros_like(rows), torch.zeros_like(rows)], -1)
    shapes = torch.full((len(prepared.objects.ids),), unfit)
    return SeatInputs(prepared.objects, prepared.start, bodies, PARTS, FLOOR, pairs, shapes)


def seat_of(prepared: Prepared, k: int = 0) -> float:
    return float(prepared.objects.top[k, :, 1].median())


@pytest.mark.parametrize("higher", [-0.06, 0.08])
def test_a_seat_is_moved_to_who_sits_on_it_and_feet_and_back_stay(higher: float) -> None:
    _, prepared = furniture(higher, "chair")
    lift = find_seat_heights(asked(prepared, SITTERS))
    assert float(lift[0]) == pytest.approx(-WEIGHTED * higher, abs=0.006)
    after = with_lifted_seats(prepared, lift)
    gap = seat_of(after) - seat_of(prepared)
    assert gap == pytest.approx(float(lift[0]), abs=1e-5)
    before, now = prepared.objects.verts[0], after.objects.verts[0]
    assert float((now - before).abs().amax()) <= abs(gap) + 1e-6  # nothing moves farther
    for end in (before[:, 1].argmin(), before[:, 1].argmax()):
        assert torch.allclose(now[end], before[end], atol=1e-5)
    assert torch.equal(now[:, [0, 2]], before[:, [0, 2]])  # raised, not moved
    order = before[:, 1].argsort()
    assert bool((now[order, 1].diff() > -1e-5).all())  # nothing is turned inside out


def test_what_was_lifted_once_is_there_and_is_not_lifted_again() -> None:
    _, prepared = furniture(0.08, "chair")
    for share in (0.08, 0.02):
        lift = find_seat_heights(asked(prepared, SITTERS))
        assert abs(float(lift[0])) < share + 0.01
        prepared = with_lifted_seats(prepared, lift)
    assert seat_of(prepared) == pytest.approx(seat_height(SITTERS), abs=0.01)


def test_no_people_too_few_and_a_shape_that_fits_move_nothing() -> None:
    _, prepared = furniture(0.08, "chair", "chair")
    standing = people(pose(ARMS_DOWN, 5), fps=5.0)
    few = replace(rows_of(SITTERS, torch.arange(2)), pose=None)
    for inputs in (asked(prepared, SITTERS, unfit=False), asked(prepared, few),
                   asked(prepared, standing)):  # fmt: skip
        lift = find_seat_heights(inputs)
        assert not bool(lift.any())
        assert torch.equal(with_lifted_seats(prepared, lift).objects.verts, prepared.objects.verts)
    lift = find_seat_heights(asked(prepared, SITTERS))
    after = with_lifted_seats(prepared, lift)
    assert float(lift[1]) == 0
    for name in ("verts", "samples", "top", "back"):
        pairs = (getattr(p.objects, name)[1] for p in (after, prepared))
        assert torch.equal(*pairs)


def test_lying_people_give_it_by_the_seat_alone() -> None:
    lying = people(turned(pose(ARMS_DOWN, 5), -1.5708, 0.0, 0.0), fps=5.0)
    verts = lying.verts - lying.verts[:, CARRIED].mean(1, keepdim=True) + MIDDLE
    part = members(PARTS, "seat")
    low = verts[0, part, 1].quantile(LOWEST)
    lying = replace(lying, verts=verts + torch.tensor([0.0, 1, 0]) * (seat_height(SITTERS) - low))
    _, prepared = furniture(0.08, "bed")
    lift = find_seat_heights(asked(prepared, lying))
    assert float(lift[0]) == pytest.approx(-WEIGHTED * 0.08, abs=0.012)


def test_a_seat_that_is_the_top_of_its_piece_is_a_matter_of_size() -> None:
    _, prepared = furniture(0.08, "stool")
    lift = find_seat_heights(asked(prepared, SITTERS))
    assert float(lift[0]) < -0.05
    after = with_lifted_seats(prepared, lift)
    assert torch.equal(after.objects.verts, prepared.objects.verts)


def test_users_meshes_follow_and_it_is_said() -> None:
    pieces, prepared = furniture(0.08, "chair")
    after = with_lifted_seats(prepared, find_seat_heights(asked(prepared, SITTERS)))
    (piece,) = to_objects(pieces, after, after.start)
    (proxy,) = proxy_meshes(after)
    pair = [place_object(replace(piece, mesh=m)).verts for m in (piece.mesh, proxy)]
    ends = [torch.stack([x.amin(0), x.amax(0)]) for x in pair]
    assert torch.allclose(*ends, atol=0.02)
    moved = piece.mesh.verts - pieces[0].mesh.verts
    assert not bool(moved[:, [0, 2]].any())
    center, scale = prepared.center[0], prepared.scale[0]
    own = (pieces[0].mesh.verts - center) * scale
    expected = after.stretch.of(own[None])[0] / scale + center
    assert torch.allclose(piece.mesh.verts, expected, atol=1e-6)
    (warning,) = seat_warnings((piece,))
    assert warning.startswith("chair_0: its mesh does not fit the image and its seat is moved")
    assert seat_warnings(pieces) == ()


@pytest.mark.parametrize("ending", [".glb", ".obj"])
def test_a_raised_file_keeps_its_faces_and_its_texture(tmp_path, ending):
    source = tmp_path / f"chair{ending}"
    scene = trimesh.Scene()
    turn = trimesh.transformations.rotation_matrix(0.3, [0, 1, 0], [1, 0, 0])
    scene.add_geometry(textured(), transform=turn)
    scene.export(source)
    camera = Camera(torch.eye(3) * 500, torch.eye(3), 640, 480)
    whole = trimesh.load_scene(source, process=False).to_mesh()
    mesh = Mesh(torch.tensor(np.array(whole.vertices)).float(), torch.tensor(np.array(whole.faces)))
    low, high = mesh.verts[:, 1].amin(), mesh.verts[:, 1].amax()
    size = high - low
    stretch = SeatStretch(low - 0.5 * size, low + 0.3 * size, high, 0.15 * size)
    raised = Mesh(stretch.of(mesh.verts), mesh.faces)
    piece = SceneObject(
        "box", "table", raised, str(source), None, "ground", torch.zeros(3), torch.zeros(()),
        torch.ones(3), stretch=stretch,
    )  # fmt: skip
    before = source.read_bytes()
    write_scene(Scene(camera, 0.0, (piece,)), tmp_path / "out" / "scene.json")
    read = read_scene(tmp_path / "out" / "scene.json").objects[0]
    assert len(read.mesh.faces) == len(mesh.faces)
    assert float(raised.verts[:, 1].amin()) > float(low)
    for end in ("amin", "amax"):
        found, expected = (getattr(m.verts, end)(0) for m in (read.mesh, raised))
        assert torch.allclose(found, expected, atol=1e-4)
    part = next(iter(trimesh.load_scene(read.mesh_file).geometry.values()))
    assert part.visual.material.to_simple().image is not None
    assert source.read_bytes() == before
    write_glb(Scene(camera, 0.0, (piece,)), None, tmp_path / "room.glb")
    room = trimesh.load_scene(tmp_path / "room.glb").to_mesh()
    assert np.allclose(room.bounds[0][1], float(raised.verts.amin(0)[1]), atol=1e-4)
