"""Who sits where, what stays under them, and pieces that are nudged to where they stand."""

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import pytest
import torch
import trimesh
from furnished import bodies_of, furnished, write_out
from little_room import GROUND, box, camera, mesh_of, piece

import mover.evaluate.stability
from mover.app.cli import run_command
from mover.app.free_places import Ranges, apart
from mover.app.simulate import nudged
from mover.bodies.skin import PARTS
from mover.bodies.skinning import open_body, zero_pose
from mover.core.contact_labels import ContactLabels
from mover.core.run import Run
from mover.core.types import Scene
from mover.evaluate.stability import (
    MASS,
    SEAT_SHARE,
    Load,
    SimulatedObject,
    hardest,
    loads_of,
    simulate,
)
from mover.io.capture.scene_file import read_scene, write_scene
from mover.io.export.contacts import write_labels
from mover.io.export.finished import read_finished

needs_mujoco = pytest.mark.skipif(
    not mover.evaluate.stability.find_spec("mujoco"), reason="needs the extra physics"
)


def bench(yaw: float = 0.0) -> Scene:
    """A board of 2 x 0.1 x 0.5 m on one foot in its middle, 0.4 m wide: it tips at its ends."""
    foot = trimesh.creation.box(extents=(0.4, 0.4, 0.5))
    foot.apply_translation([0, 0.2, 0])
    board = trimesh.creation.box(extents=(2.0, 0.1, 0.5))
    board.apply_translation([0, 0.45, 0])
    mesh = mesh_of(trimesh.util.concatenate([foot, board]))
    return Scene(camera(), GROUND, (piece("bench_0", mesh, (0.3, -3.0), yaw, GROUND),))


def sitting(*spots: tuple[int, float, float], yaw: float = 0.0) -> ContactLabels:
    """Somebody on the bench: first frame of a bout of five, and where along it and across [m]."""
    rows = [(start + k, x, z) for start, x, z in spots for k in range(5)]
    c, s = math.cos(yaw), math.sin(yaw)
    places = [(0.3 + c * x + s * z, GROUND + 0.5, -3.0 + c * z - s * x) for _, x, z in rows]
    count = len(rows)
    return ContactLabels(
        frame=torch.tensor([frame for frame, _, _ in rows]),
        person=torch.zeros(count, dtype=torch.long),
        part=torch.full((count,), PARTS.index("seat")),
        object=torch.zeros(count, dtype=torch.long),
        position=torch.tensor(places), normal=torch.tensor([[0.0, 1, 0]]).expand(count, 3),
        gap=torch.zeros(count), confidence=torch.ones(count), parts=PARTS,
        objects=("bench_0", "ground"),
    )  # fmt: skip


def loads(tmp_path: Path, scene: Scene, labels: ContactLabels) -> tuple[Load, ...]:
    write_labels(labels, tmp_path / "contacts.npz")
    return loads_of(tmp_path, scene, 10.0)


@pytest.mark.parametrize("yaw", [0.0, 0.7])
def test_each_bout_of_sitting_is_a_weight_where_it_was(tmp_path: Path, yaw: float):
    scene = bench(yaw)
    found = loads(tmp_path, scene, sitting((0, 0.1, 0.0), (100, -0.9, 0.05), yaw=yaw))
    assert [(load.person, load.frame) for load in found] == [(0, 0), (0, 100)]
    assert [load.kilos for load in found] == [pytest.approx(MASS * SEAT_SHARE)] * 2
    assert found[0].place.tolist() == pytest.approx([0.1, 0.5, 0.0], abs=1e-5)
    assert found[1].place.tolist() == pytest.approx([-0.9, 0.5, 0.05], abs=1e-5)
    worst = hardest(found, scene.objects[0])
    assert worst is not None
    assert worst.frame == 100


def test_without_labels_nobody_sits(tmp_path: Path):
    assert loads_of(tmp_path, bench(), 10.0) == ()


@needs_mujoco
@pytest.mark.parametrize(("x", "stays"), [(0.05, True), (0.9, False)])
def test_a_bench_holds_who_sits_over_its_foot_and_tips_at_its_end(
    tmp_path: Path, x: float, stays: bool
):
    scene = bench(0.7)
    found = simulate(
        scene, Run(tmp_path), loads=loads(tmp_path, scene, sitting((0, x, 0.0), yaw=0.7))
    )[0]
    assert found.moved < 0.001
    assert found.load == pytest.approx(MASS * SEAT_SHARE)
    assert found.stays == stays
    assert (found.turned_loaded > math.radians(5)) == (not stays)


def test_what_moves_a_centimetre_or_turns_a_degree_does_not_stay():
    row = SimulatedObject("a", "chair", 0.009, 0.0, math.radians(0.9), 0.0, 0.0, 5.0, False)
    assert row.stays
    for change in (
        {"moved": 0.011}, {"turned": math.radians(1.1)}, {"moved_loaded": 0.011},
        {"turned_loaded": math.radians(1.1)},
    ):  # fmt: skip
        assert not dataclasses.replace(row, **change).stays


def floating(lift: float, **where: tuple[float, float]) -> tuple[Scene, Ranges]:
    """A box over the floor, and what is stated of its place."""
    scene = Scene(
        camera(), GROUND, (piece("box_0", box(0.6, 0.5, 0.6), (0, -3), 0.0, GROUND + lift),)
    )
    here = {"x": 0.0, "y": GROUND + lift, "z": -3.0, "yaw": 0.0}
    return scene, {"box_0": {k: (v - 0.03, v + 0.03) for k, v in here.items()} | where}


@needs_mujoco
def test_a_piece_that_floats_within_its_range_comes_down_and_stays(tmp_path: Path):
    scene, ranges = floating(0.02)
    steady, rows, (nudge,) = nudged(scene, Run(tmp_path), ranges)
    assert nudge.done
    assert nudge.moved == pytest.approx(0.02, abs=0.002)
    assert rows[0].stays
    assert float(steady.objects[0].t_world_object[1]) == pytest.approx(GROUND, abs=0.002)


@needs_mujoco
def test_a_piece_that_floats_beyond_its_range_is_left_and_it_is_said(tmp_path: Path):
    scene, ranges = floating(0.2)
    steady, _, (nudge,) = nudged(scene, Run(tmp_path), ranges)
    assert not nudge.done
    assert "y would change by -0.2" in nudge.reason
    assert steady is scene
    _, _, (unknown,) = nudged(scene, Run(tmp_path), {})
    assert unknown.reason == "its uncertainty is not stated"


@needs_mujoco
def test_a_piece_that_falls_over_is_left(tmp_path: Path):
    scene = bench()
    (given,) = scene.objects
    verts = given.mesh.verts + torch.tensor([0.9, 0.0, 0.0]) * (given.mesh.verts[:, 1:2] > 0.39)
    leaning = dataclasses.replace(given, mesh=dataclasses.replace(given.mesh, verts=verts))
    wide: Any = dict.fromkeys(("x", "y", "z", "yaw"), (-9.0, 9.0))
    _, _, (nudge,) = nudged(
        dataclasses.replace(scene, objects=(leaning,)), Run(tmp_path), {"bench_0": wide}
    )
    assert nudge.reason == "it falls over"


def wedged(sure: float, unsure: float) -> tuple[Scene, Ranges]:
    """A tall box and a low one stand in each other by 6 cm, askew so that they are thrown over."""
    tall = piece("tall_0", box(0.4, 1.2, 0.4), (0, -3), 0.0, GROUND)
    low = piece("low_0", box(0.6, 0.5, 0.6), (0.44, -3.1), 0.2, GROUND)
    scene = Scene(camera(), GROUND, (tall, low))
    ranges: Ranges = {}
    for given, wide in ((tall, sure), (low, unsure)):
        x, y, z = given.t_world_object.tolist()
        here = {"x": x, "y": y, "z": z, "yaw": float(given.yaw)}
        ranges[given.id] = {k: (v - wide, v + wide) for k, v in here.items()}
    return scene, ranges


@needs_mujoco
def test_what_stands_in_each_other_comes_apart_the_least_certain_first(tmp_path: Path):
    scene, ranges = wedged(0.02, 0.2)
    assert not any(row.stays for row in simulate(scene, Run(tmp_path)))
    clear = apart(scene, Run(tmp_path), ranges, {"tall_0"})
    (still, _), (before, after) = scene.objects, (scene.objects[1], clear.objects[1])
    assert torch.equal(clear.objects[0].t_world_object, still.t_world_object)
    step = after.t_world_object - before.t_world_object
    assert 0.05 < float(step.norm()) < 0.12
    assert float(step[1]) == 0
    assert all(row.stays and row.stuck < 0.003 for row in simulate(clear, Run(tmp_path)))


@needs_mujoco
def test_each_makes_as_much_room_as_its_range_allows(tmp_path: Path):
    scene, ranges = wedged(0.06, 0.061)
    steady, rows, nudges = nudged(scene, Run(tmp_path), ranges)
    assert all(row.stays for row in rows)
    assert {nudge.id for nudge in nudges} == {"tall_0", "low_0"}
    for given, found in zip(scene.objects, steady.objects, strict=True):
        away = (found.t_world_object - given.t_world_object).abs()
        assert float(away.max()) < 0.0611
    narrow = {name: dict.fromkeys(("x", "y", "z", "yaw"), (-9.0, -8.9)) for name in ranges}
    left, rows, nudges = nudged(scene, Run(tmp_path), narrow)
    assert left is scene
    assert not any(nudge.done for nudge in nudges)


@needs_mujoco
def test_what_carries_others_is_not_moved_from_under_them(tmp_path: Path):
    scene, ranges = wedged(0.02, 0.2)
    carried = piece("cup_0", box(0.1, 0.1, 0.1), (0.5, -3.1), 0.0, GROUND + 0.5)
    cup = dataclasses.replace(carried, support="low_0")
    both = dataclasses.replace(scene, objects=(*scene.objects, cup))
    clear = apart(both, Run(tmp_path), ranges, {"tall_0"})
    assert torch.equal(clear.objects[1].t_world_object, both.objects[1].t_world_object)


@needs_mujoco
def test_ranges_speak_of_the_underside_wherever_the_mesh_has_its_origin(tmp_path: Path):
    scene, ranges = floating(0.02)
    (given,) = scene.objects
    shift = torch.tensor([0.5, -0.25, 0.1])
    mesh = dataclasses.replace(given.mesh, verts=given.mesh.verts - shift)
    place = given.t_world_object + shift
    moved = dataclasses.replace(given, mesh=mesh, t_world_object=place)
    _, rows, (nudge,) = nudged(dataclasses.replace(scene, objects=(moved,)), Run(tmp_path), ranges)
    assert nudge.done, nudge.reason
    assert rows[0].stays


@needs_mujoco
def test_the_command_writes_a_scene_that_stays_and_exports_take_it(tmp_path: Path, capsys):
    scene, ranges = floating(0.02)
    bodies = bodies_of(zero_pose(2, open_body()))
    out = write_out(tmp_path / "out", scene, bodies)
    tree = json.loads((out / "scene.json").read_text())
    tree["objects"][0]["uncertainty"] = {"level": 0.9, "ranges": ranges["box_0"]}
    (out / "scene.json").write_text(json.dumps(tree))
    assert run_command("simulate", [str(out), "--nudge"]) == 0
    said = capsys.readouterr().out
    assert "box_0: nudged by 20 mm" in said
    assert "stable: 1 of 1 stay" in said
    assert float(read_scene(out / "scene.json").objects[0].t_world_object[1]) > GROUND + 0.019
    steady = read_finished(out, None, stable=True).scene
    assert float(steady.objects[0].t_world_object[1]) == pytest.approx(GROUND, abs=0.002)
    assert run_command("export", [str(out), "--to", "mjcf", "--stable"]) == 0


def test_an_export_of_a_scene_that_nobody_made_is_refused(tmp_path: Path, capsys):
    out = write_out(tmp_path / "out", furnished(("table",)))
    assert run_command("export", [str(out), "--to", "ply", "--stable"]) == 2
    assert "mover simulate OUT --nudge" in capsys.readouterr().err


@needs_mujoco
def test_evaluate_tells_the_share_that_stays_before_and_after(tmp_path: Path, capsys, monkeypatch):
    """Of two boxes one floats as it was given; a third hangs, and counts in neither."""
    boxes = [piece(f"box_{k}", box(0.6, 0.5, 0.6), (2.0 * k, -3), 0.0, GROUND) for k in range(3)]
    boxes = [dataclasses.replace(p, annotation=None) for p in boxes]
    boxes[2] = dataclasses.replace(boxes[2], support="free")
    truth = Scene(camera(), GROUND, tuple(boxes))
    boxes[1] = dataclasses.replace(
        boxes[1], t_world_object=boxes[1].t_world_object + torch.tensor([0, 0.1, 0])
    )
    out, asked = write_out(tmp_path / "out", truth), ["--truth", str(tmp_path / "truth")]
    write_out(tmp_path / "truth", truth)
    write_scene(Scene(camera(), GROUND, tuple(boxes)), out / "initial.json")
    assert run_command("evaluate", [str(out), *asked]) == 0
    (line,) = [x for x in capsys.readouterr().out.splitlines() if x.startswith("stable")]
    assert line.split() == ["stable", "0.500", "1.000", "1"]
    assert run_command("evaluate", [str(out), *asked, "--no-stable"]) == 0
    assert "stable" not in capsys.readouterr().out
    monkeypatch.setattr(mover.evaluate.stability, "find_spec", lambda _: None)
    assert run_command("evaluate", [str(out), *asked]) == 0
    assert "stable is not measured: mujoco is not installed; pip" in capsys.readouterr().out
    metrics = json.loads((out / "metrics.json").read_text())
    assert "stable" not in metrics["result"]
