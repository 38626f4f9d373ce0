"""Edits: a list that replays, carried between cameras, and objects that stay where they are put."""

import dataclasses
import json
from pathlib import Path

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from little_room import GROUND, room

from mover.core.errors import InputError
from mover.core.types import Camera, Capture, Layout, Scene
from mover.geometry.boxes import box_of
from mover.geometry.camera import tilted, to_camera
from mover.geometry.placement import reproject
from mover.geometry.rotations import wrap
from mover.io.capture.edits import (
    Delete,
    Pin,
    Place,
    apply_edits,
    edit_scene,
    joined,
    pinned_ids,
    read_edits,
    write_edits,
)
from mover.stages.objects.place_inputs import Pinned, hold


def put(name, x=0.5, z=-2.0, yaw=1.0, scale=(1.0, 1.1, 0.9), pitch=-0.2, roll=0.0):
    return Place(name, (x, GROUND, z), yaw, scale, pitch=pitch, roll=roll)


def every_edit():
    return (
        put("chair_0"), Pin("chair_0", True), Pin("table_0", True), Delete("sofa_0"),
        Pin("table_0", False),
    )  # fmt: skip


def under(scene: Scene, pitch: float, roll: float) -> Scene:
    """The scene with another guess of its camera."""
    old = scene.camera
    R = tilted(torch.tensor(pitch), torch.tensor(roll))
    return dataclasses.replace(scene, camera=Camera(old.K, R, old.width, old.height))


def by_id(scene: Scene):
    return {piece.id: piece for piece in scene.objects}


class TestEdits:
    def test_each_kind_does_what_it_says_and_leaves_the_rest(self):
        before = room()
        after = edit_scene(before, every_edit())
        found = by_id(after)
        assert list(found) == ["chair_0", "table_0"]
        assert found["chair_0"].t_world_object.tolist() == pytest.approx([0.5, GROUND, -2.0])
        assert float(found["chair_0"].yaw) == pytest.approx(1.0)
        assert found["chair_0"].scale.tolist() == pytest.approx([1.0, 1.1, 0.9])
        assert torch.equal(found["table_0"].t_world_object, by_id(before)["table_0"].t_world_object)
        assert pinned_ids(after, every_edit()) == ("chair_0",)

    def test_of_a_capture_change_its_scene_only_and_never_the_argument(self):
        capture = Capture("c", room(), None, (), None, None, None, None, None, ())
        copy = edit_scene(capture.scene, ())
        edited, pinned = apply_edits(capture, every_edit())
        assert pinned == ("chair_0",)
        assert dataclasses.replace(edited, scene=capture.scene).name == "c"
        for old, kept in zip(copy.objects, capture.scene.objects, strict=True):
            assert torch.equal(old.t_world_object, kept.t_world_object)
        again, _ = apply_edits(capture, every_edit())
        for a, b in zip(edited.scene.objects, again.scene.objects, strict=True):
            assert torch.equal(a.mesh.verts, b.mesh.verts)
            assert torch.equal(a.t_world_object, b.t_world_object)

    @given(st.floats(-0.5, 0.1), st.floats(-0.1, 0.1), st.floats(-3, 3))
    @settings(max_examples=25, deadline=None)
    def test_a_place_of_another_camera_keeps_its_box_in_the_camera_frame(self, pitch, roll, yaw):
        place = put("chair_0", yaw=yaw, pitch=-0.2, roll=0.02)
        here = edit_scene(under(room(), -0.2, 0.02), [place])
        there = edit_scene(under(room(), pitch, roll), [place])
        centers = [
            to_camera(box_of(by_id(s)["chair_0"]).center, s.camera.R_cam_world)
            for s in (here, there)
        ]
        assert (centers[0] - centers[1]).abs().max() < 1e-5
        seen = by_id(there)["chair_0"].yaw[None]
        level = Layout(torch.zeros(1, 3), seen, torch.zeros(1, 3))
        back = reproject(level, torch.zeros(1), there.camera.R_cam_world, here.camera.R_cam_world)
        assert float(wrap(back.yaw[0] - place.yaw).abs()) < 1e-5

    def test_what_a_deleted_object_carried_stands_where_it_stood(self):
        pieces = list(room().objects)
        pieces[0] = dataclasses.replace(pieces[0], support="table_0")
        pieces[2] = dataclasses.replace(pieces[2], support="sofa_0")
        scene = edit_scene(dataclasses.replace(room(), objects=tuple(pieces)), [Delete("table_0")])
        assert by_id(scene)["chair_0"].support == "sofa_0"

    @pytest.mark.parametrize("edit", [Delete("lamp_0"), Pin("lamp_0", True), put("lamp_0")])
    def test_that_do_not_fit_are_named(self, edit):
        said = r"edits\[1\] has 'lamp_0', expected an object of the scene: chair_0, sofa_0"
        with pytest.raises(InputError, match=said):
            edit_scene(room(), [Pin("chair_0", True), edit])

    def test_placements_of_one_object_in_a_row_are_one(self):
        first, second, other = put("a", 0.0), put("a", 1.0), put("b", 2.0)
        assert joined((first,), second) == (second,)
        assert joined((first, other), second) == (first, other, second)


class TestFile:
    def test_gives_back_what_was_written(self, tmp_path: Path):
        write_edits(every_edit(), tmp_path / "edits.json")
        back = read_edits(tmp_path / "edits.json")
        assert back == every_edit()
        write_edits(back, tmp_path / "again.json")
        assert (tmp_path / "again.json").read_bytes() == (tmp_path / "edits.json").read_bytes()

    @pytest.mark.parametrize(("field", "value"), [
        ("do", "throw"), ("id", ""), ("yaw", "left"), ("scale", [1, 0, 1]), ("pitch", 9),
        ("translation", [1, 2]),
    ])  # fmt: skip
    def test_says_which_field_is_wrong(self, tmp_path: Path, field: str, value: object):
        file = tmp_path / "edits.json"
        write_edits(every_edit(), file)
        tree = json.loads(file.read_text())
        tree["edits"][0][field] = value
        file.write_text(json.dumps(tree))
        with pytest.raises(InputError, match=rf"edits\[0\]\.{field}"):
            read_edits(file)


class TestPinned:
    def test_rows_are_held_in_every_start_and_get_no_gradient(self):
        generator = torch.Generator().manual_seed(0)
        t = torch.randn(4, 3, 3, generator=generator, requires_grad=True)
        yaw = torch.randn(4, 3, generator=generator, requires_grad=True)
        size = torch.randn(4, 3, 3, generator=generator, requires_grad=True)
        there = Layout(torch.ones(3, 3), torch.ones(3), torch.ones(3, 3))
        fixed = torch.tensor([False, True, False])
        held = hold(Layout(t, yaw, size), Pinned(fixed, there))
        total = sum(x.square().sum() for x in (held.t_world_object, held.yaw, held.log_scale))
        total.backward()
        for free, kept in ((t, held.t_world_object), (yaw, held.yaw), (size, held.log_scale)):
            assert (kept[:, 1] == 1).all()
            assert (free.grad[:, 1] == 0).all()
            assert torch.equal(kept[:, [0, 2]], free[:, [0, 2]])
            assert (free.grad[:, [0, 2]] != 0).all()

    def test_nothing_pinned_changes_nothing(self):
        layout = Layout(torch.randn(2, 3, generator=torch.Generator()), torch.zeros(2),
                        torch.zeros(2, 3))  # fmt: skip
        assert hold(layout, None) is layout
