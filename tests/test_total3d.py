import math
from pathlib import Path

import make_scenes as layouts
import numpy as np
import pytest
import tiny_capture as tiny
import torch
from kept_mats import mats_read_once as mats_read_once  # for every test
from scipy.io import loadmat
from scipy.spatial.transform import Rotation

from mover.core.errors import InputError
from mover.geometry.boxes import iou2d
from mover.geometry.camera import pitch_roll, project, to_camera
from mover.geometry.placement import place_object
from mover.io.capture.folder import read_capture, write_capture
from mover.io.formats import read

DATA = Path(__file__).parents[2] / "shared" / "data" / "total3d_1"
PITCH, ROLL = -0.25, 0.06
K = np.array([[50.0, 0, 31], [0, 50, 22], [0, 0, 1]])
# A vertex that no face uses counts in the bounds that are stretched to the box.
VERTS = np.concatenate([tiny.STEP, [[0.0, -0.5, 0.0]]])
THINGS = [
    layouts.Thing(name, name, VERTS, np.concatenate([tiny.STEP_FACES, [[1, 1, 1]]]),
                  np.array(place), yaw, np.array(scale))
    for name, place, yaw, scale in (
        ("chair", [0.5, -1.4, -3.0], 0.4, [0.6, 1.0, 0.4]),
        ("wall", [0.0, -1.5, -6.0], 0.0, [6.0, 4.0, 0.2]),
        ("television", [-1.0, 0.1, -4.0], 2.0, [0.8, 0.6, 0.2]),
    )
]  # fmt: skip


def write(folder: Path) -> Path:
    """With Total3D's own angles of the camera: cam_R = R_y(0) R_z(pitch) R_x(roll)."""
    attitude = Rotation.from_euler("ZX", [PITCH, ROLL]).as_matrix()
    R = layouts.T @ attitude.T @ layouts.OURS_TO_T3D
    return layouts.write_total3d(folder, layouts.Room(K, R, (64, 48), -1.45, THINGS))


def test_a_vertex_lands_on_the_pixel_that_total3d_says(tmp_path):
    """By the formulas of its pages, of what stands in the files."""
    folder = write(tmp_path / "room")
    found = read("total3d", folder)
    assert [p.id for p in found.scene.objects] == ["chair_0", "television_2"]
    assert [p.support for p in found.scene.objects] == ["ground", "free"]
    assert found.scene.ground == pytest.approx(-1.45)
    boxes = loadmat(folder / "output" / "bdb_3d.mat")["bdb"][0]
    cam_R = loadmat(folder / "output" / "r_ex.mat")["cam_R"]
    low, high = VERTS.min(0), VERTS.max(0)
    for piece, box in zip(found.scene.objects, (boxes[0][0, 0], boxes[2][0, 0]), strict=True):
        local = (tiny.STEP - (low + high) / 2) / ((high - low) / 2) * box["coeffs"]
        points = local @ box["basis"] + box["centroid"]  # rows, in Total3D's world
        image = points @ cam_R @ np.array([[0, 0, 1], [0, -1, 0], [1, 0, 0]]).T @ K.T
        camera = found.scene.camera
        seen = project(to_camera(place_object(piece).verts, camera.R_cam_world), camera.K)
        assert np.allclose(seen.numpy(), image[:, :2] / image[:, 2:], atol=1e-3)
        assert place_object(piece).faces.tolist() == tiny.STEP_FACES.tolist()
    pitch, roll = pitch_roll(found.scene.camera.R_cam_world)
    assert (float(pitch), float(roll)) == pytest.approx((PITCH, ROLL), abs=1e-6)
    assert float(found.scene.camera.R_cam_world[2, 0]) == pytest.approx(0, abs=1e-6)


BROKEN: list[tuple[str, bytes | None, str]] = [
    ("input/cam_K.txt", b"a b", "cam_K.txt"),
    ("input/cam_K.txt", b"1 2 3\n4 5 6\n7 8 9", "intrinsics"),
    ("input/detections.json", b"[]", "bdb_3d.mat: field 'class_id' has 3 boxes"),
    ("input/detections.json", b'[{"class": "robot"}]', 'class\' has "robot"'),
    ("input/img.jpg", b"", "img.jpg"),
    ("output/bdb_3d.mat", b"junk", "bdb_3d.mat"),
    ("output/r_ex.mat", b"", "r_ex.mat"),
    ("output/0_5.obj", b"v 0 0 0\n", "0_5.obj"),
    ("output/0_5.obj", b"v 0 a 0\nf 1 2 3\n", "0_5.obj"),
    ("output/0_5.obj", b"v 0 0 0\nv 1 1 0\nv 1 0 0\nf 1 2 3\n", "a flat mesh"),
    ("output/0_5.obj", b"v 0 0 0\nv 1 1 0\nv 1 0 1\nf 1 2 9\n", "vertices 0 to 8"),
    *((name, None, Path(name).name) for name in
      ("input/cam_K.txt", "input/img.jpg", "output/layout.mat", "output/2_25.obj")),
]  # fmt: skip


@pytest.mark.parametrize(("file", "content", "words"), BROKEN)
def test_a_broken_or_missing_file_is_named(tmp_path, file, content, words):
    folder = write(tmp_path / "room")
    if content is None:
        (folder / file).unlink()
    else:
        (folder / file).write_bytes(content)
    with pytest.raises(InputError, match=words) as caught:
        read("total3d", folder)
    assert content is None or "expected" in str(caught.value)


@pytest.mark.slow
@pytest.mark.skipif(not DATA.is_dir(), reason="the shared data is not here")
def test_real_output_is_as_loose_and_tilted_as_known_and_survives_as_a_capture(tmp_path):
    found = read("total3d", DATA)
    camera, ious = found.scene.camera, []
    assert [p.annotation for p in found.scene.objects] == list(range(18))
    for piece, detection in zip(found.scene.objects, found.detections, strict=True):
        seen = project(to_camera(place_object(piece).verts, camera.R_cam_world), camera.K)
        low = torch.maximum(seen.amin(0), torch.zeros(2))
        high = torch.minimum(seen.amax(0), torch.tensor([camera.width, camera.height]))
        ious.append(float(iou2d(torch.cat([low, high]), detection.box)))
    assert min(ious[:8]) == pytest.approx(0.30, abs=0.01)
    assert max(ious[:8]) == pytest.approx(0.90, abs=0.01)
    assert sum(ious) / len(ious) > 0.6
    tilt = [math.degrees(angle) for angle in pitch_roll(camera.R_cam_world)]
    assert tilt == pytest.approx([-16.75, 2.76], abs=0.01)
    write_capture(found, tmp_path)
    copy = tmp_path / "meshes" / "chair_10.obj"
    assert copy.read_bytes() == (DATA / "output" / "10_5.obj").read_bytes()
    again = read_capture(tmp_path).scene
    for a, b in zip(found.scene.objects, again.objects, strict=True):
        assert torch.allclose(place_object(a).verts, place_object(b).verts, atol=1e-5)
        assert torch.equal(a.mesh.faces, b.mesh.faces)


@pytest.mark.parametrize(("at", "byte"), [(144, 7), (328, 0), (329, 255)])
def test_a_file_that_kills_its_reader_is_refused(tmp_path, at, byte):
    path = write(tmp_path / "room") / "output" / "bdb_3d.mat"
    content = bytearray(path.read_bytes())
    assert content[at] != byte
    content[at] = byte  # scipy 1.17 dies of each of these
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"^bdb_3d\.mat: cannot be read \(.*\), expected a \.mat"):
        read("total3d", tmp_path / "room")
