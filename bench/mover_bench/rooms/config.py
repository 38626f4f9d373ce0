"""How a known room is made and used, and how wrong its input is, with a source for each number."""

from dataclasses import dataclass, field
from typing import Literal

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
    foreign: float = 0.0  #: share of meshes as another program would make them, see `foreign.py`
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
