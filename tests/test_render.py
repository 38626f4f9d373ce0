"""Pictures without a screen: the right pixels, the right size, the right number of them."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest
import torch
from little_room import GROUND, room, walkers
from PIL import Image
from tiny_capture import HEIGHT, WIDTH, write_capture

from mover.app.cli import run_command
from mover.app.pictures import RenderConfig, overlay
from mover.app.pictures.film import save_film, video_pictures
from mover.app.pictures.overlay import backdrop, render_result, render_room
from mover.core.errors import InputError
from mover.core.types import Segment
from mover.geometry.camera import project, to_camera
from mover.geometry.rle import thinned
from mover.io.capture.bodies_file import write_bodies
from mover.io.capture.scene_file import write_scene
from mover_bench.rooms.render import see


def pixels_of(points_world, camera):
    return project(to_camera(points_world, camera.R_cam_world), camera.K)


def test_an_object_is_drawn_on_the_pixels_of_its_mask(small_room):
    camera = small_room.truth.camera
    owner = overlay.draw(overlay.furniture(small_room.truth), camera).owner
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
        surfaces = overlay.joined(
            [overlay.furniture(small_room.truth), overlay.people(bodies, [row])]
        )
        mine = overlay.draw(surfaces, camera).owner >= overlay.PERSON
        mask = torch.from_numpy(thinned(masks, row, 1))
        assert (mine & mask).sum() >= 0.98 * (mine | mask).sum()


def test_pictures_of_any_size_show_the_same_points():
    camera = room().camera
    points = torch.tensor([[0.4, -0.8, -3.5], [-1.0, -1.5, -4.0]])
    for width in (640, 320, 1280):
        small = overlay.sized_camera(camera, width, width * 9 // 16)
        truth = pixels_of(points, camera) * width / 640
        assert torch.allclose(pixels_of(points, small), truth, atol=1e-3)


def test_rays_to_the_floor_project_back_to_their_pixels():
    camera = overlay.sized_camera(room().camera, 64, 36)
    floor = overlay.floor_points(camera, GROUND)
    seen = floor.isfinite().all(-1)
    rows, columns = torch.nonzero(seen, as_tuple=True)
    centre = torch.stack([columns, rows], -1) + 0.5
    assert torch.allclose(pixels_of(floor[seen], camera), centre.float(), atol=1e-2)
    assert torch.allclose(floor[seen][:, 1], torch.tensor(GROUND), atol=1e-5)


def unannotated(scene):
    pieces = tuple(dataclasses.replace(p, annotation=None) for p in scene.objects)
    return dataclasses.replace(scene, objects=pieces)


@pytest.fixture
def out(tmp_path: Path) -> Path:
    """The folder of a result."""
    for name, shift in (("scene", 0.0), ("initial", 0.3)):
        write_scene(unannotated(room(shift)), tmp_path / f"{name}.json")
    for name in ("bodies", "initial_bodies"):
        write_bodies(walkers(6), tmp_path / f"{name}.npz")
    return tmp_path


def test_a_film_has_a_picture_for_each_frame_at_the_size_asked_for(out: Path):
    av = pytest.importorskip("av")
    film = out / "room.mp4"
    count = render_result(out, film, RenderConfig(width=161))
    with av.open(str(film)) as video:
        pictures = list(video.decode(video=0))
        rate = float(video.streams.video[0].average_rate)
    assert len(pictures) == count == 6
    assert {(p.width, p.height) for p in pictures} == {(160, 90)}
    assert rate == pytest.approx(15.0 / 3)
    moved = [np.asarray(p.to_image()).astype(float) for p in (pictures[0], pictures[-1])]
    assert np.abs(moved[0] - moved[1]).max() > 50


def test_a_still_shows_the_frame_that_is_asked_for(out: Path):
    found = []
    for frame in (0, 15):
        path = out / f"{frame}.png"
        assert render_result(out, path, RenderConfig(width=160, frame=frame)) == 1
        with Image.open(path) as picture:
            found.append(np.asarray(picture).astype(float))
    assert found[0].shape == (90, 160, 3)
    assert np.abs(found[0] - found[1]).max() > 50


def test_the_video_is_behind_the_furniture(tmp_path: Path):
    capture = write_capture(tmp_path / "capture")
    (capture / "frames").mkdir()
    colours = {0: (250, 0, 0), 3: (0, 250, 0)}
    for frame, colour in colours.items():
        Image.new("RGB", (WIDTH, HEIGHT), colour).save(capture / "frames" / f"{frame:06d}.png")
    pictures = list(render_room(room(), walkers(2), [0, 3, 9], 64, capture))
    for picture, channel in zip(pictures[:2], (0, 1), strict=True):
        assert picture[0, 0].argmax() == channel
        assert picture[0, 0, channel] > 0.95
    assert picture.shape == (36, 64, 3)
    assert (pictures[2][0, 0] - pictures[0][0, 0]).abs().max() > 0.2


def test_a_film_is_what_each_picture_would_be_alone(monkeypatch):
    """Only where people are is drawn again; what they leave and what they hide is right."""
    scene, bodies, frames = room(), walkers(12), [0, 4, 11]
    found = list(render_room(scene, bodies, frames, 320))
    whole = slice(0, 180), slice(0, 320)
    assert all(picture.shape == (180, 320, 3) for picture in found)
    monkeypatch.setattr(overlay, "window_of", lambda *_: whole)
    for picture, alone in zip(found, render_room(scene, bodies, frames, 320), strict=True):
        off = (picture - alone).abs().amax(-1)
        assert float(off.mean()) < 1e-4
        assert float((off > 0.02).float().mean()) < 1e-3  # pixels at edges
    assert float((found[0] - found[2]).abs().amax()) > 0.2
    away = dataclasses.replace(bodies, verts=bodies.verts + torch.tensor([0.0, 90.0, 0.0]))
    empty = list(render_room(scene, away, frames, 320))
    assert torch.equal(empty[0], empty[2])


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
    pytest.importorskip("av")
    write_scene(unannotated(room()), tmp_path / "scene.json")
    with pytest.raises(InputError, match="--to: "):
        render_result(tmp_path, tmp_path / name, RenderConfig(width=64))


def test_moved_furniture_is_drawn_where_it_stands_in_the_frame():
    scene = room()
    chair, *others = scene.objects
    shift = torch.tensor([-0.6, 0.0, 0.4])
    there = dataclasses.replace(chair, t_world_object=chair.t_world_object + shift)
    stays = tuple(Segment(f, p.t_world_object, p.yaw) for f, p in ((0, chair), (5, there)))
    moved = dataclasses.replace(chair, segments=stays)
    world = dataclasses.replace(scene, objects=(moved, *others))
    found = list(render_room(world, None, [4, 5, 4], 64))
    for picture, item in zip(found, (chair, there, chair), strict=True):
        alone = overlay.furniture(dataclasses.replace(scene, objects=(item, *others)))
        expected, _ = overlay.draw_picture(alone, scene.camera, backdrop(36, 64), GROUND)
        assert torch.equal(picture, expected)
    assert (found[0] - found[1]).abs().max() > 0.2


def test_the_command_says_what_it_drew(out: Path, capsys: pytest.CaptureFixture[str]):
    path = out / "room.jpg"
    assert run_command("render", [str(out), "--to", str(path), "--width", "64"]) == 0
    assert "one picture" in capsys.readouterr().out
    with Image.open(path) as picture:
        assert picture.size == (64, 36)
    assert run_command("render", [str(out), "--to", str(path), "--width", "1"]) == 2
