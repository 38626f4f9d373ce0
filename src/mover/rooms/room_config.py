"""How a known room is made: furnished, seen, and used."""

from dataclasses import dataclass, field

from .spots import Rule


@dataclass(frozen=True)
class PlanConfig:
    """How a room is furnished and seen."""

    camera_height: tuple[float, float] = (1.2, 1.7)
    """Lowest and highest camera above the floor [m]."""
    look_down: tuple[float, float] = (8.0, 14.0)
    """How far a camera 1.2 m high looks down; one that is higher by 1 m 4 more [degrees]."""
    field_of_view: tuple[float, float] = (61.0, 69.0)
    """Of the image's width [degrees]."""
    wide: tuple[float, float] = (4.6, 5.4)
    """Of the floor, from left to right [m]."""
    far: tuple[float, float] = (5.6, 6.4)
    """From the camera to the wall behind the furniture [m]."""
    visible: float = 0.85
    """Least share of a piece's vertices inside the image."""
    hidden: float = 0.75
    """No piece may be hidden by others more than this."""
    crowded: float = 1 / 3
    """Share of the pieces that others should hide; of five rooms the one nearest to it is taken."""
    spacing: float = 1.0
    """Factor on the free floor around each piece."""
    more: tuple[tuple[str, Rule], ...] = ()
    """What stands in the room after the pieces of its kind, and where."""


@dataclass(frozen=True)
class ActConfig:
    """What people do."""

    tasks: int = 5
    """Most tasks with furniture for each person."""
    walks: int = 2
    """Walks to free places: the first comes before all tasks, the others after them."""
    rounds: int = 1
    """How often each piece is thought of; more make other uses of the same piece."""
    apart: float = 0.0
    """More than 0: people only walk, and keep their skin so far from all furniture [m]."""


@dataclass(frozen=True)
class RoomConfig:
    """How a known room is made."""

    width: int = 960
    """Of the image [px]."""
    height: int = 540
    """Of the image [px]."""
    fps: float = 5.0
    """Frames a second."""
    people: int = 1
    """How many people use the room, 1 or 2."""
    pieces: int = 9
    """Most pieces of furniture."""
    least_pieces: int = 6
    """Fewest pieces of furniture that the camera sees."""
    least_frames: int = 200
    """Fewest frames."""
    least_touches: int = 3
    """Fewest tasks that touch furniture, over all people."""
    least_pixels: int = 500
    """A piece with fewer visible pixels is not annotated well enough: the room is refused."""
    stay: float = 1.0
    """Factor on how long people sit, lie and stand."""
    most_frames: int = 0
    """The video ends after so many; 0: when everybody is done."""
    least_passing: float = 0.0
    """Least share of the bodies that furniture hides in part."""
    plan: PlanConfig = field(default_factory=PlanConfig)
    """How the room is furnished and seen."""
    acts: ActConfig = field(default_factory=ActConfig)
    """What people do."""
