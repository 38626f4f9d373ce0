"""Pictures without a screen: the right pixels, the right size, the right number of them."""

import dataclasses
import math
from pathlib import Path

import numpy as np
import pytest
import torch
from little_room import GROUND, room, walkers
from PIL import Image

from mover.app.pictures.config import RenderConfig
from mover.app.pictures.eye import (
    above_eye,
    floor_points,
    in_eye,
    orbit_eye,
    spinning_eyes,
    video_eye,
)
from mover.app.pictures.film import save_film, video_pictures
from mover.app.pictures.paint import (
    NO_OWNER,
    PERSON,
    draw,
    draw_picture,
    furniture,
    ground_under,
    joined,
    people,
    shadows,
)
from mover.app.pictures.render import render_result, render_room
from mover.core.errors import InputError
from mover.core.types import Segment
from mover.geometry.camera import project, to_camera
from mover.geometry.placement import place_object
from mover.geometry.rle import thinned
from mover_bench.rooms.render import see


def pixels_of(points_world, eye):
    return project(in_eye(eye, points_world), eye.K)


def test_an_object_is_drawn_on_the_pixels_of_its_mask(small_room):
    camera = small_room.truth.camera
    owner = draw(furniture(small_room.truth), video_eye(camera, camera.width)).owner
    masks = see(small_room.plan).piece
    assert owner.shape == masks.shape
    for index in range(len(small_room.truth.objects)):
        mine, mask = owner == index, masks == index
        assert (mine & mask).sum() >= 0.98 * (mine | mask).sum()


def test_a_person_is_drawn_on_the_pixels_of_the_visible_mask(small_room):
    camera, given = small_room.truth.camera, small_room.bodies
    world = given.verts @ camera.R_cam_world
    bodies = dataclasses.replace(given, verts=world, joints=None, joint_names=(), space="world")
    masks = small_room.capture.people.masks
    for row in (0, len(world) // 2, len(world) - 1):
        surfaces = joined([furniture(small_room.truth), people(bodies, [row])])
        mine = draw(surfaces, video_eye(camera, camera.width)).owner >= PERSON
        mask = torch.from_numpy(thinned(masks, row, 1))
        assert (mine & mask).sum() >= 0.98 * (mine | mask).sum()


def test_the_eye_of_the_video_sees_the_same_points_at_any_size():
    scene = room()
    points = torch.tensor([[0.4, -0.8, -3.5], [-1.0, -1.5, -4.0]])
    truth = project(to_camera(points, scene.camera.R_cam_world), scene.camera.K)
    for width in (640, 320, 1280):
        eye = video_eye(scene.camera, width)
        assert torch.allclose(pixels_of(points, eye), truth * width / 640, atol=1e-3)


POINTS = torch.cat([p.mesh.verts + p.t_world_object for p in room().objects])
SIZE = (400, 300)


def assert_all_inside(eye):
    pixel = pixels_of(POINTS, eye)
    assert (pixel > 0).all()
    assert (pixel < torch.tensor(SIZE)).all()


@pytest.mark.parametrize("azimuth", [0.0, 0.7, 2.0, -2.5])
@pytest.mark.parametrize("elevation", [0.0, 0.4, 1.2, -0.3])
def test_an_eye_around_the_room_sees_everything_upright(azimuth: float, elevation: float):
    eye = orbit_eye(POINTS, SIZE, azimuth, elevation)
    assert torch.allclose(eye.R_eye_world @ eye.R_eye_world.mT, torch.eye(3), atol=1e-6)
    assert torch.linalg.det(eye.R_eye_world) == pytest.approx(1, abs=1e-5)
    assert_all_inside(eye)
    middle = (POINTS.amin(0) + POINTS.amax(0)) / 2
    higher = pixels_of(torch.stack([middle, middle + torch.tensor([0, 0.1, 0])]), eye)
    assert higher[1, 1] < higher[0, 1]


def test_eyes_lie_as_the_video_and_the_plan_of_the_report_have_it():
    """From the right the right of the image is near; from above +x is right, away is up."""
    right, centre = torch.tensor([1.0, -1.0, -3.5]), POINTS.mean(0)
    front, side = (orbit_eye(POINTS, SIZE, a, 0.3) for a in (0.0, math.pi / 2))
    assert pixels_of(right, front)[0] > pixels_of(centre, front)[0]
    assert in_eye(side, right)[2] < in_eye(side, centre)[2]
    eye = above_eye(POINTS, SIZE)
    near_left, near_right, far_left = (
        pixels_of(torch.tensor([x, -1.0, z]), eye) for x, z in ((-1, -3), (1, -3), (-1, -4))
    )
    assert near_right[0] > near_left[0]
    assert far_left[1] < near_left[1]


def test_eyes_that_go_around_keep_their_distance():
    eyes = spinning_eyes(POINTS, SIZE, [0.0, 1.0, 2.0, 4.0], 0.4)
    middle = (POINTS.amin(0) + POINTS.amax(0)) / 2
    far = torch.stack([(e.t_world_eye - middle).norm() for e in eyes])
    assert torch.allclose(far, far[0])
    for eye in eyes:
        assert_all_inside(eye)


def test_rays_to_the_floor_project_back_to_their_pixels():
    eye = video_eye(room().camera, 64)
    floor = floor_points(eye, GROUND)
    seen = floor.isfinite().all(-1)
    rows, columns = torch.nonzero(seen, as_tuple=True)
    centre = torch.stack([columns, rows], -1) + 0.5
    assert torch.allclose(pixels_of(floor[seen], eye), centre.float(), atol=1e-2)
    assert torch.allclose(floor[seen][:, 1], torch.tensor(GROUND), atol=1e-5)


def test_a_shadow_is_darkest_where_something_stands():
    scene = room()
    still = furniture(scene)
    ground = ground_under(still.verts, GROUND)
    eye = above_eye(still.verts, (320, 240))
    dark = shadows(eye, ground, still)[..., 3]
    owner = draw(still, eye).owner
    assert dark[owner == 2].mean() > 3 * dark[owner == NO_OWNER].mean()
    assert dark[0, 0] == 0


def unannotated(scene):
    pieces = tuple(dataclasses.replace(p, annotation=None) for p in scene.objects)
    return dataclasses.replace(scene, objects=pieces)


def folder(tmp_path: Path) -> Path:
    from mover.io.capture.bodies_file import write_bodies
    from mover.io.capture.scene_file import write_scene

    for name, shift in (("scene", 0.0), ("initial", 0.3)):
        write_scene(unannotated(room(shift)), tmp_path / f"{name}.json")
    for name in ("bodies", "initial_bodies"):
        write_bodies(walkers(6), tmp_path / f"{name}.npz")
    return tmp_path


def test_a_film_has_a_picture_for_each_frame_at_the_size_asked_for(tmp_path: Path):
    av = pytest.importorskip("av")
    out, film = folder(tmp_path), tmp_path / "room.mp4"
    count = render_result(out, film, RenderConfig(width=161))
    with av.open(str(film)) as video:
        pictures = list(video.decode(video=0))
        rate = float(video.streams.video[0].average_rate)
    assert len(pictures) == count == 6
    assert {(p.width, p.height) for p in pictures} == {(160, 90)}
    assert rate == pytest.approx(15.0 / 3)
    moved = [np.asarray(p.to_image()).astype(float) for p in (pictures[0], pictures[-1])]
    assert np.abs(moved[0] - moved[1]).max() > 50


def test_a_still_shows_the_frame_that_is_asked_for(tmp_path: Path):
    out = folder(tmp_path)
    found = []
    for frame in (0, 15):
        path = tmp_path / f"{frame}.png"
        assert render_result(out, path, RenderConfig(width=160, frame=frame)) == 1
        with Image.open(path) as picture:
            found.append(np.asarray(picture).astype(float))
    assert found[0].shape == (90, 160, 3)
    assert np.abs(found[0] - found[1]).max() > 50


def test_the_video_is_behind_the_furniture(tmp_path: Path):
    from tiny_capture import HEIGHT, WIDTH, write_capture

    capture = write_capture(tmp_path / "capture")
    (capture / "frames").mkdir()
    colours = {0: (250, 0, 0), 3: (0, 250, 0)}
    for frame, colour in colours.items():
        Image.new("RGB", (WIDTH, HEIGHT), colour).save(capture / "frames" / f"{frame:06d}.png")
    config = RenderConfig(width=64)
    pictures = list(render_room(room(), walkers(2), [0, 3, 9], config, capture))
    for picture, channel in zip(pictures[:2], (0, 1), strict=True):
        assert picture[0, 0].argmax() == channel
        assert picture[0, 0, channel] > 0.95
    assert picture.shape == (36, 64, 3)
    assert (pictures[2][0, 0] - pictures[0][0, 0]).abs().max() > 0.2


def test_frames_of_a_film_are_found_by_their_number(tmp_path: Path):
    pytest.importorskip("av")
    shades = [torch.full((32, 48, 3), k / 10) for k in range(10)]
    assert save_film(iter(shades), 10.0, tmp_path / "video.mp4") == 10
    found = list(video_pictures(tmp_path, [2, 7, 12], (24, 16)))
    assert [None if p is None else tuple(p.shape) for p in found] == [(16, 24, 3)] * 2 + [None]
    for picture, frame in zip(found[:2], (2, 7), strict=True):
        assert float(picture.mean()) == pytest.approx(frame / 10, abs=0.02)


@pytest.mark.parametrize("name", ["room.gif", "room", "room.mp4"])
def test_what_cannot_be_drawn_is_said(tmp_path: Path, name: str):
    from mover.io.capture.scene_file import write_scene

    pytest.importorskip("av")
    write_scene(unannotated(room()), tmp_path / "scene.json")
    with pytest.raises(InputError, match="--to: "):
        render_result(tmp_path, tmp_path / name, RenderConfig(width=64))


def test_a_room_without_people_turns():
    config = RenderConfig(view="orbit", turns=1, width=64)
    a, b = render_room(room(), None, [0, 0], config)
    assert a.shape == b.shape == (36, 64, 3)
    assert (a - b).abs().max() > 0.2


def test_moved_furniture_is_drawn_where_it_stands_in_the_frame():
    scene = room()
    chair, *others = scene.objects
    there = dataclasses.replace(
        chair, t_world_object=chair.t_world_object + torch.tensor([-0.6, 0.0, 0.4])
    )
    stays = tuple(Segment(f, p.t_world_object, p.yaw) for f, p in ((0, chair), (5, there)))
    moved = dataclasses.replace(chair, segments=stays)
    config = RenderConfig(width=64)
    world = dataclasses.replace(scene, objects=(moved, *others))
    found = list(render_room(world, None, [4, 5, 4], config))
    points = torch.cat([place_object(p).verts for p in scene.objects])
    for picture, item in zip(found, (chair, there, chair), strict=True):
        alone = furniture(dataclasses.replace(scene, objects=(item, *others)))
        eye = video_eye(scene.camera, 64)
        expected, _ = draw_picture(alone, eye, ground_under(points, GROUND))
        assert torch.equal(picture, expected)
    assert (found[0] - found[1]).abs().max() > 0.2


def test_the_command_says_what_it_drew(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    from mover.app.cli import run_command

    out, path = folder(tmp_path), tmp_path / "room.jpg"
    assert run_command("render", [str(out), "--to", str(path), "--width", "64"]) == 0
    assert "one picture" in capsys.readouterr().out
    with Image.open(path) as picture:
        assert picture.size == (64, 36)
    assert run_command("render", [str(out), "--to", str(path), "--width", "1"]) == 2
