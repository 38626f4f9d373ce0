"""Writes rooms in the layouts of other tools, from their pages alone: nothing of mover is used.

A room is plain: `Room(K, R, size, ground, things)`, the world has +y up and the camera at the
origin, x_cam = R @ x_world (x right, y down, z forward).
"""

import io
import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from PIL import Image
from scipy.io import savemat
from scipy.spatial.transform import Rotation
from tiny_capture import compressed, runs, write_obj

NYU40 = {
    "bed": 4, "chair": 5, "sofa": 6, "table": 7, "desk": 14, "shelves": 15, "cabinet": 3,
    "night_stand": 32, "lamp": 35, "bookshelf": 10, "otherfurniture": 39, "wall": 1,
    "television": 25,
}  # fmt: skip
FLIP = np.diag([1.0, -1.0, -1.0])
Z_UP = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # our world -> one with z up
SHIFT = np.array([1.0, 2.0, 1.5])  # [m], where the camera stands in the frame of a scan


@dataclass
class Thing:
    """x_world = R_y(yaw) @ (scale * verts) + t."""

    name: str
    category: str
    verts: np.ndarray
    faces: np.ndarray
    t: np.ndarray
    yaw: float
    scale: np.ndarray

    @property
    def world(self) -> np.ndarray:
        return (self.verts * self.scale) @ about_y(self.yaw).T + self.t

    @property
    def size(self) -> np.ndarray:
        return self.scale * np.ptp(self.verts, axis=0)

    @property
    def centre(self) -> np.ndarray:
        """Middle of its box in the world."""
        middle = (self.verts.min(0) + self.verts.max(0)) / 2
        return about_y(self.yaw) @ (self.scale * middle) + self.t


@dataclass
class Room:
    K: np.ndarray
    R: np.ndarray
    size: tuple[int, int]
    ground: float
    things: list[Thing]

    def box2d(self, thing: Thing) -> list[float]:
        seen = thing.world @ self.R.T @ self.K.T
        pixels = seen[:, :2] / seen[:, 2:]
        low, high = pixels.min(0), pixels.max(0)
        return [*np.clip(low, 0, self.size).tolist(), *np.clip(high, 0, self.size).tolist()]


def about_y(a: float) -> np.ndarray:
    return np.array([[np.cos(a), 0, np.sin(a)], [0, 1, 0], [-np.sin(a), 0, np.cos(a)]])


def four(R: np.ndarray, t: Any = (0, 0, 0)) -> np.ndarray:
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = R, t
    return out


def picture(size: tuple[int, int]) -> Image.Image:
    """A picture whose left half is darker."""
    pixels = np.zeros((size[1], size[0], 3), dtype=np.uint8)
    pixels[:, size[0] // 2 :, 0] = 200
    pixels[: size[1] // 2, :, 1] = 90
    return Image.fromarray(pixels)


def mesh(verts: np.ndarray, faces: np.ndarray) -> trimesh.Trimesh:
    return trimesh.Trimesh(verts, faces, process=False)


# --- Total3D: world x forward, y up, z right; boxes with half sizes; camera to world in cam_R ---
OURS_TO_T3D = np.array([[0.0, 0, -1], [0, 1, 0], [1, 0, 0]])
T = np.array([[0.0, 0, 1], [0, -1, 0], [1, 0, 0]])  # its camera axes -> right, down, forward


def write_total3d(folder: Path, room: Room, *, flat: bool = False, kind: str = "obj") -> Path:
    """Everything in one folder if `flat`, as in MOVER's Total3D_input."""
    source = folder if flat else folder / "input"
    result = folder if flat else folder / "output"
    source.mkdir(parents=True, exist_ok=True)
    result.mkdir(parents=True, exist_ok=True)
    picture(room.size).save(source / "img.jpg")
    np.savetxt(source / "cam_K.txt", room.K)
    rows = [{"bbox": room.box2d(t), "class": t.category} for t in room.things]
    (source / "detections.json").write_text(json.dumps(rows))
    # p_world = cam_R @ p_cam (forward, up, right); p_image = T p_cam; p_image = R p_ours.
    savemat(result / "r_ex.mat", {"cam_R": OURS_TO_T3D @ room.R.T @ T})
    # Four corners above, the same four below (yinyunie/Total3DUnderstanding, net_utils/libs.py:
    # get_layout_bdb_sunrgbd), of a room that is turned as its own axes are.
    flat = np.array([[-1, -1], [-1, 1], [1, 1], [1, -1]]) @ about_y(0.3)[::2, ::2].T * 3
    corners = [[x, y, z] for y in (2.5, room.ground) for x, z in flat]
    savemat(result / "layout.mat", {"layout": np.array(corners, dtype="f4")})
    cells = np.empty((1, len(room.things)), dtype=object)
    for i, t in enumerate(room.things):
        low, high = t.verts.min(0), t.verts.max(0)
        cells[0, i] = {  # rows of basis: the box's own x, y, z (front) in Total3D's world
            "basis": (OURS_TO_T3D @ about_y(t.yaw)).T.astype("f4"),
            "coeffs": (t.size / 2)[None].astype("f4"),
            "centroid": (OURS_TO_T3D @ t.centre)[None].astype("f4"),
            "classid": np.array([[NYU40[t.category]]]),
        }
        unit = (t.verts - (low + high) / 2) / ((high - low) / 2)
        path = result / f"{i}_{NYU40[t.category]}.{kind}"
        write_obj(path, unit, t.faces) if kind == "obj" else mesh(unit, t.faces).export(path)
    ids = np.array([[NYU40[t.category] for t in room.things]])
    savemat(result / "bdb_3d.mat", {"bdb": cells, "class_id": ids})
    return folder


# --- SAM 3D Objects: z-up local frame stored y-up; rows times R(q); PyTorch3D camera ---
def write_sam3d(folder: Path, room: Room, *, kind: str = "npz") -> Path:
    """A mesh and a pose for each thing; the tool's scale is the same along all axes."""
    folder.mkdir(parents=True)
    to_p3d = np.diag([-1.0, -1.0, 1.0])
    for i, t in enumerate(room.things):
        size = float(t.size.max())
        mesh(t.verts * t.scale / size, t.faces).export(folder / f"{i}.glb")
        # local = (x, -z, y) of the stored ones; p3d = (local * s) @ M + t
        A = to_p3d @ room.R @ about_y(t.yaw)  # p3d from y-up
        x, y, z, w = Rotation.from_matrix((A @ Z_UP.T).T).as_quat()
        pose = {"rotation": np.array([[w, x, y, z]]), "scale": np.full((1, 3), size),
                "translation": (to_p3d @ room.R @ t.t)[None]}  # fmt: skip
        if kind == "npz":
            np.savez(folder / f"{i}.npz", **pose, category=np.array(t.category))
        else:
            row = {k: v.tolist() for k, v in pose.items()} | {"category": t.category}
            (folder / f"{i}.json").write_text(json.dumps(row))
    return folder


# --- HolisticMesh (ZZWENG/holistic_mesh, code/main.py, scene_model.py `inference` and
# `get_scene_mesh`, utils.py `render_image`): one mesh of all pieces, each with the vertices of a
# sphere of 2562, right, down, forward of the flipped picture; boxes of the picture as stored ---
def write_holisticmesh(folder: Path, room: Room) -> Path:
    (folder / "models").mkdir(parents=True)
    size = max(2562, *(len(t.verts) for t in room.things))
    verts, faces = [], []
    for i, t in enumerate(room.things):
        own = t.world @ room.R.T
        verts.append(np.concatenate([own, np.repeat(own[-1:], size - len(own), 0)]))
        faces.append(t.faces + i * size)
    mesh(np.concatenate(verts), np.concatenate(faces)).export(folder / "models" / "scene.ply")
    width, boxes = room.size[0], [(*room.box2d(t), t.category) for t in room.things]
    rows = [{"bbox": [width - right, top, width - left, bottom], "class": category}
            for left, top, right, bottom, category in boxes]  # fmt: skip
    (folder / "detections.json").write_text(json.dumps(rows))
    return folder


# --- glTF: nodes with translation, rotation, scale; a camera node that looks along -z ---
def write_glb(path: Path, room: Room, world: np.ndarray | None = None, camera: bool = True) -> Path:
    """`world` is a transform of everything (4, 4), camera included."""
    world = np.eye(4) if world is None else world
    scene = trimesh.Scene()
    for t in room.things:
        matrix = world @ four(about_y(t.yaw) @ np.diag(t.scale), t.t)
        scene.add_geometry(mesh(t.verts, t.faces), node_name=t.name, transform=matrix)
    content = scene.export(file_type="glb")
    if camera:
        content = with_camera(content, world @ four(room.R.T @ FLIP), room)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
    return path


def with_camera(content: bytes, pose: np.ndarray, room: Room) -> bytes:
    fy, fx, (w, h) = room.K[1, 1], room.K[0, 0], room.size
    lens = {"yfov": 2 * np.arctan(h / 2 / fy), "aspectRatio": (w / fx) / (h / fy), "znear": 0.1}

    def add(tree: dict[str, Any]) -> None:
        tree["cameras"] = [{"type": "perspective", "perspective": lens}]
        tree["nodes"].append({"name": "camera", "camera": 0, "matrix": pose.T.ravel().tolist()})
        tree["scenes"][tree.get("scene", 0)]["nodes"].append(len(tree["nodes"]) - 1)

    return with_json(content, add)


def with_json(content: bytes, change: Callable[[dict[str, Any]], None]) -> bytes:
    """A .glb whose JSON chunk is changed."""
    size = int.from_bytes(content[12:16], "little")
    tree = json.loads(content[20 : 20 + size])
    change(tree)
    chunk = json.dumps(tree).encode()
    chunk += b" " * (-len(chunk) % 4)
    body = content[20 + size :]
    total, length = ((n + len(chunk)).to_bytes(4, "little") for n in (20 + len(body), 0))
    return content[:8] + total + length + b"JSON" + chunk + body


def camera_json(room: Room) -> dict[str, Any]:
    (w, h), K = room.size, room.K
    return {"w": w, "h": h, "fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2],
            "R_cam_world": room.R.tolist()}  # fmt: skip


# --- boxes ---
def write_boxes(path: Path, room: Room, *, frame: str = "y") -> Path:
    """Boxes in a world with y up, -y up or z up, or in the camera's axes."""
    turn = {"y": np.eye(3), "-y": FLIP, "z": Z_UP, "camera": room.R}[frame]
    rows = [
        {"id": t.name, "category": t.category, "center": (turn @ t.centre).tolist(),
         "size": t.size.tolist(), "box2d": room.box2d(t), "score": 0.9,
         "rotation": (turn @ about_y(t.yaw)).tolist()}
        for t in room.things
    ]  # fmt: skip
    tree = {"camera": camera_json(room), "ground": room.ground, "objects": rows}
    tree |= {"frame": "camera"} if frame == "camera" else {"frame": "world", "up": frame}
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(tree))
    return path


# --- the authors' release ---
def write_release(folder: Path, room: Room, bodies: np.ndarray, faces: np.ndarray) -> Path:
    """Bodies (frames, verts, 3) are in the camera's frame."""
    write_total3d(folder / "Total3D_label_occNet_results" / "Total3D_input", room, flat=True)
    st2 = folder / "smplifyx_results_st2_newCamera_gpConstraints_posaVersion"
    R_down = room.R @ FLIP  # from their world, y down
    for i, verts in enumerate(bodies):
        write_obj(st2 / "meshes" / f"{i + 1:06d}.obj", verts @ R_down, faces)
    write_xml(st2 / "smplifyx_cam" / "001.xml", room.K - HALF, R_down)
    posa = folder / "smplifyx_results_st0" / "results" / "posa_contact_npy_newBottom"
    posa.mkdir(parents=True)
    frames = folder / "Color_flip_rename"
    frames.mkdir()
    w, h = room.size
    for i in range(len(bodies)):
        chance = np.full((bodies.shape[1], 1), 0.25 * (i % 4), "f4")
        np.save(posa / f"{i:06d}_sample_00.npy", chance)
        picture(room.size).save(frames / f"{i + 1:06d}.jpg")
        home = folder / "Color_flip_rename_pointrend_X_101_det_all" / f"{i + 1:06d}"
        home.mkdir(parents=True)
        mask = np.zeros((h, w), dtype=bool)
        mask[5:20, 10 + i : 20 + i] = True
        row = {"class": "person", "bbox": [10 + i, 5, 20 + i, 20, 0.9], "mask": mask.tolist()}
        (home / "detections.json").write_text(json.dumps([row]))
    out = folder / "refine_results" / "scene_reconstruction_s3kind1" / "obj_-1" / "model_end"
    for i, t in enumerate(room.things):
        write_obj(out / f"f{i:03d}_world.obj", t.world @ FLIP, t.faces)
    write_truth(folder / "prox_scans_pre", room)
    return folder


HALF = np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]])


def write_xml(path: Path, K: np.ndarray, R: np.ndarray) -> None:
    def node(name: str, value: np.ndarray) -> str:
        body = " ".join(repr(float(v)) for v in value.ravel())
        rows, cols = value.shape
        return (f'<{name} type_id="opencv-matrix"><rows>{rows}</rows><cols>{cols}</cols>'
                f"<dt>d</dt><data>{body}</data></{name}>")  # fmt: skip

    path.parent.mkdir(parents=True)
    parts = [node("CameraMatrix", np.concatenate([R, np.zeros((3, 1))], 1)),
             node("Intrinsics", K), node("Distortion", np.zeros((8, 1)))]  # fmt: skip
    path.write_text('<?xml version="1.0"?><opencv_storage>' + "".join(parts) + "</opencv_storage>")


def write_truth(folder: Path, room: Room, *, columns: bool = False) -> None:
    """bbox3d.json and the scan, both in the camera's axes."""
    folder.mkdir(parents=True, exist_ok=True)
    tree = {}
    for t in room.things:
        axes = (room.R @ about_y(t.yaw)).T  # rows
        tree[t.name] = {
            "centroid": (room.R @ t.centre).tolist(), "coeffs": (t.size / 2).tolist(),
            "basis": (axes.T if columns else axes).tolist(),
        }  # fmt: skip
    (folder / "bbox3d.json").write_text(json.dumps(tree))
    scan(room).apply_transform(four(room.R)).export(folder / "scan_cam_cooridnates.ply")


def scan(room: Room) -> trimesh.Trimesh:
    """Everything and a floor, in our world."""
    grid = np.stack(np.meshgrid(np.arange(-4, 4, 0.2), np.arange(-8, 0, 0.2)), -1).reshape(-1, 2)
    corner = (np.arange(39)[:, None] * 40 + np.arange(39)).ravel()
    cells = corner[:, None] + [0, 1, 40]
    floor = np.stack([grid[:, 0], np.full(len(grid), room.ground), grid[:, 1]], 1)
    parts = [mesh(t.world, t.faces) for t in room.things] + [mesh(floor, cells)]
    return trimesh.util.concatenate(parts)


# --- PROX ---
def prox_stem(recording: str, index: int) -> str:
    """Name of a frame: stills of the quantitative part are each the first frame of their own shot.

    As in public code that reads it: fittings/mosh/vicon_03301_01/results/
    s001_frame_00001__00.00.00.023, and vicon_03301_03/results/s007_frame_00001__00.00.00.009
    (YangYuan's pkl2smpl; see also prox/viz/viz_mosh.py of mohamedhassanmus/prox for the folders).
    """
    if recording.startswith("vicon"):
        return f"s{index + 1:03d}_frame_00001__00.00.00.{(index * 37 + 23) % 60:03d}"
    return f"s001_frame_{index + 1:05d}__00.00.{index // 30:02d}.{index % 30:03d}"


def body_index(size: tuple[int, int], index: int) -> Image.Image:
    """Kinect's body index of a mirrored picture: 255 where no person is, else the body's number.

    Read as grey and flipped, with 0 where the person is: data_parser.py of third-party readers of
    PROX (img_fn + '.png' in BodyIndexColor), and BodyIndex by a threshold at 254.
    """
    pixels = np.full(size[::-1], 255, dtype=np.uint8)
    pixels[200:700, 300 + 10 * index : 400 + 10 * index] = 0
    return Image.fromarray(pixels)


def write_prox(root: Path, room: Room, recording: str, frames: int) -> Path:
    """The camera stands at `SHIFT` in the scan's frame; pictures are stored mirrored."""
    place = recording.split("_")[0]
    for name in ("calibration", "cam2world", "scenes"):
        (root / name).mkdir(parents=True, exist_ok=True)
    lens = {"camera_mtx": (room.K - HALF).tolist(), "k": [0.1, 0.0, 0.0, 0.0, 0.0]}
    (root / "calibration" / "Color.json").write_text(json.dumps(lens))
    cam2world = four(Z_UP @ room.R.T, SHIFT)
    (root / "cam2world" / f"{place}.json").write_text(json.dumps(cam2world.tolist()))
    scan(room).apply_transform(four(Z_UP, SHIFT)).export(root / "scenes" / f"{place}.ply")
    color = root / "recordings" / recording / "Color"
    keypoints = root / "keypoints" / recording
    index = root / "recordings" / recording / "BodyIndexColor"
    for folder in (color, keypoints, index):
        folder.mkdir(parents=True)
    for i in range(frames):
        stem = prox_stem(recording, i)
        body_index(room.size, i).save(index / f"{stem}.png")
        picture(room.size).transpose(Image.Transpose.FLIP_LEFT_RIGHT).save(color / f"{stem}.jpg")
        joints = np.zeros((25, 3))
        joints[4] = [100 + i, 200, 0.9]  # right wrist of the mirrored picture
        row = {"person_id": [-1], "pose_keypoints_2d": joints.ravel().tolist(),
               "face_keypoints_2d": [0.0] * 210, "hand_left_keypoints_2d": [1.0] * 63,
               "hand_right_keypoints_2d": [0.0] * 63}  # fmt: skip
        tree = {"version": 1.2, "people": [row]}
        (keypoints / f"{stem}_keypoints.json").write_text(json.dumps(tree))
    write_truth(root / "boxes", room)
    return root


# --- PiGraphs ---
def write_pigraphs(root: Path, room: Room, name: str, joints: np.ndarray, *, mirror: bool) -> Path:
    """Joints (frames, 25, 3) in the camera's axes; Kinect's x is left, or right if `mirror`."""
    root.mkdir(parents=True, exist_ok=True)
    place = name.split("_")[0]
    kinect = np.diag([1.0, -1, 1]) if mirror else np.diag([-1.0, -1, 1])  # from x right, y down
    scan_cam = four(Z_UP @ room.R.T @ kinect, SHIFT)
    times = [1000 + 200 * i for i in range(len(joints))]
    rows = [{"trackingId": 72057594037928000 + 1, "timestamp": time,
             "jointPositions": (pose @ kinect).tolist()}
            for time, pose in zip(times, joints, strict=True)]  # fmt: skip
    tree = {"id": name, "camera": scan_cam.ravel().tolist(), "depthTimestamps": times,
            "skeletons": rows}  # fmt: skip
    (root / f"{name}.json").write_text(json.dumps(tree))
    groups = []
    for i, t in enumerate(room.things):
        axes = (Z_UP @ about_y(t.yaw)).T
        for part, sign in (("base", -1), ("top", 1)):  # the lower and the upper half
            middle = t.centre + np.array([0, sign * t.size[1] / 4, 0])
            groups.append({
                "id": len(groups), "label": f"{t.category}:{part}", "objectId": i,
                "dominantNormal": [0, 0, 1], "segments": [],
                "obb": {"centroid": (Z_UP @ middle + SHIFT).tolist(),
                        "axesLengths": (t.size * [1, 0.5, 1]).tolist(),
                        "normalizedAxes": axes.ravel().tolist()},
            })  # fmt: skip
    wall = {"centroid": [0, 0, 0], "axesLengths": [1, 1, 1], "normalizedAxes": [1, 0, 0, 0, 1, 0,
            0, 0, 1]}  # fmt: skip
    groups.append({"id": 999, "label": "wall", "objectId": 999, "obb": wall, "segments": []})
    (root / f"{place}d.segs.json").write_text(json.dumps({"segGroups": groups}))
    scan(room).apply_transform(four(Z_UP, SHIFT)).export(root / f"{place}.ply")
    return root


# --- masks ---
def write_masks(folder: Path, masks: np.ndarray, names: list[str]) -> dict[str, Path]:
    """The same masks (n, h, w), which do not overlap, in every layout."""
    folder.mkdir(parents=True)
    n, h, w = masks.shape
    out: dict[str, Path] = {}
    ids = {name: i + 1 for i, name in enumerate(dict.fromkeys(names))}
    boxes = [[int(v) for v in (*np.argwhere(m).min(0)[::-1], *(np.argwhere(m).max(0)[::-1] + 1))]
             for m in masks]  # fmt: skip
    base: dict[str, Any] = {
        "images": [{"id": 7, "width": w, "height": h, "file_name": "a.jpg"}],
        "categories": [{"id": i, "name": name} for name, i in ids.items()],
    }

    def save(key: str, name: str, tree: Any) -> None:
        out[key] = folder / name
        out[key].write_text(json.dumps(tree))

    codes = {
        "coco_list": lambda m: {"size": [h, w], "counts": runs(m)},
        "coco_text": lambda m: {"size": [h, w], "counts": compressed(runs(m))},
    }
    for key, code in codes.items():
        rows = [
            {"id": i, "image_id": 7, "category_id": ids[names[i]], "segmentation": code(m),
             "bbox": [b[0], b[1], b[2] - b[0], b[3] - b[1]]}
            for i, (m, b) in enumerate(zip(masks, boxes, strict=True))
        ]  # fmt: skip
        save(key, f"{key}.json", {**base, "annotations": rows})
    coco, order = {"chair": 62, "couch": 63, "person": 1}, {"chair": 56, "couch": 57, "person": 0}
    for key, table in (("results", coco), ("detectron2", order)):
        save(key, f"{key}.json", [
            {"image_id": 3, "category_id": table[names[i]], "score": 0.5, "bbox": [0, 0, 1, 1],
             "segmentation": {"size": [h, w], "counts": compressed(runs(m))}}
            for i, m in enumerate(masks)
        ])  # fmt: skip
    save("mover", "mover.json", [
        {"class": names[i], "bbox": [*b, 0.9], "mask": m.tolist()}
        for i, (m, b) in enumerate(zip(masks, boxes, strict=True))
    ])  # fmt: skip
    out["labelme"] = write_labelme(folder / "labelme.json", [
        (names[i], [[x0, y0], [x1, y1]], "rectangle", None)
        for i, (x0, y0, x1, y1) in enumerate(boxes)
    ])  # fmt: skip
    out["npz"] = folder / "masks.npz"
    np.savez(out["npz"], masks=masks, scores=np.full(n, 0.5), labels=np.array(names))
    out["npz_logits"] = folder / "logits.npz"
    np.savez(out["npz_logits"], masks=np.where(masks, 3.0, -3.0)[:, None].astype("f4"))
    for key in ("labels", "files", "alpha"):
        out[key] = folder / key
        out[key].mkdir()
    numbers = (masks * np.arange(1, n + 1)[:, None, None]).sum(0).astype(np.uint8)
    Image.fromarray(numbers).save(out["labels"] / "map.png")
    named = {str(k): name for k, name in enumerate(names, start=1)}
    (out["labels"] / "labels.json").write_text(json.dumps(named))
    for i, m in enumerate(masks):
        Image.fromarray((m * 255).astype(np.uint8)).save(out["files"] / f"{names[i]}_{i}.png")
        rgba = np.zeros((h, w, 4), dtype=np.uint8)
        rgba[..., :3], rgba[..., 3] = 77, m * 255
        Image.fromarray(rgba).save(out["alpha"] / f"{i}.png")
    picture((w, h)).save(out["alpha"] / "image.png")
    return out


def write_labelme(path: Path, things: list[tuple[str, list[list[float]], str, int | None]]) -> Path:
    """What labelme 5 saves of an image of 64 x 48: label, points, type and group of each shape."""
    shapes = [
        {"label": label, "points": points, "group_id": group, "description": "",
         "shape_type": kind, "flags": {}, "mask": None}
        for label, points, kind, group in things
    ]  # fmt: skip
    tree = {"version": "5.4.1", "flags": {}, "shapes": shapes, "imagePath": "a.jpg",
            "imageData": None, "imageHeight": 48, "imageWidth": 64}  # fmt: skip
    path.write_text(json.dumps(tree))
    return path


def promise(*shape: int) -> bytes:
    """Head of an .npy of float64."""
    stream = io.BytesIO()
    head = {"descr": "<f8", "fortran_order": False, "shape": shape}
    np.lib.format.write_array_header_1_0(stream, head)
    return stream.getvalue()
