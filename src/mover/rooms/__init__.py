"""Known worlds: furnished rooms in which people move, with their truth and with noise."""

from .known import KnownRoom, RoomConfig
from .noise import NoiseConfig, add_noise
from .room import demo_room, draw_frame, make_room

__all__ = [
    "KnownRoom",
    "NoiseConfig",
    "RoomConfig",
    "add_noise",
    "demo_room",
    "draw_frame",
    "make_room",
]
