"""How a known room is made and used, and how wrong its input is, with a source for each number."""

from dataclasses import dataclass, field
from typing import Literal

Rule = Literal["wall", "corner", "middle", "facing", "before", "around", "beside"]
"""Where a piece of furniture may stand."""


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
    moved: bool = False
    """A piece is put elsewhere between the visits of two people."""
    plan: PlanConfig = field(default_factory=PlanConfig)
    """How the room is furnished and seen."""
    acts: ActConfig = field(default_factory=ActConfig)
    """What people do."""


@dataclass(frozen=True)
class PathConfig:
    """How a camera moves, and how wrong its path is given; zero everywhere: it stands still."""

    travel: float = 0.0
    """Farthest from where it began, about [m]."""
    turn: float = 0.0
    """Farthest from where it looked, about [degrees]."""
    hand: float = 0.0
    """Standard deviation of a hand along each axis [m]."""
    shake: float = 0.0
    """Standard deviation of its direction about each axis [degrees]."""
    units: float = 0.0
    """Largest logarithm of the scale in which it is given."""
    drift: float = 0.0
    """Error of the place at the end [share of the way].

    Source: SLAM on indoor sequences ends off by .5 to 1 % of the way (DROID-SLAM, DPVO on TUM).
    """
    drift_turn: float = 0.0
    """Error of the direction at the end [degrees]."""
    views: float = 0.0
    """Time between two frames in which the furniture is segmented [s]; 0: the reference alone."""


# How wrong the input of a known room is, with a source for each number.


@dataclass(frozen=True)
class NoiseConfig:
    """How wrong the input is. Zero everywhere gives the truth back."""

    along_ray: float = 0.3
    """Objects: largest shift along the viewing ray, drawn evenly [m]; the size follows."""
    sideways: float = 0.1
    """Objects: largest shift along each world axis, drawn evenly [m]."""
    yaw: float = 30.0
    """Objects: largest turn, drawn evenly [degrees]."""
    flips: float = 0.1
    """Objects: share that is turned by a further 90, 180 or 270 degrees."""
    scale: float = 0.15
    """Objects: largest error of the size along each axis, drawn evenly [share]."""
    other_shapes: float = 0.0
    """Objects: share whose mesh is another piece of the same class, stretched to the same box."""
    camera: float = 3.0
    """Mean size of the error of pitch and of roll; between 2/3 and 4/3 of it [degrees]."""
    depth_bias: float = 0.03
    """Bodies: largest error of a person's depth; the body keeps its size [share]."""
    depth_drift: float = 0.01
    """Bodies: standard deviation of a depth error that changes within a second [share]."""
    pose: float = 4.0
    """Bodies: standard deviation of each joint's rotation error [degrees]."""
    pose_seconds: float = 0.6
    """Bodies: how long a pose error lasts [s]."""
    pose_hidden: float = 1.5
    """Bodies: factor on the pose error where more than half of the body is hidden."""
    jitter: float = 0.015
    """Bodies: standard deviation of the place, independent in each frame and axis [m]."""
    dropped: float = 0.02
    """Bodies: share of rows that are missing."""
    person_masks: int = 3
    """People's masks: most pixels by which they grow or shrink (at least 1 unless 0) [px]."""
    missed_masks: float = 0.03
    """People's masks: share that is missing."""
    object_masks: int = 1
    """Objects' masks: most pixels by which they grow or shrink [px]."""
    leaks: float = 0.0
    """Objects' masks: share that leaks over its border by a fifth of its own extent.

    Source: instance masks of cluttered rooms run over into the floor and into neighbours of the
    same colour, which finer outlines (PointRend) do not cure.
    """
    missed: float = 0.0
    """Detections: share that is missing, and with it the object of the initial scene.

    Source of this and of the next three: the paper's rows with PointRend in place of annotated
    boxes. A score threshold of 0.55 misses hidden objects, and COCO has one class of tables, no
    shelves and no cabinets.
    """
    false: float = 0.0
    """Detections: objects that are not there, as a share of those that are found."""
    merged: float = 0.0
    """Detections: share that swallows a neighbour in the image, which is then missing."""
    wrong_class: float = 0.0
    """Detections: share with another class; the mesh is of that class and fills the same box."""
    foreign: float = 0.0
    """Meshes: share that is another piece of the class as another program would make it.

    Source of this and of the next: `rooms.foreign`; networks from one image (Total3D, image-to-3D)
    choose another design, smooth it, leave it open and are off by 2-5 % of its size.
    """
    warp: float = 0.0
    """Foreign meshes: root mean square displacement by a smooth warp [share of the size]."""
    mask_head: int = 0
    """Objects' masks: cells a side of the mask head, 0: exact.

    Source: Mask R-CNN predicts 28 x 28 cells in a box (He et al. 2017), others 56 x 56 or 112.
    """
    mask_box: float = 0.0
    """Objects' boxes: standard deviation of each side [share of the box's width or height].

    Source: a box AP at IoU .75 of about .6 (detectron2's model zoo) is sides off by a few per cent.
    """
    amodal: float = 0.0
    """Objects' masks: share that holds what other furniture hides, too (amodal heads, SAM)."""
    wobble: float = 0.0
    """People's masks: standard deviation of their outlines, which changes along them [px]."""
    mean_bodies: bool = False
    """Bodies: all have the mean shape, as far away as their picture's size then says.

    Source: regressors from crops hardly leave the mean shape; heights of adults differ by 6 %, so
    that people and all that is measured by them are too large or too small by as much.
    """
    pose_bias: float = 0.0
    """Bodies: standard deviation of an error of each joint's rotation that stays [degrees].

    Source: errors of 40-50 mm after alignment (3DPW, EMDB) that do not average out in time.
    """
    lens: float = 0.0
    """Mean size of the error of a guessed focal length, between 6/11 and 16/11 of it [share].

    Bodies and first scene are made under the guess: they keep their widths and are off in depth.
    Source: lenses guessed from one image (GeoCalib, WildCamera) are off by 3-8 %. camera.json says
    that it is a guess (`focal_spread`).
    """
    distortion: float = 0.0
    """Reference picture: standard deviation of the radial distortion k1 that is left in it.

    Source: .04 to .05 are what one corrects in a Kinect's colour camera (Lachat et al. 2015).
    """
    things: int = 0
    """Reference picture: things that lie about in it, as large as cushions, books and bags."""
    grain: float = 0.0
    """Reference picture: noise of the sensor [share of white], with blur and a JPEG's traces."""
