# pyright: basic, reportInvalidTypeForm=false, reportReturnType=false
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

from typing import no_type_check

import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

Eight = wp.types.vector(length=8, dtype=wp.float32)
Floats = wp.array(dtype=wp.float32)
Ints = wp.array(dtype=wp.int32)

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


@no_type_check
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


to_leaf, look, expand = Native.to_leaf, Native.look, Native.expand
reached, unite = Native.reached, Native.unite
