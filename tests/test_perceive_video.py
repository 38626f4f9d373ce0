"""The whole way from a video to a capture, on tiny networks."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from tiny_models import tiny_mask2former, tiny_sam2, tiny_vitpose

from mover.app.cli import run_command
from mover.core.run import Run
from mover.core.types import Masks
from mover.geometry.rle import decode, encode
from mover.io.people.keypoints import read_keypoints
from mover.perceive.capture import people_of_clip
from mover.perceive.config import DetectConfig, ModelsConfig, PerceiveConfig
from mover.perceive.detect import Finds
from mover.perceive.reference import Clean, detections_in, grown, hidden_mask, reference_of
from mover.perceive.steady import Drift
from mover.perceive.track import Tracks
from mover.perceive.video import Clip, write_jpeg

pytest.importorskip("transformers")
pytestmark = pytest.mark.filterwarnings("default")  # transformers warns about itself
W, H, FRAMES = 128, 96, 7


@pytest.fixture(scope="module")
def models(tmp_path_factory: pytest.TempPathFactory) -> ModelsConfig:
    base = tmp_path_factory.mktemp("models")
    return ModelsConfig(
        masks=str(tiny_mask2former(base / "masks")),
        tracker=str(tiny_sam2(base / "tracker")),
        keypoints=str(tiny_vitpose(base / "keypoints")),
        device="cpu",
    )


def room() -> np.ndarray:
    rng = np.random.default_rng(1)
    small = Image.fromarray(rng.integers(0, 255, (12, 16, 3)).astype(np.uint8))
    return np.array(small.resize((W, H), Image.Resampling.BICUBIC))


def write_frames(folder: Path) -> None:
    """Somebody grey walks through a room."""
    folder.mkdir()
    for k in range(FRAMES):
        picture = room()
        picture[20:90, 10 + 12 * k : 30 + 12 * k] = 90
        Image.fromarray(picture).save(folder / f"im{k}.png")


def named(models: ModelsConfig) -> list[str]:
    return [
        "--models.masks", models.masks, "--models.tracker", models.tracker,
        "--models.keypoints", models.keypoints, "--models.device", "cpu",
    ]  # fmt: skip


@pytest.mark.slow
def test_a_folder_of_pictures_becomes_a_capture_and_is_not_read_twice(
    models: ModelsConfig, tmp_path: Path, capsys: pytest.CaptureFixture[str]
):
    write_frames(tmp_path / "in")
    out = tmp_path / "c"
    loose = ["--detect.score", "0", "--track.present", "-1000", "--track.segment", "3"]
    command = [
        str(tmp_path / "in"), "--out", str(out), *named(models), *loose, "--fov", "65",
        "--no-layout", "--frames.folder-fps", "5",
    ]  # fmt: skip
    assert run_command("perceive", command) == 0
    told = capsys.readouterr().out
    assert "still missing: bodies.npz" in told
    assert sorted(p.name for p in (out / "frames").iterdir())[-1] == f"{FRAMES - 1:06d}.jpg"
    people = json.loads((out / "people.json").read_text())
    assert [image["id"] for image in people["images"]] == list(range(FRAMES))
    rows = [(row["image_id"], row["track_id"]) for row in people["annotations"]]
    assert len(set(rows)) == len(rows) > 0
    keypoints = read_keypoints(out / "keypoints.npz")
    assert list(zip(keypoints.frame.tolist(), keypoints.person.tolist(), strict=True)) == rows
    camera = json.loads((out / "camera.json").read_text())
    assert camera["w"] == W
    assert json.loads((out / "objects.json").read_text())["images"][0]["width"] == W
    before = {p: p.stat().st_mtime_ns for p in out.rglob("stages/*/*.json")}
    assert run_command("perceive", command) == 0
    assert {p: p.stat().st_mtime_ns for p in out.rglob("stages/*/*.json")} == before


def test_a_network_that_is_not_there_is_one_sentence(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    write_frames(tmp_path / "in")
    command = [str(tmp_path / "in"), "--out", str(tmp_path / "c"), "--models.masks", "no/such"]
    assert run_command("perceive", command) == 2
    errors = [line for line in capsys.readouterr().err.splitlines() if "mover perceive" in line]
    assert len(errors) == 1
    assert "hf download no/such" in errors[0]


def clip_of(folder: Path) -> Clip:
    folder.mkdir()
    for k in range(FRAMES):
        picture = room()
        picture[20:90, 10 + 12 * k : 30 + 12 * k] = 90
        write_jpeg(picture, folder / f"{k:06d}.jpg")
    return Clip(str(folder), W, H, torch.arange(FRAMES) / 5, 5.0)


def walkers() -> Tracks:
    masks = torch.zeros(FRAMES, H, W, dtype=torch.bool)
    for k in range(FRAMES):
        masks[k, 20:90, 10 + 12 * k : 30 + 12 * k] = True
    codes = tuple(encode(mask) for mask in masks)
    zeros = torch.zeros(FRAMES, dtype=torch.long)
    return Tracks(Masks(H, W, codes), torch.arange(FRAMES), zeros, 1)


def test_the_reference_is_the_room_without_the_walker(tmp_path: Path):
    still = Drift(
        torch.eye(3).expand(FRAMES, 3, 3), torch.zeros(FRAMES), torch.ones(FRAMES), 0, 0.0, "still"
    )
    config = PerceiveConfig().clean
    clean = reference_of(clip_of(tmp_path / "f"), still, walkers(), config)
    assert clean.frame == -1
    assert not clean.hidden.any()
    assert hidden_mask(clean) is None
    assert (clean.picture - torch.from_numpy(room()) / 255).abs().mean() < 0.03
    inner = torch.zeros(H, W, dtype=torch.bool)
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
    hidden = Clean(torch.zeros(H, W, 3), masks[0], -1)
    one = hidden_mask(hidden)
    assert one is not None
    assert torch.equal(decode(one, 0), masks[0])


@pytest.mark.slow
def test_numbers_of_people_go_on_from_segment_to_segment(models: ModelsConfig, tmp_path: Path):
    clip = clip_of(tmp_path / "f")
    config = PerceiveConfig(models=models)
    loose = DetectConfig(models, score=0.0, least=0.0)
    for segment in (2, 3, 50):
        track = type(config.track)(models, segment=segment, present=-1e9, least=0.0)
        run = Run(tmp_path / f"r{segment}")
        tracks = people_of_clip(clip, (loose, PerceiveConfig(models=models, track=track)), run)
        pairs = list(zip(tracks.frame.tolist(), tracks.person.tolist(), strict=True))
        assert len(set(pairs)) == len(pairs)
        assert sorted(set(tracks.frame.tolist())) == list(range(FRAMES))
