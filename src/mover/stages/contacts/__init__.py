"""Which body parts touch which objects, and what bodies say about depth and free space."""
