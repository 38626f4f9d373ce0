"""The main job on a device that is not the CPU: a pretended one, and a GPU where there is one."""

import json
from dataclasses import replace

import pytest
import raster_torch
import torch
from analytic import several
from nearest_torch import nearest_torch
from pretended import Elsewhere, kernels_elsewhere, registered
from test_fused import WEIGHTS, room, with_slopes
from test_pipeline import light
from test_raster_warp import pulled, scene
from test_volume import sphere

from mover.app import cli
from mover.app.results import write_results
from mover.core.devices import CPU, device_of, named
from mover.core.errors import InputError
from mover.core.records import record, to_device
from mover.core.run import Run
from mover.energy.config import Adam, SceneConfig, SceneWeights
from mover.energy.objective import scene_energy
from mover.geometry import raster as raster_warp
from mover.geometry.nearest_warp import clouds, nearest
from mover.geometry.raster import Crops, layers
from mover.geometry.volume import grid_around, sample, sample_torch
from mover.geometry.volume_warp import union_bodies
from mover.pipeline.presets import ROBUST
from mover.pipeline.reconstruct import reconstruct
from mover.stages.config import PlaceConfig
from mover.stages.objects.place_objects import place_objects

pytest.importorskip("warp")
GPU = pytest.param("cuda", marks=pytest.mark.gpu)
ADAM = Adam(4, 0.03, 0.01, beta2=0.98, keep_best=True)


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


class TestPretended:
    def test_what_a_gpu_refuses_is_refused(self):
        registered()
        there = torch.arange(4.0).to("elsewhere")
        assert isinstance(there, Elsewhere)
        with pytest.raises(RuntimeError, match="here and elsewhere"):
            there + torch.ones(4)
        assert isinstance(there * 2 + torch.full_like(there, 3), Elsewhere)
        assert torch.equal(there.cpu(), torch.arange(4.0))


class TestGeometry:
    def test_what_is_drawn_and_its_gradient_are_those_of_torch(self, device):
        verts_cam, shape, views = scene(size=96, starts=2)
        there = (to_device(x, device) for x in (verts_cam, shape, views))
        found = pulled(raster_warp, *there)
        exact = pulled(raster_torch, verts_cam.double(), shape, views)
        assert torch.equal(found[3].cpu(), exact[3])
        for values, truth in zip(found[:3], exact[:3], strict=True):
            torch.testing.assert_close(values.cpu().double(), truth, atol=1e-5, rtol=0)
        assert (found[4].cpu() - exact[4]).norm() <= 1e-3 * exact[4].norm()

    def test_first_hits_and_layers_are_those_of_torch(self, device):
        verts_cam, shape, views = scene(["sphere"], 50)
        inputs = verts_cam[0], shape.faces[0], views.K[0]
        there = [x.to(device) for x in inputs]
        found, truth = (
            r.first_hit(*x, (50, 40)) for r, x in ((raster_warp, there), (raster_torch, inputs))
        )
        for values, expected in zip(found, truth, strict=True):
            assert torch.equal(values.cpu(), expected)
        seen = layers(there[0][None], there[1], Crops(there[2][None], 50, 40))
        exact = raster_torch.layers(inputs[0][None], inputs[1], Crops(inputs[2][None], 50, 40))
        for values, expected in ((seen.front, exact.front), (seen.exit, exact.exit)):
            torch.testing.assert_close(values.cpu(), expected, atol=1e-5, rtol=0)

    def test_nearest_points_volumes_and_lookups_are_those_of_the_cpu(self, device):
        g = torch.Generator().manual_seed(0)
        points, query = (torch.rand(2, n, 3, generator=g) for n in (90, 30))
        held, sizes = clouds(points), torch.rand(2, 3, generator=g) + 0.5
        index = nearest(to_device(held, device), query.to(device), sizes.to(device))
        assert torch.equal(index.cpu(), nearest_torch(held, query, sizes))
        ball, faces = sphere([0.0, 0, 0], 0.5, 3)
        verts = ball + torch.rand(9, 1, 3, generator=g)
        grid = grid_around(verts.amin((0, 1)), verts.amax((0, 1)), 40, padding=0.1)
        truth = union_bodies(verts, faces, grid)
        found = union_bodies(verts.to(device), faces.to(device), to_device(grid, device))
        torch.testing.assert_close(found.values.cpu(), truth.values, rtol=0, atol=2e-6)
        places = torch.rand(50, 3, generator=g) - 0.5
        value = sample(found, places.to(device)).cpu()
        torch.testing.assert_close(value, sample_torch(truth, places), rtol=1e-5, atol=1e-5)


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


def test_a_whole_placing_ends_where_it_ends_on_the_cpu(device):
    inputs = replace(room(32), starts=several(room(32).starts, 1))
    config = PlaceConfig(
        WEIGHTS,
        "robust",
        ADAM,
        yaws=2,
        short=Adam(3, 0.03),
        num_hypotheses=1,
        yaw_prior_weight=1.0,
        apart=0.3,
    )
    here = place_objects(inputs, config)
    found = to_device(place_objects(to_device(inputs, device), config), "cpu")
    torch.testing.assert_close(found.energy, here.energy, rtol=0.05, atol=1e-3)
    for name in ("t_world_object", "yaw", "log_scale"):
        expected = getattr(here.layout, name)
        torch.testing.assert_close(getattr(found.layout, name), expected, rtol=0, atol=0.02)


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

    def test_what_a_device_computed_is_not_taken_for_the_processors(self, tmp_path):
        names = []
        for device in (CPU, torch.device("meta")):
            run = Run(tmp_path, device=device)
            run.stage(place_objects_like, Point(torch.zeros(2)), Adam())
            names.append(run.stages[0])
        assert not any(stage.kept for stage in names)
        assert names[0].fingerprint != names[1].fingerprint

    def test_only_descents_whose_steps_can_be_replayed_are_a_devices(self, tmp_path):
        second, first = ROBUST.place, replace(ROBUST.place, method=Adam(3))
        run = Run(tmp_path, device=torch.device("meta"))
        where = [
            run._named(place_objects_like, Point(torch.zeros(2)), c)[1] for c in (second, first)
        ]
        assert where == [CPU, run.device]


def place_objects_like(inputs: Point, _config: Adam, _observe) -> Point:
    """A stage that is computed on the device."""
    return inputs if inputs.x.device.type == "cpu" else Point(torch.zeros(2))


place_objects_like.__name__ = "place_objects"
