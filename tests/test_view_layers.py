"""What the viewer draws of the evidence, and the state behind it."""

import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest
import torch
from little_room import GROUND, camera, room, walkers

from mover.app.viewer.drawing import cast_of
from mover.app.viewer.layers import contact_points, depth_points, floor_ellipses, space_surface
from mover.app.viewer.panels import numbers_of
from mover.app.viewer.session import Shown, start_session
from mover.app.viewer.solve import Stopped, Watch, seen_in
from mover.core.observe import Energy, Step
from mover.core.types import Layout
from mover.energy.human_terms import ContactPoints, DepthMaps, shares_of
from mover.geometry.boxes import box_of
from mover.geometry.camera import pitch_roll, project, tilted, to_camera
from mover.geometry.placement import hit_floor
from mover.geometry.volume import Volume
from mover.io.capture.edits import Place, read_edits
from mover.stages.config import PrepareConfig
from mover.stages.objects.place_inputs import Moment
from mover.stages.objects.prepare_objects import PrepareInputs, prepare_objects, to_objects

INF = float("inf")


def shown(scene=None):
    scene = scene or room()
    return Shown("room", scene, room(0.3), walkers(), walkers())


class TestLayers:
    def test_depth_points_project_back_to_their_pixels_at_their_depth(self):
        blank = torch.full((360, 640), INF)
        near, far = -blank, blank.clone()
        near[100, 200], far[359, 639] = 2.5, 4.0
        points = depth_points(DepthMaps(near, far, -blank), camera())
        for found, pixel, depth in (
            (points.near, (200.5, 100.5), 2.5),
            (points.far, (639.5, 359.5), 4),
        ):
            seen = to_camera(found, camera().R_cam_world)
            assert seen[:, 2].tolist() == pytest.approx([depth], rel=1e-5)
            assert project(seen, camera().K)[0].tolist() == pytest.approx(pixel, abs=1e-2)

    @pytest.mark.parametrize("cells", [40, 200])
    def test_the_surface_of_a_ball_of_free_space_is_that_ball(self, cells: int):
        cell, origin = 2.4 / cells, torch.tensor([1.0, -2.0, 3.0])
        axis = torch.arange(cells) * cell
        x, y, z = torch.meshgrid(axis, axis, axis, indexing="ij")
        centre = torch.tensor([1.2, 1.1, 1.3])
        distance = (torch.stack([x, y, z], -1) - centre).norm(dim=-1) - 0.8
        mesh = space_surface(Volume(distance, origin, cell))
        radii = (mesh.verts - origin - centre).norm(dim=-1)
        step = -(-cells // 96)
        assert (radii - 0.8).abs().max() < 1.2 * step * cell
        a, b, c = (mesh.verts - mesh.verts.mean(0))[mesh.faces].unbind(-2)
        volume = float((torch.linalg.cross(a, b) * c).sum().abs()) / 6
        assert volume == pytest.approx(4 / 3 * np.pi * 0.8**3, rel=0.1)

    def test_space_that_touches_the_border_is_closed_and_an_empty_one_is_left_out(self):
        full = Volume(torch.full((5, 6, 7), -0.1), torch.zeros(3), 0.1)
        assert len(space_surface(full).faces) > 50
        assert space_surface(Volume(torch.ones(5, 6, 7), torch.zeros(3), 0.1)) is None

    def test_contact_points_leave_the_padding_out(self):
        points = torch.arange(2 * 4 * 3 * 3).reshape(2, 4, 3, 3).float()
        weight = torch.zeros(2, 4, 3)
        weight[0, 1, 2], weight[1, 0, 0], weight[1, 3, 1] = 5.0, 1.0, 2.0
        touches = ContactPoints(
            torch.tensor([2, 0]),
            points,
            weight,
            torch.ones(2),
            shares_of(weight),
            torch.zeros(2, 2),
        )
        found = contact_points(touches, ("a", "b", "c"))
        assert set(found) == {"a", "c"}
        assert torch.equal(found["c"], points[0, 1, 2][None])
        assert torch.equal(found["a"], torch.stack([points[1, 0, 0], points[1, 3, 1]]))
        assert contact_points(None, ("a",)) == {}

    def test_95_of_100_cameras_put_an_object_inside_of_its_ellipse(self):
        scene, generator = room(), torch.Generator().manual_seed(1)
        root = torch.tensor([[0.006, 0, 0], [0.002, 0.005, 0], [-0.004, 0.002, 0.01]]).double()
        rings = floor_ellipses(scene, (root @ root.mT).float())
        assert set(rings) == {p.id for p in scene.objects}
        pitch, roll = pitch_roll(scene.camera.R_cam_world)
        piece = scene.objects[0]
        box = box_of(piece)
        base = box.center - torch.tensor([0, 0.5, 0]) * box.size
        ray = to_camera(base, scene.camera.R_cam_world)
        draws = torch.randn(4000, 3, generator=generator, dtype=torch.float64) @ root.mT
        ring = rings[piece.id]
        middle = ring.mean(0)
        flat = (ring - middle)[:, [0, 2]].double()
        shape = torch.linalg.inv(flat.mT @ flat * 2 / len(flat))
        inside = 0
        for d in draws:
            R = tilted(pitch.double() + d[0], roll.double() + d[1])
            hit = hit_floor(ray.double(), R, torch.tensor(GROUND).double() + d[2])
            off = (hit.float() - middle)[[0, 2]].double()
            inside += float(off @ shape @ off) <= 1
        assert 0.93 < inside / len(draws) < 0.97
        assert floor_ellipses(dataclasses.replace(scene, ground=None), torch.eye(3)) == {}


class TestLive:
    def test_shows_each_object_at_its_best_start_as_the_result_would(self):
        scene = room()
        prepared = prepare_objects(
            PrepareInputs(scene.objects), PrepareConfig(cells=24, faces=100, samples=50, region=20)
        )
        generator = torch.Generator().manual_seed(0)
        layout = Layout(
            torch.randn(4, 3, 3, generator=generator), torch.randn(4, 3, generator=generator),
            0.2 * torch.randn(4, 3, 3, generator=generator),
        )  # fmt: skip
        energy = torch.rand(4, 3, generator=generator)
        step = Step("x", 0, 9, Energy({"e": energy}), lambda: Moment(layout, camera(), GROUND))
        seen = seen_in(step, scene.objects)
        for i, piece in enumerate(seen.objects):
            best = int(energy[:, i].argmin())
            one = Layout(layout.t_world_object[best], layout.yaw[best], layout.log_scale[best])
            wanted = to_objects(scene.objects, prepared, one)[i]
            assert (piece.t_world_object - wanted.t_world_object).abs().max() < 1e-5
            assert (piece.scale - wanted.scale).abs().max() < 1e-6
            assert float(piece.yaw - wanted.yaw) == 0

    def test_the_curve_is_the_energy_of_the_rooms_that_are_shown(self, monkeypatch):
        """Of the best starts, over all descents of a stage; a stage between begins it anew."""
        monkeypatch.setattr("mover.app.viewer.solve.PAUSE", 0.0)
        scene, drawn = room(), []
        count = len(scene.objects)
        layout = Layout(torch.zeros(2, count, 3), torch.zeros(2, count), torch.zeros(2, count, 3))
        watch = Watch(scene.objects, drawn.append, lambda _: None)

        def descend(*energies: float) -> None:
            for index, energy in enumerate(energies):
                both = torch.tensor([energy, energy + 9]).expand(count, 2).mT
                watch(Step("place_objects", index, 9, Energy({"e": both}),
                           lambda: Moment(layout, camera(), GROUND)))  # fmt: skip

        descend(4.0, 3.0)
        descend(3.5, 2.0)
        assert watch.energies == [count * e for e in (4.0, 3.0, 3.5, 2.0)]
        watch(Step("gather_cues", 0, 1))
        descend(8.0)
        assert watch.energies == [count * 8.0]
        assert len(drawn) == 5

    def test_other_steps_show_nothing_and_a_stop_ends_the_run(self):
        told, drawn = [], []
        watch = Watch(room().objects, drawn.append, told.append)
        watch(Step("select_frames", 0, 1))
        assert (len(told), drawn) == (1, [])
        watch.stop = True
        with pytest.raises(Stopped):
            watch(Step("select_frames", 0, 1))


class TestSession:
    def test_every_change_is_on_disk_and_an_undo_takes_it_back(self, tmp_path: Path):
        file = tmp_path / "edits.json"
        session = start_session(shown(), file, None)
        moved = dataclasses.replace(session.piece("chair_0"), yaw=torch.tensor(2.0))
        session.put(moved)
        session.put(moved)  # nothing new
        session.pin("chair_0", True)
        session.relabel("table_0", " desk ")
        assert session.pinned == ("chair_0",)
        assert len(read_edits(file)) == len(session.edits) == 3
        again = start_session(shown(), file, None)
        assert float(again.piece("chair_0").yaw) == pytest.approx(2.0, abs=1e-6)
        session.undo()
        assert session.piece("table_0").category == "table"
        assert len(read_edits(file)) == 2

    def test_edits_of_a_run_are_inside_of_its_result_and_not_done_twice(self):
        session = start_session(shown(), None, None)
        key = session.add("stool", 0, None, (0.5, -2.0))
        session.delete("sofa_0")
        solved = dataclasses.replace(shown(session.scene), log={"edits": 2})
        session.rebase(solved, 2)
        assert {p.id for p in session.scene.objects} == {"chair_0", "table_0", key}
        assert session.add("stool", 0, None, (0.5, -2.0)) != key

    def test_a_drag_after_a_run_does_not_replace_what_the_run_has_seen(self):
        session = start_session(shown(), None, None)
        for x in (0.1, 0.2):
            piece = session.piece("chair_0")
            put = dataclasses.replace(piece, t_world_object=torch.tensor([x, GROUND, -2.0]))
            session.put(put)
            session.rebase(shown(session.scene), len(session.edits))
        assert [type(e) for e in session.edits] == [Place, Place]

    def test_a_new_piece_stands_on_the_floor_and_looks_at_the_camera(self):
        session = start_session(shown(), None, None)
        piece = session.piece(session.add("chair", 1, None, (1.0, -3.0)))
        box = box_of(piece)
        assert float(box.center[1] - box.size[1] / 2) == pytest.approx(GROUND, abs=1e-4)
        front = torch.stack([piece.yaw.sin(), piece.yaw.cos()])
        assert torch.cosine_similarity(front, torch.tensor([-1.0, 3.0]), dim=0) > 0.999


class TestNumbers:
    def test_tell_place_change_evidence_and_metrics(self):
        log = {"evidence": [{"id": "chair_0", "mask_pixels": 4321, "energy": 0.25}]}
        row = {"id": "chair_0", "initial": {"iou3d": 0.25}, "result": {"iou3d": 0.75}}
        full = dataclasses.replace(shown(), log=log, metrics={"objects": [row]})
        table = numbers_of(room().objects[0], room(), full)
        for said in ("4,321", "0.250 → 0.750", "50, 90, 50 cm", "17°", "moved since the start"):
            assert said in table
        assert "nan" not in json.dumps(table)

    def test_people_are_found_by_frame_and_person(self):
        bodies = walkers(5, people=2)
        cast = cast_of(bodies)
        assert cast.frames == [0, 3, 6, 9, 12]
        assert bodies.person[cast.rows[(6, 1)]] == 1
        assert bodies.frame[cast.rows[(6, 1)]] == 6
        assert cast_of(None) is None
