"""What the kernels read, their working memory and what they write."""

import warp as wp


@wp.struct
class Items:
    """Items with their topologies and windows; item i has topology and window i % views."""

    verts: wp.array(dtype=wp.vec3)  #: vertices of all items in camera axes [m]
    window: wp.array(dtype=wp.vec4)
    """Focal lengths and principal point of each window, with the border [px]."""
    faces: wp.array(dtype=wp.vec3l)  #: triangles of each topology
    edges: wp.array(dtype=wp.vec4l)  #: edges of each topology: two vertices, two faces
    views: int  #: number of windows
    shapes: int  #: number of topologies
    n_verts: int  #: vertices of an item
    n_faces: int  #: faces of a topology, with padding
    n_edges: int  #: edges of a topology, with padding
    height: int  #: rows of a grid, with the border [px]
    width: int  #: columns of a grid, with the border [px]
    border: int  #: rows and columns around the window [px]


@wp.struct
class Scratch:
    """Working memory; `near`, `far` and `pairs` are zero before and after."""

    screen: wp.array(dtype=wp.vec3)
    """Column, row [px] and inverse depth [1/m] of each vertex; zeros where it is not drawn."""
    front: wp.array(dtype=wp.int8)  #: whether each face is drawn and faces the camera
    near: wp.array(dtype=wp.uint64)
    """Winner of each pixel among the fronts: bits of 1/z (high half), face + 1 (low half)."""
    far: wp.array(dtype=wp.uint64)  #: winner of each pixel among the backs
    pairs: wp.array(dtype=wp.uint64)
    """Outermost cut of each pair of neighbours in a row, then in a column: its place, its edge."""
    queue: wp.array(dtype=wp.int32)  #: edges of the outline
    cuts: wp.array(dtype=wp.vec4i)
    """Cuts that count: two vertices (over all items), line x 4 + flags, covered place."""
    targets: wp.array(dtype=wp.int32)
    """Pixel of the window that each cut moves, over all items; where it overshoots -2 - pixel; -1
    where there is none."""
    count: wp.array(dtype=wp.int32)  #: number of entries of `queue`, of `cuts`


@wp.struct
class MapArrays:
    """What is drawn, without the border; a pixel that nothing covers is left as it is."""

    image: wp.array(dtype=wp.float32)  #: covered share of each pixel
    nearest: wp.array(dtype=wp.float32)  #: depth of the surface in `near` [m]
    farthest: wp.array(dtype=wp.float32)  #: depth of the surface in `far` [m]
    covered: wp.array(dtype=wp.bool)  #: whether both were seen
    near_face: wp.array(dtype=wp.int32)  #: face that won the pixel in `near`
    far_face: wp.array(dtype=wp.int32)  #: face that won the pixel in `far`
    silhouette: bool  #: whether `image` is wanted
    depth: bool  #: whether the other maps are wanted, where both surfaces are seen
    hits: bool  #: whether `nearest` and `near_face` are wanted alone, wherever something is seen


@wp.struct
class Pull:
    """Gradients of the maps, on their way to the vertices."""

    cuts: wp.array(dtype=wp.vec4i)  #: as in `Scratch`
    targets: wp.array(dtype=wp.int32)  #: as in `Scratch`
    image: wp.array(dtype=wp.float32)  #: gradient of the covered share
    nearest: wp.array(dtype=wp.float32)  #: gradient of the first depth
    farthest: wp.array(dtype=wp.float32)  #: gradient of the last depth
    has_image: bool
    has_nearest: bool
    has_farthest: bool
    verts: wp.array(dtype=wp.vec3)  #: gradient of the vertices, which is added to
