"""Whole scenes against the truth: what is best, what is absent, what is written, what harms."""

import json
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest
import torch
from judged import CAMERA, FAST, GROUND, SELF_CONTAINED, cuboid, moved, pair, people, piece, room

from mover.bodies.corrected import in_world
from mover.core.errors import InputError
from mover.core.types import Scene
from mover.evaluate.bodies import soles_of
from mover.evaluate.evaluation import (
    FIRST,
    METRICS,
    EvaluatedBodies,
    evaluate,
    evaluate_folder,
    table,
)
from mover.evaluate.scene import unmatched
from mover.evaluate.stability import PHYSICS_METRICS
from mover.geometry.camera import tilted, to_camera
from mover.geometry.rotations import rot_y
from mover.io.capture.bodies_file import write_bodies
from mover.io.capture.scene_file import write_scene


def test_the_truth_scores_best_in_every_metric() -> None:
    scene, bodies = room(), people(4)
    metrics = evaluate(scene, scene, scene, EvaluatedBodies(bodies, bodies, bodies), FAST)
    assert list(metrics) == ["initial", "result", "objects"]
    for key in ("initial", "result"):
        assert set(metrics[key]) == set(METRICS)
        for name in set(METRICS) - SELF_CONTAINED:
            assert metrics[key][name] == pytest.approx(METRICS[name].best, abs=1e-6), name
    for item in metrics["objects"]:
        for name, value in item["result"].items():
            assert value == pytest.approx(METRICS[name].best, abs=1e-6), (item["id"], name)
    json.dumps(metrics, allow_nan=False)


@pytest.mark.parametrize(("names", "change"), [
    (("iou3d", "iou2d", "p2s", "center_error"), lambda p, a: moved(p, 0.1 * a, 0, 0)),
    (("iou3d", "p2s", "center_error"), lambda p, a: moved(p, 0, 0, -0.1 * a)),
    (("iou3d", "p2s"), lambda p, a: replace(p, yaw=p.yaw + 0.15 * a)),
    (("iou3d", "p2s"), lambda p, a: replace(p, scale=p.scale * (1 + 0.2 * a))),
])  # fmt: skip
def test_a_larger_fault_never_scores_better(names, change):
    truth = piece(cuboid(0.6, 0.9, 0.45), (-0.5, GROUND, -2.8), 0.1)
    rows = []
    for amount in range(6):
        metrics = pair(change(truth, amount), truth, 300)
        rows.append([METRICS[name].measure(metrics) for name in names])
    for name, values in zip(names, zip(*rows, strict=True), strict=True):
        worse = 1 if METRICS[name].best == 0 else -1
        assert all((b - a) * worse >= -1e-9 for a, b in pairwise(values)), name
        assert (values[-1] - values[0]) * worse > 0.02, name


def test_a_missing_object_scores_zero_in_overlaps_and_nothing_else() -> None:
    truth = room()
    fewer = replace(truth, objects=truth.objects[1:])
    metrics = evaluate(fewer, truth, truth, config=FAST)
    assert metrics["objects"][0]["initial"] == {"iou3d": 0.0, "iou2d": 0.0}
    assert metrics["initial"]["iou3d"] == pytest.approx(2 / 3)
    assert metrics["initial"]["center_error"] == pytest.approx(0)


def test_objects_that_the_truth_does_not_know_cost_nothing() -> None:
    truth = room()
    extra = replace(
        truth, objects=(*truth.objects, piece(cuboid(1, 1, 1), (3, GROUND, -3), 0, "x"))
    )
    assert evaluate(extra, extra, truth, config=FAST) == evaluate(truth, truth, truth, config=FAST)


def test_missed_and_false_objects_are_named_and_a_missed_one_counts_as_nothing_found() -> None:
    truth = room()
    ghost = replace(moved(truth.objects[0], 0.1, 0, 0), id="ghost")
    given = replace(truth, objects=(*truth.objects[1:], ghost))
    names = [p.id for p in truth.objects]
    assert unmatched(given, given, truth) == {"missed": [], "false": []}
    known = unmatched(given, given, truth, by_place=False)
    assert known == {"missed": names[:1], "false": ["ghost"]}
    config = replace(FAST, by_place=False)
    metrics = evaluate(given, given, truth, config=config)
    assert metrics["objects"][0]["result"] == {"iou3d": 0.0, "iou2d": 0.0}
    assert metrics["result"]["iou3d"] == pytest.approx((len(names) - 1) / len(names))
    text = table({**metrics, "unmatched": known})
    assert f"missed: {names[0]}\nfalse: ghost" in text


def test_what_lacks_its_truth_is_absent() -> None:
    scene, bodies = room(), people()
    blind = replace(scene, ground=None, objects=())
    bare = replace(bodies, joints=None, joint_names=())
    metrics = evaluate(scene, scene, blind, EvaluatedBodies(None, bodies, None), FAST)
    assert set(metrics["initial"]) == {"pitch_error", "roll_error"}
    alone = {"non_collision", "contact"}
    floor = {"ground_penetration_frequency", "ground_penetration_distance"}
    assert set(metrics["result"]) == {"pitch_error", "roll_error"} | alone | floor
    assert metrics["objects"] == []
    metrics = evaluate(blind, blind, blind, EvaluatedBodies(bare, bodies, bodies), FAST)
    assert {"pje", "p_pje"} & set(metrics["initial"]) == set()
    assert {"v2v", "p_v2v", "contact_f1"} <= set(metrics["initial"])
    assert floor & set(metrics["initial"]) == set()
    later = replace(bodies, frame=bodies.frame + 100)
    metrics = evaluate(scene, scene, scene, EvaluatedBodies(None, bodies, later), FAST)
    assert {"v2v", "pje", "contact_f1"} & set(metrics["result"]) == set()


def test_meshes_of_another_topology_have_no_vertex_metrics() -> None:
    scene, bodies = room(), people()
    other = replace(people(detail="full"), joints=bodies.joints)
    assert other.verts.shape[1] != bodies.verts.shape[1]
    metrics = evaluate(scene, scene, scene, EvaluatedBodies(None, bodies, other), FAST)["result"]
    assert metrics["pje"] == pytest.approx(0)
    assert {"v2v", "p_v2v", "contact_f1"} & set(metrics) == set()


def test_people_without_rows_are_no_people() -> None:
    scene, one = room(), people(1)
    nobody = replace(
        one, verts=one.verts[:0], joints=None, joint_names=(), frame=one.frame[:0],
        person=one.person[:0],
    )  # fmt: skip
    without = evaluate(scene, scene, scene, config=FAST)
    assert evaluate(scene, scene, scene, EvaluatedBodies(nobody, nobody, nobody), FAST) == without


def test_bodies_in_the_camera_frame_are_taken_to_the_world_of_their_scene() -> None:
    bodies = people()
    seen = replace(
        bodies, space="camera", verts=to_camera(bodies.verts, CAMERA.R_cam_world.float()),
        joints=to_camera(bodies.joints, CAMERA.R_cam_world.float()),
    )  # fmt: skip
    assert torch.allclose(in_world(seen, CAMERA).verts, bodies.verts, atol=1e-5)
    joints = in_world(seen, CAMERA).joints
    assert torch.allclose(joints, bodies.joints, atol=1e-5)
    assert torch.equal(soles_of(seen, CAMERA), soles_of(bodies, CAMERA))


def test_the_folder_gives_the_same_numbers_and_writes_them(tmp_path: Path) -> None:
    truth, bodies = room(), people()
    wrong = replace(truth, objects=tuple(moved(p, 0.2, 0, 0) for p in truth.objects))
    out, true = tmp_path / "out", tmp_path / "truth"
    write_scene(truth, true / "scene.json")
    write_scene(wrong, out / "initial.json")
    write_scene(truth, out / "scene.json")
    write_bodies(bodies, out / "bodies.npz")
    write_bodies(bodies, true / "bodies.npz")
    found = evaluate_folder(out, true, FAST, physics=False)
    assert json.loads((out / "metrics.json").read_text()) == found
    assert found["initial"]["center_error"] == pytest.approx(0.2, abs=1e-5)
    assert found["result"]["center_error"] == pytest.approx(0, abs=1e-5)
    assert "v2v" in found["result"]
    assert "v2v" not in found["initial"]
    expected = evaluate(wrong, truth, truth, EvaluatedBodies(None, bodies, bodies), FAST)
    for key in ("initial", "result"):
        assert found[key] == pytest.approx(expected[key], abs=1e-4)


def test_a_true_scene_without_a_camera_takes_that_of_camera_json(tmp_path: Path) -> None:
    scene = room()
    for name in ("out/scene.json", "out/initial.json", "truth/scene.json"):
        write_scene(scene, tmp_path / name)
    path = tmp_path / "truth" / "scene.json"
    tree = json.loads(path.read_text())
    camera = tree.pop("camera")
    path.write_text(json.dumps(tree))
    with pytest.raises(InputError):
        evaluate_folder(tmp_path / "out", tmp_path / "truth", FAST, physics=False)
    camera["R_cam_world"] = tilted(torch.tensor(-0.3), torch.tensor(0.0)).tolist()
    (tmp_path / "truth" / "camera.json").write_text(json.dumps(camera))
    found = evaluate_folder(tmp_path / "out", tmp_path / "truth", FAST, physics=False)["result"]
    assert found["pitch_error"] == pytest.approx(0.1, abs=1e-6)


def test_a_folder_without_truth_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError):
        evaluate_folder(tmp_path, tmp_path / "truth")


def test_the_table_tells_every_metric_before_and_after() -> None:
    scene, bodies = room(), people(4)
    metrics = evaluate(scene, scene, scene, EvaluatedBodies(None, bodies, bodies), FAST)
    lines = table(metrics).splitlines()
    for name in METRICS:
        row = next(line for line in lines if line.split()[0] == name)
        before, after, best = row.split()[-3:]
        assert float(best) == METRICS[name].best
        assert float(after) == pytest.approx(metrics["result"][name], abs=1e-3)
        assert (before == "-") == (name not in metrics["initial"])
    for item in metrics["objects"]:
        assert any(line.startswith(item["id"]) for line in lines)


def test_the_first_screen_shows_six_metrics_and_every_object() -> None:
    scene, bodies = room(), people(4)
    metrics = evaluate(scene, scene, scene, EvaluatedBodies(None, bodies, bodies), FAST)
    first, every = (
        {line.split()[0] for line in table(metrics, shown).splitlines() if line}
        for shown in (FIRST, None)
    )
    assert every - first == set(METRICS) - set(FIRST)
    assert len(FIRST) == 6
    assert len(METRICS) + len(PHYSICS_METRICS) <= 18


def test_the_result_keeps_the_partners_of_the_initial_scene() -> None:
    scene = room()
    left, right = (
        piece(cuboid(0.5, 0.9, 0.5), (x, GROUND, -3), 0, n) for x, n in ((-1, "l"), (1, "r"))
    )
    truth = replace(scene, objects=(left, right))
    initial = replace(scene, objects=(replace(left, id="p"), replace(right, id="q")))
    crossed = replace(scene, objects=(replace(right, id="p"), replace(left, id="q")))
    metrics = evaluate(initial, crossed, truth, config=FAST)
    assert metrics["initial"]["iou3d"] == pytest.approx(1)
    assert metrics["result"]["center_error"] == pytest.approx(2)


def test_a_seat_in_the_way_of_a_standing_person_costs_non_collision() -> None:
    scene, bodies = room(), people(1)
    feet = bodies.verts[0].mean(0).double()
    block = piece(cuboid(0.6, 0.5, 0.6), (float(feet[0]), GROUND, float(feet[2])), 0, "block")
    hit = replace(scene, objects=(block,))
    free = replace(scene, objects=(moved(block, 3, 0, 0),))
    everyone = EvaluatedBodies(bodies, bodies, bodies)
    metrics = evaluate(hit, free, free, everyone, FAST)
    height = bodies.verts[0, :, 1] - GROUND
    inside = ((height < 0.5) & (height > 0)).double().mean()
    assert metrics["initial"]["non_collision"] == pytest.approx(1 - float(inside), abs=0.01)
    assert metrics["initial"]["contact"] == 1
    assert metrics["initial"]["contact_f1"] == 0
    assert metrics["result"]["non_collision"] == 1
    assert metrics["result"]["contact"] == 0
    assert metrics["result"]["contact_f1"] == 1


def test_one_side_by_itself_changes_no_number() -> None:
    scene, bodies = room(), people(3)
    wrong = replace(scene, objects=tuple(moved(p, 0.1, 0, 0.05) for p in scene.objects))
    alone = EvaluatedBodies(None, bodies, bodies)
    whole = evaluate(wrong, scene, scene, EvaluatedBodies(bodies, bodies, bodies), FAST)
    for side, judged in (("initial", wrong), ("result", scene)):
        found = evaluate(wrong, judged, scene, alone, FAST, ("result",))
        assert found["result"] == whole[side]
        assert set(found) == {"result", "objects"}
        for one, all_sides in zip(found["objects"], whole["objects"], strict=True):
            assert one == {"id": all_sides["id"], "result": all_sides[side]}


def test_a_floor_that_rises_over_standing_feet_is_penetrated_by_its_rise() -> None:
    scene, bodies = room(), people(2)
    soles = bodies.verts[:, soles_of(bodies, CAMERA), 1] - GROUND
    assert 0 <= float(soles.min()) < 0.01
    high = replace(scene, ground=GROUND + 0.3)
    metrics = evaluate(high, scene, scene, EvaluatedBodies(bodies, bodies, None), FAST)
    assert metrics["initial"]["ground_penetration_frequency"] == 1
    expected = 0.3 - float(soles.mean())
    assert metrics["initial"]["ground_penetration_distance"] == pytest.approx(expected, abs=1e-5)
    assert metrics["result"]["ground_penetration_frequency"] == 0


def grown(scene: Scene, scale: float, yaw: float, step: tuple[float, float, float]) -> Scene:
    """The scene after an upright similarity."""
    turn = scale * rot_y(torch.tensor(yaw).double())
    pieces = [
        replace(p, t_world_object=turn @ p.t_world_object + torch.tensor(step),
                yaw=p.yaw + yaw, scale=p.scale * scale)
        for p in scene.objects
    ]  # fmt: skip
    return replace(scene, objects=tuple(pieces))


def with_first_moved(scene: Scene, z: float) -> Scene:
    return replace(scene, objects=(moved(scene.objects[0], 0, 0, z), *scene.objects[1:]))


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
    other = replace(moved(truth.objects[0], 0, 0, 1.5), id="other", annotation=None)
    more = replace(truth, objects=(*truth.objects, other))
    found = evaluate(truth, truth, more)["result"]
    assert found["iou3d_aligned"] == pytest.approx(len(truth.objects) / len(more.objects), abs=1e-4)


@pytest.mark.parametrize(("off", "by_10"), [(0.05, 0), (0.15, 1), (-0.3, 1), (0.7, 1)])
def test_objects_that_end_farther_from_the_truth_than_given_are_counted(off, by_10):
    truth = room()
    found = evaluate(truth, with_first_moved(truth, off), truth)
    count = len(truth.objects)
    assert found["result"]["worse_by_10cm"] == pytest.approx(by_10 / count)
    assert found["objects"][0]["result"]["worse_by_10cm"] == by_10
    assert found["initial"]["worse_by_10cm"] == 0


def test_what_was_given_wrong_and_comes_nearer_is_no_harm() -> None:
    truth = room()
    found = evaluate(with_first_moved(truth, 2.0), with_first_moved(truth, 1.0), truth)["result"]
    assert found["worse_by_10cm"] == 0
