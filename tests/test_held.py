"""Pieces that fall are brought to what holds them: the floor, their support, a wall."""

import dataclasses
import json
import math
from pathlib import Path

import pytest
import torch
import trimesh
from furnished import write_out
from little_room import GROUND, box, camera, mesh_of, piece

import mover.evaluate.stability
from mover.app.cli import run_command
from mover.app.free_places import Ranges, base_of, held_places
from mover.app.simulate import nudged
from mover.core.run import Run
from mover.core.types import Scene, SceneObject
from mover.evaluate.stability import simulate
from mover.geometry.boxes import box_of
from mover.io.capture.scene_file import read_scene
from mover.io.export.finished import read_finished
from mover.io.export.shell import Wall

pytestmark = pytest.mark.skipif(
    not mover.evaluate.stability.find_spec("mujoco"), reason="needs the extra physics"
)


def sure_to(wide: float, *pieces: SceneObject) -> Ranges:
    """Each piece may be so far from where it is, along each axis and in yaw."""
    return {
        p.id: {key: (value - wide, value + wide) for key, value in base_of(p).items()}
        for p in pieces
    }


def backward(yaw: float = 0.0) -> SceneObject:
    """A shelf of 1 x 2 x 0.3 m on one foot under its front: it tips on to its back."""
    foot = trimesh.creation.box(extents=(1.0, 0.1, 0.08))
    foot.apply_translation([0, 0.05, 0.1])
    body = trimesh.creation.box(extents=(1.0, 1.9, 0.3))
    body.apply_translation([0, 1.05, 0])
    mesh = mesh_of(trimesh.util.concatenate([foot, body]))
    return dataclasses.replace(piece("shelf_0", mesh, (0.3, -3.0), yaw, GROUND), annotation=None)


def wall(z: float) -> Wall:
    """Behind all that has a larger z."""
    ends = torch.tensor([[-2.0, z], [2.0, z], [0.0, -1.0]], dtype=torch.float64)
    return Wall(ends[0], ends[1], ends[2], ())


@pytest.mark.parametrize("yaw", [0.0, 0.08])
def test_what_tips_backwards_is_brought_to_the_wall_behind_it_and_stays(tmp_path: Path, yaw: float):
    shelf = backward(yaw)
    scene, walls = Scene(camera(), GROUND, (shelf,)), (wall(-3.35),)
    run, ranges = Run(tmp_path), sure_to(0.25, shelf)
    assert not simulate(scene, run, None, (), walls)[0].stays
    _, _, (alone,) = nudged(scene, run, ranges)
    assert (alone.done, alone.reason) == (False, "it falls over")
    steady, rows, (nudge,) = nudged(scene, run, ranges, walls=walls)
    assert rows[0].stays
    assert nudge.to == "the wall guessed from the layout that was given"
    (there,) = steady.objects
    assert float(there.yaw) == pytest.approx(0.0, abs=1e-6)
    assert float(box_of(there).center[2]) == pytest.approx(-3.35 + 0.15, abs=0.002)
    assert float(box_of(there).center[0]) == pytest.approx(float(box_of(shelf).center[0]), abs=1e-5)


def test_a_wall_beyond_the_range_or_at_its_side_holds_nothing(tmp_path: Path):
    shelf, run = backward(), Run(tmp_path)
    scene = Scene(camera(), GROUND, (shelf,))
    _, _, (nudge,) = nudged(scene, run, sure_to(0.05, shelf), walls=(wall(-3.35),))
    assert not nudge.done
    ends = torch.tensor([[-0.3, -5.0], [-0.3, -1.0], [-1.0, 0.0]], dtype=torch.float64)
    beside = Wall(ends[0], ends[1], ends[2], ())
    steady, _, _ = nudged(scene, run, sure_to(9.0, shelf), walls=(beside,))
    assert steady is scene


@pytest.mark.parametrize("turn", [0.0, 0.5])
def test_what_stands_half_beside_its_support_is_brought_over_it(tmp_path: Path, turn: float):
    table = piece("table_0", box(0.8, 0.7, 0.5), (0.0, -3.0), 0.3, GROUND)
    c, s = math.cos(0.3), math.sin(0.3)
    lamp = piece("lamp_0", box(0.2, 0.3, 0.2), (0.45 * c, -3.0 - 0.45 * s), 0.3 + turn, GROUND)
    high = lamp.t_world_object + torch.tensor([0.0, 0.72, 0.0])
    lamp = dataclasses.replace(lamp, t_world_object=high, support="table_0", annotation=2)
    scene = Scene(camera(), GROUND, (table, lamp))
    assert not simulate(scene, Run(tmp_path))[1].stays
    steady, rows, (nudge,) = nudged(scene, Run(tmp_path), sure_to(0.3, table, lamp))
    assert all(row.stays for row in rows)
    assert nudge.to == "table_0"
    away = steady.objects[1].t_world_object - table.t_world_object
    half = (0.2 * (math.cos(turn) + math.sin(turn))) / 2
    assert float(away[0] * c - away[2] * s) == pytest.approx(0.4 - half, abs=0.003)
    assert float(away[0] * s + away[2] * c) == pytest.approx(0.0, abs=0.003)
    assert float(away[1]) == pytest.approx(0.7, abs=0.003)


def test_what_is_deep_in_the_floor_is_brought_on_to_it(tmp_path: Path):
    sunk = piece("box_0", box(0.5, 0.6, 0.5), (0.0, -3.0), 0.0, GROUND - 0.5)
    scene = Scene(camera(), GROUND, (sunk,))
    ((to, there),) = held_places(scene, Run(tmp_path), (), sunk)
    assert to == "the floor"
    assert float(there.t_world_object[1]) == pytest.approx(GROUND, abs=1e-6)
    steady, rows, (nudge,) = nudged(scene, Run(tmp_path), sure_to(0.6, sunk))
    assert rows[0].stays
    assert nudge.done
    assert float(steady.objects[0].t_world_object[1]) == pytest.approx(GROUND, abs=0.01)


def test_the_walls_that_pieces_lean_on_are_kept_and_exported(tmp_path: Path, capsys):
    """The sofa tells where the wall is; anew, the guess would be behind the shelf."""
    sofa = piece("sofa_0", box(1.8, 0.8, 0.9), (2.0, -2.9), 0.0, GROUND)
    shelf = backward()
    scene = Scene(camera(), GROUND, (dataclasses.replace(sofa, annotation=None), shelf))
    out = write_out(tmp_path / "out", scene)
    tree = json.loads((out / "scene.json").read_text())
    for item, given in zip(tree["objects"], scene.objects, strict=True):
        item["uncertainty"] = {"ranges": sure_to(0.4, given)[given.id]}
    (out / "scene.json").write_text(json.dumps(tree))
    assert run_command("simulate", [str(out), "--nudge"]) == 0
    assert "stable: 1 of 2 stay" in capsys.readouterr().out
    assert run_command("simulate", [str(out), "--nudge", "--walls", "guess"]) == 0
    said = capsys.readouterr().out
    assert "stable: 2 of 2 stay" in said
    assert "shelf_0: nudged by 219 mm, 0.0 deg to the wall guessed from sofa_0" in said
    home = read_finished(out, stable=True)
    (kept,) = home.shell()
    assert float(kept.start @ kept.out) == pytest.approx(3.37, abs=1e-4)
    assert run_command("export", [str(out), "--to", "mjcf", "--stable", "--walls", "guess"]) == 0
    assert "guessed_wall_0" in (out / "export" / "mjcf" / "room.xml").read_text()
    assert run_command("export", [str(out), "--to", "mjcf", "--stable"]) == 0
    assert "--walls guess writes these" in capsys.readouterr().out
    tree = json.loads((out / "stable.json").read_text())
    tree["guessed_walls"][0]["out"] = [0.0]
    (out / "stable.json").write_text(json.dumps(tree))
    assert run_command("export", [str(out), "--to", "mjcf", "--stable"]) == 2
    assert "guessed_walls[0].out" in capsys.readouterr().err
    assert read_scene(out / "stable.json").objects
