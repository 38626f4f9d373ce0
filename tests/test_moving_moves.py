"""Furniture that is moved before a moving camera: when, and what its frames show of it."""

import dataclasses
from functools import cache
from pathlib import Path

import pytest
import torch
from jaxtyping import Bool
from little_room import GROUND, camera, room
from test_align_views import path_of
from torch import Tensor

from mover.core.run import Run
from mover.core.types import (
    STILL,
    CameraPath,
    Capture,
    Detection,
    Masks,
    People,
    Room,
    Scene,
    Segment,
)
from mover.evaluate.moves import measure_moves
from mover.geometry.camera import project, to_camera
from mover.geometry.path import about, from_reference, poses_at, reversed_poses, to_reference
from mover.geometry.placement import place_object, placed_at
from mover.geometry.raster import first_hit
from mover.geometry.rle import encode, tight_box
from mover.geometry.rotations import rot_y, wrap
from mover.pipeline.moves import Solving, with_moves
from mover.pipeline.presets import ROBUST, Config
from mover.pipeline.reconstruct import reconstruct
from mover.stages.config import MoveConfig
from mover.stages.objects.find_moves import MoveInputs, Stay, find_moves
from mover_bench.studies.job import noisy_room
from mover_bench.studies.sets import SETS

FPS, CHANGE, FRAMES, EVERY = 5.0, 30, 60, 5
CAMERA = camera()
SIZE = CAMERA.height, CAMERA.width


def put_elsewhere(moved: bool) -> Scene:
    """The little room, whose chair goes .9 m aside and back while nobody looks, or stays."""
    scene = room()
    chair = scene.objects[0]
    there = Segment(CHANGE, torch.tensor([0.2, GROUND, -3.6]), torch.tensor(1.0))
    segments = (Segment(0, chair.t_world_object, chair.yaw), there) if moved else ()
    pieces = (dataclasses.replace(chair, segments=segments), *scene.objects[1:])
    pieces = tuple(dataclasses.replace(p, annotation=k + 1) for k, p in enumerate(pieces))
    return dataclasses.replace(scene, objects=pieces)


def seen(scene: Scene, path: CameraPath, frame: int) -> list[Bool[Tensor, "h w"]]:
    """The visible mask of each object."""
    meshes = [place_object(placed_at(piece, frame)) for piece in scene.objects]
    verts = torch.cat([to_camera(mesh.verts, CAMERA.R_cam_world) for mesh in meshes])
    verts = from_reference(verts[None], poses_at(path, torch.tensor([frame])))[0]
    first = [sum(len(m.verts) for m in meshes[:k]) for k in range(len(meshes))]
    faces = torch.cat([mesh.faces + n for mesh, n in zip(meshes, first, strict=True)])
    owner = torch.cat([torch.full((len(m.faces),), k) for k, m in enumerate(meshes)])
    _, face = first_hit(verts, faces, CAMERA.K, SIZE)
    return [(face >= 0) & (owner[face.clamp_min(0)] == k) for k in range(len(meshes))]


@cache
def inputs_of(moved: bool, amount: float) -> MoveInputs:
    """Masks in every fifth frame; the first depths are a tenth off."""
    scene, path = put_elsewhere(moved), path_of(amount, 0.0, 0.0)
    rows = [
        (frame, k + 1, mask)
        for frame in range(0, FRAMES, EVERY)
        for k, mask in enumerate(seen(scene, path, frame))
        if mask.any()
    ]
    masks = Masks(*SIZE, tuple(encode(mask) for _, _, mask in rows))
    frame, number = (torch.tensor([row[k] for row in rows]) for k in (0, 1))
    middle = torch.stack([p.t_world_object for p in scene.objects])
    depth = to_camera(middle, CAMERA.R_cam_world)[:, 2] * torch.tensor([1.1, 0.9, 1.1])
    return MoveInputs(People(masks, frame, number, {}), None, (1, 2, 3), FPS, depth, path, CAMERA.K)


@pytest.fixture(scope="module")
def found() -> tuple[Stay, ...]:
    return find_moves(inputs_of(True, 0.8), MoveConfig()).stays


def test_what_is_put_elsewhere_before_a_moving_camera_is_found(found: tuple[Stay, ...]) -> None:
    assert [(stay.annotation, stay.first) for stay in found] == [(1, 0), (1, 28)]
    assert [stay.sure for stay in found] == [(0, 25), (30, 55)]
    shown = seen(put_elsewhere(moved=True), STILL, 0)[0][1::3, 1::3]
    common = [float((shown & s.mask).sum() / (shown | s.mask).sum()) for s in found]
    assert common[0] > 0.7
    assert common[1] < 0.3


@pytest.mark.parametrize("amount", [0.1, 0.8])
def test_what_stands_still_never_moves_however_the_camera_goes(amount: float) -> None:
    assert find_moves(inputs_of(False, amount), MoveConfig()).stays == ()


def test_a_path_about_a_view_sees_the_same_points_and_reversed_leads_back() -> None:
    path = path_of(0.8, 0.0, 0.1)
    points = torch.randn(FRAMES, 4, 3, generator=torch.Generator().manual_seed(1))
    view = poses_at(path, torch.tensor([20]))
    there = from_reference(points.flatten(0, 1)[None], view)[0].unflatten(0, (FRAMES, 4))
    assert torch.allclose(
        from_reference(there, about(path, view)), from_reference(points, path), atol=1e-5
    )
    turned = to_reference(points, path)
    assert torch.allclose(from_reference(points, reversed_poses(path)), turned, atol=1e-5)


def capture_of(scene: Scene) -> Capture:
    """With masks of the objects in the reference image and in the frames, without people."""
    masks = seen(scene, STILL, 0)
    detections = tuple(
        Detection(
            k + 1,
            "table",
            tight_box(mask),
            Masks(*SIZE, (encode(mask),)),
            1.0,
        )
        for k, mask in enumerate(masks)
    )
    bare = Capture("room", scene, None, detections, None, None, None, None, None, ())
    known = inputs_of(True, 0.8)
    return dataclasses.replace(bare, furniture=known.furniture, path=known.path)


@dataclasses.dataclass
class Solver:
    """Stands for the reconstruction: pieces that are free stand where they truly do."""

    scene: Scene
    given: list[Capture]

    def __call__(
        self, capture: Capture, _config: Config, _run: Run, _pinned: object, _away: object
    ) -> Room:
        """The room; of a segment, the world is told by the pinned sofa."""
        self.given.append(capture)
        pieces = {piece.id: piece for piece in capture.scene.objects}
        here, sofa = self.scene.objects[1], pieces["sofa_0"]
        turn = sofa.yaw - here.yaw
        now = placed_at(self.scene.objects[0], CHANGE if len(self.given) == 3 else 0)
        off = rot_y(turn) @ (now.t_world_object - here.t_world_object)
        chair = dataclasses.replace(
            pieces["chair_0"], t_world_object=sofa.t_world_object + off, yaw=now.yaw + turn
        )
        objects = (chair, *capture.scene.objects[1:])
        scene = dataclasses.replace(capture.scene, objects=objects)
        return Room(scene, scene, scene, None, None, (), (), None, {}, (), path=capture.path)


def test_each_stay_is_rebuilt_about_the_camera_that_saw_it_and_put_back_into_the_room(
    tmp_path: Path,
) -> None:
    scene = put_elsewhere(moved=True)
    capture, solver = capture_of(scene), Solver(scene, [])
    room = with_moves(Solving(capture, ROBUST, Run(tmp_path), solver), ())
    whole, _, after = solver.given
    assert whole.furniture is not None
    chairs = whole.furniture.frame[whole.furniture.person == 1]
    assert int(chairs.max()) < CHANGE
    camera, sofa = after.scene.camera, after.scene.objects[1]
    pixel = project(to_camera(place_object(sofa).verts, camera.R_cam_world), camera.K)
    left, top, low = pixel[:, 0].min(), pixel[:, 1].min(), pixel[:, 1].max()
    seen_sides = after.detections[1].box[[0, 1, 3]]  # the chair hides the fourth
    assert (torch.stack([left, top, low]) - seen_sides).abs().max() < 1
    true = scene.objects[0].segments[1]
    begin, found = after.scene.objects[0], room.scene.objects[0].segments[1]
    assert (found.t_world_object - true.t_world_object).norm() < 1e-3
    assert float(wrap(found.yaw - true.yaw).abs()) < 1e-3
    assert found.frame == CHANGE - 2
    pixel = project(to_camera(begin.t_world_object, camera.R_cam_world), camera.K)
    left, _, right, low = after.detections[0].box.tolist()
    assert left < float(pixel[0]) < right
    assert float(pixel[1]) == pytest.approx(low, abs=30)


@pytest.mark.slow
def test_a_little_room_seen_by_a_held_camera_has_its_piece_in_both_places(tmp_path: Path) -> None:
    little = dataclasses.replace(SETS["mini"].room, moved="put")
    trial = noisy_room(101, dataclasses.replace(SETS["moving-moved"], room=little))
    found = reconstruct(trial.capture, ROBUST, Run(tmp_path)).scene
    assert trial.bodies is not None
    moves = measure_moves(trial.truth, found, trial.bodies.fps)
    assert moves["false"] == 0
    (piece,) = moves["objects"]
    assert min(piece["iou3d"]) > 0.6
    assert piece["late"][0] <= 0.5
