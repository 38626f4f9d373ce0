"""Physics: convex pieces fill the furniture, simulators read it, gravity shows what is wrong."""

import dataclasses
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from furnished import along_the_axes as along_the_axes  # for every test
from furnished import furnished, moved, write_out
from little_room import GROUND, box, camera, mesh_of, piece

import mover.evaluate.stability
from mover.app.cli import run_command
from mover.core.errors import InputError
from mover.core.run import Run
from mover.core.types import Mesh, Scene
from mover.evaluate.stability import Settled, settle
from mover.furniture.library import PIECES, canonical, make_piece
from mover.geometry.placement import place_object, placed_at
from mover.geometry.topology import is_closed
from mover.geometry.watertight import close_mesh
from mover.io.capture.scene_file import write_scene
from mover.io.export import solids
from mover.io.export.finished import read_finished
from mover.io.files.meshes import write_mesh

BOXES = ("chair", "table")
needs_mujoco = pytest.mark.skipif(
    not mover.evaluate.stability.find_spec("mujoco"), reason="needs the extra physics"
)


def manifold(mesh: Mesh) -> Any:
    import manifold3d

    faces = mesh.faces.numpy().astype(np.uint64)
    return manifold3d.Manifold(manifold3d.Mesh64(mesh.verts.double().numpy(), faces))


def alone(mesh: Mesh, lift: float = 0.0, **changes: Any) -> Scene:
    given = piece("thing_0", mesh, (0.3, -3.0), 0.4, GROUND + lift)
    return Scene(camera(), GROUND, (dataclasses.replace(given, **changes),))


@pytest.mark.slow
@pytest.mark.parametrize("method", ["coacd", "slices"])
@pytest.mark.parametrize("name", ["chair", "sofa", "table"])
def test_convex_pieces_fill_the_furniture_and_little_more(name: str, method: str):
    if method == "coacd":
        pytest.importorskip("coacd", reason="needs the extra physics")
    mesh = close_mesh(make_piece(name, np.random.default_rng(0), 0).mesh)
    found = solids.cut_into_convex(solids.ConvexInputs(mesh), solids.ConvexConfig(method))
    union = manifold(found.hulls[0])
    for hull in found.hulls:
        assert is_closed(hull.faces)
        assert trimesh.Trimesh(hull.verts, hull.faces, process=False).is_convex
        union = union + manifold(hull)
    solid = manifold(mesh)
    missing, extra = (solid - union).volume(), (union - solid).volume()
    assert missing < 0.01 * solid.volume()
    assert extra < 0.08 * solid.volume()
    legs = min(float(hull.verts[:, 1].min()) for hull in found.hulls)
    assert legs == pytest.approx(float(mesh.verts[:, 1].min()), abs=0.001)


def test_a_convex_piece_stays_whole_and_a_sheet_gets_some_thickness():
    whole = solids.cut_into_convex(solids.ConvexInputs(box(1, 2, 3)), solids.ConvexConfig("slices"))
    assert len(whole.hulls) == 1
    assert whole.volume == pytest.approx(6)
    thin = solids.cut_into_convex(
        solids.ConvexInputs(box(1, 1e-7, 1)), solids.ConvexConfig("slices")
    )
    assert float(np.ptp(thin.hulls[0].verts[:, 1].numpy())) > 5e-4


def test_convex_pieces_are_kept_with_the_result(tmp_path: Path):
    scene = furnished(BOXES)
    first = solids.solids_of(scene, Run(tmp_path))
    again = Run(tmp_path)
    second = solids.solids_of(scene, again)
    assert [log.kept for log in again.stages] == [True, True]
    for a, b in zip(first, second, strict=True):
        assert torch.equal(
            torch.cat([h.verts for h in a.hulls]), torch.cat([h.verts for h in b.hulls])
        )


def test_the_closed_proxies_of_the_run_are_what_collides(tmp_path: Path):
    scene = furnished(("chair",))
    write_mesh(box(0.3, 0.4, 0.5), tmp_path / "watertight" / "chair_0.glb")
    solid = solids.solids_of(scene, Run(tmp_path))[0]
    assert len(solid.hulls) == 1
    assert solid.mass == pytest.approx(0.3 * 0.4 * 0.5 * solids.DENSITY["chair"], rel=1e-5)


def test_mass_and_inertia_are_those_of_the_stretched_solid(tmp_path: Path):
    """Against trimesh, on the mesh in the simulator's axes."""
    given = furnished(("chair",)).objects[0]
    given = dataclasses.replace(given, scale=torch.tensor([1.3, 0.8, 1.1]))
    solid = solids.solids_of(Scene(camera(), GROUND, (given,)), Run(tmp_path))[0]
    x, y, z = (close_mesh(given.mesh).verts * given.scale).double().numpy().T
    truth = trimesh.Trimesh(
        np.stack([x, -z, y], -1), close_mesh(given.mesh).faces.numpy(), process=False
    )
    truth.density = solids.DENSITY["chair"]
    assert solid.mass == pytest.approx(truth.mass, rel=1e-4)
    assert solid.centre.numpy() == pytest.approx(truth.center_mass, abs=1e-5)
    assert solid.inertia.numpy() == pytest.approx(truth.moment_inertia, rel=1e-3, abs=1e-4)


def test_every_class_of_the_library_has_a_density():
    assert {canonical(name) for name in PIECES} <= set(solids.DENSITY)


@pytest.mark.slow
@needs_mujoco
def test_mujoco_reads_the_model_with_everything_in_place(tmp_path: Path):
    scene = furnished((*BOXES, "shelf"))
    pieces = [
        dataclasses.replace(p, scale=torch.tensor([1.1, 0.9, 1.2]), support=s)
        for p, s in zip(scene.objects, ("ground", "free", "ground"), strict=True)
    ]
    scene = dataclasses.replace(scene, objects=tuple(pieces))
    home = read_finished(write_out(tmp_path / "out", scene))
    mujoco, model, data = simulated(solids.export_mjcf(home, tmp_path).files[0])
    mujoco.mj_forward(model, data)
    assert model.njnt == 2  # the table hangs
    for given in pieces:
        body = model.body(given.id)
        points = [
            corners(model, data, geom)
            for geom in range(body.geomadr[0], body.geomadr[0] + body.geomnum[0])
        ]
        collide = np.concatenate([p for p, group in points if group == 3])
        look = np.concatenate([p for p, group in points if group == 2])
        x, y, z = place_object(given).verts.double().numpy().T
        truth = np.stack([x, -z, y - GROUND], -1)
        bounds = np.stack([truth.min(0), truth.max(0)])
        assert np.stack([look.min(0), look.max(0)]) == pytest.approx(bounds, abs=1e-4)
        assert np.stack([collide.min(0), collide.max(0)]) == pytest.approx(bounds, abs=2e-3)
    assert data.geom("ground").xpos == pytest.approx([0, 0, 0])
    assert data.cam("camera").xpos == pytest.approx([0, 0, -GROUND])
    view = np.array(data.cam("camera").xmat).reshape(3, 3)
    point = np.array([0.4, -0.8, -3.5])
    there = view.T @ (np.array([point[0], -point[2], point[1]]))
    focal = 180 / math.tan(math.radians(model.cam("camera").fovy[0]) / 2)
    seen = (scene.camera.K @ scene.camera.R_cam_world @ torch.tensor(point).float()).numpy()
    u, v = 320 - focal * there[0] / there[2], 180 + focal * there[1] / there[2]
    assert [u, v] == pytest.approx(seen[:2] / seen[2], abs=0.05)


def simulated(file: Path) -> tuple[Any, Any, Any]:
    """The simulator with a model and its state."""
    import mujoco

    model = mujoco.MjModel.from_xml_path(str(file))
    return mujoco, model, mujoco.MjData(model)


def corners(model: Any, data: Any, geom: int) -> tuple[np.ndarray, int]:
    """Vertices of a mesh in the world, and its group."""
    mesh = model.geom_dataid[geom]
    start, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    turn = np.array(data.geom_xmat[geom]).reshape(3, 3)
    verts = np.array(model.mesh_vert[start : start + count]) @ turn.T + data.geom_xpos[geom]
    return verts, int(model.geom_group[geom])


def test_masses_are_said_with_two_digits_however_light(tmp_path):
    scene = furnished(("chair",))
    for size in (0.05, 1.0, 5.0):
        piece = dataclasses.replace(scene.objects[0], scale=torch.full((3,), size))
        scene = dataclasses.replace(scene, objects=(piece,))
        home = read_finished(write_out(tmp_path / "out", scene))
        (said,) = (
            note for note in solids.export_mjcf(home, tmp_path).notes if note.endswith(" kg")
        )
        mass = solids.solids_of(scene, Run(tmp_path / "out"))[0].mass
        assert float(said.split()[1]) == pytest.approx(mass, rel=0.05)
        assert "e" not in said.split()[1]


@needs_mujoco
def test_keyframes_put_furniture_where_it_then_stands(tmp_path: Path):
    home = read_finished(write_out(tmp_path / "out", furnished(BOXES)))
    objects = moved(home.scene, 8).objects[::-1]
    scene = dataclasses.replace(home.scene, objects=objects)
    file = solids.export_mjcf(dataclasses.replace(home, scene=scene), tmp_path).files[0]
    mujoco, model, data = simulated(file)
    assert [model.key(k).name for k in range(model.nkey)] == ["frame_0", "frame_8"]
    for key, frame in enumerate((0, 8)):
        mujoco.mj_resetDataKeyframe(model, data, key)
        mujoco.mj_forward(model, data)
        for item in objects:
            there = placed_at(item, frame)
            x, y, z = there.t_world_object.double().tolist()
            assert data.body(item.id).xpos == pytest.approx([x, -z, y - GROUND], abs=1e-6)
            front = data.body(item.id).xmat.reshape(3, 3) @ [0, -1, 0]
            yaw = float(there.yaw)
            assert front == pytest.approx([np.sin(yaw), -np.cos(yaw), 0], abs=1e-6)


def gallows() -> Mesh:
    """A foot with a long arm on one side."""
    foot = trimesh.creation.box(extents=(0.2, 0.4, 0.2))
    foot.apply_translation([0, 0.2, 0])
    arm = trimesh.creation.box(extents=(1.2, 0.2, 0.2))
    arm.apply_translation([0.5, 0.5, 0])
    return mesh_of(trimesh.util.concatenate([foot, arm]))


@needs_mujoco
@pytest.mark.parametrize(("mesh", "lift", "support", "moved", "turned"), [
    (box(0.6, 0.5, 0.6), 0.15, "ground", (0.14, 0.16), 0.0),  # floats: it falls as far
    (box(0.6, 0.5, 0.6), -0.05, "ground", (0.04, 9.0), 0.0),  # is sunk: it comes up
    (gallows(), 0.0, "ground", (0.1, 9.0), math.radians(15)),  # leans over its foot: it falls
    (box(0.6, 0.5, 0.1), 1.0, "free", (0.0, 0.0), 0.0),  # hangs: it is held
])  # fmt: skip
def test_what_floats_is_sunk_or_leans_moves_and_what_hangs_is_held(
    mesh, lift, support, moved, turned, tmp_path: Path
):
    (found,) = settle(alone(mesh, lift, support=support), Run(tmp_path))
    assert moved[0] <= found.moved <= moved[1]
    assert found.turned >= turned
    assert found.stays == found.fixed == (support == "free")


@pytest.mark.slow
@needs_mujoco
def test_what_stands_on_the_floor_or_on_a_table_stays_with_and_without_a_known_floor(tmp_path):
    table = piece("table_0", box(1.2, 0.7, 0.8), (0, -3), 0.2, GROUND)
    lamp = piece("lamp_0", box(0.2, 0.4, 0.2), (0.1, -3.1), 0.0, GROUND + 0.7)
    lamp = dataclasses.replace(lamp, support="table_0")
    whole = furnished()
    lowest = dataclasses.replace(furnished(BOXES), ground=None)
    carried = Scene(camera(), GROUND, (table, lamp))
    for scene, most in ((whole, 0.001), (lowest, 0.001), (carried, 0.002)):
        for found in settle(scene, Run(tmp_path)):
            assert found.moved < most, found
            assert found.turned < math.radians(0.2), found
            assert found.stays


def test_without_mujoco_the_way_to_get_it_is_named(tmp_path: Path, monkeypatch):
    monkeypatch.setattr(mover.evaluate.stability, "find_spec", lambda _: None)
    with pytest.raises(InputError, match=r"\.\[physics\]"):
        settle(furnished(BOXES), Run(tmp_path))


@pytest.mark.slow
@needs_mujoco
@pytest.mark.parametrize("seed", range(10))
def test_the_truth_of_known_rooms_stands_still(seed: int, tmp_path: Path):
    from mover_bench.rooms.compose import draw_plan
    from mover_bench.rooms.config import RoomConfig
    from mover_bench.rooms.known import scene_of

    plan = draw_plan(np.random.default_rng([seed, 0]), RoomConfig())
    for found in settle(scene_of(plan), Run(tmp_path), 3.0):
        assert found.moved < 0.01, found


def test_what_moves_a_centimetre_or_turns_a_degree_does_not_stay():
    row = Settled("a", 0.009, math.radians(0.9), fixed=False)
    assert row.stays
    for change in ({"moved": 0.011}, {"turned": math.radians(1.1)}):
        assert not dataclasses.replace(row, **change).stays


@needs_mujoco
def test_evaluate_prints_the_share_that_stays_before_and_after(tmp_path: Path, capsys, monkeypatch):
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
    write_out(tmp_path / "same", Scene(camera(), GROUND, tuple(boxes)))
    assert run_command("evaluate", [str(out), "--truth", str(tmp_path / "same")]) == 0
    assert "same has the initial scene of this result" in capsys.readouterr().out
