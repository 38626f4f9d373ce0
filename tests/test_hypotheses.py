"""Hypotheses of a first scene: kept in the capture, and starts of the main job."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tiny_capture as tiny
import torch
from test_folder import close
from test_pipeline import light

from mover.core.errors import InputError
from mover.core.run import Run
from mover.core.types import Capture, SceneObject
from mover.furniture.library import make_piece
from mover.geometry.boxes import box_of
from mover.geometry.rotations import rot_y
from mover.io.capture.folder import read_capture, write_capture
from mover.pipeline.reconstruct import reconstruct
from mover.stages.config import PrepareConfig
from mover.stages.objects.place_inputs import PlaceInputs
from mover.stages.objects.prepare_objects import PrepareInputs, prepare_objects
from mover.stages.objects.starts import other_starts

QUICK = PrepareConfig(cells=24, faces=200, samples=50, region=10)


@pytest.fixture
def capture(folder: Path) -> Capture:
    return read_capture(folder)


def elsewhere(piece: SceneObject, step: float) -> SceneObject:
    """Another shape in another place."""
    return replace(
        piece, mesh=make_piece("cabinet", np.random.default_rng(0)).mesh, mesh_file="",
        t_world_object=piece.t_world_object + torch.tensor([step, 0.0, -step]),
        yaw=piece.yaw + step, scale=torch.tensor([1.1, 0.8, 1.3]),
    )  # fmt: skip


def with_others(capture: Capture) -> Capture:
    first, second = capture.scene.objects
    others = (elsewhere(first, 0.4), elsewhere(second, -0.3), elsewhere(first, 0.9))
    return replace(capture, hypotheses=others)


def test_hypotheses_come_back_from_the_folder(capture: Capture, tmp_path: Path):
    given = with_others(capture)
    write_capture(given, tmp_path / "out")
    found = read_capture(tmp_path / "out")
    order = [0, 2, 1]  # object by object
    close(found.hypotheses, tuple(given.hypotheses[k] for k in order))
    assert not [w for w in found.warnings if "hypotheses" in w]


def test_hypotheses_of_another_scene_are_left_out_and_reported(capture: Capture, tmp_path: Path):
    write_capture(with_others(capture), tmp_path / "out")
    tiny.change(tmp_path / "out" / "scene.json", "objects.0.translation.0", -0.4)
    found = read_capture(tmp_path / "out")
    assert {p.id for p in found.hypotheses} == {capture.scene.objects[1].id}
    assert [w for w in found.warnings if "not of this scene" in w and "chair_0" in w]


@pytest.mark.parametrize(("field", "value", "words"), [
    ("format", "x", "format"),
    ("objects", [], "objects"),
    ("objects", {"chair_0": [{}] * 17}, "at most 16"),
    ("objects", {"chair_0": [{"translation": [0, 0], "yaw": 0}]}, "translation"),
])  # fmt: skip
def test_wrong_fields_are_refused_by_name(capture, tmp_path, field, value, words):
    write_capture(with_others(capture), tmp_path / "out")
    tiny.change(tmp_path / "out" / "hypotheses.json", field, value)
    with pytest.raises(InputError, match=words):
        read_capture(tmp_path / "out")


def test_a_mesh_outside_of_the_capture_is_refused(capture: Capture, tmp_path: Path):
    write_capture(with_others(capture), tmp_path / "out")
    tiny.write_obj(tmp_path / "secret.obj", tiny.STEP, tiny.STEP_FACES)
    file = tmp_path / "out" / "hypotheses.json"
    tree = json.loads(file.read_text())
    tree["objects"]["chair_0"][1]["mesh"] = "../secret.obj"
    file.write_text(json.dumps(tree))
    with pytest.raises(InputError, match="mesh"):
        read_capture(tmp_path / "out")


def test_starts_have_the_boxes_of_the_hypotheses(capture: Capture):
    """The object's own shape fills the box that another shape had."""
    others = with_others(capture).hypotheses
    prepared = prepare_objects(PrepareInputs(capture.scene.objects), QUICK)
    found = other_starts(others, prepared.objects, prepared.start)
    assert found.yaw.shape == (2, 2)
    for rank, index, piece in ((0, 0, others[0]), (0, 1, others[1]), (1, 0, others[2])):
        box = box_of(piece)
        size = prepared.objects.size[index] * found.log_scale[rank, index].exp()
        assert torch.allclose(size, box.size, atol=1e-5)
        centre = found.t_world_object[rank, index] + torch.tensor([0.0, 0.5, 0.0]) * size
        assert torch.allclose(centre, box.center, atol=1e-5)
        assert torch.allclose(rot_y(found.yaw[rank, index]), rot_y(piece.yaw), atol=1e-6)
    lonely = found.t_world_object[1, 1]  # the lamp has only one: it stays
    assert torch.equal(lonely, prepared.start.t_world_object[1])


def test_strangers_and_nothing_give_no_starts(capture: Capture):
    prepared = prepare_objects(PrepareInputs(capture.scene.objects), QUICK)
    stranger = replace(capture.scene.objects[0], id="unknown")
    assert len(other_starts((stranger,), prepared.objects, prepared.start).yaw) == 0
    assert len(other_starts((), prepared.objects, prepared.start).yaw) == 0


class StoppedError(Exception):
    """The first descent was asked for."""


class Stopping(Run):
    """Stops before the first descent."""

    def stage(self, stage, inputs, config):
        if isinstance(inputs, PlaceInputs):
            raise StoppedError(inputs)
        return super().stage(stage, inputs, config)


@pytest.mark.parametrize(("preset", "count"), [("robust", 3), ("paper", 1)])
def test_the_main_job_starts_from_all_of_them(capture, tmp_path, preset, count):
    """The paper has one start; ours takes all, each on the floor."""
    given = replace(with_others(capture), bodies=None, people=None, touch=None)
    with pytest.raises(StoppedError) as stopped:
        reconstruct(given, light(preset, steps=2), Stopping(tmp_path / preset))
    inputs = stopped.value.args[0]
    assert len(inputs.starts.yaw) == count
    heights = inputs.starts.t_world_object[:, 0, 1].tolist()
    assert heights == pytest.approx([inputs.ground] * count)
