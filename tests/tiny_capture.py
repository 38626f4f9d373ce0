"""A tiny capture folder, made with plain json and numpy: an oracle for the readers and writers."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

WIDTH, HEIGHT = 64, 48
PITCH, ROLL = -0.3, 0.08
STEP = np.array(
    [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [2, 0, 0.5]], dtype=float
)  # an asymmetric pile of triangles
STEP_FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3], [1, 4, 2]])
BODY = np.array([[0, -1.7, 0], [0.3, 0, 0], [-0.2, 0, 0.1], [0, -0.9, 0.25]])
BODY_FACES = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 1], [1, 3, 2]])
ROWS = [(0, 0, [0.2, 1.0, 4.0]), (0, 7, [-0.6, 1.1, 5.0]), (3, 0, [0.4, 0.9, 3.5])]


def rotation(pitch: float, roll: float, heading: float = 0.0) -> np.ndarray:
    """R_cam_world written out from the format's page, with the world turned by -heading."""
    c, s = np.cos(roll), np.sin(roll)
    rz = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
    c, s = np.cos(-pitch), np.sin(-pitch)
    rx = np.array([[1, 0, 0], [0, c, -s], [0, s, c]])
    c, s = np.cos(heading), np.sin(heading)
    ry = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
    return np.diag([1.0, -1, -1]) @ rz @ rx @ ry


def object_mask(index: int) -> np.ndarray:
    mask = np.zeros((HEIGHT, WIDTH), dtype=bool)
    if index == 0:
        mask[20:40, 5:25] = True
        mask[20:26, 5:9] = False
    else:
        mask[10:30, 40:60] = True
    return mask


def person_mask(row: int) -> np.ndarray:
    mask = np.zeros((HEIGHT, WIDTH), dtype=bool)
    mask[5:45, 30 + row : 38 + 2 * row] = True
    mask[5:9, 30 + row] = False
    return mask


def runs(mask: np.ndarray) -> list[int]:
    """Run lengths down the columns, background first."""
    flat = mask.T.ravel()
    ends = [0, *(np.flatnonzero(flat[1:] != flat[:-1]) + 1), flat.size]
    return [0] * int(flat[0]) + np.diff(ends).tolist()


def compressed(counts: list[int]) -> str:
    """COCO's code of run lengths, from its description: five bits a character, least first."""
    code = ""
    for i, count in enumerate(counts):
        x = count - (counts[i - 2] if i > 2 else 0)
        more = True
        while more:
            bits = x & 31
            x >>= 5
            more = x != (-1 if bits & 16 else 0)
            code += chr(bits + (32 if more else 0) + 48)
    return code


def camera(**changes: object) -> dict[str, Any]:
    tree = {"w": WIDTH, "h": HEIGHT, "fl_x": 60.0, "fl_y": 58.5, "cx": 30.5, "cy": 25.25}
    return {**tree, "R_cam_world": rotation(PITCH, ROLL).tolist(), **changes}


def scene() -> dict[str, Any]:
    return {
        "format": "mover-scene",
        "version": 1,
        "ground": {"height": -1.4},
        "objects": [
            {
                "id": "chair_0", "category": "chair", "mesh": "meshes/step.obj", "annotation": 11,
                "translation": [-0.9, -1.4, -3.0], "yaw": 0.4, "scale": [0.5, 0.9, 0.6],
            },
            {
                "id": "Lampe_ä.2", "category": "Stehlampe", "mesh": "meshes/lamp.glb",
                "annotation": 5, "translation": [0.8, -0.5, -3.2], "yaw": -2.9,
                "scale": [1.0, 1.1, 1.2], "support": "chair_0",
            },
        ],
    }  # fmt: skip


def hypotheses() -> dict[str, Any]:
    """The chair in its place, and in another one in the shape of the lamp."""
    keys = ("mesh", "translation", "yaw", "scale")
    first = {key: scene()["objects"][0][key] for key in keys}
    other = {**first, "mesh": "meshes/lamp.glb", "translation": [-0.2, -1.4, -3.5]}
    objects = {"chair_0": [first, other]}
    return {"format": "mover-hypotheses", "version": 1, "objects": objects}


def objects() -> dict[str, Any]:
    code = {"size": [HEIGHT, WIDTH], "counts": compressed(runs(object_mask(0)))}
    corners = [[40.0, 10.0, 60.0, 10.0, 60.0, 30.0, 40.0, 30.0]]
    first = {"id": 11, "image_id": 4, "category_id": 62, "bbox": [5, 20, 20, 20], "score": 0.75}
    second = {"id": 5, "image_id": 4, "category_id": 900, "bbox": [40.5, 10, 19.25, 20]}
    return {
        "images": [{"id": 4, "width": WIDTH, "height": HEIGHT, "file_name": "room.png"}],
        "categories": [{"id": 62, "name": "chair"}, {"id": 900, "name": "Stehlampe"}],
        "annotations": [{**first, "segmentation": code}, {**second, "segmentation": corners}],
    }


def people() -> dict[str, Any]:
    annotations = []
    for i, (frame, person, _) in enumerate(ROWS):
        counts = runs(person_mask(i))
        code = {"size": [HEIGHT, WIDTH], "counts": counts if i == 0 else compressed(counts)}
        row = {"id": i, "image_id": frame, "category_id": 1, "track_id": person}
        annotations.append({**row, "segmentation": code})
    reference = {"segmentation": {"size": [HEIGHT, WIDTH], "counts": runs(person_mask(2))}}
    return {
        "info": {"fps": 5.0, "heights": {"0": 1.78}},
        "images": [{"id": 0, "width": WIDTH, "height": HEIGHT}, {"id": 3}],
        "categories": [{"id": 1, "name": "person"}],
        "annotations": annotations,
        "reference_people": [reference],
    }


def bodies() -> dict[str, Any]:
    verts = np.stack([BODY + np.array(place) for _, _, place in ROWS])
    return {
        "frame": np.array([frame for frame, _, _ in ROWS]),
        "person": np.array([person for _, person, _ in ROWS]),
        "space": np.array("camera"),
        "vertices": verts.astype(np.float32),
        "faces": BODY_FACES.astype(np.int32),
        "joints": verts[:, :2].astype(np.float32) + np.float32(0.01),
        "joint_names": np.array(["head", "foot"]),
    }


def touch() -> np.ndarray:
    return np.linspace(0, 1, 12, dtype=np.float32).reshape(3, 4)


def picture() -> np.ndarray:
    pixels = np.zeros((HEIGHT, WIDTH, 3), dtype=np.uint8)
    pixels[..., 0] = np.arange(WIDTH)
    pixels[..., 1] = np.arange(HEIGHT)[:, None] * 3
    return pixels


def put(tree: Any, way: Sequence[Any], value: Any) -> None:
    """Set the field of nested lists and objects to which the way leads; `...` deletes it."""
    *way, last = way
    for key in way:
        tree = tree[key]
    if value is ...:
        del tree[last]
    else:
        tree[last] = value


def change(file: Path, path: str, value: Any) -> None:
    """Set the field `a.0.b` of a JSON file; `...` deletes it."""
    tree = json.loads(file.read_text())
    put(tree, [int(key) if key.isdigit() else key for key in path.split(".")], value)
    file.write_text(json.dumps(tree))


def ways_of(tree: Any, way: tuple[Any, ...] = (), most: int = 10**9) -> list[tuple[Any, ...]]:
    """The way to every value in lists and objects; in lists of `most` items only to the ends."""
    found = [way] if way else []
    keys: Any = tree if isinstance(tree, dict) else ()
    if isinstance(tree, list):
        keys = range(len(tree)) if len(tree) < most else (0, len(tree) - 1)
    for key in keys:
        found += ways_of(tree[key], (*way, key), most)
    return found


def write_obj(path: Path, verts: np.ndarray, faces: np.ndarray) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    lines = ["v " + " ".join(map(str, v)) for v in verts.tolist()]
    lines += ["f " + " ".join(str(i + 1) for i in f) for f in faces.tolist()]
    path.write_text("\n".join(lines) + "\n")


def write_glb(path: Path) -> None:
    """The step, stored small and moved by the transform of its node."""
    import trimesh

    transform = np.diag([0.5, 0.5, 0.5, 1.0])
    transform[:3, 3] = [0.1, 0.2, 0.3]
    whole = trimesh.Scene()
    whole.add_geometry(trimesh.Trimesh(STEP, STEP_FACES, process=False), transform=transform)
    whole.export(path, file_type="glb")


def write_capture(folder: Path) -> Path:
    """Write all files of the capture."""
    (folder / "meshes").mkdir(parents=True)
    for name, tree in (
        ("camera", camera(height=1.45)),
        ("scene", scene()),
        ("objects", objects()),
        ("people", people()),
    ):
        (folder / f"{name}.json").write_text(json.dumps(tree))
    np.savez(folder / "bodies.npz", **bodies())
    np.savez(folder / "contacts.npz", probability=touch())
    Image.fromarray(picture()).save(folder / "room.png")
    write_obj(folder / "meshes" / "step.obj", STEP, STEP_FACES)
    write_glb(folder / "meshes" / "lamp.glb")
    return folder
