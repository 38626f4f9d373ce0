"""PROX as it really is: stills under their real names, several recordings, body indices, gaps.

The names are those of public code that reads the data set (see make_scenes.prox_stem): in the
quantitative part each still is the first frame of a shot of its own.
"""

import json
import shutil
from pathlib import Path

import make_people as made
import make_scenes as layouts
import numpy as np
import pytest
import torch
from PIL import Image
from test_import_datasets import prox_room
from test_import_scenes import check_truth, imported
from test_import_scenes import plain as plain  # the fixture
from test_readers_people import models as models  # the fixture: the body that the fits are of

from mover.core.errors import InputError
from mover.core.types import Masks
from mover.geometry.rle import decode
from mover.io.capture.bodies_file import read_bodies
from mover.io.people.values import frame_numbers
from mover_bench.datasets.prox_files import read_body_index

FIRST, SECOND = "vicon_03301_01", "vicon_03301_02"
SHIFT = np.array([1.0, 2.0, 1.5])


def write_fits(root: Path, recording: str, frames: int, kinds: tuple[str, ...]) -> None:
    """PROX's results/<frame>/000.pkl of every frame, of the true people under an identity."""
    for kind in kinds:
        for k in range(frames):
            file = root / kind / recording / "results" / layouts.prox_stem(recording, k) / "000.pkl"
            made.store({**made.fit(k), "gender": "male"}, file)


@pytest.fixture(scope="module")
def stills(plain: layouts.Room, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two recordings of the quantitative room: three and two stills, with fits and MoSh."""
    return write_stills(tmp_path_factory.mktemp("quantitative"), prox_room(plain))


def write_stills(root: Path, room: layouts.Room) -> Path:
    """PROX's quantitative part of a room, people in the camera's axes whatever its tilt."""
    for name, frames in ((FIRST, 3), (SECOND, 2)):
        layouts.write_prox(root, room, name, frames, SHIFT)
        write_fits(root, name, frames, ("fittings/PROX", "fittings/mosh"))
    world = np.eye(4).tolist()
    (root / "vicon2scene.json").write_text(json.dumps(world))
    return root


def mask_of(row: dict) -> torch.Tensor:
    """The mask of a row of people.json."""
    coded = row["segmentation"]
    return decode(Masks(*coded["size"], (coded["counts"].encode(),)), 0)


def rows_of(folder: Path) -> dict[str, dict]:
    return json.loads((folder / "people.json").read_text())


def test_several_recordings_of_one_room_are_one_capture(stills, plain, tmp_path):
    out = tmp_path / "out"
    boxes = stills / "boxes" / "bbox3d.json"
    found = imported("prox", stills, out, tmp_path, recordings=(FIRST, SECOND), boxes=boxes)
    assert sorted(p.name for p in (out / "frames").iterdir()) == [f"{k:06d}.jpg" for k in range(5)]
    bodies, true = read_bodies(out / "bodies.npz"), read_bodies(out / "truth" / "bodies.npz")
    assert bodies.frame.tolist() == true.frame.tolist() == [0, 1, 2, 3, 4]
    assert bodies.person.unique().tolist() == [0]  # both are of subject 03301
    assert bodies.fps is None  # shots have no common clock
    assert [row["image_id"] for row in rows_of(out)["annotations"]] == [0, 1, 2, 3, 4]
    people = made.person("smplx")["verts"]
    wanted = torch.from_numpy(people[[0, 1, 2, 0, 1]]).float()
    torch.testing.assert_close(bodies.verts, wanted, atol=1e-4, rtol=0)
    assert len(list((out / "keypoints").iterdir())) == 5
    check_truth(out / "truth", prox_room(plain))
    assert f"{SECOND}: 2 stills, 3 to 4 of the capture" in found.notes
    whole = tmp_path / "whole"
    imported("prox", stills, whole, tmp_path, recordings=("vicon",))
    assert rows_of(whole) == rows_of(out)


def test_videos_follow_one_another_with_a_minute_between(plain, tmp_path):
    root, names = tmp_path / "prox", ("MPH8_00034_01", "MPH8_00168_02")
    for name in names:
        layouts.write_prox(root, prox_room(plain), name, 2, SHIFT)
        write_fits(root, name, 2, ("PROXD",))
    imported("prox", root, tmp_path / "out", tmp_path, recordings=names)
    bodies = read_bodies(tmp_path / "out" / "bodies.npz")
    assert bodies.frame.tolist() == [0, 1, 1802, 1803]
    assert bodies.person.tolist() == [0, 0, 1, 1]
    assert bodies.fps == 30
    tracks = [(r["image_id"], r["track_id"]) for r in rows_of(tmp_path / "out")["annotations"]]
    assert tracks == [(0, 0), (1, 0), (1802, 1), (1803, 1)]


def test_body_indices_are_masks_of_the_flipped_pictures(stills: Path, tmp_path: Path) -> None:
    imported("prox", stills, tmp_path / "out", tmp_path, recording=FIRST)
    wanted = torch.zeros(1080, 1920, dtype=torch.bool)
    wanted[200:700, 1920 - 410 : 1920 - 310] = True
    assert torch.equal(mask_of(rows_of(tmp_path / "out")["annotations"][1]), wanted)


def test_the_reference_is_the_emptiest_picture_and_who_is_in_it_is_masked(stills, tmp_path):
    root = shutil.copytree(stills, tmp_path / "p")
    stem = layouts.prox_stem(FIRST, 1)
    pixels = np.full((1080, 1920), 255, dtype=np.uint8)
    pixels[300:310, 400:420] = 0
    Image.fromarray(pixels).save(root / "recordings" / FIRST / "BodyIndexColor" / f"{stem}.png")
    color = root / "recordings" / FIRST / "Color" / f"{stem}.jpg"
    Image.new("RGB", (1920, 1080), (200, 10, 10)).save(color)
    found = imported("prox", root, tmp_path / "out", tmp_path, recording=FIRST)
    assert (
        "the reference image is frame 1, the emptiest: it has people on 0.0% of it" in found.notes
    )
    reference = next((tmp_path / "out").glob("reference.*"))
    with Image.open(reference) as picture:
        assert np.abs(np.asarray(picture.convert("RGB"))[5, 5] - [200, 10, 10]).max() < 20
    (row,) = rows_of(tmp_path / "out")["reference_people"]
    wanted = torch.zeros(1080, 1920, dtype=torch.bool)
    wanted[300:310, 1500:1520] = True
    assert torch.equal(mask_of(row), wanted)


@pytest.mark.parametrize(("pixels", "said"), [
    (np.full((1080, 1920), 128), "has the number 128, expected bodies 0 to 5, and 255"),
    (
        np.zeros((1080, 1920)),
        "100% of the picture is a body, expected 255 where there is no person",
    ),
    (np.full((424, 512), 255), "has 512 x 424 pixels, expected 1920 x 1080"),
])  # fmt: skip
def test_what_is_no_body_index_is_refused(pixels: np.ndarray, said: str, tmp_path: Path) -> None:
    Image.fromarray(pixels.astype(np.uint8)).save(tmp_path / "a.png")
    with pytest.raises(InputError, match=said):
        read_body_index(tmp_path / "a.png")


def test_a_recording_that_would_collapse_is_refused(plain: layouts.Room, tmp_path: Path) -> None:
    name = "MPH8_00034_01"
    root = layouts.write_prox(tmp_path / "p", prox_room(plain), name, 2, SHIFT)
    color = root / "recordings" / name / "Color"
    first = color / "s001_frame_00001__00.00.00.000.jpg"
    shutil.copy(first, color / "s001_frame_00001__00.00.09.999.jpg")
    with pytest.raises(InputError, match=r"00.00.00.000 and .*00.00.09.999 are both frame 1"):
        imported("prox", root, tmp_path / "out", tmp_path, recording=name)
    (color / "s001_frame_00001__00.00.09.999.jpg").rename(first.with_suffix(".png"))
    with pytest.raises(InputError, match="are one frame"):
        imported("prox", root, tmp_path / "out", tmp_path, recording=name)


def test_frames_are_numbers_of_a_video_or_places_among_stills() -> None:
    assert frame_numbers(["000007", "000003"], "x") == {"000003": 3, "000007": 7}
    video = [f"s001_frame_{k:05d}__00.00.00.{k}23" for k in (4, 12)]
    assert frame_numbers(video, "x") == {video[0]: 4, video[1]: 12}
    shots = ["s010_frame_00001__0.1", "s002_frame_00001__0.2", "s001_frame_00001__0.3"]
    assert frame_numbers(shots, "x") == {shots[2]: 1, shots[1]: 2, shots[0]: 3}


def test_a_recording_of_another_room_is_refused(stills: Path, tmp_path: Path) -> None:
    (stills / "recordings" / "MPH8_00034_01" / "Color").mkdir(parents=True)
    with pytest.raises(InputError, match="of vicon, MPH8_00034_01 of MPH8, expected recordings"):
        imported("prox", stills, tmp_path / "o", tmp_path, recordings=(FIRST, "MPH8_00034_01"))
    with pytest.raises(InputError, match="MPH8_00034_01: has no frames"):
        imported("prox", stills, tmp_path / "o", tmp_path, recording="MPH8_00034_01")
    shutil.rmtree(stills / "recordings" / "MPH8_00034_01")


@pytest.mark.parametrize(("part", "said"), [
    ("recordings/vicon_03301_01/Color", "no pictures"),
    ("recordings/vicon_03301_01/BodyIndexColor", "no depth order"),
    ("keypoints/vicon_03301_01", "`mover fit` has nothing to fit"),
    ("fittings/PROX/vicon_03301_01", "only the image speaks"),
    ("fittings/mosh/vicon_03301_01", "no true bodies"),
    ("cam2world", "no truth of the camera"),
    ("scenes", "the truth has no floor"),
])  # fmt: skip
def test_a_missing_part_is_named_and_the_rest_still_works(part, said, stills, tmp_path):
    root = shutil.copytree(stills, tmp_path / "p")
    shutil.rmtree(root / part)
    found = imported("prox", root, tmp_path / "out", tmp_path, recording=FIRST)
    line = next(note for note in found.notes if said in note)
    assert line.startswith(part)
    assert "missing" in line
    assert (tmp_path / "out" / "camera.json").is_file()
    assert (tmp_path / "out" / "truth").exists() == (part != "cam2world")
