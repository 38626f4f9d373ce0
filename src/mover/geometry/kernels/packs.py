"""Squared distances to eight boxes or eight triangles at once, in the C++ that kernels become.

A compiler turns loops over eight into single instructions of a CPU; written in Warp, the same takes
six times as long. On CUDA they stay loops. There is no branch on the way, so that the bits do not
depend on the lane.

Boxes: lane k of pack i is at 48 i + 8 j + k, j = 0..2 the lower corner, 3..5 the upper one.
Shapes: lane k of leaf i is at 136 i + 8 j + k, j = 0..2 the first corner of a triangle, 3..5 the
direction u of its first edge, 6..8 the direction v across it, 9..11 the normal; 12 the length of
the first edge, 13 and 14 the third corner along u and v, 15 and 16 one over the squared lengths of
the other edges. Slabs: leaf i is at 8 i + j, j = 0..2 the normal of a leaf, 3 where its middle
plane is, 4 half its thickness. The functions are in a class, because Warp allows them no second
decorator.
"""

import warp as wp

Eight = wp.types.vector(length=8, dtype=wp.float32)
Floats = wp.array(dtype=wp.float32)
Ints = wp.array(dtype=wp.int32)
Points = wp.array(dtype=wp.vec3)

NEAREST = """
    const float* r = shapes.data + 136 * leaf;
    float d[8];
    for (int k = 0; k < 8; ++k) {
        const float dx = p[0] - r[k], dy = p[1] - r[8 + k], dz = p[2] - r[16 + k];
        const float x = dx * r[24 + k] + dy * r[32 + k] + dz * r[40 + k];
        const float y = dx * r[48 + k] + dy * r[56 + k] + dz * r[64 + k];
        const float z = dx * r[72 + k] + dy * r[80 + k] + dz * r[88 + k];
        const float l = r[96 + k], cx = r[104 + k], cy = r[112 + k];
        const float bx = cx - l, xl = x - l;
        float s = x < 0.0f ? 0.0f : x;
        s = x - (s > l ? l : s);
        float m = s * s + y * y;
        s = (x * cx + y * cy) * r[120 + k];
        s = s < 0.0f ? 0.0f : s;
        s = s > 1.0f ? 1.0f : s;
        const float fx = x - s * cx, fy = y - s * cy, f = fx * fx + fy * fy;
        m = f < m ? f : m;
        s = (xl * bx + y * cy) * r[128 + k];
        s = s < 0.0f ? 0.0f : s;
        s = s > 1.0f ? 1.0f : s;
        const float gx = xl - s * bx, gy = y - s * cy, g = gx * gx + gy * gy;
        m = g < m ? g : m;
        const float second = x * cy - y * cx, third = y * bx - xl * cy;
        float in = y < second ? y : second;
        in = third < in ? third : in;
        d[k] = (in > 0.0f ? 0.0f : m) + z * z;
    }
    for (int k = 0; k < 4; ++k) d[k] = d[k + 4] < d[k] ? d[k + 4] : d[k];
    for (int k = 0; k < 2; ++k) d[k] = d[k + 2] < d[k] ? d[k + 2] : d[k];
    const float least = d[1] < d[0] ? d[1] : d[0];
"""

TO_LEAF = NEAREST + "    return least;"

LOOK = """
    for (int left = hit; left != 0; left &= left - 1) {
#if defined(__CUDA_ARCH__)
        const int v = __ffs(left) - 1;
#else
        const int v = __builtin_ctz(left);
#endif
        const float x = low[0] + (float)(v >> 2), y = low[1] + (float)((v >> 1) & 1);
        const float p[3] = {x, y, low[2] + (float)(v & 1)};
NEAREST        known[v] = least < known[v] ? least : known[v];
    }
    return known;
""".replace("NEAREST", NEAREST)

EXPAND = """
    const float* b = boxes.data + 48 * pack;
    float d[8];
    for (int k = 0; k < 8; ++k) {
        float x = b[k] - high[0], y = b[8 + k] - high[1], z = b[16 + k] - high[2];
        const float u = low[0] - b[24 + k], v = low[1] - b[32 + k], w = low[2] - b[40 + k];
        x = u > x ? u : x;
        y = v > y ? v : y;
        z = w > z ? w : z;
        x = x > 0.0f ? x : 0.0f;
        y = y > 0.0f ? y : 0.0f;
        z = z > 0.0f ? z : 0.0f;
        d[k] = x * x + y * y + z * z;
    }
    int at = end;
    for (int k = 0; k < 8; ++k) {
        stack.data[at] = 8 * pack + k;
        at += d[k] < reach;
    }
    return at;
"""

REACHED = """
    const float* b = boxes.data + 48 * (slot / 8) + slot % 8;
    const float* s = slabs.data + 8 * leaf;
    const float e[3][8]
        = {{0, 0, 0, 0, 1, 1, 1, 1}, {0, 0, 1, 1, 0, 0, 1, 1}, {0, 1, 0, 1, 0, 1, 0, 1}};
    const float o = s[0] * low[0] + s[1] * low[1] + s[2] * low[2] - s[3];
    float d[8];
    for (int k = 0; k < 8; ++k) {
        float sum = 0.0f;
        for (int j = 0; j < 3; ++j) {
            const float p = low[j] + e[j][k], u = b[8 * j] - p, v = p - b[24 + 8 * j];
            float x = u > v ? u : v;
            x = x > 0.0f ? x : 0.0f;
            sum += x * x;
        }
        float off = o + e[0][k] * s[0] + e[1][k] * s[1] + e[2][k] * s[2];
        off = (off < 0.0f ? -off : off) - s[4];
        off = off > 0.0f ? off * off : 0.0f;
        d[k] = (off > sum ? off : sum) - reach[k];
    }
    int hit = 0;
    for (int k = 0; k < 8; ++k) hit |= (d[k] < 0.0f ? 1 : 0) << k;
    return hit;
"""

UNITE = """
    const float* from = boxes.data + 48 * pack;
    float* b = boxes.data + 48 * (slot / 8) + slot % 8;
    for (int j = 0; j < 3; ++j) {
        float low = from[8 * j], high = from[24 + 8 * j];
        for (int k = 1; k < 8; ++k) {
            low = from[8 * j + k] < low ? from[8 * j + k] : low;
            high = from[24 + 8 * j + k] > high ? from[24 + 8 * j + k] : high;
        }
        b[8 * j] = low;
        b[24 + 8 * j] = high;
    }
"""


# A triangle without an area is an edge or a point: it gets some directions across, so that
# distances to it are right. Roots are taken in loops of their own; the others become single
# instructions.
ENTER = """
    const int* c = corners.data + 32 * leaf;
    float* r = shapes.data + 136 * leaf;
    float p[9][8], n[3][8], box[6][8], w[10][8];
    for (int k = 0; k < 8; ++k) {
        for (int j = 0; j < 3; ++j) {
            const float* v = &at.data[c[8 * j + k]][0];
            for (int i = 0; i < 3; ++i) p[3 * j + i][k] = v[i];
        }
    }
    const float* o = &at.data[corners.data[0]][0];
    for (int k = 0; k < 8; ++k) {
        const float ax = p[0][k], ay = p[1][k], az = p[2][k];
        const float ex = p[3][k] - ax, ey = p[4][k] - ay, ez = p[5][k] - az;
        const float wx = p[6][k] - ax, wy = p[7][k] - ay, wz = p[8][k] - az;
        const float side = (float)c[24 + k];
        n[0][k] = side * (ey * wz - ez * wy);
        n[1][k] = side * (ez * wx - ex * wz);
        n[2][k] = side * (ex * wy - ey * wx);
        const float e2 = ex * ex + ey * ey + ez * ez, w2 = wx * wx + wy * wy + wz * wz;
        const bool edge = e2 > 1e-24f, any = edge || w2 > 1e-24f;
        w[0][k] = any ? (edge ? ex : wx) : 1.0f;
        w[1][k] = any ? (edge ? ey : wy) : 0.0f;
        w[2][k] = any ? (edge ? ez : wz) : 0.0f;
        w[3][k] = edge ? e2 : (any ? w2 : 1.0f);
        w[4][k] = edge ? 1.0f : 0.0f;
        w[5][k] = any ? w2 : 0.0f;
        w[6][k] = wx;
        w[7][k] = wy;
        w[8][k] = wz;
    }
    for (int k = 0; k < 8; ++k) w[3][k] = sqrtf(w[3][k]);
    for (int k = 0; k < 8; ++k) {
        const float one = 1.0f / w[3][k], wx = w[6][k], wy = w[7][k], wz = w[8][k];
        const float ux = one * w[0][k], uy = one * w[1][k], uz = one * w[2][k];
        const float cx = wx * ux + wy * uy + wz * uz;
        const float vx = wx - cx * ux, vy = wy - cx * uy, vz = wz - cx * uz;
        const bool wide = vx * vx + vy * vy + vz * vz > 1e-10f * w[5][k] && w[5][k] > 0.0f;
        const bool steep = ux > -0.6f && ux < 0.6f;
        const float tilt = steep ? ux : uy;
        r[k] = p[0][k];
        r[8 + k] = p[1][k];
        r[16 + k] = p[2][k];
        r[24 + k] = ux;
        r[32 + k] = uy;
        r[40 + k] = uz;
        r[48 + k] = wide ? vx : (steep ? 1.0f : 0.0f) - tilt * ux;
        r[56 + k] = wide ? vy : (steep ? 0.0f : 1.0f) - tilt * uy;
        r[64 + k] = wide ? vz : -tilt * uz;
        r[96 + k] = w[4][k] * w[3][k];
        r[104 + k] = cx;
        w[5][k] = wide ? 1.0f : 0.0f;
    }
    for (int i = 0; i < 2; ++i) {
        for (int k = 0; k < 8; ++k) {
            const float ux = r[24 + k], uy = r[32 + k], uz = r[40 + k];
            const float along = r[48 + k] * ux + r[56 + k] * uy + r[64 + k] * uz;
            const float vx = r[48 + k] - along * ux, vy = r[56 + k] - along * uy;
            const float vz = r[64 + k] - along * uz;
            r[48 + k] = vx;
            r[56 + k] = vy;
            r[64 + k] = vz;
            w[9][k] = vx * vx + vy * vy + vz * vz;
        }
        for (int k = 0; k < 8; ++k) w[9][k] = sqrtf(w[9][k]);
        for (int k = 0; k < 8; ++k) {
            const float one = 1.0f / w[9][k];
            r[48 + k] *= one;
            r[56 + k] *= one;
            r[64 + k] *= one;
        }
    }
    for (int k = 0; k < 8; ++k) {
        const float ux = r[24 + k], uy = r[32 + k], uz = r[40 + k];
        const float vx = r[48 + k], vy = r[56 + k], vz = r[64 + k];
        const float cy = w[5][k] * (w[6][k] * vx + w[7][k] * vy + w[8][k] * vz);
        const float cx = r[104 + k], bx = cx - r[96 + k];
        const float c2 = cx * cx + cy * cy, b2 = bx * bx + cy * cy;
        r[72 + k] = uy * vz - uz * vy;
        r[80 + k] = uz * vx - ux * vz;
        r[88 + k] = ux * vy - uy * vx;
        r[112 + k] = cy;
        r[120 + k] = 1.0f / (c2 > 1e-30f ? c2 : 1e-30f);
        r[128 + k] = 1.0f / (b2 > 1e-30f ? b2 : 1e-30f);
    }
    float sum[4][8];
    for (int k = 0; k < 8; ++k) {
        for (int j = 0; j < 3; ++j) {
            float low = p[j][k], high = low;
            low = p[3 + j][k] < low ? p[3 + j][k] : low;
            high = p[3 + j][k] > high ? p[3 + j][k] : high;
            box[j][k] = p[6 + j][k] < low ? p[6 + j][k] : low;
            box[3 + j][k] = p[6 + j][k] > high ? p[6 + j][k] : high;
            sum[j][k] = n[j][k];
        }
        sum[3][k] = (p[0][k] - o[0]) * n[0][k] + (p[1][k] - o[1]) * n[1][k]
            + (p[2][k] - o[2]) * n[2][k];
    }
    for (int half = 4; half > 0; half /= 2) {
        for (int j = 0; j < 4; ++j)
            for (int k = 0; k < half; ++k) sum[j][k] += sum[j][k + half];
        for (int j = 0; j < 3; ++j) {
            for (int k = 0; k < half; ++k) {
                const float less = box[j][k + half], more = box[3 + j][k + half];
                box[j][k] = less < box[j][k] ? less : box[j][k];
                box[3 + j][k] = more > box[3 + j][k] ? more : box[3 + j][k];
            }
        }
    }
    float* b = boxes.data + 48 * (slot / 8) + slot % 8;
    for (int j = 0; j < 6; ++j) b[8 * j] = box[j][0];
    const float area = sum[0][0] * sum[0][0] + sum[1][0] * sum[1][0] + sum[2][0] * sum[2][0];
    const float unit = area > 1e-24f ? 1.0f / sqrtf(area) : 0.0f;
    const float x = unit * sum[0][0], y = unit * sum[1][0], z = unit * sum[2][0];
    float low[8], high[8];
    for (int k = 0; k < 8; ++k) {
        const float d = x * p[0][k] + y * p[1][k] + z * p[2][k];
        const float e = x * p[3][k] + y * p[4][k] + z * p[5][k];
        const float f = x * p[6][k] + y * p[7][k] + z * p[8][k];
        low[k] = d < e ? d : e;
        high[k] = d < e ? e : d;
        low[k] = f < low[k] ? f : low[k];
        high[k] = f > high[k] ? f : high[k];
    }
    for (int half = 4; half > 0; half /= 2) {
        for (int k = 0; k < half; ++k) {
            low[k] = low[k + half] < low[k] ? low[k + half] : low[k];
            high[k] = high[k + half] > high[k] ? high[k + half] : high[k];
        }
    }
    float* slab = slabs.data + 8 * leaf;
    slab[0] = x;
    slab[1] = y;
    slab[2] = z;
    slab[3] = 0.5f * (low[0] + high[0]);
    slab[4] = 0.5f * (high[0] - low[0]) + 0.002f;
    return sum[3][0];
"""


class Native:
    """What is written in C++."""

    @wp.func_native(TO_LEAF)
    def to_leaf(shapes: Floats, leaf: int, p: wp.vec3) -> float:
        """Squared distance from a point to the nearest of the triangles of a leaf."""

    @wp.func_native(LOOK)
    def look(shapes: Floats, leaf: int, low: wp.vec3, hit: int, known: Eight) -> Eight:
        """Lower what is known at some places of a block (the bits of `hit`) by a leaf."""

    @wp.func_native(EXPAND)
    def expand(
        boxes: Floats, pack: int, low: wp.vec3, high: wp.vec3, reach: float, stack: Ints, end: int
    ) -> int:
        """Put slots of a pack that are nearer to a box than `reach` on the stack; its new end."""

    @wp.func_native(REACHED)
    def reached(
        boxes: Floats, slabs: Floats, slot: int, leaf: int, low: wp.vec3, reach: Eight
    ) -> int:
        """Bit k: whether a leaf may be nearer to place k of a block than `reach`."""

    @wp.func_native(UNITE)
    def unite(boxes: Floats, pack: int, slot: int) -> None:
        """The box of a slot, from those of the pack of its children."""

    @wp.func_native(ENTER)
    def enter(
        corners: Ints,
        at: Points,
        leaf: int,
        slot: int,
        shapes: Floats,
        boxes: Floats,
        slabs: Floats,
    ) -> float:
        """Lay out a leaf (see `FaceTree.corners`), its box and slab; six times the volume below."""


to_leaf, look, expand = Native.to_leaf, Native.look, Native.expand
reached, unite, enter = Native.reached, Native.unite, Native.enter
