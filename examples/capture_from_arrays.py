"""A capture in memory, from plain arrays: python examples/capture_from_arrays.py.

A table that a detector saw in a picture of 320 x 240 pixels, with a first guess of where it stands.
"""

import numpy as np

from mover.core.types import Capture
from mover.furniture.library import make_piece
from mover.io.capture.arrays import ObjectArrays, capture_from_arrays


def make_capture() -> Capture:
    """One table, seen by a camera that is not levelled yet."""
    table = make_piece("table", np.random.default_rng(0), style=0).mesh  # +y up, +z front, metres
    mask = np.zeros((240, 320), dtype=bool)
    mask[128:176, 117:204] = True
    camera = {"w": 320, "h": 240, "fl_x": 250.0, "fl_y": 250.0, "cx": 160.0, "cy": 120.0}
    guess = ObjectArrays(
        id="table_0",
        category="dining table",
        vertices=table.verts,
        faces=table.faces,
        translation=(0.1, -1.4, -4.0),
        yaw=0.2,
        mask=mask,
    )
    return capture_from_arrays(camera, [guess], name="a table")


def main() -> Capture:
    """Make it and say what is in it."""
    capture = make_capture()
    for piece in capture.scene.objects:
        print(piece.id, piece.category, piece.t_world_object.tolist())
    for warning in capture.warnings:
        print("warning:", warning)
    return capture


if __name__ == "__main__":
    main()
