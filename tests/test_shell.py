"""Walls that are guessed: where furniture stands along them, outside of everything, marked."""

import dataclasses
import math
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest
import torch
from furnished import bodies_of, furnished, moving_pose, write_out
from little_room import GROUND, box, camera, piece, walkers

import mover.io.export.solids
from mover.app.cli import run_command
from mover.core.types import Scene
from mover.io.export.finished import Finished, read_finished
from mover.io.export.mjcf import export_mjcf
from mover.io.export.shell import HEIGHT, guess_walls, slab, wall_notes
from mover.io.export.urdf import export_urdf
from mover.io.export.usd import export_usd
from mover.pipeline.outcome import layout_over

BACK, LEFT = -5.0, -2.5  # [m], inner faces of the true walls before the room is turned


@pytest.fixture(autouse=True)
def along_the_axes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(mover.io.export.solids, "find_spec", lambda _: None)


def room(yaw: float = 0.0, gap: float = 0.03) -> Scene:
    """Shelf and sofa along the back wall, a cabinet along the left, a table in the middle."""
    rows = (
        ("shelf_0", (1.0, 2.0, 0.3), (-0.5, BACK + gap + 0.15), 0.0),
        ("sofa_0", (2.0, 0.8, 0.9), (1.5, BACK + gap + 0.45), 0.0),
        ("cabinet_0", (1.2, 1.0, 0.5), (LEFT + gap + 0.25, -3.5), math.pi / 2),
        ("table_0", (1.2, 0.7, 0.8), (0.3, -3.2), 0.3),
    )
    c, s = math.cos(yaw), math.sin(yaw)
    pieces = [
        dataclasses.replace(
            piece(name, box(*size), (c * x + s * z, c * z - s * x), turn + yaw, GROUND),
            annotation=k + 1,
        )
        for k, (name, size, (x, z), turn) in enumerate(rows)
    ]
    return Scene(camera(), GROUND, tuple(pieces))


@pytest.mark.parametrize("yaw", [0.0, 0.2, -0.6])
def test_walls_stand_where_the_furniture_turns_its_back(yaw: float):
    walls = guess_walls(room(yaw), None)
    assert [wall.pieces for wall in walls] == [("cabinet_0",), ("shelf_0", "sofa_0")]
    c, s = math.cos(yaw), math.sin(yaw)
    for wall, (x, z) in zip(walls, ((-1.0, 0.0), (0.0, -1.0)), strict=True):
        out = np.array([c * x + s * z, c * z - s * x])
        assert wall.out.numpy() == pytest.approx(out, abs=0.02)
    left, back = walls
    assert float((left.start * left.out).sum()) == pytest.approx(-LEFT, abs=0.05)
    assert float((back.start * back.out).sum()) == pytest.approx(-BACK, abs=0.05)


def test_no_wall_cuts_furniture_people_or_the_camera():
    scene = room()
    people = walkers(20)
    away = torch.tensor([-2.4, 0.0, -1.0])  # half of them through the left wall
    people = dataclasses.replace(people, verts=people.verts + away)
    for wall in guess_walls(scene, people):
        edge = float((wall.start * wall.out).sum())
        assert float((people.verts[..., ::2].double() @ wall.out).max()) < edge
        assert edge > 0


def test_a_room_without_backs_along_its_sides_stays_open():
    scene = room()
    assert guess_walls(dataclasses.replace(scene, objects=scene.objects[-1:]), None) == ()
    assert guess_walls(dataclasses.replace(scene, objects=()), None) == ()
    (only,) = guess_walls(dataclasses.replace(scene, objects=scene.objects[2:]), None)
    assert only.pieces == ("cabinet_0",)


def test_a_shelf_that_faces_the_wall_tells_none():
    scene = room()
    turned = [dataclasses.replace(p, yaw=p.yaw + math.pi) for p in scene.objects]
    assert guess_walls(dataclasses.replace(scene, objects=tuple(turned)), None) == ()


@pytest.mark.parametrize("yaw", [0.0, 0.4])
def test_a_layout_that_was_given_tells_all_four_walls(yaw: float):
    """Its left side would cut the cabinet, so that wall goes where the cabinet ends."""
    c, s = math.cos(yaw), math.sin(yaw)
    corners = [(-2.3, -6.0), (3.0, -6.0), (3.0, 1.0), (-2.3, 1.0)]
    layout = torch.tensor([(c * x + s * z, c * z - s * x) for x, z in corners])
    walls = guess_walls(dataclasses.replace(room(yaw), layout=layout), None)
    edges = {}
    for wall in walls:
        assert wall.pieces == ()
        out = wall.out.numpy() @ np.array([[c, s], [-s, c]])  # in the room's own axes
        edges[tuple(np.round(out).astype(int))] = float((wall.start * wall.out).sum())
    left = {(-1, 0): pytest.approx(2.49, abs=1e-4)}  # the cabinet, and 2 cm of air
    assert edges == {(1, 0): pytest.approx(3.0, abs=1e-4), (0, -1): pytest.approx(6.0, abs=1e-4),
                     (0, 1): pytest.approx(1.0, abs=1e-4), **left}  # fmt: skip
    assert "a wall is guessed from the layout that was given" in wall_notes(walls)


def test_a_layout_grows_with_the_height_of_the_camera():
    layout = torch.tensor([[-1.0, -4.0], [2.0, -4.0], [2.0, 1.0], [-1.0, 1.0]])
    given = dataclasses.replace(room(), layout=layout)
    assert torch.equal(layout_over(given, GROUND), layout)
    assert torch.allclose(layout_over(given, 1.1 * GROUND), 1.1 * layout)
    assert torch.equal(layout_over(given, None), layout)


def finished(tmp_path: Path) -> Finished:
    out = write_out(tmp_path / "out", room(0.2), bodies_of(moving_pose(3, pace=0.1)))
    return read_finished(out)


def corners_of(wall: Any) -> np.ndarray:
    (x, z), (length, thick), yaw = slab(wall)
    half = np.array([[a * length / 2, b * thick / 2] for a in (-1, 1) for b in (-1, 1)])
    c, s = math.cos(yaw), math.sin(yaw)
    return half @ np.array([[c, -s], [s, c]]) + [x, z]


def test_usd_has_them_as_still_boxes_that_say_they_are_guessed(tmp_path: Path):
    Usd = pytest.importorskip("pxr.Usd", reason="needs the extra usd")
    from pxr import Gf, UsdGeom, UsdPhysics

    home = finished(tmp_path)
    found = export_usd(home, tmp_path, walls="guess")
    assert "a wall is guessed from shelf_0, sofa_0" in found.notes
    stage = Usd.Stage.Open(str(found.files[0]))
    for k, wall in enumerate(guess_walls(home.scene, home.bodies)):
        prim = stage.GetPrimAtPath(f"/room/guessed_wall_{k}")
        assert prim.HasAPI(UsdPhysics.CollisionAPI)
        assert not prim.HasAPI(UsdPhysics.RigidBodyAPI)
        assert prim.GetCustomDataByKey("mover:guessed_from") == ", ".join(wall.pieces)
        matrix = UsdGeom.XformCache().GetLocalToWorldTransform(prim)
        points = [
            matrix.Transform(Gf.Vec3d(a, b, c) / 2)
            for a in (-1, 1) for b in (-1, 1) for c in (-1, 1)
        ]  # fmt: skip
        flat = np.array(points)[:, [0, 2]]
        truth = corners_of(wall)
        assert max(np.linalg.norm(flat - p, axis=1).min() for p in truth) < 1e-6
        assert np.ptp(np.array(points)[:, 1]) == pytest.approx(HEIGHT)
    without = Usd.Stage.Open(str(export_usd(home, tmp_path / "without").files[0]))
    assert not without.GetPrimAtPath("/room/guessed_wall_0")


def test_mujoco_has_them_and_the_furniture_stays(tmp_path: Path):
    mujoco = pytest.importorskip("mujoco", reason="needs the extra physics")
    home = finished(tmp_path)
    path = export_mjcf(home, tmp_path, walls="guess").files[0]
    model = mujoco.MjModel.from_xml_path(str(path))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    for k, wall in enumerate(guess_walls(home.scene, home.bodies)):
        geom, size = data.geom(f"guessed_wall_{k}"), model.geom(f"guessed_wall_{k}").size
        turn = np.array(geom.xmat).reshape(3, 3)
        points = [geom.xpos + turn @ (size * [a, b, 0]) for a in (-1, 1) for b in (-1, 1)]
        flat = np.array([[x, -y] for x, y, _ in points])
        assert max(np.linalg.norm(flat - p, axis=1).min() for p in corners_of(wall)) < 1e-6
    start = {p.id: np.array(data.body(p.id).xpos) for p in home.scene.objects}
    for _ in range(1000):  # two seconds
        mujoco.mj_step(model, data)
    for name, place in start.items():
        assert np.linalg.norm(data.body(name).xpos - place) < 0.01


def test_urdf_has_them_as_fixed_boxes(tmp_path: Path):
    mujoco = pytest.importorskip("mujoco", reason="needs the extra physics")
    home = finished(tmp_path)
    found = export_urdf(home, tmp_path, walls="guess")
    assert "a wall is guessed from shelf_0, sofa_0" in found.notes
    model = mujoco.MjModel.from_xml_path(str(found.files[0]))
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    boxes = [g for g in range(model.ngeom) if model.geom_type[g] == mujoco.mjtGeom.mjGEOM_BOX]
    walls = guess_walls(home.scene, home.bodies)
    assert len(boxes) == 2 * (1 + len(walls))  # seen and colliding: the floor, the walls
    for wall in walls:
        (x, z), _, _ = slab(wall)
        away = [np.linalg.norm(data.geom_xpos[g] - [x, -z, HEIGHT / 2]) for g in boxes]
        geom = boxes[int(np.argmin(away))]
        turn, size = data.geom_xmat[geom].reshape(3, 3), model.geom_size[geom]
        points = [
            data.geom_xpos[geom] + turn @ (size * [a, b, 0]) for a in (-1, 1) for b in (-1, 1)
        ]
        flat = np.array([[x, -y] for x, y, _ in points])
        assert max(np.linalg.norm(flat - p, axis=1).min() for p in corners_of(wall)) < 1e-6
    names = {link.attrib["name"] for link in ElementTree.parse(found.files[0]).iter("link")}
    assert {"guessed_wall_0", "guessed_wall_1"} <= names
    assert "guessed_wall" not in export_urdf(home, tmp_path).files[0].read_text()


def test_the_command_says_what_a_guess_rests_on(tmp_path: Path, capsys):
    out = write_out(tmp_path / "out", furnished(("table",)))
    assert run_command("export", [str(out), "--to", "mjcf", "--walls", "guess"]) == 0
    assert "no walls: nothing stands along any" in capsys.readouterr().out
