"""`refine --preset paper`: SMPLify-X again in the estimated room, with the terms of PROX."""

import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from analytic import FACES, box_verts
from test_commands_refine import FAR, finished, lowest, standing
from test_experiment import quick

from mover.app import cli
from mover.bodies.keypoints import keypoints_of
from mover.bodies.skinning import open_body
from mover.core.run import Run
from mover.core.types import Bodies, Keypoints, Mesh, Room, Scene
from mover.evaluate.contact import close_meshes, furniture_of
from mover.evaluate.evaluation import evaluate_people
from mover.fitting.bodies import FitInputs, fit_bodies
from mover.fitting.config import Stage
from mover.fitting.presets import FITS, PAPER_ROOM, ROOM_TERMS, at_most, without
from mover.fitting.prior import ANGLES
from mover.fitting.room import RHO, FitRoom, room_terms
from mover.fitting.unknowns import Points
from mover.geometry.camera import project
from mover.geometry.volume import grid_around
from mover.geometry.volume_warp import union_bodies
from mover.geometry.watertight import close_mesh
from mover.io.capture.bodies_file import read_bodies
from mover.io.capture.scene_file import read_scene
from mover.io.people.keypoints import write_keypoints
from mover.pipeline.outcome import to_world
from mover.pipeline.presets import PRESETS
from mover.pipeline.reconstruct import reconstruct
from mover.pipeline.refit import pairs_of, refit_bodies
from mover_bench.experiment.job import with_noise
from mover_bench.experiment.measures import under_camera
from mover_bench.experiment.sets import SETS
from mover_bench.rooms.seen import joints_seen

QUICK = ["--stages.0.steps", "15", "--stages.1.steps", "5", "--stages.2.steps", "10"]


def keypoints_in(out, bodies: Bodies) -> Keypoints:
    """What a detector sees of people in the world of a result."""
    camera = read_scene(out / "scene.json").camera
    points = keypoints_of(open_body(), bodies.verts, bodies.joints, "openpose25")
    pixels = project(points @ camera.R_cam_world.mT, camera.K)
    sure = torch.ones(pixels.shape[:2])
    return Keypoints(pixels, sure, "openpose25", bodies.frame, bodies.person, 5.0)


@pytest.fixture
def result(tmp_path):
    """Somebody too far away, seen where the truth is; a truth, and the keypoints."""
    out = finished(tmp_path / "out", standing(FAR))
    truth = finished(tmp_path / "truth", standing(0.0))
    write_keypoints(keypoints_in(truth, standing(0.0)), tmp_path / "keypoints.npz")
    return out, truth, tmp_path / "keypoints.npz"


def test_people_are_fitted_again_on_the_floor_of_their_room(result, capsys):
    out, truth, seen = result
    words = [str(out), "--preset", "paper", "--keypoints", str(seen), "--truth", str(truth)]
    assert cli.run_command("refine", [*words, *QUICK]) == 0
    assert "3 bodies fitted again in their room" in capsys.readouterr().out
    before, after = read_bodies(out / "bodies.npz"), read_bodies(out / "refined" / "bodies.npz")
    assert (
        lowest(after).abs().max() < 0.5 * lowest(before).abs().min()
    )  # the last stage holds loosely
    values = json.loads((out / "refined" / "metrics.json").read_text())
    assert values["refined"]["pje"] < 0.5 * values["result"]["pje"]
    assert after.pose.betas.unique(dim=0).shape[0] == 1


def test_the_floor_does_it_and_may_be_left_out(result):
    out, _, seen = result
    words = [str(out), "--preset", "paper", "--keypoints", str(seen), *QUICK]
    assert cli.run_command("refine", [*words, "--no-camgp"]) == 0
    without_floor = lowest(read_bodies(out / "refined" / "bodies.npz")).abs().max()
    assert cli.run_command("refine", words) == 0
    assert lowest(read_bodies(out / "refined" / "bodies.npz")).abs().max() < 0.5 * without_floor


def test_people_are_paired_in_each_frame_whatever_their_numbers():
    near, far = standing(0.0, 2), standing(0.0, 2)
    far = replace(far, verts=far.verts + 1, joints=far.joints + 1, person=torch.tensor([1, 1]))
    both = replace(
        near, verts=torch.cat([near.verts, far.verts]), joints=torch.cat([near.joints, far.joints]),
        frame=torch.tensor([0, 1, 0, 1]), person=torch.tensor([0, 0, 1, 1]), pose=None,
        space="camera",
    )  # fmt: skip
    flip = torch.tensor([1.0, -1, -1])  # into a camera's axes
    both = replace(both, verts=both.verts * flip, joints=both.joints * flip)
    K = torch.tensor([[500.0, 0, 320], [0, 500, 240], [0, 0, 1]])
    pixels = project(both.joints[:, :17], K)[[2, 0, 3, 1, 1]]
    pixels[4] += 900  # nobody
    seen = Keypoints(
        pixels, torch.ones(5, 17), "coco17", torch.tensor([0, 0, 1, 1, 1]),
        torch.tensor([0, 1, 7, 8, 9]), 5.0,
    )  # fmt: skip
    assert pairs_of(both, seen, K).tolist() == [[0, 2], [1, 0], [2, 3], [3, 1]]


def test_bodies_without_keypoints_are_left_out_and_said(result, capsys):
    out, truth, seen = result
    every = keypoints_in(truth, standing(0.0))
    some = replace(
        every, points=every.points[:2], confidence=every.confidence[:2], frame=every.frame[:2],
        person=every.person[:2],
    )  # fmt: skip
    write_keypoints(some, seen)
    words = [str(out), "--preset", "paper", "--keypoints", str(seen)]
    few = [word for k in range(3) for word in (f"--stages.{k}.steps", "2")]
    assert cli.run_command("refine", [*words, *few]) == 0
    assert "1 of 3 bodies have no keypoints: left out" in capsys.readouterr().out
    assert len(read_bodies(out / "refined" / "bodies.npz").frame) == 2


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--preset", "paper"], "--keypoints: is missing, expected a path"),
        (["--keypoints", "k.npz"], "--keypoints, --vposer: of --preset paper only"),
        (["--preset", "best"], "--preset: 'best' is none of robust, paper"),
    ],
)
def test_what_is_asked_wrongly_is_one_sentence(tmp_path, capsys, words, said):
    out = finished(tmp_path / "out", standing(FAR))
    assert cli.run_command("refine", [str(out), *words]) == 2
    assert said in capsys.readouterr().err


def test_bare_meshes_and_other_frames_are_refused(result, tmp_path, capsys):
    out, truth, seen = result
    words = ["--preset", "paper", "--keypoints", str(seen)]
    late = keypoints_in(truth, standing(0.0))
    write_keypoints(replace(late, frame=late.frame + 100), seen)
    assert cli.run_command("refine", [str(out), *words]) == 2
    assert "none is of a frame of bodies.npz" in capsys.readouterr().err
    bare = finished(tmp_path / "bare", replace(standing(FAR), pose=None))
    assert cli.run_command("refine", [str(bare), *words]) == 2
    assert "has no parameters of a body model" in capsys.readouterr().err


def box_room(stands=(False, False)) -> FitRoom:
    """A box of half a metre on a floor at -1, two points of the skin that both may touch."""
    mesh = Mesh(box_verts((0.5, 0.5, 0.5)).float() - torch.tensor([0.0, 1.0, 0.0]), FACES)
    low, high = mesh.verts.amin(0), mesh.verts.amax(0)
    volume = union_bodies(mesh.verts[None], mesh.faces, grid_around(low, high, 64, 0.2), 1)
    top = torch.tensor([[0.0, -0.5, 0.0]])
    return FitRoom(
        torch.eye(3), -1.0, volume, top, torch.tensor([[0.0, 1.0, 0.0]]),
        torch.arange(2), torch.tensor([True, True]), 10.0, torch.tensor([True, True]),
        torch.tensor([stands]),
    )  # fmt: skip


def at(*places, facing=(0.0, -1.0, 0.0)) -> Points:
    skin = torch.tensor([places]).requires_grad_()
    none = torch.zeros(1, 0, 3)
    return Points(none, none, skin, torch.tensor([[facing] * len(places)]))


def test_each_term_is_what_prox_writes():
    deep = at((0.0, -0.6, 0.0), (2.0, -1.03, 0.0))  # 10 cm in the box; 3 cm below the floor
    found = room_terms(deep, box_room(), Stage(under=100, sdf=2.0, contact=7.0))
    assert found["under"].item() == pytest.approx(3.0, abs=1e-4)
    assert found["sdf"].item() == pytest.approx(2 * 10 * 0.1, rel=0.1)
    far = 4.0 + 0.53**2
    each = [0.1**2 / (0.1**2 + RHO**2), far / (far + RHO**2)]
    assert found["contact"].item() == pytest.approx(7 * sum(each) / 2, rel=1e-4)
    stands = room_terms(deep, box_room((False, True)), Stage(feet=1.0))
    assert stands["feet"].item() == pytest.approx(0.03**2 / (0.03**2 + RHO**2), rel=1e-3)


def test_a_surface_of_another_direction_is_not_touched_and_nothing_is_nothing():
    aside = at((0.0, -0.45, 0.0), (0.1, -0.45, 0.0), facing=(1.0, 0.0, 0.0))
    found = room_terms(aside, box_room(), Stage(contact=7.0, feet=1.0, sdf=1.0, under=1.0))
    assert {name: value.item() for name, value in found.items()} == dict.fromkeys(found, 0.0)
    assert room_terms(aside, None, Stage(contact=7.0)) == {}
    assert room_terms(aside, box_room(), Stage()) == {}


def test_every_row_of_the_table_leaves_its_terms_out():
    for row, names in ROOM_TERMS.items():
        stages = without(PAPER_ROOM, row).stages
        assert all(getattr(stage, name) == 0 for stage in stages for name in names)
        assert any(getattr(stage, name) for stage in PAPER_ROOM.stages for name in names)
        others = [n for r, ns in ROOM_TERMS.items() if r != row for n in ns]
        assert all(any(getattr(stage, n) for stage in stages) for n in others)


@pytest.mark.slow
def test_the_chain_from_keypoints_gives_people_a_place_in_the_room(small_room, tmp_path):
    """The paper's chain: keypoints, fit, room, the people fitted again in it (Tab. 5)."""
    trial = with_noise(small_room, 3, SETS["rooms"])
    seated = torch.tensor([action in ("sit", "lean") for action in small_room.actions])
    camera, rng = trial.truth.camera, np.random.default_rng([3, 25])
    seen = joints_seen(small_room.bodies, camera, seated, rng)
    first = trial.capture.scene.camera
    inputs = FitInputs(seen, first, open_body(), trial.capture.bodies)
    fitted = fit_bodies(inputs, at_most(FITS["paper"], 10)).bodies
    capture = replace(trial.capture, bodies=fitted, touch=None)
    room = reconstruct(capture, quick(PRESETS["paper"]), Run(tmp_path))

    def refitted(room: Room, *lacking: str) -> Bodies:
        config = at_most(without(PAPER_ROOM, *lacking), 10)
        return refit_bodies(room, seen, None, (config, ANGLES)).bodies

    def judged(scene: Scene, bodies: Bodies) -> dict[str, float]:
        truth = to_world(small_room.bodies, camera)
        solid = furniture_of(scene.objects, close_meshes(scene.objects))
        return evaluate_people(bodies, scene.ground, solid, truth)

    proxies = tuple(close_mesh(thing.mesh) for thing in trial.truth.objects)
    true = under_camera(replace(room, proxies=proxies, scene=trial.truth), capture, camera)
    baseline = judged(room.scene, under_camera(room, capture, first).bodies)
    assert judged(room.scene, refitted(room, "sdf", "contact"))["pje"] < 0.7 * baseline["pje"]
    assert judged(room.scene, refitted(room))["sink_depth"] < 0.5 * baseline["sink_depth"]
    assert judged(true.scene, refitted(true))["pje"] < baseline["pje"]
