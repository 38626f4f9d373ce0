"""Each setting of each command and stage has a range, which is checked before work starts."""

import ast
import dataclasses
import importlib
import json
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

import mover
from mover.app.cli import COMMANDS, run_command
from mover.app.results import read_config
from mover.core.errors import InputError
from mover.core.settings import Range, check_settings, read_settings, settings_of
from mover.pipeline.presets import PRESETS, Config

SOURCES = Path(mover.__file__).parents[1]
ENDS = ("Args", "Config", "Options", "Weights", "Address", "Stage", "Adam", "BatchedBFGS")
BAD = (-1, 0, math.nan, math.inf, -math.inf, 1e30, 10**30, None, "a", True, [], {"a": 1})


def classes() -> Iterator[type[Any]]:
    """Every dataclass of settings in the sources of `mover`, and of its commands in mover_bench."""
    for path in sorted(SOURCES.rglob("*.py")):
        name = ".".join(path.relative_to(SOURCES).with_suffix("").parts).removesuffix(".__init__")
        found = [n for n in ast.parse(path.read_text()).body if isinstance(n, ast.ClassDef)]
        for node in found:
            made_by_users = name.startswith("mover.") or node.name.endswith("Args")
            if made_by_users and node.name.endswith(ENDS):
                kind = getattr(importlib.import_module(name), node.name)
                if dataclasses.is_dataclass(kind):
                    yield kind


def numbers(kind: type[Any]) -> Iterator[tuple[str, Range | None]]:
    """The fields with numbers of a dataclass, and their ranges."""
    for name, hint in settings_of(kind).items():
        ranges = [one for one in walk(hint) if isinstance(one, Range)]
        if ranges or {int, float} & set(walk(hint)):
            yield name, ranges[0] if ranges else None


def walk(hint: Any) -> Iterator[Any]:
    yield hint
    for one in (*getattr(hint, "__args__", ()), *getattr(hint, "__metadata__", ())):
        yield from walk(one)


def test_every_number_that_a_user_may_set_has_a_range():
    found = {f"{kind.__name__}.{name}": span for kind in classes() for name, span in numbers(kind)}
    assert len(found) > 160
    assert {name for name, span in found.items() if span is None} == set()


def paths_of(kind: type[Any], way: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """Every setting of a tree of dataclasses."""
    for name, hint in settings_of(kind).items():
        inner = [
            one for one in walk(hint) if isinstance(one, type) and dataclasses.is_dataclass(one)
        ]
        for one in inner:
            yield from paths_of(one, (*way, name))
        if not inner:
            yield (*way, name)


def tree_with(way: tuple[str, ...], value: Any) -> dict[str, Any]:
    *outer, last = way
    tree = {last: value}
    for name in reversed(outer):
        tree = {name: tree}
    return tree


@pytest.mark.parametrize("way", list(paths_of(Config)), ids=".".join)
def test_a_setting_is_taken_or_refused_with_its_name(way):
    for value in BAD:
        tree = json.loads(json.dumps(tree_with(way, value)))
        try:
            config = read_settings(Config, tree, "config")
        except InputError as error:
            said = str(error)
            assert said.startswith(f"config.{'.'.join(way)}"), said
            assert "expected" in said
        else:
            assert finite(config) or way[-1] == "tilt_prior"


def finite(value: Any) -> bool:
    """Whether all numbers in settings are finite, but for priors that are not there."""
    if dataclasses.is_dataclass(value):
        return all(finite(getattr(value, f.name)) for f in dataclasses.fields(value))
    if isinstance(value, tuple):
        return all(finite(one) for one in value)
    return not isinstance(value, float) or math.isfinite(value)


@pytest.mark.parametrize("name", list(PRESETS))
def test_presets_are_within_their_own_ranges(name):
    check_settings(PRESETS[name], name)


@pytest.mark.parametrize(("command", "flags", "words"), [
    ("run", ("x", "--gather.cells", "0"), "has 0, expected a whole number from 8 to 512"),
    ("run", ("x", "--place.weights.depth", "nan"), "--place.weights.depth: has nan"),
    ("run", ("x", "--outer-iterations", "-3"), "--outer_iterations: has -3"),
    ("render", ("x", "--width", "0"), "--width: has 0, expected a whole number from 16 to"),
    ("view", ("x", "--port", "-1"), "--port: has -1"),
    ("batch", ("x", "--gather.cells", "0"), "--gather.cells: has 0"),
    ("batch", ("x", "--workers", "-1"), "--workers: has -1"),
    ("batch", ("x", "--ray.cpus", "nan"), "--ray.cpus: has nan"),
    ("video", ("x", "--out", "y", "--fov", "0"), "--fov: has 0"),
    ("fit", ("k.npz", "--fps", "0"), "--fps: has 0.0, expected a number from 0.001 to 10,000"),
    ("experiment", ("--workers", "-1"), "--workers: has -1"),
])  # fmt: skip
def test_every_command_checks_its_numbers_before_it_reads_anything(command, flags, words, capsys):
    assert run_command(command, flags) == 2
    assert words in capsys.readouterr().err


@pytest.mark.parametrize(("tree", "words"), [
    ({"config": {"place": 5}}, "config.place: has 5, expected settings"),
    ({"config": {"place": {"yaws": "many"}}}, "place.yaws: has 'many', expected a whole"),
    ({"config": {"place": {"yaw": 1}}}, "config.place.yaw: is no setting, expected one of"),
    ({"config": {"nonsense": 1}}, "config.nonsense: is no setting"),
    ({"config": {"image": {"borders": [1, math.nan]}}}, r"image.borders\[1\]: has"),
    ({"config": {"image": {"borders": 3}}}, "image.borders: has 3, expected a list"),
    ({"config": {"layout": {"method": {"steps": -1}}}}, "config.layout.method.steps: has -1"),
    ({"config": {"layout": {"form": "new"}}}, "config.layout.form: has 'new', expected one of"),
    ({"config": {"seat_heights": 1}}, "config.seat_heights: has 1, expected true or false"),
    ({"config": 3}, "field 'config' has 3"),
    ([], "has \\[\\], expected an object"),
    ({}, "field 'config' has nothing"),
])  # fmt: skip
def test_a_file_of_settings_is_refused_with_the_field(tree, words, tmp_path):
    path = tmp_path / "run.json"
    path.write_text(json.dumps(tree))
    with pytest.raises(InputError, match=words) as caught:
        read_config(path)
    assert "run.json" in str(caught.value)


@pytest.mark.parametrize(
    ("command", "word"),
    [*((name, "--help") for name in COMMANDS), ("run", "--help-all"), ("video", "--help-all")],
)
def test_help_shows_the_range_of_each_number(command, word, capsys):
    with pytest.raises(SystemExit):
        run_command(command, (word,))
    shown = capsys.readouterr().out
    assert " INT " not in shown
    assert " FLOAT " not in shown
