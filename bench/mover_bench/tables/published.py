"""Numbers that the paper prints: quoted beside our own, never computed here.

Source: Yi et al., "Human-Aware Object Placement for Visual Environment Reconstruction" (MOVER),
CVPR 2022, its tables and its supplement. Measured on PROX and PiGraphs, which cannot be shared, so
that they are not comparable with numbers on known rooms. None: not printed.
"""

from collections.abc import Mapping, Sequence

Values = tuple[float | None, ...]
Quoted = tuple[tuple[str, Mapping[str, float]], ...]
"""Labels of rows, and their numbers by column."""

SCENE_COLUMNS = ("iou3d", "p2s", "iou2d", "non_collision", "contact")
SCENE: Mapping[str, Values] = {
    "HolisticMesh, PointRend": (0.211, 0.410, 0.648, 0.990, 0.369),
    "Total3D, PointRend": (0.246, 0.319, 0.522, 0.974, 0.510),
    "MOVER, PointRend": (0.309, 0.221, 0.777, 0.977, 0.612),
    "HolisticMesh": (0.267, 0.237, 0.745, 0.988, 0.491),
    "Total3D": (0.196, 0.369, 0.227, 0.963, 0.440),
    "MOVER, camera": (0.374, 0.206, 0.859, 0.979, 0.738),
    "MOVER, camera, contact": (0.381, 0.205, 0.904, 0.980, 0.773),
    "MOVER, camera, depth": (0.393, 0.194, 0.907, 0.983, 0.638),
    "MOVER, camera, collision": (0.383, 0.199, 0.903, 0.984, 0.674),
    "MOVER, camera, contact, depth": (0.389, 0.199, 0.904, 0.983, 0.697),
    "MOVER": (0.383, 0.199, 0.898, 0.986, 0.673),
    "Cooperative, PiGraphs": (0.214, None, 0.686, None, None),
    "Holistic++, PiGraphs": (0.249, None, 0.751, None, None),
    "HolisticMesh, PiGraphs": (0.263, None, 0.756, None, None),
    "MOVER, PiGraphs": (0.278, None, 0.792, None, None),
}
"""PROX qualitative unless PiGraphs is named; annotated boxes and masks unless PointRend is."""

CAMERA_COLUMNS = (
    "pitch_error", "roll_error", "tilt",
    "ground_penetration_frequency", "ground_penetration_distance",
)  # fmt: skip
CAMERA: Mapping[str, Values] = {
    "Total3D": (0.059, 0.031, 0.045, 0.316, 0.167),
    "MOVER": (0.042, 0.034, 0.038, 0.100, 0.112),
}
"""PROX qualitative."""

BODY_COLUMNS = ("pje", "v2v", "p_pje", "p_v2v")
BODIES: Mapping[str, Values] = {
    "RGB, scanned scene": (0.22027, 0.21806, 0.07324, 0.06080),
    "PROX, scanned scene": (0.16708, 0.16651, 0.07197, 0.06114),
    "HolisticMesh": (0.19078, 0.19221, 0.07272, 0.06101),
    "MOVER, baseline": (0.21962, 0.22250, 0.07592, 0.06834),
    "MOVER, +CamGP": (0.17641, 0.18009, 0.07341, 0.06733),
    "MOVER, +CamGP+SDF": (0.17598, 0.17998, 0.07396, 0.06829),
    "MOVER, +CamGP+SDF+Contact": (0.17437, 0.17831, 0.07360, 0.06789),
}
"""PROX quantitative [m]."""

LENGTH: Mapping[str, Values] = {
    "10 s": (0.389, 0.018), "20 s": (0.395, 0.015), "30 s": (0.407, 0.010),
    "whole (51 s)": (0.424, None),
}  # fmt: skip
"""PROX qualitative: mean and standard deviation of IoU3D over ten segments a video."""

NOISE: Mapping[str, Mapping[float, float]] = {
    "scale": {0.0: 0.417, 0.05: 0.4105, 0.15: 0.3805, 0.25: 0.345},
    "place": {0.0: 0.417, 0.1: 0.415, 0.2: 0.416, 0.3: 0.4175},
    "turn": {0.0: 0.417, 15.0: 0.4205, 30.0: 0.418, 45.0: 0.4205},
}
"""One video: IoU3D with uniform noise on the initial scene. (Its table prints 0.05 % and 10 m where
5 % and 10 cm must be meant.)"""


def quoted(columns: Sequence[str], values: Mapping[str, Values]) -> Quoted:
    """What is printed of some rows."""
    return tuple(
        (label, {c: v for c, v in zip(columns, row, strict=True) if v is not None})
        for label, row in values.items()
    )
