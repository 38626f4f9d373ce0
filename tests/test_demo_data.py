"""The files of `mover demo` are those of the room that it names, to the bit."""

from dataclasses import replace
from pathlib import Path

import pytest

from mover.app.demo import DATA, write_demo
from mover.core.records import fingerprint
from mover.core.types import Capture
from mover.io.capture.bodies_file import read_bodies
from mover.io.capture.folder import read_capture, write_capture
from mover.io.capture.scene_file import read_scene
from mover_bench.rooms.config import NoiseConfig
from mover_bench.rooms.noise import add_noise


def without_paths(capture: Capture) -> Capture:
    """The capture without where it was read from."""
    objects = tuple(replace(thing, mesh_file="") for thing in capture.scene.objects)
    return replace(capture, name="", scene=replace(capture.scene, objects=objects))


def test_the_files_are_small() -> None:
    assert sum(path.stat().st_size for path in DATA.rglob("*") if path.is_file()) < 5_000_000


@pytest.mark.slow
def test_what_is_read_is_the_known_room_with_noise(demo_room, tmp_path: Path) -> None:
    write_demo(tmp_path / "shipped")
    write_capture(add_noise(demo_room, NoiseConfig(), 0), tmp_path / "made")
    shipped, made = (read_capture(tmp_path / name) for name in ("shipped", "made"))
    assert fingerprint(without_paths(shipped)) == fingerprint(without_paths(made))
    truth = tmp_path / "shipped" / "truth"
    true_bodies = replace(demo_room.bodies, mean_shape=True)  # which reading finds
    assert fingerprint(read_bodies(truth / "bodies.npz")) == fingerprint(true_bodies)
    true = {thing.id: thing for thing in demo_room.truth.objects}
    for thing in read_scene(truth / "scene.json", None).objects:
        assert fingerprint(thing.t_world_object, thing.yaw, thing.mesh.verts) == fingerprint(
            true[thing.id].t_world_object, true[thing.id].yaw, true[thing.id].mesh.verts
        )
