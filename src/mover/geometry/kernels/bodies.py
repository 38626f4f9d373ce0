"""Warp kernels that lower a volume to the signed distance of one closed body.

Lengths are in cells, and places are counted from the first of the body's box: the centres of cells
have integer coordinates. Scratch arrays are laid out by columns, (x, z, y).
"""

import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

SHELL = wp.constant(2.0)  # [cells], see `volume.SHELL`
FAR = wp.constant(1.0e6)
MORE = wp.constant(0.001)  # [cells], far more than the rounding of a distance
SLIVER = wp.constant(1.0e-9)  # squared sine of an angle below which a triangle is its edges
SNAP = wp.constant(wp.float64(65536.0))  # vertices snap to this part of a cell, for exact crossings
BITS = wp.constant(wp.int64(16))


@wp.struct
class Body:
    """One body and the scratch arrays about it."""

    faces: wp.array(dtype=wp.vec3i)
    place: wp.array(dtype=wp.vec3d)
    """Vertices."""
    at: wp.array(dtype=wp.vec3)
    """The same in single precision."""
    size: wp.vec3i
    """Places of the box."""
    low: wp.vec3i
    """Its first place in the volume."""
    winding: wp.array3d(dtype=wp.int32)
    """At first its changes along y, with one place more."""
    least: wp.array3d(dtype=wp.float32)
    """Distance to the nearest triangle, where it is within the shell and may matter; else a bound
    below which it would."""
    owner: wp.array3d(dtype=wp.int32)
    """The triangle that is nearest or, deep inside, one that is near; -1: none."""


@wp.struct
class Flat:
    """A triangle seen along y, in fixed point, counter-clockwise."""

    x: wp.types.vector(length=3, dtype=wp.int64)
    z: wp.types.vector(length=3, dtype=wp.int64)
    y: wp.vec3d
    sign: int
    """0 where it is seen edge-on."""


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


@wp.kernel
def add_up(b: Body, side: int, field: wp.array3d(dtype=wp.float32), cell: float) -> None:
    """Turn changes along a column into winding numbers, positive inside; bound the distances."""
    x, z = wp.tid()
    winding = wp.int32(0)
    for y in range(b.size[1]):
        winding += b.winding[x, z, y] * side
        b.winding[x, z, y] = winding
        held = field[b.low[0] + x, b.low[1] + y, b.low[2] + z] / cell
        most = wp.min(held, SHELL)
        if winding > 0:
            most = wp.where(held < -SHELL, -1.0, SHELL)
        b.least[x, z, y] = most


@wp.func
def to_edge(p: wp.vec3, a: wp.vec3, b: wp.vec3) -> float:
    """Squared distance from a point to an edge."""
    e = b - a
    t = wp.clamp(wp.dot(p - a, e) / wp.max(wp.dot(e, e), 1.0e-12), 0.0, 1.0)
    return wp.length_sq(p - a - t * e)


@wp.struct
class Face:
    """A triangle, for distances to it."""

    a: wp.vec3
    u: wp.vec3
    v: wp.vec3
    normal: wp.vec3
    """Of length 1, or 0 where the triangle is but an edge or a point."""
    along_u: wp.vec3
    """Times a point of the plane, its share of u."""
    along_v: wp.vec3


@wp.func
def face_of(b: Body, f: int) -> Face:
    """See `Face`."""
    t = b.faces[f]
    first = wp.min(t)  # in one order, so that a flipped triangle has the same roundings
    last = wp.max(t)
    r = Face()
    r.a = b.at[first]
    r.u = b.at[t[0] + t[1] + t[2] - first - last] - r.a
    r.v = b.at[last] - r.a
    normal = wp.cross(r.u, r.v)
    square = wp.length_sq(normal)
    if square > SLIVER * wp.length_sq(r.u) * wp.length_sq(r.v):
        r.normal = normal / wp.sqrt(square)
        r.along_u = wp.cross(r.v, normal) / square
        r.along_v = wp.cross(normal, r.u) / square
    return r


@wp.func
def to_face(r: Face, p: wp.vec3) -> float:
    """Distance from a point to a triangle: to its plane, else to edges that it is beyond."""
    q = p - r.a
    second = wp.dot(q, r.along_u)
    third = wp.dot(q, r.along_v)
    flat = wp.length_sq(r.normal) > 0.0
    if flat and second >= 0.0 and third >= 0.0 and second + third <= 1.0:
        return wp.abs(wp.dot(q, r.normal))
    best = FAR * FAR
    if not flat or third < 0.0:
        best = to_edge(q, wp.vec3(), r.u)
    if not flat or second < 0.0:
        best = wp.min(best, to_edge(q, wp.vec3(), r.v))
    if not flat or second + third > 1.0:
        best = wp.min(best, to_edge(q, r.u, r.v))
    return wp.sqrt(best)


@wp.kernel
def scatter(b: Body) -> None:
    """Distances of a triangle to the places within its shell where they may matter."""
    f = wp.tid()
    r = face_of(b, f)
    more = wp.vec3(SHELL + MORE, SHELL + MORE, SHELL + MORE)  # or a farther triangle might win
    low = r.a + wp.min(wp.vec3(), wp.min(r.u, r.v)) - more
    high = r.a + wp.max(wp.vec3(), wp.max(r.u, r.v)) + more
    first = wp.vec3i()
    last = wp.vec3i()
    for k in range(3):
        first[k] = wp.max(int(wp.ceil(low[k])), 0)
        last[k] = wp.min(int(wp.floor(high[k])), b.size[k] - 1)
    for x in range(first[0], last[0] + 1):
        for z in range(first[2], last[2] + 1):
            # only the rows within the shell of the triangle's plane, unless it is upright
            base = wp.dot(r.normal, wp.vec3(float(x), 0.0, float(z)) - r.a)
            up = wp.abs(r.normal[1])
            middle = -base / wp.where(up > 1.0e-3, r.normal[1], FAR)
            reach = wp.where(up > 1.0e-3, (SHELL + MORE) / up, FAR)
            begin = wp.max(first[1], int(wp.ceil(wp.max(middle - reach, low[1]))))
            end = wp.min(last[1], int(wp.floor(wp.min(middle + reach, high[1]))))
            for y in range(begin, end + 1):
                most = b.least[x, z, y]
                if wp.abs(base + r.normal[1] * float(y)) < most:
                    d = to_face(r, wp.vec3(float(x), float(y), float(z)))
                    if d < most:
                        b.owner[x, z, y] = f
                        wp.atomic_min(b.least, x, z, y, d)


@wp.func
def to_owner(b: Body, f: int, p: wp.vec3) -> float:
    """Distance to a triangle that may be unknown (-1)."""
    if f < 0:
        return FAR
    return to_face(face_of(b, f), p)


@wp.kernel
def lower(b: Body, mesh: wp.uint64, field: wp.array3d(dtype=wp.float32), cell: float) -> None:
    """Lower the volume along a column; deep inside by the triangle that the mesh finds."""
    x, z = wp.tid()
    guess = int(-1)
    for y in range(b.size[1]):
        at = b.low + wp.vec3i(x, y, z)
        held = field[at[0], at[1], at[2]]
        found = b.owner[x, z, y] >= 0
        signed = b.least[x, z, y] * cell
        if b.winding[x, z, y] > 0:
            signed = -signed
        if found and signed <= SHELL * cell:
            field[at[0], at[1], at[2]] = wp.min(held, signed)
        if b.winding[x, z, y] > 0 and not found:
            p = wp.vec3(float(x), float(y), float(z))
            most = wp.min(to_owner(b, guess, p), to_owner(b, b.owner[wp.max(x - 1, 0), z, y], p))
            most = wp.min(most, to_owner(b, b.owner[x, wp.max(z - 1, 0), y], p))
            if -(most + MORE) * cell < held:
                q = wp.mesh_query_point_no_sign(mesh, p, most + MORE)
                if q.result:
                    b.owner[x, z, y] = q.face
                    field[at[0], at[1], at[2]] = wp.min(
                        held, -to_face(face_of(b, q.face), p) * cell
                    )
        if b.owner[x, z, y] >= 0:
            guess = b.owner[x, z, y]
