# pyright: basic, reportInvalidTypeForm=false
"""Warp kernel of the crossings of vertical lines with a body; see `bodies`."""

from typing import no_type_check

import warp as wp

from .bodies import Work

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

SNAP = wp.constant(wp.float64(65536.0))  # vertices snap to this part of a cell, as in `voxels`
BITS = wp.constant(wp.int64(16))


@wp.struct
@no_type_check
class Flat:
    """A triangle seen along y, in fixed point, counter-clockwise."""

    x: wp.types.vector(length=3, dtype=wp.int64)
    z: wp.types.vector(length=3, dtype=wp.int64)
    y: wp.vec3d
    sign: int


@wp.func
@no_type_check
def flat(w: Work, t: wp.vec3i) -> Flat:
    """See `Flat`; the sign is 0 where the triangle is seen edge-on."""
    r = Flat()
    for k in range(3):
        v = w.place[t[k]]
        r.x[k] = wp.int64(wp.rint(v[0] * SNAP)) - (wp.int64(w.low[0]) << BITS)
        r.z[k] = wp.int64(wp.rint(v[2] * SNAP)) - (wp.int64(w.low[2]) << BITS)
        r.y[k] = v[1]
    area = (r.x[1] - r.x[0]) * (r.z[2] - r.z[0]) - (r.z[1] - r.z[0]) * (r.x[2] - r.x[0])
    r.sign = 1
    if area == wp.int64(0):
        r.sign = 0
    if area < wp.int64(0):
        r.sign = -1
        x = r.x[1]
        z = r.z[1]
        y = r.y[1]
        r.x[1] = r.x[2]
        r.z[1] = r.z[2]
        r.y[1] = r.y[2]
        r.x[2] = x
        r.z[2] = z
        r.y[2] = y
    return r


@wp.func
@no_type_check
def weight(r: Flat, k: int, px: wp.int64, pz: wp.int64) -> wp.int64:
    """Twice the area of a column and the edge opposite of a corner; -1 if it is outside."""
    i = (k + 1) % 3
    j = (k + 2) % 3
    ex = r.x[j] - r.x[i]
    ez = r.z[j] - r.z[i]
    area = ex * (pz - r.z[i]) - ez * (px - r.x[i])
    owns = ez < wp.int64(0) or (ez == wp.int64(0) and ex > wp.int64(0))
    if area == wp.int64(0) and not owns:
        area = wp.int64(-1)
    return area


@wp.kernel
@no_type_check
def cross(w: Work) -> None:
    """Signed crossings of the columns with each triangle, one step where they pass it."""
    r = flat(w, w.faces[wp.tid()])
    if r.sign == 0:
        return
    one = wp.int64(65535)
    xl = wp.max(int((wp.min(r.x) + one) >> BITS), 0)
    xh = wp.min(int(wp.max(r.x) >> BITS), w.size[0] - 1)
    zl = wp.max(int((wp.min(r.z) + one) >> BITS), 0)
    zh = wp.min(int(wp.max(r.z) >> BITS), w.size[2] - 1)
    for x in range(xl, xh + 1):
        for z in range(zl, zh + 1):
            px = wp.int64(x) << BITS
            pz = wp.int64(z) << BITS
            a = weight(r, 0, px, pz)
            b = weight(r, 1, px, pz)
            c = weight(r, 2, px, pz)
            if wp.min(a, wp.min(b, c)) >= wp.int64(0):
                share = wp.vec3d(wp.float64(a), wp.float64(b), wp.float64(c))
                height = wp.dot(share, r.y) / wp.float64(a + b + c)
                y = int(wp.ceil(wp.clamp(height, wp.float64(-1.0e6), wp.float64(1.0e6))))
                y = wp.clamp(y - w.low[1], 0, w.size[1])
                wp.atomic_add(w.steps, (x * w.size[2] + z) * (w.size[1] + 1) + y, r.sign)
