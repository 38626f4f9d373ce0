"""MediaPipe's networks: pixels in and out, against what mediapipe itself found in real clips."""

import hashlib
import sys
import zipfile
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import pytest
import torch
from filmed import clip_of

from mover.app.cli import run_command
from mover.bodies.keypoints import LAYOUTS
from mover.core.errors import InputError
from mover.core.types import Keypoints, Masks, People
from mover.geometry.rle import decode, encode
from mover.perceive import config, mediapipe
from mover.perceive.config import ModelsConfig
from mover.perceive.steady import Clean
from mover.perceive.video import Clip, read_frames

CLIPS = Path(__file__).parents[2] / "shared" / "data" / "clips"
H, W = 240, 320
PEOPLE = {(90.0, 120.0): 40.0, (230.0, 110.0): 36.0}
"""Middle of the hips of the people in the picture [px], and half of their height."""


def logit(share: float) -> float:
    return float(np.log(share / (1 - share)))


def detector(picture: np.ndarray) -> dict[tuple[int, ...], np.ndarray]:
    """Finds white squares: two boxes that overlap for each person, the hips, a point above."""
    assert picture.shape == (224, 224, 3)
    assert picture.min() >= -1
    assert picture.max() <= 1
    scores, values = np.full((2254, 1), -50.0), np.zeros((2254, 12))
    anchors = mediapipe.anchors() * 224
    scale = 224 / W
    for x, y in PEOPLE:
        at = np.array([x, y + (W - H) / 2]) * scale
        if picture[tuple(at[::-1].astype(int))].min() < 0.5:
            continue
        for k in np.square(anchors - at).sum(1).argsort()[:2]:
            half = PEOPLE[x, y] * scale
            edge = at - [0, 2 * half]
            scores[k] = logit(0.9)
            values[k] = [*(at - anchors[k]), half, half, *(at - anchors[k]), *(edge - anchors[k]),
                         *np.zeros(4)]  # fmt: skip
    return {(1, 2254, 12): values[None], (1, 2254, 1): scores[None]}


def landmarks(picture: np.ndarray) -> dict[tuple[int, ...], np.ndarray]:
    """Finds the hips in the middle of its crop, and a mask about them."""
    assert picture.shape == (256, 256, 3)
    assert picture.max() <= 1
    white = picture.min(-1) > 0.5
    rows = np.zeros((39, 5))
    rows[:, :2], rows[:, 3] = 128, logit(0.8)
    rows[0, :2] = 128, 28  # the nose, up in the crop
    maps = np.full((64, 64, 39), -50.0)
    maps[32, 34, 1] = 5.0  # the second one is sure two cells to the right
    return {
        (1, 195): rows.reshape(1, -1), (1, 1): np.array([[0.9 if white[128, 128] else 0.1]]),
        (1, 64, 64, 39): maps[None], (1, 256, 256, 1): np.where(white, 9.0, -9.0)[None, ..., None],
    }  # fmt: skip


def crowd(*people: tuple[float, float]) -> np.ndarray:
    picture = np.zeros((H, W, 3), np.uint8)
    for x, y in people:
        half = int(PEOPLE[x, y])
        picture[int(y) - half : int(y) + half, int(x) - half // 2 : int(x) + half // 2] = 255
    return picture


def test_several_people_are_found_upright_in_the_pixels_of_the_picture(tmp_path, monkeypatch):
    one, two = PEOPLE
    pictures = [crowd(*people) for people in ((one, two), (two,), (), (one, two))]
    tracks, found = poses_in(clip_of(tmp_path, pictures), monkeypatch)
    assert found.frame.tolist() == tracks.frame.tolist() == [0, 0, 1, 3, 3]
    assert found.person.equal(tracks.person)
    middle = found.points[:, 5]
    names = {one: 0, two: 1} if float(middle[0, 0]) < 160 else {one: 1, two: 0}
    assert found.person.tolist() == [0, 1, names[two], *found.person.tolist()[3:]]
    assert sorted(found.person.tolist()[3:]) == [0, 1]
    for k in range(5):
        at = {v: key for key, v in names.items()}[int(found.person[k])]
        side = 5 * PEOPLE[at]
        assert middle[k].tolist() == pytest.approx(at, abs=0.6)
        nose = (at[0], at[1] - 100 / 256 * side)
        assert found.points[k, 0].tolist() == pytest.approx(nose, abs=0.6)
        moved = (at[0] + 8 / 256 * side, at[1])
        assert found.points[k, 1].tolist() == pytest.approx(moved, abs=0.6)
        true = torch.from_numpy(crowd(at)[..., 0] > 127)
        mask = decode(tracks.masks, k)
        assert float((mask & true).sum() / (mask | true).sum()) > 0.9
    assert found.confidence.flatten().tolist() == pytest.approx([0.8] * 5 * 33)


def poses_in(clip: Clip, monkeypatch: pytest.MonkeyPatch) -> tuple[People, Keypoints]:
    monkeypatch.setattr(mediapipe, "loaded", {"d": detector, "l": landmarks}.__getitem__)
    return mediapipe.find_poses(mediapipe.PoseInputs(clip, ("d", "l"), ""))


def joints_at(points: torch.Tensor) -> Keypoints:
    """The landmarks of a person in one frame."""
    zero = torch.tensor([0])
    return Keypoints(points, torch.ones(1, 33), "mediapipe33", zero, zero, 5.0)


def test_masks_lose_the_furniture_that_no_limb_is_near_to():
    """A man of 200 px stands upright before a chair; his mask takes the chair along."""
    points = np.full((1, 33, 2), 160.0)
    rows = {0: 20, 7: 20, 8: 20, 11: 60, 12: 60, 23: 120, 24: 120, 25: 169, 26: 169, 27: 218,
            28: 218, 29: 225, 30: 225, 31: 225, 32: 225}  # fmt: skip
    for k in range(33):
        points[0, k, 1] = rows.get(k, 100)
    y, x = torch.meshgrid(torch.arange(H), torch.arange(W), indexing="ij")
    body = ((x - 160).abs() < 10) & (y > 10) & (y < 228)
    chair = (x > 150) & (x < 260) & (y > 130) & (y < 220)
    masks = Masks(H, W, (encode(body | chair | ((x > 280) & (y > 200))),))
    joints = joints_at(torch.from_numpy(points).float())
    tracks = People(masks, joints.frame, joints.person)
    found = decode(mediapipe.without_furniture(tracks, joints, chair).masks, 0)
    assert bool((found & body).sum() == body.sum())  # what is near to a limb stays
    assert not bool(found[:, 200:260].any())  # of the chair nothing else
    assert bool(found[220, 300])  # what is no furniture stays
    none = mediapipe.without_furniture(tracks, joints, torch.zeros(H, W, dtype=torch.bool))
    assert none.masks.counts == masks.counts


def test_landmarks_where_a_frame_shows_the_empty_room_are_not_seen(tmp_path: Path):
    """The 33 landmarks of a man: most on him, a leg's on a chair, a toe's on the floor beside."""
    noise = np.random.default_rng(0).integers(-3, 4, (H, W, 3))
    room = np.full((H, W, 3), 90)
    room[130:220, 200:260] = 160  # a chair
    frame = room + noise + 6  # it became lighter
    frame[10:228, 140:180] = 30
    frame[190:205, 225:240] = 30  # a foot before the chair
    points = torch.full((1, 33, 2), 160.0)
    points[0, :, 1] = torch.linspace(25, 215, 33)
    points[0, 25], points[0, 27], points[0, 28], points[0, 31] = torch.tensor(
        [[215.0, 150], [215, 200], [232, 197], [290, 225]]
    )
    points[0, 1] = torch.tensor([-20.0, 50])  # outside nothing is known
    joints = joints_at(points)
    clip = clip_of(tmp_path, [frame.astype(np.uint8)])
    chair = torch.zeros(H, W, dtype=torch.bool)
    chair[130:220, 200:260] = True
    clean = Clean(torch.from_numpy(room).float() / 255, chair)  # always under the man's mask
    for furniture, gone in ((chair, [25, 27, 31]), (None, [31])):
        found = mediapipe.without_room(joints, clip, clean, furniture)
        assert (found.confidence[0] == 0).nonzero()[:, 0].tolist() == gone
    shown = Clean(torch.from_numpy(frame).float() / 255, torch.zeros_like(chair))
    found = mediapipe.without_room(joints, clip, shown, chair)
    assert torch.equal(found.confidence, joints.confidence)


def test_nothing_is_found_in_an_empty_picture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    tracks, found = poses_in(clip_of(tmp_path, [crowd()]), monkeypatch)
    assert found.points.shape == (0, 33, 2)
    assert tracks.masks.counts == ()
    assert mediapipe.detected(crowd(), detector) == []
    outside = np.full((39, 2), -9.0)
    assert np.array_equal(mediapipe.refined(outside, np.zeros((64, 64, 39))), outside)


def test_the_layout_names_what_the_body_model_has():
    names = LAYOUTS["mediapipe33"]
    assert len(names) == 33
    for k, name in {0: "nose", 11: "left_shoulder", 16: "right_wrist", 24: "right_hip",
                    28: "right_ankle", 29: "left_heel", 32: "right_big_toe"}.items():  # fmt: skip
        assert names[k] == name


class TestWeights:
    @pytest.fixture(autouse=True)
    def cache(self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))

    def archive(self, path: Path, files: dict[str, bytes]) -> Path:
        with zipfile.ZipFile(path, "w") as archive:
            for name, content in files.items():
                archive.writestr(name, content)
        return path

    def test_networks_come_out_of_a_wheel_or_a_bundle_and_a_single_file_replaces_one(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
    ):
        content = b"\0\0\0\0TFL3" + bytes(9)
        digest = hashlib.sha256(content).hexdigest()
        monkeypatch.setattr(config, "DIGESTS", dict.fromkeys(config.DIGESTS, digest))
        source = self.archive(tmp_path / "m.whl", dict.fromkeys(config.IN_WHEEL, content))
        assert config.networks() is None
        assert run_command("weights", ["mediapipe", str(source)]) == 0
        assert config.networks() is not None
        assert capsys.readouterr().out.count("wrote") == 2
        heavy = tmp_path / "heavy.tflite"
        heavy.write_bytes(content + b"1")
        config.fetch(print, heavy)
        bundle = dict.fromkeys(config.IN_TASK, content + b"2")
        for source, last in ((heavy, b"1"), (self.archive(tmp_path / "h.task", bundle), b"2")):
            config.fetch(print, source)
            assert (config.folder() / config.LANDMARKS).read_bytes()[-1:] == last

    @pytest.mark.parametrize(("name", "content", "words"), [
        ("m.whl", b"PK", "cannot be read"),
        ("m.whl", None, "is not that of mediapipe==0.10.21"),
        ("m.task", None, "cannot be read"),
        ("m.tflite", b"nonsense", "no network of TensorFlow Lite"),
    ])  # fmt: skip
    def test_what_is_no_network_is_refused(self, name, content, words, tmp_path):
        path = tmp_path / name
        if content is None:
            self.archive(path, dict.fromkeys(config.IN_WHEEL, b"\0\0\0\0TFL3other"))
        else:
            path.write_bytes(content)
        with pytest.raises(InputError, match=words):
            config.fetch(print, path)
        with pytest.raises(InputError, match="no such file"):
            config.fetch(print, tmp_path / "none.whl")
        assert config.networks() is None

    def test_a_download_that_fails_says_what_to_do(self, monkeypatch: pytest.MonkeyPatch):
        monkeypatch.setattr(sys, "executable", "false")
        with pytest.raises(InputError, match=r"mover weights mediapipe FILE\.whl"):
            config.fetch(print)

    def test_only_what_is_needed_is_asked_for(self, monkeypatch: pytest.MonkeyPatch):
        monkeypatch.setattr(config.importlib.util, "find_spec", lambda _: None)
        found = config.missing(ModelsConfig(), (), mediapipe=True)
        assert [line.split(":")[0].split(",")[0] for line in found] == [
            "the package av", "the package ai_edge_litert",
            "MediaPipe's networks (Apache-2.0; 9 MB)",
        ]  # fmt: skip
        assert all("mediapipe" in line for line in found)
        assert not any("mediapipe" in line for line in config.missing(ModelsConfig()))
        with pytest.raises(InputError, match="mover weights mediapipe"):
            mediapipe.pose_inputs(Clip("", 1, 1, torch.zeros(1), None))


@pytest.mark.slow
@pytest.mark.skipif(not CLIPS.is_dir(), reason="shared/data is not there")
@pytest.mark.skipif(find_spec("ai_edge_litert") is None, reason="ai-edge-litert is not installed")
@pytest.mark.skipif(config.networks() is None, reason="mover weights mediapipe has not been run")
@pytest.mark.parametrize("name", ["s1_ADL_16", "s3_ADL_18", "s4_ADL_19"])
def test_joints_and_masks_are_those_of_mediapipe(name: str):
    stored = np.load(CLIPS / name / "mediapipe_full.npz")
    wanted, misses, overlaps = stored["frame"].tolist(), list[float](), list[float]()
    nets = [mediapipe.loaded(str(path)) for path in config.networks() or ()]
    for index, _, pixels in read_frames(CLIPS / name / "video.mp4"):
        if index not in wanted:
            continue
        row, picture = wanted.index(index), pixels()
        found = mediapipe.people_in(picture, *nets)
        off = [np.linalg.norm(p - stored["points33"][row], axis=1).mean() for p, *_ in found]
        misses.append(min(off) / np.ptp(stored["points33"][row], axis=0).max())
        mask, size = found[int(np.argmin(off))][2], picture.shape[:2]
        true = np.unpackbits(stored["mask"][row]).ravel()[: mask.size].reshape(size) > 0
        overlaps.append(float((mask & true).sum() / (mask | true).sum()))
    assert len(misses) == len(wanted)
    assert np.median(misses) < 0.004  # of the person's extent: 1 px of 250
    assert min(overlaps) > 0.95
