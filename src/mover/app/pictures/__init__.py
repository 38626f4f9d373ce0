"""Pictures and films of a room, without a screen."""
