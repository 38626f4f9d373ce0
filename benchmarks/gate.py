"""Whether figures of quality are as good as the committed baseline; times only warn.

A figure is lower-is-better. It may exceed the baseline by the tolerance that the baseline states.
"""

from collections.abc import Mapping
from typing import NamedTuple

SLOWER = 1.5  # times the baseline, from where a warning is given


class Verdict(NamedTuple):
    """What a run says against the baseline."""

    failures: list[str]
    """Figures of quality that are worse, not finite or absent."""
    warnings: list[str]
    """Times that are much longer."""


def judge(
    quality: Mapping[str, float],
    times: Mapping[str, float],
    baseline: Mapping[str, Mapping[str, Mapping[str, float]]],
) -> Verdict:
    """Compare figures with those of the baseline.

    Args:
        quality: Value of each figure, lower is better.
        times: Wall time of each row [ms].
        baseline: `quality`: value and tolerance of each figure; `times`: wall [ms] of each row.
    """
    failures, warnings = [], []
    for name, held in baseline["quality"].items():
        if name not in quality:
            if not held.get("optional"):
                failures.append(f"{name}: not measured")
            continue
        limit = held["value"] + held["tolerance"]
        if not quality[name] <= limit:  # also where it is not a number
            failures.append(f"{name}: {quality[name]:.3g}, expected at most {limit:.3g}")
    for name, held in baseline["times"].items():
        if name in times and times[name] > SLOWER * held["wall"]:
            warnings.append(f"{name}: {times[name]:.1f} ms, the baseline took {held['wall']:.1f}")
    return Verdict(failures, warnings)
