# pyright: basic, reportInvalidTypeForm=false
"""Where rays enter closed bodies and first leave them: one thread for each body and triangle."""

from typing import no_type_check

import warp as wp

from mover.geometry.kernels.spans import SLACK, TINY, Triangle, on_screen, signed_area, triangle

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
    """Raise the inverse depth of the run of one row."""
    y = float(row) + 0.5
    x = t.across.x + (y - t.across.y) * t.across.x_step
    q = t.across.q + (y - t.across.y) * t.across.q_step
    x2 = t.upper.x + (y - t.upper.y) * t.upper.x_step
    q2 = t.upper.q + (y - t.upper.y) * t.upper.q_step
    if y >= t.kink:
        x2 = t.lower.x + (y - t.lower.y) * t.lower.x_step
        q2 = t.lower.q + (y - t.lower.y) * t.lower.q_step
    wide = float(out.shape[2])
    low = wp.where(x < x2, x, x2) - 0.5
    high = wp.where(x < x2, x2, x) - 0.5
    first = wp.ceil(wp.where(low > 0.0, wp.where(low < wide, low, wide), 0.0))
    last = wp.floor(wp.where(high > -1.0, wp.where(high < wide, high, wide - 1.0), -1.0))
    if first <= last:
        span = x2 - x
        step = (q2 - q) * span / wp.max(span * span, TINY)
        q = q + (first + 0.5 - x) * step
        for i in range(int(last) - int(first) + 1):
            at = q + float(i) * step
            wp.atomic_max(out, item, row, int(first) + i, wp.where(at > TINY, at, TINY))


@wp.func
@no_type_check
def between(a: float, b: float, c: float, slack: float, size: int) -> bool:
    """Whether a pixel centre of a line of pixels is within the range of three places."""
    low = wp.where(a < b, a, b)
    high = wp.where(a < b, b, a)
    low = wp.where(c < low, c, low) - slack
    high = wp.where(c > high, c, high) + slack
    return wp.ceil(low - 0.5) <= wp.floor(high - 0.5) and high > 0.0 and low < float(size)


@wp.kernel
@no_type_check
def draw(
    screen: wp.array2d(dtype=wp.vec3),
    faces: wp.array(dtype=wp.vec3l),
    front: wp.array3d(dtype=wp.float32),
    leave: wp.array3d(dtype=wp.float32),
) -> None:
    """Inverse depth of the nearest triangles that face the camera, and that face away.

    Most triangles of a body are smaller than a pixel: these are left before anything is set up.
    """
    item, f = wp.tid()
    face = faces[f]
    a = screen[item, int(face[0])]
    b = screen[item, int(face[1])]
    c = screen[item, int(face[2])]
    if not between(a[1], b[1], c[1], 0.0, front.shape[1]):
        return
    if not between(a[0], b[0], c[0], SLACK, front.shape[2]):
        return
    area = signed_area(a, b, c)
    if area != 0.0:
        t = triangle(a, b, c, face, front.shape[1])
        for row in range(t.first, t.last + 1):
            if area < 0.0:
                fill(t, row, item, front)
            else:
                fill(t, row, item, leave)
