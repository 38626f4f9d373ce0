"""Eq. 1 as one Warp kernel: the same numbers as `objective`, sooner."""
