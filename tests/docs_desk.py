"""A folder with a small input under every name that the commands in the docs use."""

import dataclasses
import json
import shutil
from fractions import Fraction
from pathlib import Path
from typing import Any

import make_people
import make_scenes as layouts
import numpy as np
import torch
from make_keypoints import CAMERA, as_bodies, walker
from make_keypoints import seen as seen_by
from make_smpl import make_model, write_npz
from PIL import Image
from test_posa import write_checkpoint, write_meshes

from mover.app.results import write_truth
from mover.bodies import BodyModel
from mover.bodies.smpl_files import load_smpl
from mover.core.records import rows_of
from mover.core.types import Bodies, BodyPose, Capture
from mover.io.capture.bodies_file import write_bodies
from mover.io.capture.camera_file import camera_to_json
from mover.io.capture.edits import Place, placement_of, write_edits
from mover.io.capture.folder import write_capture
from mover.io.files.fields import write_json
from mover.io.people.keypoints import write_keypoints
from mover_bench.rooms.config import NoiseConfig
from mover_bench.rooms.known import KnownRoom
from mover_bench.rooms.noise import add_noise

NAMES = {
    "floor lamp": "lamp", "coffee table": "table", "shelf": "shelves", "wardrobe": "cabinet",
    "nightstand": "night_stand", "armchair": "sofa", "office chair": "chair", "stool": "chair",
    "bench": "sofa",
}  # fmt: skip


def plain(room: KnownRoom, factor: float = 1.0) -> layouts.Room:
    """The true room as numbers, under a picture that is so many times larger."""
    camera = room.truth.camera
    things = [
        layouts.Thing(
            piece.id, NAMES.get(piece.category, piece.category),
            piece.mesh.verts.double().numpy(), piece.mesh.faces.numpy(),
            piece.t_world_object.double().numpy(), float(piece.yaw), piece.scale.double().numpy(),
        )
        for piece in room.truth.objects
    ]  # fmt: skip
    K = camera.K.double().numpy() * [[factor]]
    K[2, 2] = 1
    size = (round(camera.width * factor), round(camera.height * factor))
    return layouts.Room(K, camera.R_cam_world.double().numpy(), size, room.truth.ground, things)


def thinned(capture: Capture, every: int = 8) -> Capture:
    """Every so many frames of the people."""
    bodies, people = capture.bodies, capture.people
    assert bodies is not None
    assert people is not None
    rows = (people.frame % every == 0).nonzero()[:, 0]
    counts = tuple(people.masks.counts[k] for k in rows.tolist())
    fewer = dataclasses.replace(
        people, masks=dataclasses.replace(people.masks, counts=counts), frame=people.frame[rows],
        person=people.person[rows],
    )  # fmt: skip
    return dataclasses.replace(capture, bodies=some(bodies, every), people=fewer)


def some(bodies: Bodies, every: int = 8) -> Bodies:
    """Bodies of every so many frames."""
    return rows_of(bodies, bodies.frame % every == 0)


def write_captures(desk: Path, room: KnownRoom) -> None:
    """CAPTURE with its truth, DIR, a list of captures, a list of edits."""
    capture = thinned(add_noise(room, NoiseConfig(), 1))
    write_capture(capture, desk / "CAPTURE")
    write_truth(room.truth, some(room.bodies), desk / "CAPTURE" / "truth")
    (desk / "DIR").symlink_to(Path("CAPTURE") / "truth")
    for home in ("LIST", "captures"):
        (desk / home).mkdir()
        (desk / home / "one").symlink_to(Path("..") / "CAPTURE")
    (desk / "list.txt").write_text("captures/one  # a remark\n")
    piece = capture.scene.objects[0]
    moved = dataclasses.replace(piece, t_world_object=piece.t_world_object + 0.1)
    write_edits((Place(piece.id, placement_of(moved, capture.scene)),), desk / "edits.json")
    bare = desk / "C"
    bare.mkdir()
    for name in ("camera.json", "objects.json"):
        shutil.copy(desk / "CAPTURE" / name, bare)
    np.savez(
        desk / "depth.npz", depth=np.full((room.truth.camera.height, room.truth.camera.width), 3.0)
    )


def coco(masks: np.ndarray, names: list[str]) -> dict[str, Any]:
    """Masks as COCO has them."""
    n, h, w = masks.shape
    rows = [
        {"id": i, "image_id": 7, "category_id": i + 1, "bbox": [0, 0, 1, 1],
         "segmentation": {"size": [h, w], "counts": layouts.runs_of(masks[i])}}
        for i in range(n)
    ]  # fmt: skip
    for row, mask in zip(rows, masks, strict=True):
        y, x = np.nonzero(mask)
        row["bbox"] = [int(x.min()), int(y.min()), int(np.ptp(x)) + 1, int(np.ptp(y)) + 1]
    return {
        "images": [{"id": 7, "width": w, "height": h, "file_name": "a.jpg"}],
        "categories": [{"id": i + 1, "name": name} for i, name in enumerate(names)],
        "annotations": rows,
    }


def write_scenes(desk: Path, room: KnownRoom) -> None:
    """What other tools write of furniture, masks and recordings."""
    same = plain(room)
    for name in ("SOURCE", "my_total3d"):
        layouts.write_total3d(desk / name, same)
    layouts.write_sam3d(desk / "sam3d", same)
    layouts.write_holisticmesh(desk / "holisticmesh", same)
    layouts.write_glb(desk / "SCENE.glb", same)
    layouts.write_boxes(desk / "BOXES.json", same)
    layouts.picture(same.size).save(desk / "I.jpg")
    shapes = desk / "shapes"
    for thing in same.things[:2]:
        layouts.write_obj(shapes / f"{thing.category}_0.obj", thing.verts, thing.faces)
    w, h = same.size
    masks = np.zeros((len(same.things), h, w), dtype=bool)
    for mask, thing in zip(masks, same.things, strict=True):
        x0, y0, x1, y1 = (round(v) for v in same.box2d(thing))
        mask[y0:y1, x0:x1] = True
    for name in ("chairs.json", "MASKS.json"):
        (desk / name).write_text(json.dumps(coco(masks, [t.category for t in same.things])))
    people = np.zeros((5, 1, h, w), dtype=bool)
    people[:, :, 40:120, 60:100] = True
    np.savez(desk / "people.npz", masks=people, object_ids=np.array([0]))
    bodies = np.stack(
        [[[0, 0, 3.0], [0.3, 0, 3], [0, 0.9, 3], [0.1 * i, 0, 3.3]] for i in range(4)]
    )
    tetra = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    layouts.write_release(desk / "SEQUENCE", same, bodies, tetra)
    large = plain(room, 1920 / same.size[0])
    layouts.write_prox(desk / "PROX", large, "MPH8_00034_01", 3, np.array([1.0, 2.0, 1.5]))
    shutil.copytree(desk / "PROX" / "boxes", desk / "MPH8")
    layouts.write_total3d(desk / "total3d" / "MPH8", large)
    joints = np.tile(np.linspace(0, 1, 25)[:, None], (2, 1, 3)) + np.array([0, 0, 3.0])
    layouts.write_pigraphs(desk / "PIGRAPHS", same, "a_b_c", joints, mirror=False)


class Vposer(torch.nn.Module):
    """The shapes of the second version's decoder, with weights of resting poses."""

    def __init__(self) -> None:
        super().__init__()
        nn = torch.nn
        self.vp_model = nn.ModuleDict({"decoder_net": nn.Sequential(
            nn.Linear(32, 512), nn.LeakyReLU(), nn.Dropout(0.1), nn.Linear(512, 512),
            nn.LeakyReLU(), nn.Linear(512, 126),
        )})  # fmt: skip
        with torch.no_grad():
            self.vp_model["decoder_net"][5].bias.copy_(torch.eye(3)[:, :2].reshape(6).repeat(21))


def person_of(model: BodyModel) -> Bodies:
    """A person of the user's model before the camera."""
    place, still = torch.tensor([[0.0, 0.0, 3.0]]), torch.zeros(1, 3)
    pose = BodyPose("smplx", "neutral", torch.zeros(1, 10), still, torch.zeros(1, 63), place, {})
    verts, joints = model.posed(pose)
    row = torch.zeros(1, dtype=torch.long)
    return Bodies(verts, model.faces, joints, model.joint_names, row, row, 5.0, "camera", pose)


def write_persons(desk: Path) -> None:
    """Keypoints, bodies and contacts."""
    walk = as_bodies(*walker(6))
    write_json(camera_to_json(CAMERA), desk / "camera.json")
    write_bodies(walk, desk / "bodies_of_hmr.npz")
    seen = seen_by(walk, noise=1.0)
    write_keypoints(seen, desk / "keypoints.npz")
    (desk / "keypoints").mkdir()
    for k in range(len(walk.frame)):
        triple = torch.cat([seen.points[k], seen.confidence[k, :, None]], -1)
        person = {"pose_keypoints_2d": triple.reshape(-1).tolist()}
        file = desk / "keypoints" / f"{k:06d}_keypoints.json"
        file.write_text(json.dumps({"people": [person]}))
    make_people.write_gvhmr(desk)
    folder = desk / "vposer_v1_0" / "snapshots"
    folder.mkdir(parents=True)
    torch.save({"state_dict": Vposer().state_dict()}, folder / "V02_05_epoch=13.ckpt")
    file = desk / "models" / "smplx" / "SMPLX_NEUTRAL.npz"
    write_npz(make_model("smplx"), file)
    people = person_of(load_smpl("smplx", "neutral", file))
    write_bodies(people, desk / "bodies.npz")
    write_meshes(desk / "mesh_ds")
    write_checkpoint(desk / "contact.pt")
    np.savez(desk / "deco.npz", contact_label=np.zeros(people.verts.shape[:2]))


def write_video(path: Path) -> None:
    """A grey person walks through a room."""
    import av

    rng = np.random.default_rng(1)
    small = Image.fromarray(rng.integers(0, 255, (12, 16, 3)).astype(np.uint8))
    room = np.array(small.resize((128, 96), Image.Resampling.BICUBIC))
    with av.open(str(path), "w") as container:
        stream = container.add_stream("libx264", rate=5)
        stream.width, stream.height, stream.pix_fmt = 128, 96, "yuv420p"
        stream.codec_context.time_base = Fraction(1, 5)
        for k in range(6):
            picture = room.copy()
            picture[20:90, 10 + 12 * k : 30 + 12 * k] = 90
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
            frame.pts, frame.time_base = k, Fraction(1, 5)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


def write_desk(desk: Path, room: KnownRoom) -> Path:
    """All of it but OUT, a finished result of CAPTURE."""
    desk.mkdir()
    write_captures(desk, room)
    write_scenes(desk, room)
    write_persons(desk)
    write_video(desk / "room.mp4")
    return desk
