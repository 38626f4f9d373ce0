"""Masks and joints: the true code on tiny networks, and crafted outputs of real ones."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from filmed import clip_of
from tiny_models import tiny_mask2former, tiny_vitpose

from mover.core.errors import InputError
from mover.core.types import Masks, People
from mover.geometry.rle import decode, encode
from mover.perceive.config import ModelsConfig, PerceiveConfig
from mover.perceive.networks import (
    PERSON,
    Finds,
    JointsInputs,
    Network,
    find_instances,
    find_joints,
    instances,
    joints_in,
    link_people,
    network,
)
from mover.perceive.video import Clip

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
        masks=str(tiny_mask2former(base / "masks")), keypoints=str(tiny_vitpose(base / "keypoints"))
    )


def noisy(folder: Path, count: int) -> Clip:
    rng = np.random.default_rng(0)
    return clip_of(folder, rng.integers(0, 255, (count, H, W, 3)).astype(np.uint8))


def mask(rows: slice, columns: slice) -> torch.Tensor:
    out = torch.zeros(H, W, dtype=torch.bool)
    out[rows, columns] = True
    return out


class Says:
    """A network that returns a crafted output."""

    def __init__(self, output: Any, config: Any) -> None:
        self.output, self.config = output, config

    def __call__(self, **_inputs: Any) -> Any:
        return self.output


def test_crafted_logits_become_known_masks_and_classes(folders: ModelsConfig):
    net = network("masks", folders)
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
    found = instances(said, [picture], [7], 0.5)
    assert found.category == ("chair", "person")
    assert found.frame.tolist() == [7, 7]
    assert bool((found.score > 0.9).all())
    for index, one in enumerate(truth.values()):
        drawn = decode(found.masks, index)
        assert (drawn & one).sum() > 0.95 * (drawn | one).sum()
    assert link_people(found).masks.counts == found.masks.counts[1:]


def test_crafted_heat_becomes_known_joints(folders: ModelsConfig):
    net = network("keypoints", folders)
    heat = torch.zeros(1, 17, 16, 12)
    y, x = torch.meshgrid(torch.arange(16.0), torch.arange(12.0), indexing="ij")
    peaks = [(2 + k % 8, 2 + (5 * k) % 12) for k in range(17)]
    for k, (px, py) in enumerate(peaks):
        heat[0, k] = torch.exp(-((x - px).square() + (y - py).square()) / 4)
    said = Network(Says(SimpleNamespace(heatmaps=heat), net.model.config), net.processor, "cpu")
    box = torch.tensor([20.0, 16.0, 65.0, 76.0])  # 45 x 60: the shape of the heat map
    (found,) = joints_in(said, [np.zeros((H, W, 3), dtype=np.uint8)], box[None])
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
    clip, config = noisy(tmp_path, 5), PerceiveConfig(models=folders, score=0.0)
    found = find_instances(clip, config)
    single = find_instances(clip.part(3, 4), config)
    rows = (found.frame == 3).nonzero()[:, 0].tolist()
    assert rows
    assert [found.category[k] for k in rows] == list(single.category)
    assert [found.masks.counts[k] for k in rows] == list(single.masks.counts)
    assert find_instances(clip.part(0, 0), config).category == ()


def test_people_keep_their_numbers_where_detections_are_linked():
    codes, frames = [], []
    for k in range(12):
        if k not in (4, 5):  # the first is hidden for a moment
            codes.append(encode(mask(slice(10, 60), slice(5 + 3 * k, 30 + 3 * k))))
            frames.append(k)
        codes.append(encode(mask(slice(50, 90), slice(90 - 2 * k, 120 - 2 * k))))
        frames.append(k)
    found = Finds(
        Masks(H, W, tuple(codes)), torch.tensor(frames), (PERSON,) * len(codes),
        torch.ones(len(codes)),
    )  # fmt: skip
    tracks = link_people(found)
    assert sorted(tracks.person.unique().tolist()) == [0, 1]
    firsts = [p for p, c in zip(tracks.person.tolist(), codes, strict=True)
              if decode(Masks(H, W, (c,)), 0)[:50].any()]  # fmt: skip
    assert firsts == [0] * 10


def test_joints_of_all_people_are_found_row_by_row(folders: ModelsConfig, tmp_path: Path):
    clip = noisy(tmp_path, 3)
    code = encode(mask(slice(20, 80), slice(40, 85)))
    zeros = torch.zeros(20, dtype=torch.long)
    tracks = People(Masks(H, W, (code,) * 20), torch.arange(20) % 3, zeros)
    found = find_joints(JointsInputs(clip, tracks), folders)
    assert found.points.shape == (20, 17, 2)
    assert found.layout == "coco17"
    assert found.points.isfinite().all()
    empty = People(Masks(H, W, ()), zeros[:0], zeros[:0])
    assert find_joints(JointsInputs(clip, empty), folders).points.shape == (0, 17, 2)


@pytest.mark.parametrize("kind", ["masks", "keypoints"])
def test_a_missing_network_is_one_sentence_that_says_what_to_download(kind: str, tmp_path: Path):
    def wanting(name: str) -> ModelsConfig:
        return replace(ModelsConfig(), **{kind: name})

    with pytest.raises(InputError, match=r"run `hf download no-one/has-this` once") as error:
        network(kind, wanting("no-one/has-this"))
    assert "\n" not in str(error.value)
    with pytest.raises(InputError, match=r"holds no network for this task"):
        network(kind, wanting(str(tmp_path)))
