"""Where rays enter closed bodies and first leave them: one thread for each body and triangle."""

import warp as wp

from mover.geometry.kernels.spans import TINY, Triangle, on_screen, run_of, signed_area, triangle

wp.set_module_options({"enable_backward": False, "fuse_fp": False})


@wp.kernel
def project(
    verts: wp.array2d(dtype=wp.vec3),
    window: wp.array(dtype=wp.vec4),
    screen: wp.array2d(dtype=wp.vec3),
) -> None:
    """Vertices on the screen: column, row [px], inverse depth [1/m]."""
    item, v = wp.tid()
    screen[item, v] = on_screen(verts[item, v], window[item])


@wp.func
def fill(t: Triangle, row: int, item: int, out: wp.array3d(dtype=wp.float32)) -> None:
    """Raise the inverse depth of the run of one row."""
    r = run_of(t, row, 0, out.shape[2])
    for i in range(r.count):
        at = r.q + float(i) * r.step
        wp.atomic_max(out, item, row, r.first + i, wp.where(at > TINY, at, TINY))


@wp.kernel
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
    t = triangle(a, b, c, face, wp.vec4i(0, front.shape[1], 0, front.shape[2]))
    area = float(0.0)
    if t.first <= t.last:
        area = signed_area(a, b, c)
    if area != 0.0:
        for row in range(t.first, t.last + 1):
            if area < 0.0:
                fill(t, row, item, front)
            else:
                fill(t, row, item, leave)
