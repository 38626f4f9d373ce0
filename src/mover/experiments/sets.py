"""Open HSI Rooms: versioned sets of known rooms, each made from its seeds alone.

A set is a way to make rooms, a way to spoil what is known of them, and the seeds that results are
reported on; settings are chosen on other seeds. Sets that differ in nothing but the noise have the
same rooms for the same seeds. The figures of the noise have their sources in `NoiseConfig`.
"""

from dataclasses import dataclass, field

from ..rooms import ActConfig, NoiseConfig, PlanConfig, RoomConfig


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
    "long": RoomSet(
        "A minute in which a person uses many pieces, some of them repeatedly, each for a short"
        " time.",
        "1000-1009", "100-103", _LONG,
    ),
}  # fmt: skip
"""All sets by name."""
