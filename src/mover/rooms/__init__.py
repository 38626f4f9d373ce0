"""Known worlds: furnished rooms in which people move, with their truth and with noise."""

from .noise import NoiseConfig, add_noise
from .room import KnownRoom, RoomConfig, demo_room, make_room

__all__ = ["KnownRoom", "NoiseConfig", "RoomConfig", "add_noise", "demo_room", "make_room"]
