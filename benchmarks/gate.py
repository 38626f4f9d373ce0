"""Whether figures of quality are as good as the committed baseline; times only warn.

A figure is lower-is-better and may exceed the baseline by its tolerance. Energies of fixed inputs
are held from both sides, because a lower one also says that something else is computed.
"""

from collections.abc import Mapping
from typing import Any, NamedTuple

SLOWER = 1.5  # times the baseline, from where a warning is given

# The first name that a figure begins with says how much it may change, and why as much.
LIMITS = (
    ("energy at", 1e-5, "sums of single precision in another order; the same bits on one machine"),
    ("energy after", 1e-3, "what the issue calls an equal energy; 60 steps pass roundings on"),
    ("energy of two", 0.5, "a count of bits that differ: none may"),
    ("energy gradient", 1e-4, "single precision, where slopes of opposite signs cancel"),
    ("energy", 1e-5, "single precision, a few hundred roundings of 6e-8"),
    ("silhouette gradient", 1e-5, "as above, and 100 times less than the issue allows"),
    ("silhouette Warp - torch", 1e-5, "the issue's; crossings are placed in single precision"),
    ("silhouette Warp - DEODR eight", 1e-4, "a share of 1/64 at 100 pixels of an outline"),
    ("silhouette Warp - DEODR", 2e-4, "three more of 15,728 centres that lie on a side"),
    ("depth seen by one, Warp - torch", 0.5e-4, "half a pixel of a body: none may"),
    ("depth seen", 1e-4, "one pixel of a body whose ray touches the outline"),
    ("depth Warp - torch", 1e-5, "the issue's"),
    ("depth", 1e-5, "single precision at 5 m is 5e-7; a surface seen from the side multiplies it"),
    ("distance beyond", 0.5, "a count of places: none may"),
    ("distance", 1e-6, "single precision of coordinates in cells, at 2 m"),
    ("lookup gradient", 1e-4, "single precision of differences of neighbours"),
    ("lookup", 1e-6, "single precision of the place in its cell"),
    ("nearest", 1e-6, "which of two is nearer is decided in single precision"),
    ("gathering", 0.5, "a count of bits that differ: none may"),
)
BOTH = ("energy at", "energy after")  # held from both sides, relative to their value
EXTRA = ("DEODR", "Embree", "Open3D", "PyTorch3D")  # absent where these are


class Verdict(NamedTuple):
    """What a run says against the baseline."""

    failures: list[str]
    """Figures of quality that are worse, not finite or absent."""
    warnings: list[str]
    """Times that are much longer."""


def held(name: str, value: float) -> dict[str, Any]:
    """A figure as the baseline keeps it: with its tolerance, and why it is that."""
    tolerance, why = next((t, w) for start, t, w in LIMITS if name.startswith(start))
    both = name.startswith(BOTH)
    return {
        "value": value,
        "tolerance": tolerance * abs(value) if both else tolerance,
        "why": why,
        "both": both,
        "optional": any(tool in name for tool in EXTRA),
    }


def judge(
    quality: Mapping[str, float], times: Mapping[str, float], baseline: Mapping[str, Any]
) -> Verdict:
    """Compare figures with those of the baseline.

    Args:
        quality: Value of each figure, lower is better.
        times: Wall time of each row [ms].
        baseline: `quality`: what `held` gives of each figure; `times`: wall [ms] of each row.
    """
    failures, warnings = [], []
    for name, one in baseline["quality"].items():
        if name not in quality:
            if not one["optional"]:
                failures.append(f"{name}: not measured")
            continue
        off = quality[name] - one["value"]
        if not (abs(off) if one["both"] else off) <= one["tolerance"]:  # also where it is no number
            limit = f"{one['value']:.6g} and {one['tolerance']:.1g} more"
            failures.append(f"{name}: {quality[name]:.6g}, expected at most {limit} ({one['why']})")
    for name, spent in baseline["times"].items():
        if name in times and times[name] > SLOWER * spent["wall"]:
            warnings.append(f"{name}: {times[name]:.1f} ms, the baseline took {spent['wall']:.1f}")
    return Verdict(failures, warnings)
