"""The terms that refine bodies in a room."""
