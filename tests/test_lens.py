"""The focal length from the straight lines of a picture (`find_lens`, `room_lines`)."""

import dataclasses
import functools
import json
import math
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from kept_rooms import thinned
from test_pipeline import light

from mover.core.errors import InputError
from mover.core.records import rows_of
from mover.core.run import Run
from mover.core.types import Camera, Tilt
from mover.geometry.boxes import box_of
from mover.geometry.camera import pitch_roll, project, tilted
from mover.geometry.rotations import axis_angle, rot_y
from mover.io.capture.folder import read_capture, write_capture
from mover.pipeline.people import estimate_people, through_its_lens
from mover.pipeline.presets import PAPER, ROBUST
from mover.pipeline.reconstruct import reconstruct
from mover.stages.camera.find_lens import LensInputs, find_lens, through_lens
from mover.stages.camera.room_lines import (
    Prior,
    RoomPose,
    Segments,
    _lean,
    find_segments,
    fit_room,
    sines,
    sines_and_slopes,
)
from mover.stages.config import LensConfig
from mover.stages.people.find_depth import pelvis
from mover_bench.rooms.noise import wrong_lens

W, H, FOCAL = 960, 540, 760.0
ON = LensConfig(use=True)
REAL = Path(__file__).parents[2] / "shared" / "data" / "total3d_1" / "input" / "img.jpg"
KINECT = 529.5
"""Focal length of its calibrated camera [px] (SUN RGB-D)."""


def camera_of(focal: float, pitch: float = -0.2, roll: float = 0.02) -> Camera:
    K = torch.tensor([[focal, 0, W / 2], [0, focal, H / 2], [0, 0, 1.0]])
    return Camera(K, tilted(torch.tensor(pitch), torch.tensor(roll)), W, H)


def lines_in(picture, masks=None):
    return find_segments(picture, None, torch.tensor([W / 2, H / 2]), masks=masks)


@functools.cache
def drawn(heading, seed, **boxes):
    """Lines of a picture of boxes' edges."""
    return lines_in(*picture_of(heading, seed, **boxes))


def picture_of(heading, seed, boxes=9, askew=0, only=None, off=(0.0, 0.0), solid=False):
    """Boxes' edges by OpenCV, which shares nothing with the method.

    Solid boxes hide each other, and have masks.
    """
    rng, camera = np.random.default_rng(seed), camera_of(FOCAL)
    picture = np.full((H, W, 3), 235, np.uint8)
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float) - 0.5
    pairs = [(a, b) for a in range(8) for b in range(a) if abs(corners[a] - corners[b]).sum() == 1]
    turn = rot_y(torch.tensor(heading, dtype=torch.float64)).numpy()
    R = camera.R_cam_world.double().numpy()
    made = []
    for k in range(boxes + askew):
        own = turn if k < boxes else rot_y(torch.tensor(rng.uniform(0, np.pi))).double().numpy()
        if off[1]:  # each stands a little off the axes of the room
            angle = np.radians(rng.uniform(*off)) * rng.choice([-1, 1])
            own = own @ rot_y(torch.tensor(angle)).double().numpy()
        size = rng.uniform(0.4, 1.4, 3)
        middle = np.array([rng.uniform(-2, 2), rng.uniform(-1.4, 0), rng.uniform(-5, -3)])
        seen = ((corners * size) @ own.T + middle) @ R.T
        made.append((seen[:, 2].mean(), seen[:, :2] / seen[:, 2:] * FOCAL + [W / 2, H / 2]))
    label = np.zeros((H, W), np.uint8)
    for k, (_, pixel) in enumerate(sorted(made, key=lambda one: -one[0]) if solid else made):
        if solid:
            hull = cv2.convexHull(pixel.round().astype(np.int32))
            cv2.fillConvexPoly(picture, hull, (200, 205, 210))
            cv2.fillConvexPoly(label, hull, k + 1)
        for a, b in pairs:
            if only is None or abs(corners[a] - corners[b])[only]:
                ends = [tuple(round(16 * v) for v in pixel[i]) for i in (a, b)]
                cv2.line(picture, *ends, (60, 70, 80), 2, cv2.LINE_AA, 4)
    noisy = picture + rng.normal(0, 4, picture.shape)
    masks = torch.from_numpy(label) == torch.arange(1, len(made) + 1)[:, None, None]
    return torch.from_numpy(noisy.clip(0, 255) / 255).float(), masks if solid else None


def lens_of(segments: Segments, focal: float, spread: float | None):
    camera = camera_of(focal, -0.17, 0.0)  # tilt is known to some degrees
    return find_lens(LensInputs(segments, camera, spread, ON.tilt), ON)


@pytest.mark.parametrize(
    ("off", "heading"),
    [(1.07, 0.7),
     *(pytest.param(*one, marks=pytest.mark.slow) for one in (
         (0.93, 0.0), (1.0, 0.3), (1.0, 0.0), (1.07, 0.0), (0.93, 0.3), (1.07, 0.3), (0.93, 0.7),
         (1.0, 0.7)))],
)  # fmt: skip
def test_a_guessed_lens_is_found_from_boxes_that_stand_along_a_room(off: float, heading: float):
    found = lens_of(drawn(heading, seed=3, askew=2), off * FOCAL, 0.055)
    assert found.spread < 0.03
    assert abs(math.log(found.zoom * off)) < max(2.5 * found.spread, 0.015)
    assert abs(math.log(found.zoom * off)) < 0.025


@pytest.mark.parametrize("heading", [0.0, 0.3, 0.7, 1.4])
def test_the_heading_of_a_room_is_found_from_what_stands_along_it(heading: float):
    found = lens_of(drawn(heading, seed=3, askew=2), FOCAL, 0.0)
    off = math.remainder(found.heading.yaw - heading, math.pi / 2)
    assert abs(off) < min(math.radians(0.5), 3 * found.heading.spread)
    assert abs(found.tilt.pitch + 0.2) < math.radians(0.5)


@pytest.mark.slow
def test_the_stated_error_holds():
    found = [lens_of(drawn(0.1 * k, seed=k, askew=3), 1.06 * FOCAL, 0.055) for k in range(10)]
    off = [math.log(one.zoom * 1.06) / one.spread for one in found if one.spread]
    assert math.sqrt(np.mean(np.square(off))) < 1.5


@pytest.mark.slow
@pytest.mark.parametrize(
    ("off", "count"),
    [((3.0, 8.0), 3), ((0.0, 0.0), 12), ((3.0, 8.0), 12), ((3.0, 15.0), 12)],
)
def test_right_angles_of_each_object_give_the_lens_wherever_it_is_turned(off, count):
    errors, spreads = [], []
    for seed in range(count):
        guess = math.exp(0.055 * np.random.default_rng(seed + 100).standard_normal())
        found = lens_of(drawn(0.3, seed, off=off, solid=True), guess * FOCAL, 0.055)
        errors.append(math.log(found.zoom * guess))
        spreads.append(found.spread)
    rms, spread = (float(np.sqrt(np.mean(np.square(x)))) for x in (errors, spreads))
    assert rms < 0.01  # of a guess that is off by .055
    assert rms < 1.2 * spread < 0.018


@pytest.mark.parametrize("off", [0.94, 1.0, 1.09])
def test_a_lens_of_which_nothing_is_stated_is_kept(off: float):
    found = lens_of(drawn(0.5, seed=1), off * FOCAL, None)
    assert found.zoom == 1
    assert found.spread == pytest.approx(0.01)
    assert found.warnings == ()


@pytest.mark.slow
@pytest.mark.parametrize(("off", "word"), [(1.09, "shorter"), (0.93, "longer")])
def test_a_stated_guess_that_lines_correct_is_a_sentence(off: float, word: str):
    found = lens_of(drawn(0.5, seed=1), off * FOCAL, 0.055)
    assert found.zoom == pytest.approx(1 / off, rel=0.025)
    assert "focal length" in found.warnings[0]
    assert word in found.warnings[0]


@pytest.mark.parametrize("picture", ["blank", "verticals", "noise"])
def test_a_picture_without_evidence_leaves_the_lens(picture: str):
    made = {
        "blank": lambda: lines_in(torch.full((H, W, 3), 0.5)),
        "verticals": lambda: drawn(0.4, seed=2, only=1),
        "noise": lambda: lines_in(torch.rand(H, W, 3, generator=torch.Generator().manual_seed(0))),
    }[picture]()
    assert lens_of(made, 1.08 * FOCAL, None).zoom == 1
    declared = lens_of(made, 1.08 * FOCAL, 0.055)
    assert declared.spread > 0.04
    assert declared.heading is None
    assert abs(math.log(declared.zoom)) < 0.03


@pytest.mark.skipif(not REAL.exists(), reason="the shared data are not here")
@pytest.mark.parametrize(
    ("off", "most"),
    [(1.0, 0.015), *(pytest.param(*one, marks=pytest.mark.slow)
                     for one in ((0.93, 0.045), (1.07, 0.02)))],
)  # fmt: skip
def test_a_photo_of_a_calibrated_camera_gives_its_lens(off: float, most: float):
    picture = torch.from_numpy(cv2.imread(str(REAL))[..., ::-1] / 255.0).float()
    K = torch.tensor([[off * KINECT, 0, 365], [0, off * KINECT, 265], [0, 0, 1.0]])
    camera = Camera(K, tilted(torch.tensor(-0.28), torch.tensor(0.05)), 730, 530)
    segments = find_segments(picture, None, K[:2, 2])
    guess = find_lens(LensInputs(segments, camera, 0.055, ON.tilt), ON)
    assert abs(math.log(off * guess.zoom)) < most
    if off == 1:
        assert find_lens(LensInputs(segments, camera, None, ON.tilt), ON).zoom == 1


def test_slopes_are_those_of_the_angles():
    rng = torch.Generator().manual_seed(1)
    middle = 200 * torch.randn(7, 2, generator=rng).double()
    along = torch.nn.functional.normalize(torch.randn(7, 2, generator=rng).double(), dim=-1)
    one, group = torch.ones(7).double(), torch.tensor([0, 0, 1, 1, 2, 2, 2])
    segments = Segments(middle, along, one, one, group)
    focal, askew = torch.tensor([700.0]).double().log(), torch.tensor([[0, 0.1, -0.2]]).double()
    pitch, roll, yaw = torch.tensor([-0.2, 0.1, 0.4]).double()
    R = (tilted(pitch, roll) @ rot_y(yaw))[None]

    def angles(x: torch.Tensor, turn: torch.Tensor):
        pose = RoomPose(focal + x[:1], axis_angle(x[1:])[None] @ R, askew + turn)
        return sines(segments, pose)[0]

    zero = torch.zeros(4, dtype=torch.float64), torch.zeros(3, dtype=torch.float64)
    common, turns = torch.autograd.functional.jacobian(angles, zero)
    value, slope = sines_and_slopes(segments, RoomPose(focal, R, askew))
    assert torch.equal(value[0], angles(*zero))
    assert torch.allclose(slope[0, ..., :4], common, atol=1e-12)
    assert torch.allclose(slope[0, ..., 4], turns[:, range(7), group], atol=1e-12)


@pytest.mark.parametrize("plane", [False, True])
def test_slopes_are_those_of_the_way_up(plane: bool):
    R = tilted(torch.tensor(-0.2), torch.tensor(0.1)).double()[None]
    up = tilted(torch.tensor(-0.25), torch.tensor(0.05)).double()[:, 1]
    prior = Prior(math.log(700), 0.05, up, 0.1, plane)

    def lean(x: torch.Tensor):
        pose = RoomPose(math.log(730) + x[:1], axis_angle(x[1:])[None] @ R, R[:, :1, 0])
        return _lean(prior, pose)[0]

    at = torch.zeros(4, dtype=torch.float64)
    wanted = torch.autograd.functional.jacobian(lean, at)[0]
    _, slope = _lean(prior, RoomPose(torch.tensor([math.log(730)]).double(), R, R[:, :1, 0]))
    assert torch.allclose(slope[0].mT, wanted, atol=1e-8)


@pytest.mark.parametrize("zoom", [0.93, 1.08])
def test_a_floor_under_feet_is_as_steep_as_the_lens_makes_it(zoom: float):
    """People are as many times too far as the lens is too long, and so their floor leans."""
    true = camera_of(FOCAL)
    rng = np.random.default_rng(0)
    R = true.R_cam_world.double()
    soles = torch.from_numpy(rng.uniform([-2, -1.5, -6], [2, -1.5, -2], (40, 3))) @ R.mT
    soles = soles * torch.tensor([1, 1, zoom])  # as a tool sees them under the wrong lens
    middle = soles - soles.mean(0)
    normal = torch.linalg.svd(middle).Vh[2]
    normal = normal * (normal @ R[:, 1]).sign()
    pose = RoomPose(torch.tensor([math.log(FOCAL)]).double(), R[None], R[None, :1, 0])
    seen = Prior(math.log(zoom * FOCAL), 0.05, normal, 0.01, up_is_plane=True)
    assert float(_lean(seen, pose)[0].norm()) < 1e-6
    fixed = dataclasses.replace(seen, up_is_plane=False)
    assert float(_lean(fixed, pose)[0].norm()) > 0.01


def exact(camera: Camera, seed: int = 0) -> tuple[Segments, torch.Tensor]:
    """Sixty lines along the axes of a room that stands askew, and its axes in those of a camera."""
    R = camera.R_cam_world.double() @ rot_y(torch.tensor(0.35).double())
    rng = np.random.default_rng(seed)
    start = torch.from_numpy(rng.uniform([-2, -1, -6], [2, 1, -3], (60, 3)))
    axis = torch.eye(3).double()[torch.arange(60) % 3] * 0.5
    ends = torch.stack([project((start + k * axis) @ R.mT, camera.K.double()) for k in (0, 1)], 1)
    gap = ends[:, 1] - ends[:, 0]
    length = gap.norm(dim=-1)
    return Segments(
        ends.mean(1) - torch.tensor([W / 2, H / 2]), gap / length[:, None], 1 / length,
        torch.ones(60).double(), torch.zeros(60).long(),
    ), R  # fmt: skip


@pytest.mark.slow
def test_lines_of_two_cameras_state_an_error_as_wide_as_they_differ():
    """Each camera fits its lines sharply, and halves of all of them now this one, now that one."""
    apart, (one, _) = 0.2, exact(camera_of(FOCAL))
    other, _ = exact(camera_of(FOCAL * math.exp(apart)), seed=1)
    both = Segments(*(torch.cat([getattr(x, f.name) for x in (one, other)])
                      for f in dataclasses.fields(Segments)))  # fmt: skip
    one, both = (dataclasses.replace(x, error=0.3 * x.error) for x in (one, both))
    alone = lens_of(one, 1.02 * FOCAL, 0.15)
    assert abs(math.log(alone.zoom * 1.02)) < alone.spread < 0.02
    assert apart / 5 < lens_of(both, math.exp(apart / 2) * FOCAL, 0.15).spread


def test_the_whole_camera_is_found_in_exact_lines():
    camera = camera_of(FOCAL)
    segments, R = exact(camera)
    up = camera_of(FOCAL, -0.15, 0.0).R_cam_world[:, 1].double()
    prior = Prior(math.log(1.08 * FOCAL), 0.2, up, 0.1)
    found = fit_room(segments, prior, camera_of(FOCAL, -0.15, 0.0).R_cam_world)
    assert float(found.pose.log_focal[0]) == pytest.approx(math.log(FOCAL), abs=2e-3)
    lean = found.pose.R_cam_room[0, :, 1] @ camera.R_cam_world[:, 1].double()
    assert float(lean) > math.cos(2e-3)
    between = (found.pose.R_cam_room[0].mT @ R).abs()
    assert float(between.amax(1).amin()) > math.cos(3e-3)


def test_the_picture_stays_under_another_lens(small_room):
    capture = small_room.capture
    zoomed = through_lens(capture, 1.07, pinned=(capture.scene.objects[0].id,))
    old, new = capture.scene, zoomed.scene
    for k, (a, b) in enumerate(zip(old.objects, new.objects, strict=True)):
        x, y = (s.camera.R_cam_world @ box_of(p).center for s, p in ((old, a), (new, b)))
        if k == 0:
            assert torch.equal(a.t_world_object, b.t_world_object)
        else:
            pixels = project(x[None], old.camera.K), project(y[None], new.camera.K)
            assert torch.allclose(*pixels, atol=1e-2)
            assert float(y[2] / x[2]) == pytest.approx(1.07, rel=1e-4)
            assert torch.equal(a.yaw, b.yaw)
    before, after = pelvis(capture.bodies), pelvis(zoomed.bodies)
    pixels = project(before, old.camera.K), project(after, new.camera.K)
    assert torch.allclose(*pixels, atol=1e-2)
    back = through_lens(zoomed, 1 / 1.07, pinned=(capture.scene.objects[0].id,))
    assert torch.allclose(back.bodies.verts, capture.bodies.verts, atol=1e-5)


def test_only_robust_asks_the_lines():
    assert ROBUST.lens.use
    assert not PAPER.lens.use


def test_a_capture_keeps_what_it_says_of_its_lens(small_room, tmp_path):
    capture = thinned(small_room.capture)
    guessed = dataclasses.replace(capture, focal_spread=0.055)
    write_capture(guessed, tmp_path / "guessed")
    assert read_capture(tmp_path / "guessed").focal_spread == 0.055
    write_capture(capture, tmp_path / "silent")
    silent = read_capture(tmp_path / "silent")
    assert silent.focal_spread is None
    assert not silent.focal_by_lines
    write_capture(dataclasses.replace(guessed, focal_by_lines=True), tmp_path / "by lines")
    assert read_capture(tmp_path / "by lines").focal_by_lines


def test_a_capture_keeps_a_measured_tilt_beside_that_of_its_scene(small_room, tmp_path):
    camera = small_room.capture.scene.camera
    pitch, roll = (float(a) + 0.02 for a in pitch_roll(camera.R_cam_world))
    tilt = Tilt(pitch, roll, 0.01)
    write_capture(dataclasses.replace(thinned(small_room.capture), tilt=tilt), tmp_path)
    back = read_capture(tmp_path)
    assert dataclasses.astuple(back.tilt) == pytest.approx(dataclasses.astuple(tilt), abs=1e-6)
    assert torch.allclose(back.scene.camera.R_cam_world, camera.R_cam_world, atol=1e-6)
    assert not [w for w in back.warnings if "camera" in w]
    given = json.loads((tmp_path / "camera.json").read_text())
    for change, said in (
        ({"tilt_spread": 0}, "tilt_spread"), ({"R_cam_world": None}, "tilt_spread.*R_cam_world"),
    ):  # fmt: skip
        (tmp_path / "camera.json").write_text(json.dumps({**given, **change}))
        with pytest.raises(InputError, match=rf"camera\.json.*{said}"):
            read_capture(tmp_path)


@pytest.mark.parametrize("lines", [True, False])
@pytest.mark.parametrize("config", [PAPER, ROBUST], ids=["paper", "robust"])
def test_a_measured_tilt_holds_where_one_step_leaves_the_camera_open(
    small_room, config, lines: bool, tmp_path
):
    whole, true = thinned(small_room.capture), small_room.truth.camera
    one = rows_of(whole.bodies, whole.bodies.frame == whole.bodies.frame.max())
    pitch, roll = (float(a) for a in pitch_roll(true.R_cam_world))
    wrong = tilted(torch.tensor(pitch + 0.05), torch.tensor(roll - 0.05))
    scene = dataclasses.replace(whole.scene, camera=dataclasses.replace(true, R_cam_world=wrong))
    capture = dataclasses.replace(whole, scene=scene, bodies=one, people=None)
    if not lines:
        capture = dataclasses.replace(capture, reference=None)

    def off(tilt: Tilt | None) -> float:
        given = dataclasses.replace(capture, tilt=tilt)
        given = through_its_lens(given, config, Run(tmp_path / str(tilt)), ())
        found = estimate_people(given, config, Run(tmp_path / str(tilt))).alignment
        angles = pitch_roll(found.camera.R_cam_world)
        return max(abs(float(a) - b) for a, b in zip(angles, (pitch, roll), strict=True))

    measured = Tilt(pitch + 0.003, roll - 0.003, 0.005)
    assert off(measured) < 0.005
    if not (lines and config.lens.use):
        assert off(None) > 0.02


@pytest.mark.slow
def test_a_room_under_a_guessed_lens_is_rebuilt_under_a_better_one(small_room, tmp_path):
    guessed = wrong_lens(thinned(small_room.capture), 0.055, np.random.default_rng(2))
    given, true = guessed.scene.camera.K[0, 0], small_room.truth.camera.K[0, 0]
    config = light("robust", steps=4)  # the lens is found before anything is placed
    room = reconstruct(guessed, config, Run(tmp_path / "asked"))
    found = room.scene.camera.K[0, 0]
    assert abs(float((found / true).log())) < 0.6 * abs(float((given / true).log()))
    assert torch.equal(room.initial.camera.K, guessed.scene.camera.K)
    for piece, own in zip(room.initial.objects, guessed.scene.objects, strict=True):
        assert torch.equal(piece.t_world_object, own.t_world_object)
    stated = dataclasses.replace(guessed, focal_spread=0.0)
    counted = dataclasses.replace(guessed, focal_by_lines=True)
    for name, capture in (("kept", stated), ("counted", counted)):
        kept = reconstruct(capture, config, Run(tmp_path / name))
        assert torch.equal(kept.scene.camera.K, guessed.scene.camera.K)
