"""A moving camera's poses come in from every tool's own layout, and wrong ones are refused."""

import io
import json
import math
import re
import struct
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import joblib
import little_room
import numpy as np
import pytest
import torch
from PIL import Image
from scipy.spatial.transform import Rotation

from mover.core.errors import InputError
from mover.core.types import STILL, Capture
from mover.geometry.camera import pitch_roll
from mover.geometry.path import from_reference, is_still, poses_at, scaled, to_reference
from mover.io.capture.camera_file import path_of, path_to_arrays
from mover.io.capture.folder import read_capture, write_capture
from mover.io.capture.merge import import_into
from mover.io.capture.parts import Parts
from mover.io.files.cameras import camera_of_photo, read_camera_file, tilt_of_photo
from mover.io.files.fields import At
from mover.io.formats import chosen, names
from mover.io.people.cameras import read_colmap, read_slam, read_tum

COUNT, FOCAL = 6, 0.625
WIDTH, HEIGHT = 640, 360


def true_path() -> np.ndarray:
    """Camera to world in OpenCV's axes, (T, 4, 4)."""
    T = np.tile(np.eye(4), (COUNT, 1, 1))
    way = np.linspace(0, 1, COUNT)[:, None]
    T[:, :3, :3] = Rotation.from_rotvec(way * [0.1, -0.4, 0.05] + [0.2, 0, 0]).as_matrix()
    T[:, :3, 3] = way * [0.7, -0.1, 0.3] + [3, 1, 2]
    return T


def lens(zoom: float = 1.0) -> np.ndarray:
    K = np.array([[FOCAL * WIDTH, 0, WIDTH / 2], [0, FOCAL * WIDTH, HEIGHT / 2], [0, 0, 1]])
    K[:2] *= zoom
    return K


def write_vipe(folder: Path) -> Path:
    """nv-tlabs/vipe, vipe/utils/io.py: read_pose_artifacts, read_intrinsics_artifacts."""
    for kind in ("pose", "intrinsics"):
        (folder / kind).mkdir()
    inds, K = np.arange(COUNT), lens()
    four = np.tile([K[0, 0], K[1, 1], K[0, 2], K[1, 2]], (COUNT, 1)).astype(np.float32)
    np.savez(folder / "pose" / "clip.npz", data=true_path().astype(np.float32), inds=inds)
    np.savez(folder / "intrinsics" / "clip.npz", data=four, inds=inds)
    return folder


def write_megasam(folder: Path) -> Path:
    """mega-sam/mega-sam, cvd_opt/cvd_opt.py: np.savez at its end; images are smaller."""
    file, small = folder / "clip_sgd_cvd_hr.npz", (COUNT, 18, 32)
    np.savez(
        file, images=np.zeros((*small, 3), np.uint8), depths=np.ones(small, np.float16),
        intrinsic=lens(0.05).astype(np.float32), cam_c2w=true_path().astype(np.float32),
    )  # fmt: skip
    return file


def write_vggt(folder: Path) -> Path:
    """facebookresearch/vggt, demo_gradio.py: np.savez of the predictions, x_cam = [R | t] x."""
    extrinsic = np.linalg.inv(true_path())[:, :3].astype(np.float32)
    intrinsic = np.tile(lens(0.8), (COUNT, 1, 1)).astype(np.float32)
    depth = np.ones((COUNT, 18, 32, 1), np.float32)
    np.savez(folder / "predictions.npz", extrinsic=extrinsic, intrinsic=intrinsic, depth=depth)
    return folder


def seven() -> np.ndarray:
    """DPVO's terminate(): x y z, quaternion x y z w, camera to world."""
    T = true_path()
    return np.concatenate([T[:, :3, 3], Rotation.from_matrix(T[:, :3, :3]).as_quat()], 1)


def write_wham(folder: Path) -> Path:
    """yohanshin/WHAM, demo.py: joblib.dump of DPVO's rows."""
    joblib.dump(seven().astype(np.float32), folder / "slam_results.pth")
    return folder


def write_gvhmr(folder: Path) -> Path:
    """zju3dv/GVHMR, tools/demo/demo.py: torch.save of DPVO's rows, which hold R_w2c.mT."""
    (folder / "preprocess").mkdir()
    torch.save(seven(), folder / "preprocess" / "slam_results.pt")
    return folder


def write_tum(folder: Path) -> Path:
    """MichaelGrupp/evo, evo/tools/file_interface.py: write_tum_trajectory_file, np.savetxt."""
    table = np.concatenate([np.arange(COUNT)[:, None], seven()], 1)
    np.savetxt(folder / "trajectory.txt", table, delimiter=" ")
    return folder


def write_colmap(folder: Path) -> Path:
    """colmap.github.io/format.html#text-format: two lines a picture, here not in their order."""
    back = np.linalg.inv(true_path())
    turn = Rotation.from_matrix(back[:, :3, :3]).as_quat()[:, [3, 0, 1, 2]]
    lines = ["# Image list with two lines of data per image:", "# Number of images: 6"]
    for k in (2, 0, 1, *range(3, COUNT)):
        pose = " ".join(f"{v:.17g}" for v in (*turn[k], *back[k, :3, 3]))
        points = "" if k else "10.5 20.5 -1 30.25 40.5 17"
        lines += [f"{k + 1} {pose} 1 my video/frame_{k:05d}.jpg", points]
    (folder / "images.txt").write_text("\n".join(lines) + "\n")
    camera = f"1 SIMPLE_RADIAL {WIDTH} {HEIGHT} {FOCAL * WIDTH} {WIDTH / 2} {HEIGHT / 2} 0.01"
    (folder / "cameras.txt").write_text(f"# Camera list\n{camera}\n")
    return folder


WRITERS: dict[str, Callable[[Path], Path]] = {
    "vipe": write_vipe, "megasam": write_megasam, "vggt": write_vggt, "wham": write_wham,
    "gvhmr": write_gvhmr, "tum": write_tum, "colmap": write_colmap,
}  # fmt: skip


def test_every_tool_has_a_fixture():
    assert set(WRITERS) == set(names("cameras"))


@pytest.fixture
def capture():
    bodies, room = little_room.walkers(2), replace(little_room.room(), objects=())
    verts = bodies.verts * torch.tensor([1.0, -1, -1])
    bodies = replace(bodies, verts=verts, space="camera")
    return Capture("room", room, None, (), None, None, bodies, None, None, ())


SEEN = torch.tensor([[0.3, 0.2, 3.0], [-1, 0.5, 4]]).expand(COUNT, 2, 3)


def path_from(capture: Capture, T: Any, **more: Any):
    """The path of these arrays, and what is said of it."""
    said: list[str] = []
    at = At({"frame": np.arange(COUNT), "T_world_camera": T, **more}, "cameras.npz")
    return path_of(at, capture.scene.camera, capture.bodies, said.append), said


@pytest.mark.parametrize("tool", WRITERS)
def test_the_poses_of_every_tool_come_back_from_a_capture(tool, capture, tmp_path):
    folder, source = tmp_path / "room", tmp_path / "source"
    write_capture(capture, folder)
    source.mkdir()
    at = chosen("--cameras-from", tool, "cameras")(WRITERS[tool](source))
    if "focal" in at.value:
        assert np.allclose(at.value["focal"], FOCAL, rtol=1e-5)
    at = At({**at.value, "reference": np.array(2)}, at.file)
    import_into(folder, Parts("cameras", cameras=at))
    path = read_capture(folder).path
    true = torch.from_numpy(np.linalg.inv(true_path()[2]) @ true_path()).float()
    expected = SEEN @ true[:, :3, :3].mT + true[:, None, :3, 3]
    again = path_of(At(path_to_arrays(path), "c"), capture.scene.camera, None, list[str]().append)
    for one in (path, again):
        found = to_reference(SEEN, poses_at(one, torch.arange(COUNT)))
        assert torch.allclose(found, expected, atol=1e-5)


def test_simple_vo_of_gvhmr_leads_from_world_to_camera(tmp_path):
    """zju3dv/GVHMR, hmr4d/utils/preproc/relpose/simple_vo.py: T_w2c, (L, 4, 4)."""
    np.save(tmp_path / "slam_results.npy", np.linalg.inv(true_path()))
    at = read_slam(tmp_path / "slam_results.npy")
    assert np.allclose(at.value["T_world_camera"], true_path())


def test_whams_sign_for_no_slam_and_colmaps_binary_poses_are_refused_with_their_cure(tmp_path):
    row = np.zeros((COUNT, 7))
    row[:, 3] = 1
    joblib.dump(row, tmp_path / "slam_results.pth")
    with pytest.raises(InputError, match="camera that was followed"):
        read_slam(tmp_path)
    (tmp_path / "images.bin").write_bytes(bytes(8))
    for path in (tmp_path, tmp_path / "images.bin"):
        with pytest.raises(InputError, match=r"^images\.bin: .*model_converter --output_type TXT"):
            read_colmap(path)


@pytest.mark.parametrize(("file", "line", "words"), [
    ("t.txt", "0.5 0 0 0 0 0 0 1", "has 0.5, expected numbers of frames"),
    ("t.txt", "1 0 0 0 0 0 1", "lines of 8 finite numbers"),
    ("t.txt", "1 0 0 nan 0 0 0 1", "lines of 8 finite numbers"),
    ("t.txt", "1 0 0 0 0 0 0 x", "another form"),
    ("t.txt", "1 0 0 0 0 0 0 2", "quaternions of length 1"),
    ("t.txt", "# nothing", "lines of 8 finite numbers"),
    ("images.txt", "1 1 0 0 0 0 0 0 1", "IMAGE_ID QW"),
    ("images.txt", "# nothing", "IMAGE_ID QW"),
    ("images.txt", "1 1 0 0 0 0 0 0 1 2.jpg\n\n2 1 0 0 0 0 0 0 1 2.png", "each picture once"),
    ("images.txt", "1 1 0 0 0 0 0 0 1 a2.jpg\n\n2 1 0 0 0 0 0 0 1 2.png", "both frame 2"),
])  # fmt: skip
def test_wrong_text_is_refused_in_a_sentence(file, line, words, tmp_path):
    (tmp_path / file).write_text(line + "\n")
    with pytest.raises(InputError, match=words):
        (read_colmap if file == "images.txt" else read_tum)(tmp_path)


def test_a_pose_between_two_is_half_way(capture):
    path, _ = path_from(capture, true_path(), frame=np.arange(COUNT) * 10)
    ends = poses_at(path, torch.tensor([0, 10, 20]))
    middle = poses_at(path, torch.tensor([5, 15]))
    t = ends.t_reference_camera
    assert torch.allclose(middle.t_reference_camera, (t[1:] + t[:-1]) / 2)
    R = ends.R_reference_camera
    step = middle.R_reference_camera[0].mT @ R[1]
    assert torch.allclose(step, R[0].mT @ middle.R_reference_camera[0], atol=1e-6)


def test_points_go_there_and_back_and_a_larger_scale_moves_the_camera_alone(capture):
    path, _ = path_from(capture, true_path())
    poses = poses_at(path, torch.arange(COUNT))
    points = torch.randn(COUNT, 5, 3, generator=torch.Generator().manual_seed(0))
    assert torch.allclose(from_reference(to_reference(points, poses), poses), points, atol=1e-5)
    larger = poses_at(scaled(path, 2.0), torch.arange(COUNT))
    moved = to_reference(points, larger) - to_reference(points, poses)
    assert torch.allclose(moved, poses.t_reference_camera[:, None].expand(-1, 5, -1), atol=1e-5)


def test_a_camera_that_never_moves_is_the_still_one(capture):
    path, _ = path_from(capture, np.tile(true_path()[:1], (COUNT, 1, 1)))
    assert path is STILL
    assert is_still(path)
    points = torch.randn(3, 4, 3)
    assert torch.equal(to_reference(points, poses_at(path, torch.arange(3))), points)


def test_wrong_cameras_are_refused_in_a_sentence_and_another_lens_is_said(capture):
    T, good = true_path(), np.arange(COUNT)
    for arrays, words in (
        ({"T": T, "frame": good[::-1]}, "rising frames"),
        ({"T": T[:3]}, r"shape \(6, 4, 4\)"),
        ({"T": T @ np.diag([-1.0, 1, 1, 1])}, "rotation and translation"),
        ({"T": T * 2}, "rotation and translation"),
        ({"T": T, "focal": np.linspace(0.6, 0.8, COUNT)}, "no zoom"),
        ({"T": T, "reference": np.array(9)}, "has a pose"),
        ({"T": T, "frame": good + 2}, "for all bodies, also for frame 0"),
    ):
        with pytest.raises(InputError, match=words):
            path_from(capture, **arrays)
    with pytest.raises(InputError, match="T_world_camera"):
        path_of(At({"frame": good}, "c"), capture.scene.camera, capture.bodies, list[str]().append)
    _, said = path_from(capture, T, focal=np.full(COUNT, 0.9))
    assert "focal length is 0.9 widths" in said[0]


def test_people_of_a_moving_camera_must_be_in_its_axes(capture, tmp_path):
    world = replace(capture.bodies, space="world")
    write_capture(replace(capture, bodies=world), tmp_path / "room")
    at = At({"frame": np.arange(COUNT), "T_world_camera": true_path()}, "cameras.npz")
    with pytest.raises(InputError, match="'space' has 'world', expected 'camera'"):
        import_into(tmp_path / "room", Parts("cameras", cameras=at))


# Lenses, as calibrations give them: the same one in every form.

LENS = (740.5, 741.0, 479.5, 269.5)
FX, FY, CX, CY = LENS
K = [[FX, 0, CX], [0, FY, CY], [0, 0, 1]]
NINE = " ".join(str(v) for row in K for v in row)
YAML = f"""%YAML:1.0
---
image_width: 960
image_height: 540
camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ {FX}, 0., {CX}, 0., {FY},
       {CY}, 0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ 1e-04, 0., 0., 0., 0. ]
"""
ROS = f"""image_width: 960
image_height: 540
camera_name: head
camera_matrix:
  rows: 3
  cols: 3
  data: [{NINE.replace(" ", ", ")}]
distortion_model: plumb_bob
"""
KALIBR = f"""cam0:
  cam_overlaps: []
  camera_model: pinhole
  distortion_coeffs: [1.0e-05, 0.0, 0.0,
    0.0]
  distortion_model: radtan
  intrinsics: [{FX}, {FY}, {CX}, {CY}]
  resolution: [960, 540]
  rostopic: /cam0/image_raw
"""  # as ethz-asl/kalibr writes camchain.yaml
XML = f"""<?xml version="1.0"?><opencv_storage><image_Width>960</image_Width>
<image_Height>540</image_Height><Camera_Matrix type_id="opencv-matrix"><rows>3</rows><cols>3</cols>
<dt>d</dt><data>{NINE}</data></Camera_Matrix></opencv_storage>"""
SIDES = {"width": 960, "height": 540}
REALSENSE = {**SIDES, "fx": FX, "fy": FY, "ppx": CX, "ppy": CY, "coeffs": [0.0] * 5}
DEPTH = {**SIDES, "fx": 380.0, "fy": 380.0, "ppx": 480.0, "ppy": 270.0}
COLMAP = f"# Camera list\n1 PINHOLE 960 540 {FX} {FY} {CX + 0.5} {CY + 0.5}\n"
BINARY = struct.pack("<QiiQQ4d", 1, 1, 1, 960, 540, FX, FY, CX + 0.5, CY + 0.5)


def saved(write: Any, *given: Any, **named: Any) -> bytes:
    file = io.BytesIO()
    write(file, *given, **named)
    return file.getvalue()


LENSES: dict[str, tuple[str, str | bytes | dict[str, Any]]] = {
    "OpenCV's YAML": ("calib.yml", YAML), "ROS": ("head.yaml", ROS), "OpenCV's XML": ("c.xml", XML),
    "Kalibr": ("camchain.yaml", KALIBR),
    "OpenCV's JSON": ("c.json", {**SIDES, "camera_matrix": {"data": np.ravel(K).tolist()}}),
    "a dump": ("d.json", {**SIDES, "mtx": K, "dist": [[0, 0, 0, 0, 0]]}),
    "RealSense": ("rs.json", REALSENSE),
    "RealSense, all": ("all.json", {"serial": "1", "depth": DEPTH, "color": REALSENSE}),
    "Open3D": ("o.json", {**SIDES, "intrinsic_matrix": np.array(K).T.ravel().tolist()}),
    "a dump of arrays": ("calib.npz", saved(np.savez, mtx=np.array(K), **SIDES)),
    "COLMAP": ("cameras.txt", COLMAP), "COLMAP, binary": ("cameras.bin", BINARY),
}  # fmt: skip


def written(folder: Path, name: str, content: str | bytes | dict[str, Any]) -> Path:
    if isinstance(content, dict):
        content = json.dumps(content)
    (folder / name).write_bytes(content if isinstance(content, bytes) else content.encode())
    return folder / name


@pytest.mark.parametrize("kind", LENSES)
def test_every_calibration_gives_the_same_lens(kind, tmp_path):
    """Those that count pixels from the centre of the first one are moved by half of one."""
    path = written(tmp_path, *LENSES[kind])
    found = read_camera_file(path, None).value
    wanted = {"w": 960, "h": 540, "fl_x": FX, "fl_y": FY, "cx": CX + 0.5, "cy": CY + 0.5}
    assert {name: found[name] for name in wanted} == wanted
    if kind.startswith("COLMAP"):
        assert read_camera_file(tmp_path, None).value == found


OWN = {"w": 960, "h": 540, "fl_x": FX, "fl_y": FY, "cx": CX + 0.5, "cy": CY + 0.5}
FOUR = {"fx": FX, "fy": FY, "cx": CX, "cy": CY}
SIZED = LENSES | {
    "our own": ("camera.json", OWN),
    "K": ("k.json", {**SIDES, "K": np.ravel(K).tolist()}),
    "four numbers inside": ("n.json", {**SIDES, "intrinsics": FOUR}),
}


@pytest.mark.parametrize("kind", SIZED)
def test_a_lens_of_another_size_is_scaled_or_refused_with_both_sizes(kind, tmp_path, caplog):
    path = written(tmp_path, *SIZED[kind])
    assert read_camera_file(path, (960, 540)).value.items() >= OWN.items()
    found = read_camera_file(path, (480, 270)).value
    assert found.items() >= {name: value / 2 for name, value in OWN.items()}.items()
    said = "is of pictures of 960 x 540 pixels"
    assert caplog.messages[-1] == f"{path.name}: {said}; it is scaled to the image of 480 x 270"
    for size in ((960, 720), (540, 960)):
        wanted = f"expected the shape of the image, {size[0]} x {size[1]}"
        with pytest.raises(InputError, match=f"^{re.escape(path.name)}: {said}, {wanted}"):
            read_camera_file(path, size)


POINTER = "version https://git-lfs.github.com/spec/v1\noid sha256:4d7a\nsize 12345\n"
NO_LENSES: dict[str, tuple[str, str | bytes | dict[str, Any], str]] = {
    "bent": ("c.yml", YAML.replace("1e-04", "-0.3"), "corners by .* undistort the images"),
    "Kalibr's fisheye": ("c.yaml", KALIBR.replace("radtan", "equidistant"), "undistort the images"),
    "Kalibr's two": ("c.yaml", KALIBR + KALIBR.replace("cam0", "cam1"), "has cam0 and cam1"),
    "a fisheye": ("cameras.txt", COLMAP.replace("PINHOLE", "OPENCV_FISHEYE") + " ", "expected 8"),
    "several": ("cameras.txt", COLMAP + COLMAP.replace("740.5", "800"), "2 cameras, expected one"),
    "cut off": ("cameras.bin", BINARY[:50], "cannot be read .it is damaged, cut off"),
    "no size": ("d.json", {"mtx": K}, "no width and height, expected .* give --image"),
    "an array": ("K.npy", saved(np.save, np.array(K)), "no width and height, .* give --image"),
    "another matrix": ("d.json", {**SIDES, "K": [[1, 2], [3, 4]]}, "'K' has .*3 x 3 numbers"),
    "other words": ("d.json", {"hello": 1}, "one of the fields fl_x, fx, camera_mtx"),
    "text": ("cam_K.txt", "fx fy\n100 abc\n", r"'fx fy 100 abc'.*expected 3 x 3 numbers"),
    "no numbers": ("c.yml", "hello: world\n", "no numbers with names"),
    **{f"a pointer, {end}": (f"c.{end}", POINTER, "pointer of Git LFS.*git lfs pull")
       for end in ("txt", "yml", "xml", "json")},
    "a web page": ("c.json", " <!DOCTYPE html><html>", "web page in place of the file"),
    "nothing": ("c.json", "", "it is empty: copy or download it again"),
}  # fmt: skip


@pytest.mark.parametrize("kind", NO_LENSES)
def test_what_is_no_lens_is_named_in_the_users_words(kind, tmp_path):
    name, content, words = NO_LENSES[kind]
    with pytest.raises(InputError, match=words) as caught:
        read_camera_file(written(tmp_path, name, content), None)
    assert str(caught.value).startswith(name)
    assert not re.search("Error|could not convert", str(caught.value))


def apple_note(gravity: tuple[float, ...], order: str = ">") -> bytes:
    """Apple's maker note with its version and an acceleration, as ExifTool's Apple.pm has it."""
    mark, first = {">": b"MM", "<": b"II"}[order], 14 + 2 + 2 * 12 + 4
    rows = struct.pack(order + "HHHIIHHIII", 2, 1, 9, 1, 14, 8, 10, 3, first, 0)
    words = (n for value in gravity for n in (round(value * 1e6), 1_000_000))
    return b"Apple iOS\0\0\1" + mark + rows + struct.pack(order + "6i", *words)


def photo(path: Path, note: bytes, orientation: int = 1, lens: str = "back camera") -> Path:
    picture = Image.new("RGB", (300, 200))
    exif = picture.getexif()
    exif[0x0112] = orientation
    exif.get_ifd(0x8769).update({0xA405: 26, 0x927C: note, 0xA434: f"iPhone 13 Pro {lens}"})
    picture.save(path, exif=exif)
    return path


@pytest.mark.parametrize(("orientation", "gravity", "tilt"), [
    (6, (0.02683717579, -0.7210501641, -0.6948792783), (-43.9, 2.1)),  # ExifTool's example
    (6, (0.0, -1.0, 0.0), (0, 0)), (8, (0.0, 1.0, 0.0), (0, 0)), (1, (-1.0, 0.0, 0.0), (0, 0)),
    (3, (1.0, 0.0, 0.0), (0, 0)), (1, (-0.9397, 0.0, -0.3420), (-20, 0)),
    (1, (-0.9848, -0.1736, 0.0), (0, 10)), (3, (0.9848, 0.1736, 0.0), (0, 10)),
    (6, (0.1736, -0.9848, 0.0), (0, 10)), (8, (-0.1736, 0.9848, 0.0), (0, 10)),
])  # fmt: skip
@pytest.mark.parametrize("order", "><")
def test_a_phones_photo_says_its_tilt(orientation, gravity, tilt, order, tmp_path):
    file = photo(tmp_path / "p.jpg", apple_note(gravity, order), orientation)
    said = tilt_of_photo(file)
    turn = pitch_roll(torch.tensor(said["R_cam_world"]))
    assert [math.degrees(float(a)) for a in turn] == pytest.approx(tilt, abs=0.1)
    assert said["tilt_spread"] == pytest.approx(math.radians(1))
    lens = camera_of_photo(file, (3000, 2000))
    assert lens is not None
    assert lens.value["fl_x"] == pytest.approx(3000 * 26 / 36)


@pytest.mark.parametrize("note", [
    b"", b"Apple iOS\0\0\1MM", apple_note((0.0, -1.0, 0.0))[:40], apple_note((0.0, -0.4, 0.0)),
    b"Nikon\0\2\x10\0\0" + apple_note((0.0, -1.0, 0.0)),
    apple_note((0.0, -1.0, 0.0)).replace((1_000_000).to_bytes(4, "big"), bytes(4)),
])  # fmt: skip
def test_a_photo_without_gravity_says_nothing(note, tmp_path):
    assert tilt_of_photo(photo(tmp_path / "p.jpg", note, 6)) == {}
    Image.new("RGB", (3, 2)).save(tmp_path / "bare.png")
    assert tilt_of_photo(tmp_path / "bare.png") == {}
    assert camera_of_photo(tmp_path / "bare.png", (3, 2)) is None
    for orientation in (1, 3, 8):  # pixels that were turned since then
        turned = photo(tmp_path / "t.jpg", apple_note((0.0, -1.0, 0.0)), orientation)
        assert tilt_of_photo(turned) == {}
    front = photo(tmp_path / "f.jpg", apple_note((0.0, -1.0, 0.0)), 6, "front camera")
    assert tilt_of_photo(front) == {}
