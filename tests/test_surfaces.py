"""ADD-S and the turn that ICP makes, against naive loops and known motions."""

import dataclasses
import math

import numpy as np
import pytest
import torch
import trimesh
from furnished import furnished
from little_room import camera

from mover.core.types import Mesh, SceneObject
from mover.evaluate.evaluation import evaluate
from mover.evaluate.scene import (
    Pair,
    add_s,
    add_s_01,
    icp_rotation,
    yaw_error,
    yaw_error_symmetric,
)
from mover.evaluate.surfaces import add_s as share_of
from mover.evaluate.surfaces import diameter, icp_turn


def pair(estimate: SceneObject, truth: SceneObject) -> Pair:
    return Pair(estimate, camera(), truth, camera(), 100)


def moved(piece: SceneObject, shift: float = 0.0, yaw: float = 0.0) -> SceneObject:
    away = torch.tensor([shift, 0.0, 0.0])
    return dataclasses.replace(
        piece, t_world_object=piece.t_world_object + away, yaw=piece.yaw + yaw
    )


def test_add_s_is_the_mean_of_both_directions_over_the_diameter():
    rng = np.random.default_rng(0)
    a, b = rng.normal(size=(40, 3)), rng.normal(size=(30, 3)) + 0.5
    there = [min(math.dist(p, q) for q in b) for p in a]
    back = [min(math.dist(p, q) for q in a) for p in b]
    widest = max(math.dist(p, q) for p in b for q in b)
    truth = (sum(there) / len(there) + sum(back) / len(back)) / 2 / widest
    estimate, true = torch.from_numpy(a), torch.from_numpy(b)
    assert share_of(estimate, true) == pytest.approx(truth)
    assert diameter(true) == pytest.approx(widest)


def test_a_perfect_object_is_within_a_tenth_and_one_that_is_a_metre_off_is_not():
    (chair,) = furnished(("chair",)).objects
    assert add_s(pair(chair, chair)) == 0
    assert add_s_01(pair(chair, chair)) == 1
    assert add_s_01(pair(moved(chair, 1.0), chair)) == 0
    values = [add_s(pair(moved(chair, shift), chair)) for shift in (0.02, 0.1, 0.3, 1.0)]
    assert values == sorted(values)


@pytest.mark.parametrize("degrees", [4.0, -12.0])
@pytest.mark.parametrize("name", ["chair", "sofa", "shelf"])
def test_icp_turns_a_piece_back_by_as_much_as_it_was_turned(name: str, degrees: float):
    (piece,) = furnished((name,)).objects
    found = icp_rotation(pair(moved(piece, 0.03, math.radians(degrees)), piece))
    assert math.degrees(found) == pytest.approx(abs(degrees), abs=1.5)


def test_a_round_thing_needs_no_turn_whatever_its_front_is_called():
    angle = torch.arange(200) * (math.pi * (3 - 5**0.5))
    radius = (torch.arange(200) / 200).sqrt() * 0.5
    disc = torch.stack([radius * angle.cos(), torch.zeros(200), radius * angle.sin()], -1)
    turn = torch.tensor(0.6)
    turned = torch.stack([
        turn.cos() * disc[:, 0] + turn.sin() * disc[:, 2], disc[:, 1],
        turn.cos() * disc[:, 2] - turn.sin() * disc[:, 0],
    ], -1)  # fmt: skip
    assert icp_turn(turned, disc) < 0.1
    (chair,) = furnished(("chair",)).objects
    assert yaw_error(pair(moved(chair, yaw=0.6), chair)) == pytest.approx(0.6)


def shaped(category: str, mesh: Mesh) -> SceneObject:
    (like,) = furnished(("table",)).objects
    return dataclasses.replace(like, category=category, mesh=mesh)


def box_mesh(width: float, depth: float, turn: float = 0.0) -> Mesh:
    """A box by trimesh, turned in its own frame."""
    made = trimesh.creation.box((width, 0.7, depth))
    made.apply_transform(trimesh.transformations.rotation_matrix(turn, [0, 1, 0]))
    return Mesh(torch.from_numpy(made.vertices).float(), torch.from_numpy(made.faces).long())


def test_sides_that_look_alike_are_no_error():
    round_top = trimesh.creation.cylinder(0.5, 0.7, sections=72)
    round_top.apply_transform(trimesh.transformations.rotation_matrix(math.pi / 2, [1, 0, 0]))
    disc = Mesh(
        torch.from_numpy(np.array(round_top.vertices)).float(),
        torch.from_numpy(np.array(round_top.faces)).long(),
    )
    long, square = box_mesh(1.6, 0.8), box_mesh(0.9, 0.9)
    for turn in (0.1, math.pi / 2 + 0.1, math.pi - 0.1, -math.pi / 2):
        error = {
            name: yaw_error_symmetric(pair(moved(p, yaw=turn), p))
            for name, p in {
                "disc": shaped("table", disc),
                "square": shaped("side table", square),
                "long": shaped("table", long),
                "cabinet": shaped("cabinet", long),
            }.items()
        }
        assert error["disc"] == 0
        assert error["square"] == pytest.approx(0.1 if abs(turn) != math.pi / 2 else 0, abs=1e-5)
        half = min(abs(turn), math.pi - abs(turn))
        assert error["long"] == pytest.approx(half, abs=1e-5)
        assert error["cabinet"] == pytest.approx(abs(turn), abs=1e-5)  # it has a front


def test_a_table_with_one_shelf_is_turned_by_half_a_circle():
    top, side = trimesh.creation.box((1.6, 0.05, 0.8)), trimesh.creation.box((0.05, 0.7, 0.8))
    side.apply_translation([0.7, -0.35, 0])
    both = trimesh.util.concatenate([top, side])
    mesh = Mesh(torch.from_numpy(both.vertices).float(), torch.from_numpy(both.faces).long())
    piece = shaped("table", mesh)
    assert yaw_error_symmetric(pair(moved(piece, yaw=3.0), piece)) == pytest.approx(3.0)


def test_a_missing_object_counts_in_the_share():
    scene = furnished(("chair", "sofa"))
    lost = dataclasses.replace(scene, objects=scene.objects[:1])
    found = evaluate(lost, lost, scene)
    assert found["result"]["add_s_01"] == 0.5
    assert found["result"]["add_s"] == 0
