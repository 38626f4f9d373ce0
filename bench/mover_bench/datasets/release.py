"""The folder of the MOVER authors' release: one sequence with all inputs, and their results.

    Total3D_label_occNet_results/Total3D_input/   the initial scene; its objects' detections
    Color_flip_rename/000001.jpg ...              frames, numbered from 1
    Color_flip_rename_pointrend_.../000001/detections.json      masks of every frame
    smplifyx_results_st2_.../{meshes/*.obj, smplifyx_cam/001.xml}   bodies in their world (y down)
    smplifyx_results_st0/results/posa_contact_.../000000_sample_00.npy   contacts, from 0
    prox_scans_pre/{bbox3d.json, scan_cam_cooridnates.ply}      the truth, in the camera's frame
    refine_results/**/f000_world.obj              their result

Folders are found by what they hold, so that renamed ones do as well.
"""

import dataclasses
import math
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mover.core.errors import InputError
from mover.core.files import copy_whole
from mover.core.types import Mesh, Scene
from mover.geometry.rotations import affine
from mover.io.capture.camera_file import camera_of
from mover.io.capture.parts import Hints, Parts
from mover.io.capture.scene_file import scene_of, scene_tree, write_scene
from mover.io.files.cameras import read_camera_file
from mover.io.files.fields import At, existing, read_json, read_npy
from mover.io.files.meshes import load_arrays, mesh_of, write_mesh
from mover.io.files.schema import rotation
from mover.io.masks.coco import annotations_tree
from mover.io.masks.instance_files import list_instances
from mover.io.masks.instances import Instance, Instances
from mover.io.scenes.networks import CLASSES, FURNITURE, read_shape, total3d_parts
from mover.io.scenes.placing import (
    FLIP,
    LEVEL,
    Matrix,
    Pieces,
    about_y,
    free_id,
    level_of,
    load_from,
    posed,
)
from mover_bench.datasets.true_boxes import (
    boxes_scene,
    floor_in,
    read_bbox3d,
    read_scan,
    vertical_of,
)

FPS = 30.0
STAGES = ("smplifyx_results_st2*", "smplifyx_results_st0*", "*")
CONTACTS = "*_sample_00.npy"


def body_arrays(folder: Path, R: Matrix | None, notes: list[str]) -> tuple[At | None, int]:
    """The arrays of bodies.npz in the camera's frame, and the number of frame 0.

    `R` is R_cam_world of the world of the meshes, whose y is down, where it is known.

    Raises:
        InputError: If a mesh cannot be read or has another topology than the first.
    """
    paths = _meshes(folder)
    if not paths or R is None:
        return None, 1
    numbers = [int(p.stem) for p in paths]
    verts: list[Matrix] = []
    faces = read_shape(paths[0])[1]
    for path in paths:
        points, own = read_shape(path)
        if own.shape != faces.shape or len(points) != len(verts[0] if verts else points):
            raise InputError(f"{path.name}: has another topology, expected that of {paths[0].name}")
        verts.append(points @ FLIP @ R.T)
    notes.append(f"{len(paths)} bodies are those of {paths[0].parent.parent.name}")
    arrays: dict[str, Any] = {
        "vertices": np.stack(verts).astype(np.float32),
        "faces": faces,
        "frame": np.array(numbers) - numbers[0],
        "person": np.zeros(len(numbers), dtype=np.int64),
        "space": np.array("camera"),
        "fps": np.array(FPS),
    }
    return At(arrays, paths[0].parent.name), numbers[0]


def _meshes(folder: Path) -> list[Path]:
    """The meshes of the last stage that has any, by number."""
    for stage in STAGES:
        for home in sorted(folder.glob(f"{stage}/meshes")):
            kinds = [p for p in home.iterdir() if p.suffix in (".obj", ".ply")]
            paths = [p for p in kinds if p.stem.isdecimal()]
            if paths:
                return sorted(paths, key=lambda p: int(p.stem))
    return []


def contact_arrays(folder: Path, bodies: At | None, notes: list[str]) -> At | None:
    """The arrays of contacts.npz, where there is one file for each body."""
    if bodies is None:
        return None
    rows, count = bodies.value["vertices"].shape[:2]
    home = next(iter(sorted({p.parent for p in folder.rglob(CONTACTS)})), None)
    if home is None:
        return None
    paths = [home / f"{frame:06d}_sample_00.npy" for frame in bodies.value["frame"].tolist()]
    there = [path for path in paths if path.is_file()]
    if len(there) < rows:
        notes.append(f"contacts: only {len(there)} of {rows} bodies have a file, so none is used")
        return None
    values = [read_npy(path) for path in paths]
    for at in values:
        if at.value.dtype.kind != "f" or at.value.size != count:
            raise InputError(f"{at.file}: has shape {at.value.shape}, expected ({count}, 1)")
    stack = np.stack([at.value.reshape(-1) for at in values]).astype(np.float32)
    return At({"probability": stack.clip(0, 1)}, home.name)


DEEPEST = 5  # folders below the sequence's own that are looked through
DETECTIONS = "detections.json"
SURE = 0.7  # the authors drop detections of the reference image that are less so
LEAST = 4  # points that settle a transform


def release_parts(folder: Path, hints: Hints) -> Parts:
    """One sequence of the authors' release.

    Raises:
        InputError: If the initial scene is missing, or a file is wrong.
    """
    if not folder.is_dir():
        raise InputError(f"{folder}: there is no such folder, expected a sequence of MOVER")
    home = found(folder, "bdb_3d.mat")
    if home is None:
        raise InputError(f"{folder}: has no bdb_3d.mat in it, expected Total3D_input")
    parts = _unsure_dropped(total3d_parts(home.parent, hints))
    assert parts.camera is not None
    lens: dict[str, Any] = dict(parts.camera.value)
    size = lens["w"], lens["h"]
    notes: list[str] = []
    xml = found(folder, "001.xml")
    R = None if xml is None else np.array(read_camera_file(xml, size).get("R_cam_world").value)
    if R is None:
        notes.append("there is no smplifyx_cam/001.xml, so the bodies' world is not known")
    bodies, first = body_arrays(folder, R, notes)
    people = _people(folder, home.parent, size)
    one = found(folder, f"{first:06d}.jpg")
    pictures = sorted(one.parent.glob("[0-9]*.jpg")) if one is not None else []
    beside: dict[str, Callable[[Path], object]] = dict(parts.beside)
    for picture in (p for p in pictures if p.stem.isdecimal()):
        beside[f"frames/{int(picture.stem) - first:06d}.jpg"] = partial(copy_whole, picture)
    contacts = contact_arrays(folder, bodies, notes)
    scenes = {**_truth(folder, lens, hints), **_authors(folder, parts, R, notes)}
    for place, scene in scenes.items():
        beside[f"{place}/scene.json"] = partial(write_scene, scene)
    return dataclasses.replace(
        parts, name=folder.resolve().name, bodies=bodies, contacts=contacts, people=people,
        beside=beside, notes=tuple(notes),
    )  # fmt: skip


def found(folder: Path, name: str) -> Path | None:
    """The first file of this name in a folder or some folders below it."""
    for depth in range(DEEPEST):
        paths = sorted(folder.glob("*/" * depth + name))
        if paths:
            return paths[0]
    return None


def _unsure_dropped(parts: Parts) -> Parts:
    """Without objects whose detection is not sure enough, as the authors do."""
    assert parts.objects is not None
    assert parts.scene is not None
    tree, scene = parts.objects.value, parts.scene.value
    kept = [a for a in tree["annotations"] if a.get("score", 1.0) >= SURE]
    ids = {a["id"] for a in kept}
    rows = [row for row in scene["objects"] if row["annotation"] in ids]
    return dataclasses.replace(
        parts,
        objects=At({**tree, "annotations": kept}, parts.objects.file),
        scene=At({**scene, "objects": rows}, parts.scene.file),
    )


def _people(folder: Path, home: Path, size: tuple[int, int]) -> At | None:
    """The first person of every frame, in frames numbered from 0."""
    paths = sorted(
        p for p in folder.rglob(f"[0-9]*/{DETECTIONS}")
        if p.parent != home and p.parent.name.isdecimal()
    )  # fmt: skip
    paths = [path for path in paths if path.parent.parent == paths[0].parent.parent]
    if not paths:
        return None
    start = 1 if int(paths[0].parent.name) == 1 else 0
    first: dict[int, Instance] = {}
    for path in paths:
        seen = list_instances(read_json(path), {}, size).fitted(size)
        frame = int(path.parent.name) - start
        one = next((item for item in seen.items if item.is_person), None)
        if one is not None:
            first[frame] = dataclasses.replace(one, frame=frame, track=0)
    return Instances(tuple(first.values()), size, paths[0].parent.parent.name).people_tree()


def _authors(folder: Path, parts: Parts, R: Matrix | None, notes: list[str]) -> dict[str, Scene]:
    """Their result as a scene, to compare with: its meshes are ours, moved."""
    paths = sorted(folder.glob("**/f[0-9][0-9][0-9]_world.obj"), key=lambda p: (p.parent, p.name))
    assert parts.scene is not None
    assert parts.camera is not None
    rows = parts.scene.get("objects").items()
    last = [p for p in paths if p.parent == paths[-1].parent] if paths else []
    if R is None or len(last) != len(rows):
        if last:
            notes.append(f"their result has {len(last)} objects, {len(rows)} are known: left out")
        return {}
    placed: list[dict[str, Any]] = []
    meshes = {row.value["mesh"]: parts.load_mesh(row.get("mesh")) for row in rows}
    for row, path in zip(rows, last, strict=True):
        verts = meshes[row.value["mesh"]][0].verts.double().numpy()
        theirs = _used(path, len(verts)) @ FLIP
        if len(verts) < LEAST:
            raise InputError(f"{path.name}: has {len(verts)} vertices, expected {LEAST} or more")
        corners = np.concatenate([verts, np.ones((len(verts), 1))], axis=1)
        matrix = np.eye(4)  # the affine transform between two meshes of one topology
        matrix[:3] = np.linalg.lstsq(corners, theirs, rcond=None)[0].T
        place = posed(matrix, verts.min(0), verts.max(0))
        placed.append({**row.value, **place.fields, "annotation": None})
    lens = camera_of(At({**parts.camera.value, "R_cam_world": R.tolist()}, "refine_results"))
    tree = scene_tree(placed, "refine_results")
    scene, _ = scene_of(tree, partial(load_from, meshes), lens, notes.append)
    return {"authors": scene}


def _used(path: Path, count: int) -> Matrix:
    """The vertices of an object of theirs that triangles use, `count` of them."""
    verts, faces = read_shape(path)
    a, b, c = faces.T
    kept = np.unique(faces[(a != b) & (b != c) & (c != a)])
    if len(kept) != count or kept.max(initial=-1) >= len(verts):
        raise InputError(f"{path.name}: has {len(kept)} vertices, expected the {count} of its mesh")
    return verts[kept]


def _truth(folder: Path, camera: dict[str, Any], hints: Hints) -> dict[str, Scene]:
    """The boxes and the scan in them; gravity is what the boxes share."""
    path = hints.boxes or found(folder, "bbox3d.json")
    if path is None:
        return {}
    boxes = read_bbox3d(path, hints.names)
    guess = At(camera, "camera").maybe("R_cam_world")
    first = FLIP if guess is None else np.array(guess.value)
    R = level_of(vertical_of(boxes, first[:, 1]))
    world = affine(R.T)
    lens = {**camera, "R_cam_world": R.tolist()}
    scans = [found(folder, n) for n in ("scan_cam_cooridnates.ply", "scan_cam_coordinates.ply")]
    file = next((p for p in scans if p is not None), None)
    if file is None:
        return {"truth": boxes_scene(boxes, world, lens, None)}
    scan = read_scan(file)
    ground = floor_in(scan, world)
    inside = boxes_scene(boxes, world, lens, ground, scan)
    return {"truth": boxes_scene(boxes, world, lens, ground), "truth_scan": inside}


SCENE = Path("models") / "scene.ply"
LENS = {"w": 1920, "h": 1080, "fl_x": 1060.5317, "fl_y": 1060.3856, "cx": 951.2999, "cy": 536.7704}
"""Of PROX's colour camera, which its code takes for every picture."""


def holisticmesh_parts(folder: Path, hints: Hints) -> Parts:
    """What HolisticMesh made of one picture."""
    if not (folder / SCENE).is_file():
        why = "that main.py writes where the scene is given to render_image"
        raise InputError(f"{SCENE}: there is no such file in {folder}, expected the mesh {why}")
    named = "the one of its --data_path, whose order names the objects"
    rows = read_json(existing(folder / "detections.json", named)).items()
    names = [row.get("class").choice(CLASSES) for row in rows]
    given = {} if hints.camera is None else dict(hints.camera.value)
    tilt = None if hints.camera is None else hints.camera.maybe("R_cam_world")
    R = np.array(LEVEL) if tilt is None else rotation(tilt)
    camera: dict[str, Any] = {**LENS, **given, "R_cam_world": R.tolist()}
    at = At(str(SCENE), str(SCENE))
    verts, faces = load_arrays(at, folder / SCENE)
    size, rest = divmod(len(verts), max(1, len(rows)))
    if not rows or rest:
        at.refuse(f"as many vertices for each of {len(rows)} detections", f"{len(verts)} vertices")
    owner = faces // size
    if (owner != owner[:, :1]).any():
        at.refuse("faces of one object each", "faces that join two objects")
    found, annotations = Pieces(), list[dict[str, Any]]()
    for i, (row, category) in enumerate(zip(rows, names, strict=True)):
        if category not in FURNITURE:
            continue
        own = verts[i * size : (i + 1) * size]
        key = free_id(category, f"{category}_{i}", found.meshes)
        fields, mesh = upright(mesh_of(own, faces[owner[:, 0] == i] - i * size, at), R)
        write_mesh(mesh, file := hints.work / f"{key}.glb")
        found.add(category, key, {**fields, "annotation": i}, mesh, str(file))
        box = row.get("bbox")  # of the mirrored picture, with a score where it has five numbers
        scored = isinstance(box.value, list) and len(box.value) == 5
        left, top, right, bottom = box.vector(5 if scored else 4)[:4]
        kept = [float(camera["w"]) - right, top, right - left, bottom - top]
        annotations.append({"id": i, "image_id": 0, "category_id": category, "bbox": kept})
    how = "level, as --camera has no R_cam_world" if tilt is None else "as given"
    return dataclasses.replace(
        found.parts(folder.resolve().name, str(SCENE)),
        camera=At(camera, "camera.json"),
        objects=At(annotations_tree(annotations, {}, CLASSES), "detections.json"),
        notes=(f"the camera is {how}; the fronts of the objects are guesses",),
    )


TURNS = 90  # angles that are tried for the box around a footprint, over a quarter turn


def upright(mesh: Mesh, R_cam_world: Matrix) -> tuple[dict[str, Any], Mesh]:
    """Fields in scene.json of a mesh in camera axes, and it about the middle of its bottom.

    Its box is the upright one with the smallest footprint; its front is the side that faces the
    camera, as that of furniture along walls.
    """
    verts = mesh.verts.double().numpy() @ R_cam_world
    flat, angles = verts[:, [0, 2]], np.arange(TURNS) * (math.pi / 2 / TURNS)
    x = flat @ np.stack([np.cos(angles), -np.sin(angles)])
    z = flat @ np.stack([np.sin(angles), np.cos(angles)])
    areas = np.ptp(x, axis=0) * np.ptp(z, axis=0)
    quarters = angles[int(areas.argmin())] + np.arange(4) * math.pi / 2
    middle = (flat.max(0) + flat.min(0)) / 2
    away = np.sin(quarters) * middle[0] + np.cos(quarters) * middle[1]
    yaw = math.remainder(float(quarters[int(away.argmin())]), 2 * math.pi)
    local = verts @ about_y(yaw)  # rows: R_y(-yaw) v
    low, high = local.min(0), local.max(0)
    origin = np.array([(low[0] + high[0]) / 2, low[1], (low[2] + high[2]) / 2])
    fields = {"translation": (about_y(yaw) @ origin).tolist(), "yaw": yaw, "scale": [1.0] * 3}
    return fields, Mesh(torch.from_numpy(local - origin).float(), mesh.faces)
