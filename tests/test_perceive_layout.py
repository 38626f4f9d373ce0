"""The first scene: heights, shapes, depth maps, files, and the whole way from a video."""

import json
import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from mover.app.cli import run_command
from mover.core.errors import InputError
from mover.core.records import rows_of
from mover.core.run import Run
from mover.core.types import Camera, Detection, Masks, Scene, SceneObject
from mover.energy.image_terms import SEEN
from mover.furniture.library import choose_piece, make_piece
from mover.geometry.boxes import box_of, iou3d
from mover.geometry.camera import pitch_roll, tilted, to_camera, to_world
from mover.geometry.placement import place_object
from mover.geometry.raster import Crops, Topology, look
from mover.geometry.rle import encode, tight_box
from mover.geometry.topology import edges_of
from mover.io.capture.annotations_file import detections_to_json
from mover.io.capture.camera_file import camera_to_json
from mover.io.files.fields import write_json
from mover.io.files.images import read_depth
from mover.io.files.meshes import write_mesh
from mover.io.formats import read
from mover.perceive.capture import read_picture_of, write_first_scene
from mover.perceive.config import LayoutConfig, ScreenConfig
from mover.perceive.layout import (
    SOUGHT,
    FirstScene,
    Picture,
    at_scale,
    first_scene,
    floor_height,
    is_placed,
    median_depths,
    shapes_of,
)
from mover.perceive.screen import ScreenInputs, outermost, screen
from mover.perceive.standing import seen_from, standing_on
from mover.stages.objects.gather_given import unplaced
from mover.stages.posterior import Gaussian

W, H, FOCAL = 480, 320, 420.0
HEIGHT = 1.35


def camera(pitch: float = -0.25, roll: float = 0.03) -> Camera:
    K = torch.tensor([[FOCAL, 0, W / 2], [0, FOCAL, H / 2], [0, 0, 1]])
    return Camera(K, tilted(torch.tensor(pitch), torch.tensor(roll)), W, H)


def furniture(names: dict[str, tuple[float, float, float]], seed: int = 50) -> list[SceneObject]:
    rng = np.random.default_rng(seed)
    pieces = []
    for k, (name, (x, z, yaw)) in enumerate(names.items()):
        mesh = make_piece(name, rng).mesh
        t = torch.tensor([x, -HEIGHT, z])
        pieces.append(
            SceneObject(f"p{k}", name, mesh, "", k, "ground", t, torch.tensor(yaw), torch.ones(3))
        )
    return pieces


def drawn(piece: SceneObject, view: Camera) -> tuple[torch.Tensor, torch.Tensor]:
    """Mask and depth of one piece."""
    mesh = place_object(piece)
    verts = to_camera(mesh.verts, view.R_cam_world)[None]
    faces = mesh.faces[None]
    views = Crops(view.K[None], H, W)
    cover, depths = look(verts, Topology(faces, edges_of(mesh.faces)[None]), views, depth=True)
    depth = torch.where(depths.covered[0], depths.nearest[0], torch.inf)
    return cover[0] > 0.5, depth


def picture(pieces: list[SceneObject], view: Camera, depth: bool = False) -> Picture:
    """What a perfect detector gives; the floor fills the rest of the depth map."""
    seen = [drawn(piece, view) for piece in pieces]
    nearest = torch.stack([d for _, d in seen]).amin(0)
    masks = torch.stack([m & (d <= nearest) for m, d in seen])
    found = tuple(
        Detection(k, p.category, tight_box(m), Masks(H, W, (encode(m),)), 1.0)
        for k, (p, m) in enumerate(zip(pieces, masks, strict=True))
    )
    return Picture(
        view, found, masks, torch.zeros(H, W, dtype=torch.bool), None,
        torch.minimum(nearest, floor_depth(view)) if depth else None,
    )  # fmt: skip


def floor_depth(view: Camera) -> torch.Tensor:
    """Depth of the floor, written out; NaN above the horizon."""
    y, x = torch.meshgrid(torch.arange(H) + 0.5, torch.arange(W) + 0.5, indexing="ij")
    rays = torch.stack([(x - W / 2) / FOCAL, (y - H / 2) / FOCAL, torch.ones(H, W)], -1)
    down = to_world(rays, view.R_cam_world)[..., 1]
    return torch.where(down < -0.05, -HEIGHT / down, torch.nan)


ROOM = {"sofa": (-1.2, -4.2, 0.5), "chair": (0.7, -3.0, -0.6), "table": (0.2, -4.6, 0.1),
        "cabinet": (1.9, -4.9, -0.4)}  # fmt: skip
QUICK = LayoutConfig(shapes=4, keep=2, turns=4)


@pytest.fixture(scope="module")
def pieces() -> list[SceneObject]:
    return furniture(ROOM)


@pytest.mark.slow
def test_furniture_along_walls_faces_the_room(tmp_path: Path):
    """A block has the same outline from behind, and nobody puts a cabinet back to front."""
    block = choose_piece("box", (0.9, 0.9, 0.45))
    (tmp_path / "own").mkdir()
    write_mesh(block, tmp_path / "own" / "cabinet_0.glb")
    places = {"cabinet": (-1.2, -4.0, 0.4), "wardrobe": (1.0, -4.5, 2.5)}
    shown = [replace(p, category="cabinet", mesh=block) for p in furniture(places)]
    found = first_scene(picture(shown, camera()), QUICK, Run(tmp_path / "run"), tmp_path / "own")
    for piece, true in zip(found.scene.objects, shown, strict=True):
        front = torch.stack([piece.yaw.sin(), piece.yaw.cos()])
        assert front @ -piece.t_world_object[[0, 2]] > 0
        assert abs((2 * (piece.yaw - true.yaw)).sin()) < 0.2


def test_outermost_points_have_the_box_of_the_shape(pieces: list[SceneObject]):
    verts = pieces[0].mesh.verts
    points = outermost(verts)
    size = verts.amax(0) - verts.amin(0)
    assert ((points.amax(0) - points.amin(0)) > 0.97 * size).all()


def screen_inputs(pieces: list[SceneObject], height: float | None) -> ScreenInputs:
    """One shape of each class, in the boxes of a perfect picture."""
    verts = [shapes_of(piece.category, 1)[0].mesh.verts for piece in pieces]
    low = [v - torch.tensor([0, float(v[:, 1].min()), 0]) for v in verts]
    return ScreenInputs(
        camera(), torch.stack([d.box for d in picture(pieces, camera()).detections]),
        torch.full((4, 4), SEEN), torch.full((4,), torch.nan), torch.arange(4),
        torch.stack([outermost(v) for v in low]), height, unplaced(4),
    )  # fmt: skip


@pytest.mark.slow
def test_usual_sizes_constrain_the_height_of_the_camera(pieces: list[SceneObject]):
    inputs = screen_inputs(pieces, None)
    found = screen(inputs, ScreenConfig(heights=(0.9, 1.2, 1.5, 1.9)))
    assert found.height == pytest.approx(HEIGHT, rel=0.15)
    # a picture of a doll's house looks the same: doubled shapes double the height
    twice = screen(
        replace(inputs, points=2 * inputs.points),
        ScreenConfig(heights=(1.8, 2.4, 3.0, 3.8), usual=3.0),
    )
    assert twice.height / found.height == pytest.approx(2, rel=0.05)
    known = screen(replace(inputs, height=1.2), ScreenConfig(tilt=0.0))
    pitch, roll = (float(a) for a in pitch_roll(camera().R_cam_world))
    mean = torch.tensor([pitch, roll, math.log(1.2)])
    for spread, most in ((0.05, 1.1), (0.01, 0.5)):
        precision = torch.tensor([1e6, 1e6, spread**-2]).diag()
        sure = screen(replace(inputs, prior=Gaussian(mean, precision)), ScreenConfig())
        assert abs(sure.height - 1.2) < most * abs(known.height - 1.2)
    assert torch.equal(known.R_cam_world, camera().R_cam_world)


@pytest.mark.slow
def test_a_thing_of_which_many_shapes_are_known_says_no_more_than_another(pieces):
    once = screen_inputs(pieces, 1.2)
    odd = torch.tensor([1.3, 1, 1, 1])[:, None, None]  # one is not of the usual size
    once = replace(once, points=once.points * odd)
    rows = torch.tensor([0] * 8 + [1, 2, 3])
    often = replace(once, thing=rows, points=once.points[rows], given=unplaced(len(rows)))
    config = ScreenConfig(tilt=0.0, tilt_known=0.0)
    assert screen(often, config).height == pytest.approx(screen(once, config).height, abs=5e-4)


@pytest.mark.slow
def test_a_perfect_picture_gives_furniture_near_the_true_one(pieces, tmp_path):
    run = Run(tmp_path)
    first = first_scene(picture(pieces, camera()), QUICK, run)
    assert [p.category for p in first.scene.objects] == list(ROOM)
    assert [p.annotation for p in first.scene.objects] == [0, 1, 2, 3]
    overlaps = [
        float(iou3d(box_of(a), box_of(b))) for a, b in zip(first.scene.objects, pieces, strict=True)
    ]
    assert sum(overlaps) / 4 > 0.3
    for group in first.others:
        assert 1 < len(group) <= QUICK.keep
        assert [h.energy for h in group] == sorted(h.energy for h in group)
    first_scene(picture(pieces, camera()), QUICK, run)
    assert all(stage.kept for stage in run.stages[len(run.stages) // 2 :])


def test_a_depth_map_tells_the_floor_and_how_far_things_are(pieces: list[SceneObject]):
    view = camera()
    seen = picture(pieces, view, depth=True)
    things = seen.masks.any(0)
    assert floor_height(seen.depth, view, things) == pytest.approx(HEIGHT, abs=0.03)
    assert floor_height(torch.full((H, W), torch.nan), view, things) is None
    medians = median_depths(seen.depth, seen.masks)
    for k, piece in enumerate(pieces):
        assert float(medians[k]) == pytest.approx(float(box_of(piece).center.norm()), rel=0.15)


@pytest.mark.parametrize("factor", [0.85, 1.0, 1.2])
def test_a_known_height_tells_the_scale_of_a_depth_map(pieces: list[SceneObject], factor: float):
    seen = picture(pieces, camera(), depth=True)
    off = replace(seen, depth=factor * seen.depth, height=HEIGHT)
    found = at_scale(off).depth
    known = seen.depth.isfinite()
    assert torch.allclose(found[known], seen.depth[known], rtol=0.03)
    assert at_scale(replace(off, height=None)).depth is off.depth
    assert at_scale(replace(off, height=5 * HEIGHT)).depth is off.depth


@pytest.mark.slow
def test_measured_depth_makes_it_better(tmp_path: Path):
    """In the mean of five rooms: in a single one a picture alone may be lucky."""
    config, view = replace(QUICK, screen=ScreenConfig(tilt=0.0)), camera()

    def miss(seen: Picture, pieces: list[SceneObject]) -> float:
        found = first_scene(seen, config, Run(tmp_path)).scene.objects
        pairs = zip(found, pieces, strict=True)
        return sum(float((box_of(a).center - box_of(b).center).norm()) for a, b in pairs) / 4

    plain, deep = 0.0, 0.0
    for seed in range(50, 55):
        pieces = furniture(ROOM, seed)
        seen = picture(pieces, view, depth=True)
        plain += miss(replace(seen, depth=None), pieces) / 5
        deep += miss(seen, pieces) / 5
    assert deep < min(0.3, plain)


def test_feet_tell_the_tilt_and_the_height_of_the_camera(pieces, small_room, tmp_path):
    true = small_room.truth.camera
    level = replace(true, R_cam_world=torch.diag(torch.tensor([1.0, -1.0, -1.0])))
    seen = replace(picture(pieces, camera()), camera=level)
    found = standing_on(seen, small_room.bodies, Run(tmp_path))
    tilt = torch.stack(pitch_roll(true.R_cam_world))
    off = torch.rad2deg(torch.stack(pitch_roll(found.camera.R_cam_world)) - tilt)
    assert off.abs().max() < 1.5
    wanted = torch.cat([tilt, torch.tensor([-small_room.truth.ground]).log()])
    miss = found.prior.mean - wanted
    assert float(miss @ found.prior.precision @ miss) < 7.8  # 95 % of three unknowns
    assert float(found.prior.mean[2].exp()) == pytest.approx(-small_room.truth.ground, abs=0.1)
    # a height that is given stays, people of unknown size say less of it, one frame hardly anything
    known = standing_on(replace(seen, height=2.0), small_room.bodies, Run(tmp_path)).prior
    assert float(known.mean[2].exp()) == pytest.approx(2.0, rel=0.1)
    fitted = standing_on(seen, replace(small_room.bodies, size_spread=0.06), Run(tmp_path)).prior
    once = standing_on(seen, rows_of(small_room.bodies, torch.tensor([0])), Run(tmp_path)).prior
    spreads = [
        float(torch.linalg.inv(p.precision)[2, 2].sqrt()) for p in (found.prior, fitted, once)
    ]
    assert 0.05 <= spreads[0] < spreads[1] < spreads[2]
    assert spreads[1] >= (0.05**2 + 0.06**2) ** 0.5


@pytest.mark.parametrize("people", [True, False])
def test_edges_of_the_picture_tell_tilt_and_heading(people: bool, small_room, tmp_path: Path):
    capture, true = small_room.capture, small_room.truth.camera
    guess = tilted(*(a + math.radians(2) for a in pitch_roll(true.R_cam_world)))
    seen = Picture(
        replace(true, R_cam_world=guess), (), torch.zeros(0, true.height, true.width).bool(),
        torch.zeros(true.height, true.width).bool(), None, None, reference=capture.reference,
    )  # fmt: skip
    found = seen_from(seen, small_room.bodies if people else None, Run(tmp_path))
    pairs = zip(pitch_roll(found.camera.R_cam_world), pitch_roll(true.R_cam_world), strict=True)
    assert max(abs(float(a - b)) for a, b in pairs) < math.radians(0.3)
    assert found.tilt_spread < math.radians(0.5)
    turned = abs(math.remainder(found.heading.yaw, math.pi / 2))
    assert turned < min(math.radians(1), 3 * found.heading.spread)
    if people:
        assert float(found.prior.mean[2].exp()) == pytest.approx(-small_room.truth.ground, abs=0.03)
    blank = replace(seen, reference=torch.full_like(capture.reference, 0.5))
    nothing = seen_from(blank, None, Run(tmp_path))
    assert (nothing.tilt_spread, nothing.heading) == (None, None)
    assert torch.equal(nothing.camera.R_cam_world, guess)
    measured = replace(blank, camera=true, tilt_spread=0.005)
    held = seen_from(measured, small_room.bodies if people else None, Run(tmp_path))
    pairs = zip(pitch_roll(held.camera.R_cam_world), pitch_roll(true.R_cam_world), strict=True)
    assert max(abs(float(a - b)) for a, b in pairs) < math.radians(0.1)
    assert held.tilt_spread == 0.005


@pytest.mark.slow
def test_a_wrong_tilt_is_partly_corrected(tmp_path: Path):
    pieces = furniture(
        ROOM | {"office chair": (-0.3, -2.4, 2.0), "double bed": (-2.4, -6.4, 0.0)}, seed=51
    )
    true = camera(-0.25, 0.0)
    seen = picture(pieces, true)
    tilt = torch.tensor(-0.25 + math.radians(3))
    wrong = replace(seen, camera=replace(true, R_cam_world=tilted(tilt, torch.tensor(0.0))))
    config = replace(QUICK, screen=ScreenConfig(prior=0.003))
    first = first_scene(wrong, config, Run(tmp_path))
    pitch, _ = pitch_roll(first.scene.camera.R_cam_world)
    assert abs(float(pitch) + 0.25) < math.radians(3)


def test_shapes_are_those_of_the_class_and_differ():
    found = shapes_of("couch", 5)
    assert len({tuple(s.mesh.verts.shape) for s in found}) > 1
    widths = [s.size[0] for s in found]
    assert max(widths) > 1.5 * min(widths)
    assert len(shapes_of("dining table", 20)) == 20
    (fridge,) = shapes_of("refrigerator", 5)
    assert fridge.size[1] > 1.5
    assert not is_placed("TV")
    assert is_placed("dining table")


def test_the_users_own_shapes_come_first(tmp_path: Path, pieces: list[SceneObject]):
    write_mesh(pieces[1].mesh, tmp_path / "chair_0.glb")
    write_mesh(pieces[0].mesh, tmp_path / "sofa-1.glb")
    (own,) = shapes_of("chair", 5, tmp_path)
    assert own.file.endswith("chair_0.glb")
    assert own.size == pytest.approx(tuple(box_of(pieces[1]).size.tolist()), rel=1e-4)
    assert len(shapes_of("bed", 5, tmp_path)) == 5
    with pytest.raises(InputError, match="no such folder"):
        shapes_of("chair", 5, tmp_path / "none")


@pytest.mark.parametrize("kind", ["npz", "moge", "npy", "png", "half"])
def test_depth_maps_of_all_kinds_say_the_same(kind: str, tmp_path: Path):
    depth = floor_depth(camera()).numpy()
    points = np.repeat(depth[..., None], 3, -1)
    if kind == "npy":
        np.save(tmp_path / "d.npy", depth.astype(np.float16))
    elif kind == "png":
        values = (np.nan_to_num(depth).clip(0, 65) * 1000).round().astype(np.uint16)
        Image.fromarray(values).save(tmp_path / "d.png")
    else:
        arrays = {"npz": {"depth": depth[None]}, "moge": {"points": points, "mask": depth > 0},
                  "half": {"depth": depth[::2, ::2]}}  # fmt: skip
        np.savez(tmp_path / "d.npz", **arrays[kind])
    found = read_depth(next(tmp_path.iterdir()), camera())
    known = ~np.isnan(depth) & (depth < 40)
    rows = slice(H // 2 + 40, H)
    near = 0.03 if kind == "half" else 0.002
    assert np.allclose(found.numpy()[rows][known[rows]], depth[rows][known[rows]], rtol=near)
    assert torch.equal(found.isnan(), torch.from_numpy(np.isnan(depth))) or kind == "half"


def test_depth_maps_without_a_unit_or_of_another_shape_are_refused(tmp_path: Path):
    Image.new("L", (W, H), 80).save(tmp_path / "d.png")
    np.savez(tmp_path / "d.npz", depth=np.ones((H, H)))
    np.savez(tmp_path / "e.npz", other=np.ones((H, W)))
    for name, words in {
        "d.png": "16 bits of millimetres", "d.npz": "expected the shape of 480 x 320",
        "e.npz": "one of the arrays depth", "d.exr": r"expected \.npz",
    }.items():  # fmt: skip
        with pytest.raises(InputError, match=words):
            read_depth(tmp_path / name, camera())


def write_capture_without_scene(folder: Path, seen: Picture) -> None:
    folder.mkdir()
    write_json(camera_to_json(seen.camera), folder / "camera.json")
    write_json(detections_to_json(seen.detections, seen.camera, None), folder / "objects.json")


def test_a_first_scene_that_is_made_again_begins_where_the_first_did(pieces, tmp_path):
    level, found, own = (camera(pitch, 0.0) for pitch in (-0.1, -0.2, -0.3))
    folder = tmp_path / "c"
    write_capture_without_scene(folder, picture(pieces[:1], level))
    first = FirstScene(Scene(found, -1.4, ()), (), ())
    write_first_scene(first, folder, read_picture_of(folder))
    told = json.loads((folder / "camera.json").read_text())
    torch.testing.assert_close(torch.tensor(told["R_cam_world"]), found.R_cam_world)
    assert told["tilt_spread"] == first.tilt.spread > 0
    seen = read_picture_of(folder)
    torch.testing.assert_close(seen.camera.R_cam_world, level.R_cam_world, rtol=0, atol=1e-6)
    assert seen.tilt_spread is None
    measured = {**camera_to_json(own), "tilt_spread": 0.01}
    write_json(measured, folder / "camera.json")
    assert read_picture_of(folder).tilt_spread == 0.01
    write_first_scene(first, folder, read_picture_of(folder))
    told = json.loads((folder / "camera.json").read_text())
    assert (told["R_cam_world"], told["tilt_spread"]) == (measured["R_cam_world"], 0.01)
    write_json(camera_to_json(level), folder / "camera.json")
    write_first_scene(first, folder, read_picture_of(folder))
    write_json(camera_to_json(own), folder / "camera.json")
    torch.testing.assert_close(read_picture_of(folder).camera.R_cam_world, own.R_cam_world)
    write_json(camera_to_json(found), folder / "camera.json")
    (folder / "perceived" / "guess.json").write_text("{")
    torch.testing.assert_close(read_picture_of(folder).camera.R_cam_world, found.R_cam_world)


@pytest.mark.slow
def test_the_command_turns_masks_into_a_capture(pieces, tmp_path, capsys):
    folder = tmp_path / "c"
    write_capture_without_scene(folder, picture(pieces[:2], camera()))
    quick = ["--shapes", "2", "--keep", "2", "--turns", "2"]
    assert run_command("layout", [str(folder), *quick, "--screen.method.steps", "20"]) == 0
    assert "first scene of 2 objects" in capsys.readouterr().out
    capture = read("folder", folder)
    assert [p.id for p in capture.scene.objects] == ["sofa_0", "chair_0"]
    assert capture.scene.size_spread == SOUGHT
    made = [(folder / name).read_bytes() for name in ("scene.json", "camera.json")]
    assert run_command("layout", [str(folder), *quick, "--screen.method.steps", "20"]) == 0
    assert [(folder / name).read_bytes() for name in ("scene.json", "camera.json")] == made
    others = json.loads((folder / "hypotheses.json").read_text())["objects"]
    for name, rows in others.items():
        assert len(rows) == 2
        assert all((folder / row["mesh"]).is_file() for row in rows)
        piece = next(p for p in capture.scene.objects if p.id == name)
        assert rows[0]["yaw"] == pytest.approx(float(piece.yaw), abs=1e-5)
    assert run_command("layout", [str(tmp_path / "none")]) == 2
    (folder / "objects.json").unlink()
    assert run_command("layout", [str(folder)]) == 2
    assert "needs camera.json and objects.json" in capsys.readouterr().err
