"""Kernels that a machine has not yet, compiled by a process beside the first stages."""

import subprocess
import sys

from mover.app.batch import cores

GEOMETRY, FUSED = "mover.geometry.kernels", "mover.energy.fused.kernels"
KERNELS = (
    ("cost", FUSED),
    ("bodies", GEOMETRY),
    ("lower", GEOMETRY),
    ("nearest", GEOMETRY),
    ("lookup", GEOMETRY),
    ("farthest", GEOMETRY),
)
"""What takes seconds and is not needed at once; the first is needed by every run."""
_beside: list["subprocess.Popen[bytes]"] = []


def compile_beside() -> None:
    """Start that process where the first kernel is missing and there is a second core."""
    from mover.geometry.warp_start import is_compiled

    if _beside or cores() < 2 or is_compiled(KERNELS[0][0], "cpu", KERNELS[0][1]):
        return
    words = [sys.executable, "-c", f"from {__name__} import compile_all; compile_all()"]
    none = subprocess.DEVNULL
    _beside.append(subprocess.Popen(words, stdin=none, stdout=none, stderr=none))


def compile_all() -> None:
    """Compile what is missing into Warp's cache."""
    from mover.geometry.warp_start import kernels

    for name, package in KERNELS:
        kernels(name, "cpu", package)
