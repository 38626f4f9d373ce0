"""The main job as a whole, on small captures: resume, determinism, and no look at the truth."""

import functools
import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import raycast
import torch

from mover.app.results import read_config, write_results, write_truth
from mover.core import records
from mover.core.observe import Step, silent
from mover.core.run import Run
from mover.geometry.boxes import iou2d
from mover.geometry.camera import pitch_roll, project, to_camera
from mover.geometry.placement import place_object
from mover.geometry.rle import decode
from mover.io.capture.folder import write_capture
from mover.io.capture.scene_file import read_scene
from mover.io.formats import read
from mover.pipeline.presets import PRESETS
from mover.pipeline.reconstruct import reconstruct
from mover.stages.objects.place_inputs import Placed

SHARED = Path(__file__).parents[2] / "shared" / "data"
PHOTO, TOTAL3D = SHARED / "photo_bench", SHARED / "total3d_1"


def light(name, steps=15):
    """A preset with few steps and coarse volumes."""
    config = PRESETS[name]
    return replace(
        config,
        prepare=replace(config.prepare, cells=32, faces=300, samples=200, region=60),
        image=replace(config.image, size=48),
        layout=replace(
            config.layout, method=replace(config.layout.method, steps=steps),
            short=replace(config.layout.short, steps=min(5, config.layout.short.steps)),
        ),
        refine=replace(
            config.refine, method=replace(config.refine.method, steps=5),
            rounds=min(2, config.refine.rounds),
        ),
        gather=replace(config.gather, cells=48),
        place=replace(config.place, method=replace(config.place.method, steps=steps)),
    )  # fmt: skip


@pytest.fixture(scope="module")
def capture_folder(tmp_path_factory, small_room, small_capture):
    folder = tmp_path_factory.mktemp("capture")
    write_capture(small_capture, folder)
    write_truth(small_room.truth, small_room.bodies, folder / "truth")
    return folder


def run_in(folder, capture, config, observe=silent):
    run = Run(folder, observe)
    room = reconstruct(capture, config, run)
    write_results(capture, room, config, run)
    return room


@pytest.fixture(scope="module")
def whole(capture_folder, tmp_path_factory):
    """Makes the whole run of a preset, once: its folder and its room."""

    @functools.cache
    def made(name):
        folder = tmp_path_factory.mktemp(name)
        return folder, run_in(folder, read("folder", capture_folder), light(name))

    return made


class Killed(Exception):
    pass


@pytest.mark.slow
class TestRun:
    def test_a_run_that_was_killed_goes_on_and_gives_the_same_result(
        self, capture_folder, whole, tmp_path
    ):
        capture, config = read("folder", capture_folder), light("robust")
        seen = []

        def die(step: Step):
            seen.append(step.stage)
            if step.stage == "gather_cues: free space":
                raise Killed

        with pytest.raises(Killed):
            run_in(tmp_path / "cut", capture, config, die)
        finished = {p.parent.name for p in (tmp_path / "cut" / "stages").rglob("*.json")}
        assert "align_camera" in finished
        second = []
        run_in(tmp_path / "cut", capture, config, lambda step: second.append(step.stage))
        assert "prepare_objects" not in second
        for name in ("scene.json", "bodies.npz"):
            a, b = (folder / name for folder in (whole("robust")[0], tmp_path / "cut"))
            assert a.read_bytes() == b.read_bytes()

    def test_the_result_is_the_same_without_the_truth(self, capture_folder, whole, tmp_path):
        blind = tmp_path / "capture"
        shutil.copytree(capture_folder, blind)
        shutil.rmtree(blind / "truth")
        run_in(tmp_path, read("folder", blind), light("paper"))
        known = whole("paper")[0] / "scene.json"
        assert known.read_bytes() == (tmp_path / "scene.json").read_bytes()

    @pytest.mark.parametrize("name", sorted(PRESETS))
    def test_every_preset_writes_a_whole_result(self, capture_folder, whole, name):
        capture, config = read("folder", capture_folder), light(name)
        folder, room = whole(name)
        named = ("scene.json", "scene.glb", "bodies.npz", "run.json", "report.html", "initial.json")
        for file in named:
            assert (folder / file).stat().st_size > 100, file
        scene = read_scene(folder / "scene.json")
        assert [p.id for p in scene.objects] == [p.id for p in capture.scene.objects]
        assert len(list((folder / "watertight").iterdir())) == len(scene.objects)
        assert len(room.bodies.frame) == len(capture.bodies.frame)
        log = json.loads((folder / "run.json").read_text())
        assert {"place_objects", "align_camera"} <= {s["name"] for s in log["stages"]}
        assert read_config(folder / "run.json") == config

    def test_objects_of_the_result_stand_on_the_ground(self, whole):
        _, room = whole("robust")
        for piece in room.scene.objects:
            lowest = float(place_object(piece).verts[:, 1].min())
            assert abs(lowest - room.scene.ground) < 1e-4, piece.id

    def test_without_people_only_the_image_speaks_and_the_run_says_so(
        self, capture_folder, tmp_path
    ):
        alone = tmp_path / "capture"
        shutil.copytree(capture_folder, alone)
        (alone / "bodies.npz").unlink()
        (alone / "people.json").unlink()
        room = run_in(tmp_path / "out", read("folder", alone), light("robust"))
        assert room.bodies is None
        assert any("bodies" in w for w in room.warnings)

    @pytest.mark.parametrize("alone", [False, True])
    def test_evidence_lists_the_energy_that_was_minimised_by_term(
        self, capture_folder, tmp_path, alone
    ):
        capture, run = read("folder", capture_folder), Run(tmp_path)
        if alone:
            capture = replace(capture, bodies=None, people=None, touch=None)
        room = reconstruct(capture, light("robust", steps=4), run)
        stage = [s for s in run.stages if s.name == "place_objects"][-1]
        placed = records.load(Placed, tmp_path / "stages" / "place_objects" / stage.fingerprint)
        energy = torch.tensor([e.energy for e in room.evidence])
        assert ((placed.energy - energy).abs().amin(0) <= 1e-3 * energy).all()  # a candidate's
        along = placed.walls.trust.amax(-1) > 0
        assert along.any()
        for evidence, lined in zip(room.evidence, along.tolist(), strict=True):
            assert evidence.energy == pytest.approx(sum(evidence.terms.values()))
            assert ("depth" in evidence.terms) == (not alone)
            assert (evidence.terms["wall"] > 0) == lined
            assert (evidence.nearest_body is None) == alone

    def test_a_room_without_objects_still_has_a_floor_and_people(self, capture_folder, tmp_path):
        capture = read("folder", capture_folder)
        empty = replace(capture, scene=replace(capture.scene, objects=()))
        room = run_in(tmp_path, empty, light("robust"))
        assert room.scene.objects == ()
        assert room.scene.ground < -1
        assert (tmp_path / "report.html").stat().st_size > 100

    def test_two_people_are_two_tracks(self, capture_folder, tmp_path):
        capture = read("folder", capture_folder)
        bodies, people = capture.bodies, capture.people
        half, seen = (x.frame > int(bodies.frame.median()) for x in (bodies, people))
        bodies = replace(bodies, person=half.long(), pose=None)
        both = replace(capture, bodies=bodies, people=replace(people, person=seen.long()))
        room = run_in(tmp_path, both, light("robust"))
        assert set(room.bodies.person.tolist()) == {0, 1}


@pytest.mark.slow
@pytest.mark.skipif(not PHOTO.exists(), reason="the photograph is not here")
def test_the_bench_of_a_real_photograph_stands_where_the_soles_stand(tmp_path):
    capture = read("folder", PHOTO)
    room = run_in(tmp_path, capture, PRESETS["robust"])
    ground, camera = room.scene.ground, room.scene.camera
    assert abs(float(room.bodies.verts[..., 1].min()) - ground) < 0.02
    bench = place_object(room.scene.objects[0])
    assert abs(float(bench.verts[:, 1].min()) - ground) < 1e-3
    assert abs(float(pitch_roll(camera.R_cam_world)[0])) < np.radians(5)
    front = raycast.cast(
        to_camera(bench.verts, camera.R_cam_world).numpy(), bench.faces.numpy(),
        camera.K.numpy(), camera.height, camera.width,
    )[0]  # fmt: skip
    drawn = np.isfinite(front)
    mask = decode(capture.detections[0].mask, 0).numpy()
    # the bench of the library is of another design: it has legs where the photographed one has none
    assert (drawn & mask).sum() / (drawn | mask).sum() >= 0.48


@pytest.mark.slow
@pytest.mark.skipif(not TOTAL3D.exists(), reason="Total3D's outputs are not here")
def test_the_outputs_of_a_network_run_through_the_image_only_stage(tmp_path):
    capture = read("total3d", TOTAL3D)
    config = replace(
        PRESETS["robust"], layout=replace(PRESETS["robust"].layout, yaws=1, num_hypotheses=1)
    )
    room = run_in(tmp_path, capture, config)

    def fit(scene):
        boxes = {d.id: d.box for d in capture.detections}
        values = []
        for piece in scene.objects:
            verts = to_camera(place_object(piece).verts, scene.camera.R_cam_world)
            pixels = project(verts, scene.camera.K)
            drawn = torch.cat([pixels.amin(0), pixels.amax(0)])
            values.append(float(iou2d(drawn, boxes[piece.annotation])))
        return sum(values) / len(values)

    assert fit(room.scene) > max(0.85, fit(room.initial))
