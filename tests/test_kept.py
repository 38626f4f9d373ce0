"""What is kept in the user's cache: used when it is whole, never needed."""

import os
from pathlib import Path

import numpy as np
import pytest
import torch

from mover.core.run import kept
from mover.core.types import Mesh
from mover.furniture.library import make_piece
from mover.stages.config import PrepareConfig
from mover.stages.objects import prepare_objects as stage
from mover.stages.objects.prepare_objects import prepare_objects

MESH = Mesh(torch.rand(5, 3, generator=torch.Generator().manual_seed(1)), torch.arange(3)[None])


def never() -> Mesh:
    raise AssertionError("it is kept")


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "mover"


@pytest.mark.usefixtures("cache")
def test_what_was_made_once_is_the_same_the_next_time():
    assert kept(Mesh, "a", lambda: MESH) is MESH
    again = kept(Mesh, "a", never)
    assert torch.equal(again.verts, MESH.verts)
    assert torch.equal(again.faces, MESH.faces)
    with pytest.raises(AssertionError, match="it is kept"):
        kept(Mesh, "b", never)


@pytest.mark.parametrize("suffix", [".json", ".npz"])
def test_what_is_damaged_is_made_anew(cache: Path, suffix: str):
    kept(Mesh, "a", lambda: MESH)
    file = cache / f"Mesh-a{suffix}"
    file.write_bytes(file.read_bytes()[:-20])
    assert kept(Mesh, "a", lambda: MESH) is MESH
    assert torch.equal(kept(Mesh, "a", never).verts, MESH.verts)


def test_where_nothing_can_be_written_nothing_is_kept(cache: Path):
    cache.write_text("a file")
    assert kept(Mesh, "a", lambda: MESH) is MESH


def test_the_half_that_was_not_used_for_longest_goes(cache: Path, monkeypatch):
    monkeypatch.setattr("mover.core.run.MOST", 4)
    for place, name in enumerate("abcd"):
        kept(Mesh, name, lambda: MESH)
        for file in cache.glob(f"Mesh-{name}.*"):
            os.utime(file, (place, place))
    kept(Mesh, "a", never)
    kept(Mesh, "e", lambda: MESH)
    left = {file.name for file in cache.iterdir()}
    assert left == {f"Mesh-{name}{suffix}" for name in "ade" for suffix in (".json", ".npz")}


@pytest.mark.usefixtures("cache")
def test_a_mesh_is_closed_once_for_all_scenes(monkeypatch):
    chair = make_piece("chair", np.random.default_rng(0)).mesh
    config = PrepareConfig(samples=50, region=20)
    places = [(torch.zeros(3), 0.0), (torch.ones(3), 1.0)]
    scenes = [
        stage.PrepareInputs(
            (
                stage.SceneObject(
                    "a", "chair", chair, "", None, "ground",
                    t_world_object=place, yaw=torch.tensor(yaw), scale=torch.ones(3),
                ),
            )
        )
        for place, yaw in places
    ]  # fmt: skip
    first = prepare_objects(scenes[0], config)
    monkeypatch.setattr(stage, "close_mesh", never)
    again = prepare_objects(scenes[1], config)
    assert torch.equal(first.objects.verts, again.objects.verts)
    assert torch.equal(first.objects.samples, again.objects.samples)
    with pytest.raises(TypeError):
        prepare_objects(scenes[0], PrepareConfig(cells=48, samples=50, region=20))
