"""Open HSI Rooms: versioned sets of known rooms, each made from its seeds alone.

A set is a way to make rooms, a way to spoil what is known of them, and the seeds that results are
reported on; settings are chosen on other seeds. Sets that differ in nothing but the noise have the
same rooms for the same seeds. The figures of the noise have their sources in `NoiseConfig`.
For the study of sensitivity one thing of the noise is changed: `rooms+scale=0.25` is the set
`rooms` with errors of 25 % in the sizes of the objects; rooms, people and all else stay the same.
"""

from dataclasses import dataclass, field, replace
from typing import Any

from mover.core.errors import InputError
from mover_bench.rooms.config import (
    ActConfig,
    NoiseConfig,
    PathConfig,
    PlanConfig,
    RoomConfig,
    Withheld,
)


@dataclass(frozen=True)
class RoomSet:
    """Rooms of one kind, with one kind of noise."""

    about: str
    """What it holds, in a sentence."""
    seeds: str
    """Held-out rooms, for results: `1000-1029`."""
    development: str
    """Rooms to choose settings on; none is held out."""
    room: RoomConfig = field(default_factory=RoomConfig)
    noise: NoiseConfig = field(default_factory=NoiseConfig)
    version: int = 1
    """Counts up whenever a room of the set changes."""
    exact: tuple[str, ...] = ()
    """What is given as it truly is, of `EXACT`."""
    withheld: Withheld | None = None
    """What no detector saw: `rooms.noise.without_support`."""
    paths: tuple[PathConfig, ...] = (PathConfig(),)
    """How the camera moves, one room after the other."""


_SMALL = RoomConfig(
    width=320,
    height=180,
    pieces=5,
    least_pieces=3,
    least_frames=40,
    most_frames=80,
    least_touches=1,
    least_pixels=60,
    stay=0.25,
    acts=ActConfig(tasks=2, walks=1),
)
_FREE = RoomConfig(
    least_frames=150,
    most_frames=250,
    least_touches=0,
    least_passing=0.25,
    acts=ActConfig(walks=12, apart=0.05),
)
_CROWDED = RoomConfig(
    pieces=14,
    least_pieces=9,
    least_frames=150,
    plan=PlanConfig(
        camera_height=(0.9, 1.25),
        look_down=(5.0, 9.0),
        field_of_view=(52.0, 58.0),
        visible=0.4,
        hidden=0.85,
        crowded=0.7,
        spacing=0.6,
        more=(
            ("chair", "around"), ("armchair", "facing"), ("stool", "facing"), ("bench", "facing"),
            ("cabinet", "wall"), ("coffee table", "facing"), ("nightstand", "wall"),
            ("office chair", "facing"),
        ),
    ),
)  # fmt: skip
_MOVED = RoomConfig(
    least_frames=80,
    most_frames=130,
    least_touches=1,
    stay=0.6,
    moved="put",
    acts=ActConfig(tasks=3, walks=1),
)
_HANDLED = replace(_MOVED, stay=0.4, acts=ActConfig(tasks=2, walks=1))
_LONG = RoomConfig(
    least_frames=300,
    most_frames=300,
    least_touches=4,
    stay=0.4,
    acts=ActConfig(tasks=16, rounds=3),
)
_DETECTED = NoiseConfig(
    object_masks=3,
    person_masks=4,
    missed_masks=0.08,
    leaks=0.25,
    missed=0.1,
    false=0.1,
    merged=0.05,
    wrong_class=0.08,
)
_UPSTREAM = NoiseConfig(
    foreign=1.0, warp=0.03,
    mask_head=28, mask_box=0.03, amodal=0.15, leaks=0.15, object_masks=0,
    mean_bodies=True, depth_bias=0.01, pose_bias=4.0, pose=4.0, pose_seconds=2.0,
    lens=0.055, distortion=0.02, things=8, grain=0.02,
    wobble=2.5, person_masks=0, missed_masks=0.04,
    missed=0.05, false=0.05,
)  # fmt: skip
_SLAM = PathConfig(shake=0.7, units=1.6, drift=0.01, drift_turn=0.5)
_MOVING = (
    replace(_SLAM, travel=0.8, turn=5.0, hand=0.01),
    replace(_SLAM, travel=0.1, turn=12.0, hand=0.01),
    replace(_SLAM, travel=0.05, turn=1.0, hand=0.015),
)
_MOVING_OFTEN = tuple(replace(path, views=0.4) for path in _MOVING)

SETS: dict[str, RoomSet] = {
    "mini": RoomSet(
        "Small pictures of little rooms with a short visit: a test that takes seconds.",
        "1000-1002", "100-101", _SMALL,
    ),
    "rooms": RoomSet(
        "A person uses the furniture of a room: the standard set.",
        "1000-1029", "100-129",
    ),
    "two": RoomSet(
        "Two people use one room.",
        "1000-1019", "100-129", RoomConfig(people=2),
    ),
    "free": RoomSet(
        "A person walks between the pieces and behind them and touches nothing but the floor.",
        "1000-1019", "100-129", _FREE,
    ),
    "wrong-shape": RoomSet(
        "The rooms of `rooms`; every mesh that is given is another piece of the same class.",
        "1000-1029", "100-129", noise=NoiseConfig(other_shapes=1.0),
    ),
    "clutter": RoomSet(
        "More furniture, seen by a lower and narrower camera: pieces hide each other and are cut"
        " by the border of the image.",
        "1000-1029", "100-129", _CROWDED,
    ),
    "detected": RoomSet(
        "The rooms of `rooms`; masks and boxes as a detector gives them, with objects missed,"
        " invented, run together and called by wrong names.",
        "1000-1029", "100-129", noise=_DETECTED,
    ),
    "upstream": RoomSet(
        "The rooms of `rooms` as today's tools would give them, all errors at once: foreign meshes,"
        " masks of a coarse head, mean bodies with biased poses, a guessed lens.",
        "1000-1029", "100-129", noise=_UPSTREAM,
    ),
    "long": RoomSet(
        "A minute in which a person uses many pieces, some of them repeatedly, each for a short"
        " time.",
        "1000-1009", "100-103", _LONG,
    ),
    "moved": RoomSet(
        "Two people use a room one after the other; between them a chair or a table is moved.",
        "1000-1029", "100-129", _MOVED,
    ),
    "unmoved": RoomSet(
        "The rooms of `moved`; the second visitor finds everything where it was.",
        "1000-1029", "100-129", replace(_MOVED, moved="stays"),
    ),
    "pushed": RoomSet(
        "A person pushes a chair or a table elsewhere with both hands.",
        "1000-1029", "100-129", replace(_HANDLED, moved="pushed"),
    ),
    "rolled": RoomSet(
        "A person sits on a chair, rolls elsewhere on it, and stands up there.",
        "1000-1029", "100-129", replace(_HANDLED, moved="rolled"),
    ),
    "withheld-seat": RoomSet(
        "The rooms of `rooms`; the seat that is used most is not in what is given.",
        "1000-1029", "100-129", withheld="seat",
    ),
    "withheld-step": RoomSet(
        "The rooms of `rooms` with a step on which somebody stands; it is not in what is given.",
        "1000-1029", "100-129", RoomConfig(support="step"), withheld="step",
    ),
    "withheld-table": RoomSet(
        "The rooms of `rooms` with people who work at a table with both hands; it is not in what is"
        " given.",
        "1000-1029", "100-129", RoomConfig(support="table"), withheld="table",
    ),
    "platform": RoomSet(
        "The rooms of `rooms`; a seat stands on a platform that people walk onto; what is given"
        " says that all stands on the ground.",
        "1000-1029", "100-129", RoomConfig(support="platform"),
    ),
    "moving-camera": RoomSet(
        "The rooms of `rooms` seen by a camera that is walked with, panned or held by hand; its"
        " path is as SLAM gives it, in a scale of its own and with a drift of 1 % of the way.",
        "1000-1029", "100-129", paths=_MOVING,
    ),
    "moving-views": RoomSet(
        "The rooms of `moving-camera`; the furniture is segmented in a frame every 4 s, too.",
        "1000-1029", "100-129", paths=tuple(replace(path, views=4.0) for path in _MOVING),
    ),
    "moving-moved": RoomSet(
        "The rooms of `moved` seen by the cameras of `moving-camera`; the furniture is segmented in"
        " every second frame.",
        "1000-1029", "100-129", _MOVED, paths=_MOVING_OFTEN,
    ),
    "moving-pushed": RoomSet(
        "The rooms of `pushed` seen by the cameras of `moving-moved`.",
        "1000-1029", "100-129", replace(_HANDLED, moved="pushed"), paths=_MOVING_OFTEN,
    ),
    "moving-rolled": RoomSet(
        "The rooms of `rolled` seen by the cameras of `moving-moved`.",
        "1000-1029", "100-129", replace(_HANDLED, moved="rolled"), paths=_MOVING_OFTEN,
    ),
}  # fmt: skip
"""All sets by name."""


# Sets without one kind of errors, for the study of what each costs: `upstream+no-shapes`.


SWITCHES: dict[str, tuple[str, ...]] = {
    "shapes": ("foreign", "warp"),
    "places": ("along_ray", "sideways", "scale"),
    "flips": ("flips",),
    "masks": ("mask_head", "mask_box", "amodal", "leaks", "object_masks"),
    "bodies": ("mean_bodies", "pose_bias", "pose"),
    "height": ("mean_bodies",),
    "lens": ("lens",),
    "picture": ("distortion", "things", "grain"),
    "people": ("wobble", "missed_masks"),
    "finds": ("missed", "false"),
}
"""Fields of `NoiseConfig` that are zero where an error is switched off, by its name."""
OFF = "no-"


def without(noise: NoiseConfig, error: str) -> NoiseConfig:
    """The noise with one kind of errors switched off."""
    off: dict[str, Any] = {name: type(getattr(noise, name))(0) for name in SWITCHES[error]}
    return replace(noise, **off)


@dataclass(frozen=True)
class Change:
    """An error of the input in growing sizes."""

    title: str
    unit: str
    fields: tuple[str, ...]
    """Of `NoiseConfig`: set to the level."""
    levels: tuple[float, ...]
    """Studied sizes; the first is no error of this kind."""
    without: tuple[str, ...] = ()
    """Fields that are zero, so that this error is the only one of its kind."""
    shown: float = 1.0
    """Factor from a level to the unit."""


CHANGES: dict[str, Change] = {
    "scale": Change("size of objects", "± %", ("scale",), (0.0, 0.05, 0.15, 0.25), shown=100),
    "place": Change(
        "place of objects", "± cm", ("sideways",), (0.0, 0.1, 0.2, 0.3), ("along_ray",), shown=100
    ),
    "turn": Change("orientation of objects", "± °", ("yaw",), (0.0, 15.0, 30.0, 45.0), ("flips",)),
    "focal": Change("focal length", "± %", ("focal",), (0.0, 0.025, 0.05), shown=100),
    "masks": Change("objects' masks", "± px", ("object_masks",), (0, 1, 3, 6)),
    "leaks": Change("objects' masks that leak", "%", ("leaks",), (0.0, 0.2, 0.4), shown=100),
    "people": Change("people's masks", "± px", ("person_masks",), (0, 3, 6)),
    "pose": Change("joints of bodies", "° (sd)", ("pose",), (0.0, 4.0, 8.0)),
    "depth": Change("depth of bodies", "± %", ("depth_bias",), (0.0, 0.03, 0.06), shown=100),
    "feet": Change("lost legs", "%", ("lost_feet",), (0.0, 0.2, 0.4), shown=100),
    "missed": Change("missed objects", "%", ("missed",), (0.0, 0.1, 0.2), shown=100),
}
"""By the name that stands in the name of a set."""
WHOLE = ("object_masks", "person_masks")  # fields that count pixels
EXACT: dict[str, tuple[str, ...]] = {
    "camera": ("camera", "focal"),
    "bodies": ("depth_bias", "depth_drift", "pose", "jitter", "dropped", "lost_feet"),
    "contacts": (),
    "masks": ("object_masks", "person_masks", "missed_masks", "leaks"),
}
"""What can be true, and the fields of `NoiseConfig` that are zero then: `rooms+exact=camera,masks`.

A true camera stays where it is, with the floor's height below it, and the true contacts of each
body are given as its own (`job.spoilt`). Initial scene and the rest of the noise stay as they are.
"""


def set_named(name: str) -> RoomSet:
    """A set of `SETS`, or one with another noise.

    `rooms+scale=0.25`, `rooms+exact=bodies`, `upstream+no-lens`.

    Raises:
        InputError: If there is none of this name.
    """
    base, plus, change = name.partition("+")
    if base not in SETS:
        raise InputError(f"--set: {base!r} is none of {', '.join(SETS)}")
    if not plus:
        return SETS[base]
    if change.startswith(OFF) and change.removeprefix(OFF) in SWITCHES:
        return replace(SETS[base], noise=without(SETS[base].noise, change.removeprefix(OFF)))
    kind, _, level = change.partition("=")
    if kind == "exact":
        return _exactly(SETS[base], name, tuple(level.split(",")))
    if kind not in CHANGES:
        known = f"{', '.join(CHANGES)}, exact"
        raise InputError(f"--set: {name!r} changes {kind!r}, expected one of {known}")
    try:
        size = float(level)
    except ValueError:
        raise InputError(f"--set: {name!r}, expected a number: {base}+{kind}=LEVEL") from None
    return replace(SETS[base], noise=changed(SETS[base].noise, CHANGES[kind], size))


def _exactly(base: RoomSet, name: str, exact: tuple[str, ...]) -> RoomSet:
    """A set of which some things are known as they truly are."""
    for word in exact:
        if word not in EXACT:
            known = ", ".join(EXACT)
            raise InputError(f"--set: {name!r} has {word!r} exact, expected some of {known}")
    zero: dict[str, Any] = {field: 0 for word in exact for field in EXACT[word]}
    return replace(base, noise=replace(base.noise, **zero), exact=exact)


def changed(noise: NoiseConfig, change: Change, level: float) -> NoiseConfig:
    """The noise with one kind of error of a given size."""
    values: dict[str, Any] = {
        name: round(level) if name in WHOLE else level for name in change.fields
    }
    return replace(noise, **values, **dict.fromkeys(change.without, 0.0))


def changed_set(base: str, kind: str, level: float) -> str:
    """Name of a changed set; the base itself where its noise is that already."""
    same = changed(SETS[base].noise, CHANGES[kind], level) == SETS[base].noise
    return base if same else f"{base}+{kind}={level:g}"
