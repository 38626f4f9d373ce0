"""Masks as other tools and people leave them: frames, tracks, soft rims, dumps, many images."""

import json
import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from tiny_capture import compressed, runs

from mover.core.errors import InputError
from mover.core.types import Masks
from mover.geometry.rle import decode
from mover.io.masks.instance_files import read_people, read_things
from mover.io.masks.instances import Instances
from mover.io.people.found import followed

H, W = 48, 64
KEPT = (0, 1, 2, 6, 7)
"""Frames in which there is a person; between them there is none."""


def walker(frame: int, start: int = 4) -> np.ndarray:
    mask = np.zeros((H, W), dtype=bool)
    mask[10:40, start + 2 * frame : start + 2 * frame + 14] = True
    return mask


def pixels(found: Instances) -> dict[tuple[int, int | None], np.ndarray]:
    assert found.size == (W, H)
    return {(i.frame, i.track): decode(Masks(H, W, (i.mask or b"",)), 0).numpy()
            for i in found.items}  # fmt: skip


def code(mask: np.ndarray) -> dict[str, Any]:
    return {"size": [H, W], "counts": compressed(runs(mask))}


def save(folder: Path, tree: Any) -> Path:
    folder.mkdir(exist_ok=True)
    (folder / "a.json").write_text(json.dumps(tree))
    return folder / "a.json"


def white(mask: np.ndarray) -> Image.Image:
    return Image.fromarray((mask * 255).astype(np.uint8))


def of_pictures(name: str, soft: bool = False, home: str = "") -> Callable[[Path], Path]:
    """Writes a picture a frame; names have the number in their format."""

    def write(folder: Path) -> Path:
        (folder / home).mkdir(parents=True)
        for frame in KEPT:
            picture = white(walker(frame))
            if soft:
                half = picture.resize((W // 2, H // 2), Image.Resampling.LANCZOS)
                picture = half.resize((W, H), Image.Resampling.LANCZOS)
            picture.save(folder / home / name.format(frame, frame + 1))
        return folder

    return write


def results(first: int) -> Callable[[Path], Path]:
    """A list of detections of COCO without those frames in which there is no person."""

    def write(folder: Path) -> Path:
        return save(folder, [
            {"image_id": k + first, "category_id": 1, "score": 0.9, "segmentation": code(walker(k))}
            for k in KEPT
        ])  # fmt: skip

    return write


def coco(named: str, first: int) -> Callable[[Path], Path]:
    """COCO with all images, of which some have no annotation; ids from `first`."""

    def write(folder: Path) -> Path:
        images = [{"id": k + first, "width": W, "height": H, "file_name": named.format(k)}
                  for k in range(8)]  # fmt: skip
        rows = [{"id": k, "image_id": k + first, "category_id": 3, "segmentation": code(walker(k))}
                for k in KEPT]  # fmt: skip
        names = [{"id": 3, "name": "Person"}]
        return save(folder, {"images": images, "annotations": rows, "categories": names})

    return write


def segments(folder: Path) -> Path:
    """video_segments of sam2's notebooks/video_predictor_example.ipynb, pickled."""
    folder.mkdir()
    tree = {k: {1: walker(k)[None]} for k in KEPT}
    (folder / "video_segments.pkl").write_bytes(pickle.dumps(tree))
    return folder / "video_segments.pkl"


def segments_of_numpy(folder: Path) -> Path:
    """The same by np.save, with probabilities in place of logits."""
    folder.mkdir()
    tree: Any = {k: {1: np.where(walker(k)[None], 0.97, 0.02)} for k in KEPT}
    np.save(folder / "video_segments.npy", tree)
    return folder / "video_segments.npy"


def mask_data(folder: Path) -> Path:
    """mask_data/ and json_data/ of grounded_sam2_tracking_demo_with_continuous_id.py."""
    for name in ("mask_data", "json_data"):
        (folder / name).mkdir(parents=True)
    for k in KEPT:
        labels = walker(k) * 2 + (walker(k, 34) & (k < 6)) * 5
        np.save(folder / "mask_data" / f"mask_{k:05d}.npy", labels.astype(np.uint16))
        about = {
            str(n): {"instance_id": n, "class_name": name, "x1": 0, "y1": 0, "x2": 0, "y2": 0,
                     "logit": 0.0}
            for n, name in ((2, "person"), (5, "chair"))
        }  # fmt: skip
        tree = {"mask_name": f"mask_{k:05d}.npy", "mask_height": H, "mask_width": W,
                "promote_type": "mask", "labels": about}  # fmt: skip
        (folder / "json_data" / f"mask_{k:05d}.json").write_text(json.dumps(tree))
    return folder


VIDEOS = {  # how a walker is written, his track, and what is said of frames and tracks
    "frame_0001.png": (of_pictures("frame_{1:04d}.png"), 0, "white masks are one person",
                       "numbers 1 to 8 with 3 left out count from 1: 1 is frame 0"),
    "1.png": (of_pictures("{1}.png"), 0),
    "000000.jpg": (of_pictures("{0:06d}.jpg"), 0),
    "mask_00000_soft.png": (of_pictures("mask_{0:05d}.png", soft=True), 0),
    "000001/00000.png": (of_pictures("{0:05d}.png", home="000007"), 7),
    "results from 1": (results(1), 0, "image_ids 1 to 8 with 3 left out count from 1"),
    "results from 0": (results(0), 0, "people without tracks: 1, one in each frame"),
    "coco from 1": (coco("", 1), 0),
    "coco of cvat": (coco("frame_{:06d}.PNG", 1), 0),
    "segments": (segments, 1), "np.save": (segments_of_numpy, 1, "probabilities, cut at 0.5"),
    "mask_data": (mask_data, 2),
}  # fmt: skip


@pytest.mark.parametrize("way", VIDEOS)
def test_frames_keep_their_numbers_over_gaps_and_a_person_is_one_track(way, tmp_path):
    write, track, *said = VIDEOS[way]
    found = read_people(write(tmp_path / "in"), {}, None)
    assert all(any(words in note for note in found.notes) for words in said), found.notes
    assert "coco" not in way or found.frames == set(range(8))  # also those without people
    got = pixels(found)
    assert list(got) == [(frame, track) for frame in KEPT]
    for (frame, _), mask in got.items():
        off = (mask ^ walker(frame)).sum() / walker(frame).sum()
        assert off <= (0.15 if "soft" in way or "jpg" in way else 0)


BOTH = {  # how pictures of two in each frame are called, and what is said of it
    "00000/0.png": ("{0:05d}/{1}.png", "folders like 00000 are frames"),
    "frame_0001/person_1.png": ("frame_{0:04d}/person_{1}.png", "folders like frame_0000 are"),
    "0/0.png": ("{0}/{1}.png", "folders like 0 are frames"),
    "00000_0.png": ("{0:05d}_{1}.png", "names like 00000_0 are of a frame and of a person"),
    "frame_000-obj1.png": ("frame_{0:03d}-obj{1}.png", "names like frame_000-obj0 are of a frame"),
    "001/00000.png": ("{1:03d}/{0:05d}.png", ""), "1/00000.png": ("{1}/{0:05d}.png", ""),
    "person_1/0.png": ("person_{1}/{0}.png", ""), "p_001/0.png": ("p_{1:03d}/{0}.png", ""),
    "00001/00000.png": ("{1:05d}/{0:05d}.png", ""),
}  # fmt: skip


@pytest.mark.parametrize("way", BOTH)
def test_names_and_folders_are_those_of_frames_or_of_people(way, tmp_path):
    name, said = BOTH[way]
    wanted = {(k, t): walker(k, 4 + 28 * t) for k in KEPT for t in (0, 1) if (k, t) != (2, 1)}
    for (frame, track), mask in wanted.items():
        path = tmp_path / "in" / name.format(frame, track)
        path.parent.mkdir(parents=True, exist_ok=True)
        white(mask).save(path)
    found = read_people(tmp_path / "in", {}, None)
    got = pixels(found)
    assert got.keys() == wanted.keys()
    assert all((got[key] == mask).all() for key, mask in wanted.items())
    assert said in "; ".join(found.notes)
    assert bool(said) == any("like" in note for note in found.notes)


def test_things_that_are_numbered_twice_are_things_of_one_picture(tmp_path):
    for number in (0, 1):
        white(walker(0, 4 + 28 * number)).save(tmp_path / f"chair_001_{number}.png")
    found = read_things(tmp_path, {}, None)
    assert [(i.category, i.frame, i.track) for i in found.items] == [("chair", 0, None)] * 2


@pytest.mark.parametrize("boxes", [True, False])
def test_people_without_tracks_are_followed_by_place_not_by_score(boxes, tmp_path):
    """The one with the better score alternates, and so does their order (k34)."""
    rows: list[dict[str, Any]] = []
    for k in range(12):
        pair = [{"image_id": k, "category_id": 1, "segmentation": code(walker(j * k, start)),
                 **({"bbox": [0, 0, 1, 1]} if boxes else {}),
                 "score": 0.9 if (j + k) % 2 else 0.8}
                for j, start in ((0, 2), (1, 24))]  # fmt: skip
        rows += pair[:: 1 if k % 3 else -1]
    got = pixels(read_people(save(tmp_path, rows), {}, None))
    for k in range(12):
        assert (got[k, 0] == walker(0, 2)).all()
        assert (got[k, 1] == walker(k, 24)).all()


def test_people_who_cross_keep_their_tracks():
    """One comes from the left, one from the right, who is hidden for two frames."""
    rows = [(f, x) for f in range(20) for x in (94 + 40 * f, 884 - 38 * f)[: 1 + (f not in (7, 8))]]
    places = np.array([(x, 300.0) for _, x in rows])
    tracks = followed([f for f, _ in rows], places, np.full(len(rows), 300.0))
    assert tracks.tolist() == [int(x != 94 + 40 * f) for f, x in rows]


def test_a_stack_of_frames_is_a_person_and_one_of_apart_masks_are_people(tmp_path):
    np.save(tmp_path / "logits.npy", walker(0) * 2.5 - 1.2)
    (lone,) = pixels(read_people(tmp_path / "logits.npy", {}, None)).values()
    assert (lone == walker(0)).all()
    np.save(tmp_path / "frames.npy", np.stack([walker(k) for k in range(6)])[:, None])
    got = pixels(read_people(tmp_path / "frames.npy", {}, None))
    assert list(got) == [(k, 0) for k in range(6)]
    np.save(tmp_path / "last.npy", np.stack([walker(k) for k in range(6)])[..., None])
    np.save(tmp_path / "first.npy", np.stack([walker(k) for k in range(6)])[None])
    for name in ("last.npy", "first.npy"):
        assert list(pixels(read_people(tmp_path / name, {}, None))) == [(k, 0) for k in range(6)]
    apart = np.stack([walker(0, k) for k in (0, 20, 40)])
    np.save(tmp_path / "fast.npy", apart[:, None])  # SAM 2's layout of frames, however fast he is
    found = read_people(tmp_path / "fast.npy", {}, None)
    assert list(pixels(found)) == [(0, 0), (1, 0), (2, 0)]
    assert any("people of one image are (n, h, w)" in note for note in found.notes)
    np.save(tmp_path / "people.npy", apart)
    found = read_people(tmp_path / "people.npy", {}, None)
    assert list(pixels(found)) == [(0, 0), (0, 1), (0, 2)]
    assert any("3 masks are people of one image" in note for note in found.notes)


@pytest.mark.parametrize("shape", ["objects first", "frames first"])
@pytest.mark.parametrize("count", [2, 6, 9])
def test_the_axis_of_frames_is_that_along_which_masks_overlap(shape, count, tmp_path):
    two = np.stack([[walker(k, 4 + 28 * t) for t in (0, 1)] for k in range(count)])
    stack = two if shape == "frames first" else two.swapaxes(0, 1)
    axes = "(frames, objects, h, w)" if shape == "frames first" else "(objects, frames, h, w)"
    for name, more in (("a", {}), ("b", {"object_ids": np.arange(2)})):
        np.savez(tmp_path / f"{name}.npz", masks=stack, **more)
        found = read_people(tmp_path / f"{name}.npz", {}, None)
        said = f"{name}.npz: masks {axes}: 2 people or things in {count} frames"
        assert said in found.notes
        got = pixels(found)
        assert got.keys() == {(k, t) for k in range(count) for t in (0, 1)}
        assert all((mask == two[key]).all() for key, mask in got.items())


@pytest.mark.parametrize("apart", [False, True])
@pytest.mark.parametrize("shape", ["fhw", "f1hw", "fhw1"])
def test_a_map_of_labels_a_frame_has_a_track_a_label(shape, apart, tmp_path):
    """Two people, at the same time or one after the other."""
    both = [walker(k) * (k < 4 or not apart) + walker(k, 34) * 2 * (k >= 4 or not apart)
            for k in range(8)]  # fmt: skip
    axis = {"fhw": (), "f1hw": 1, "fhw1": 3}[shape]
    np.savez(tmp_path / "a.npz", masks=np.expand_dims(np.stack(both).astype(np.uint8), axis))
    got = pixels(read_people(tmp_path / "a.npz", {}, None))
    assert set(got) == {
        (k, t) for k in range(8) for t in (1, 2) if not apart or (t == 2) == (k > 3)
    }
    assert all((mask == (both[k] == track)).all() for (k, track), mask in got.items())


SHAPES = np.stack([walker(0), walker(0, 20), walker(0, 40)])
SOFT = {
    "probabilities": np.where(SHAPES, 0.97, 0.02), "half precision": SHAPES.astype(np.float16),
    "logits": SHAPES * 9.0 - 6, "numbered": SHAPES * np.arange(1, 4)[:, None, None],
    "grey": np.stack([np.asarray(
        white(m).resize((W // 2, H // 2), Image.Resampling.LANCZOS).resize(
            (W, H), Image.Resampling.LANCZOS)) for m in SHAPES]),
    "grey numbers": SHAPES * 255.0 - SHAPES[:, ::-1] * 0.5 * SHAPES,
}  # fmt: skip


@pytest.mark.parametrize("kind", SOFT)
def test_masks_of_an_array_are_cut_at_half_and_logits_at_zero(kind, tmp_path):
    np.savez(tmp_path / "a.npz", masks=SOFT[kind])
    found = read_things(tmp_path / "a.npz", {}, None)
    for mask, item in zip(SHAPES, found.items, strict=True):
        got = decode(Masks(H, W, (item.mask or b"",)), 0).numpy()
        assert (got ^ mask).sum() <= (0.15 if kind == "grey" else 0) * mask.sum()
    assert any("cut at 0.5" in note for note in found.notes) == (kind == "probabilities")


def test_a_dump_of_mmdetection_is_named_with_the_cure(tmp_path):
    tree = [{"img_id": 0, "pred_instances": {"labels": np.array([56]), "masks": [code(walker(0))]}}]
    (tmp_path / "out.pkl").write_bytes(pickle.dumps(tree))
    with pytest.raises(InputError, match=r"^out.pkl.*MMDetection's dump.*expected .*preds/.*json"):
        read_things(tmp_path / "out.pkl", {}, None)


def test_soft_labels_are_labels_and_a_dancer_is_a_person(tmp_path):
    both = walker(0) * 85 + walker(0, 40) * 170
    folder = tmp_path / "in"
    folder.mkdir()
    big = Image.fromarray(both.astype(np.uint8)).resize((W * 4, H * 4), Image.Resampling.BILINEAR)
    big.save(folder / "00000.png")
    found = read_things(folder, {"85": "chair", "170": "sofa"}, None)
    assert [i.category for i in found.items] == ["chair", "sofa"]
    rows = [{"class": "dancer", "bbox": [0, 0, 9, 9, 1.0], "mask": walker(0).tolist()}]
    people = read_people(save(tmp_path, rows), {}, None)
    assert len(people.items) == 1
    assert any("'dancer' taken as people's" in note for note in people.notes)
    del rows[0]["mask"]
    boxes = read_people(save(tmp_path, rows), {}, None)
    assert "a.json: boxes without mask, which people need, left out: 1" in boxes.notes


def grounded(folder: Path) -> Path:
    """DUMP_JSON_RESULTS of grounded_sam2_local_demo.py; scores as SAM 2 has them, lists of one."""
    row = {"class_name": "chair", "bbox": [4.0, 10.0, 18.0, 40.0],
           "segmentation": code(walker(0)), "score": [1.02]}  # fmt: skip
    tree = {"image_path": "notebooks/images/a.jpg", "annotations": [row], "box_format": "xyxy",
            "img_width": W, "img_height": H}  # fmt: skip
    return save(folder, tree)


def mmdet(folder: Path) -> Path:
    """outputs/preds/a.json of mmdet's DetInferencer (mmdet/apis/det_inferencer.py: pred2dict)."""
    return save(folder, predictions(0))


def predictions(frame: int) -> dict[str, Any]:
    return {"labels": [56, 0, 60], "scores": [0.9, 0.8, 0.05],
            "bboxes": [[4, 10, 18, 40], [0, 0, 9, 9], [0, 0, 5, 5]],
            "masks": [code(walker(0)), code(walker(frame, 30)), code(walker(0, 9))]}  # fmt: skip


FRAMES = [predictions(frame) for frame in range(4)]


@pytest.mark.parametrize("tree", [
    FRAMES, {"predictions": FRAMES, "visualization": []}, [{"predictions": [p]} for p in FRAMES],
])  # fmt: skip
def test_entries_of_mmdetection_are_frames(tree, tmp_path):
    path = save(tmp_path, tree)
    found = read_people(path, {}, None)
    got = pixels(found)
    assert list(got) == [(k, 0) for k in range(4)]
    assert all((mask == walker(k, 30)).all() for (k, _), mask in got.items())
    assert "a.json: 4 entries of MMDetection are frames in their order" in found.notes
    (chair_of_2,) = read_things(path, {}, None, "000002.png").items
    assert (chair_of_2.category, chair_of_2.frame) == ("chair", 2)


def test_a_list_of_other_objects_is_named_by_their_fields(tmp_path):
    path = save(tmp_path, [{"boxes": [[0, 0, 9, 9]], "ids": [1]}])
    with pytest.raises(InputError, match=r"'\[0\]' has an object of boxes, ids, expected a detec"):
        read_things(path, {}, None)


@pytest.mark.parametrize("kind", ["masks", "labels"])
def test_a_folder_of_arrays_has_an_array_a_frame(kind, tmp_path):
    for frame in KEPT:
        both = np.stack([walker(frame, 34), walker(frame)])
        if kind == "labels":
            np.savez(tmp_path / f"mask_{frame:05d}.npz", masks=both[0] * 2 + both[1] * 5)
        else:
            ids = np.array([2, 5])
            np.savez(tmp_path / f"mask_{frame:05d}.npz", masks=both, object_ids=ids)
    got = pixels(read_people(tmp_path, {}, None))
    assert got.keys() == {(k, t) for k in KEPT for t in (2, 5)}
    assert all((mask == walker(k, 34 if t == 2 else 4)).all() for (k, t), mask in got.items())
    np.savez(tmp_path / "mask_00009.npz", masks=np.stack([walker(k) * 3 for k in range(3)]),
             frame=np.arange(3))  # fmt: skip
    with pytest.raises(InputError, match=r"6 files, of which mask_00009.npz has several frames"):
        read_people(tmp_path, {}, None)
    for path in tmp_path.glob("mask_0000[0-8].npz"):
        path.unlink()
    assert list(pixels(read_people(tmp_path, {}, None))) == [(k, 0) for k in range(3)]


@pytest.mark.parametrize("write", [grounded, mmdet])
def test_results_of_detectors_are_read(write, tmp_path):
    found = read_things(write(tmp_path), {}, None)
    (item,) = found.items
    assert item.category == "chair"
    assert item.box == (4, 10, 18, 40)
    assert (pixels(found)[0, None] == walker(0)).all()
    assert 0.9 <= item.score <= 1


def many_images(folder: Path) -> Path:
    """What CVAT exports of a task of several pictures."""
    names = ("kitchen.jpg", "images/Room.JPG", "next.jpg")
    images = [{"id": k, "width": W + 2 * (k == 0), "height": H, "file_name": name}
              for k, name in enumerate(names)]  # fmt: skip
    rows = [{"id": k, "image_id": k, "category_id": k, "segmentation": [[k, 0, 9, 0, 9, 9]],
             "bbox": [0, 0, 9, 9], "iscrowd": 0} for k in range(3)]  # fmt: skip
    names = [{"id": k, "name": name} for k, name in enumerate(("table", "chair", "bed"))]
    return save(folder, {"images": images, "annotations": rows, "categories": names})


def test_of_many_images_only_ours_counts_and_this_is_said(tmp_path):
    path = many_images(tmp_path)
    found = read_things(path, {}, (W, H), "room.png")
    assert [i.category for i in found.items] == ["chair"]
    assert found.notes == ("a.json: of 3 images only images/Room.JPG is taken",)
    with pytest.raises(InputError, match=r"3 images \(kitchen.jpg, .*expected one called x.png"):
        read_things(path, {}, (W, H), "x.png")


def chair(folder: Path, drawn: Any, *, file: str = "", **more: Any) -> Instances:
    row = {"id": 1, "image_id": 0, "category_id": 1, "segmentation": drawn, **more}
    image = {"id": 0, "width": W, "height": H, "file_name": file}
    tree = {"images": [image], "annotations": [row], "categories": [{"id": 1, "name": "chair"}]}
    return read_things(save(folder, tree), {}, None, "room.png")


@pytest.mark.parametrize("file", ["", "images/Room.JPG", "other.jpg"])
def test_a_lone_image_of_another_name_is_taken_and_this_is_said(file, tmp_path):
    found = chair(tmp_path, [SQUARE], file=file)
    said = f"a.json: its only image, {file}, is taken for room.png"
    assert found.notes == ((said,) if file == "other.jpg" else ())
    assert [item.category for item in found.items] == ["chair"]


@pytest.mark.parametrize("nothing", [[], [[]], None])
def test_a_box_without_mask_is_a_box(nothing, tmp_path):
    (item,) = chair(tmp_path, nothing, bbox=[4, 10, 14, 30]).items
    assert (item.box, item.mask) == ((4, 10, 18, 40), None)


SQUARE = [[4, 10], [18, 10], [18, 40], [4, 40]]
TEXT = {"size": f"[{H}, {W}]", "counts": compressed(runs(walker(0)))}


COUNTS = {"size": [H, W], "counts": str(runs(walker(0)))}


@pytest.mark.parametrize("drawn", [[SQUARE], [SQUARE, []], TEXT, COUNTS])
def test_other_spellings_of_a_mask_are_the_same_mask(drawn, tmp_path):
    (mask,) = pixels(chair(tmp_path, drawn)).values()
    assert (mask == walker(0)).all()


@pytest.mark.parametrize(("drawn", "words"), [
    ([[4, 10, 18, 10, 18, 40, 4]], "has polygon 0 with 7 numbers, an odd count, expected numbers"),
    ("iVBORw0KGgoAAAANSUhEUgAAAA/z=", "has a picture in base64, expected COCO's compressed code"),
    ({"size": [H, W], "counts": "data:image/png;base64,iVBO"}, "has a picture in base64"),
])  # fmt: skip
def test_what_is_no_mask_is_named(drawn, words, tmp_path):
    with pytest.raises(InputError, match=rf"segmentation' {words}"):
        chair(tmp_path, drawn)


def test_a_track_of_cvat_is_an_attribute(tmp_path):
    (item,) = chair(tmp_path, [SQUARE], attributes={"track_id": 4, "occluded": False}).items
    assert item.track == 4


def test_polygons_in_shares_of_the_image_are_refused(tmp_path):
    with pytest.raises(InputError, match=r"segmentation' has .* shares .*, expected pixels"):
        chair(tmp_path, [[0.1, 0.1, 0.5, 0.1, 0.5, 0.5]])
