"""Furniture: made fit, seen in the image, placed."""
