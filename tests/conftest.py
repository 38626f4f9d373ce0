import gc
import os
import sys
from importlib.machinery import PathFinder

import jaxtyping
import pytest
import shape_checks

jaxtyping.jaxtyped = shape_checks.jaxtyped
sys.dont_write_bytecode = False  # what is compiled is kept, and for commands in tests, too
os.environ.pop("PYTHONDONTWRITEBYTECODE", None)


class _Kernels(PathFinder):
    """Kernels are read by Warp, which has types of its own: they are not checked."""

    @classmethod
    def find_spec(cls, fullname, path=None, target=None):
        return super().find_spec(fullname, path, target) if ".kernels." in fullname else None


sys.meta_path.insert(0, _Kernels)  # before the one that checks shapes


def pytest_collection():
    """Only where tests run: they draw in double precision, too, which the program never does."""
    gc.disable()  # nothing of what is imported goes
    import torch
    from reference import reference_of

    from mover.geometry import raster

    torch.set_num_threads(1)  # threads that wait for one another are slower than one
    raster._reference_of = reference_of


def pytest_collection_modifyitems(items):
    """Tests of the documentation and of pages in a browser are marked by where they stand."""
    gc.freeze()
    gc.enable()
    for item in items:
        if item.path.stem.startswith("test_docs"):
            item.add_marker(pytest.mark.docs)
        if "browser" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.browser)


@pytest.fixture(scope="session")
def tiny():
    """A known room that is made at once: three pieces, and a person who sits."""
    from test_rooms import tiny_room

    return tiny_room()


@pytest.fixture
def folder(tmp_path):
    """The folder of a tiny capture with everything in it."""
    from tiny_capture import write_capture

    return write_capture(tmp_path / "tiny")


@pytest.fixture(scope="session")
def small_room():
    """A known room with few frames."""
    from kept_rooms import drawn, kept

    from mover_bench.rooms.config import RoomConfig

    return kept(drawn, 3, RoomConfig(width=480, height=270, stay=0.3, least_frames=60))


@pytest.fixture(scope="session")
def small_capture(small_room):
    """What is given of the small room: with noise, and of every eighth frame of the people."""
    from kept_rooms import thinned

    from mover_bench.rooms.config import NoiseConfig
    from mover_bench.rooms.noise import add_noise

    return thinned(add_noise(small_room, NoiseConfig(), 1))


@pytest.fixture
def quick(monkeypatch):
    """Fits and rooms with few steps, for tests that ask whether they are there, not how good."""
    from test_fit import QUICK
    from test_perceive_layout import QUICK as LAYOUT
    from test_pipeline import light

    from mover.app.cli import video
    from mover.fitting import FITS
    from mover.pipeline.presets import PRESETS

    monkeypatch.setattr(video, "LayoutConfig", lambda: LAYOUT)
    monkeypatch.setitem(PRESETS, "robust", light("robust"))
    monkeypatch.setitem(FITS, "robust", QUICK)


@pytest.fixture(scope="session")
def smpl_models(tmp_path_factory):
    """A folder with synthetic files of SMPL, SMPL-H and SMPL-X."""
    from make_smpl import write_models

    names = ("smpl", "smplh", "smplx")
    return write_models(tmp_path_factory.mktemp("models"), names)


@pytest.fixture(scope="session")
def demo_room():
    """The room of `mover demo`."""
    from kept_rooms import demo, kept

    return kept(demo)
