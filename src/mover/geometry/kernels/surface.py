"""Depth of the surface that a pixel sees, and its gradient.

The depth itself is that of the run of pixels: in single precision it is nearer to the exact value
than the plane through the vertices, from which the gradient comes.
"""

import warp as wp

from mover.geometry.kernels.scene import Items, MapArrays, Pull
from mover.geometry.kernels.spans import FULL, HALF

GRAZING = 0.01  # sine of the angle below which a triangle's depth has no gradient
AGREE = 1e-3  # relative difference of plane and scan line in 1/z beyond which the plane is noise
LOW = wp.constant(wp.uint64(0xFFFFFFFF))


@wp.func
def face_of(key: wp.uint64) -> int:
    """Face that won a pixel."""
    return int(key & LOW) - 1


@wp.func
def inverse_depth(key: wp.uint64, farthest: bool) -> float:
    """Inverse depth [1/m] of the run that won a pixel."""
    flip = wp.where(farthest, FULL, wp.uint32(0))
    return wp.cast(wp.uint32(key >> HALF) ^ flip, wp.float32)


@wp.func
def show_pixel(maps: MapArrays, pixel: int, near: wp.uint64, far: wp.uint64) -> None:
    """Write the maps of one pixel from its winners."""
    if near != wp.uint64(0):
        if maps.silhouette:
            maps.image[pixel] = 1.0
        if maps.hits:
            maps.nearest[pixel] = 1.0 / inverse_depth(near, False)
            maps.near_face[pixel] = face_of(near)
        if maps.depth and far != wp.uint64(0):
            maps.covered[pixel] = True
            maps.nearest[pixel] = 1.0 / inverse_depth(near, False)
            maps.farthest[pixel] = 1.0 / inverse_depth(far, True)
            maps.near_face[pixel] = face_of(near)
            maps.far_face[pixel] = face_of(far)


@wp.func
def pull_pixel(scene: Items, maps: MapArrays, pull: Pull, pixel: int) -> None:
    """Add the gradients of both depths of a pixel to the vertices."""
    if maps.covered[pixel]:
        if pull.has_nearest:
            g = pull.nearest[pixel]
            pull_depth(scene, pixel, maps.near_face[pixel], maps.nearest[pixel], g, pull.verts)
        if pull.has_farthest:
            g = pull.farthest[pixel]
            pull_depth(scene, pixel, maps.far_face[pixel], maps.farthest[pixel], g, pull.verts)


@wp.func
def pull_depth(
    scene: Items, pixel: int, face: int, z: float, gradient: float, grads: wp.array(dtype=wp.vec3)
) -> None:
    """Add the gradient of a pixel's depth to the vertices of the face that it sees.

    The depth z = (n . a) / (n . ray) moves by n / (n . ray) times the motion of the point that is
    hit, which is the mean of the motions of the vertices with its barycentric weights. Faces that
    are seen edge-on, and slivers whose plane is noise, have no gradient.
    """
    if gradient == 0.0:
        return
    wide = scene.width - 2 * scene.border
    high = scene.height - 2 * scene.border
    item = pixel / (wide * high)
    k = scene.window[item % scene.views]
    column = float(pixel % wide + scene.border) + 0.5
    row = float(pixel / wide % high + scene.border) + 0.5
    ray = wp.vec3((column - k[2]) / k[0], (row - k[3]) / k[1], 1.0)
    corner = scene.faces[item % scene.shapes * scene.n_faces + face]
    base = item * scene.n_verts
    a = scene.verts[base + int(corner[0])]
    e = scene.verts[base + int(corner[1])] - a
    f = scene.verts[base + int(corner[2])] - a
    normal = wp.cross(e, f)
    size = wp.dot(normal, normal)
    toward = wp.dot(normal, a)
    slant = wp.dot(normal, ray)
    steep = toward * toward > GRAZING * GRAZING * size * wp.dot(a, a)
    if steep and wp.isfinite(toward) and wp.abs(slant * z - toward) < AGREE * wp.abs(toward):
        p = ray * (toward / slant) - a
        second = wp.dot(wp.cross(p, f), normal) / size
        third = wp.dot(wp.cross(e, p), normal) / size
        pull = normal * (gradient / slant)
        wp.atomic_add(grads, base + int(corner[0]), (1.0 - second - third) * pull)
        wp.atomic_add(grads, base + int(corner[1]), second * pull)
        wp.atomic_add(grads, base + int(corner[2]), third * pull)
