"""The variants of an experiment: settings, and the part of a capture that they get."""

from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Int
from torch import Tensor

from mover.core.errors import InputError
from mover.core.records import rows_of
from mover.core.types import Bodies, Capture
from mover.pipeline.presets import PRESETS, READINGS, Config, literally
from mover.stages.config import LensConfig, SpreadConfig
from mover_bench.rooms.config import CHANGES

Given = Literal["all", "true contacts", "no contact", "no people"]
SEGMENTS = 10  # of each length, as in the paper
LENGTHS = (10, 20, 30)  # [s]
FRAMES = 5  # single frames whose results are averaged
TERMS = ("contact", "depth", "collision")  #: the terms of the people as the paper has them
NO_TERM = "no-term"  #: stands for none of them: the image alone, optimised once more


@dataclass(frozen=True)
class Cut:
    """Which part of a video is given."""

    seconds: float = 0.0  #: length of a segment [s]; 0: a single frame
    start: float = 0.0  #: where it starts: 0 as early, 1 as late as possible


@dataclass(frozen=True)
class Variant:
    """Settings, and what is withheld."""

    config: Config
    given: Given = "all"
    """What of the people is given: `true contacts`: also which skin touches something, without
    error; `no contact`: they touch nothing; `no people`: an image."""
    cut: Cut | None = None  #: part of the video; None: all of it
    change: str = ""  #: an error of the input in another size, such as `scale=0.25`
    refined: bool = False  #: the room refines the people before anything is measured
    row: str = ""
    """Row of the tables that is the mean over several variants; empty: the variant's own name."""


ROBUST = PRESETS["robust"]


def weighted(config: Config, **weights: float) -> Config:
    """Other weights of the people's terms in stage 2."""
    place = config.place
    return replace(config, place=replace(place, weights=replace(place.weights, **weights)))


def with_terms(config: Config, *names: str) -> Variant:
    """Settings whose second stage has only these terms of the people (Tab. 2)."""
    off = {term: 0.0 for term in TERMS if term not in names}
    off |= {} if "contact" in names else {"heading": 0.0}
    return Variant(weighted(config, **off), "all" if "contact" in names else "no contact")


def _subsets(preset: str, prefix: str) -> dict[str, Variant]:
    """A preset with each proper subset of the people's terms."""
    subsets = [(), *((t,) for t in TERMS), TERMS[:2], TERMS[::2], TERMS[1:]]
    names = [prefix + ("-".join(subset) or NO_TERM) for subset in subsets]
    return {n: with_terms(PRESETS[preset], *s) for n, s in zip(names, subsets, strict=True)}


NO_WALLS = {s: replace(getattr(ROBUST, s), walls=False) for s in ("layout", "place")}
NOT_GIVEN = replace(ROBUST.layout, weights=replace(ROBUST.layout.weights, given=0.0))
LISTS: dict[str, dict[str, Variant]] = {
    "ablation": {
        "robust": Variant(ROBUST),
        "no-people": Variant(ROBUST, "no people"),
        **{
            f"frame-{k}": Variant(ROBUST, cut=Cut(start=(k + 0.5) / FRAMES), row="one frame")
            for k in range(FRAMES)
        },
        **_subsets("robust", ""),
        "refined-people": Variant(ROBUST, refined=True),
    },
    "terms": {"paper": Variant(PRESETS["paper"]), **_subsets("paper", "paper-")},
    "presets": {
        "robust": Variant(ROBUST),
        NO_TERM: with_terms(ROBUST),
        "paper": Variant(PRESETS["paper"]),
        f"paper-{NO_TERM}": with_terms(PRESETS["paper"]),
        "true-contacts": Variant(PRESETS["paper"], "true contacts"),
        f"true-contacts-{NO_TERM}": replace(with_terms(PRESETS["paper"]), given="true contacts"),
        "printed": Variant(PRESETS["printed"]),
        f"printed-{NO_TERM}": with_terms(PRESETS["printed"]),
    },
    "readings": {
        "paper": Variant(PRESETS["paper"]),
        "printed": Variant(PRESETS["printed"]),
        **{f"literal {name}": Variant(literally(PRESETS["paper"], name)) for name in READINGS},
    },
    "parts": {
        "robust": Variant(ROBUST),
        "no-refined-camera": Variant(replace(ROBUST, refine=replace(ROBUST.refine, rounds=0))),
        "no-yaw-starts": Variant(replace(ROBUST, layout=replace(ROBUST.layout, yaws=1))),
        "no-second-pass": Variant(replace(ROBUST, outer_iterations=0)),
        "no-walls": Variant(replace(ROBUST, **NO_WALLS)),
        "no-learnt-sizes": Variant(replace(ROBUST, sizes=SpreadConfig())),
        "no-given": Variant(weighted(replace(ROBUST, layout=NOT_GIVEN), given=0.0)),
        "no-lens": Variant(replace(ROBUST, lens=LensConfig())),
        "no-scale": Variant(replace(ROBUST, height_spread=0.0)),
        "no-seat-heights": Variant(replace(ROBUST, seat_heights=False)),
    },
    "length": {
        "robust": Variant(ROBUST),
        **{
            f"{s}s-{k}": Variant(ROBUST, cut=Cut(s, (k + 0.5) / SEGMENTS), row=f"{s} s")
            for s in LENGTHS
            for k in range(SEGMENTS)
        },
    },
    "sensitivity": {
        "robust": Variant(ROBUST),
        **{
            change: Variant(ROBUST, change=change)
            for name, error in CHANGES.items()
            for change in (f"{name}={level:g}" for level in error.levels)
        },
    },
}
"""Lists of variants by name: the paper's tables, and `robust` without what it adds to the paper."""
VARIANTS: dict[str, Variant] = {
    **{name: Variant(config) for name, config in PRESETS.items()},
    **{name: variant for some in LISTS.values() for name, variant in some.items()},
}
"""All variants by name."""


def names_in(asked: tuple[str, ...]) -> tuple[str, ...]:
    """The variants that are asked for by name or by the name of a list, each once.

    Raises:
        InputError: If there is none of a name.
    """
    for name in asked:
        if name not in VARIANTS and name not in LISTS:
            known = [n for n, variant in VARIANTS.items() if not variant.row and not variant.change]
            raise InputError(f"--variants: {name!r} is none of {', '.join([*LISTS, *known])}")
    return tuple(dict.fromkeys(n for name in asked for n in LISTS.get(name, (name,))))


def at_most(variant: Variant, steps: int) -> Variant:
    """The same with at most so many steps of each descent; 0: as it is."""
    config = variant.config
    stages = {"layout": config.layout, "place": config.place}
    fewer = {
        name: replace(one, method=replace(one.method, steps=min(one.method.steps, steps)))
        for name, one in stages.items()
    }
    return replace(variant, config=replace(config, **fewer)) if steps else variant


def withheld(capture: Capture, given: Given, cut: Cut | None) -> Capture:
    """The capture as a variant gets it: a part of the video, no contacts, no people."""
    if capture.bodies is None:
        return capture
    if given == "no people":
        return replace(capture, bodies=None, people=None, touch=None)
    if cut is not None:
        capture = shortened(capture, frames_of(capture.bodies, cut))
    if given == "no contact" and capture.bodies is not None:
        return replace(capture, touch=torch.zeros(capture.bodies.verts.shape[:2]))
    return capture


def frames_of(bodies: Bodies, cut: Cut) -> Int[Tensor, " frames"]:
    """The frames of a part of a video, ascending."""
    frames = bodies.frame.unique()
    if not cut.seconds or bodies.fps is None:
        return frames[[round(cut.start * (len(frames) - 1))]]
    first, whole = int(frames.amin()), int(frames.amax() - frames.amin()) + 1
    count = min(whole, round(cut.seconds * bodies.fps))
    begin = first + round(cut.start * (whole - count))
    return torch.arange(begin, begin + count)


def shortened(capture: Capture, frames: Int[Tensor, " frames"]) -> Capture:
    """Only what is known of these frames, where there may be no person; the still image stays."""
    bodies, people, touch = capture.bodies, capture.people, capture.touch
    if bodies is not None:
        keep = torch.isin(bodies.frame, frames)
        if not keep.any():
            return replace(capture, bodies=None, people=None, touch=None)
        bodies, touch = rows_of(bodies, keep), None if touch is None else touch[keep]
    if people is not None:
        people = rows_of(people, torch.isin(people.frame, frames))
    return replace(capture, bodies=bodies, people=people, touch=touch)
