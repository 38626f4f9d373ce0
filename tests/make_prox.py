"""A user's copy of PROX in its true layout, of a known room and its own people as SMPL-X bodies.

The body model is a file in the layout of SMPL-X (make_smpl), the people are those of the room with
their angles, the pictures are empty. Names are those of `make_scenes.write_prox`.
"""

import json
from dataclasses import replace
from pathlib import Path

import make_people as made
import make_scenes as layouts
import numpy as np
import tiny_capture as tiny
import torch
from make_smpl import make_model, write_npz
from PIL import Image

from mover.bodies.keypoints import keypoints_of
from mover.bodies.skinning import SkinnedBody
from mover.bodies.smpl_files import load_smpl
from mover.core.records import rows_of
from mover.core.types import BodyPose
from mover.geometry.camera import project
from mover.geometry.rle import decode
from mover_bench.rooms.known import KnownRoom

SIZE = (1920, 1080)


def write_body_model(folder: Path) -> Path:
    """What MOVER_BODY_MODELS names: PROX's men."""
    write_npz(make_model("smplx"), folder / "smplx" / "SMPLX_MALE.npz")
    return folder


def smplx_people(room: KnownRoom, rows: list[int], model: SkinnedBody) -> BodyPose:
    """Some rows of the people, the pelvis where it was; hands at rest."""
    given = rows_of(room.bodies, torch.tensor(rows))
    pose = replace(
        given.pose, model="smplx", gender="male", extra={}, betas=torch.zeros(len(rows), 10),
        body_pose=given.pose.body_pose[:, :63],
    )  # fmt: skip
    _, joints = model.posed(pose)
    return replace(pose, transl=pose.transl + given.joints[:, 0] - joints[:, 0])


def write_recording(
    root: Path, plain: layouts.Room, name: str, room: KnownRoom, rows: list[int], fits: list[str]
) -> None:
    """A recording of some rows of a room's first person, whose fits are the truth."""
    layouts.write_prox(root, plain, name, len(rows))
    model = load_smpl("smplx", "male")
    pose = smplx_people(room, rows, model)
    verts, joints = model.posed(pose)
    points = keypoints_of(model, verts, joints, "openpose25")
    pixels = project(points, torch.from_numpy(plain.K).float())
    for k, row in enumerate(rows):
        stem = layouts.prox_stem(name, k)
        _write_keypoints(root / "keypoints" / name / f"{stem}_keypoints.json", pixels[k])
        _write_index(root / "recordings" / name / "BodyIndexColor" / f"{stem}.png", room, row)
        data = {
            **{key: getattr(pose, key)[k : k + 1].double().numpy() for key in
               ("betas", "global_orient", "body_pose", "transl")},
            **{key: np.zeros((1, 3)) for key in ("jaw_pose", "leye_pose", "reye_pose")},
            **{key: np.zeros((1, 12)) for key in ("left_hand_pose", "right_hand_pose")},
            "expression": np.zeros((1, 10)), "pose_embedding": np.zeros((1, 32)),
            "camera_rotation": np.eye(3)[None], "camera_translation": np.zeros((1, 3)),
            "gender": "male",
        }  # fmt: skip
        for kind in fits:
            made.store(data, root / kind / name / "results" / stem / "000.pkl")


def _write_keypoints(path: Path, pixels: torch.Tensor) -> None:
    """OpenPose's file of one person, all joints seen."""
    body = torch.cat([pixels, torch.ones(25, 1)], 1).double().flatten().tolist()
    empty = {"face_keypoints_2d": [0.0] * 210, "hand_left_keypoints_2d": [0.0] * 63,
             "hand_right_keypoints_2d": [0.0] * 63}  # fmt: skip
    person = {"person_id": [-1], "pose_keypoints_2d": body, **empty}
    path.write_text(json.dumps({"version": 1.2, "people": [person]}))


def _write_index(path: Path, room: KnownRoom, row: int) -> None:
    """The body index of a picture as it is stored, mirrored; the room's masks are smaller."""
    people = room.capture.people
    own = (people.frame == room.bodies.frame[row]) & (people.person == room.bodies.person[row])
    mask = decode(people.masks, int(own.nonzero()[0, 0])).numpy()[:, ::-1]
    factor = SIZE[0] // mask.shape[1]
    large = np.kron(mask, np.ones((factor, factor), dtype=bool))
    Image.fromarray(np.where(large, 0, 255).astype(np.uint8)).save(path)


def write_furniture(folder: Path, plain: layouts.Room) -> Path:
    """Total3D's files of the room, wrong by 15 cm, 10 degrees and a tilt of 3 degrees."""
    rng = np.random.default_rng(0)
    things = [
        replace(t, t=t.t + 0.15 * rng.normal(size=3) * [1, 0, 1], yaw=t.yaw + 0.17 * rng.normal())
        for t in plain.things
    ]
    tilt = layouts.Rotation.from_euler("x", 3, degrees=True).as_matrix()
    given = layouts.Room(plain.K, tilt @ plain.R, plain.size, plain.ground, things)
    layouts.write_total3d(folder, given)
    rows = [{"bbox": plain.box2d(t), "class": t.category} for t in plain.things]
    (folder / "input" / "detections.json").write_text(json.dumps(rows))
    return folder


def write_object_masks(path: Path, plain: layouts.Room, room: KnownRoom) -> Path:
    """COCO's annotations of the furniture in the flipped picture; the room's masks are smaller."""
    names = list(dict.fromkeys(t.category for t in plain.things))
    rows = []
    for i, (thing, found) in enumerate(zip(plain.things, room.capture.detections, strict=True)):
        mask = decode(found.mask, 0).numpy()
        factor = SIZE[0] // mask.shape[1]
        runs = tiny.runs(np.kron(mask, np.ones((factor, factor), dtype=bool)))
        left, top, right, bottom = plain.box2d(thing)
        rows.append({
            "id": i, "image_id": 0, "category_id": names.index(thing.category),
            "bbox": [left, top, right - left, bottom - top],
            "segmentation": {"size": [SIZE[1], SIZE[0]], "counts": tiny.compressed(runs)},
        })  # fmt: skip
    image = {"id": 0, "width": SIZE[0], "height": SIZE[1], "file_name": "000000.jpg"}
    categories = [{"id": i, "name": name} for i, name in enumerate(names)]
    tree = {"images": [image], "categories": categories, "annotations": rows}
    path.write_text(json.dumps(tree))
    return path
