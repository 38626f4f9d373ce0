"""The main job on a device that is not the CPU: a pretended one, and a GPU where there is one."""

import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from analytic import several
from pretended import OWN, Elsewhere, kernels_elsewhere, registered
from test_fused import WEIGHTS, room, with_slopes
from test_pipeline import light

from mover.app import cli
from mover.app.results import write_results
from mover.core.devices import CPU, device_of, named
from mover.core.errors import InputError
from mover.core.records import record, to_device
from mover.core.run import Run
from mover.energy.config import Adam, BatchedBFGS, SceneConfig, SceneWeights
from mover.energy.objective import scene_energy
from mover.pipeline.reconstruct import reconstruct
from mover.stages.config import PlaceConfig

pytest.importorskip("warp")
GPU = pytest.param("cuda", marks=pytest.mark.gpu)


@pytest.fixture(params=["pretended", GPU])
def device(request):
    """A device that is pretended, and a GPU."""
    if request.param == "cuda":
        if not torch.cuda.is_available():
            pytest.skip("no NVIDIA GPU here")
        yield torch.device("cuda", 0)
        return
    with kernels_elsewhere() as there:
        yield there


@pytest.mark.slow
@pytest.mark.skipif(OWN in os.environ, reason="this is the process of its own")
@pytest.mark.skipif(torch.cuda.is_available(), reason="a GPU is here: nothing is pretended")
def test_the_pretended_device_in_a_process_that_knows_it_from_the_start():
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-rs"]
    command += ["-m", "not gpu", str(Path(__file__))]
    environment = {**os.environ, OWN: "1"}
    ended = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert ended.returncode == 0, ended.stdout
    assert "in a process of its own" not in ended.stdout
    passed = re.search(r"(\d+) passed", ended.stdout)
    assert passed is not None
    assert int(passed[1]) >= 7


def test_what_a_gpu_refuses_is_refused():
    registered()
    there = torch.arange(4.0).to("elsewhere")
    assert isinstance(there, Elsewhere)
    with pytest.raises(RuntimeError, match="here and elsewhere"):
        there + torch.ones(4)
    assert isinstance(there * 2 + torch.full_like(there, 3), Elsewhere)
    assert torch.equal(there.cpu(), torch.arange(4.0))


def energy_under(inputs, weights, form):
    rest = inputs.objects, inputs.camera, inputs.image, inputs.humans
    return lambda layout: scene_energy(layout, *rest, SceneConfig(weights, form))


@pytest.mark.parametrize(("form", "weights"), [("robust", WEIGHTS), ("paper", SceneWeights())])
def test_all_terms_and_their_gradients_are_those_of_the_cpu(device, form, weights):
    inputs = room(32)
    layout = several(inputs.starts, 2)
    here = with_slopes(energy_under(inputs, weights, form), layout)
    there = with_slopes(
        energy_under(to_device(inputs, device), weights, form), to_device(layout, device)
    )
    for value, truth in zip(there, here, strict=True):
        assert value.device.type == device.type
        assert (value.cpu() - truth).norm() <= 1e-3 * truth.norm()


@record
class Point:
    """One field of unknowns."""

    x: torch.Tensor


def calm(config):
    """A few long steps magnify what is rounded otherwise: the camera takes short ones."""
    method = replace(config.refine.method, rate=0.03)
    return replace(config, refine=replace(config.refine, method=method))


@pytest.mark.slow
def test_the_main_job_ends_where_it_ends_on_the_cpu(device, small_room, tmp_path):
    from mover_bench.experiment.variants import shortened
    from mover_bench.rooms.config import NoiseConfig
    from mover_bench.rooms.noise import add_noise

    capture = shortened(add_noise(small_room, NoiseConfig(), 1), torch.arange(60))
    config = calm(light("robust", steps=4))
    here, there = (
        reconstruct(capture, config, Run(tmp_path / d.type, device=d)) for d in (CPU, device)
    )
    for known in (there, None):  # the second time from disk, and as before
        run = Run(tmp_path / device.type, device=device)
        write_results(capture, known or reconstruct(capture, config, run), config, run)
    log = json.loads((run.folder / "run.json").read_text())
    assert log["device"] == named(device)
    assert all(stage["kept"] for stage in log["stages"])
    assert all(piece.t_world_object.device == CPU for piece in there.scene.objects)
    places = (torch.stack([p.t_world_object for p in x.scene.objects]) for x in (here, there))
    off = (next(places) - next(places)).abs()
    assert off[:, 1].max() <= 0.005
    assert off.norm(dim=-1).median() <= 0.02


class TestChoice:
    def test_auto_is_the_processor_where_there_is_no_gpu(self, monkeypatch):
        monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
        assert device_of("auto") == device_of("cpu") == CPU
        with pytest.raises(InputError, match=r"--device cuda: torch .*, expected a GPU"):
            device_of("cuda")

    def test_a_run_on_a_gpu_that_is_not_there_ends_before_anything_is_read(
        self, monkeypatch, tmp_path, capsys
    ):
        monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
        code = cli.run_command("run", [str(tmp_path / "none"), "--device", "cuda"])
        assert code == 2
        assert "mover run: --device cuda: torch" in capsys.readouterr().err

    @pytest.mark.parametrize(("config", "kept"), [(Adam(), False), (BatchedBFGS(), True)])
    def test_what_a_device_computed_is_not_taken_for_the_processors(self, tmp_path, config, kept):
        """Descents whose steps cannot be replayed are the processor's everywhere."""
        names = []
        for device in (CPU, torch.device("meta")):
            run = Run(tmp_path, device=device)
            run.stage(place_objects_like, Point(torch.zeros(2)), PlaceConfig(method=config))
            names.append(run.stages[0])
        assert [stage.kept for stage in names] == [False, kept]
        assert (names[0].fingerprint == names[1].fingerprint) == kept


def place_objects_like(inputs: Point, _config: PlaceConfig, _observe) -> Point:
    """A stage that is computed on the device."""
    return inputs if inputs.x.device.type == "cpu" else Point(torch.zeros(2))


place_objects_like.__name__ = "place_objects"
