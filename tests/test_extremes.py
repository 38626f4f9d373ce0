"""The main job on extreme captures: it ends, and every number is finite."""

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from test_pipeline import light, run_in

from mover.core.types import Capture, Masks, Mesh
from mover.geometry.camera import to_camera
from mover.geometry.rle import decode
from mover_bench.rooms.render import encode

pytestmark = pytest.mark.slow
GROWN = 8  # 480 x 270 to 3,840 x 2,160


def changed(capture: Capture, **fields: object) -> Capture:
    """The capture with its first object changed."""
    first, *rest = capture.scene.objects
    pieces = (replace(first, **fields), *rest)
    return replace(capture, scene=replace(capture.scene, objects=pieces))


def ends_finite(capture: Capture, folder: Path) -> None:
    """Whether a short run puts everything at finite positions."""
    room = run_in(folder, capture, light("robust", steps=5))
    found = [torch.tensor(room.scene.ground), room.scene.camera.R_cam_world]
    for piece in room.scene.objects:
        found += [piece.t_world_object, piece.yaw, piece.scale]
    for value in found:
        assert value.isfinite().all()


def test_a_mesh_of_half_a_million_faces(small_capture, tmp_path):
    import trimesh

    ball = trimesh.creation.icosphere(subdivisions=7, radius=0.4)  # 327,680 faces
    disc = trimesh.creation.icosphere(subdivisions=6, radius=0.3)
    disc = trimesh.util.concatenate([disc, disc.copy().apply_translation([0.2, 0.3, 0])])
    both = trimesh.util.concatenate([ball, disc])
    assert len(both.faces) == 491520
    mesh = Mesh(torch.tensor(both.vertices).float(), torch.tensor(both.faces))
    ends_finite(changed(small_capture, mesh=mesh), tmp_path)


TRIANGLE = Mesh(torch.tensor([[0.0, 0, 0], [0.5, 0, 0], [0, 0.8, 0]]), torch.tensor([[0, 1, 2]]))
OBJECTS = {
    "a mesh of one triangle": {"mesh": TRIANGLE},
    "behind the camera": {"t_world_object": torch.tensor([0.0, -1.4, 3.0])},
    "outside of the image": {"t_world_object": torch.tensor([40.0, -1.4, -3.0])},
}


@pytest.mark.parametrize("name", OBJECTS)
def test_an_object(name, small_capture, tmp_path):
    behind = to_camera(torch.tensor([[0.0, -1.4, 3.0]]), small_capture.scene.camera.R_cam_world)
    assert behind[0, 2] < -1
    ends_finite(changed(small_capture, **OBJECTS[name]), tmp_path)


def test_bodies_behind_the_camera(small_capture, tmp_path):
    bodies = small_capture.bodies
    moved = replace(bodies, verts=bodies.verts + torch.tensor([0.0, 0, 12.0]), pose=None)
    ends_finite(replace(small_capture, bodies=moved), tmp_path)


def test_an_image_of_4k(small_capture, tmp_path):
    scene, people = small_capture.scene, small_capture.people
    camera = replace(
        scene.camera, K=scene.camera.K * torch.tensor([[GROWN], [GROWN], [1.0]]),
        width=GROWN * scene.camera.width, height=GROWN * scene.camera.height,
    )  # fmt: skip
    assert (camera.width, camera.height) == (3840, 2160)
    found = tuple(
        replace(d, box=GROWN * d.box, mask=None if d.mask is None else enlarged(d.mask))
        for d in small_capture.detections
    )
    large = replace(
        small_capture, scene=replace(scene, camera=camera), reference=None, reference_people=None,
        detections=found, people=replace(people, masks=enlarged(people.masks)),
    )  # fmt: skip
    ends_finite(large, tmp_path)


def enlarged(masks: Masks) -> Masks:
    """The same masks in an image of 4K."""
    small = [decode(masks, row).numpy() for row in range(len(masks.counts))]
    return encode([m.repeat(GROWN, 0).repeat(GROWN, 1) for m in small])
