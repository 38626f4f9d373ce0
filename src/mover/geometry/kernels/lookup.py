"""Warp kernel of the trilinear lookup in a volume, with its gradient."""

import warp as wp

wp.set_module_options({"enable_backward": False, "fuse_fp": False})

BRICK = wp.constant(3)  # bits: side of the bricks that are known to be constant, see `Volume.busy`


@wp.struct
class Field:
    """A volume and the bricks in which it changes."""

    values: wp.array3d(dtype=wp.float32)
    busy: wp.array3d(dtype=wp.uint8)
    origin: wp.vec3
    cell: float


@wp.func
def interpolate(f: Field, at: wp.vec3i, t: wp.vec3) -> wp.vec4:
    """Change with x, y and z [per cell], and the value, at the fraction `t` of a cell."""
    x = at[0]
    y = at[1]
    z = at[2]
    v00 = f.values[x, y, z]
    v01 = f.values[x, y + 1, z]
    v10 = f.values[x + 1, y, z]
    v11 = f.values[x + 1, y + 1, z]
    d00 = f.values[x, y, z + 1] - v00
    d01 = f.values[x, y + 1, z + 1] - v01
    d10 = f.values[x + 1, y, z + 1] - v10
    d11 = f.values[x + 1, y + 1, z + 1] - v11
    e0 = v00 + d00 * t[2]
    e1 = v10 + d10 * t[2]
    dy0 = v01 + d01 * t[2] - e0
    dy1 = v11 + d11 * t[2] - e1
    f0 = e0 + dy0 * t[1]
    f1 = e1 + dy1 * t[1]
    dz0 = d00 + (d01 - d00) * t[1]
    dz1 = d10 + (d11 - d10) * t[1]
    return wp.vec4(
        f1 - f0, dy0 + (dy1 - dy0) * t[0], dz0 + (dz1 - dz0) * t[0], f0 + (f1 - f0) * t[0]
    )


@wp.kernel
def lookup(
    f: Field,
    points: wp.array(dtype=wp.vec3),
    found: wp.array(dtype=wp.float32),
    slope: wp.array(dtype=wp.vec3),
) -> None:
    """Value [m] and gradient [1] at world points; outside as in `volume.sample`."""
    i = wp.tid()
    p = (points[i] - f.origin) / f.cell
    at = wp.vec3i()
    t = wp.vec3()
    inside = bool(True)
    for k in range(3):
        top = float(f.values.shape[k] - 1)
        inside = inside and p[k] >= 0.0 and p[k] <= top
        q = wp.where(p[k] > 0.0, wp.min(p[k], top), 0.0)
        at[k] = wp.min(int(q), f.values.shape[k] - 2)
        t[k] = q - float(at[k])
    if f.busy[at[0] >> BRICK, at[1] >> BRICK, at[2] >> BRICK] == wp.uint8(0):
        value = f.values[at[0], at[1], at[2]]
        found[i] = wp.where(inside, value, wp.max(value, 0.0))
        slope[i] = wp.vec3(0.0, 0.0, 0.0)
        return
    r = interpolate(f, at, t)
    if inside:
        found[i] = r[3]
        slope[i] = wp.vec3(r[0], r[1], r[2]) / f.cell
    else:
        found[i] = wp.max(r[3], 0.0)
        slope[i] = wp.vec3(0.0, 0.0, 0.0)
