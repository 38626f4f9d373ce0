"""How known rooms are made and used, how wrong their input is, and the versioned sets of them.

Each number has a source. A set is a way to make rooms, a way to disturb what is known of them, and
the seeds that results are reported on; settings are chosen on other seeds. Sets that differ in
nothing but the noise have the same rooms for the same seeds. The figures of the noise have their
sources in `NoiseConfig`.
"""

from dataclasses import dataclass, field, replace
from typing import Any, Literal

from mover.core.errors import InputError

Rule = Literal["wall", "corner", "middle", "facing", "before", "around", "beside"]
"""Where an object may stand."""


@dataclass(frozen=True)
class PlanConfig:
    """How a room is furnished and seen."""

    camera_height: tuple[float, float] = (1.2, 1.7)  #: above the floor [m]
    look_down: tuple[float, float] = (8.0, 14.0)
    """Of a camera 1.2 m high; one that is higher by 1 m looks down 4 more [degrees]."""
    field_of_view: tuple[float, float] = (61.0, 69.0)  #: of the image's width [degrees]
    visible: float = 0.85  #: least share of an object's vertices inside the image
    hidden: float = 0.75  #: largest share of an object that others may occlude
    crowded: float = 1 / 3
    """Share of the objects that others should occlude; of five rooms the nearest one is taken."""
    spacing: float = 1.0  #: factor on the free floor around each object
    more: tuple[tuple[str, Rule], ...] = ()
    """What stands in the room after the objects of its kind, and where."""
    askew: tuple[float, float] = (0.0, 0.0)
    """How far each object is turned away from its rule's heading, to either side [degrees]."""


@dataclass(frozen=True)
class ActConfig:
    """What people do."""

    tasks: int = 5  #: most tasks with furniture for each person
    walks: int = 2  #: to free floor: the first comes before all tasks, the others after them


@dataclass(frozen=True)
class RoomConfig:
    """How a known room is made."""

    width: int = 960  #: of the image [px]
    height: int = 540  #: of the image [px]
    fps: float = 5.0  #: frames a second
    people: int = 1  #: 1 or 2
    pieces: int = 9  #: most objects
    least_pieces: int = 6  #: fewest objects that the camera sees
    least_frames: int = 200
    least_touches: int = 3  #: fewest tasks that touch furniture, over all people
    least_pixels: int = 500  #: a room is refused where an object shows fewer
    stay: float = 1.0  #: factor on how long people sit, lie and stand
    most_frames: int = 0  #: the video ends after so many; 0: when all people are done
    moved: bool = False  #: an object is moved between the visits of two people
    plan: PlanConfig = field(default_factory=PlanConfig)
    acts: ActConfig = field(default_factory=ActConfig)


@dataclass(frozen=True)
class PathConfig:
    """How a camera moves, and how wrong its path is; zero everywhere: it stands still.

    SLAM on indoor sequences ends off by .5 to 1 % of the way (DROID-SLAM, DPVO on TUM).
    """

    travel: float = 0.0  #: farthest from its first position, about [m]
    turn: float = 0.0  #: farthest from its first direction, about [degrees]
    hand: float = 0.0  #: standard deviation of a hand along each axis [m]
    shake: float = 0.0  #: standard deviation of its direction about each axis [degrees]
    units: float = 0.0  #: largest logarithm of the scale of the path
    drift: float = 0.0  #: error of the last position [share of the way]
    drift_turn: float = 0.0  #: error of the last direction [degrees]


@dataclass(frozen=True)
class NoiseConfig:
    """How wrong the input is. Zero everywhere gives the truth back."""

    # Objects of the initial scene.
    along_ray: float = 0.3  #: largest shift along the viewing ray [m]; the size follows
    sideways: float = 0.1  #: largest shift along each world axis [m]
    yaw: float = 30.0  #: largest rotation [degrees]
    flips: float = 0.1  #: share rotated by a further 90, 180 or 270 degrees
    scale: float = 0.15  #: largest error of the size along each axis [share]
    other_shapes: float = 0.0
    """Share whose mesh is another object of the same class, stretched to the same box."""
    camera: float = 3.0  #: mean error of pitch and roll, between 2/3 and 4/3 of it [degrees]

    # Bodies.
    depth_bias: float = 0.03  #: largest error of a person's depth; the size is kept [share]
    depth_drift: float = 0.01  #: standard deviation of a depth error that lasts a second [share]
    pose: float = 4.0  #: standard deviation of each joint's rotation error [degrees]
    pose_seconds: float = 0.6  #: how long a pose error lasts [s]
    pose_hidden: float = 1.5  #: factor on it where more than half of the body is occluded
    jitter: float = 0.015  #: standard deviation of the position in each frame and axis [m]
    dropped: float = 0.02  #: share of rows that are missing

    # Masks.
    person_masks: int = 3  #: people: most pixels by which they grow or shrink, at least 1 unless 0
    missed_masks: float = 0.03  #: people: share that is missing
    object_masks: int = 1  #: objects: most pixels by which they grow or shrink
    leaks: float = 0.0
    """Objects: share that leaks over its border by a fifth of its own extent, as masks of cluttered
    rooms do into the floor and into neighbours of the same colour."""

    # Detections: the paper's rows with PointRend in place of annotated boxes. A score threshold of
    # 0.55 misses occluded objects, and COCO has one class of tables, no shelves and no cabinets.
    missed: float = 0.0  #: share that is missing, and with it the object of the initial scene
    false: float = 0.0  #: objects that are not there, as a share of those that are found
    merged: float = 0.0  #: share that swallows a neighbour in the image, which is then missing
    wrong_class: float = 0.0
    """Share with another class; the mesh is of that class and fills the same box."""

    # Networks from one image to meshes (Total3D, image-to-3D) choose another design, smooth it,
    # leave it open and are off by 2-5 % of its size.
    foreign: float = 0.0  #: share of meshes as another program would make them, see `foreign_mesh`
    warp: float = 0.0  #: root mean square displacement of those by a smooth warp [share]

    # Mask R-CNN predicts 28 x 28 cells in a box (He et al. 2017), others 56 x 56 or 112. A box AP
    # at IoU .75 of about .6 (detectron2's model zoo) is sides off by a few per cent.
    mask_head: int = 0  #: objects: cells a side of the mask head, 0: exact
    mask_box: float = 0.0  #: objects: standard deviation of each side of the box [share]
    amodal: float = 0.0  #: objects: share of masks that hold what is occluded, too
    wobble: float = 0.0  #: people: standard deviation of outlines, changing along them [px]

    # Regressors from crops hardly leave the mean shape; heights of adults differ by 6 %. Errors of
    # 40-50 mm after alignment (3DPW, EMDB) do not average out in time.
    mean_bodies: bool = False
    """All bodies have the mean shape, as far away as their size in the picture then implies."""
    pose_bias: float = 0.0  #: standard deviation of a joint's constant rotation error [degrees]

    # Lenses guessed from one image (GeoCalib, WildCamera) are off by 3-8 %.
    lens: float = 0.0
    """Mean error of a guessed focal length, between 6/11 and 16/11 of it [share]. Bodies and first
    scene are made under the guess: they keep their widths and are off in depth. camera.json says
    that it is a guess (`focal_spread`)."""

    # Reference picture; one corrects .04 to .05 in a Kinect's colour camera (Lachat et al. 2015).
    distortion: float = 0.0  #: standard deviation of the radial distortion k1 that is left
    things: int = 0  #: clutter as large as cushions, books and bags
    grain: float = 0.0  #: noise of the sensor [share of white], with blur and a JPEG's traces


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
