"""HolisticMesh (Weng and Yeung, 2021), the paper's baseline: what it made of one picture.

It leaves models/scene.ply, all furniture of one picture, where `verts, faces, lo_bdb3D_cam_coord`
are given to its `render_image`, as a commented line of its main.py does; and detections.json. The
objects follow one another in the order of the detections, each with as many vertices (a sphere of
2562), in the axes of the mirrored picture's camera (x right, y down, z forward), as PROX's pictures
are stored mirrored and its bodies are fitted to the flipped ones. The meshes have no axes of their
own: each gets an upright box, and its front is guessed. The camera is level unless --camera says
more.
"""

import dataclasses
import math
from pathlib import Path
from typing import Any

import numpy as np
import torch

from mover.core.errors import InputError
from mover.core.types import Mesh
from mover.io.capture.parts import Hints, Parts
from mover.io.files.fields import At, existing, read_json
from mover.io.files.meshes import load_arrays, mesh_of, write_mesh
from mover.io.files.schema import rotation
from mover.io.masks.coco import annotations_tree
from mover.io.scenes.networks import CLASSES, FURNITURE
from mover.io.scenes.placing import LEVEL, Matrix, Pieces, about_y, free_id

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
