"""Real sets: i3DB, on a scene made in its layout and, where it is, on the real one; clips."""

import json
import math
from pathlib import Path

import numpy as np
import pytest
import torch

from mover.core.errors import InputError
from mover.geometry.boxes import box_of
from mover.geometry.camera import pitch_roll, tilted
from mover_bench.cli import ExperimentArgs
from mover_bench.datasets.i3db import HALPE, JOINTS, read_i3db
from mover_bench.experiment import real

REAL = Path(__file__).parents[2] / "shared" / "data" / "i3db"
PITCH, FLOOR = math.radians(-5.0), -1.2
COUCH = {"seat": ((0, 0.25, 0), (1.8, 0.3, 0.8)), "back": ((0, 0.6, -0.35), (1.8, 0.5, 0.1))}
TOP = {"top": ((0, 0.72, 0), (1.2, 0.04, 0.7))}


def write_scene(folder: Path) -> Path:
    """A couch that faces the camera and a bare table top, as amonszpart/iMapper names the files."""
    R = tilted(torch.tensor(PITCH), torch.tensor(0.0)).double().numpy()
    for at, name, parts, place in (
        (0, "couch", COUCH, (-1, FLOOR, -4)),
        (1, "table", TOP, (1, FLOOR, -3)),
    ):
        for where in ("gt/skel_made_GT_objects", "iMapper/skel_output_objects"):
            (folder / where).mkdir(parents=True, exist_ok=True)
            for part, (centre, size) in parts.items():
                world = np.array(centre) + np.array(place)
                data = {
                    "axes": R.tolist(),
                    "scales": list(size),
                    "centroid": (R @ world)[:, None].tolist(),
                }
                (folder / where / f"{at:02d}_{name}_{part}.json").write_text(json.dumps(data))
    K = [[1955.0, 0, 960], [0, 1955.0, 540], [0, 0, 1]]
    (folder / "intrinsics.json").write_text(json.dumps(K))
    rows = {str(j): [100.0 + j, 200.0, 0.0] for j in range(16)}
    found = {
        "3d": {f"{frame:05d}": rows for frame in (1, 2, 3, 4)},
        "confidence": {"frame_ids": [2, 4], "values": [{"0": 0.9}, {"0": 0.8}]},
    }
    (folder / "skel_made_2d_00.json").write_text(json.dumps(found))
    return folder


def test_parts_become_objects_that_stand_in_a_level_world(tmp_path: Path) -> None:
    scene = read_i3db(write_scene(tmp_path / "Scene1"))
    pitch, roll = pitch_roll(scene.truth.camera.R_cam_world)
    assert float(pitch) == pytest.approx(PITCH, abs=1e-5)
    assert float(roll) == pytest.approx(0, abs=1e-5)
    couch, table = scene.truth.objects
    assert [couch.category, table.category] == ["couch", "table"]
    assert scene.truth.ground == pytest.approx(FLOOR + 0.1, abs=1e-4)  # the seat's underside
    assert couch.t_world_object.tolist() == pytest.approx([-1, FLOOR + 0.1, -4], abs=1e-4)
    assert float(couch.yaw) == pytest.approx(0, abs=1e-4)  # the back is behind it
    assert box_of(couch).size.tolist() == pytest.approx([1.8, 0.75, 0.8], abs=1e-4)
    assert box_of(table).size[1] == pytest.approx(0.64, abs=1e-4)  # legs down to that floor
    assert [d.id for d in scene.detections] == [1, 2]
    assert real.overlaps("imapper", [couch, table], scene)["imapper"] == pytest.approx(1)


def test_keypoints_are_those_of_even_frames_in_pixels_of_the_video(tmp_path: Path) -> None:
    keypoints = read_i3db(write_scene(tmp_path / "Scene1")).keypoints
    assert keypoints.layout == "halpe26"
    assert keypoints.frame.tolist() == [1, 2]
    ankle = keypoints.points[:, HALPE["RANK"]]
    assert ankle[0].tolist() == pytest.approx([100.5 * 1080 / 368, 200.5 * 1080 / 368])
    assert keypoints.confidence[:, HALPE["RANK"]].tolist() == pytest.approx([0.9, 0.8])
    assert float(keypoints.confidence.sum()) == pytest.approx(1.7)
    assert len(JOINTS) == 16


def test_wrong_places_are_the_same_each_time_and_off(tmp_path: Path) -> None:
    scene = read_i3db(write_scene(tmp_path / "Scene1"))
    wrong = [real.wrongly_placed(scene, scene.truth.camera) for _ in range(2)]
    for a, b in zip(wrong[0].objects, wrong[1].objects, strict=True):
        assert torch.equal(a.t_world_object, b.t_world_object)
    assert real.overlaps("given", wrong[0].objects, scene)["given"] < 0.9


@pytest.mark.parametrize(("change", "words"), [
    ({}, "--source: expected the folder i3DB"),
    ({"source": "."}, "has no scene of i3DB"),
    ({"source": ".", "variants": ("none",)}, "--variants: 'none' is none of"),
])  # fmt: skip
def test_what_is_no_i3db_is_a_sentence(change, words, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    given = {k: Path(v) if k == "source" else v for k, v in change.items()}
    with pytest.raises(InputError, match=words):
        real.judge_i3db(ExperimentArgs(set="i3db", out=tmp_path, **given))
    with pytest.raises(InputError, match="has no gt/skel_"):
        read_i3db(tmp_path)


def test_a_table_has_a_row_a_scene_and_the_means() -> None:
    rows = {"a": dict.fromkeys(real.I3DB_COLUMNS, 0.2), "b": dict.fromkeys(real.I3DB_COLUMNS, 0.4)}
    lines = real.i3db_table(rows).splitlines()
    assert len(lines) == 5
    assert lines[-1].startswith("| mean | 0.300 |")


@pytest.mark.skipif(not REAL.exists(), reason="the shared data are not here")
def test_the_real_scene_reads_as_it_was_measured_by_others() -> None:
    scene = read_i3db(REAL / "Scene11")
    assert len(scene.truth.objects) == 5
    assert scene.truth.ground == pytest.approx(-1.084, abs=0.02)
    assert math.degrees(float(pitch_roll(scene.truth.camera.R_cam_world)[0])) == pytest.approx(
        -4.72, abs=0.1
    )
    assert len(scene.keypoints.frame) == 175


def test_the_surface_under_a_point_is_the_highest_one_below_it():
    square = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1]])
    floor, seat = square * 4 - 1, square + torch.tensor([0, 0.5, 0.0])
    slope = square.clone()
    slope[:, 1] = 0.2 * slope[:, 0]
    slope[:, 0] += 2
    faces = torch.cat([x[torch.tensor([[0, 1, 2], [0, 2, 3]])] for x in (floor, seat, slope)])
    points = torch.tensor([[0.5, 0.6, 0.5], [0.5, 0.4, 0.4], [0.5, 0.3, 0.4], [2.5, 0.9, 0.5]])
    above = torch.tensor([[9.0, 1.0, 9.0]])
    found = real.tops_below(torch.cat([points, above]), faces)
    assert found.tolist() == pytest.approx([0.5, 0.5, -1, 0.1, -torch.inf], abs=1e-6)


def test_a_folder_without_clips_is_refused_and_a_table_has_a_row_for_each_object(tmp_path: Path):
    for source in (None, tmp_path):
        with pytest.raises(InputError, match="--source: expected a folder of clips"):
            real.judge_clips(ExperimentArgs(set="clips", source=source))
    rows = [{"object": "bed_0", "size": "1.00 x 0.50 x 2.00", "iou": 0.7}, {"object": "chair_0"}]
    table = real.clips_table({"a": {"stature": 1.7, "objects": rows}})
    assert table.count("\n| a | 1.7 |") == 2
    assert "| bed_0 | 1.00 x 0.50 x 2.00 |" in table
