"""Frames, the steady camera, the clean picture and the lens."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from filmed import clip_of, take, write_film
from PIL import Image
from scipy.spatial.transform import Rotation

from mover.core.errors import InputError
from mover.geometry.camera import pitch_roll
from mover.io.files.cameras import GUESSED
from mover.perceive.capture import camera_by, lens_of
from mover.perceive.config import FramesConfig
from mover.perceive.own import Video
from mover.perceive.steady import (
    LEAST_FRAMES,
    Drift,
    align,
    find_drift,
    median,
    moved,
    steady_frames,
    warnings_of,
    warp,
)
from mover.perceive.video import Clip, read_picture, stamp_of

BEDROOM = Path(__file__).parents[2] / "shared" / "data" / "sam2_bedroom" / "bedroom.mp4"
W, H = 320, 180


def texture(seed: int = 0, size: tuple[int, int] = (260, 420)) -> torch.Tensor:
    """Smooth random patches of colour."""
    generator = torch.Generator().manual_seed(seed)
    parts = [
        torch.nn.functional.interpolate(
            torch.rand(1, 3, size[0] // n, size[1] // n, generator=generator), size, mode="bicubic"
        )
        for n in (8, 20, 50)
    ]
    picture = torch.stack(parts).mean(0)[0].permute(1, 2, 0)
    return ((picture - 0.5) * 2 + 0.5).clamp(0, 1)


def turn(pan: float, tilt: float, roll: float, zoom: float, f: float) -> np.ndarray:
    """The homography of a camera that turns about its centre."""
    K = np.array([[f, 0, W / 2], [0, f, H / 2], [0, 0, 1]])
    R = Rotation.from_euler("YXZ", (pan, tilt, roll)).as_matrix()
    M = K @ np.diag([zoom, zoom, 1]) @ R @ np.linalg.inv(K)
    return M / M[2, 2]


def view(world: torch.Tensor, M: np.ndarray) -> torch.Tensor:
    """What a turned camera sees of a picture that is larger than its own."""
    shift = np.array([[1.0, 0, 50], [0, 1, 40], [0, 0, 1]])
    return torch.from_numpy(warp(world.numpy(), shift @ np.linalg.inv(M), (H, W)))


def grey(picture: torch.Tensor) -> np.ndarray:
    """Brightness in whole steps."""
    return (picture.mean(-1) * 255).round().to(torch.uint8).numpy()


def worst(found: np.ndarray, true: np.ndarray) -> float:
    corners = np.array([[0.0, 0], [W, 0], [0, H], [W, H]])
    return float(np.linalg.norm(moved(found, corners) - moved(true, corners), axis=-1).max())


EYE = np.eye(3)


def test_a_turned_camera_is_found():
    world = texture()
    M = turn(0.05, -0.03, 0.02, 1.01, 250.0)
    fit = align(grey(view(world, EYE)), grey(view(world, M)), EYE)
    assert worst(fit.H, M) < 0.2
    assert worst(EYE, M) > 20
    assert fit.agree > 0.85


def test_people_and_light_do_not_pull_the_camera():
    world = texture(1)
    M = turn(-0.03, 0.02, 0.0, 1.0, 288.0)
    a, b = grey(view(world, EYE)), grey(view(world, M) * 0.8 + 0.1)
    other = grey(texture(2))
    a[40:150, 60:120], b[30:140, 150:210] = other[40:150, 60:120], other[40:150, 60:120]
    assert worst(align(a, b, EYE).H, M) < 0.5


def write_clip(folder: Path, turns: list[np.ndarray], walkers: bool = False) -> Clip:
    world, other = texture(3), texture(4)
    pictures = [view(world, M) for M in turns]
    for k, picture in enumerate(pictures if walkers else ()):
        picture[40:160, 20 + 20 * k : 70 + 20 * k] = other[:120, :50]
    return clip_of(folder, [(p * 255).round().to(torch.uint8).numpy() for p in pictures])


def load_frame(path: Path) -> torch.Tensor:
    return torch.from_numpy(read_picture(path)).float() / 255


def found_in(clip: Clip) -> tuple[Drift, list[str]]:
    drift = find_drift(clip)
    return drift, warnings_of(drift, clip.time)


def away(drift: Drift, frame: int, point: np.ndarray) -> float:
    """How far a point of the first frame is in another one [px]."""
    H = (drift.H[frame] @ torch.linalg.inv(drift.H[0])).double().numpy()
    return float(np.linalg.norm(moved(H, point) - point))


def test_a_still_camera_is_left_alone(tmp_path: Path):
    clip = write_clip(tmp_path / "raw", [EYE] * 4, walkers=True)
    drift, texts = found_in(clip)
    assert (drift.verdict, texts) == ("still", [])
    steady = steady_frames(clip, drift, tmp_path / "steady")
    assert steady.path(2).read_bytes() == clip.path(2).read_bytes()


def test_a_swaying_camera_is_turned_back(tmp_path: Path):
    turns = [turn(0.012 * k, 0.006 * k, -0.004 * k, 1.0, 288.0) for k in range(6)]
    clip = write_clip(tmp_path / "raw", turns, walkers=True)
    drift, (text,) = found_in(clip)
    assert drift.verdict == "sways"
    assert "sways" in text
    assert drift.reference in (2, 3)
    centre = np.array([[W / 2, H / 2]])
    far = float(np.linalg.norm(moved(turns[5], centre) - centre))
    assert away(drift, 5, centre) == pytest.approx(far, abs=0.5)
    steady = steady_frames(clip, drift, tmp_path / "steady")
    inner = (slice(20, 160), slice(190, 300))  # no person walks here in the first two frames
    a, b = (load_frame(steady.path(k))[inner] for k in (0, 1))
    raw = (load_frame(clip.path(0)) - load_frame(clip.path(1)))[inner].abs().mean()
    assert (a - b).abs().mean() < 0.2 * raw


def test_frames_are_chosen_by_the_clock_not_by_counting(tmp_path: Path):
    colours = [10 * k for k in range(20)]
    times = [*range(10), *range(20, 30)]  # a third of a second is missing
    greys = [np.full((48, 64, 3), colour, dtype=np.uint8) for colour in colours]
    film = write_film(tmp_path / "v.mp4", greys, times)
    clip = take(film, tmp_path / "f", FramesConfig(fps=10))
    assert clip.time.mul(30).round().tolist() == [0, 3, 6, 9, 21, 24, 27, 29]
    assert clip.numbers.tolist() == [0, 1, 2, 3, 7, 8, 9, 10]  # a tenth of a second each
    greys = [float(load_frame(clip.path(k)).mean()) * 255 for k in range(len(clip.time))]
    expected = [colours[times.index(round(30 * t))] for t in clip.time.tolist()]
    assert greys == pytest.approx(expected, abs=4)
    part = take(film, tmp_path / "g", FramesConfig(fps=10, start=0.2, end=0.31))
    assert part.time.mul(30).round().tolist() == part.index.tolist() == [6, 9]


def test_a_folder_of_pictures_keeps_the_order_of_numbers(tmp_path: Path):
    (tmp_path / "in").mkdir()
    for k in (10, 2, 1):
        Image.new("L", (8, 6), 20 * k).save(tmp_path / "in" / f"im{k}.png")
    clip = take(tmp_path / "in", tmp_path / "out")
    assert clip.fps is None
    greys = [round(float(load_frame(clip.path(k)).mean()) * 255 / 20) for k in range(3)]
    assert greys == [1, 2, 10]
    Image.new("L", (9, 6)).save(tmp_path / "in" / "im11.png")
    with pytest.raises(InputError, match="9 x 6 pixels, expected 8 x 6"):
        take(tmp_path / "in", tmp_path / "out2")


@pytest.mark.parametrize("content", [b"", b"nonsense" * 100])
def test_a_file_that_is_no_video_gives_one_clear_error(tmp_path: Path, content: bytes):
    pytest.importorskip("av")
    (tmp_path / "v.mp4").write_bytes(content)
    with pytest.raises(InputError, match=r"v\.mp4: cannot be read"):
        take(tmp_path / "v.mp4", tmp_path / "f")
    with pytest.raises(InputError, match="no such file"):
        stamp_of(tmp_path / "other.mp4")


def test_the_clean_picture_is_the_room_that_people_never_hide_for_long():
    room = (texture(6, (60, 80)) * 255).round().to(torch.uint8).numpy()
    shown = np.ones((6, 60, 80), dtype=bool)
    pictures = np.stack([room] * 6)
    for k in range(6):
        shown[k, 10:50, 10 * k : 10 * k + 20] = False
        shown[k, :5, :5] = False  # always hidden
        pictures[k][~shown[k]] = 25 * k
    picture, hidden = median(pictures, shown)
    assert hidden.nonzero()[0].max() == hidden.nonzero()[1].max() == 4
    assert np.array_equal(picture[~hidden], room[~hidden])
    assert median(pictures[: LEAST_FRAMES - 1], shown[: LEAST_FRAMES - 1])[1].all()


@pytest.mark.parametrize("missed", [(), (0, 2), (0, 2, 5)])
def test_people_whom_a_detector_misses_are_not_in_the_clean_picture(missed: tuple[int, ...]):
    room = texture(7, (60, 80)).numpy()
    noise = np.random.default_rng(0)
    shown = np.ones((9, 60, 80), dtype=bool)
    pictures = np.stack([(room + 0.01 * noise.normal(size=room.shape)).clip(0, 1)] * 9)
    for k in range(9):
        pictures[k, 15:50, 8 * k : 8 * k + 14] = 0.9
        shown[k, 15:50, 8 * k : 8 * k + 14] = k in missed
    picture, hidden = median((pictures * 255).round().astype(np.uint8), shown)
    assert not hidden.any()
    assert np.abs(picture / 255 - room).max() < 0.06


def test_the_lens_comes_from_the_file_the_angle_or_the_photo(tmp_path: Path):
    (tmp_path / "geo.json").write_text('{"f": 700, "pitch": -0.2, "roll": 0.05}')
    at, text = lens_of((640, 480), tmp_path / "geo.json")
    assert (at.value["fl_x"], text) == (700, None)
    up = np.array(at.value["R_cam_world"])[:, 1]
    assert math.asin(up[2]) == pytest.approx(-0.2)
    at, _ = lens_of((640, 480), fov=90.0)
    assert at.value["fl_x"] == pytest.approx(320)
    assert at.value["focal_spread"] == GUESSED
    picture = Image.new("RGB", (36, 24))
    exif = picture.getexif()
    exif.get_ifd(0x8769)[0xA405] = 28
    picture.save(tmp_path / "p.jpg", exif=exif)
    at, text = lens_of((3600, 2400), tmp_path / "p.jpg")
    assert (at.value["fl_x"], text) == (pytest.approx(2800), None)
    photo = Video(tmp_path / "p.jpg", tilt=(-10.0, 2.0, 0.5), camera_height=1.3)
    known, _ = camera_by(photo, (3600, 2400))
    assert (known.value["fl_x"], known.value["height"]) == (pytest.approx(2800), 1.3)
    turn = pitch_roll(torch.tensor(known.value["R_cam_world"]))
    assert [math.degrees(float(a)) for a in turn] == pytest.approx([-10, 2], abs=1e-4)
    assert known.value["tilt_spread"] == pytest.approx(math.radians(0.5))
    _, text = lens_of((3600, 2400))
    assert "--fov" in (text or "")


@pytest.mark.slow
@pytest.mark.skipif(not BEDROOM.exists(), reason="shared/data is not there")
def test_the_swaying_bedroom_is_steadied(tmp_path: Path):
    pytest.importorskip("av")
    raw = take(BEDROOM, tmp_path / "raw", FramesConfig(fps=5))
    assert (raw.width, raw.height, raw.fps, len(raw.time)) == (960, 540, 5.0, 34)
    drift = find_drift(raw)
    assert drift.verdict == "sways"
    assert away(drift, -1, np.array([[480.0, 270.0]])) == pytest.approx(56, abs=3)
    steady = steady_frames(raw, drift, tmp_path / "steady")
    wall = (slice(60, 300), slice(620, 720))  # stripes, shelf and candle, where no child jumps
    for a, b in ((0, 33), (10, 25)):
        before = (load_frame(raw.path(a)) - load_frame(raw.path(b)))[wall].abs().mean()
        after = (load_frame(steady.path(a)) - load_frame(steady.path(b)))[wall].abs().mean()
        assert after < 0.5 * before
