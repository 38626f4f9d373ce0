import sys
from importlib.machinery import PathFinder

import pytest
import torch

torch.set_num_threads(1)  # threads that wait for one another are slower than one


class _Kernels(PathFinder):
    """Kernels are read by Warp, which has types of its own: nobody checks them."""

    @classmethod
    def find_spec(cls, fullname, path=None, target=None):
        return super().find_spec(fullname, path, target) if ".kernels." in fullname else None


sys.meta_path.insert(0, _Kernels)  # before the one that checks shapes


def pytest_sessionstart():
    """Tests draw in double precision, too, which the program never does."""
    from reference import reference_of

    from mover.geometry import raster

    raster._reference_of = reference_of


def pytest_collection_modifyitems(items):
    """Tests of the documentation and of pages in a browser are marked by where they stand."""
    for item in items:
        if item.path.stem.startswith("test_docs"):
            item.add_marker(pytest.mark.docs)
        if "browser" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.browser)


@pytest.fixture(scope="session")
def small_room():
    """A known room with few frames."""
    from kept_rooms import drawn, kept

    from mover_bench.rooms.config import RoomConfig

    return kept(drawn, 3, RoomConfig(width=480, height=270, stay=0.3, least_frames=60))


@pytest.fixture(scope="session")
def demo_room():
    """The room of `mover demo`."""
    from kept_rooms import demo, kept

    return kept(demo)
