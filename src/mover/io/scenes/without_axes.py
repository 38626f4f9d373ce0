"""Tools whose meshes have no axes of their own: Gen3DSR and HolisticMesh.

An object gets an upright box around it, and its front is guessed (placing.py). Gravity is not known
either: the camera is level unless --camera says more.

Gen3DSR leaves reconstruction/<i>_<label>.glb, all in one world, and cam_params.json {K, c2w, W, H}.
The world is the camera's own (x right, y down, z forward) unless a true pose was given, which c2w
holds.

HolisticMesh leaves models/scene.ply, all furniture of one picture, where `verts, faces,
lo_bdb3D_cam_coord` are given to its `render_image`, as a commented line of its main.py does; and
detections.json. The pieces follow one another in the order of the detections, each with as many
vertices (a sphere of 2562), in the axes of the mirrored picture's camera (x right, y down,
z forward), as PROX's pictures are stored mirrored and its bodies are fitted to the flipped ones.
"""

import dataclasses
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from mover.core.errors import InputError
from mover.geometry.rotations import affine
from mover.io.capture.parts import Hints, Parts, image_parts
from mover.io.files.cameras import camera_of_tree
from mover.io.files.fields import At, choice, get, items, read_json, refuse, vector
from mover.io.files.meshes import load_arrays, mesh_of, write_mesh
from mover.io.files.schema import rigid
from mover.io.masks.coco import annotations_tree
from mover.io.scenes.placing import LEVEL, Pieces, category_of_name, tilt_of, without_axes
from mover.io.scenes.total3d import CLASSES, FURNITURE

WHOLE = ("full_scene", "background", "depth_scene")


def gen3dsr_parts(folder: Path, hints: Hints) -> Parts:
    """What Gen3DSR made of one picture."""
    lens = read_json(folder / "cam_params.json")
    given = camera_of_tree(lens, None)
    tilt = tilt_of(hints)
    R = np.array(LEVEL) if tilt is None else tilt
    camera = At({**given.value, "R_cam_world": R.tolist()}, given.file)
    world = np.asarray(affine(R.T) @ np.linalg.inv(rigid(get(lens, "c2w"))), dtype=np.float64)
    paths = [p for p in (folder / "reconstruction").glob("*.glb") if p.stem not in WHOLE]
    if not paths:
        raise InputError(f"{folder}: has no reconstruction/<i>_<label>.glb, expected meshes")
    found = Pieces()
    for path in sorted(paths, key=_number):
        category = hints.names.get(path.stem) or category_of_name(path.stem)
        copy = partial(without_axes, path, world, category)
        found.add(category, path.stem, lambda key, copy=copy: copy(hints.work / f"{key}.glb"))
    image = folder / "input.png"
    load, size = image_parts(image) if image.is_file() else (None, None)
    how = "level" if tilt is None else "as given"
    return dataclasses.replace(
        found.parts(folder.resolve().name, folder.name),
        camera=camera,
        load_image=load if size == (given.value["w"], given.value["h"]) else None,
        image_size=size,
        notes=(f"the camera is {how}; the fronts of the objects are guesses",),
    )


def _number(path: Path) -> tuple[int, str]:
    head = path.stem.split("_")[0]
    return (int(head), "") if head.isdecimal() else (1 << 30, path.stem)


# HolisticMesh.


SCENE = Path("models") / "scene.ply"
LENS = {"w": 1920, "h": 1080, "fl_x": 1060.5317, "fl_y": 1060.3856, "cx": 951.2999, "cy": 536.7704}
"""Of PROX's colour camera, which its code takes for every picture."""


def holisticmesh_parts(folder: Path, hints: Hints) -> Parts:
    """What HolisticMesh made of one picture."""
    if not (folder / SCENE).is_file():
        why = "that main.py writes where the scene is given to render_image"
        raise InputError(f"{SCENE}: there is no such file in {folder}, expected the mesh {why}")
    if not (folder / "detections.json").is_file():
        why = "the one of its --data_path, whose order names the pieces"
        raise InputError(f"detections.json: there is no such file in {folder}, expected {why}")
    rows = items(read_json(folder / "detections.json"))
    names = [choice(get(row, "class"), CLASSES) for row in rows]
    given = {} if hints.camera is None else dict(hints.camera.value)
    tilt = tilt_of(hints)
    R = np.array(LEVEL) if tilt is None else tilt
    camera = {**LENS, **given, "R_cam_world": R.tolist()}
    found, world = Pieces(), affine(R.T)
    for index, path in _pieces(folder, len(rows), hints.work).items():
        if names[index] in FURNITURE:
            copy = partial(without_axes, path, world, names[index])
            name = f"{names[index]}_{index}"
            found.add(names[index], name, lambda key, copy=copy: copy(hints.work / f"{key}.glb"))
            found.rows[-1]["annotation"] = index
    how = "level, as --camera has no R_cam_world" if tilt is None else "as given"
    return dataclasses.replace(
        found.parts(folder.resolve().name, str(SCENE)),
        camera=At(camera, "camera.json"),
        objects=At(_annotations(rows, names, float(camera["w"])), "detections.json"),
        notes=(f"the camera is {how}; the fronts of the objects are guesses",),
    )


def _pieces(folder: Path, count: int, work: Path) -> dict[int, Path]:
    """The mesh of each detection, as a file of its own."""
    at = At(str(SCENE), str(SCENE))
    verts, faces = load_arrays(at, folder / SCENE)
    if not count or len(verts) % count:
        refuse(at, f"as many vertices for each of {count} detections", f"{len(verts)} vertices")
    size = len(verts) // count
    owner = faces // size
    if (owner != owner[:, :1]).any():
        refuse(at, "faces of one piece each", "faces that join two pieces")
    found: dict[int, Path] = {}
    for index in range(count):
        own = verts[index * size : (index + 1) * size]
        mesh = mesh_of(own, faces[owner[:, 0] == index] - index * size, at)
        found[index] = work / f"holisticmesh_{index}.glb"
        write_mesh(mesh, found[index])
    return found


def _annotations(rows: list[At], names: list[str], width: float) -> dict[str, Any]:
    """The content of objects.json: boxes of the flipped picture."""
    annotations: list[dict[str, Any]] = []
    for i, (row, name) in enumerate(zip(rows, names, strict=True)):
        if name not in FURNITURE:
            continue
        box = get(row, "bbox")
        long = isinstance(box.value, list) and len(box.value) == 5
        left, top, right, bottom = vector(box, 5 if long else 4)[:4]
        place = [width - right, top, right - left, bottom - top]
        at = {"id": i, "image_id": 0, "category_id": name, "bbox": place}
        annotations.append(at)
    return annotations_tree(annotations, {}, CLASSES)
