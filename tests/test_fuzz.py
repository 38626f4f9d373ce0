"""Whatever is damaged: a sentence or a result, and never a traceback, a hang or silent nonsense.

All mutations are drawn from a seed. A share of them runs in `make test`, all in `make test-all`;
`python -m pytest tests/test_fuzz.py -m "" -s` prints the counts.
"""

import functools
import itertools
import json
import logging
import math
import os
import pickle
import shutil
import signal
import struct
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import is_dataclass, replace
from pathlib import Path
from typing import Any

import make_people as made
import numpy as np
import pytest
import tiny_capture as tiny
import torch
from test_readers_people import CAMERA, Toy
from test_run import PLANE, Twice, doubled, files
from test_safe_pickle import Calls

from mover.bodies import BODY_MODELS
from mover.core.errors import InputError
from mover.core.run import Run
from mover.core.settings import Range, settings_of
from mover.core.types import Capture
from mover.io.capture.folder import read_capture
from mover.io.people.bodies import bodies_from
from mover.io.people.found import Known
from mover.io.people.keypoints import keypoints_from

FEW, ALL = 64, 1000  # mutations of a capture
LONGEST = 20  # [s], of one read
JUNK = (
    0, -1, 1, 1e-8, -1e-8, 1e8, -80, 500, 1000, 1e5, 10**30, math.nan, math.inf, -math.inf, True,
    None, "", "x", "..", "ground", "\ud800", [], {}, [[]], [1, 2], {"a": 1}, ["x"] * 3,
    [math.nan] * 3,
)  # fmt: skip
BAD_ARRAYS = (
    *(np.zeros(shape) for shape in ((), 3, (3, 4, 3), (0, 3), (3, 63), (3, 10), (3, 3))),
    *(np.full(shape, np.nan) for shape in ((), 3, (3, 4, 3))),
    *(np.array([value] * 3) for value in (1 << 62, -(1 << 63), (1 << 64) - 1, 1e300, "a")),
    *(np.array(word) for word in ("x", "world", "makehuman", "smplx", "")),
    np.ones((3, 4), dtype=bool), np.zeros((5, 3), dtype=np.uint64), np.array([["a", "b"]]),
    np.zeros((3, 4, 3), dtype=np.float16), np.zeros((2, 3), dtype="M8[s]"),
)  # fmt: skip
POSE = ("model", "gender", "betas", "body_pose", "global_orient", "transl", "left_hand_pose",
        "expression")  # fmt: skip
FACTORS = (0.001, 0.01, 0.3048, 3.28, 39.37, 100.0, 1000.0, 1e8, -1.0)


@contextmanager
def limited(seconds: int) -> Iterator[None]:
    """A hang is a failure."""

    def late(*_: object) -> None:
        raise TimeoutError(f"not through after {seconds} s")

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(seconds)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


def in_json(folder: Path, rng: np.random.Generator) -> str:
    """One value of one file is another, is a multiple of itself, or is not there."""
    path = folder / str(rng.choice(["camera", "scene", "objects", "people", "hypotheses"]))
    path = path.with_suffix(".json")
    tree = json.loads(path.read_text())
    ways = tiny.ways_of(tree)
    way = ways[rng.integers(len(ways))]
    old, kind = functools.reduce(lambda node, key: node[key], way, tree), rng.integers(4)
    if kind == 0 and isinstance(old, float | int) and not isinstance(old, bool):
        new: Any = old * FACTORS[rng.integers(len(FACTORS))]
    else:
        new = ... if kind == 1 else JUNK[rng.integers(len(JUNK))]
    tiny.put(tree, way, new)
    path.write_text(json.dumps(tree))
    return f"{path.name} {way}, {old!r:.30}"


def in_arrays(folder: Path, rng: np.random.Generator) -> str:
    """One array of an archive has another unit, shape, kind or one bad number, or is not there."""
    path = folder / str(rng.choice(["bodies.npz", "contacts.npz"]))
    arrays = dict(np.load(path))
    name = str(rng.choice(list(arrays)))
    array = arrays[name]
    bad, far = array.copy(), 1e8 if array.dtype.kind == "f" else 7
    if array.dtype.kind in "fiu" and array.size:
        bad.flat[rng.integers(array.size)] = rng.choice([0, 99, far])
    options: list[Callable[[], Any]] = [
        lambda: bad, lambda: array[:-1] if array.ndim else np.zeros(3), lambda: array.ravel(),
        lambda: np.array(["x"]), lambda: array.astype(str), lambda: np.zeros(0),
    ]  # fmt: skip
    if array.dtype.kind == "f":
        options += [lambda f=f: array * np.float32(f) for f in FACTORS] + [lambda: array * math.nan]
    which = int(rng.integers(len(options) + 1))
    tiny.put(arrays, [name], ... if which == len(options) else options[which]())
    np.savez(path, **arrays)
    return f"{path.name} {name} {which}"


def in_parameters(folder: Path, rng: np.random.Generator) -> str:
    """Up to seven arrays of the bodies, among them parameters, are any arrays."""
    path = folder / "bodies.npz"
    arrays = dict(np.load(path))
    names = rng.choice([*arrays, *POSE], int(rng.integers(1, 8)), replace=False)
    some = {str(name): BAD_ARRAYS[rng.integers(len(BAD_ARRAYS))] for name in names}
    np.savez(path, **(arrays | some))
    return f"{path.name} {some}"


def in_bytes(folder: Path, rng: np.random.Generator) -> str:
    """A file is cut, or some of its bytes are others."""
    found = sorted(p for p in folder.rglob("*") if p.is_file())
    path = found[rng.integers(len(found))]
    content = path.read_bytes()
    where = int(rng.integers(len(content)))
    tail = b"" if rng.integers(2) else rng.bytes(int(rng.integers(1, 9))) + content[where + 4 :]
    path.write_bytes(content[:where] + tail)
    return f"{path.name} at {where}"


def in_files(folder: Path, rng: np.random.Generator) -> str:
    """A file is gone, a folder, a link to nothing or to itself, or another file."""
    found = sorted(p for p in folder.rglob("*") if p.is_file())
    path, other = found[rng.integers(len(found))], found[rng.integers(len(found))]
    content = other.read_bytes()
    path.unlink()
    kind = int(rng.integers(5))
    if kind == 1:
        path.mkdir()
    elif kind == 2:
        path.symlink_to(folder / "gone")
    elif kind == 3:
        path.symlink_to(path)
    elif kind == 4:
        path.write_bytes(content)
    return f"{path.name} {kind} {other.name}"


KINDS = (in_json, in_json, in_json, in_arrays, in_parameters, in_arrays, in_bytes, in_files)


def check_sane(capture: Capture) -> None:
    """What is taken can be true, whatever the readers think of it."""
    camera = capture.scene.camera
    assert 0.05 <= float(camera.K[0, 0]) / camera.width <= 100
    assert camera.width * camera.height <= 1 << 28
    for piece in (*capture.scene.objects, *capture.hypotheses):
        verts = piece.mesh.verts[piece.mesh.faces.unique()] * piece.scale
        assert 0.01 <= float((verts.amax(0) - verts.amin(0)).max()) <= 30
        assert float(piece.t_world_object.norm()) <= 100
        assert abs(float(piece.yaw)) <= 1000
    bodies = capture.bodies
    if bodies is not None:
        assert float(bodies.verts.abs().max()) <= 100
        assert float(bodies.verts[..., 2].median()) > 0
        extent = (bodies.verts.amax(1) - bodies.verts.amin(1)).norm(dim=-1).median()
        assert 0.05 <= float(extent) <= 10
        assert bodies.fps is None or 1e-3 <= bodies.fps <= 1e4
    for detection in capture.detections:
        assert bool(detection.box.isfinite().all())


@contextmanager
def or_refused(counts: Counter[str], what: str, most: int = LONGEST) -> Iterator[None]:
    """An `InputError` is a sentence and counted, any other error fails; all in some seconds."""
    try:
        with limited(most):
            yield
    except InputError as error:
        text = str(error)
        assert "\n" not in text, text
        assert 20 < len(text) < 700, text
        counts["refused"] += 1
    except Exception as error:
        raise AssertionError(f"{what}: {error!r}") from error


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = tiny.write_capture(tmp_path_factory.mktemp("fuzz") / "tiny")
    (folder / "hypotheses.json").write_text(json.dumps(tiny.hypotheses()))
    return folder


@pytest.mark.parametrize("numbers", [
    range(FEW), pytest.param(range(FEW, FEW + ALL), marks=pytest.mark.slow),
])  # fmt: skip
def test_mutated_captures_are_taken_warned_of_or_refused(whole, numbers):
    counts: Counter[str] = Counter()
    copy = whole.parent / "copy"
    for number in numbers:
        shutil.rmtree(copy, ignore_errors=True)
        shutil.copytree(whole, copy)
        rng = np.random.default_rng(number)
        what = KINDS[number % len(KINDS)](copy, rng)
        with or_refused(counts, f"mutation {number} ({what})"):
            capture = read_capture(copy)
            check_sane(capture)
            counts["warned" if capture.warnings else "taken"] += 1
    assert sum(counts.values()) == len(numbers)


# Pickles: `test_safe_pickle.py` has those that pickle refuses, here each reader is handed some.


def bad_pickles(mark: Path) -> dict[str, bytes]:
    """Pickles that call, hold themselves or are broken, by their names."""
    good = pickle.dumps({"betas": np.zeros((2, 10)), "frame": [1, 2], "x": [1.0, "a", None]})
    calls = ((os.system, (f"touch {mark}",)), (open, (str(mark), "w")), (os.mkdir, (str(mark),)))
    found = {
        f"calls {call.__name__}, protocol {p}": pickle.dumps(Calls(call, *arguments), protocol=p)
        for p in (0, 2, 4)
        for call, arguments in calls
    }
    ring: dict[str, Any] = {}
    ring["betas"] = ring
    found |= {
        "a mapping that holds itself": pickle.dumps(ring),
        "deep lists": b"\x80\x02" + b"](" * 5000 + b"e" * 5000 + b".",
        "huge bytes": b"\x80\x04\x8e" + struct.pack("<Q", 1 << 60) + b".",
        "a far memo": b"\x80\x02j\xff\xff\xff\x7f.", "nothing": b"", "text": b"hello\n",
        "an archive": b"PK\x03\x04" + b"\0" * 60, "gzip of nothing": b"\x1f\x8b\x08" + b"\0" * 7,
        "a huge array": pickle.dumps(np.zeros(3)).replace(b"K\x03\x85", b"J\xff\xff\xff\x7f\x85"),
    }  # fmt: skip
    for number in range(12):
        rng = np.random.default_rng(number)
        where = int(rng.integers(2, len(good)))
        tail = b"" if number % 2 else rng.bytes(3) + good[where + 3 :]
        found[f"broken {number}"] = good[:where] + tail
    return found


def readers(home: Path) -> Iterator[tuple[str, Path, Callable[[], object]]]:
    """Each reader of people and keypoints, its source, and how it is read."""
    for tool, make in (made.BODIES | made.KEYPOINTS).items():
        folder = home / tool.replace(":", "_")
        folder.mkdir()
        source, known = make(folder), Known(camera=CAMERA)
        read = keypoints_from if tool in made.KEYPOINTS else bodies_from
        yield tool, folder, lambda r=read, t=tool, s=source, k=known: r(t.split(":")[0], s, k)


@pytest.mark.filterwarnings("ignore:invalid value encountered:RuntimeWarning")  # the toy's sums
@pytest.mark.parametrize(("every", "refused", "read"), [
    (5, 51, 51), pytest.param(1, 51, 25 * 15 + 1, marks=pytest.mark.slow),
])  # fmt: skip
def test_bad_pickles_are_refused_by_every_reader(tmp_path, monkeypatch, every, refused, read):
    for name in made.COUNTS:
        monkeypatch.setitem(BODY_MODELS, name, lambda _, name=name: Toy(name))
    counts: Counter[str] = Counter()
    mark = tmp_path / "mark"
    bad = bad_pickles(mark)
    for number, (tool, folder, reader) in enumerate(readers(tmp_path)):
        path = sorted(p for p in folder.rglob("*") if p.is_file())[0]
        for name, content in list(bad.items())[number % every :: every]:
            path.write_bytes(content)
            with or_refused(counts, f"{tool}: {name}"):
                reader()
                counts["taken"] += 1
            assert not mark.exists(), (tool, name)
    assert counts["refused"] >= refused
    assert sum(counts.values()) >= read


@pytest.mark.parametrize("seed", range(24))
def test_a_stage_that_was_damaged_anywhere_is_said_and_computed_again(tmp_path, caplog, seed):
    rng = np.random.default_rng(seed)
    wanted = Run(tmp_path).stage(doubled, PLANE, Twice())
    path = files(tmp_path)[seed % 2]
    content = bytearray(path.read_bytes())
    where, kind = int(rng.integers(len(content))), seed // 2 % 3
    if kind == 0:
        del content[where:]
    elif kind == 1:
        content[where] ^= 1 << int(rng.integers(8))
    else:
        content[where:where] = rng.bytes(5)
    path.write_bytes(bytes(content))
    with caplog.at_level(logging.WARNING):
        run = Run(tmp_path)
        found = run.stage(doubled, PLANE, Twice())
    assert torch.equal(found.points, wanted.points)
    assert found.ground == wanted.ground
    assert run.stages[0].kept or "computed again" in caplog.text  # unused bytes of an archive


# Settings: every number at -1, 0 and the ends of its range, where these are taken.


def ways_of(settings: Any, way: tuple[str, ...] = ()) -> Iterator[tuple[tuple[str, ...], Range]]:
    """The settings with a range of a tree, below the dataclasses that are in it now."""
    for name, hint in settings_of(type(settings)).items():
        value = getattr(settings, name)
        ranges = [one for one in getattr(hint, "__metadata__", ()) if isinstance(one, Range)]
        if is_dataclass(value):
            yield from ways_of(value, (*way, name))
        elif ranges:
            yield (*way, name), ranges[0]


def with_value(settings: Any, way: tuple[str, ...], value: float) -> Any:
    name, *rest = way
    inner = with_value(getattr(settings, name), tuple(rest), value) if rest else value
    return replace(settings, **{name: inner})


def part_of(capture: Capture, objects: int, rows: int) -> Capture:
    """The first objects, and some of the frames."""
    bodies, pieces = capture.bodies, capture.scene.objects[:objects]
    keep = torch.linspace(0, len(bodies.frame) - 1, rows).long()
    some = {name: getattr(bodies, name)[keep] for name in ("verts", "joints", "frame", "person")}
    few = replace(bodies, pose=None, **some)
    return replace(capture, scene=replace(capture.scene, objects=pieces), bodies=few)


@pytest.mark.long
@pytest.mark.slow
@pytest.mark.parametrize("part", range(4))
def test_every_setting_at_its_ends_runs_to_the_end(tmp_path, part, tiny):
    from test_pipeline import light

    from mover.pipeline.reconstruct import reconstruct
    from mover_bench.rooms.config import NoiseConfig
    from mover_bench.rooms.noise import add_noise

    capture = part_of(add_noise(tiny, NoiseConfig(), 1), 2, 12)
    config, counts, tried = light("robust", steps=2), Counter[str](), 0
    for way, span in itertools.islice(ways_of(config), part, None, 4):
        for value in {span.kind(v) for v in (-1, 0, span.low) if span.holds(span.kind(v))}:
            tried += 1
            with or_refused(counts, f"{'.'.join(way)} {value}", 60):
                room = reconstruct(capture, with_value(config, way, value), Run(tmp_path))
                assert all(bool(one.t_world_object.isfinite().all()) for one in room.scene.objects)
                counts["ran"] += 1
    assert counts == {"ran": tried}  # none is refused
    assert tried >= 25
