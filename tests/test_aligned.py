"""Harm and the error of the whole: what `evaluate` says beside the means of objects."""

from dataclasses import replace

import pytest
import torch
from judged import room

from mover.core.types import Scene
from mover.evaluate.evaluation import evaluate
from mover.geometry.rotations import rot_y


def grown(scene: Scene, scale: float, yaw: float, step: tuple[float, float, float]) -> Scene:
    """The scene after an upright similarity."""
    turn = scale * rot_y(torch.tensor(yaw).double())
    pieces = [
        replace(p, t_world_object=turn @ p.t_world_object + torch.tensor(step),
                yaw=p.yaw + yaw, scale=p.scale * scale)
        for p in scene.objects
    ]  # fmt: skip
    return replace(scene, objects=tuple(pieces))


def moved(scene: Scene, index: int, z: float) -> Scene:
    pieces = list(scene.objects)
    place = pieces[index].t_world_object + torch.tensor([0.0, 0.0, z])
    pieces[index] = replace(pieces[index], t_world_object=place)
    return replace(scene, objects=tuple(pieces))


def test_a_similarity_of_the_whole_room_costs_nothing_once_it_is_taken_out() -> None:
    truth = room()
    found = evaluate(truth, grown(truth, 0.9, 0.1, (0.2, 0.05, -0.3)), truth)["result"]
    assert found["iou3d"] < 0.7
    assert found["iou3d_aligned"] == pytest.approx(1.0, abs=1e-4)


def test_two_objects_fit_always_so_that_they_say_nothing() -> None:
    truth = replace(room(), objects=room().objects[:2])
    assert "iou3d_aligned" not in evaluate(truth, truth, truth)["result"]


def test_a_missing_object_counts_as_none_after_the_similarity_too() -> None:
    truth = room()
    other = replace(moved(truth, 0, 1.5).objects[0], id="other", annotation=None)
    more = replace(truth, objects=(*truth.objects, other))
    found = evaluate(truth, truth, more)["result"]
    assert found["iou3d_aligned"] == pytest.approx(len(truth.objects) / len(more.objects), abs=1e-4)


@pytest.mark.parametrize(("off", "by_10"), [(0.05, 0), (0.15, 1), (-0.3, 1), (0.7, 1)])
def test_objects_that_end_farther_from_the_truth_than_given_are_counted(off, by_10):
    truth = room()
    found = evaluate(truth, moved(truth, 0, off), truth)
    count = len(truth.objects)
    assert found["result"]["worse_by_10cm"] == pytest.approx(by_10 / count)
    assert found["objects"][0]["result"]["worse_by_10cm"] == by_10
    assert found["initial"]["worse_by_10cm"] == 0


def test_what_was_given_wrong_and_comes_nearer_is_no_harm() -> None:
    truth = room()
    found = evaluate(moved(truth, 0, 2.0), moved(truth, 0, 1.0), truth)["result"]
    assert found["worse_by_10cm"] == 0
