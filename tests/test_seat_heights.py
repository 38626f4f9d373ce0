"""Seats of meshes that do not fit are put where people sit; feet, backs and the rest stay."""

from dataclasses import replace

import pytest
import torch
from figures import ARMS_DOWN, SEATED, people, pose, turned

from mover.bodies.parts import members, parts_of
from mover.core.types import Bodies, Cage, Mesh, SceneObject
from mover.furniture.floor import Floor
from mover.furniture.library import catalogue
from mover.geometry.cage import bent
from mover.geometry.placement import place_object
from mover.stages.config import BendConfig, PrepareConfig
from mover.stages.objects.bend_shapes import with_lifted_seats
from mover.stages.objects.prepare_objects import (
    Prepared,
    PrepareInputs,
    prepare_objects,
    proxy_meshes,
    to_objects,
)
from mover.stages.objects.seat_heights import LOWEST, SeatInputs, find_seat_heights

FLOOR = Floor(0.0)
SITTERS = people(pose(SEATED, 5), fps=5.0)
PARTS = parts_of(SITTERS)
CARRIED = members(PARTS, "seat", "left_thigh", "right_thigh")
MIDDLE = SITTERS.verts[0, CARRIED].mean(0)


def told(bodies: Bodies) -> float:
    """How high the seat of the first of them is."""
    return float(bodies.verts[0, CARRIED, 1].quantile(LOWEST))


def furniture(higher: float, *categories: str) -> tuple[tuple[SceneObject, ...], Prepared]:
    """Pieces below the sitters, the seat of the first so much higher than they sit."""
    pieces = []
    for k, category in enumerate(categories):
        shape = catalogue(category)[0]
        low, high = shape.mesh.verts.amin(0), shape.mesh.verts.amax(0)
        grown = (told(SITTERS) + higher) / shape.seat_height
        base = grown * (low + high) / 2 * torch.tensor([1.0, 0.0, 1.0])
        place = MIDDLE * torch.tensor([1.0, 0.0, 1.0]) - base
        pieces.append(SceneObject(
            f"{category}_{k}", category, shape.mesh, "", None, "ground", place, torch.tensor(0.0),
            torch.full((3,), grown),
        ))  # fmt: skip
    return tuple(pieces), prepare_objects(PrepareInputs(tuple(pieces)), PrepareConfig())


def asked(prepared: Prepared, bodies: Bodies, loose: bool = True) -> SeatInputs:
    rows = torch.arange(len(bodies.frame))
    pairs = torch.stack([rows, torch.zeros_like(rows), torch.zeros_like(rows)], -1)
    doubt = torch.full((len(prepared.objects.ids),), loose)
    return SeatInputs(prepared.objects, prepared.start, bodies, PARTS, FLOOR, pairs, doubt)


def seat_of(prepared: Prepared, k: int = 0) -> float:
    return float(prepared.objects.top[k, :, 1].median())


@pytest.mark.parametrize("higher", [-0.06, 0.08])
def test_a_seat_is_moved_to_who_sits_on_it_and_feet_and_back_stay(higher: float) -> None:
    _, prepared = furniture(higher, "chair")
    found = find_seat_heights(asked(prepared, SITTERS), BendConfig())
    believed = 1 / (1 + (0.025 / 0.07) ** 2)
    assert float(found.lift[0]) == pytest.approx(-believed * higher, abs=0.006)
    after = with_lifted_seats(prepared, found.lift)
    gap = seat_of(after) - seat_of(prepared)
    assert gap == pytest.approx(float(found.lift[0]), abs=0.003)
    before, now = prepared.objects.verts[0], after.objects.verts[0]
    for end in (before[:, 1].argmin(), before[:, 1].argmax()):
        assert torch.allclose(now[end], before[end], atol=1e-5)
    assert torch.equal(now[:, [0, 2]], before[:, [0, 2]])  # raised, not moved
    order = before[:, 1].argsort()
    assert bool((now[order, 1].diff() > -1e-5).all())  # nothing is turned inside out


def test_what_was_lifted_once_is_there_and_is_not_lifted_again() -> None:
    _, prepared = furniture(0.08, "chair")
    for share in (0.08, 0.02):
        lift = find_seat_heights(asked(prepared, SITTERS), BendConfig(seat=1.0)).lift
        assert abs(float(lift[0])) < share + 0.01
        prepared = with_lifted_seats(prepared, lift)
    assert seat_of(prepared) == pytest.approx(told(SITTERS), abs=0.01)


def test_nobody_too_few_and_a_shape_that_fits_move_nothing() -> None:
    _, prepared = furniture(0.08, "chair", "chair")
    standing = people(pose(ARMS_DOWN, 5), fps=5.0)
    few = replace(
        SITTERS, **{k: getattr(SITTERS, k)[:2] for k in ("verts", "frame", "person")}, pose=None
    )
    for inputs in (asked(prepared, SITTERS, loose=False), asked(prepared, few),
                   asked(prepared, standing)):  # fmt: skip
        lift = find_seat_heights(inputs, BendConfig()).lift
        assert not bool(lift.any())
        assert torch.equal(with_lifted_seats(prepared, lift).objects.verts, prepared.objects.verts)
    lift = find_seat_heights(asked(prepared, SITTERS), BendConfig()).lift
    after = with_lifted_seats(prepared, lift)
    assert float(lift[1]) == 0
    for name in ("verts", "samples", "top", "back"):
        pairs = (getattr(p.objects, name)[1] for p in (after, prepared))
        assert torch.equal(*pairs)


def test_who_lies_tells_it_by_the_seat_alone() -> None:
    lying = people(turned(pose(ARMS_DOWN, 5), -1.5708, 0.0, 0.0), fps=5.0)
    verts = lying.verts - lying.verts[:, CARRIED].mean(1, keepdim=True) + MIDDLE
    part = members(PARTS, "seat")
    low = verts[0, part, 1].quantile(LOWEST)
    lying = replace(lying, verts=verts + torch.tensor([0.0, 1, 0]) * (told(SITTERS) - low))
    _, prepared = furniture(0.08, "bed")
    lift = find_seat_heights(asked(prepared, lying), BendConfig()).lift
    believed = 1 / (1 + (0.025 / 0.07) ** 2)
    assert float(lift[0]) == pytest.approx(-believed * 0.08, abs=0.012)


def test_a_seat_that_is_the_top_of_its_piece_is_a_matter_of_size() -> None:
    _, prepared = furniture(0.08, "stool")
    lift = find_seat_heights(asked(prepared, SITTERS), BendConfig()).lift
    assert float(lift[0]) < -0.05
    after = with_lifted_seats(prepared, lift)
    assert torch.equal(after.objects.verts, prepared.objects.verts)


def test_meshes_that_were_bent_keep_that_and_users_meshes_follow() -> None:
    pieces, prepared = furniture(0.08, "chair")
    objects = prepared.objects
    half = objects.size * torch.tensor([0.5, 0.0, 0.5])
    offset = torch.zeros(1, 3, 3, 3, 3)
    offset[:, :, 2, :, 2] = -0.05  # the back leans
    own = Cage(-half, objects.size - half, offset)
    unit, center = prepared.scale, prepared.center
    cages = Cage(own.low / unit + center, own.high / unit + center, offset / unit[0])
    leaning = replace(objects, verts=bent(objects.verts, own), top=bent(objects.top, own))
    prepared = replace(prepared, objects=leaning, cages=cages, straight=objects)
    lift = find_seat_heights(asked(prepared, SITTERS), BendConfig()).lift
    after = with_lifted_seats(prepared, lift)
    assert torch.allclose(after.objects.verts[0][:, [0, 2]], leaning.verts[0][:, [0, 2]], atol=1e-5)
    assert seat_of(after) - seat_of(prepared) == pytest.approx(float(lift[0]), abs=0.003)
    (piece,) = to_objects(pieces, after, after.start)
    (proxy,) = proxy_meshes(after)
    pair = [place_object(replace(piece, mesh=m)).verts for m in (piece.mesh, proxy)]
    for a, b in zip((x.amin(0) for x in pair), (x.amax(0) for x in pair), strict=True):
        assert bool((b > a).all())
    ends = [torch.stack([x.amin(0), x.amax(0)]) for x in pair]
    assert torch.allclose(*ends, atol=0.02)
    flat = bent(pieces[0].mesh.verts, Cage(*(x[0] for x in vars(after.cages).values())))
    assert torch.allclose(piece.mesh.verts, flat, atol=1e-6)
    assert isinstance(piece.mesh, Mesh)
