"""The nouns of the package, with shapes and units. Frames, axes and pixels: docs/conventions.md."""

from dataclasses import field
from typing import Literal

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.core.records import record


@record
class Camera:
    """A pinhole camera, still at the world origin (x right, y down, z forward); picture in [px]."""

    K: Float[Tensor, "3 3"]  #: intrinsics [px]; the centre of the top-left pixel is (0.5, 0.5)
    R_cam_world: Float[Tensor, "3 3"]
    """Maps world (+y up, viewing direction without x) to camera axes."""
    width: int
    height: int


@record
class Mesh:
    """A triangle mesh in its own canonical frame (+y up, +z front) [m], or of a body."""

    verts: Float[Tensor, "verts 3"]
    faces: Int[Tensor, "faces 3"]


@record
class Segment:
    """Where an object stands from a frame on, until its next segment begins."""

    frame: int
    t_world_object: Float[Tensor, "3"]  #: place of the mesh origin in the world [m]
    yaw: Float[Tensor, ""]  #: [rad]
    mover: int | None = None
    """The person with whom it moves, held by hand or sat on; None: it stands."""


@record
class SeatStretch:
    """How the seat of a mesh is raised to where people sit; its bottom and its top stay.

    What lies below the seat and what lies above it are each stretched evenly.
    """

    bottom: Float[Tensor, "*items"]  #: lowest y, the seat's and the highest, as the mesh was [m]
    seat: Float[Tensor, "*items"]
    top: Float[Tensor, "*items"]
    rise: Float[Tensor, "*items"]  #: how far the seat goes up [m]

    def of(self, points: Float[Tensor, "*items points 3"]) -> Float[Tensor, "*items points 3"]:
        """Points of the mesh, raised."""
        y = points[..., 1]
        ends = (self.bottom, self.top)
        shares = [((y - end.unsqueeze(-1)) / (self.seat - end).unsqueeze(-1)) for end in ends]
        share = torch.minimum(*shares).nan_to_num(0.0).clamp(0, 1)
        y = y + share * self.rise.unsqueeze(-1)
        return torch.stack([points[..., 0], y, points[..., 2]], -1)


@record
class SceneObject:
    """One object of a scene: x_world = R_y(yaw) @ (scale * x_mesh) + t_world_object."""

    id: str
    category: str
    mesh: Mesh
    mesh_file: str
    """Where the mesh came from; it is copied, and rewritten only where a seat moved (`stretch`)."""
    annotation: int | None  #: id of its annotation in the reference image; None: no image evidence
    support: str  #: `ground`, `free`, or the id of the object that carries it
    t_world_object: Float[Tensor, "3"]  #: place of the mesh origin in the world [m]
    yaw: Float[Tensor, ""]  #: right-handed rotation about +y [rad]
    scale: Float[Tensor, "3"]  #: factor along each mesh axis
    segments: tuple[Segment, ...] = ()
    """Where it stands when, of an object that is moved; its own position is that of the reference
    image. Empty: it never moves."""
    stretch: SeatStretch | None = None
    """How `mesh` was made from what its file holds; None: it is as in the file."""


@record
class Scene:
    """A furnished room: initial guess, result or truth."""

    camera: Camera
    ground: float | None
    """Height of the floor in the world [m], negative below the camera; None: unknown."""
    objects: tuple[SceneObject, ...]
    size_spread: float = 0.0
    """Standard deviation of the logarithm of a common error of all positions and sizes."""


@record
class Masks:
    """Binary images of one size, kept run-length encoded (COCO's compressed counts)."""

    height: int
    width: int
    counts: tuple[bytes, ...]


@record
class Detection:
    """One annotated instance of the reference image."""

    id: int
    category: str
    box: Float[Tensor, "4"]  #: x_min, y_min, x_max, y_max [px]
    mask: Masks | None  #: one mask; None: only the box is known
    score: float


@record
class People:
    """Visible masks of tracked people, one row for each (frame, person)."""

    masks: Masks
    frame: Int[Tensor, " rows"]
    person: Int[Tensor, " rows"]
    heights: dict[str, float] = field(default_factory=dict)  #: known body heights by track [m]


@record
class BodyPose:
    """Parameters of a body model, with the names and meaning of the smplx package."""

    model: str
    gender: str
    betas: Float[Tensor, "bodies shape"]
    global_orient: Float[Tensor, "bodies 3"]
    body_pose: Float[Tensor, "bodies angles"]
    transl: Float[Tensor, "bodies 3"]
    extra: dict[str, Tensor]
    """left_hand_pose, right_hand_pose, jaw_pose, leye_pose, reye_pose, expression where given; one
    row a body. `flat_hand_mean` (bodies, 1): not 0 where hands turn from flat, not mean, hands."""


@record
class Bodies:
    """People in all frames: one row for each (frame, person), one topology; positions in [m]."""

    verts: Float[Tensor, "bodies verts 3"]
    faces: Int[Tensor, "faces 3"]
    joints: Float[Tensor, "bodies joints 3"] | None
    joint_names: tuple[str, ...]
    frame: Int[Tensor, " bodies"]
    person: Int[Tensor, " bodies"]
    fps: float | None  #: frames a second; None: unordered images
    space: Literal["camera", "world"]  #: frame of vertices and joints
    pose: BodyPose | None
    size_spread: float | None = None
    """Standard deviation of the logarithm of all sizes, as far as they are wrong together: bodies
    from keypoints of unknown height. 0: it was given. None: unknown."""
    mean_shape: bool = False
    """All have the mean shape of their model, so that their heights were not observed."""


@record
class Keypoints:
    """Joints that a detector saw in the images [px]: one row for each (frame, person)."""

    points: Float[Tensor, "rows joints 2"]
    confidence: Float[Tensor, "rows joints"]  #: from 0 to 1; 0: the joint is missing
    layout: str  #: which joints: a name in `bodies.keypoints.LAYOUTS`
    frame: Int[Tensor, " rows"]
    person: Int[Tensor, " rows"]
    fps: float | None


def rows_by_person(
    frame: Int[Tensor, " rows"], person: Int[Tensor, " rows"]
) -> list[Int[Tensor, " _"]]:
    """Rows of each person, in the order of their frames."""
    every = (torch.nonzero(person == one)[:, 0] for one in person.unique().tolist())
    return [rows[torch.argsort(frame[rows], stable=True)] for rows in every]


@record
class CameraPath:
    """Where the camera was in the frames, in the axes of the reference image's camera.

    x_reference = R_reference_camera @ x_camera + t_reference_camera. A camera that stands still has
    one pose, which is that of the reference image.
    """

    frame: Int[Tensor, " poses"]  #: rising
    R_reference_camera: Float[Tensor, "poses 3 3"]
    t_reference_camera: Float[Tensor, "poses 3"]
    """In the units of the tool that found the poses until their scale is found, then [m]."""


STILL = CameraPath(torch.zeros(1, dtype=torch.long), torch.eye(3)[None], torch.zeros(1, 3))
"""The path of a camera that stands still."""


@record
class DepthImage:
    """What a depth network says of the reference picture."""

    values: Float[Tensor, "h w"]
    """Distance along the view [m], or inverse depth up to a factor and a shift; NaN: unknown."""
    metric: bool


@record
class Heading:
    """Along which two directions, at right angles, a room runs: its walls and most furniture."""

    yaw: float  #: of one of them about up, seen from the camera [rad]
    spread: float  #: standard deviation [rad]


@record
class Tilt:
    """Pitch and roll as they were measured, or as lines of the picture show them [rad]."""

    pitch: float
    roll: float
    spread: float  #: standard deviation of both


@record
class Capture:
    """Everything that is known before the method runs; it never holds the truth."""

    name: str
    scene: Scene  #: the initial scene; its camera holds the first guess of pitch and roll
    camera_height: float | None  #: known height of the camera above the floor [m]
    detections: tuple[Detection, ...]
    reference: Float[Tensor, "h w 3"] | None  #: the clean reference image, in [0, 1]
    reference_people: Masks | None  #: people in the reference image: what they hide is unknown
    bodies: Bodies | None
    people: People | None
    touch: Float[Tensor, "bodies verts"] | None
    """Chance that a body's vertex touches something, where the user has it (POSA, DECO)."""
    warnings: tuple[str, ...]
    furniture: People | None = None
    """Visible masks of the objects in some frames, `person` being the number of an annotation."""
    hypotheses: tuple[SceneObject, ...] = ()
    """Other positions and shapes of the scene's objects, under their ids: further starts."""
    path: CameraPath = STILL  #: where the camera was when it saw the people
    depth: DepthImage | None = None  #: measured depth of the reference picture
    keypoints: Keypoints | None = None  #: in the frames; read where people have no masks
    focal_spread: float | None = None
    """Standard deviation of the logarithm of the focal length; 0: it was measured. None:
    unknown."""
    focal_by_lines: bool = False
    """Whether the lines of the reference picture have been counted in the focal length."""
    tilt: Tilt | None = None  #: of the camera, where it was looked for in the picture
    heading: Heading | None = None  #: of the room's walls, where it was


@record
class Objects:
    """The furniture, packed: closed proxies at their initial size [m], each in its own frame.

    The origin of a frame is the centre of the box's bottom, +y is up, +z the front. Arrays are
    padded: vertices and points by repetition, faces and edges by zeros (degenerate).
    """

    ids: tuple[str, ...]
    categories: tuple[str, ...]  #: canonical names
    verts: Float[Tensor, "objects verts 3"]
    real_verts: Bool[Tensor, "objects verts"]  #: False where vertices pad
    faces: Int[Tensor, "objects faces 3"]
    edges: Int[Tensor, "objects edges 4"]  #: two vertices and the two faces beside them
    samples: Float[Tensor, "objects samples 3"]  #: points spread evenly over the surface [m]
    size: Float[Tensor, "objects 3"]  #: edges of the box [m]
    top: Float[Tensor, "objects region 3"]
    """Points of the region that carries: a seat, a mattress, a table top [m]."""
    back: Float[Tensor, "objects region 3"]  #: points of the region that one leans against [m]
    has_top: Bool[Tensor, " objects"]
    has_back: Bool[Tensor, " objects"]
    is_seat: Bool[Tensor, " objects"]  #: people can sit or lie on it
    supports: Int[Tensor, " objects"]
    """-1: the ground, -2: free, else the index of the carrying object."""


@record
class Layout:
    """Where the objects stand: the unknowns of Eq. 1. Leading axes hold several starts."""

    t_world_object: Float[Tensor, "*starts objects 3"]  #: centre of the box's bottom [m]
    yaw: Float[Tensor, "*starts objects"]  #: rotation about gravity [rad]
    log_scale: Float[Tensor, "*starts objects 3"]
    """Logarithm of the scale along each object axis; 0 keeps the initial size."""

    def __getitem__(self, starts: int | slice | None) -> "Layout":
        """Some starts; `layout[None]` is one layout as the only start."""
        return Layout(self.t_world_object[starts], self.yaw[starts], self.log_scale[starts])

    def gather(self, index: Int[Tensor, "few objects"]) -> "Layout":
        """Starts by index, an own one for each object."""
        wide = index.unsqueeze(-1).expand(-1, -1, 3)
        parts = self.t_world_object.gather(0, wide), self.yaw.gather(0, index)
        return Layout(*parts, self.log_scale.gather(0, wide))

    @staticmethod
    def cat(*layouts: "Layout") -> "Layout":
        """All starts of several layouts."""
        parts = zip(*((one.t_world_object, one.yaw, one.log_scale) for one in layouts), strict=True)
        return Layout(*(torch.cat(part) for part in parts))

    @staticmethod
    def where(first: Bool[Tensor, " objects"], one: "Layout", other: "Layout") -> "Layout":
        """The objects of one layout where `first`, else of the other; both may have starts."""
        wide = first[:, None]
        return Layout(
            torch.where(wide, one.t_world_object, other.t_world_object),
            torch.where(first, one.yaw, other.yaw),
            torch.where(wide, one.log_scale, other.log_scale),
        )


@record
class Evidence:
    """What held an object in its position."""

    id: str
    mask_pixels: int  #: pixels of its mask in the image
    near_pixels: int  #: pixels (of an image 640 wide) where people passed in front of it
    far_pixels: int  #: pixels where it hid people
    touching_bodies: int  #: bodies that touch it
    nearest_body: float | None
    """From its surface to the nearest body of all frames [m]; negative: inside; None: no people."""
    energy: float  #: what is left of Eq. 1 where it stands
    terms: dict[str, float]  #: the same by term of Eq. 1 (`SCENE_TERMS`)


@record
class ContactLabels:
    """Who touches what: one row for each frame, person, part of the body and object that touch."""

    frame: Int[Tensor, " rows"]
    person: Int[Tensor, " rows"]
    part: Int[Tensor, " rows"]  #: index into `parts`
    object: Int[Tensor, " rows"]  #: index into `objects`
    position: Float[Tensor, "rows 3"]  #: on the surface of the object, in the world [m]
    normal: Float[Tensor, "rows 3"]  #: out of the object there, a unit vector
    gap: Float[Tensor, " rows"]
    """From the surface to the nearest vertex of the part [m]; negative: the part is inside."""
    confidence: Float[Tensor, " rows"]
    """From 0 to 1: how near it is, and whether the posture bears on it."""
    parts: tuple[str, ...]
    objects: tuple[str, ...]  #: ids of the scene's objects; the last is `ground`, the floor


@record
class Proposal:
    """A support that no detector saw: people rest on it."""

    proposed: SceneObject  #: of the library, where they rest; without an annotation
    piece: str  #: its name in the library
    style: int
    seed: int  #: which design, and what drew its sizes
    certainty: float  #: from 0 to 1; a rule of thumb, not a calibrated chance
    bodies: int  #: how many bodies rest on it...
    seconds: float  #: ... and for how long [s]


@record
class Room:
    """What `reconstruct` returns."""

    scene: Scene  #: the refined scene: every object of the input
    initial: Scene  #: the scene as it was given
    image_only: Scene
    """The same objects under the refined camera as the image alone places them (stage 1)."""
    bodies: Bodies | None  #: all rows of the input, in the world of `scene`
    kept: Bool[Tensor, " bodies"] | None  #: rows that served as evidence
    proxies: tuple[Mesh, ...]
    """The closed meshes that were optimised, in the coordinates of the pieces' own meshes."""
    evidence: tuple[Evidence, ...]
    covariance: Float[Tensor, "3 3"] | None
    """Of pitch [rad], roll [rad] and ground [m] as the feet give them."""
    traces: dict[str, Tensor]  #: total energy before each step, by stage
    warnings: tuple[str, ...]
    path: CameraPath = STILL
    """Where the cameras of the frames were, in the axes of that of `scene` [m]."""
    proposals: tuple[Proposal, ...] = ()
    """What people rest on that is not in the scene; nothing else depends on them."""
    estimates: tuple[str, ...] = ()
    """Lens and scale with their spreads, and what would narrow them, each a line."""
