"""Kernels of the rasteriser in NVIDIA Warp: one source for CPU and CUDA.

`spans`, `contour` and `surface` hold what is done for one triangle, one edge and one pixel.
`items` runs them with one thread for each item, which suits a CPU; `grid` with one for each vertex,
triangle, edge or pixel, which suits a GPU. These modules import `warp`: import them inside
functions.
"""
