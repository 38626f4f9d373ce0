"""PROX and PiGraphs from files in their exact layout.

The names of PROX are those of public code that reads the data set (see make_scenes.prox_stem): in
the quantitative part each still is the first frame of a shot of its own.
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
from test_import_scenes import check_truth, imported
from test_import_scenes import plain as plain  # the fixture
from test_readers_people import models as models  # the fixture: the body that the fits are of

import mover.io.formats
from mover.app.cli import run_command
from mover.core.errors import InputError
from mover.core.types import Masks
from mover.geometry.placement import place_object
from mover.geometry.rle import decode
from mover.io.capture.bodies_file import read_bodies
from mover.io.capture.evidence import gather_evidence
from mover.io.capture.folder import read_capture
from mover.io.capture.scene_file import read_scene
from mover.io.formats import names
from mover.io.people.values import frame_numbers
from mover_bench.datasets.pigraphs import NAMES, capsule_people, read_segments
from mover_bench.datasets.prox_files import read_body_index, recordings_of
from mover_bench.datasets.true_boxes import FLOOR

RECORDING = "MPH8_00034_01"


def prox_room(plain: layouts.Room) -> layouts.Room:
    """The room under PROX's picture size."""
    K = np.diag([1920 / plain.size[0]] * 2 + [1]) @ plain.K
    return layouts.Room(K, plain.R, (1920, 1080), plain.ground, plain.things)


@pytest.fixture(scope="module")
def prox(plain, tmp_path_factory):
    root = tmp_path_factory.mktemp("prox")
    room = prox_room(plain)
    layouts.write_prox(root, room, RECORDING, 3)
    (root / "recordings" / "N0SittingBooth_00162_01" / "Color").mkdir(parents=True)
    return root


def test_prox_gives_flipped_frames_its_lens_and_the_truth(prox, plain, tmp_path):
    out, room = tmp_path / "out", prox_room(plain)
    boxes = prox / "boxes" / "bbox3d.json"
    imported("prox", prox, out, tmp_path, recording=RECORDING, boxes=boxes)
    lens = json.loads((out / "camera.json").read_text())
    assert lens["cx"] == pytest.approx(room.K[0, 2], abs=1e-6)
    assert "R_cam_world" not in lens  # the truth stays in truth/
    names = sorted(p.name for p in (out / "frames").iterdir())
    assert names == ["000000.jpg", "000001.jpg", "000002.jpg"]
    with Image.open(out / "frames" / "000000.jpg") as picture:
        flipped = np.asarray(picture).astype(int)
    assert np.abs(flipped - np.asarray(layouts.picture(room.size)).astype(int)).mean() < 3
    check_truth(out / "truth", room)
    check_scan(out / "truth_scan", room)
    check_keypoints(out / "keypoints" / "000001_keypoints.json")


def check_scan(folder: Path, room: layouts.Room) -> None:
    """What the scan has in the boxes are the objects themselves above the floor, and no floor."""
    truth = read_scene(folder / "scene.json")
    for piece, thing in zip(truth.objects, room.things, strict=True):
        mesh = place_object(piece)
        verts = mesh.verts.numpy()
        gap = np.linalg.norm(thing.world[:, None] - verts[None], axis=-1).min(1)
        above = thing.world[:, 1] - truth.ground > FLOOR
        assert above.any()
        assert gap[above].max() < 1e-3, thing.name
        assert (verts[mesh.faces.numpy()][..., 1].max(1) - truth.ground > 0.9 * FLOOR).all()


def check_keypoints(file: Path) -> None:
    """Those of mirrored pictures change sides."""
    (person,) = json.loads(file.read_text())["people"]
    joints = np.array(person["pose_keypoints_2d"]).reshape(-1, 3)
    assert joints[7].tolist() == [1920 - 101, 200, 0.9]  # the left wrist
    assert not joints[4].any()
    hands = [np.array(person[f"hand_{s}_keypoints_2d"]) for s in ("right", "left")]
    assert hands[0].any()
    assert not hands[1].any()


def test_axes_by_columns_are_understood(prox, plain, tmp_path):
    layouts.write_truth(tmp_path, prox_room(plain), columns=True)
    boxes = tmp_path / "bbox3d.json"
    imported("prox", prox, tmp_path / "out", tmp_path, recording=RECORDING, boxes=boxes)
    check_truth(tmp_path / "out" / "truth", prox_room(plain))


def test_booths_are_left_out_and_an_unknown_recording_is_named_with_those_there_are(prox, tmp_path):
    assert recordings_of(prox) == [RECORDING]
    with pytest.raises(InputError, match=RECORDING):
        imported("prox", prox, tmp_path / "out", tmp_path, recording="MPH11_1_1")


def walking(frames: int) -> np.ndarray:
    """Skeletons of Kinect in the camera's axes: they walk to the right of the picture."""
    joints = np.zeros((frames, 25, 3))
    heights = {0: 0.9, 1: 1.2, 2: 1.5, 3: 1.65, 20: 1.4, 12: 0.9, 16: 0.9, 13: 0.5, 17: 0.5,
               14: 0.1, 18: 0.1, 15: 0.03, 19: 0.03}  # fmt: skip
    for j in range(25):
        joints[:, j, 1] = 1.4 - heights.get(j, 1.1)
        side = 1 if j in (4, 5, 6, 7, 12, 13, 14, 15, 21, 22) else -1
        joints[:, j, 0] = 0.15 * side if j not in (0, 1, 2, 3, 20) else 0
    joints[..., 2] = 3.0
    joints[..., 0] += 0.1 * np.arange(frames)[:, None]
    return joints


@pytest.mark.parametrize("mirror", [False, True])
def test_pigraphs_gives_skeletons_with_skin_and_the_truth(plain, tmp_path, mirror):
    joints = walking(4)
    name = "3bHallway_mati2_2014-04-30-22-46-22"
    things = [t for t in plain.things if t.category in ("chair", "bed", "desk", "cabinet", "sofa")]
    room = layouts.Room(plain.K, plain.R, plain.size, plain.ground, things)
    layouts.write_pigraphs(tmp_path / "in", room, name, joints, mirror=mirror)
    source = layouts.write_glb(tmp_path / "in.glb", plain)
    imported("glb", source, tmp_path / "out", tmp_path)
    found = imported("pigraphs", tmp_path / "in", tmp_path / "out", tmp_path, recording=name)
    assert any("mirrored" in note for note in found.notes) != mirror
    capture = read_capture(tmp_path / "out")
    assert np.allclose(capture.bodies.joints.numpy(), joints, atol=1e-5)
    assert capture.bodies.frame.tolist() == [0, 1, 2, 3]
    gap = torch.cdist(capture.bodies.verts[2], capture.bodies.joints[2]).amin(0)
    assert float(gap[[0, 3, 13, 17]].max()) < 0.15
    check_truth(tmp_path / "out" / "truth", room)
    gather_evidence(capture)


def test_capsules_are_closed_and_outward():
    arrays = capsule_people([(0, 0, walking(1)[0])], np.eye(3), 5.0)
    verts, faces = arrays["vertices"][0].astype(float), arrays["faces"]
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    assert {tuple(e) for e in edges.tolist()} == {tuple(e[::-1]) for e in edges.tolist()}
    volume = np.einsum("ij,ij->i", verts[faces[:, 0]],
                       np.cross(verts[faces[:, 1]], verts[faces[:, 2]])).sum() / 6  # fmt: skip
    assert 0.03 < volume < 0.2
    assert len(NAMES) == 25


def test_parts_of_an_object_become_one_box(plain, tmp_path):
    layouts.write_pigraphs(tmp_path, plain, "room_a_b", walking(1), mirror=False)
    boxes = read_segments(tmp_path / "roomd.segs.json")
    known = [t for t in plain.things if t.category not in ("shelves", "lamp", "night_stand")]
    assert len(boxes) == len(known)
    for box, thing in zip(boxes, known, strict=True):
        assert np.allclose(sorted(2 * box.half), sorted(thing.size), atol=1e-6)


def test_without_the_bench_the_command_says_where_data_sets_are_read(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(mover.io.formats, "find_spec", lambda _: None)
    for name in names("dataset"):
        assert run_command("import", [name, str(tmp_path), "--out", str(tmp_path / "out")]) == 2
        said = capsys.readouterr().err
        assert f"{name}: is read by mover_bench, which is not part of the installed package" in said


FIRST, SECOND = "vicon_03301_01", "vicon_03301_02"


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
        layouts.write_prox(root, room, name, frames)
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
        layouts.write_prox(root, prox_room(plain), name, 2)
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
    root = layouts.write_prox(tmp_path / "p", prox_room(plain), name, 2)
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
