"""Whatever a file holds: it is read, or refused with a message."""

import json
import shutil
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tiny_capture as tiny
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from mover.core.errors import InputError
from mover.io.capture.folder import read_capture

NAN = float("nan")


def paths_of(tree: Any, way: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """The place of every value in nested lists and objects."""
    found = [way] if way else []
    keys = tree if isinstance(tree, dict) else range(len(tree)) if isinstance(tree, list) else ()
    for key in keys:
        found += paths_of(tree[key], (*way, key))
    return found


TREES = {
    "camera.json": tiny.camera(height=1.4), "scene.json": {**tiny.scene(), "camera": tiny.camera()},
    "objects.json": tiny.objects(), "people.json": tiny.people(),
    "hypotheses.json": tiny.hypotheses(),
}  # fmt: skip
PLACES = [(file, way) for file, tree in TREES.items() for way in paths_of(tree)]
JUNK = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5)
    | st.sampled_from([..., 0, -1, 1 << 70, 1e308, "ground", "..", "meshes", 64, 48, NAN]),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=3), inner),
    max_leaves=5,
)  # fmt: skip
BAD_ARRAYS = st.sampled_from(
    [
        *(np.zeros(shape) for shape in ((), 3, (3, 4, 3), (0, 3), (3, 63), (3, 10), (3, 3))),
        *(np.full(shape, NAN) for shape in ((), 3, (3, 4, 3))),
        *(np.array([value] * 3) for value in (1 << 62, -(1 << 63), (1 << 64) - 1, 1e300, "a")),
        *(np.array(word) for word in ("x", "world", "makehuman", "smplx", "")),
        np.ones((3, 4), dtype=bool), np.zeros((5, 3), dtype=np.uint64), np.array([["a", "b"]]),
        np.zeros((3, 4, 3), dtype=np.float16), np.zeros((2, 3), dtype="M8[s]"),
    ]
)  # fmt: skip
NAMES = (
    "frame", "person", "space", "vertices", "faces", "joints", "joint_names", "fps", "model",
    "gender", "betas", "body_pose", "global_orient", "transl", "left_hand_pose", "expression",
)  # fmt: skip
FILES = ("bodies.npz", "contacts.npz", "meshes/lamp.glb", "meshes/step.obj", "room.png")
SLOW = (HealthCheck.too_slow, HealthCheck.function_scoped_fixture)
FUZZ = settings(max_examples=300, deadline=None, suppress_health_check=SLOW)


@pytest.fixture(scope="module")
def whole() -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as place:
        folder = tiny.write_capture(Path(place) / "tiny")
        (folder / "hypotheses.json").write_text(json.dumps(tiny.hypotheses()))
        yield folder


def read_or_refuse(folder: Path) -> None:
    try:
        read_capture(folder)
    except InputError as error:
        assert "expected" in str(error)  # noqa: PT017


@pytest.mark.slow
@FUZZ
@given(place=st.sampled_from(PLACES), value=JUNK)
def test_no_junk_in_any_json_field_raises_anything_else(
    whole: Path, place: tuple[str, tuple[Any, ...]], value: Any
) -> None:
    file, (*way, last) = place
    tree = json.loads(json.dumps(TREES[file]))
    inner = tree
    for key in way:
        inner = inner[key]
    if value is ...:
        del inner[last]
    else:
        inner[last] = value
    copy = whole.parent / "copy"
    shutil.copytree(whole, copy, dirs_exist_ok=True)
    (copy / file).write_text(json.dumps(tree, default=str))
    read_or_refuse(copy)


@pytest.mark.slow
@FUZZ
@given(changes=st.dictionaries(st.sampled_from(NAMES), BAD_ARRAYS | st.none(), max_size=7))
def test_no_junk_in_any_array_raises_anything_else(whole: Path, changes: dict[str, Any]) -> None:
    arrays = {**tiny.bodies(), **changes}
    copy = whole.parent / "copy"
    shutil.copytree(whole, copy, dirs_exist_ok=True)
    np.savez(copy / "bodies.npz", **{k: v for k, v in arrays.items() if v is not None})
    read_or_refuse(copy)


@pytest.mark.slow
@FUZZ
@given(
    name=st.sampled_from(FILES),
    where=st.floats(0, 1), junk=st.binary(min_size=1, max_size=8), cut=st.booleans(),
)  # fmt: skip
def test_no_flipped_bytes_raise_anything_else(
    whole: Path, name: str, where: float, junk: bytes, cut: bool
) -> None:
    copy = whole.parent / "copy"
    shutil.copytree(whole, copy, dirs_exist_ok=True)
    content = (whole / name).read_bytes()
    start = int(where * len(content))
    tail = b"" if cut else content[start + len(junk) :]
    (copy / name).write_bytes(content[:start] + junk + tail)
    read_or_refuse(copy)
