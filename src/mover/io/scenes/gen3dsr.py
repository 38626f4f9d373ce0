"""Gen3DSR: reconstruction/<i>_<label>.glb, all in one world, and cam_params.json {K, c2w, W, H}.

The world is the camera's own (x right, y down, z forward) unless a true pose was given, which c2w
holds. Meshes have no axes of their own: an object gets an upright box around it, and its front is
guessed (placing.py). Gravity is not known either: the camera is level unless --camera says more.
"""

import dataclasses
from functools import partial
from pathlib import Path

import numpy as np

from mover.core.errors import InputError
from mover.geometry.rotations import affine
from mover.io.capture.parts import Hints, Parts, image_parts
from mover.io.files.cameras import camera_of_tree
from mover.io.files.fields import At, get, read_json
from mover.io.files.schema import rigid
from mover.io.scenes.placing import LEVEL, Pieces, category_of_name, tilt_of, without_axes

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
