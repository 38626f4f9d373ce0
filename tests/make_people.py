"""Files as today's tools leave them, of one known person; written without the package.

One adult with the left arm raised walks past a tilted camera, seen in an image that is wider than
high. The body is a skeleton with rigid flesh about each joint; its pelvis is not at its origin.
World: +y up, the camera at the origin. Camera: x right, y down, z forward.
"""

import json
import math
import pickle
from collections import defaultdict
from functools import partial
from pathlib import Path

import numpy as np
import torch
from scipy.spatial.transform import Rotation

WIDTH, HEIGHT = 1280, 720
K = np.array([[1100.0, 0, 655], [0, 1100, 348], [0, 0, 1]])
PITCH, ROLL = -0.15, 0.03
FRAMES = np.array([0, 1, 2, 5, 6])  # the person is hidden in 3 and 4
TRACK = 3

BODY = {  # rest place of the joints [m]; +x is the person's left, +y up, +z where they look
    0: (0, -0.24, 0.02), 1: (0.07, -0.33, 0), 2: (-0.07, -0.33, 0), 3: (0, -0.12, 0),
    4: (0.1, -0.72, 0), 5: (-0.1, -0.72, 0), 6: (0, 0.01, 0), 7: (0.09, -1.13, -0.03),
    8: (-0.09, -1.13, -0.03), 9: (0, 0.07, 0.01), 10: (0.12, -1.19, 0.1),
    11: (-0.12, -1.19, 0.1), 12: (0, 0.28, -0.02), 13: (0.08, 0.19, -0.01),
    14: (-0.08, 0.19, -0.01), 15: (0, 0.37, 0.02), 16: (0.17, 0.22, -0.02),
    17: (-0.17, 0.22, -0.02), 18: (0.43, 0.2, -0.04), 19: (-0.43, 0.2, -0.04),
    20: (0.68, 0.21, -0.04), 21: (-0.68, 0.21, -0.04),
}  # fmt: skip
PARENTS = [-1, 0, 0, 0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 9, 9, 12, 13, 14, 16, 17, 18, 19]
COUNTS = {"smpl": (24, 690), "smplh": (52, 690), "smplx": (55, 1100)}  # joints; a tenth of the skin
HAND_MEAN = 0.2  # [rad], what SMPL-X adds to every angle of a hand


def skeleton(model: str) -> tuple[np.ndarray, list[int]]:
    """Rest joints and parents; hands hang on the wrists (20, 21), the face on the head (15)."""
    places, parents = [np.array(BODY[k], float) for k in range(22)], list(PARENTS)
    if model == "smpl":
        extra = [(20, (0.08, 0, 0)), (21, (-0.08, 0, 0))]
    else:
        face = [(15, (0, -0.02, 0.03)), (15, (0.03, 0.06, 0.06)), (15, (-0.03, 0.06, 0.06))]
        fingers = [(20, (0.08, 0, 0.01 * k)) for k in range(15)]
        fingers += [(21, (-0.08, 0, 0.01 * k)) for k in range(15)]
        extra = ([] if model == "smplh" else face) + fingers
    for parent, offset in extra:
        places.append(places[parent] + offset)
        parents.append(parent)
    return np.array(places), parents


def flesh(model: str) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertices about the joints, the joint of each, and triangles."""
    joints, verts = COUNTS[model]
    rng = np.random.default_rng(0)
    offset = rng.normal(size=(verts, 3))
    offset *= 0.06 / np.linalg.norm(offset, axis=1, keepdims=True)
    owner = np.arange(verts) % joints
    first = np.arange(0, verts - 2, 2)
    faces = np.stack([first, first + 1, first + 2], 1)
    return offset, owner, np.concatenate([faces, [[verts - 1, 0, 1]]])


def posed(model, angles, transl, betas=None, flat_hands=True):
    """Vertices and joints of (T, joints, 3) axis-angle vectors; beta 0 makes 5 cm taller."""
    rest, parents = skeleton(model)
    offset, owner, _ = flesh(model)
    angles = np.array(angles, float).reshape(len(transl), len(rest), 3)
    if model == "smplx" and not flat_hands:
        angles[:, 25:] += HAND_MEAN
    verts, joints = [], []
    for t, turn in enumerate(Rotation.from_rotvec(angles.reshape(-1, 3)).as_matrix().reshape(
        *angles.shape[:2], 3, 3
    )):  # fmt: skip
        size = 1 if betas is None else 1 + 0.03 * betas[t, 0]
        world, place = [turn[0]], [rest[0] * size]
        for j in range(1, len(rest)):
            p = parents[j]
            world.append(world[p] @ turn[j])
            place.append(place[p] + world[p] @ (rest[j] - rest[p]) * size)
        world, place = np.array(world), np.array(place) + transl[t]
        joints.append(place)
        verts.append(place[owner] + np.einsum("vij,vj->vi", world[owner], offset * size))
    return np.array(verts), np.array(joints)


def camera_matrix() -> np.ndarray:
    """R_cam_world."""
    flip = np.diag([1.0, -1, -1])
    turn = Rotation.from_rotvec([0, 0, ROLL]) * Rotation.from_rotvec([-PITCH, 0, 0])
    return flip @ turn.as_matrix()


def camera_json() -> dict:
    return {"w": WIDTH, "h": HEIGHT, "fl_x": K[0, 0], "fl_y": K[1, 1], "cx": K[0, 2], "cy": K[1, 2]}


def person(model: str) -> dict[str, np.ndarray]:
    """The true person in camera axes: angles, transl, betas, verts, joints, pixels."""
    count = COUNTS[model][0]
    angles = np.zeros((len(FRAMES), count, 3))
    angles[:, 16, 2] = 1.3  # the left arm is raised
    angles[:, 17, 2] = 0.9  # the right arm hangs
    angles[:, 1, 0] = -0.2 + 0.05 * FRAMES  # the left leg swings
    angles[:, 15, 1] = 0.3
    if model == "smplx":
        angles[:, 25:40, 2] = 0.1
    R = camera_matrix()
    root = Rotation.from_matrix(R) * Rotation.from_rotvec([0, 0.3, 0])
    angles[:, 0] = root.as_rotvec()
    betas = np.zeros((len(FRAMES), 10))
    betas[:, 0] = 0.8
    world = np.stack([0.5 + 0.1 * FRAMES, np.full(5, -0.35), -4 - 0.05 * FRAMES], 1)
    transl = world @ R.T
    verts, joints = posed(model, angles, transl, betas)
    return {
        "angles": angles, "transl": transl, "betas": betas,
        "verts": verts, "joints": joints, "pixels": pixels(joints),
    }  # fmt: skip


def pixels(points: np.ndarray, lens: np.ndarray = K) -> np.ndarray:
    seen = points @ lens.T
    return seen[..., :2] / seen[..., 2:]


def lens(focal: float) -> np.ndarray:
    return np.array([[focal, 0, WIDTH / 2], [0, focal, HEIGHT / 2], [0, 0, 1]])


def under(other: np.ndarray, true: dict) -> np.ndarray:
    """Shift of the person that a tool with another lens reports: same pixel, same size."""
    middle = true["verts"].mean(1)
    depth = middle[:, 2] * other[0, 0] / K[0, 0]
    at = pixels(middle)
    flat = (at - other[:2, 2]) / other[0, 0] * depth[:, None]
    return np.concatenate([flat, depth[:, None]], 1) - middle


def rolled(vector: np.ndarray, angle: float) -> np.ndarray:
    """A root in a world that turns about its x axis."""
    return (Rotation.from_rotvec([angle, 0, 0]) * Rotation.from_rotvec(vector)).as_rotvec()


def matrices(vectors: np.ndarray) -> np.ndarray:
    flat = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix()
    return flat.reshape(*vectors.shape[:-1], 3, 3)


def in_world(true: dict, R: np.ndarray, t: np.ndarray, model: str) -> tuple[np.ndarray, np.ndarray]:
    """Angles and transl in the world x_world = R x_cam + t: the root turns about the pelvis."""
    angles = true["angles"].copy()
    angles[:, 0] = (Rotation.from_matrix(R) * Rotation.from_rotvec(angles[:, 0])).as_rotvec()
    rest = skeleton(model)[0][0] * (1 + 0.03 * true["betas"][:, :1])
    return angles, (rest + true["transl"]) @ R.T + t - rest


def upright() -> tuple[np.ndarray, np.ndarray]:
    """A tool's world with +y up, of any heading and origin: x_world = R x_cam + t."""
    R = Rotation.from_rotvec([0, 1.1, 0]).as_matrix() @ camera_matrix().T
    return R, np.array([1.0, 0.9, -2.0])


def write_gvhmr(folder: Path, names=("smpl_params_incam", "smpl_params_global")) -> Path:
    true = person("smplx")
    used = lens(math.hypot(WIDTH, HEIGHT))
    shift = under(used, true)
    world, place = in_world(true, *upright(), "smplx")
    body = {"body_pose": true["angles"][:, 1:22].reshape(-1, 63), "betas": true["betas"]}
    incam = {**body, "global_orient": true["angles"][:, 0], "transl": true["transl"] + shift}
    data = {names[0]: incam, names[1]: {**body, "global_orient": world[:, 0], "transl": place}}
    data["K_fullimg"] = np.broadcast_to(used, (len(FRAMES), 3, 3)).copy()
    torch.save(to_torch(data), folder / "hmr4d_results.pt")
    return folder / "hmr4d_results.pt"


write_gem = partial(write_gvhmr, names=("body_params_incam", "body_params_global"))


def to_torch(value):
    if isinstance(value, dict):
        return {k: to_torch(v) for k, v in value.items()}
    return torch.from_numpy(np.asarray(value)).float()


def dump(value, path: Path, compress=0) -> Path:
    import joblib

    joblib.dump(value, path, compress=compress)
    return path


def wham_person() -> dict:
    true = person("smpl")
    shift = under(lens(math.hypot(WIDTH, HEIGHT)), true)
    world, place = in_world(true, *upright(), "smpl")
    return {
        "pose": true["angles"].reshape(-1, 72), "trans": true["transl"] + shift,
        "pose_world": world.reshape(-1, 72), "trans_world": place, "betas": true["betas"],
        "verts": (true["verts"] + shift[:, None]).astype(np.float32), "frame_ids": FRAMES,
    }  # fmt: skip


def write_wham(folder: Path) -> Path:
    return dump(defaultdict(dict, {TRACK: wham_person()}), folder / "wham_output.pkl")


def pare_person() -> dict:
    """A square about the person; s, p, q by weak perspective of the position."""
    true = person("smpl")
    t = true["transl"]
    low, high = true["pixels"].min(1), true["pixels"].max(1)
    middle, side = (low + high) / 2, (high - low).max(1) * 1.2
    size = 2 * K[0, 0] / (t[:, 2] * side)
    offset = t[:, :2] - 2 * (middle - K[:2, 2]) / (size * side)[:, None]
    half = np.array([WIDTH, HEIGHT]) / 2
    scale = K[0, 0] / t[:, 2:] / half
    return {
        "pred_cam": np.concatenate([size[:, None], offset], 1),
        "bboxes": np.concatenate([middle, side[:, None], side[:, None]], 1),
        "orig_cam": np.concatenate([scale, (pixels(t) / half - 1) / scale], 1),
        "joints3d": true["joints"] - t[:, None], "smpl_joints2d": true["pixels"],
        "verts": true["verts"] - t[:, None], "pose": matrices(true["angles"]),
        "betas": true["betas"], "frame_ids": FRAMES, "joints2d": None,
    }  # fmt: skip


def write_pare(folder: Path, name="pare_output.pkl") -> Path:
    return dump({TRACK: pare_person()}, folder / name)


def write_pare_images(folder: Path) -> Path:
    """One pickle an image, with a row a person."""
    given = pare_person()
    names = {"pose": "pred_pose", "betas": "pred_shape", "orig_cam": "orig_cam"}
    for k, frame in enumerate(FRAMES):
        rows = {new: given[old][k : k + 1] for old, new in names.items()}
        dump(rows, folder / f"img_{frame:06d}.pkl")
    return folder


def write_phalp(folder: Path) -> Path:
    true = person("smpl")
    place = true["transl"] + under(lens(5000 / 256 * max(WIDTH, HEIGHT)), true)
    turns = matrices(true["angles"])
    frames = {}
    for frame in range(int(FRAMES[-1]) + 1):
        near = int(np.argmin(np.abs(FRAMES - frame)))
        ghost = frame not in FRAMES  # the tracker foretells people that it does not see
        body = {"global_orient": turns[near, :1], "body_pose": turns[near, 1:]}
        frames[f"outputs/_DEMO/video/img/{frame + 1:06d}.jpg"] = {
            "time": frame, "tid": [TRACK], "smpl": [{**body, "betas": true["betas"][near]}],
            "camera": [place[near]], "size": [[HEIGHT, WIDTH]], "tracked_time": [int(ghost)],
        }  # fmt: skip
    return dump(frames, folder / "demo_video.pkl", compress=3)


def write_tram(folder: Path) -> Path:
    true = person("smpl")
    R, t = upright()
    count = int(FRAMES[-1]) + 1
    used = lens(900.0)
    camera = {
        "pred_cam_R": np.broadcast_to(np.eye(3), (count, 3, 3)), "pred_cam_T": np.zeros((count, 3)),
        "world_cam_R": np.broadcast_to(R, (count, 3, 3)).copy(),
        "world_cam_T": np.broadcast_to(t, (count, 3)).copy(),
        "img_focal": 900.0, "img_center": np.array([WIDTH / 2, HEIGHT / 2]), "spec_focal": 880.0,
    }  # fmt: skip
    np.save(folder / "camera.npy", camera, allow_pickle=True)
    (folder / "hps").mkdir()
    track = {
        "pred_rotmat": matrices(true["angles"]), "pred_shape": true["betas"],
        "pred_trans": (true["transl"] + under(used, true))[:, None],
        "pred_cam": np.zeros((5, 3)), "frame": FRAMES,
    }  # fmt: skip
    tensors = {k: torch.from_numpy(np.asarray(v)) for k, v in track.items()}
    np.save(folder / "hps" / "hps_track_0.npy", tensors, allow_pickle=True)
    return folder


def write_prompthmr(folder: Path) -> Path:
    true = person("smplx")
    R, t = upright()
    count = int(FRAMES[-1]) + 1
    used = lens(1500.0)
    world, place = in_world(true, R, t, "smplx")
    trans = true["transl"] + under(used, true)
    lens_keys = {"img_focal": 1500.0, "img_center": np.array([WIDTH / 2, HEIGHT / 2])}
    data = {
        "people": {TRACK: {
            "frames": FRAMES, "track_id": TRACK,
            "smplx_cam": {"rotmat": matrices(true["angles"]), "shape": true["betas"],
                          "pose": true["angles"][:, :25].reshape(5, 75), "trans": trans},
            "smplx_world": {"pose": world.reshape(5, 165), "shape": true["betas"], "trans": place},
        }},
        "camera": {"pred_cam_R": np.zeros((count, 3, 3)), **lens_keys},
        "camera_world": {"Rcw": np.broadcast_to(R.T, (count, 3, 3)).copy(),
                         "Tcw": np.broadcast_to(-R.T @ t, (count, 3)).copy(), **lens_keys},
    }  # fmt: skip
    return dump(data, folder / "results.pkl", compress=("gzip", 3))


def write_slahmr(folder: Path) -> Path:
    """A world of the camera's axes, turned a little; frame 3 and 4 of the person are gaps (NaN)."""
    true = person("smplh")
    R = Rotation.from_rotvec([0.2, -0.1, 0.05]).as_matrix()  # x_cam = R x_world + t
    t = np.array([0.1, -0.2, 0.3])
    world, place = in_world(true, R.T, -R.T @ t, "smplh")
    count = int(FRAMES[-1]) + 1
    gaps = np.full((1, count, 63 + 6), np.nan)
    gaps[0, FRAMES] = np.concatenate([world[:, 0], place, world[:, 1:22].reshape(-1, 63)], 1)
    betas = np.zeros((1, 16))
    betas[0, :10] = true["betas"][0]
    up = R.T @ camera_matrix()[:, 1]
    path = folder / "video_000060_world_results.npz"
    np.savez(
        path, trans=gaps[..., 3:6], root_orient=gaps[..., :3], pose_body=gaps[..., 6:],
        betas=betas, cam_R=np.broadcast_to(R, (1, count, 3, 3)),
        cam_t=np.broadcast_to(t, (1, count, 3)), floor_plane=-1.4 * up[None],
        intrins=np.array([K[0, 0], K[1, 1], K[0, 2], K[1, 2]]), world_scale=np.ones(1),
    )  # fmt: skip
    return folder


def write_sam3dbody(folder: Path, focal=True) -> Path:
    """Meshes without parameters; another person stands still, listed in turn first and second."""
    true = person("smplx")
    used = lens(1400.0)
    place = np.array([0, 0, 4.0])
    for k, frame in enumerate(FRAMES):
        people = []
        for far in (0.0, 1.5):
            verts, joints = (true[n][0 if far else k] + [far, 0, far] for n in ("verts", "joints"))
            shift = under(used, {"verts": verts[None]})[0]
            people.append({
                "pred_vertices": (verts + shift - place).astype(np.float32), "pred_cam_t": place,
                "pred_keypoints_3d": joints + shift - place,
                "pred_keypoints_2d": pixels(joints + shift, used), "bbox": np.zeros(4),
                **({"focal_length": 1400.0} if focal else {}),
            })  # fmt: skip
        for j, one in enumerate(people if k % 2 else people[::-1]):
            np.savez(folder / f"{frame:06d}_subj{j:02d}.npz", **one)
    return folder


def write_amass(folder: Path, model="smplh") -> Path:
    """A motion in a world with +z up: of SMPL-H as released first, of SMPL-X as `stageii`."""
    true = person(model)
    z_up = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    angles, place = in_world(true, z_up @ camera_matrix().T, np.zeros(3), model)
    betas = np.zeros(16)
    betas[:10] = true["betas"][0]
    data = {"poses": angles.reshape(len(FRAMES), -1), "trans": place, "betas": betas}
    if model == "smplx":
        more = {"gender": "neutral", "mocap_frame_rate": 30.0, "surface_model_type": "smplx"}
        labels = np.array([["LFHD", None]] * len(FRAMES), dtype=object)
        np.savez(folder / "walk_stageii.npz", **data, **more, labels_obs=labels)
        return folder / "walk_stageii.npz"
    more = {"gender": np.array(b"neutral"), "mocap_framerate": 30.0, "dmpls": np.zeros((5, 8))}
    np.savez(folder / "walk_poses.npz", **data, **more)
    return folder / "walk_poses.npz"


write_amass_x = partial(write_amass, model="smplx")


def fit(k: int, place: np.ndarray | None = None) -> dict:
    """A frame's pickle of SMPLify-X, whose camera sees the body at a place, or of PROX (None)."""
    true = person("smplx")
    row = true["angles"][k]
    prox = {"transl": true["transl"][k : k + 1], "pose_embedding": np.zeros((1, 32))}
    return {
        "betas": true["betas"][k : k + 1], "global_orient": row[:1],
        "body_pose": row[1:22].reshape(1, 63), "jaw_pose": row[22:23], "leye_pose": row[23:24],
        "reye_pose": row[24:25], "expression": np.zeros((1, 10)),
        "left_hand_pose": row[25:40].reshape(1, 45) - HAND_MEAN,
        "right_hand_pose": row[40:].reshape(1, 45) - HAND_MEAN,
        "camera_rotation": np.eye(3)[None], **(prox if place is None else {}),
        "camera_translation": np.zeros((1, 3)) if place is None else place.reshape(1, 3),
    }  # fmt: skip


def write_smplifyx(folder: Path) -> Path:
    true = person("smplx")
    place = true["transl"] + under(lens(5000.0), true)
    for k, frame in enumerate(FRAMES):
        store(fit(k, place[k]), folder / "results" / f"{frame:06d}" / f"{TRACK:03d}.pkl")
    return folder / "results"


def write_prox(folder: Path) -> Path:
    for k, frame in enumerate(FRAMES):
        name = f"s001_frame_{frame:05d}__00.00.0{k}.023"
        store(fit(k), folder / "results" / name / "000.pkl")
    return folder / "results"


def store(value, path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("wb") as file:
        pickle.dump(value, file, protocol=2)
    return path


BODIES = {
    "4dhumans": write_phalp, "amass": write_amass, "amass:smplx": write_amass_x, "gem": write_gem,
    "gvhmr": write_gvhmr, "pare": write_pare, "pare:images": write_pare_images,
    "phalp": write_phalp, "prompthmr": write_prompthmr,
    "prox": write_prox, "sam3dbody": write_sam3dbody, "slahmr": write_slahmr,
    "smplifyx": write_smplifyx, "tram": write_tram,
    "vibe": partial(write_pare, name="vibe_output.pkl"), "wham": write_wham,
}  # fmt: skip

# The joints of the skeleton that show where a detector's points are.
SHOWN = {"nose": 15, "neck": 12, "mid_hip": 0} | {
    f"{side}_{name}": joint + (side == "right")
    for side in ("left", "right")
    for name, joint in {"shoulder": 16, "elbow": 18, "wrist": 20, "hip": 1, "knee": 4, "ankle": 7,
                        "big_toe": 10}.items()
}  # fmt: skip
COCO = ("nose", "left_eye", "right_eye", "left_ear", "right_ear", "left_shoulder",
        "right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist", "left_hip",
        "right_hip", "left_knee", "right_knee", "left_ankle", "right_ankle")  # fmt: skip
HALPE = (*COCO, "head_top", "neck", "mid_hip", "left_big_toe", "right_big_toe", "left_small_toe",
         "right_small_toe", "left_heel", "right_heel")  # fmt: skip
MEDIAPIPE = ("nose", "", "left_eye", "", "", "right_eye", "", "left_ear", "right_ear", "", "",
             "left_shoulder", "right_shoulder", "left_elbow", "right_elbow", "left_wrist",
             "right_wrist", *("",) * 6, "left_hip", "right_hip", "left_knee", "right_knee",
             "left_ankle", "right_ankle", "left_heel", "right_heel", "left_big_toe",
             "right_big_toe")  # fmt: skip
OPENPOSE = ("nose", "neck", "right_shoulder", "right_elbow", "right_wrist", "left_shoulder",
            "left_elbow", "left_wrist", "mid_hip", "right_hip", "right_knee", "right_ankle",
            "left_hip", "left_knee", "left_ankle", "right_eye", "left_eye", "right_ear",
            "left_ear", "left_big_toe", "left_small_toe", "left_heel", "right_big_toe",
            "right_small_toe", "right_heel")  # fmt: skip


def seen(names) -> np.ndarray:
    """(frames, joints, 3): pixels counted from the first pixel's centre; unknown joints are 0."""
    shown = person("smplx")["pixels"] - 0.5
    found = np.zeros((len(FRAMES), len(names), 3))
    for k, name in enumerate(names):
        if name in SHOWN:
            found[:, k] = np.c_[shown[:, SHOWN[name]], np.full(len(FRAMES), 0.9)]
    return found


def write_openpose(folder: Path) -> Path:
    body = seen(OPENPOSE)
    hand = np.zeros((5, 21, 3))
    left, right = hand.copy(), hand.copy()
    left[:, 0], right[:, 0] = body[:, 7], body[:, 4]
    for frame in range(int(FRAMES[-1]) + 1):
        people = [{
            "person_id": [-1], "pose_keypoints_2d": body[k].ravel().tolist(),
            "hand_left_keypoints_2d": left[k].ravel().tolist(),
            "hand_right_keypoints_2d": right[k].ravel().tolist(),
            "face_keypoints_2d": [0.0] * 210, "pose_keypoints_3d": [],
        } for k in np.flatnonzero(frame == FRAMES)]  # fmt: skip
        text = json.dumps({"version": 1.3, "people": people})
        (folder / f"video_{frame:012d}_keypoints.json").write_text(text)
    return folder


def write_coco17(folder: Path, name="results.json", joints=COCO, **more) -> Path:
    """A row a person and frame, as COCO's results; `more` are further fields of each."""
    rows = [
        {"image_id": f"{f}.jpg" if more else int(f), "category_id": 1,
         "keypoints": row.ravel().tolist(), "score": 0.8, **more}
        for f, row in zip(FRAMES, seen(joints), strict=True)
    ]  # fmt: skip
    (folder / name).write_text(json.dumps(rows))
    return folder / name


def write_coco17_mmpose(folder: Path) -> Path:
    images = [
        {"frame_id": int(f), "instances": [
            {"keypoints": row[:, :2].tolist(), "keypoint_scores": row[:, 2].tolist()}
        ]}
        for f, row in zip(FRAMES, seen(COCO), strict=True)
    ]  # fmt: skip
    (folder / "mmpose.json").write_text(json.dumps({"meta_info": {}, "instance_info": images}))
    return folder / "mmpose.json"


def write_coco17_ultralytics(folder: Path) -> Path:
    """`to_json` of the results of each image, in a list."""
    images: list[list[dict[str, object]]] = [[] for _ in range(int(FRAMES[-1]) + 1)]
    for frame, row in zip(FRAMES, seen(COCO), strict=True):
        joints = {axis: row[:, k].tolist() for k, axis in enumerate(("x", "y", "visible"))}
        box = {"x1": 0.0, "y1": 0.0, "x2": 9.0, "y2": 9.0}
        images[frame] = [{"name": "person", "class": 0, "confidence": 0.9, "box": box,
                          "track_id": TRACK, "keypoints": joints}]  # fmt: skip
    (folder / "yolo.json").write_text(json.dumps(images))
    return folder / "yolo.json"


def write_coco17_vitpose(folder: Path) -> Path:
    """`--save-json` of JunkyByte/easy_ViTPose, inference.py: y, x, score by track and image."""
    images: list[dict[str, object]] = [{} for _ in range(int(FRAMES[-1]) + 1)]
    for frame, row in zip(FRAMES, seen(COCO), strict=True):
        images[frame] = {str(TRACK): row[:, [1, 0, 2]].tolist()}
    names = {str(k): str(k) for k in range(17)}
    (folder / "vitpose.json").write_text(json.dumps({"keypoints": images, "skeleton": names}))
    return folder / "vitpose.json"


KEYPOINTS = {
    "coco17": write_coco17, "coco17:mmpose": write_coco17_mmpose,
    "coco17:ultralytics": write_coco17_ultralytics, "coco17:vitpose": write_coco17_vitpose,
    "halpe26": partial(write_coco17, name="alphapose-results.json", joints=HALPE, score=2.9,
                       box=[0, 0, 1, 1], idx=TRACK),
    "openpose": write_openpose,
    "mediapipe": partial(write_coco17, name="landmarks.json", joints=MEDIAPIPE),
}  # fmt: skip
