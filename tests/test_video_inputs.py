"""Videos as people film them: turned, uneven, short, long, cut, without people or furniture."""

import json
import re
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from filmed import (
    FIGURE,
    FINDERS,
    NO_FINDERS,
    H,
    Shot,
    W,
    filmed,
    instances,
    take,
    turned_film,
    walk,
    write_film,
)
from PIL import Image

from mover.app.cli.video import VideoArgs, video_to_room
from mover.core.errors import InputError
from mover.core.observe import Observer, silent
from mover.core.run import Run
from mover.core.types import Keypoints, Masks, People, Scene
from mover.geometry.rle import decode, tight_box
from mover.io.capture.bodies_file import read_bodies
from mover.io.capture.scene_file import read_scene
from mover.io.people.keypoints import read_keypoints, write_keypoints
from mover.perceive import mediapipe
from mover.perceive.capture import Finders, perceive, read_picture_of
from mover.perceive.config import FramesConfig, PerceiveConfig
from mover.perceive.mediapipe import PoseInputs
from mover.perceive.networks import Finds, link_people
from mover.perceive.own import Video, own_objects, swaps
from mover.perceive.steady import Drift
from mover.perceive.video import Clip
from mover.stages.camera import find_lens

pytest.importorskip("cv2")
SECOND = 30


@pytest.fixture(autouse=True)
def rough(monkeypatch):
    """The lens is not asked for here: its error is estimated from few halves of the lines."""
    monkeypatch.setattr(find_lens, "HALVES", 2)


def perceived(source: Path, out: Path, fps: float = 5.0, lens: Path | None = None) -> Path:
    config = PerceiveConfig(FramesConfig(fps=fps))
    video = Video(source, lens, 60.0 if lens is None else None)
    perceive(video, out, config, Run(out / "perceived"), print, FINDERS)
    return out


def rows(capture: Path, name: str) -> list[dict[str, Any]]:
    return json.loads((capture / name).read_text())["annotations"]


@pytest.mark.slow
@pytest.mark.parametrize("turns", [1, 2, 3])
@pytest.mark.parametrize("tall", [False, True])
def test_a_phone_that_was_turned_gives_what_an_upright_one_gives(tmp_path, turns, tall):
    shot, times = Shot(tall=tall), range(0, SECOND, 3)
    upright = perceived(filmed(tmp_path / "a.mp4", shot, times), tmp_path / "upright")
    turned = perceived(
        turned_film(tmp_path / "b.mp4", [shot.at(t / 30) for t in times], times, turns),
        tmp_path / "turned",
    )
    cameras = [json.loads((c / "camera.json").read_text()) for c in (upright, turned)]
    assert cameras[0] == cameras[1]
    assert (cameras[1]["h"], cameras[1]["w"]) == shot.size
    (chair,), (found,) = rows(upright, "objects.json"), rows(turned, "objects.json")
    assert found["bbox"] == pytest.approx(chair["bbox"], abs=2)
    assert len(rows(upright, "people.json")) == len(rows(turned, "people.json")) == len(times) // 2
    one, other = (read_keypoints(c / "keypoints.npz") for c in (upright, turned))
    assert torch.equal(one.frame, other.frame)
    assert (one.points - other.points).abs().max() < 2


def test_what_moves_evenly_moves_evenly_in_an_uneven_video(tmp_path: Path):
    dim = range(SECOND, 3 * SECOND, 5)  # phones take fewer frames where it is dark
    times = [*range(SECOND), *dim, *range(4 * SECOND, 5 * SECOND)]  # and none for a second
    capture = perceived(filmed(tmp_path / "v.mp4", Shot(), times), tmp_path / "c", fps=10)
    found = read_keypoints(capture / "keypoints.npz")
    true = torch.tensor([walk(float(t)) for t in found.frame / found.fps])
    middle = found.points[..., 0].mean(-1) - 10
    assert (middle - true).abs().max() < 12 * 0.5 / 10 + 1  # half a step of the clock, and a pixel
    assert int(found.frame.max()) == 10 * 5
    shown = json.loads((capture / "people.json").read_text())["images"]
    assert [image["id"] for image in shown] == found.frame.tolist()
    assert len(found.frame) < 40
    names = sorted(path.name for path in (capture / "frames").iterdir())
    assert names == [f"{frame:06d}.jpg" for frame in found.frame.tolist()]


@pytest.mark.parametrize(("gap", "fps"), [(15, 5.0), (15, 0.0), (1, 0.0)])
def test_of_a_slow_video_or_at_its_own_rate_all_frames_are_taken_at_their_times(tmp_path, gap, fps):
    times = [*range(0, 20 * gap, gap), *range(60 * gap, 70 * gap, gap)]  # a pause between
    film = filmed(tmp_path / "v.mp4", Shot(), times)
    clip = take(film, tmp_path / "f", FramesConfig(fps=fps))
    assert clip.fps == pytest.approx(SECOND / gap)
    assert clip.numbers.tolist() == [*range(20), *range(60, 70)]
    assert clip.time.tolist() == pytest.approx([t / SECOND for t in times], abs=1e-3)


@pytest.mark.slow
def test_another_video_in_the_same_folder_leaves_nothing_of_the_first(tmp_path: Path):
    perceived(filmed(tmp_path / "v.mp4", Shot(), range(0, 2 * SECOND, 3)), tmp_path / "c")
    assert (tmp_path / "c" / "keypoints.npz").is_file()
    empty = filmed(tmp_path / "w.mp4", Shot(person=False), range(0, SECOND, 3))
    perceived(empty, tmp_path / "c")
    assert len(list((tmp_path / "c" / "frames").iterdir())) == 5
    assert not (tmp_path / "c" / "keypoints.npz").exists()


def absent(_clip: Clip, _config: PerceiveConfig, _: Observer = silent) -> Finds:
    raise InputError("no network")


@pytest.mark.slow
def test_what_replaced_a_file_stays_until_a_new_flag_gives_it(tmp_path: Path, capsys):
    """What was removed is made again; of another video that is said."""
    for name, shot in (("v", Shot()), ("w", Shot(1))):
        filmed(tmp_path / f"{name}.mp4", shot, range(0, SECOND, 3))
    for name in "ab":
        shape = {"label": name, "points": [[50, 40], [80, 40], [80, 70]], "shape_type": "polygon"}
        tree = {"imageWidth": W, "imageHeight": H, "shapes": [shape]}
        (tmp_path / f"{name}.json").write_text(json.dumps(tree))
    (tmp_path / "none.npz").write_text("")  # no bodies: each run ends before they are written
    capture = tmp_path / "out" / "capture"
    files = [capture / n for n in ("objects.json", "people.json", "keypoints.npz", "camera.json")]

    def again(video: str = "v", **flags: Any) -> tuple[list[bytes | None], str]:
        """The files after a run, and what it says."""
        args = VideoArgs(tmp_path / f"{video}.mp4", tmp_path / "out", **flags)
        with pytest.raises(InputError, match=r"none\.npz: cannot be read"):
            video_to_room(replace(args, bodies=str(tmp_path / "none.npz")), FINDERS)
        return [f.read_bytes() for f in files], capsys.readouterr().out

    again(fov=60.0)
    made, _ = again(fov=60.0, objects=tmp_path / "a.json")
    joints = read_keypoints(files[2])
    write_keypoints(replace(joints, points=joints.points + 1), files[2])
    for file in (files[0], files[1], files[3]):
        file.write_text(file.read_text() + " ")
    own = [file.read_bytes() for file in files]
    stays = "is yours and stays"
    for video, flags in (
        ("v", {}), ("v", {"fov": 60.0}), ("w", {"fov": 60.0, "objects": tmp_path / "a.json"})
    ):  # fmt: skip
        found, said = again(video, **flags)
        assert found == own
        assert said.count(stays) == 4
        assert said.count("though the video") == (4 if video == "w" else 0)
    found, said = again(fov=70.0, objects=tmp_path / "b.json")
    assert found[1:3] == own[1:3]
    assert b'"b"' in found[0]
    assert found[3] != own[3]
    assert (said.count("was yours"), said.count(stays)) == (2, 2)
    files[2].unlink()
    assert again(fov=70.0, objects=tmp_path / "b.json")[0][2] == made[2]


SWAY = [(0, 0), (3, 1), (5, 2), (4, 1), (2, 0), (0, 0)]
"""Where in the world the pictures of a swaying camera begin [px]."""


def test_joints_masks_and_outlines_in_pixels_of_a_swaying_video_are_carried_along(tmp_path: Path):
    """Each file counts the frames of the video; the people's numbers are those of the masks."""
    shots = [Shot(look=(4 + x, 4 + y)) for x, y in SWAY for _ in range(2)]  # each is there twice
    pictures = [shot.at(0.2 * (k // 2)) for k, shot in enumerate(shots)]
    film = write_film(tmp_path / "v.mp4", pictures, range(0, 3 * len(pictures), 3))
    boxes = [(round(walk(0.2 * k)), H - 70, 20, 62) for k in range(len(SWAY))]  # x, y, w, h
    joints, images, people = [], [], []
    for k, (x, y, w, h) in enumerate(boxes):
        points = [v for a, b in FIGURE for v in (x + a * w - 0.5, y + b * h - 0.5, 1.0)]
        images.append({"id": 2 * k, "width": W, "height": H})
        outline = [[x, y, x + w, y, x + w, y + h, x, y + h]]
        row = {"id": k, "image_id": 2 * k, "category_id": 1}
        people.append({**row, "track_id": 5, "bbox": [x, y, w, h], "segmentation": outline})
        joints.append({"image_id": 2 * k, "keypoints": points, "score": 1.0, "track_id": 2})
    names = [{"id": 1, "name": "person"}]
    masks = {"images": images, "annotations": people, "categories": names}
    chair = [[W - 34, H - 40], [W - 10, H - 40], [W - 10, H - 12], [W - 34, H - 12]]
    shape = {"label": "chair", "points": chair, "shape_type": "polygon"}
    labelme = {"imageWidth": W, "imageHeight": H, "shapes": [shape]}
    for name, tree in (("joints", joints), ("masks", masks), ("chair", labelme)):
        (tmp_path / f"{name}.json").write_text(json.dumps(tree))
    out, said = tmp_path / "c", list[str]()
    video = Video(
        film, fov=60.0, keypoints=lambda: tmp_path / "joints.json", masks=tmp_path / "masks.json",
        objects=tmp_path / "chair.json", objects_frame=4,
    )  # fmt: skip
    rest = PerceiveConfig(), Run(out / "perceived"), said.append, NO_FINDERS
    perceive(video, out, *rest)
    (reference,) = re.findall(r"sways .* onto frame (\d+)", "\n".join(said))
    at = SWAY[int(reference)]
    found = read_keypoints(out / "keypoints.npz")
    assert found.frame.tolist() == list(range(len(SWAY)))
    assert found.person.tolist() == [5] * len(SWAY)
    for k, (x, y, w, h) in enumerate(boxes):
        true = np.add((x, y), FIGURE * (w, h)) + np.subtract(SWAY[k], at)
        assert np.abs(found.points[k].numpy() - true).max() < 0.7
    for k, row in enumerate(rows(out, "people.json")):
        mask = decode(Masks(H, W, (row["segmentation"]["counts"].encode(),)), 0)
        left, top = np.add(boxes[k][:2], np.subtract(SWAY[k], at))
        right = left + 20, top + 62
        assert tight_box(mask).tolist() == pytest.approx([left, top, *right], abs=1.5)
        assert (row["image_id"], row["track_id"]) == (k, 5)
    assert read_picture_of(out).reference is not None
    (row,) = rows(out, "objects.json")
    assert row["bbox"] == pytest.approx([W - 34 + 5 - at[0], H - 40 + 2 - at[1], 24, 28], abs=1.5)
    whole = {"segmentation": [[0, 0, W, 0, W, H, 0, H]]}
    (tmp_path / "full.json").write_text(
        json.dumps({**masks, "annotations": [{**row, **whole} for row in people]})
    )
    with pytest.raises(InputError, match=r"full\.json: masks cover 100% .* invert them"):
        perceive(replace(video, masks=tmp_path / "full.json"), out, *rest)
    for zoom, shift, words in (
        (0.5, 0, rf"masks\.json, .* of about 6\d x (4[6-9]|50) pixels: .* of {W} x {H}"),
        (1, 60, r"masks\.json, .* both of this video, and their frames counted from 0"),
    ):
        points = [np.reshape(row["keypoints"], (-1, 3)) * (zoom, zoom, 1) for row in joints]
        points = [np.add(xy, (shift, 0, 0)).tolist() for xy in points]
        other = [{**row, "keypoints": p} for row, p in zip(joints, points, strict=True)]
        (tmp_path / "joints.json").write_text(json.dumps(other))
        with pytest.raises(InputError, match=words):
            perceive(video, out, *rest)
    (tmp_path / "joints.json").write_text(json.dumps([{**joints[0], "image_id": 1}]))
    with pytest.raises(InputError, match=r"none of the frames .* expected 0, 2, 4, 6"):
        perceive(video, out, *rest)


def test_files_that_count_frames_at_another_rate_are_taken_by_their_rate_or_refused(tmp_path: Path):
    """So what a capture has may be handed in again with its video."""
    film = filmed(tmp_path / "v.mp4", Shot(), range(0, 57, 3))  # ten a second
    first, said = perceived(film, tmp_path / "c"), list[str]()
    file, out = first / "keypoints.npz", tmp_path / "d"
    video = Video(film, fov=60.0, keypoints=lambda: file, masks=first / "people.json")
    perceive(video, out, PerceiveConfig(), Run(out / "perceived"), said.append, FINDERS)
    one, other = (read_keypoints(c / "keypoints.npz") for c in (first, out))
    assert torch.equal(one.frame, other.frame)
    assert (one.points - other.points).abs().max() < 2  # who walks goes 2.4 px a frame
    shown = [[row["image_id"] for row in rows(c, "people.json")] for c in (first, out)]
    assert shown[0] == shown[1] == one.frame.tolist()
    what = "has 'fps' 5, expected 10 as in v.mp4: frame 1 of it is taken as frame 2 of the video"
    for name in ("keypoints.npz", "people.json"):
        assert f"warning: {name}: {what}" in said
    file = tmp_path / "other.npz"
    write_keypoints(replace(one, fps=7.0), file)
    with pytest.raises(InputError, match=r"other\.npz: has 'fps' 7, expected 10 .* number frames"):
        perceive(video, out, PerceiveConfig(), Run(out / "perceived"), print, FINDERS)


def test_people_whose_numbers_are_exchanged_are_said_with_the_frame():
    """Not such as pass each other, or as stand where they cannot be told apart."""
    frame = torch.arange(6).repeat_interleave(2)
    x = torch.tensor([[0.0, 200.0 - 20 * k] for k in range(6)])  # one walks to the other
    place = torch.stack([x, torch.zeros_like(x)], -1).flatten(0, 1)
    points = place[:, None] + torch.from_numpy(100 * FIGURE).float()
    person = torch.tensor([0, 1] * 3 + [1, 0] * 3)
    joints = Keypoints(points, torch.ones(12, 17), "coco17", frame, person, 5.0)
    assert swaps(joints) == [("0 and 1", 3)]
    assert swaps(replace(joints, person=torch.tensor([0, 1] * 6))) == []
    near = replace(joints, points=points * torch.tensor([0.05, 1.0]))
    assert swaps(near) == []


@pytest.mark.parametrize(("boxes", "frame", "words"), [
    ([(0.2, 0.3, 0.4, 0.5)], None, "REFUSED o.json: .* has a box from 0 to 1, expected pixels"),
    ([(200, 9, 20, 20)], None, "REFUSED o.json: object chair outside the picture of 128 x 96"),
    ([(9, 9, 20, 20), (200, 9, 20, 20)], None, "warning: o.json: object chair outside .* left out"),
    ([(9, 9, 20, 90)], None, "warning: o.json: outline chair beyond the picture, cut"),
    ([(9, 9, 20, 20)], 9999, "REFUSED --objects-frame: has 9999, expected .* 0 to 2"),
    ([(9, 9, 20, 20)], 3, "^$"),
])  # fmt: skip
def test_outlines_beyond_the_picture_or_of_a_frame_beyond_the_video_are_said(
    tmp_path: Path, boxes: list[tuple[float, ...]], frame: int | None, words: str
):
    rows = [{"image_id": 0, "category_id": 1, "bbox": box} for box in boxes]
    tree = {"images": [{"id": 0, "width": W, "height": H}], "annotations": rows}
    names = {"categories": [{"id": 1, "name": "chair"}]}
    (tmp_path / "o.json").write_text(json.dumps({**tree, **names}))
    clip = Clip("", W, H, torch.arange(3) / 5, 5.0)
    drift = Drift(torch.eye(3).repeat(3, 1, 1), torch.ones(3), 0, 0.0, "still")
    video, said = Video(tmp_path, objects=tmp_path / "o.json", objects_frame=frame), list[str]()
    try:
        (row,) = own_objects(video, clip, drift, said.append)["annotations"]
        assert row["bbox"] == pytest.approx([9, 9, 20, min(boxes[0][3], H - 9)])
    except InputError as error:
        said = [f"REFUSED {error}"]
    assert re.search(words, "\n".join(said))


@pytest.mark.slow
def test_without_a_network_for_furniture_all_else_is_written_and_the_outlines_are_asked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
):
    """And MediaPipe's masks and joints, or a command's joints, are all that is needed of people."""
    filmed(tmp_path / "v.mp4", Shot(), range(0, SECOND, 3))

    monkeypatch.setattr(mediapipe, "pose_inputs", lambda clip: PoseInputs(clip, ("", ""), ""))

    def poses(
        inputs: PoseInputs, _config: None, _observe: Observer = silent
    ) -> tuple[People, Keypoints]:
        tracks = link_people(instances(inputs.clip, PerceiveConfig()))
        points = torch.full((len(tracks.frame), 33, 2), 40.0)
        rows = tracks.frame, tracks.person
        return tracks, Keypoints(points, torch.ones(points.shape[:2]), "mediapipe33", *rows, None)

    finders = replace(NO_FINDERS, poses=poses, instances=absent)
    out = tmp_path / "out"
    code = (
        "import sys, json; rows = [{'image_id': k, 'keypoints': [9, 8, 1] * 17} for k in range(5)];"
        "json.dump(rows, open(sys.argv[2], 'w'))"
    )
    command = f"{sys.executable} -c {json.dumps(code)} {{frames}} {{out}}"
    for joints, layout in (("mediapipe", "mediapipe33"), (command, "coco17")):
        args = VideoArgs(tmp_path / "v.mp4", out, keypoints=joints, fov=60)
        args = args if joints == "mediapipe" else replace(args, people_masks=tmp_path / "masks")
        with pytest.raises(InputError, match=r"outline it in .*reference\.png .* --objects FILE"):
            video_to_room(args, finders)
        found = read_keypoints(out / "capture" / "keypoints.npz")
        assert found.layout == layout
        assert found.frame.tolist() == list(range(5))
        (tmp_path / "masks").mkdir(exist_ok=True)
        for k in range(0, 10, 2):
            picture = Image.new("L", (W, H), 0)
            picture.paste(1, (4, 4, 24, 40))
            picture.save(tmp_path / "masks" / f"{k:06d}.png")


def test_of_a_video_that_is_cut_the_longest_shot_is_used_and_said(tmp_path, capsys):
    shots = (Shot(1), Shot(2), Shot(1))
    ends = (1.0, 3.4, 5.0)
    times = range(0, 5 * SECOND, 6)
    pictures = [shots[sum(t / SECOND >= end for end in ends)].at(t / SECOND) for t in times]
    capture = perceived(write_film(tmp_path / "v.mp4", pictures, times), tmp_path / "c")
    told = capsys.readouterr().out
    assert "the video is cut at 1.0 s, 3.4 s" in told
    assert "the longest is used, 1.0 to 3.2 s" in told
    assert "--frames.end 1.0 or --frames.start 3.4" in told
    assert "moves" not in told
    frames = [row["image_id"] for row in rows(capture, "people.json")]
    assert frames == list(range(5, 17))
    clean = np.asarray(Image.open(capture / "reference.png").convert("L")).astype(float)
    empty = Shot(2, person=False).at(0).mean(-1)
    assert np.abs(clean - empty)[:, 70:90].mean() < 12


def test_black_frames_at_the_start_are_no_shots(tmp_path, capsys):
    pictures = [np.zeros((H, W, 3), np.uint8)] * 3 + [Shot().at(k / 5) for k in range(3, 14)]
    perceived(write_film(tmp_path / "v.mp4", pictures, range(0, 84, 6)), tmp_path / "c")
    said = next(line for line in capsys.readouterr().out.splitlines() if "is cut at" in line)
    assert said.endswith(
        "is cut at 0.6 s: the method needs one shot, and the longest is used, 0.6 to 2.6 s"
    )


def test_a_video_that_is_cut_off_or_of_another_kind_says_so(tmp_path: Path):
    film = filmed(tmp_path / "v.mp4", Shot(), range(0, SECOND, 3))
    for name, data in (("cut.mp4", film.read_bytes()[:900]), ("text.mp4", b"no video")):
        (tmp_path / name).write_bytes(data)
        words = rf"^{name}: cannot be read \(it is unfinished, damaged or of another kind: copy it"
        with pytest.raises(InputError, match=words):
            take(tmp_path / name, tmp_path / "f")


def test_a_camera_that_moves_is_said(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    times = range(0, 3 * SECOND, 6)
    pictures = [Shot(look=(4 * k, 2 * k), chair=False).at(0) for k in range(len(times))]
    perceived(write_film(tmp_path / "v.mp4", pictures, times), tmp_path / "c")
    told = capsys.readouterr().out
    assert "warning: the camera moves" in told
    assert "one that stands still" in told


def test_people_who_are_found_in_few_frames_may_be_in_the_room_and_that_is_said(tmp_path, capsys):
    pictures = [Shot(person=k < 4).at(k / 5) for k in range(10)]
    perceived(write_film(tmp_path / "v.mp4", pictures, range(0, 60, 6)), tmp_path / "c")
    assert "warning: people are found in 4 of 10 frames" in capsys.readouterr().out


def test_a_video_without_furniture_ends_with_one_sentence(tmp_path: Path):
    film = filmed(tmp_path / "v.mp4", Shot(chair=False), range(0, SECOND, 3))
    with pytest.raises(InputError, match=r"finds no furniture in it.*--score 0\.3"):
        video_to_room(VideoArgs(film, tmp_path / "out", fov=60), FINDERS)
    assert not (tmp_path / "out" / "room").exists()


def test_a_calibration_is_scaled_to_the_frames_and_of_another_format_refused(tmp_path: Path):
    file = tmp_path / "lens.json"
    lens = {"w": 640, "h": 480, "fl_x": 550, "fl_y": 560, "cx": 330, "cy": 235, "height": 1.4}
    file.write_text(json.dumps(lens))
    film = filmed(tmp_path / "v.mp4", Shot(), range(0, SECOND, 3))
    capture = perceived(film, tmp_path / "c", lens=file)
    found = json.loads((capture / "camera.json").read_text())
    expected = {"w": 128, "h": 96, "fl_x": 110, "fl_y": 112, "cx": 66, "cy": 47, "height": 1.4}
    assert {name: found[name] for name in expected} == pytest.approx(expected)
    film = filmed(tmp_path / "tall.mp4", Shot(tall=True), range(0, SECOND, 3))
    with pytest.raises(InputError, match=r"lens\.json: .*640 x 480.*96 x 128"):
        perceived(film, tmp_path / "d", lens=file)


def test_frames_without_time_stamps_are_counted(tmp_path: Path):
    film = filmed(tmp_path / "v.h264", Shot(), range(25), rate=25)  # a bare stream
    capture = perceived(film, tmp_path / "c")
    found = read_keypoints(capture / "keypoints.npz")
    assert found.frame.tolist() == list(range(6))
    true = torch.tensor([walk(min(k / 5, 0.96)) for k in range(6)])
    assert (found.points[..., 0].mean(-1) - 10 - true).abs().max() < 1.5


def room_of(args: VideoArgs, finders: Finders = FINDERS) -> Scene:
    video_to_room(args, finders)
    assert (args.out / "room" / "report.html").is_file()
    return read_scene(args.out / "room" / "scene.json")


@pytest.mark.slow
@pytest.mark.usefixtures("quick")
def test_without_people_the_picture_alone_places_the_furniture_and_that_is_said(tmp_path, capsys):
    film, out = filmed(tmp_path / "v.mp4", Shot(person=False), range(0, SECOND, 3)), tmp_path / "o"
    scene = room_of(VideoArgs(film, out, fov=60.0))
    told = capsys.readouterr().out
    assert "no person is seen in the video: only the image places the furniture" in told
    assert [piece.id for piece in scene.objects] == ["chair_0"]
    assert not (out / "room" / "bodies.npz").exists()


@pytest.mark.long
@pytest.mark.usefixtures("quick")
def test_ten_minutes_become_a_room(tmp_path: Path):
    times = range(0, 600 * SECOND, 3 * SECOND)  # the picture changes every three seconds
    film, out = filmed(tmp_path / "v.mp4", Shot(), times), tmp_path / "out"
    scene = room_of(VideoArgs(film, out, fov=60.0))
    assert [piece.id for piece in scene.objects] == ["chair_0"]
    found = read_keypoints(out / "capture" / "keypoints.npz")
    assert (found.frame / found.fps).tolist() == pytest.approx(
        [3.0 * k for k in range(200)], abs=0.1
    )
    bodies = read_bodies(out / "room" / "bodies.npz")
    assert bodies.fps == pytest.approx(found.fps)
    assert float(bodies.frame.max()) / found.fps > 580


@pytest.mark.long
@pytest.mark.usefixtures("quick")
def test_three_seconds_of_a_phone_held_upright_become_a_room(tmp_path: Path):
    from kept_rooms import drawn, kept

    from mover_bench.rooms.config import NoiseConfig, RoomConfig
    from mover_bench.rooms.known import draw_frame
    from mover_bench.rooms.noise import add_noise
    from mover_bench.rooms.seen import Seen

    config = RoomConfig(width=270, height=480, stay=0.3, least_frames=60)
    room = kept(drawn, 4, config)
    first = int(room.bodies.frame.min())
    pictures = [(draw_frame(room, first + k).numpy() * 255).astype(np.uint8) for k in range(15)]
    turned_film(tmp_path / "v.mp4", pictures, [6 * k for k in range(15)], 1)
    out, camera = tmp_path / "out", room.truth.camera
    K = camera.K.tolist()
    lens = {"w": 270, "h": 480, "fl_x": K[0][0], "fl_y": K[1][1], "cx": K[0][2], "cy": K[1][2]}
    (tmp_path / "lens.json").write_text(json.dumps(lens))
    args = VideoArgs(tmp_path / "v.mp4", out, camera=tmp_path / "lens.json")
    finders = Seen(room, add_noise(room, NoiseConfig(), 4), 4).finders()
    scene = room_of(args, finders)
    assert (scene.camera.width, scene.camera.height) == (270, 480)
    found = read_bodies(out / "room" / "bodies.npz")
    assert 0 < len(found.frame.unique()) <= 15
    near = [float(piece.t_world_object.norm()) for piece in scene.objects]
    true = [float(piece.t_world_object.norm()) for piece in room.truth.objects]
    assert len(near) == 4
    assert all(min(true) / 2 < distance < 2 * max(true) for distance in near)
