"""Kernels of the rasteriser in NVIDIA Warp: one source for CPU and CUDA.

`spans`, `contour` and `surface` hold what is done for one triangle, one edge and one pixel. `grid`
runs it with a thread for each, which suits a GPU; `items` runs the same functions in loops, a few
items a thread, which suits a CPU. These modules import `warp`: import them inside functions.
"""
