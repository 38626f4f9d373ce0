"""Scene, bodies and masks are held against each other, and what is wrong is named."""

import json
import runpy
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from little_room import room, walkers

from mover.core.records import rows_of
from mover.core.types import Bodies, Capture, Detection, Keypoints, Masks, People, Tilt
from mover.geometry.camera import pitch_roll, tilted, to_camera
from mover.geometry.rle import encode, mask_boxes
from mover.io.capture.agreement import (
    agreement,
    box_around,
    in_image,
    outermost,
    outlines,
    thinned_capture,
)
from mover.io.capture.faults import check_against_picture, write_mended
from mover.io.capture.folder import read_capture, write_capture
from mover.io.capture.plausible import check_bodies

FAULTS = runpy.run_path(str(Path(__file__).parents[1] / "benchmarks" / "faults.py"))["FAULTS"]


def masks_of(boxes: torch.Tensor, width: int, height: int) -> Masks:
    """Full boxes as masks."""
    codes = []
    for left, top, right, bottom in boxes.round().long().tolist():
        mask = torch.zeros(height, width, dtype=torch.bool)
        mask[top:bottom, left:right] = True
        codes.append(encode(mask))
    return Masks(height, width, tuple(codes))


@pytest.fixture(scope="module")
def right():
    """A capture whose parts lie on each other exactly."""
    scene, walking = room(), walkers(24, people=2)
    camera, size = scene.camera, (scene.camera.width, scene.camera.height)
    scene = replace(scene, objects=tuple(
        replace(one, annotation=k) for k, one in enumerate(scene.objects)))  # fmt: skip
    boxes = in_image(outlines([outermost(one) for one in scene.objects], camera), camera)
    detections = tuple(
        Detection(k, one.category, box, masks_of(box[None], *size), 1.0)
        for k, (one, box) in enumerate(zip(scene.objects, boxes, strict=True))
    )
    verts = to_camera(walking.verts, camera.R_cam_world)
    low, high = verts.amin(1), verts.amax(1)
    middle = (low + high) / 2
    up = camera.R_cam_world[:, 1]
    bodies = Bodies(
        verts, walking.faces, torch.stack([middle, middle + 0.6 * up], 1), ("pelvis", "head"),
        walking.frame, walking.person, 15.0, "camera", None,
    )  # fmt: skip
    shown = masks_of(in_image(box_around(verts, camera), camera), *size)
    people = People(shown, bodies.frame, bodies.person, {})
    return Capture("right", scene, None, detections, None, None, bodies, people, None, ())


def test_what_lies_on_its_picture_has_no_fault(right):
    assert check_against_picture(right).warnings == ()


def test_it_is_said_that_bodies_without_masks_are_held_against_nothing(right):
    said = "bodies could not be held against the picture"
    whole, bare, alone = (
        check_against_picture(capture).summary
        for capture in (right, replace(right, people=None), replace(right, bodies=None))
    )
    assert [any(said in line for line in lines) for lines in (whole, bare, alone)] == [0, 1, 0]


@pytest.mark.parametrize("name", [
    pytest.param(name, marks=pytest.mark.slow) if number % 3 else name
    for number, name in enumerate(FAULTS)
])  # fmt: skip
def test_a_fault_is_named_and_mended(right, name):
    words, change = FAULTS[name]
    harmed = change(right)
    if harmed is None:
        pytest.skip("this room has nothing that shows it")
    findings = check_against_picture(harmed)
    assert any(words in text for text in findings.warnings), findings.warnings
    for fault in findings.faults:
        harmed = fault.mend(harmed)
    mended = agreement(thinned_capture(harmed))
    assert float(mended.objects.mean()) > 0.9
    assert float(mended.people.nanmean()) > 0.9


@pytest.mark.slow
@pytest.mark.parametrize("name", ["the camera upside down", "positions with y down"])
def test_a_mended_camera_takes_its_measured_tilt_along(right, name):
    harmed = FAULTS[name][1](right)
    angles = [float(a) for a in pitch_roll(harmed.scene.camera.R_cam_world)]
    mended = replace(harmed, tilt=Tilt(*angles, 0.02))
    for fault in check_against_picture(mended).faults:
        mended = fault.mend(mended)
    R = tilted(torch.tensor(mended.tilt.pitch), torch.tensor(mended.tilt.roll))
    assert torch.allclose(R, mended.scene.camera.R_cam_world, atol=1e-5)


@pytest.mark.slow
def test_parts_of_different_pictures_and_nothing_to_compare_are_said(right):
    boxes = [torch.tensor([600.0 - 20 * k, 5, 610 - 20 * k, 10]) for k in range(3)]
    pairs = zip(right.detections, boxes, strict=True)
    elsewhere = tuple(replace(one, box=box, mask=None) for one, box in pairs)
    lone = replace(right, detections=elsewhere, bodies=None, people=None)
    (said,) = check_against_picture(lone).warnings
    assert "one room" in said
    first, *rest = right.detections
    (said,) = check_against_picture(
        replace(right, detections=(replace(first, box=boxes[0], mask=None), *rest))
    ).warnings
    assert f"{right.scene.objects[0].id} not where the annotation is" in said
    bare = replace(right, detections=(), people=None)
    (said,) = check_against_picture(bare).warnings
    assert "nothing could be held against the picture" in said


OF_BODIES = [name for name in FAULTS if name.startswith("bodies")]


def with_joints(capture: Capture, track: int = 0) -> Capture:
    """Joints in place of masks: corners of the boxes less their skin."""
    boxes, frame = mask_boxes(capture.people.masks), capture.people.frame
    low, high = boxes.float().split(2, 1)
    side = (high - low).amax(1, keepdim=True)
    low, high = low + side * torch.tensor([0.05, 0.08]), high - side * 0.05
    points = torch.zeros(len(frame), 17, 2)
    points[:, 5:9] = torch.stack([low, high, (low + high) / 2, low], 1)
    sure = torch.zeros(len(frame), 17)
    sure[:, 5:9] = 0.9
    keypoints = Keypoints(points, sure, "coco17", frame, capture.people.person + track, 15.0)
    return replace(capture, people=None, keypoints=keypoints)


def test_bodies_on_their_keypoints_have_no_fault(right):
    findings = check_against_picture(with_joints(right, 7))
    assert findings.warnings == ()
    (said,) = [text for text in findings.summary if "bodies" in text]
    assert "bodies and their keypoints share 9" in said


@pytest.mark.parametrize("name", OF_BODIES)
def test_without_masks_keypoints_show_the_faults_of_bodies(right, name):
    words, change = FAULTS[name]
    findings = check_against_picture(change(with_joints(right)))
    said = [text for text in findings.warnings if words in text]
    assert said, findings.warnings
    assert "mask" not in said[0]


def test_a_person_whom_no_keypoints_show_is_named(right):
    joints = with_joints(right).keypoints
    alone = rows_of(joints, joints.person == right.people.person[0])
    lone = int(right.bodies.person.unique()[right.bodies.person.unique() != alone.person[0]])
    (said,) = check_against_picture(replace(right, people=None, keypoints=alone)).warnings
    assert said == f"bodies.npz: no keypoints show person {lone}, whom the bodies have"


@pytest.mark.parametrize("see", [lambda one: one, with_joints])
def test_one_person_of_several_who_is_elsewhere_is_named(right, see):
    bodies = right.bodies
    lone = int(bodies.person.max())
    away = torch.tensor([0.4, -0.3, 2.0]) * (bodies.person == lone)[:, None, None]
    turned = bodies.verts + away * bodies.verts[:1].abs().amax((0, 1))
    found = check_against_picture(replace(see(right), bodies=replace(bodies, verts=turned)))
    assert any(f"person {lone} miss their" in text for text in found.warnings), found.warnings


def test_keypoints_of_a_folder_are_read_where_there_are_no_masks(right, tmp_path):
    given = with_joints(right)
    write_capture(given, tmp_path / "one")
    found = read_capture(tmp_path / "one").keypoints
    assert torch.equal(found.points, given.keypoints.points)
    assert torch.equal(found.person, given.keypoints.person)
    write_capture(replace(given, people=right.people), tmp_path / "both")
    assert read_capture(tmp_path / "both").keypoints is None  # masks show more
    triples = torch.cat([given.keypoints.points, given.keypoints.confidence[..., None]], -1)
    write_capture(replace(given, keypoints=None), tmp_path / "folder")
    for frame in given.keypoints.frame.unique().tolist():
        rows = triples[given.keypoints.frame == frame]
        people = [{"pose_keypoints_2d": [*row.flatten().tolist(), *([0.0] * 24)]} for row in rows]
        path = tmp_path / "folder" / "keypoints" / f"{frame:06d}_keypoints.json"
        path.parent.mkdir(exist_ok=True)
        path.write_text(json.dumps({"people": people}))
    capture = read_capture(tmp_path / "folder")
    assert capture.keypoints.layout == "openpose25"
    late = FAULTS["bodies 2 frames early"][1](capture)
    assert any("2 frames early" in text for text in check_against_picture(late).warnings)


def test_unreadable_keypoints_are_said_and_stop_nothing(right, tmp_path):
    write_capture(replace(right, people=None), tmp_path)
    (tmp_path / "keypoints.npz").write_text("no archive")
    capture = read_capture(tmp_path)
    assert capture.keypoints is None
    (said,) = [text for text in capture.warnings if "keypoints.npz" in text]
    assert said.endswith("bodies are not held against it")


@pytest.mark.slow
def test_a_mended_capture_is_written_beside_the_given_one(right, tmp_path):
    harmed = FAULTS["bodies 5 frames late"][1](right)
    write_capture(harmed, tmp_path / "in")
    (tmp_path / "in" / "notes.txt").write_text("mine")
    given = read_capture(tmp_path / "in")
    write_mended(given, check_against_picture(given), tmp_path / "in", tmp_path / "out")
    assert (tmp_path / "out" / "notes.txt").read_text() == "mine"
    found = read_capture(tmp_path / "out")
    assert torch.equal(found.bodies.frame, right.bodies.frame)
    assert check_against_picture(found).warnings == ()
    with pytest.raises(Exception, match="there already"):
        write_mended(given, check_against_picture(given), tmp_path / "in", tmp_path / "out")
    nobody = {"images": [], "annotations": [], "categories": []}
    (tmp_path / "in" / "people.json").write_text(json.dumps(nobody))
    given = read_capture(tmp_path / "in")
    write_mended(given, check_against_picture(given), tmp_path / "in", tmp_path / "new")
    assert read_capture(tmp_path / "new").people is None


def test_a_mesh_on_its_side_does_not_lay_the_others_down(right):
    """It gains more than two others lose: the mean alone would turn all three."""
    few = replace(right, scene=replace(right.scene, objects=right.scene.objects[:3]))
    harmed = FAULTS["one mesh with +z up"][1](few)
    (fault,) = check_against_picture(harmed).faults
    assert (
        fault.name == f"scene.json: the mesh of {few.scene.objects[0].id} is on the side (+z is up)"
    )
    mended = fault.mend(harmed).scene.objects
    assert all(a.mesh is b.mesh for a, b in zip(mended[1:], few.scene.objects[1:], strict=True))


def test_no_cure_is_named_that_leads_to_where_nothing_is_seen(right):
    """Objects all over the world: a unit may gain a little, and puts the room before the lens."""
    away = torch.tensor([[3.0, -9.0, 8.0], [-5.0, 7.0, -30.0], [9.0, 2.0, 14.0]])
    some = tuple(replace(one, t_world_object=at)
                 for one, at in zip(right.scene.objects[:3], away, strict=True))  # fmt: skip
    found = check_against_picture(replace(right, scene=replace(right.scene, objects=some)))
    assert not found.faults
    assert any("are scene, camera and picture of one room" in text for text in found.unexplained)


def test_a_frame_rate_with_which_people_are_too_fast_for_a_room_is_asked_about(right):
    said, bodies = [], replace(right.bodies, frame=right.bodies.frame // 3, fps=5.0)
    check_bodies(bodies, "bodies.npz", said.append)
    check_bodies(replace(bodies, fps=90.0), "bodies.npz", said.append)
    (one,) = said
    assert "frame rate 90 right" in one
