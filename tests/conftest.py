import pytest
import torch


def pytest_configure(config):
    """Threads that wait for one another are slower than one, and results do not depend on them."""
    torch.set_num_threads(1)


@pytest.fixture(scope="session")
def small_room():
    """A known room with few frames, made once."""
    from mover.rooms.room import RoomConfig, make_room

    return make_room(3, RoomConfig(width=480, height=270, stay=0.3, least_frames=60))
