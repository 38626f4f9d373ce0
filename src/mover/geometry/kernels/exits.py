# pyright: basic, reportInvalidTypeForm=false
"""Where rays enter closed bodies and first leave them: one thread for each body and triangle."""

from typing import no_type_check

import warp as wp

from ..raster_spans import TINY
from .spans import Triangle, on_screen, signed_area, triangle

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.kernel
@no_type_check
def project(
    verts: wp.array2d(dtype=wp.vec3),
    window: wp.array(dtype=wp.vec4),
    screen: wp.array2d(dtype=wp.vec3),
) -> None:
    """Vertices on the screen: column, row [px], inverse depth [1/m]."""
    item, v = wp.tid()
    screen[item, v] = on_screen(verts[item, v], window[item])


@wp.func
@no_type_check
def fill(t: Triangle, row: int, item: int, out: wp.array3d(dtype=wp.float32)) -> None:
    """Raise the inverse depth of the run of one row, as in `raster_spans.spans` and `zbuffer`."""
    y = float(row) + 0.5
    x = t.across.x + (y - t.across.y) * t.across.x_step
    q = t.across.q + (y - t.across.y) * t.across.q_step
    x2 = t.upper.x + (y - t.upper.y) * t.upper.x_step
    q2 = t.upper.q + (y - t.upper.y) * t.upper.q_step
    if y >= t.kink:
        x2 = t.lower.x + (y - t.lower.y) * t.lower.x_step
        q2 = t.lower.q + (y - t.lower.y) * t.lower.q_step
    wide = float(out.shape[2])
    first = wp.clamp(wp.ceil(wp.min(x, x2) - 0.5), 0.0, wide)
    last = wp.clamp(wp.floor(wp.max(x, x2) - 0.5), -1.0, wide - 1.0)
    if first <= last:
        span = x2 - x
        step = (q2 - q) * span / wp.max(span * span, TINY)
        q = q + (first + 0.5 - x) * step
        for i in range(int(last) - int(first) + 1):
            wp.atomic_max(out, item, row, int(first) + i, wp.max(q + float(i) * step, TINY))


@wp.kernel
@no_type_check
def draw(
    screen: wp.array2d(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3l),
    front: wp.array3d(dtype=wp.float32),
    leave: wp.array3d(dtype=wp.float32),
) -> None:
    """Inverse depth of the nearest triangles that face the camera, and that face away."""
    item, f = wp.tid()
    face = faces[f]
    a = screen[item, int(face[0])]
    b = screen[item, int(face[1])]
    c = screen[item, int(face[2])]
    area = signed_area(a, b, c)
    if area != 0.0:
        t = triangle(a, b, c, face, front.shape[1])
        for row in range(t.first, t.last + 1):
            if area < 0.0:
                fill(t, row, item, front)
            else:
                fill(t, row, item, leave)


@wp.kernel
@no_type_check
def depth(q: wp.array3d(dtype=wp.float32), nothing: float) -> None:
    """Depth [m] out of its inverse, in place; `nothing` where there is no surface."""
    item, row = wp.tid()
    for column in range(q.shape[2]):
        value = q[item, row, column]
        q[item, row, column] = wp.where(value > 0.0, 1.0 / value, nothing)
