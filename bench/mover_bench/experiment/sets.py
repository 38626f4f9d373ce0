"""Versioned sets of known rooms, each made from its seeds alone.

A set is a way to make rooms, a way to disturb what is known of them, and the seeds that results are
reported on; settings are chosen on other seeds. Sets that differ in nothing but the noise have the
same rooms for the same seeds. The figures of the noise have their sources in `NoiseConfig`.
"""

from dataclasses import dataclass, field, replace
from typing import Any, Literal

from mover.core.errors import InputError
from mover_bench.rooms.config import ActConfig, NoiseConfig, PathConfig, PlanConfig, RoomConfig


@dataclass(frozen=True)
class RoomSet:
    """Rooms of one kind, with one kind of noise."""

    about: str  #: what it holds, in a sentence
    room: RoomConfig = field(default_factory=RoomConfig)
    noise: NoiseConfig = field(default_factory=NoiseConfig)
    seeds: str = "1000-1029"  #: held-out rooms, for results
    development: str = "100-129"  #: rooms to choose settings on; none is held out
    withheld: Literal["seat"] | None = None  #: what no detector saw: `rooms.noise.without_seat`
    paths: tuple[PathConfig, ...] = (PathConfig(),)
    """How the camera moves, one room after the other."""


_SMALL = RoomConfig(
    width=320, height=180, pieces=5, least_pieces=3, least_frames=40, most_frames=80,
    least_touches=1, least_pixels=60, stay=0.25, acts=ActConfig(tasks=2, walks=1),
)  # fmt: skip
_CROWDED = RoomConfig(
    pieces=14, least_pieces=9, least_frames=150,
    plan=PlanConfig(
        camera_height=(0.9, 1.25), look_down=(5.0, 9.0), field_of_view=(52.0, 58.0), visible=0.4,
        hidden=0.85, crowded=0.7, spacing=0.6,
        more=(
            ("chair", "around"), ("armchair", "facing"), ("stool", "facing"), ("bench", "facing"),
            ("cabinet", "wall"), ("coffee table", "facing"), ("nightstand", "wall"),
            ("office chair", "facing"),
        ),
    ),
)  # fmt: skip
_MOVED = RoomConfig(
    least_frames=80, most_frames=130, least_touches=1, stay=0.6, moved=True,
    acts=ActConfig(tasks=3, walks=1),
)  # fmt: skip
_DETECTED = NoiseConfig(
    object_masks=3, person_masks=4, missed_masks=0.08, leaks=0.25, missed=0.1, false=0.1,
    merged=0.05, wrong_class=0.08,
)  # fmt: skip
_UPSTREAM = NoiseConfig(
    foreign=1.0, warp=0.03,
    mask_head=28, mask_box=0.03, amodal=0.15, leaks=0.15, object_masks=0,
    mean_bodies=True, depth_bias=0.01, pose_bias=4.0, pose=4.0, pose_seconds=2.0,
    lens=0.055, distortion=0.02, things=8, grain=0.02,
    wobble=2.5, person_masks=0, missed_masks=0.04,
    missed=0.05, false=0.05,
)  # fmt: skip
_SLAM = PathConfig(shake=0.7, units=1.6, drift=0.01, drift_turn=0.5)

SETS: dict[str, RoomSet] = {
    "mini": RoomSet(
        "Small pictures of little rooms with a short visit: a test that takes seconds.",
        _SMALL, seeds="1000-1002", development="100-101"),
    "rooms": RoomSet("A person uses the furniture of a room: the standard set."),
    "two": RoomSet("Two people use one room.", RoomConfig(people=2), seeds="1000-1019"),
    "wrong-shape": RoomSet(
        "The rooms of `rooms`; every mesh that is given is another object of the same class.",
        noise=NoiseConfig(other_shapes=1.0)),
    "clutter": RoomSet(
        "More furniture, seen by a lower and narrower camera: objects occlude each other and are"
        " cut by the border of the image.",
        _CROWDED),
    "detected": RoomSet(
        "The rooms of `rooms`; masks and boxes as a detector gives them, with objects missed,"
        " invented, merged and called by wrong names.",
        noise=_DETECTED),
    "upstream": RoomSet(
        "The rooms of `rooms` as today's tools would give them, all errors at once: foreign meshes,"
        " masks of a coarse head, mean bodies with biased poses, a guessed lens.",
        noise=_UPSTREAM),
    "askew": RoomSet(
        "The rooms of `rooms` with each object turned 3 to 15 degrees away from the walls, under a"
        " guessed lens.",
        RoomConfig(plan=PlanConfig(askew=(3.0, 15.0))),
        NoiseConfig(lens=0.055)),
    "moved": RoomSet(
        "Two people use a room one after the other; between them a chair or a table is moved.",
        _MOVED),
    "withheld-seat": RoomSet(
        "The rooms of `rooms`; the seat that is used most is missing from the input.",
        withheld="seat"),
    "moving": RoomSet(
        "The rooms of `rooms` seen by a camera that is walked with, panned or held by hand; its"
        " path is as SLAM gives it, in a scale of its own and with a drift of 1 % of the way.",
        paths=(
            replace(_SLAM, travel=0.8, turn=5.0, hand=0.01),
            replace(_SLAM, travel=0.1, turn=12.0, hand=0.01),
            replace(_SLAM, travel=0.05, turn=1.0, hand=0.015),
        )),
}  # fmt: skip
"""All sets by name."""


@dataclass(frozen=True)
class Change:
    """An error of the input in growing sizes."""

    field: str  #: of `NoiseConfig`: set to the level
    levels: tuple[float, ...]  #: studied sizes; the first is no error of this kind
    without: str = ""
    """Another field that is zero then, so that this error is the only one of its kind."""


CHANGES: dict[str, Change] = {
    "scale": Change("scale", (0.0, 0.05, 0.15, 0.25)),
    "place": Change("sideways", (0.0, 0.1, 0.2, 0.3), "along_ray"),
    "turn": Change("yaw", (0.0, 15.0, 30.0, 45.0), "flips"),
    "masks": Change("object_masks", (0, 1, 3, 6)),
    "pose": Change("pose", (0.0, 4.0, 8.0)),
    "depth": Change("depth_bias", (0.0, 0.03, 0.06)),
    "missed": Change("missed", (0.0, 0.1, 0.2)),
}
"""Errors of the input by name (the paper's sensitivity, Tab. 7, has the first three)."""


def set_named(name: str) -> RoomSet:
    """A set of `SETS`.

    Raises:
        InputError: If there is none of this name.
    """
    if name not in SETS:
        raise InputError(f"--set: {name!r} is none of {', '.join(SETS)}")
    return SETS[name]


def changed(rooms: RoomSet, change: str) -> RoomSet:
    """The set with one error of another size, as `scale=0.25`; empty: as it is."""
    if not change:
        return rooms
    kind, _, level = change.partition("=")
    error = CHANGES[kind]
    values: dict[str, Any] = {error.field: type(getattr(rooms.noise, error.field))(float(level))}
    values |= {error.without: 0.0} if error.without else {}
    return replace(rooms, noise=replace(rooms.noise, **values))


def parse_seeds(text: str) -> tuple[int, ...]:
    """Read `0-9` or `0,3,5-7`.

    Raises:
        InputError: If it is anything else.
    """
    seeds: set[int] = set()
    for part in text.split(","):
        first, dash, last = part.strip().partition("-")
        ends = [first, last if dash else first]
        if not all(end.isascii() and end.isdigit() for end in ends) or int(ends[1]) < int(ends[0]):
            raise InputError(f"--seeds: {text!r}, expected numbers and ranges like 0,3,5-7")
        seeds.update(range(int(ends[0]), int(ends[1]) + 1))
    return tuple(sorted(seeds))
