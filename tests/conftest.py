import pytest
import torch

torch.set_num_threads(1)  # threads that wait for one another are slower than one


@pytest.fixture(scope="session")
def small_room():
    """A known room with few frames, made once."""
    from mover.rooms.room import RoomConfig, make_room

    return make_room(3, RoomConfig(width=480, height=270, stay=0.3, least_frames=60))


@pytest.fixture(scope="session")
def demo_room():
    """The room of `mover demo`."""
    from mover.rooms import room

    return room.demo_room()
