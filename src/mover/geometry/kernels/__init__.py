"""Kernels in NVIDIA Warp.

`spans`, `contour` and `surface` hold what is done for one triangle, one edge and one pixel of a
drawing; `items` runs it in loops, a few items a thread. These modules import `warp`: import them
inside functions.
"""
