# pyright: basic, reportInvalidTypeForm=false
"""Warp kernel of the crossings of vertical lines with a body; see `bodies`."""

from typing import no_type_check

import warp as wp

from .bodies import BITS, Work

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


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
        v = w.lines[t[k]]
        r.x[k] = v[0]
        r.z[k] = v[1]
        r.y[k] = w.place[t[k]][1]
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
    t = w.faces[wp.tid()]
    u = w.lines[t[0]]
    v = w.lines[t[1]]
    p = w.lines[t[2]]
    one = wp.int64(65535)
    xl = wp.max(int((wp.min(u[0], wp.min(v[0], p[0])) + one) >> BITS), 0)
    xh = wp.min(int(wp.max(u[0], wp.max(v[0], p[0])) >> BITS), w.size[0] - 1)
    zl = wp.max(int((wp.min(u[1], wp.min(v[1], p[1])) + one) >> BITS), 0)
    zh = wp.min(int(wp.max(u[1], wp.max(v[1], p[1])) >> BITS), w.size[2] - 1)
    if xl > xh or zl > zh:
        return
    r = flat(w, t)
    if r.sign == 0:
        return
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
                w.crossed[(x >> 1) * ((w.size[2] + 1) >> 1) + (z >> 1)] = wp.uint8(1)
                wp.atomic_add(w.steps, (x * w.size[2] + z) * (w.size[1] + 1) + y, r.sign)
