"""Known rooms, studies on them, and the tables of the paper; nothing in `mover` needs it."""
