"""Masks, tracks and joints: the true code on tiny networks, and crafted outputs of real ones."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from tiny_models import tiny_mask2former, tiny_oneformer, tiny_sam2, tiny_vitpose

from mover.core.errors import InputError
from mover.core.types import Masks
from mover.geometry.rle import decode, encode
from mover.perceive.config import DetectConfig, JointsConfig, ModelsConfig, TrackConfig
from mover.perceive.detect import (
    DetectInputs,
    Finds,
    Network,
    find_instances,
    instances,
    network,
    overlap,
    people_in,
)
from mover.perceive.track import (
    JointsInputs,
    SegmentInputs,
    Tracks,
    find_joints,
    full_masks,
    joints_in,
    link_people,
    matched,
    no_people,
    stack_of,
    track_people,
)
from mover.perceive.video import Clip, write_jpeg

pytest.importorskip("transformers")
pytestmark = pytest.mark.filterwarnings("default")  # transformers warns about itself
H, W = 96, 128


@pytest.fixture(autouse=True)
def offline(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> ModelsConfig:
    base = tmp_path_factory.mktemp("models")
    return ModelsConfig(
        masks=str(tiny_mask2former(base / "masks")),
        tracker=str(tiny_sam2(base / "tracker")),
        keypoints=str(tiny_vitpose(base / "keypoints")),
        device="cpu",
    )


def clip_of(folder: Path, count: int) -> Clip:
    rng = np.random.default_rng(0)
    for k in range(count):
        write_jpeg(rng.integers(0, 255, (H, W, 3)).astype(np.uint8), folder / f"{k:06d}.jpg")
    return Clip(str(folder), W, H, torch.arange(count) / 5, 5.0)


def mask(rows: slice, columns: slice) -> torch.Tensor:
    out = torch.zeros(H, W, dtype=torch.bool)
    out[rows, columns] = True
    return out


class Says:
    """A network that returns what it was told."""

    def __init__(self, output: Any, config: Any) -> None:
        self.output, self.config = output, config

    def __call__(self, **_inputs: Any) -> Any:
        return self.output


def test_crafted_logits_become_known_masks_and_classes(folders: ModelsConfig):
    net = network("masks", folders.masks, folders)
    truth = {1: mask(slice(20, 70), slice(10, 60)), 0: mask(slice(40, 90), slice(80, 120))}
    classes = torch.full((1, 6, 5), -10.0)
    classes[..., 4] = 10.0  # nothing
    pixels = torch.full((1, 6, H, W), -10.0)
    for query, (label, one) in enumerate(truth.items()):
        classes[0, query, label], classes[0, query, 4] = 10.0, -10.0
        pixels[0, query][one] = 10.0
    output = SimpleNamespace(class_queries_logits=classes, masks_queries_logits=pixels)
    said = Network(Says(output, net.model.config), net.processor, "cpu")
    picture = np.zeros((H, W, 3), dtype=np.uint8)
    found = instances(said, [picture], [7], DetectConfig())
    assert found.category == ("chair", "person")
    assert found.frame.tolist() == [7, 7]
    assert bool((found.score > 0.9).all())
    for index, one in enumerate(truth.values()):
        assert overlap(decode(found.masks, index)[None], one[None]) > 0.95
    assert people_in(found).category == ("person",)


@pytest.fixture(scope="module")
def oneformer(tmp_path_factory: pytest.TempPathFactory) -> ModelsConfig:
    folder = tiny_oneformer(tmp_path_factory.mktemp("models") / "oneformer")
    return ModelsConfig(masks=str(folder), device="cpu")


@pytest.mark.parametrize("count", [1, 2])
def test_crafted_logits_of_oneformer_become_the_same_masks(oneformer: ModelsConfig, count: int):
    """One instance alone does not get the rest of the picture, and overlaps stay."""
    net = network("masks", oneformer.masks, oneformer)
    shapes = [(1, mask(slice(20, 70), slice(10, 60))), (0, mask(slice(40, 90), slice(50, 120)))]
    classes = torch.full((1, 6, 5), -10.0)
    classes[..., 4] = 10.0  # nothing
    pixels = torch.full((1, 6, H, W), -10.0)
    for query, (label, one) in enumerate(shapes[:count]):
        classes[0, query, label], classes[0, query, 4] = 10.0, -10.0
        pixels[0, query][one] = 10.0
    output = SimpleNamespace(class_queries_logits=classes, masks_queries_logits=pixels)
    said = Network(Says(output, net.model.config), net.processor, "cpu")
    found = instances(said, [np.zeros((H, W, 3), dtype=np.uint8)], [7], DetectConfig())
    assert found.category == ("chair", "person")[:count]
    assert bool((found.score > 0.9).all())
    for index, (_, one) in enumerate(shapes[:count]):
        assert overlap(decode(found.masks, index)[None], one[None]) > 0.95


def test_oneformer_is_asked_for_instances_and_runs_in_batches(
    oneformer: ModelsConfig, tmp_path: Path
):
    clip = clip_of(tmp_path, 3)
    config = DetectConfig(oneformer, score=0.0, batch=2, least=0.0)
    found = find_instances(DetectInputs(clip, (0, 1, 2)), config)
    assert set(found.frame.tolist()) == {0, 1, 2}
    assert set(found.category) <= {"person", "chair", "couch", "wall-other-merged"}
    net = network("masks", oneformer.masks, oneformer)
    words = net.processor(
        images=[np.zeros((H, W, 3), np.uint8)], task_inputs=["instance"], return_tensors="pt"
    )["task_inputs"]
    other = net.processor(
        images=[np.zeros((H, W, 3), np.uint8)], task_inputs=["semantic"], return_tensors="pt"
    )["task_inputs"]
    assert words.shape == (1, 77)
    assert not torch.equal(words, other)


def test_crafted_heat_becomes_known_joints(folders: ModelsConfig):
    net = network("keypoints", folders.keypoints, folders)
    heat = torch.zeros(1, 17, 16, 12)
    y, x = torch.meshgrid(torch.arange(16.0), torch.arange(12.0), indexing="ij")
    peaks = [(2 + k % 8, 2 + (5 * k) % 12) for k in range(17)]
    for k, (px, py) in enumerate(peaks):
        heat[0, k] = torch.exp(-((x - px).square() + (y - py).square()) / 4)
    said = Network(Says(SimpleNamespace(heatmaps=heat), net.model.config), net.processor, "cpu")
    box = torch.tensor([20.0, 16.0, 65.0, 76.0])  # 45 x 60: the shape of the heat map
    found = joints_in(said, [np.zeros((H, W, 3), dtype=np.uint8)], [box])[0]
    # the box grows by a quarter about its middle; cells lie evenly over it, from edge to edge
    low = (box[:2] + box[2:]) / 2 - 1.25 * (box[2:] - box[:2]) / 2
    step = 1.25 * (box[2:] - box[:2]) / torch.tensor([12.0, 16.0])
    expected = low + torch.tensor(peaks).float() * step
    assert (found[:, :2] - expected).abs().max() < 1.05 * step.max()
    order = found[:, 0].argsort(stable=True)
    assert torch.equal(
        torch.tensor(peaks)[order][:, 0].sort().values, torch.tensor(peaks)[order][:, 0]
    )
    assert found[:, 2].min() > 0.8


def test_networks_run_on_frames_in_batches(folders: ModelsConfig, tmp_path: Path):
    clip = clip_of(tmp_path, 5)
    config = DetectConfig(folders, score=0.0, batch=2, least=0.0)
    found = find_instances(DetectInputs(clip, tuple(range(5))), config)
    single = find_instances(DetectInputs(clip, (3,)), config)
    rows = (found.frame == 3).nonzero()[:, 0].tolist()
    assert [found.category[k] for k in rows] == list(single.category)
    assert [found.masks.counts[k] for k in rows] == list(single.masks.counts)


def test_sam2_follows_everybody_through_a_segment(folders: ModelsConfig, tmp_path: Path):
    clip = clip_of(tmp_path, 4)
    people = [mask(slice(20, 70), slice(10, 50)), mask(slice(30, 90), slice(70, 120))]
    codes = tuple(encode(m) for m in people)
    found = Finds(
        Masks(H, W, codes), torch.zeros(2, dtype=torch.long), ("person",) * 2, torch.ones(2)
    )
    config = TrackConfig(folders, present=-1e9, least=0.0)
    tracks = track_people(SegmentInputs(clip, 0, 3, found, no_people(clip)), config)
    assert tracks.frame.tolist() == [0, 0, 1, 1, 2, 2, 3, 3]
    assert tracks.person.tolist() == [0, 1] * 4
    first = stack_of(tracks.masks)[:2]
    assert float(overlap(first, torch.stack(people)).diagonal().min()) > 0.9
    last = Tracks(Masks(H, W, codes[1:]), torch.tensor([3]), torch.tensor([1]), 2)
    again = replace(found, masks=Masks(H, W, codes))
    more = track_people(SegmentInputs(clip, 3, 3, again, last), config)
    assert sorted(more.person.tolist()) == [1, 2]  # the first one is new to this segment
    assert more.people == 3


def test_masks_of_sam2_are_brought_to_the_pixels_of_the_video():
    logits = torch.full((1, 1, 24, 32), -8.0)
    logits[0, 0, 6:18, 8:24] = 8.0
    wide = full_masks(logits, (H, W))[0]
    assert torch.equal(wide.any(1), mask(slice(24, 72), slice(0, W)).any(1))
    assert torch.equal(wide.any(0), mask(slice(0, H), slice(32, 96)).any(0))
    assert int(wide.sum()) > 48 * 64 - 20  # all but rounded corners


def test_people_keep_their_numbers_where_detections_are_linked():
    codes, frames = [], []
    for k in range(12):
        if k not in (4, 5):  # the first is hidden for a moment
            codes.append(encode(mask(slice(10, 60), slice(5 + 3 * k, 30 + 3 * k))))
            frames.append(k)
        codes.append(encode(mask(slice(50, 90), slice(90 - 2 * k, 120 - 2 * k))))
        frames.append(k)
    found = Finds(
        Masks(H, W, tuple(codes)), torch.tensor(frames), ("person",) * len(codes),
        torch.ones(len(codes)),
    )  # fmt: skip
    tracks = link_people(found, TrackConfig())
    assert tracks.people == 2
    firsts = [p for p, c in zip(tracks.person.tolist(), codes, strict=True)
              if decode(Masks(H, W, (c,)), 0)[:50].any()]  # fmt: skip
    assert firsts == [0] * 10


def test_pairs_have_the_largest_sum_of_overlaps():
    assert matched(torch.tensor([[0.5, 0.6], [0.0, 0.55]]), 0.3) == {0: 0, 1: 1}
    assert matched(torch.tensor([[0.2]]), 0.3) == {}
    assert matched(torch.zeros(0, 2), 0.3) == {}


def test_joints_of_everybody_are_found_row_by_row(folders: ModelsConfig, tmp_path: Path):
    clip = clip_of(tmp_path, 3)
    code = encode(mask(slice(20, 80), slice(40, 85)))
    tracks = Tracks(Masks(H, W, (code,) * 3), torch.arange(3), torch.zeros(3, dtype=torch.long), 1)
    found = find_joints(JointsInputs(clip, tracks), JointsConfig(folders, batch=2))
    assert found.points.shape == (3, 17, 2)
    assert found.layout == "coco17"
    assert found.points.isfinite().all()
    empty = find_joints(JointsInputs(clip, no_people(clip)), JointsConfig(folders))
    assert empty.points.shape == (0, 17, 2)


@pytest.mark.parametrize("kind", ["masks", "tracker", "keypoints"])
def test_a_missing_network_is_one_sentence_that_says_what_to_download(kind: str, tmp_path: Path):
    config = ModelsConfig(device="cpu")
    name = "nobody/has-this"
    with pytest.raises(InputError, match=r"run `hf download nobody/has-this` once") as error:
        network(kind, name, config)
    assert "\n" not in str(error.value)
    with pytest.raises(InputError, match=r"holds no network for this task"):
        network(kind, str(tmp_path), config)
    with pytest.raises(InputError, match="none of auto, cpu, cuda"):
        network(kind, name, replace(config, device="tpu"))
