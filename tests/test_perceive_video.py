"""The way from a video to a capture, on tiny networks, and what is kept of their finds."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from filmed import clip_of
from PIL import Image
from test_lens import FOCAL, camera_of, picture_of
from tiny_models import tiny_mask2former, tiny_vitpose

from mover.core.run import Run
from mover.core.types import Keypoints, Masks, People
from mover.geometry.rle import decode, encode
from mover.io.people.keypoints import read_keypoints
from mover.perceive.capture import Finders, lens_by_lines, perceive, restless
from mover.perceive.config import ModelsConfig, PerceiveConfig
from mover.perceive.networks import Finds
from mover.perceive.own import Video
from mover.perceive.steady import Clean, Drift, detections_in, grown, hidden_mask, reference_of
from mover.perceive.video import Clip

W, H, FRAMES = 128, 96, 7


def room() -> np.ndarray:
    rng = np.random.default_rng(1)
    small = Image.fromarray(rng.integers(0, 255, (12, 16, 3)).astype(np.uint8))
    return np.array(small.resize((W, H), Image.Resampling.BICUBIC))


def walked(folder: Path) -> Clip:
    """A grey person walks through a room."""
    pictures = [room() for _ in range(FRAMES)]
    for k, picture in enumerate(pictures):
        picture[20:90, 10 + 12 * k : 30 + 12 * k] = 90
    return clip_of(folder, pictures)


@pytest.mark.slow
@pytest.mark.filterwarnings("default")  # transformers warns about itself
def test_a_folder_of_pictures_becomes_a_capture_and_is_not_read_twice(tmp_path: Path):
    pytest.importorskip("transformers")
    walked(tmp_path / "in")
    out, said = tmp_path / "c", list[str]()
    masks, joints = tiny_mask2former(tmp_path / "masks"), tiny_vitpose(tmp_path / "joints")
    models = ModelsConfig(str(masks), str(joints))
    config = PerceiveConfig(models=models, score=0.0)

    def go() -> None:
        run = Run(out / "perceived")
        perceive(Video(tmp_path / "in", fov=65.0), out, config, run, said.append, Finders())

    go()
    assert "% of the room are never seen" in said[-1]
    assert sorted(p.name for p in (out / "frames").iterdir())[-1] == f"{FRAMES - 1:06d}.jpg"
    people = json.loads((out / "people.json").read_text())
    assert [image["id"] for image in people["images"]] == list(range(FRAMES))
    rows = [(row["image_id"], row["track_id"]) for row in people["annotations"]]
    assert len(set(rows)) == len(rows) > 0
    keypoints = read_keypoints(out / "keypoints.npz")
    assert list(zip(keypoints.frame.tolist(), keypoints.person.tolist(), strict=True)) == rows
    assert json.loads((out / "camera.json").read_text())["w"] == W
    assert json.loads((out / "objects.json").read_text())["images"][0]["width"] == W
    before = {p: p.stat().st_mtime_ns for p in out.rglob("stages/*/*.json")}
    go()
    assert {p: p.stat().st_mtime_ns for p in out.rglob("stages/*/*.json")} == before


def test_the_reference_is_the_room_without_the_walker(tmp_path: Path):
    masks = torch.zeros(FRAMES, H, W, dtype=torch.bool)
    for k in range(FRAMES):
        masks[k, 20:90, 10 + 12 * k : 30 + 12 * k] = True
    codes = tuple(encode(mask) for mask in masks)
    zeros = torch.zeros(FRAMES, dtype=torch.long)
    tracks = People(Masks(H, W, codes), torch.arange(FRAMES), zeros)
    still = Drift(torch.eye(3).expand(FRAMES, 3, 3), torch.ones(FRAMES), 0, 0.0, "still")
    clean = reference_of(walked(tmp_path / "f"), still, tracks)
    assert not clean.hidden.any()
    assert hidden_mask(clean) is None
    assert (clean.picture - torch.from_numpy(room()) / 255).abs().mean() < 0.03
    inner = np.zeros((H, W), dtype=bool)
    inner[40, 50] = True
    assert int(grown(inner, 2).sum()) == 13


def test_furniture_is_kept_once_and_cups_are_not():
    masks = torch.zeros(4, H, W, dtype=torch.bool)
    masks[0, 10:50, 10:50] = masks[1, 11:50, 10:50] = True
    masks[2, 60:90, 60:90], masks[3, 0:5, 0:5] = True, True
    codes = tuple(encode(m) for m in masks)
    found = Finds(
        Masks(H, W, codes), torch.zeros(4, dtype=torch.long), ("chair", "couch", "bed", "cup"),
        torch.tensor([0.8, 0.9, 0.7, 0.99]),
    )  # fmt: skip
    kept = detections_in(found)
    assert [(d.id, d.category) for d in kept] == [(0, "couch"), (1, "bed")]
    assert kept[1].box.tolist() == [60, 60, 90, 90]
    hidden = Clean(torch.zeros(H, W, 3), masks[0])
    one = hidden_mask(hidden)
    assert torch.equal(decode(one, 0), masks[0])


@pytest.mark.parametrize(("fps", "dense"), [(5.0, False), (10.0, True)])
def test_jumps_ask_for_more_frames_a_second_and_walks_do_not(fps: float, dense: bool):
    """A person 100 px tall jumps 1.6 times a second by 26 px, or walks."""
    time = torch.arange(int(6 * fps)) / fps
    person = torch.rand(17, 2, generator=torch.Generator().manual_seed(0)) * torch.tensor([30, 100])
    for jumps, walks in ((True, 0.0), (False, 90.0)):
        points = person + torch.stack([walks * time, 0 * time], -1)[:, None]
        if jumps:
            points[..., 1] += 13 * (2 * torch.pi * 1.6 * time).sin()[:, None]
        frames = torch.arange(len(time))
        joints = Keypoints(points, torch.ones(len(time), 17), "coco17", frames, 0 * frames, fps)
        assert restless(joints) == (jumps and not dense)
        gone = replace(joints, frame=3 * frames)  # no two frames that follow each other
        assert not restless(gone)


@pytest.mark.slow
@pytest.mark.parametrize(("spread", "taken"), [(0.055, True), (0.0, False), (None, False)])
def test_the_lens_of_the_lines_counts_before_bodies_are_fitted(spread: float | None, taken: bool):
    (picture, _), said = picture_of(0.5, seed=1), list[str]()
    clean = Clean(picture, torch.zeros(picture.shape[:2], dtype=torch.bool))
    guess = camera_of(1.08 * FOCAL, -0.1)
    found, left = lens_by_lines(guess, spread, clean, said.append)
    off = float(found.K[0, 0]) / FOCAL - 1
    assert abs(off) < 0.03 if taken else off == pytest.approx(0.08)
    if taken:  # in the room, the same lines do not count a second time
        assert 0 < left["focal_spread"] < 0.05
        assert left["focal_by_lines"] is True
    else:
        assert left == {}
    assert len(said) == taken
