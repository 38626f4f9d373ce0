"""Boxes: corners, placed boxes, and intersection over union."""

import manifold3d
import numpy as np
import pytest
import torch

from mover.core.types import Mesh, SceneObject
from mover.geometry.boxes import Box, box_of, corners, iou2d, iou3d
from mover.geometry.placement import place_object
from mover.geometry.rotations import rot_y


def as_solid(box: Box, index: int) -> manifold3d.Manifold:
    turn = np.zeros((3, 4))
    turn[:, :3] = rot_y(box.yaw[index]).numpy()
    turn[:, 3] = box.center[index].numpy()
    return manifold3d.Manifold.cube(box.size[index].tolist(), True).transform(turn)  # pyright: ignore[reportArgumentType]


def by_manifold(a: Box, b: Box, index: int) -> float:
    one, two = as_solid(a, index), as_solid(b, index)
    shared = (one ^ two).volume()
    return shared / (one.volume() + two.volume() - shared)


def random_boxes(count: int, seed: int) -> Box:
    generator = torch.Generator().manual_seed(seed)
    rows = torch.rand(count, 7, generator=generator, dtype=torch.float64)
    return Box(1.5 * rows[:, :3], 0.05 + 2 * rows[:, 3:6], 14 * (rows[:, 6] - 0.5))


def test_iou_is_that_of_exact_solids_on_hundreds_of_pairs():
    a, b = random_boxes(300, 0), random_boxes(300, 1)
    found = iou3d(a, b)
    expected = torch.tensor([by_manifold(a, b, k) for k in range(300)], dtype=torch.float64)
    assert (expected == 0).sum() > 15
    assert (expected > 0.1).sum() > 30
    # manifold3d snaps touching geometry at about 1e-12 of the size
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-6)


def boxes_at(center: list[float], size: list[float], yaw: float) -> Box:
    return Box(*(torch.tensor([part], dtype=torch.float64) for part in (center, size, yaw)))


@pytest.mark.parametrize("yaw", [0.0, 0.1, np.pi / 4, np.pi / 2, 3.0, -1e-9])
@pytest.mark.parametrize(("center", "size", "other", "expected"), [
    pytest.param([0, 0, 0], [1, 1, 1], 0.0, 1.0, id="identical"),
    pytest.param([0, 0, 0], [1, 1, 1], np.pi / 2, 1.0, id="identical after a quarter turn"),
    pytest.param([0, 0, 0], [0.5, 0.5, 0.5], 0.7, 0.125, id="nested"),
    pytest.param([0.5, 0, 0], [1, 1, 1], 0.0, 1 / 3, id="half covered"),
    pytest.param([1, 0, 0], [1, 1, 1], 0.0, 0.0, id="touching sides"),
    pytest.param([0, 1, 0], [1, 1, 1], 0.3, 0.0, id="touching above"),
    pytest.param([1, 0, 1], [1, 1, 1], 0.0, 0.0, id="touching edges"),
    pytest.param([5, 0, 0], [1, 1, 1], 0.3, 0.0, id="apart"),
    pytest.param([0, 0, 0], [1, 1, 1], np.pi / 4, 2**0.5 / 2, id="octagon"),
])  # fmt: skip
def test_iou_of_special_pairs_is_exact(yaw, center, size, other, expected):
    a = boxes_at([1.0, 2.0, -3.0], [1, 1, 1], yaw)
    moved = rot_y(a.yaw)[0] @ torch.tensor(center, dtype=torch.float64) + a.center[0]
    b = boxes_at(moved.tolist(), size, yaw + other)
    assert float(iou3d(a, b)) == pytest.approx(expected, abs=1e-9)
    assert float(iou3d(b, a)) == pytest.approx(expected, abs=1e-9)


def test_iou_of_empty_boxes_is_zero_and_keeps_leading_axes_and_precision():
    empty = boxes_at([0, 0, 0], [0, 0, 0], 0)
    assert float(iou3d(empty, empty)) == 0
    rows = random_boxes(6, 2)
    folded = Box(*(x.float().unflatten(0, (2, 3)) for x in (rows.center, rows.size, rows.yaw)))
    found = iou3d(folded, folded)
    assert found.shape == (2, 3)
    assert found.dtype == torch.float32
    torch.testing.assert_close(found, torch.ones(2, 3))


def test_corners_are_in_their_documented_order():
    box = boxes_at([1, 2, 3], [2, 4, 6], 0)
    expected = [[x, y, z] for x in (0.0, 2.0) for y in (0.0, 4.0) for z in (0.0, 6.0)]
    torch.testing.assert_close(corners(box)[0], torch.tensor(expected, dtype=torch.float64))
    turned = boxes_at([0, 0, 0], [2, 4, 6], np.pi / 2)  # +z of the box is +x of the world
    assert corners(turned)[0, 7].tolist() == pytest.approx([3, 2, -1])


def test_the_box_of_a_piece_has_the_corners_of_its_placed_box_mesh():
    verts = torch.cartesian_prod(*[torch.tensor([0.0, 1.0])] * 3) * torch.tensor([1.0, 2.0, 0.5])
    faces = torch.tensor([[0, 1, 2], [3, 4, 5], [5, 6, 7]])
    unused = torch.full((1, 3), 50.0)
    piece = SceneObject(
        id="shelf_0", category="shelf", mesh=Mesh(torch.cat([verts, unused]), faces),
        mesh_file="", annotation=None, support="ground", yaw=torch.tensor(0.8),
        t_world_object=torch.tensor([0.3, -1, -2]), scale=torch.tensor([1.5, 0.5, 2]),
    )  # fmt: skip
    box = box_of(piece)
    torch.testing.assert_close(box.size, torch.tensor([1.5, 1.0, 1.0]))
    torch.testing.assert_close(corners(box), place_object(piece).verts[:8])


def test_iou_of_image_boxes():
    a = torch.tensor([[0.0, 0, 2, 2], [0, 0, 1, 1], [0, 0, 1, 1], [0, 0, 0, 0]])
    b = torch.tensor([[1.0, 1, 3, 3], [0, 0, 1, 1], [1, 0, 2, 1], [0, 0, 0, 0]])
    torch.testing.assert_close(iou2d(a, b), torch.tensor([1 / 7, 1, 0, 0]))
