"""How `fit` and `refine` weigh bodies: ours, and as the paper and PROX have it."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Literal

from mover.fitting.config import PUBLISHED, FitConfig

Preset = Literal["robust", "paper"]

PAPER = FitConfig(
    loose=0.0,
    left=0.0,
    limits=0.0,
    smooth_joints=1e2,
    smooth_pixels=1e-2,
    still=0.0,
    held=0.0,
    stands=0.0,
    lies=0.0,
    acceleration=0.0,
    jitter=1.0,
    by_size=False,
    alike=1_000_000,
    lasting=False,
    stages=tuple(replace(stage, smooth=1.0, steps=300) for stage in PUBLISHED[3:]),
)
"""SMPLify-X and L_smooth (Sec. 3.2), in the two stages that the authors' fit of videos runs.

With no acceleration and a jitter of 1 m a second difference is divided by 1: it is priced as
printed, by rho with sigma_2 = 0.1 m and sigma_3 = 100 px. lambda_smooth is not printed; here the
released code's 10^2 and 0.1^2. The printed pose prior is VPoser's: give its weights (`--vposer`).
"""

FITS: dict[Preset, FitConfig] = {"robust": FitConfig(), "paper": PAPER}
"""By name."""

PAPER_ROOM = replace(
    PAPER,
    stages=(
        replace(PAPER.stages[-1], under=1e4, feet=1e2),
        replace(PAPER.stages[-1], under=1e2, feet=1.0, sdf=40.0),
        replace(PAPER.stages[-1], under=1e2, feet=1.0, sdf=40.0, contact=1e3),
    ),
)
"""The refinement with the estimated room: `PAPER`, and the terms of `fitting.room` one by one.

The weights are printed nowhere: these are those of the authors' released configuration (its last
three stages; the feet's are those of its configuration for videos).
"""
ROOM_TERMS: Mapping[str, tuple[str, ...]] = {
    "camgp": ("under", "feet"), "sdf": ("sdf",), "contact": ("contact",),
}  # fmt: skip
"""The weights of a stage by the rows of the paper's table of bodies."""


def without(config: FitConfig, *rows: str) -> FitConfig:
    """The settings without some of the room's terms, see `ROOM_TERMS`."""
    zero = {name: 0.0 for row in rows for name in ROOM_TERMS[row]}
    return replace(config, stages=tuple(replace(stage, **zero) for stage in config.stages))


def at_most(config: FitConfig, steps: int) -> FitConfig:
    """The settings with so many iterations a stage at most; 0: as they are."""
    if not steps:
        return config
    stages = tuple(replace(stage, steps=min(stage.steps, steps)) for stage in config.stages)
    return replace(config, stages=stages)
