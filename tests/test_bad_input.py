"""Each mistake in a file gives one message that names file, field, found and expected."""

import json
import zipfile
from pathlib import Path

import numpy as np
import pytest
import tiny_capture as tiny
from PIL import Image

from mover.core.errors import InputError
from mover.io.capture.folder import read_capture

NAN = float("nan")


def refused(folder: Path, file: str, words: str) -> str:
    with pytest.raises(InputError, match=words) as caught:
        read_capture(folder)
    message = str(caught.value)
    assert message.startswith(file), message
    assert "expected" in message
    assert "\n" not in message
    return message


SQUARE = {"size": [10, 10], "counts": [100]}
JSON = [
    ("camera.json", "w", 0, "'w' has 0, expected a whole number"),
    ("camera.json", "w", 64.5, "'w'"),
    ("camera.json", "w", 1 << 20, "'w' has 1048576"),
    ("camera.json", "h", ..., "'h' has nothing"),
    ("camera.json", "fl_x", 0.0, "'fl_x' has 0.0, expected a number above 0"),
    ("camera.json", "fl_y", NAN, "'fl_y' has nan"),
    ("camera.json", "cx", "a", "'cx' has \"a\""),
    ("camera.json", "cy", float("inf"), "'cy' has inf"),
    ("camera.json", "cy", True, "'cy' has True"),
    ("camera.json", "k1", 0.1, "'k1'.*undistort"),
    ("camera.json", "height", -1.4, "'height' has -1.4"),
    ("camera.json", "R_cam_world", [[1, 0, 0], [0, 1, 0]], "2 items"),
    ("camera.json", "R_cam_world", [[1, 0, 0], [0, 1, 0], [0, 0, -1]], "rotation matrix"),
    ("camera.json", "R_cam_world", [[1, 0, 0], [0, 1, 0], [0, 0, NAN]], r"R_cam_world\[2\]\[2\]"),
    ("scene.json", "format", "usd", "'format' has \"usd\", expected one of mover-scene"),
    ("scene.json", "version", 2, "'version' has 2"),
    ("scene.json", "ground", {"height": NAN}, "'ground.height' has nan"),
    ("scene.json", "ground", 3, "'ground' has 3"),
    ("scene.json", "objects", {}, "'objects' has {}"),
    ("scene.json", "objects.0.id", "chair 0", r"'objects\[0\].id' has \"chair 0\""),
    ("scene.json", "objects.0.id", "../chair", "id"),
    ("scene.json", "objects.0.id", ".hidden", "id"),
    ("scene.json", "objects.0.id", "ground", "id"),
    ("scene.json", "objects.0.id", "", "text"),
    ("scene.json", "objects.1.id", "CHAIR_0", "used twice"),
    ("scene.json", "objects.0.category", None, "category"),
    ("scene.json", "objects.0.mesh", "../lamp.glb", "inside the capture"),
    ("scene.json", "objects.0.mesh", "/etc/passwd", "inside the capture"),
    ("scene.json", "objects.0.mesh", "meshes/no.glb", "does not exist"),
    ("scene.json", "objects.0.mesh", "camera.json", "a file of kind"),
    ("scene.json", "objects.0.mesh", "a" * 5000, "cannot be found"),
    ("scene.json", "objects.0.mesh", "a\0b", "printable"),
    ("scene.json", "objects.0.category", "\ud800", "printable"),
    ("scene.json", "objects.0.yaw", "\ud800", "'objects.0..yaw' has"),
    ("camera.json", "R_cam_world", [[1, 0, 0], [0, 1, "\ud800"], [0, 0, 1]], r"\[1\]\[2\]' has"),
    ("scene.json", "objects.0.annotation", 12, "'objects.0..annotation' has 12"),
    ("scene.json", "objects.0.annotation", 5, "used twice"),
    ("scene.json", "objects.0.annotation", "11", "whole number"),
    ("scene.json", "objects.0.translation", [0, 0], "2 items, expected a list of 3"),
    ("scene.json", "objects.0.translation", [0, 0, NAN], r"translation\[2\]"),
    ("scene.json", "objects.0.translation", [0, 0, 1e300], r"translation\[2\]"),
    ("scene.json", "objects.0.yaw", [0.1], "yaw"),
    ("scene.json", "objects.0.yaw", 10**400, "yaw"),
    ("scene.json", "objects.0.scale", 1.0, "scale"),
    ("scene.json", "objects.0.scale", [1, 0, 1], r"scale\[1\]' has 0, expected a number above 0"),
    ("scene.json", "objects.0.support", "sofa", "'sofa'"),
    ("scene.json", "objects.0.support", "chair_0", "circle"),
    ("scene.json", "objects.0.support", "Lampe_ä.2", "circle"),
    ("scene.json", "camera", {"w": 64}, "'camera.h' has nothing"),
    ("objects.json", "images", [], "0 items"),
    ("objects.json", "images.0.width", 63, "'images.0..width' has 63, expected 64"),
    ("objects.json", "images.0.file_name", "no.png", "does not exist"),
    ("objects.json", "images.0.file_name", "../no.png", "inside the capture"),
    ("objects.json", "images.0.file_name", "camera.json", "cannot be read"),
    ("objects.json", "categories.0.name", 3, "name"),
    ("objects.json", "categories.1.id", 62, "used twice"),
    ("objects.json", "annotations.0.id", ..., "'annotations.0..id' has nothing"),
    ("objects.json", "annotations.1.id", 11, "used twice"),
    ("objects.json", "annotations.0.image_id", 0, "expected 4"),
    ("objects.json", "annotations.0.category_id", 1, "one of the categories"),
    ("objects.json", "annotations.0.score", 1.5, "score"),
    ("objects.json", "annotations.0.bbox", [1, 2, 3], "3 items"),
    ("objects.json", "annotations.0.bbox", [1, 2, 0, 4], "above 0"),
    ("objects.json", "annotations.0.bbox", [1, 2, NAN, 4], r"bbox\[2\]"),
    ("objects.json", "annotations.0.bbox", [64, 2, 3, 4], "inside the image of 64 x 48"),
    ("objects.json", "annotations.0.segmentation", SQUARE, r"size \[10, 10\], expected \[48, 64\]"),
    ("objects.json", "annotations.0.segmentation.counts", [5], "sum to"),
    ("objects.json", "annotations.0.segmentation.counts", [48 * 64], "an empty mask"),
    ("objects.json", "annotations.1.segmentation.0", [1, 1, 2, 2], "4 numbers"),
    ("objects.json", "annotations.1.segmentation.0", [1, 1, 1, 1, 1, 1], "an empty mask"),
    ("people.json", "info.fps", 0, "'info.fps' has 0"),
    ("people.json", "info.heights", {"0": 178}, "'info.heights.0' has 178"),
    ("people.json", "info.heights", {"Anna": 1.7}, "number of a track"),
    ("people.json", "images.1.id", 0, "not used twice"),
    ("people.json", "images.0.id", -1, "-1"),
    ("people.json", "images.0.width", 65, "65"),
    ("people.json", "annotations.0.image_id", 2, "one of the images"),
    ("people.json", "annotations.0.track_id", ..., "track_id"),
    ("people.json", "annotations.1.track_id", 0, "used twice"),
    ("people.json", "annotations.0.segmentation", SQUARE, r"\[48, 64\]"),
    ("people.json", "annotations.0.category_id", 9, "one of the categories"),
    ("people.json", "reference_people.0.segmentation.counts", [1], "sum to 1"),
    ("people.json", "info.fps", 1e-8, "'info.fps' has 1e-08, expected a finite number from 0.001"),
    ("camera.json", "height", 99, "'height' has 99"),
    ("camera.json", "fl_x", 1e8, "'fl_x' has 1e.08, expected 3.2 to 6400 px for 64 px"),
    ("camera.json", "fl_y", 1e-8, "'fl_y' has 1e-08, expected a number above 0|'fl_y' has 1e-08"),
    ("camera.json", "cx", 1e8, "'cx' has 1e.08, expected -640 to 640 px"),
    ("scene.json", "ground.height", -80, "has -80, expected a finite number from -30"),
    ("scene.json", "objects.0.translation", [1e9, 0, 0], "translation' of chair_0 is 1e.09 m away"),
    ("scene.json", "objects.1.translation", [0, 0, -500], r"\[1\].*500 m away.*in centimetres"),
    ("scene.json", "objects.0.yaw", 1e8, "yaw' of chair_0 has 1e.08 rad, expected -1000 to 1000"),
    ("scene.json", "objects.0.scale", [1000] * 3, "2e.03 m large, expected .*millimetres"),
    ("scene.json", "objects.0.scale", [50, 100, 60], "100 m large.*centimetres. Multiply .* 0.01"),
    ("scene.json", "objects.0.scale", [1e-8] * 3, "2e-08 m large, expected 0.01 to 30 m"),
]


@pytest.mark.parametrize(("file", "path", "value", "words"), JSON)
def test_a_wrong_field_is_named(folder, file, path, value, words):
    tiny.change(folder / file, path, value)
    refused(folder, file, words)


def with_one(array: np.ndarray, value: float) -> np.ndarray:
    bad = array.copy()
    bad[1, 2, 0] = value
    return bad


VERTS = tiny.bodies()["vertices"]
ARRAYS = [
    ("vertices", with_one(VERTS, NAN), r"nan at \[1, 2, 0\]"),
    ("vertices", VERTS * np.float32(1e30), "finite"),
    ("vertices", VERTS[:2], r"shape \(2, 4, 3\) of float32, expected .*\(3, V, 3\)"),
    ("vertices", VERTS[..., :2], "vertices"),
    ("vertices", VERTS[:, :0], "at least one point"),
    ("vertices", VERTS.astype(complex), "complex"),
    ("vertices", VERTS.astype(str), "vertices"),
    ("vertices", ..., "'vertices' has nothing"),
    ("faces", ..., "'faces' has nothing"),
    ("faces", np.zeros((0, 3), dtype=int), "an empty mesh"),
    ("faces", tiny.BODY_FACES + 1, "vertices 1 to 4, expected vertices 0 to 3"),
    ("faces", tiny.BODY_FACES - 1, "vertices -1"),
    ("faces", tiny.BODY_FACES.astype(float), "whole numbers"),
    ("frame", np.array([0, 0]), r"'person' has|'vertices' has"),
    ("frame", np.array([0, 0, -1]), "'frame' has -1"),
    ("frame", np.array([0, 0, 1 << 40]), "'frame' has 1099511627776"),
    ("frame", np.array([0.0, 0, 1]), "whole numbers"),
    ("frame", np.array(0), "shape"),
    ("frame", ..., "'frame' has nothing"),
    ("person", np.array([0, 0, 0]), "frame 0 of person 0 twice"),
    ("space", np.array("room"), "'space' has \"room\", expected one of camera, world"),
    ("space", ..., "'space' has nothing"),
    ("fps", np.array(0.0), "'fps' has 0"),
    ("fps", np.array([5.0]), "'fps' has shape"),
    ("joint_names", ..., "'joint_names' has nothing"),
    ("joint_names", np.array(["one"]), "shape"),
    ("joints", ..., "'joints' has nothing"),
    ("body_pose", np.zeros((3, 63)), "'model' has nothing"),
    ("vertices", VERTS * 1000, "millimetres.*are they in metres"),
    ("vertices", VERTS * 100, "centimetres.*are they in metres"),
    ("vertices", VERTS * np.float32(39.37), "in inches.*are they in metres"),
    ("vertices", VERTS / 1000, "are they in metres"),
    ("vertices", -VERTS, "behind the camera.*'space'"),
    ("vertices", VERTS - VERTS.mean(1, keepdims=True), "was the translation left out"),
    ("vertices", with_one(VERTS, 1e8), "1e.08 m away in row 1"),
    ("fps", np.array(1e-8), "'fps' has 1e-08"),
    ("probability", tiny.touch()[:2], "shape"),
    ("probability", tiny.touch() + 0.5, "expected probabilities"),
    ("probability", tiny.touch() * NAN, "finite"),
]


@pytest.mark.parametrize(("name", "value", "words"), ARRAYS)
def test_a_wrong_array_is_named(folder, name, value, words):
    arrays, file = tiny.bodies(), "bodies.npz"
    if name == "probability":
        arrays, file = {}, "contacts.npz"
    tiny.put(arrays, [name], value)
    np.savez(folder / file, **arrays)
    refused(folder, file, words)


JSON_FILES = ("camera.json", "scene.json", "objects.json", "people.json")


@pytest.mark.parametrize("name", JSON_FILES)
def test_a_file_that_is_missing_or_not_json_or_has_a_name_twice_is_named(folder, name):
    whole = (folder / name).read_bytes()
    for text in (b"", b"{", b"\xff\xfe\x00", b"[" * 100_000, b"nan"):
        (folder / name).write_bytes(text)
        refused(folder, name, "is not JSON")
    (folder / name).write_bytes(b'{"info": 1, "info": 2, ' + whole[1:])
    refused(folder, name, 'the name "info" is there twice')
    (folder / name).unlink()
    if name != "people.json":
        refused(folder, name, "no such file")


@pytest.mark.parametrize(("name", "given"), [
    ("scene.json", "objects.json"), ("objects.json", "scene.json"), ("objects.json", "people.json"),
    ("camera.json", "scene.json"),
])  # fmt: skip
def test_a_file_under_the_name_of_another_is_called_so(folder, name, given):
    (folder / name).write_bytes((folder / given).read_bytes())
    refused(folder, name, f"is it {given}")


@pytest.mark.parametrize("name", ["bodies.npz", "contacts.npz"])
def test_a_file_that_is_not_npz_is_named(folder, name):
    for content in (b"", b"PK\x03\x04 not really", (folder / name).read_bytes()[:200]):
        (folder / name).write_bytes(content)
        refused(folder, name, "cannot be read")


def test_pickled_objects_are_refused_unread(folder):
    np.savez(folder / "bodies.npz", frame=np.array([{"a": 1}], dtype=object))
    refused(folder, "bodies.npz", "field 'frame'.*no pickled objects")


def test_an_array_that_unpacks_to_more_than_the_limit_is_refused_by_its_header(folder):
    header = {"descr": "<f4", "fortran_order": False, "shape": (100_000, 100_000, 3)}
    path = folder / "bodies.npz"
    with zipfile.ZipFile(path, "w") as archive, archive.open("vertices.npy", "w") as stream:
        np.lib.format.write_array_header_1_0(stream, header)
    refused(folder, "bodies.npz", "field 'vertices'.*bytes or more, expected at most")


OBJ = "v 0 0 0\nv 1 0 0\nv 0 1 0\n"


@pytest.mark.parametrize(("text", "words"), [
    ("", "cannot be read|empty mesh"),
    (OBJ, "cannot be read|empty mesh"),
    (OBJ + "f 1 1 2\n", "empty mesh"),
    (OBJ + "f 1 2 7\n", "cannot be read|name vertices"),
    (OBJ.replace("1 0 0", "nan 0 0") + "f 1 2 3\n", "NaN"),
    (OBJ.replace("0 1 0", "2 0 0") + "f 1 2 3\n", "a line or a point"),
])  # fmt: skip
def test_a_mesh_without_a_surface_is_named(folder, text, words):
    (folder / "meshes" / "step.obj").write_text(text)
    message = refused(folder, "scene.json", words)
    assert "objects[0].mesh" in message


@pytest.mark.parametrize("kind", ["glb", "gltf", "ply", "off", "stl"])
def test_a_broken_mesh_file_is_named(folder, kind):
    tiny.change(folder / "scene.json", "objects.0.mesh", f"meshes/broken.{kind}")
    for content in (b"", b"solid x\n", bytes(range(256)) * 3):
        (folder / "meshes" / f"broken.{kind}").write_bytes(content)
        refused(folder, "scene.json", "broken|empty mesh")


@pytest.mark.parametrize(("tree", "words"), [
    ({"buffers": [{"uri": "../../secret.bin", "byteLength": 4}]}, "buffers beside it"),
    ({"accessors": [{"count": 1 << 40}]}, "1099511627776"),
    ({"buffers": [3]}, "cannot be read"),
])  # fmt: skip
def test_a_gltf_that_reaches_out_of_its_folder_or_of_memory_is_refused(folder, tree, words):
    (folder.parent.parent / "secret.bin").write_bytes(b"1234")
    (folder / "meshes" / "a.gltf").write_text(json.dumps(tree))
    tiny.change(folder / "scene.json", "objects.0.mesh", "meshes/a.gltf")
    refused(folder, "scene.json", words)


def test_a_link_that_leaves_the_folder_is_refused(folder):
    outside = folder.parent / "outside.obj"
    (folder / "meshes" / "step.obj").rename(outside)
    (folder / "meshes" / "step.obj").symlink_to(outside)
    refused(folder, "scene.json", "a link that leaves it")


def test_a_picture_of_another_size_is_refused_with_both_sizes(folder):
    Image.fromarray(tiny.picture()[:-1]).save(folder / "room.png")
    refused(folder, "objects.json", "'room.png' with 64 x 47 pixels, expected 64 x 48")


def test_frames_behind_the_end_of_the_video_are_refused(folder):
    (folder / "frames").mkdir()
    for frame in range(3):
        (folder / "frames" / f"{frame:06d}.jpg").touch()
    refused(folder, "bodies.npz", "'frame' has 3, expected a frame from 0 to 2")


@pytest.mark.parametrize(("file", "path", "value", "words"), [
    ("objects.json", "annotations.0.bbox", [30, 2, 20, 5], "a box and a mask in different"),
    ("objects.json", "annotations.0.bbox", [5, 20, 70, 30], "reaches beyond the image"),
    ("objects.json", "annotations.1.segmentation.0",
     [40, 10, 80, 10, 80, 30, 40, 30], "leaves the image and was clipped"),
    ("people.json", "annotations.1.segmentation", None, "1 of 3 people without mask"),
    ("people.json", "annotations.1.segmentation.counts", [48 * 64], "1 of 3 people without"),
    ("people.json", "reference_people.0.segmentation", None, "1 people of the reference"),
    ("scene.json", "ground.height", 0.4, "the ground is not below the camera"),
    ("scene.json", "objects", [], "there are no objects"),
    ("scene.json", "objects.0.translation", [0, -1.4, 5], "4.6 m behind the camera"),
    ("scene.json", "objects.0.translation", [0, -1.4, -45], "is it in metres"),
    ("scene.json", "objects.0.scale", [1e-8, 0.9, 0.6], "is it flat"),
    ("camera.json", "fl_x", 6000.0, "fl_x 6000 and fl_y 58.5 differ much"),
    ("camera.json", "cx", 0, "far from the middle"),
    ("scene.json", "objects.0.yaw", 90, "yaw' of chair_0 has 90; is it in radians"),
    ("scene.json", "objects.0.scale", [8.0, 8, 8], "16 m large, as its box"),
    ("scene.json", "objects.0.category", "sofa", "is a sofa, its annotation 11 a chair"),
    ("people.json", "info.heights", {"5": 1.7}, "the height of unknown track 5"),
    ("camera.json", "R_cam_world", [[-1, 0, 0], [0, 1, 0], [0, 0, -1]], "on its side or head"),
    ("camera.json", "R_cam_world", [[1, 0, 0], [0, 0, 1], [0, -1, 0]], "straight up or down"),
])  # fmt: skip
def test_what_is_odd_but_not_wrong_is_a_warning(folder, file, path, value, words):
    tiny.change(folder / file, path, value)
    assert words in "\n".join(read_capture(folder).warnings)


@pytest.mark.parametrize(("name", "shift", "words"), [
    ("frame", 9, "3 of 3 bodies have no mask"),
    ("person", 5, "people.json: by its position"),
    ("joints", 5, "'joints' is 8.5 m off the meshes"),
])  # fmt: skip
def test_odd_bodies_are_a_warning(folder, name, shift, words):
    arrays = tiny.bodies()
    np.savez(folder / "bodies.npz", **arrays | {name: arrays[name] + shift})
    assert words in "\n".join(read_capture(folder).warnings)


def test_two_objects_with_one_mask_are_a_warning(folder):
    first = tiny.objects()["annotations"][0]
    for key in ("segmentation", "bbox"):
        tiny.change(folder / "objects.json", f"annotations.1.{key}", first[key])
    assert "2 objects (chair_0, Lampe_ä.2) have one" in "\n".join(read_capture(folder).warnings)


@pytest.mark.parametrize("name", ["people.json", "bodies.npz", "contacts.npz", "hypotheses.json"])
def test_a_link_to_nothing_is_no_missing_file(folder, name):
    (folder / name).unlink(missing_ok=True)
    (folder / name).symlink_to(folder / "gone")
    refused(folder, name, "no such file")


def test_a_wrong_hypothesis_is_named_by_its_object_and_row(folder):
    (folder / "hypotheses.json").write_text(json.dumps(tiny.hypotheses()))
    tiny.change(folder / "hypotheses.json", "objects.chair_0.1.yaw", NAN)
    refused(folder, "hypotheses.json", r"objects.chair_0\[1\].yaw' has nan")
