"""Camera pitch, roll, lens and ground from the feet, then from the objects."""
