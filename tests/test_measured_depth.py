"""Measured depth: files, its scale against the room, and what it does in a run."""

import os
from dataclasses import replace

import numpy as np
import pytest
import tiny_capture as tiny
import torch
from analytic import GROUND, make_inputs
from PIL import Image

from mover.app.cli.video import take_depth
from mover.core.errors import InputError
from mover.core.types import DepthImage, Layout
from mover.energy.config import only
from mover.energy.image_terms import Measured
from mover.geometry.camera import to_world
from mover.geometry.placement import place_in
from mover.geometry.raster import Crops, Topology, look
from mover.io.capture.folder import folder_parts, read_capture, write_capture
from mover.io.capture.merge import import_into
from mover.io.files.images import find_depth_file, read_depth, reference_frame
from mover.stages.config import PlaceConfig
from mover.stages.objects.gather_depth import DepthImageInputs, gather_depth
from mover.stages.objects.place_inputs import coarser_image
from mover.stages.objects.place_objects import energy_of


def true_inputs() -> DepthImageInputs:
    """The boxes of the analytic room on its floor, and a network that sees them truly."""
    known = make_inputs(size=64)
    camera, objects = known.camera, known.objects
    layout = Layout(*(getattr(known.starts, n)[0] for n in ("t_world_object", "yaw", "log_scale")))
    y, x = torch.meshgrid(*(torch.arange(n) + 0.5 for n in (360, 640)), indexing="ij")
    rays = torch.stack([x, y, torch.ones_like(x)], -1) @ torch.linalg.inv(camera.K).mT
    down = to_world(rays, camera.R_cam_world)[..., 1]
    depth = torch.where(down < -0.01, GROUND / down.clamp_max(-0.01), torch.inf)
    verts = place_in(objects.verts, layout, camera.R_cam_world)
    whole = Crops(camera.K[None].expand(len(verts), 3, 3), 360, 640)
    seen = look(verts, Topology(objects.faces, objects.edges), whole, depth=True)[1]
    drawn = torch.where(seen.covered, seen.nearest, torch.inf)
    depth = torch.minimum(depth, drawn.amin(0))
    depth = torch.where(depth < 50, depth, torch.nan)
    image = DepthImage(depth, True)
    hidden = seen.covered.any(0)
    return DepthImageInputs(image, known.image, objects, camera, GROUND, layout, hidden)


def errors(found: Measured | None, inputs: DepthImageInputs) -> torch.Tensor:
    """Logarithm of found over true depth within the masks."""
    true = inputs.image.measured
    inside = (inputs.image.masks > 0.99) & (true.depth > 0) & (found.depth > 0)
    return (found.depth / true.depth)[inside].log()


def with_values(inputs: DepthImageInputs, values: torch.Tensor, metric: bool) -> DepthImageInputs:
    return replace(inputs, depth=DepthImage(values, metric))


@pytest.fixture(scope="module")
def inputs():
    return true_inputs()


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    return read_capture(tiny.write_capture(tmp_path_factory.mktemp("tiny") / "tiny"))


@pytest.mark.parametrize("factor", [1.0, 1.15, 0.85])
def test_the_factor_of_a_metric_network_is_found(inputs, factor):
    scaled = with_values(inputs, factor * inputs.depth.values, True)
    assert float(errors(gather_depth(scaled), inputs).abs().median()) < 0.02


def test_factor_and_shift_of_an_inverse_depth_are_found(inputs):
    values = 300 / inputs.depth.values + 40
    found = gather_depth(with_values(inputs, values, False))
    assert float(errors(found, inputs).abs().median()) < 0.01


@pytest.mark.parametrize("metric", [True, False])
def test_an_object_that_stands_wrong_does_not_pull_the_others(inputs, metric):
    far = inputs.layout.t_world_object.clone()
    far[1] *= 1.4
    values = inputs.depth.values if metric else 7 / inputs.depth.values + 1
    layout = replace(inputs.layout, t_world_object=far)
    moved = replace(with_values(inputs, values, metric), layout=layout)
    assert float(errors(gather_depth(moved), inputs).abs().median()) < 0.03


def test_nothing_is_said_where_nothing_gives_the_scale(inputs):
    empty = torch.full_like(inputs.depth.values, torch.nan)
    assert gather_depth(with_values(inputs, empty, True)) is None
    assert gather_depth(with_values(inputs, torch.full_like(empty, 5.0), False)) is None


def test_a_wrong_distance_costs_the_same_in_windows_of_fewer_pixels():
    known = make_inputs(size=96)
    config = PlaceConfig(only(measured=1.0), "robust")
    far = replace(known.starts, t_world_object=1.1 * known.starts.t_world_object)
    images = [coarser_image(known.image, factor) for factor in (1, 2)]
    costs = [energy_of(replace(known, image=image), config)(far).per_item for image in images]
    assert (costs[0] > 1).all()
    assert torch.allclose(costs[0], costs[1], rtol=0.1)


def test_a_capture_keeps_its_depth_an_import_takes_it_along_and_the_newer_one_counts(
    tmp_path, capture
):
    generator = torch.Generator().manual_seed(1)
    values = torch.rand(tiny.HEIGHT, tiny.WIDTH, generator=generator) + 1
    values[:5] = torch.nan
    for name, metric in (("depth", True), ("disparity", False)):
        write_capture(replace(capture, depth=DepthImage(values, metric)), tmp_path / name)
        made = import_into(tmp_path / "own", folder_parts(tmp_path / name))
        assert f"{name}/" in made.written
        for folder in (name, "own"):
            found = read_capture(tmp_path / folder).depth
            assert found.metric == metric
            assert torch.equal(found.values.nan_to_num(0), values.nan_to_num(0))
    with pytest.raises(ValueError, match="has depth, which the capture lacks"):
        write_capture(capture, tmp_path / "depth")
    write_capture(capture, tmp_path / "none")
    made = import_into(tmp_path / "own", folder_parts(tmp_path / "none"))
    assert read_capture(tmp_path / "own").depth is not None
    assert "disparity/" not in made.written


def test_inverse_depth_may_be_an_array_or_a_grey_picture(tmp_path, capture):
    camera = capture.scene.camera
    folder = tmp_path / "disparity"
    folder.mkdir()
    values = np.random.default_rng(0).integers(1, 255, (camera.height, camera.width))
    Image.fromarray(values.astype(np.uint8)).save(folder / "000000.png")
    np.savez(folder / "000001.npz", disparity=values.astype(np.float32))
    for name in ("000000.png", "000001.npz"):
        found = read_depth(folder / name, camera, metric=False)
        assert torch.equal(found, torch.from_numpy(values).float())
    assert find_depth_file(tmp_path) == (folder / "000000.png", False)


WHOLE_VIDEOS = {  # of MegaSaM, which halves the sides, and of VGGT, whose sides are 14 n pixels
    "depths": ("float16", lambda w, h: (h // 2, w // 2), ()),
    "depth": ("float32", lambda w, h: (h // 14 * 14, w // 14 * 14), (1,)),
}  # fmt: skip


@pytest.mark.parametrize("key", WHOLE_VIDEOS)
def test_depths_of_a_whole_video_give_the_frame_of_the_reference_picture(
    key, tmp_path, capture, caplog
):
    camera = capture.scene.camera
    dtype, shape, tail = WHOLE_VIDEOS[key]
    size = shape(camera.width, camera.height)
    values = np.arange(1, 5)[:, None, None] * np.ones((4, *size))
    write_capture(capture, tmp_path / "room")
    (tmp_path / "room" / "depth").mkdir()
    file = tmp_path / "room" / "depth" / "000000.npz"
    np.savez(file, **{key: values.reshape(4, *size, *tail).astype(dtype)})
    assert bool((read_capture(tmp_path / "room").depth.values == 1).all())
    assert "depth maps of 4 frames: that of frame 0 is used" in caplog.text
    poses = {"frame": np.arange(4), "T_world_camera": np.tile(np.eye(4), (4, 1, 1))}
    np.savez(tmp_path / "room" / "cameras.npz", **poses, reference=np.array(2))
    assert bool((read_depth(file, camera, frame=reference_frame(tmp_path / "room")) == 3).all())
    with pytest.raises(InputError, match="has 4 frames, expected a depth map of frame 7"):
        read_depth(file, camera, frame=7)
    for number in (1, 2, 3):
        np.save(tmp_path / "room" / "depth" / f"{number:06d}.npy", values[number])
    assert find_depth_file(tmp_path / "room") == (file.with_name("000002.npy"), True)


@pytest.mark.parametrize("kind", ["npy", "png", "npz"])
@pytest.mark.parametrize("folder", ["depth", "disparity"])
def test_a_pipe_as_depth_is_refused_at_once(kind, folder, tmp_path, capture):
    (tmp_path / folder).mkdir()
    os.mkfifo(tmp_path / folder / f"000000.{kind}")
    file, metric = find_depth_file(tmp_path)
    with pytest.raises(InputError, match=rf"000000\.{kind}: .*is no file \(a pipe\)"):
        read_depth(file, capture.scene.camera, metric=metric)


def test_what_is_wrong_with_measured_depth_is_one_sentence(tmp_path, capture):
    camera = capture.scene.camera
    assert find_depth_file(tmp_path) is None
    for folder, words in (
        ("depth", r"depth/: has no depth map, expected 000000\.npy or"),
        ("disparity", r"has depth/ and disparity/, expected one of the two"),
    ):
        (tmp_path / folder).mkdir()
        with pytest.raises(InputError, match=words):
            find_depth_file(tmp_path)
    with pytest.raises(InputError, match=r"depth: is no file \(a folder\), .*: name the file"):
        take_depth(tmp_path / "depth", tmp_path)
    values = np.linspace(0.1, 1.0, camera.height)[:, None].repeat(camera.width, 1)
    np.savez(tmp_path / "a.npz", disp=values)
    with pytest.raises(InputError, match=r"a\.npz .*'disp' is inverse depth: into disparity/"):
        read_depth(tmp_path / "a.npz", camera)
    assert np.allclose(read_depth(tmp_path / "a.npz", camera, metric=False), values)
    Image.new("RGB", (camera.width, camera.height)).save(tmp_path / "a.png")
    np.save(tmp_path / "a.npy", np.ones((5, 5)))
    for name, words in (
        ("a.png", r"a\.png: has RGB pixels, expected one grey value"),
        ("a.npy", r"a\.npy: has 5 x 5 values"),
    ):
        with pytest.raises(InputError, match=words):
            read_depth(tmp_path / name, camera, metric=False)
