"""What a room is rebuilt with: a preset, a preset without one of its parts, or less evidence.

A job has the name of a variant. Variants of one room share its finished stages, so that only what
differs is computed anew. What of a capture a variant is not given is withheld here as well.
"""

from dataclasses import dataclass, replace
from typing import Literal

import torch
from jaxtyping import Int
from torch import Tensor

from mover.core.records import rows_of
from mover.core.types import Bodies, Capture
from mover.energy.config import Adam
from mover.pipeline.presets import PRESETS, Config, with_sizes
from mover.stages.camera.config import LensConfig
from mover.stages.config import AssignConfig, SpreadConfig

Hears = Literal["all", "no contact", "nobody"]
SEGMENTS = 10  # of each length, as in the paper
LENGTHS = (10, 20, 30)  # [s]
FRAMES = 5  # single frames whose results are averaged
SHARES = (0.125, 0.25, 0.5, 1.0)  # of the video, for the time
HIDDEN = (
    "frame-",
    "s-",
    "time-",
    "people-",
    "fitted-",
)  # names of variants that tables put together


@dataclass(frozen=True)
class Cut:
    """Which part of a video is given."""

    seconds: float = 0.0
    """Length of a segment [s]; 0: see `share`."""
    share: float = 0.0
    """Part of the frames, from the first one; 0: a single frame."""
    place: float = 0.0
    """Where it begins: 0 as early, 1 as late as possible."""


@dataclass(frozen=True)
class Variant:
    """Settings, and what is withheld."""

    config: Config
    hears: Hears = "all"
    """What of the people is told: `no contact`: nobody touches anything; `nobody`: an image."""
    cut: Cut | None = None
    """Part of the video; None: all of it."""
    bodies: str = ""
    """People refined afterwards: a row of the paper's table of bodies; empty: they are not."""
    fitted: str = ""
    """People fitted to keypoints, and again in the room: a row of that table; empty: no."""
    simulated: bool = False
    """Gravity acts on the furniture: only whether it stays is measured."""
    refined: bool = False
    """The room refines the people before anything is measured."""
    fresh: bool = False
    """Nothing is taken from stages that other variants have finished: it is timed."""


ROBUST = PRESETS["robust"]


def weighed(config: Config, **weights: float) -> Config:
    """Other weights of the people's evidence in stage 2."""
    return replace(
        config, place=replace(config.place, weights=replace(config.place.weights, **weights))
    )


def relaxed(config: Config, factor: float = 0.1) -> Config:
    """A weaker prior on the sizes of objects in all stages, the same in all rooms."""
    return replace(with_sizes(config, factor, factor), sizes=SpreadConfig())


def _far(config: Config) -> Config:
    """Without the prior on distances."""
    layout = replace(config.layout, weights=replace(config.layout.weights, distance=0.0))
    return weighed(replace(config, layout=layout), distance=0.0)


def _unlined(config: Config) -> Config:
    """Without the lines along which furniture stands."""
    layout = replace(config.layout, wall_alignment_steps=0)
    place = replace(config.place, wall_alignment_steps=0)
    return replace(config, layout=layout, place=place)


def kind_inputs(config: Config) -> Config:
    """Without what is meant for the inputs of today's tools, as `robust` was before."""
    layout = replace(config.layout, weights=replace(config.layout.weights, given=0.0))
    prepare = replace(config.prepare, level_feet=False)
    image = replace(config.image, bounded=False)
    kind = replace(config, layout=layout, prepare=prepare, image=image, height_spread=0.0)
    return weighed(replace(kind, lens=LensConfig()), given=0.0)


_SILENT = {"contact": 0.0, "heading": 0.0}
TERMS: dict[str, Variant] = {
    "again-alone": Variant(weighed(ROBUST, depth=0.0, collision=0.0, **_SILENT), "no contact"),
    "contact": Variant(weighed(ROBUST, depth=0.0, collision=0.0)),
    "depth": Variant(weighed(ROBUST, collision=0.0, **_SILENT), "no contact"),
    "collision": Variant(weighed(ROBUST, depth=0.0, **_SILENT), "no contact"),
    "contact-depth": Variant(weighed(ROBUST, collision=0.0)),
    "contact-collision": Variant(weighed(ROBUST, depth=0.0)),
    "depth-collision": Variant(weighed(ROBUST, **_SILENT), "no contact"),
}
"""The paper's ablation: which terms of the people are on, under the same camera."""

HUMAN = ("contact", "depth", "collision")
"""The terms of the people as the paper has them."""
NO_TERM = "nothing"
"""Stands for none of them: the image alone for as many steps more."""


def lone_term(preset: str, name: str) -> Variant:
    """A preset whose second stage has one term of the people, or none."""
    config = PRESETS[preset]
    weights = config.place.weights
    silent = {term: 0.0 for term in HUMAN if term != name}
    silent |= {} if name == "contact" else {"heading": 0.0}
    place = replace(config.place, weights=replace(weights, **silent))
    return Variant(replace(config, place=place), "all" if name == "contact" else "no contact")


ALONE: dict[str, Variant] = {
    f"{preset}-{name}": lone_term(preset, name)
    for preset in ("paper",)
    for name in (*HUMAN, NO_TERM)
}
"""`paper` with one term of the people, or none."""

_FEET = replace(ROBUST, refine=replace(ROBUST.refine, rounds=0))
PARTS: dict[str, Variant] = {
    "no-refined-camera": Variant(_FEET),
    "paper-camera": Variant(replace(_FEET, align=PRESETS["paper"].align)),
    "no-yaw-starts": Variant(replace(ROBUST, layout=replace(ROBUST.layout, yaws=1))),
    "no-second-pass": Variant(replace(ROBUST, outer_iterations=0)),
    "no-depth-factor": Variant(replace(ROBUST, correct_depth=False)),
    "no-distance": Variant(_far(ROBUST)),
    "no-heading": Variant(weighed(ROBUST, heading=0.0)),
    "no-walls": Variant(_unlined(ROBUST)),
    "no-learnt-sizes": Variant(replace(ROBUST, sizes=SpreadConfig())),
    "no-trust": Variant(replace(ROBUST, silhouette_confidence=False)),
    "no-slide": Variant(replace(ROBUST, slide_to_floor=False)),
    "no-groups": Variant(replace(ROBUST, assign=AssignConfig())),
}
"""`robust` without one of the parts that it adds to the paper."""

TOOLS: dict[str, Variant] = {
    "no-given": Variant(kind_inputs(ROBUST)),
    "no-lens": Variant(replace(ROBUST, lens=LensConfig())),
    "no-scale": Variant(replace(ROBUST, height_spread=0.0)),
    "no-seats": Variant(replace(ROBUST, seat_heights=False)),
    "no-turns": Variant(replace(ROBUST, turn_to_people=False)),
    "no-bending": Variant(replace(ROBUST, shape="keep")),
    "no-level-feet": Variant(replace(ROBUST, prepare=replace(ROBUST.prepare, level_feet=False))),
    "no-bounded-sides": Variant(replace(ROBUST, image=replace(ROBUST.image, bounded=False))),
}
"""`robust` without all that is meant for the inputs of today's tools, and without parts of it."""

NOBODY: dict[str, Variant] = {"nobody": Variant(ROBUST, "nobody")}
SINGLE: dict[str, Variant] = {
    f"frame-{k}": Variant(ROBUST, cut=Cut(place=(k + 0.5) / FRAMES)) for k in range(FRAMES)
}
"""One frame with its people, as methods do that do not accumulate."""
SEGMENT: dict[str, Variant] = {
    f"{s}s-{k}": Variant(ROBUST, cut=Cut(s, place=(k + 0.5) / SEGMENTS))
    for s in LENGTHS
    for k in range(SEGMENTS)
}
"""Segments of a video, evenly spread over it."""
TIMED: dict[str, Variant] = {
    f"time-{share:g}": Variant(ROBUST, cut=Cut(share=share), fresh=True) for share in SHARES
}
RELAXED: dict[str, Variant] = {"relaxed-scale": Variant(relaxed(ROBUST))}
PEOPLE: dict[str, Variant] = {
    f"people-{name}": Variant(ROBUST, bodies=row)
    for name, row in {
        "given": "given", "baseline": "baseline", "camgp": "+CamGP", "sdf": "+CamGP+SDF",
        "contact": "+CamGP+SDF+Contact", "order": "all", "true-given": "true given",
        "true-room": "true room",
    }.items()
}  # fmt: skip
"""The people after the room is known; the last two in the true room."""
UNREFINED: dict[str, Variant] = {
    "people-in-room": Variant(ROBUST, bodies="in room"),
    "people-true": Variant(ROBUST, bodies="true people"),
}
"""The people as they are in the room that was found, and the true ones."""

STANDS: dict[str, Variant] = {"stands": Variant(ROBUST, simulated=True)}
"""Whether what `robust` finds stays under gravity."""

FITTED: dict[str, Variant] = {
    f"fitted-{row.replace(' ', '-')}": Variant(PRESETS["paper"], fitted=row)
    for row in ("baseline", "camgp", "sdf", "contact", "robust", "true room")
}
"""The paper's chain: keypoints, fit, room, refinement (`studies.fitted`)."""
REFINED: dict[str, Variant] = {"refined-people": Variant(ROBUST, refined=True)}

VARIANTS: dict[str, Variant] = {
    **{name: Variant(config) for name, config in PRESETS.items()},
    **TERMS, **ALONE, **PARTS, **TOOLS, **NOBODY, **RELAXED, **REFINED, **SINGLE, **SEGMENT,
    **TIMED, **STANDS, **PEOPLE, **UNREFINED, **FITTED,
}  # fmt: skip
"""By the name of the job."""


def is_variant(name: str) -> bool:
    """Whether `variant_named` knows it."""
    base, at, steps = name.partition("@")
    return base in VARIANTS and (not at or (steps.isascii() and steps.isdigit()))


def variant_named(name: str) -> Variant:
    """A variant; `paper-depth@600` is `paper-depth` with 600 steps of the last descent."""
    base, _, steps = name.partition("@")
    variant = VARIANTS[base]
    method = variant.config.place.method
    if not steps or not isinstance(method, Adam):
        return variant
    place = replace(variant.config.place, method=replace(method, steps=int(steps)))
    return replace(variant, config=replace(variant.config, place=place))


def choices() -> str:
    """The names that one would type."""
    return ", ".join(name for name in VARIANTS if not any(part in name for part in HIDDEN))


# What a variant is given of a capture: a part of the video, people without contacts, nobody.


def withheld(capture: Capture, hears: Hears, cut: Cut | None) -> Capture:
    """The capture as a variant gets it."""
    if capture.bodies is None:
        return capture
    if hears == "nobody":
        return replace(capture, bodies=None, people=None, touch=None)
    if cut is not None:
        capture = shortened(capture, frames_of(capture.bodies, cut))
    if hears == "no contact":
        assert capture.bodies is not None
        return replace(capture, touch=torch.zeros(capture.bodies.verts.shape[:2]))
    return capture


def frames_of(bodies: Bodies, cut: Cut) -> Int[Tensor, " frames"]:
    """The frames of a part of a video, ascending."""
    seen = bodies.frame.unique()
    first, last = int(seen.amin()), int(seen.amax())
    whole = last - first + 1
    if cut.seconds and bodies.fps is not None:
        count = min(whole, round(cut.seconds * bodies.fps))
    elif cut.share:
        count = max(1, round(cut.share * whole))
    else:
        return seen[[round(cut.place * (len(seen) - 1))]]
    begin = first + round(cut.place * (whole - count))
    return torch.arange(begin, begin + count)


def shortened(capture: Capture, frames: Int[Tensor, " frames"]) -> Capture:
    """Only what is known of these frames, where there may be nobody; the still image stays."""
    bodies, people, touch = capture.bodies, capture.people, capture.touch
    if bodies is not None:
        keep = torch.isin(bodies.frame, frames)
        if not keep.any():
            return replace(capture, bodies=None, people=None, touch=None)
        bodies, touch = rows_of(bodies, keep), None if touch is None else touch[keep]
    if people is not None:
        people = rows_of(people, torch.isin(people.frame, frames))
    return replace(capture, bodies=bodies, people=people, touch=touch)
