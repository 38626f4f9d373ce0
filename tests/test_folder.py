import dataclasses
import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tiny_capture as tiny
import torch

from mover.core.errors import InputError
from mover.core.records import map_tensors
from mover.geometry.camera import pitch_roll
from mover.geometry.rle import decode
from mover.io.capture.folder import read_capture, write_capture
from mover.io.formats import FORMATS, IMPORTED, chosen, names, read

DATA = Path(__file__).parents[2] / "shared" / "data"


def close(a: object, b: object) -> None:
    """Equal records: numbers to 1e-6, all else exactly; where meshes lie does not count."""
    if isinstance(a, torch.Tensor):
        assert isinstance(b, torch.Tensor)
        assert a.shape == b.shape
        assert a.dtype == b.dtype
        assert torch.allclose(a.double(), b.double(), atol=1e-6, rtol=1e-6)
    elif isinstance(a, tuple):
        assert isinstance(b, tuple)
        for x, y in zip(a, b, strict=True):
            close(x, y)
    elif dataclasses.is_dataclass(a):
        for field in dataclasses.fields(a):
            if field.name not in ("mesh_file", "name", "warnings"):
                close(getattr(a, field.name), getattr(b, field.name))
    else:
        assert a == b


def test_every_field_of_a_capture_arrives_and_truth_is_not_looked_at(folder):
    (folder / "truth").mkdir()
    (folder / "truth" / "scene.json").write_text("broken")
    found = read("folder", folder)
    assert found.name == "tiny"
    assert found.camera_height == 1.45
    camera = found.scene.camera
    assert (camera.width, camera.height) == (tiny.WIDTH, tiny.HEIGHT)
    assert camera.K.tolist() == [[60.0, 0.0, 30.5], [0.0, 58.5, 25.25], [0.0, 0.0, 1.0]]
    tilt = [float(v) for v in pitch_roll(camera.R_cam_world)]
    assert tilt == pytest.approx([tiny.PITCH, tiny.ROLL], abs=1e-6)
    chair, lamp = found.scene.objects
    assert [(p.id, p.category, p.annotation, p.support) for p in (chair, lamp)] == [
        ("chair_0", "chair", 11, "ground"), ("Lampe_ä.2", "Stehlampe", 5, "chair_0"),
    ]  # fmt: skip
    assert torch.allclose(lamp.t_world_object, torch.tensor([0.8, -0.5, -3.2]))
    assert float(lamp.yaw) == pytest.approx(-2.9)
    assert torch.allclose(chair.scale, torch.tensor([0.5, 0.9, 0.6]))
    assert found.scene.ground == -1.4
    assert found.warnings == ()


def test_meshes_come_with_the_transforms_of_their_nodes(folder):
    chair, lamp = read_capture(folder).scene.objects
    step = torch.from_numpy(tiny.STEP).float()
    assert torch.allclose(chair.mesh.verts, step)
    assert chair.mesh.faces.tolist() == tiny.STEP_FACES.tolist()
    assert torch.allclose(lamp.mesh.verts, step / 2 + torch.tensor([0.1, 0.2, 0.3]), atol=1e-6)
    assert Path(lamp.mesh_file).read_bytes() == (folder / "meshes" / "lamp.glb").read_bytes()


def test_evidence_arrives_as_it_was_drawn(folder):
    found = read_capture(folder)
    for detection, index in zip(found.detections, (0, 1), strict=True):
        assert (decode(detection.mask, 0).numpy() == tiny.object_mask(index)).all()
    assert found.detections[0].score == 0.75
    assert found.detections[1].box.tolist() == [40.5, 10, 59.75, 30]
    for row in range(3):
        assert (decode(found.people.masks, row).numpy() == tiny.person_mask(row)).all()
    assert (decode(found.reference_people, 0).numpy() == tiny.person_mask(2)).all()
    assert found.people.frame.tolist() == [0, 0, 3]
    assert found.people.person.tolist() == [0, 7, 0]
    assert found.people.heights == {"0": 1.78}
    assert ((found.reference * 255).round().numpy() == tiny.picture()).all()
    assert (found.touch.numpy() == tiny.touch()).all()


def test_bodies_take_the_frame_rate_of_people_json(folder):
    found = read_capture(folder).bodies
    assert found.fps == 5.0
    assert (found.verts.numpy() == tiny.bodies()["vertices"]).all()
    assert found.joint_names == ("head", "foot")
    np.savez(folder / "bodies.npz", **tiny.bodies(), fps=30.0)
    found = read_capture(folder).bodies
    assert found.fps == 30


def test_writing_and_reading_gives_the_same_capture_also_of_double_precision(folder, tmp_path):
    first = read_capture(folder)
    double = map_tensors(lambda x: x.double() if x.is_floating_point() else x, first)
    write_capture(double, tmp_path / "double")
    close(first, read_capture(tmp_path / "double"))
    write_capture(first, tmp_path / "copy")
    second = read_capture(tmp_path / "copy")
    close(first, second)
    assert [d.mask.counts for d in first.detections if d.mask] == [
        d.mask.counts for d in second.detections if d.mask
    ]
    write_capture(second, tmp_path / "again")
    for path in sorted(p for p in (tmp_path / "copy").rglob("*") if p.is_file()):
        same = tmp_path / "again" / path.relative_to(tmp_path / "copy")
        assert path.read_bytes() == same.read_bytes(), path.name


def test_a_capture_without_anything_optional_is_read_with_a_word_about_each(folder):
    for name in ("bodies.npz", "people.json", "contacts.npz"):
        (folder / name).unlink()
    camera, objects, scene = tiny.camera(), tiny.objects(), tiny.scene()
    del camera["R_cam_world"], objects["images"][0]["file_name"]
    del objects["annotations"][1]["segmentation"], scene["objects"][1]["annotation"]
    objects["annotations"].append({**objects["annotations"][0], "id": 99})
    for name, tree in (("camera", camera), ("objects", objects), ("scene", scene)):
        (folder / f"{name}.json").write_text(json.dumps(tree))
    found = read_capture(folder)
    assert (found.bodies, found.people, found.touch, found.reference) == (None, None, None, None)
    assert found.scene.camera.R_cam_world.tolist() == np.diag([1.0, -1, -1]).tolist()
    said = "\n".join(found.warnings)
    for word in ("bodies.npz", "people.json", "reference.jpg", "annotation 5 without segm",
                 "(5 Stehlampe, 99 chair) without object", "'Lampe"):  # fmt: skip
        assert word.strip("'") in said, (word, said)


def test_what_scene_json_says_about_the_camera_wins(folder):
    other = tiny.camera(fl_x=70.0)
    del other["R_cam_world"]
    tiny.change(folder / "scene.json", "camera", other)
    camera = read_capture(folder).scene.camera
    assert float(camera.K[0, 0]) == 70
    assert float(pitch_roll(camera.R_cam_world)[0]) == pytest.approx(tiny.PITCH, abs=1e-6)


def test_a_heading_turns_the_world_and_leaves_the_view(folder):
    straight = read_capture(folder)
    # The same room in a world that is turned by -heading: same camera picture.
    heading, scene = 0.7, tiny.scene()
    ry = np.diag([1.0, -1, -1]) @ tiny.rotation(0, 0, heading)
    for item in scene["objects"]:
        item["translation"] = (ry.T @ np.array(item["translation"])).tolist()
        item["yaw"] -= heading
    turned = tiny.rotation(tiny.PITCH, tiny.ROLL, heading)
    scene["camera"] = tiny.camera(R_cam_world=turned.tolist())
    (folder / "scene.json").write_text(json.dumps(scene))
    bodies = tiny.bodies()
    for key in ("vertices", "joints"):
        bodies[key] = bodies[key] @ turned  # from camera axes to that world
    bodies["space"] = np.array("world")
    np.savez(folder / "bodies.npz", **bodies)
    found = read_capture(folder)
    assert float(found.scene.camera.R_cam_world[2, 0]) == pytest.approx(0, abs=1e-6)
    assert found.bodies.space == "camera"
    turns = [replace(p, yaw=torch.atan2(p.yaw.sin(), p.yaw.cos())) for p in straight.scene.objects]
    close(replace(straight, scene=replace(straight.scene, objects=tuple(turns))), found)


def test_a_capture_is_not_mixed_with_what_lies_in_its_folder(folder):
    capture = replace(read_capture(folder), people=None, reference_people=None)
    with pytest.raises(ValueError, match=r"has people.json, which the capture lacks"):
        write_capture(capture, folder)


def test_every_row_of_the_table_of_formats_has_a_function_and_a_name_of_its_own():
    homes = [*(("capture",), ("people",), ("cameras",), ("keypoints",), ("export",)), IMPORTED]
    for kinds in homes:
        known = names(*kinds)
        assert len(known) == len(set(known)) > 0
        assert all(callable(chosen("it", name, *kinds)) for name in known)
    assert sum(len(names(*kinds)) for kinds in homes) == len(FORMATS)
    with pytest.raises(ValueError, match=", ".join(sorted(names("capture")))):
        read("prose", Path())
    with pytest.raises(InputError, match="--to: 'dwg' is none of glb, usd"):
        chosen("--to", "dwg", "export")


@pytest.mark.skipif(not DATA.is_dir(), reason="the shared data is not here")
def test_a_real_photograph_is_read_without_a_word():
    found = read_capture(DATA / "photo_bench")
    assert found.warnings == ()
    assert tuple(found.bodies.verts.shape) == (1, 18439, 3)
    assert found.people is not None
    assert tuple(found.reference.shape) == (898, 1600, 3)
    mask = found.detections[0].mask
    assert int(decode(mask, 0).sum()) == 41688  # COCO's own "area" in the file
