"""Warp kernels that lower a volume to the signed distance of one closed body.

Lengths are in cells, and places are counted from the first of the body's box: the centres of cells
have integer coordinates. Scratch arrays are laid out by columns, (x, z, y).
"""

import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

SHELL = wp.constant(2.0)  # [cells], up to where it is exact outside: more than a cell's diagonal
FAR = wp.constant(1.0e6)  # [cells]
TINY = wp.constant(1.0e-12)
SLIVER = wp.constant(1.0e-9**0.5)  # sine of an angle below which a triangle has no area
MORE = wp.constant(0.001)  # [cells], far more than the rounding of a distance
SNAP = wp.constant(wp.float64(65536.0))  # vertices snap to this part of a cell, for exact crossings
BITS = wp.constant(wp.int64(16))


@wp.struct
class Body:
    """One body and the scratch arrays about it."""

    faces: wp.array(dtype=wp.vec3i)
    place: wp.array(dtype=wp.vec3d)  #: vertices
    size: wp.vec3i  #: places of the box
    low: wp.vec3i  #: its first place in the volume
    winding: wp.array3d(dtype=wp.int32)  #: at first its changes along y, with one place more
    near: wp.array3d(dtype=wp.float32)  #: distance to the surface, exact within the shell


@wp.struct
class Flat:
    """A triangle seen along y, in fixed point, counter-clockwise."""

    x: wp.types.vector(length=3, dtype=wp.int64)
    z: wp.types.vector(length=3, dtype=wp.int64)
    y: wp.vec3d
    sign: int  #: 0 where it is seen edge-on


@wp.func
def flat(b: Body, t: wp.vec3i) -> Flat:
    """See `Flat`."""
    r = Flat()
    for k in range(3):
        p = b.place[t[k]]
        r.x[k] = wp.int64(wp.rint(p[0] * SNAP))
        r.z[k] = wp.int64(wp.rint(p[2] * SNAP))
        r.y[k] = p[1]
    area = (r.x[1] - r.x[0]) * (r.z[2] - r.z[0]) - (r.z[1] - r.z[0]) * (r.x[2] - r.x[0])
    r.sign = wp.where(area < wp.int64(0), -1, wp.where(area > wp.int64(0), 1, 0))
    if r.sign < 0:
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
def cross(b: Body) -> None:
    """Signed crossings of the columns with each triangle, one step where they pass it."""
    r = flat(b, b.faces[wp.tid()])
    if r.sign == 0:
        return
    one = wp.int64(65535)
    xl = wp.max(int((wp.min(r.x) + one) >> BITS), 0)
    xh = wp.min(int(wp.max(r.x) >> BITS), b.size[0] - 1)
    zl = wp.max(int((wp.min(r.z) + one) >> BITS), 0)
    zh = wp.min(int(wp.max(r.z) >> BITS), b.size[2] - 1)
    for x in range(xl, xh + 1):
        for z in range(zl, zh + 1):
            px = wp.int64(x) << BITS
            pz = wp.int64(z) << BITS
            u = weight(r, 0, px, pz)
            v = weight(r, 1, px, pz)
            w = weight(r, 2, px, pz)
            if wp.min(u, wp.min(v, w)) >= wp.int64(0):
                share = wp.vec3d(wp.float64(u), wp.float64(v), wp.float64(w))
                height = wp.dot(share, r.y) / wp.float64(u + v + w)
                y = int(wp.ceil(wp.clamp(height, wp.float64(-1.0e6), wp.float64(1.0e6))))
                wp.atomic_add(b.winding, x, z, wp.clamp(y, 0, b.size[1]), r.sign)


@wp.func
def toward(p: wp.vec3, a: wp.vec3, b: wp.vec3) -> wp.vec3:
    """From a point to the nearest one of an edge."""
    edge = b - a
    share = wp.dot(p - a, edge) / wp.max(wp.dot(edge, edge), TINY)
    return a + wp.clamp(share, 0.0, 1.0) * edge - p


@wp.func
def beside(at: wp.vec3, a: wp.vec3, b: wp.vec3, inward: float, least: float) -> float:
    """The lesser squared distance: that to an edge counts where the place is beyond it."""
    if inward < 0.0:
        least = wp.min(least, wp.length_sq(toward(at, a, b)))
    return least


@wp.kernel
def surround(b: Body) -> None:
    """Distances to a triangle from all places within the shell about it."""
    t = b.faces[wp.tid()]
    p = wp.vec3(b.place[t[0]])
    q = wp.vec3(b.place[t[1]])
    r = wp.vec3(b.place[t[2]])
    normal = wp.cross(q - p, r - p)
    area = wp.length(normal)  # twice
    if area <= SLIVER * wp.length(q - p) * wp.length(r - p):
        return
    normal = normal / area
    pq = wp.cross(normal, q - p)
    qr = wp.cross(normal, r - q)
    rp = wp.cross(normal, p - r)
    low = wp.min(p, wp.min(q, r))
    high = wp.max(p, wp.max(q, r))
    xl = wp.max(int(wp.ceil(low[0] - SHELL)), 0)
    zl = wp.max(int(wp.ceil(low[2] - SHELL)), 0)
    xh = wp.min(int(wp.floor(high[0] + SHELL)), b.size[0] - 1)
    zh = wp.min(int(wp.floor(high[2] + SHELL)), b.size[2] - 1)
    for x in range(xl, xh + 1):
        dx = wp.max(wp.max(low[0] - float(x), float(x) - high[0]), 0.0)
        for z in range(zl, zh + 1):
            dz = wp.max(wp.max(low[2] - float(z), float(z) - high[2]), 0.0)
            up = wp.sqrt(wp.max(SHELL * SHELL - dx * dx - dz * dz, 0.0)) + MORE
            yl = wp.max(int(wp.ceil(low[1] - up)), 0)
            yh = wp.min(int(wp.floor(high[1] + up)), b.size[1] - 1)
            for y in range(yl, yh + 1):
                at = wp.vec3(float(x), float(y), float(z))
                height = wp.abs(wp.dot(at - p, normal))
                held = wp.min(b.near[x, z, y], SHELL)
                if height < held:
                    least = beside(at, p, q, wp.dot(at - p, pq), FAR * FAR)
                    least = beside(at, q, r, wp.dot(at - q, qr), least)
                    least = beside(at, r, p, wp.dot(at - r, rp), least)
                    least = wp.where(least < FAR, least, height * height)  # above the triangle
                    if least < held * held:
                        wp.atomic_min(b.near, x, z, y, wp.sqrt(least))


@wp.kernel
def lower(
    b: Body, mesh: wp.uint64, side: int, field: wp.array3d(dtype=wp.float32), cell: float
) -> None:
    """Lower the volume along a column; deep inside from the nearest point of Warp's mesh.

    Distances change by one cell from place to place at most, which bounds the next search.
    """
    x, z = wp.tid()
    winding = int(0)
    reach = float(FAR)
    for y in range(b.size[1]):
        winding += b.winding[x, z, y] * side
        at = b.low + wp.vec3i(x, y, z)
        near = b.near[x, z, y]
        if winding > 0:
            held = field[at[0], at[1], at[2]]
            reach = wp.min(near, reach + 1.0 + MORE)
            if near > SHELL and reach > -held / cell:
                p = wp.vec3(float(x), float(y), float(z))
                q = wp.mesh_query_point_no_sign(mesh, p, reach)
                if q.result:
                    reach = wp.length(wp.mesh_eval_position(mesh, q.face, q.u, q.v) - p)
            field[at[0], at[1], at[2]] = wp.min(held, -reach * cell)
        else:
            reach = FAR
            if near <= SHELL:
                held = field[at[0], at[1], at[2]]
                field[at[0], at[1], at[2]] = wp.min(held, near * cell)
