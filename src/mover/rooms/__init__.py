"""Known worlds: furnished rooms in which people move, with their truth and with noise."""

from .known import KnownRoom
from .noise import NoiseConfig, add_noise
from .room import demo_room, draw_frame, make_room
from .room_config import ActConfig, PlanConfig, RoomConfig

__all__ = [
    "ActConfig",
    "KnownRoom",
    "NoiseConfig",
    "PlanConfig",
    "RoomConfig",
    "add_noise",
    "demo_room",
    "draw_frame",
    "make_room",
]
