"""A folder with a small input under every name that the commands in the docs use."""

import dataclasses
import json
import shutil
from pathlib import Path

import make_people
import make_scenes
import numpy as np
import torch
from kept_rooms import some
from make_keypoints import CAMERA, as_bodies, seen, walker
from make_smpl import make_model, write_npz

from mover.app.results import write_truth
from mover.core.types import Capture
from mover.io.capture.bodies_file import write_bodies
from mover.io.capture.camera_file import camera_to_json
from mover.io.capture.edits import placement_of, write_edits
from mover.io.capture.folder import write_capture
from mover.io.files.fields import write_json
from mover.io.people.keypoints import write_keypoints
from mover_bench.rooms.known import KnownRoom


def write_captures(desk: Path, room: KnownRoom, capture: Capture) -> None:
    """CAPTURE with its truth, DIR, a list of captures, a list of edits."""
    write_capture(capture, desk / "CAPTURE")
    write_truth(room.truth, some(room.bodies), desk / "CAPTURE" / "truth")
    (desk / "DIR").symlink_to(Path("CAPTURE") / "truth")
    (desk / "captures").mkdir()
    (desk / "captures" / "one").symlink_to(Path("..") / "CAPTURE")
    (desk / "list.txt").write_text("captures/one  # a remark\n")
    piece = capture.scene.objects[0]
    moved = dataclasses.replace(piece, t_world_object=piece.t_world_object + 0.1)
    write_edits((placement_of(moved, capture.scene),), desk / "edits.json")


def write_scenes(desk: Path, room: KnownRoom) -> None:
    """Total3D's scene of the room, and masks of its furniture and of a person."""
    camera = room.truth.camera
    things = [
        make_scenes.Thing(
            o.id, "chair", o.mesh.verts.double().numpy(), o.mesh.faces.numpy(),
            o.t_world_object.double().numpy(), float(o.yaw), o.scale.double().numpy(),
        )
        for o in room.truth.objects
    ]  # fmt: skip
    axes, size = camera.R_cam_world.double().numpy(), (camera.width, camera.height)
    same = make_scenes.Room(camera.K.double().numpy(), axes, size, room.truth.ground, things)
    for name in ("SOURCE", "my_total3d"):
        make_scenes.write_total3d(desk / name, same)
    rows = []
    for i, thing in enumerate(things):
        x0, y0, x1, y1 = (round(v) for v in same.box2d(thing))
        outline = [x0, y0, x1, y0, x1, y1, x0, y1]
        rows.append({"id": i, "image_id": 7, "category_id": 1, "bbox": [x0, y0, x1 - x0, y1 - y0],
                     "segmentation": [outline]})  # fmt: skip
    image = {"id": 7, "width": size[0], "height": size[1], "file_name": "a.jpg"}
    kinds = [{"id": 1, "name": "chair"}]
    coco = {"images": [image], "categories": kinds, "annotations": rows}
    (desk / "chairs.json").write_text(json.dumps(coco))
    people = np.zeros((5, 1, *size[::-1]), dtype=bool)
    people[:, :, 40:120, 60:100] = True
    np.savez(desk / "people.npz", masks=people, object_ids=np.array([0]))


def write_persons(desk: Path) -> None:
    """Keypoints, bodies of other tools, and a body model."""
    walk = as_bodies(*walker(6))
    write_json(camera_to_json(CAMERA), desk / "camera.json")
    write_bodies(walk, desk / "bodies_of_hmr.npz")
    found = seen(walk, noise=1.0)
    write_keypoints(found, desk / "keypoints.npz")
    (desk / "keypoints").mkdir()
    for k in range(len(walk.frame)):
        triple = torch.cat([found.points[k], found.confidence[k, :, None]], -1)
        person = {"pose_keypoints_2d": triple.reshape(-1).tolist()}
        file = desk / "keypoints" / f"{k:06d}_keypoints.json"
        file.write_text(json.dumps({"people": [person]}))
    make_people.write_gvhmr(desk)
    write_npz(make_model("smplx"), desk / "models" / "smplx" / "SMPLX_NEUTRAL.npz")


def write_desk(desk: Path, room: KnownRoom, capture: Capture) -> Path:
    """All of it but OUT, a finished result of CAPTURE."""
    shutil.rmtree(desk, ignore_errors=True)
    desk.mkdir()
    write_captures(desk, room, capture)
    write_scenes(desk, room)
    write_persons(desk)
    return desk
