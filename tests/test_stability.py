"""Who sits where, what stays under them, and pieces that are nudged to where they stand."""

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
from mover.bodies.skin import PARTS
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
from mover.io.capture.scene_file import write_scene
from mover.io.export.contacts import write_labels

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
