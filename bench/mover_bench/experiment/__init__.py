"""One experiment on known rooms: variants of the method, room by room, and their tables."""
