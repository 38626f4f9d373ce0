"""The scripts in examples/ run, and what they show is true."""

import sys
from pathlib import Path

import numpy as np
import pytest
import torch

EXAMPLES = Path(__file__).parents[1] / "examples"


@pytest.fixture(autouse=True)
def _from_examples(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(sys, "path", [str(EXAMPLES), *sys.path])


def test_a_capture_is_made_from_arrays(capsys: pytest.CaptureFixture[str]):
    import capture_from_arrays

    capture = capture_from_arrays.main()
    assert [piece.id for piece in capture.scene.objects] == ["table_0"]
    assert capture.detections[0].mask is not None
    assert "table_0" in capsys.readouterr().out


def test_a_run_from_python_puts_the_table_on_its_mask(tmp_path: Path):
    import capture_from_arrays
    import run_from_python

    from mover.evaluate.scene import image_box

    room = run_from_python.main(tmp_path, steps=30)
    given = capture_from_arrays.make_capture()

    def miss(scene):
        seen = image_box(scene.objects[0], scene.camera)
        size = torch.tensor([320.0, 240, 320, 240])
        return float((seen.float() * size - given.detections[0].box).abs().max())

    assert miss(room.scene) < 0.5 * miss(given.scene)
    assert room.evidence[0].mask_pixels > 0


def test_the_new_term_moves_the_box_out_of_the_wall():
    import add_a_term
    from add_a_term import WALL, behind_term

    layout = add_a_term.main()
    assert float(layout.t_world_object[0, 1, 2]) > WALL + 0.4
    assert torch.allclose(layout.t_world_object[0, 0], torch.tensor([0.0, 0.0, -3.0]))
    verts = torch.tensor([[[0.0, 0.0, WALL]]])
    assert float(behind_term(verts, WALL)) == 0
    assert float(behind_term(verts - 0.5, WALL)) == pytest.approx(0.25)


def test_the_better_scene_is_measured_as_better():
    import evaluate_scenes

    metrics = evaluate_scenes.main()
    before, after = metrics["initial"], metrics["result"]
    assert after["iou3d"] > before["iou3d"]
    assert after["center_error"] == pytest.approx(0.05 * 2**0.5, abs=1e-4)
    assert before["center_error"] == pytest.approx(0.25 * 2**0.5, abs=1e-4)


def test_the_gallery_shows_an_object_and_a_seated_person():
    import gallery

    from mover_bench.rooms.motion import Task

    play = gallery.played(gallery.one("chair", 0, 1), (Task("sit", 0),))
    frames = gallery.first_run(play.done.labels, "sit")
    cell = play.cell("sit", gallery.spread(frames, 3)[1], gallery.SIDE)
    empty = gallery.picture_of(play.still, gallery.joined([]), gallery.SIDE, 0.12)
    page = gallery.sheet([cell, gallery.Cell("chair", empty)], 2)
    assert page.size == (2 * gallery.CELL[0], gallery.CELL[1] + gallery.CAPTION)
    colours = cell.picture.getcolors(100_000)
    assert len(colours) > 500


@pytest.mark.slow
def test_the_picture_of_the_readme_shows_before_beside_after(tmp_path: Path, small_room):
    import dataclasses

    import picture
    from PIL import Image

    from mover.app.results import initial_bodies
    from mover.io.capture.bodies_file import write_bodies
    from mover.io.capture.folder import write_capture
    from mover.io.capture.scene_file import write_scene
    from mover_bench.rooms.config import NoiseConfig
    from mover_bench.rooms.noise import add_noise

    capture = add_noise(small_room, NoiseConfig(), 1)
    first = next(p for p in small_room.truth.objects if p.id == capture.scene.objects[0].id)
    scene = dataclasses.replace(capture.scene, objects=(first, *capture.scene.objects[1:]))
    write_capture(capture, tmp_path / "capture")
    write_scene(scene, tmp_path / "room" / "scene.json")
    for name in ("initial_bodies.npz", "bodies.npz"):
        write_bodies(initial_bodies(capture), tmp_path / "room" / name)
    picture.main(tmp_path, tmp_path / "picture.png")
    shown = np.asarray(Image.open(tmp_path / "picture.png").convert("RGB")).astype(int)
    height, width = capture.reference.shape[:2]
    assert shown.shape[:2] == (len(picture.SHOWN) * height // 2, width)
    before, after = shown[:, : width // 2], shown[:, width // 2 :]
    assert 0.001 < (np.abs(before - after).max(-1) > 30).mean() < 0.5  # one object stands elsewhere
