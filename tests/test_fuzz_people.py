"""Whatever is wrong with one field of a tool's file, the reader reads it or refuses it."""

import json
import pickle
from pathlib import Path
from typing import Any

import make_people as made
import numpy as np
import pytest
import torch
import trimesh
from test_readers_people import CAMERA, Toy

from mover.bodies import BODY_MODELS
from mover.core.errors import InputError
from mover.io.people.bodies import bodies_from
from mover.io.people.found import Known
from mover.io.people.keypoints import keypoints_from

joblib = pytest.importorskip("joblib", reason="the fixtures are written by joblib")
CHANGES = 10


def load(path: Path) -> Any:
    match path.suffix:
        case ".json":
            return json.loads(path.read_text())
        case ".npz":
            with np.load(path, allow_pickle=True) as arrays:
                return dict(arrays)
        case ".npy":
            return np.load(path, allow_pickle=True).item()
        case ".pt":
            return torch.load(path, weights_only=True)
        case _:
            return joblib.load(path)


def dump(value: Any, path: Path) -> None:
    match path.suffix:
        case ".json":
            path.write_text(json.dumps(value, default=lambda x: np.asarray(x).astype(str).tolist()))
        case ".npz":
            np.savez(path, **value)
        case ".npy":
            np.save(path, value, allow_pickle=True)
        case ".pt":
            torch.save(value, path)
        case _:
            path.write_bytes(pickle.dumps(value))


def places(value: Any, start: tuple = ()) -> list[tuple]:
    keys = value.keys() if isinstance(value, dict) else range(len(value))
    found = []
    for key in keys:
        found.append((*start, key))
        if isinstance(value[key], dict | list) and len(value[key]) < 100:
            found += places(value[key], (*start, key))
    return found


def changed(old: Any, rng: np.random.Generator) -> Any:
    options: list[Any] = [None, "abc", 0, -5, np.zeros(0), [1, 2], {"a": 1}, 1e300, b"x"]
    numeric = isinstance(old, torch.Tensor) or (
        isinstance(old, np.ndarray) and old.dtype.kind in "fiub"
    )
    array = np.asarray(old).astype(float) if numeric else None
    if array is not None and array.size > 1:
        broken = array.copy()
        broken.flat[0] = np.inf
        options += [array[:-1], array.ravel(), array.T, array * 1e30, array * np.nan, broken]
    new = options[rng.integers(len(options))]
    is_array = isinstance(old, torch.Tensor) and isinstance(new, np.ndarray)
    return torch.from_numpy(new.copy()) if is_array else new


@pytest.mark.filterwarnings("ignore:invalid value encountered:RuntimeWarning")  # the toy's sums
@pytest.mark.parametrize("tool", [*made.BODIES, *made.KEYPOINTS])
def test_a_file_with_one_wrong_field_is_read_or_refused(tool, tmp_path, monkeypatch):
    for name in made.COUNTS:
        monkeypatch.setitem(BODY_MODELS, name, lambda _, name=name: Toy(name))
    folder = tmp_path / "source"
    folder.mkdir()
    source = (made.BODIES | made.KEYPOINTS)[tool](folder)
    faces = tmp_path / "faces.ply"
    verts, triangles = made.person("smplx")["verts"][0], made.flesh("smplx")[2]
    trimesh.Trimesh(verts, triangles, process=False).export(faces)
    known = Known(camera=CAMERA, faces=faces if tool == "sam3dbody" else None)
    rng = np.random.default_rng(len(tool))
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    for _ in range(CHANGES):
        path = files[rng.integers(len(files))]
        kept = path.read_bytes()
        tree = load(path)
        where = places(tree)
        *start, last = where[rng.integers(len(where))]
        node = tree
        for key in start:
            node = node[key]
        node[last] = changed(node[last], rng)
        dump(tree, path)
        try:
            if tool in made.KEYPOINTS:
                assert keypoints_from(tool.split(":")[0], source, known).points.isfinite().all()
            else:
                bodies = bodies_from(tool.split(":")[0], source, known).bodies
                assert bodies.verts.isfinite().all()
        except InputError as error:
            assert 20 < len(str(error)) < 600  # noqa: PT017
        path.write_bytes(kept)
