"""Damaged stages are dropped, said, and computed again; what is whole is kept."""

import json
import logging
import os
import shutil
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from jaxtyping import Float, TypeCheckError
from torch import Tensor

from mover.core import records
from mover.core.errors import InputError
from mover.core.files import replacing
from mover.core.observe import Observer, Step, silent
from mover.core.records import record
from mover.core.run import Run


@dataclass(frozen=True)
class Twice:
    factor: float = 2.0


@record
class Plane:
    ground: float
    points: Float[Tensor, "points 3"]
    names: tuple[str, ...]


def doubled(inputs: Plane, config: Twice, observe: Observer = silent) -> Plane:
    """A stage."""
    observe(Step("doubled", 0, 1))
    factor = config.factor
    return Plane(factor * inputs.ground, factor * inputs.points, inputs.names)


PLANE = Plane(-1.25, torch.arange(12.0).view(4, 3), ("a", "b"))


def files(folder: Path) -> tuple[Path, Path]:
    (tree,) = folder.glob("stages/doubled/*.json")
    return tree, tree.with_suffix(".npz")


def cut(path: Path) -> None:
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])


def empty(path: Path) -> None:
    path.write_bytes(b"")


def flip(path: Path) -> None:
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0x10
    path.write_bytes(bytes(data))


def lift(path: Path) -> None:
    """The floor another one, in JSON that is whole."""
    tree = json.loads(path.with_suffix(".json").read_text())
    tree["record"]["ground"] *= 1.5
    path.with_suffix(".json").write_text(json.dumps(tree))


def poison(path: Path) -> None:
    """A NaN, in an archive that is whole."""
    with np.load(path.with_suffix(".npz")) as file:
        arrays = dict(file)
    arrays["points" if "points" in arrays else next(iter(arrays))][0, 0] = np.nan
    np.savez(path.with_suffix(".npz"), **arrays)


def swap(path: Path) -> None:
    """The files of another input under this name."""
    other = path.parents[2] / "other"
    Run(other).stage(doubled, Plane(-9.0, torch.ones(4, 3), ("c",)), Twice())
    for mine, theirs in zip(files(path.parents[2]), files(other), strict=True):
        shutil.copy(theirs, mine)
    shutil.rmtree(other)


def older(path: Path) -> None:
    """A tree as it was written before there were digests."""
    tree = json.loads(path.with_suffix(".json").read_text())
    path.with_suffix(".json").write_text(json.dumps(tree["record"]))


DAMAGES = [cut, empty, flip, lift, poison, swap, older, Path.unlink]


@pytest.mark.parametrize("damage", DAMAGES, ids=lambda d: d.__name__)
@pytest.mark.parametrize("which", [0, 1], ids=["json", "npz"])
def test_a_damaged_stage_is_said_and_computed_anew(tmp_path, caplog, damage, which):
    wanted = Run(tmp_path).stage(doubled, PLANE, Twice())
    damage(files(tmp_path)[which])
    run = Run(tmp_path)
    with caplog.at_level(logging.WARNING):
        found = run.stage(doubled, PLANE, Twice())
    assert found.ground == wanted.ground == -2.5
    assert torch.equal(found.points, wanted.points)
    assert found.names == wanted.names
    assert [stage.kept for stage in run.stages] == [False]
    said = [r.getMessage() for r in caplog.records if "is damaged" in r.getMessage()]
    gone = damage is Path.unlink and which == 0
    assert len(said) == (0 if gone else 1)
    assert all("doubled" in text and "computed again" in text for text in said)
    again = Run(tmp_path)
    assert torch.equal(again.stage(doubled, PLANE, Twice()).points, wanted.points)
    assert [stage.kept for stage in again.stages] == [True]


def test_a_damaged_record_is_one_sentence_with_its_file(tmp_path: Path) -> None:
    records.save(PLANE, tmp_path / "plane")
    cut(tmp_path / "plane.npz")
    with pytest.raises(InputError, match="plane: is damaged"):
        records.load(Plane, tmp_path / "plane")


def test_what_a_killed_write_left_goes_away_with_a_later_one(tmp_path: Path) -> None:
    wanted, young = tmp_path / "a.json", tmp_path / ".a-new.json"
    for name in (".a-x1.json", ".a-x2.json", ".b-x3.json"):
        (tmp_path / name).touch()
        os.utime(tmp_path / name, (0, 0))
    young.touch()
    with replacing(wanted) as part:
        part.write_text("1")
    assert sorted(p.name for p in tmp_path.iterdir()) == [".a-new.json", ".b-x3.json", "a.json"]


@pytest.mark.parametrize("wrong", [
    {"points": torch.zeros(4, 2)},
    {"points": torch.zeros(4, 3, dtype=torch.int64)},
    {"points": None},
    {"ground": "low"},
    {"ground": torch.zeros(())},
    {"names": (1, 2)},
    {"names": ["a", "b"]},
])  # fmt: skip
def test_what_is_wrong_is_refused_however_often_the_like_was_built(wrong: dict[str, Any]) -> None:
    for _ in range(3):
        replace(PLANE, points=torch.zeros(5, 3))
        with pytest.raises(TypeCheckError):
            replace(PLANE, **wrong)


@pytest.mark.parametrize("inference", [False, True])
def test_fingerprint_is_that_of_the_content_whoever_wrote_it(inference: bool):
    with torch.inference_mode(inference):
        plane = replace(PLANE, points=PLANE.points.clone())
    before = records.fingerprint(plane)
    plane.points.numpy()[1, 2] = -7.0
    changed = records.fingerprint(plane)
    other = replace(plane, points=torch.from_numpy(plane.points.numpy().copy()))
    plane.points.numpy()[:] = PLANE.points.numpy()
    assert changed == records.fingerprint(other) != before == records.fingerprint(plane)
