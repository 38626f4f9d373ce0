"""Errors like those of real upstream tools, on a room in which everything is known.

Sources: the paper's sensitivity table (uniform noise on the translation, orientation and scale of
Total3D's objects: 0.3 m, 30 degrees, 15 %), and published errors of monocular body regression
(a few degrees a joint and 2-3 % in depth, both slow in time); the other rows name their own
sources in `NoiseConfig`. Every part has its own stream of
random numbers, so that changing one leaves the others as they were.

Foreign meshes are those that other programs make. Each starts from another design of the same
class, whose proportions are changed, and goes through one of several makers, so that no one style
of errors is learnt:

- `smooth`: a fine grid, smoothed, as networks from an image to a solid leave it;
- `blocky`: a coarse grid of matter (occupancy networks, 32 cells a side);
- `sphere`: a sphere of 2562 vertices drawn onto the surface, faces that bridge gaps cut out, as
  Total3D does (Sec. 3.3 there); never closed;
- `soup`: flat faces with two sides, some of them turned over, as in collections of CAD models.

Then the mesh is warped by a few per cent of its size, and some lose what a camera does not see.
"""

import io
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from mover.bodies.skinning import open_body
from mover.core.records import map_tensors, rows_of
from mover.core.types import Bodies, BodyPose, Camera, Capture, Mesh, Scene, SceneObject
from mover.furniture.library import SEATS, another
from mover.furniture.pieces import Furniture
from mover.geometry.camera import pitch_roll, tilted
from mover.geometry.mesh import face_normals, fit_box, used
from mover.geometry.rle import decode
from mover.geometry.rotations import rot_y
from mover.geometry.topology import Triangles, level_set
from mover.stages.camera.find_lens import through_lens
from mover_bench.rooms import noise_masks as masks
from mover_bench.rooms.config import NoiseConfig
from mover_bench.rooms.known import KnownRoom, one_thread, rounded_bodies
from mover_bench.rooms.poses import from_vector, to_vector

KNOTS = 4  # stretches along each axis that change their share of the size
PROPORTION = 0.2  # by which a stretch grows or shrinks, drawn evenly
TORN = 0.4  # share of meshes without what faces down or back
FINE, COARSE = (44, 56), (20, 28)  # cells along the longest side
ROUNDS = 30  # steps of the sphere towards the surface
BRIDGE = 0.06  # of the size: faces of the sphere farther from the surface are cut out


def foreign_mesh(known: Furniture, warp: float, rng: np.random.Generator) -> Mesh:
    """Another piece of the class as another program would give it, in the box of a known piece.

    `warp` is its root mean square displacement, as a share of the size.
    """
    mesh = another(known, rng).mesh
    verts = mesh.verts.double().numpy()
    low, size = verts.min(0), np.ptp(verts, axis=0)
    verts = np.stack([_stretched((verts[:, k] - low[k]) / size[k], rng) for k in range(3)], -1)
    wanted = np.array(known.size)
    maker = MAKERS[int(rng.integers(len(MAKERS)))]
    verts, faces = maker((verts * wanted, mesh.faces.numpy()), rng)
    verts = verts + warp * wanted * _waves(verts / wanted, rng)
    out = Mesh(torch.from_numpy(verts).float(), torch.from_numpy(faces.astype(np.int64)))
    if rng.uniform() < TORN:  # what looks down or back is not there
        normals = face_normals(out.verts, out.faces)
        seen = ~((normals[:, 1] < -0.7) | (normals[:, 2] < -0.7))
        out = Mesh(out.verts, out.faces[seen]) if int(seen.sum()) > 50 else out
    out = used(out)
    high = torch.tensor([wanted[0] / 2, wanted[1], wanted[2] / 2]).float()
    return fit_box(out, high * torch.tensor([-1.0, 0.0, -1.0]), high)


def _stretched(at: Float[np.ndarray, " verts"], rng: np.random.Generator) -> np.ndarray:
    """Places in [0, 1] moved so that stretches between knots change their lengths, ends kept."""
    steps = 1 + PROPORTION * rng.uniform(-1, 1, KNOTS)
    knots = np.concatenate([[0.0], steps.cumsum()]) / steps.sum()
    return np.interp(at, np.linspace(0, 1, KNOTS + 1), knots)


def _waves(at: Float[np.ndarray, "verts 3"], rng: np.random.Generator) -> np.ndarray:
    """A smooth displacement of root mean square one: a few long waves along each axis."""
    total = np.zeros_like(at)
    for _ in range(4):
        wave, phase = rng.normal(0, 3.0, 3), rng.uniform(0, 2 * np.pi)
        total += np.sin(at @ wave + phase)[:, None] * rng.normal(size=3)
    return total / np.sqrt(2.0)


def _grid(
    mesh: Triangles, cells: int, blur: float, level: float, *, matter: bool = False
) -> Triangles:
    """The surface of a grid's distances (or of its matter), blurred [cells]."""
    import igl
    from scipy.ndimage import gaussian_filter

    verts, faces = mesh
    cell = float(np.ptp(verts, axis=0).max()) / cells
    start = verts.min(0) - 4 * cell
    counts = (np.ceil(np.ptp(verts, axis=0) / cell) + 9).astype(int)
    axes = [start[k] + cell * np.arange(counts[k]) for k in range(3)]
    z, y, x = np.meshgrid(axes[2], axes[1], axes[0], indexing="ij")
    places = np.stack([x.ravel(), y.ravel(), z.ravel()], -1)
    signed = np.asarray(igl.signed_distance(places, verts, faces.astype(np.int64))[0]) / cell
    field = signed.reshape(counts[::-1].tolist()).clip(-3, 3)
    if matter:
        field = np.where(field < level, -1.0, 1.0)
        level = 0.2
    field = gaussian_filter(field, blur)
    return level_set(field.transpose(2, 1, 0), start, cell, level)


def _smooth(mesh: Triangles, rng: np.random.Generator) -> Triangles:
    """Thin parts grow by about a cell, or they would be lost."""
    blur = float(rng.uniform(0.7, 1.3))
    return _grid(mesh, int(rng.integers(*FINE)), blur, 0.3 + 0.6 * blur)


def _blocky(mesh: Triangles, rng: np.random.Generator) -> Triangles:
    return _grid(mesh, int(rng.integers(*COARSE)), 0.5, 0.75, matter=True)


def _sphere(mesh: Triangles, rng: np.random.Generator) -> Triangles:
    """A sphere drawn onto the surface, without the faces that bridge its gaps."""
    import igl
    import trimesh

    verts, faces = mesh
    ball = trimesh.creation.icosphere(subdivisions=4)
    shell = np.asarray(ball.faces)
    size = np.ptp(verts, axis=0)
    points = np.asarray(ball.vertices) * size * rng.uniform(0.55, 0.75) + verts.min(0) + size / 2
    ends = np.concatenate([shell[:, [0, 1]], shell[:, [1, 2]], shell[:, [2, 0]]])
    count = np.bincount(ends[:, 0], minlength=len(points))[:, None]
    for step in range(ROUNDS):
        onto = np.asarray(igl.point_mesh_squared_distance(points, verts, faces.astype(np.int64))[2])
        middle = np.zeros_like(points)
        np.add.at(middle, ends[:, 0], points[ends[:, 1]])
        pull = 0.3 + 0.5 * step / ROUNDS
        points = (1 - pull) * (middle / count) + pull * onto
    centre = points[shell].mean(1)
    off = np.asarray(igl.point_mesh_squared_distance(centre, verts, faces.astype(np.int64))[0])
    return points, shell[np.sqrt(off) < BRIDGE * size.max()]


def _soup(mesh: Triangles, rng: np.random.Generator) -> Triangles:
    """Faces without neighbours, some turned over, some with two sides."""
    import trimesh

    verts, faces = mesh
    longest = float(np.ptp(verts, axis=0).max()) / 6
    verts, faces = trimesh.remesh.subdivide_to_size(verts, faces, longest)[:2]
    turned = rng.uniform(size=len(faces)) < 0.3
    faces = np.where(turned[:, None], faces[:, ::-1], faces)
    twice = faces[rng.uniform(size=len(faces)) < 0.2]
    return np.asarray(verts), np.concatenate([faces, twice[:, ::-1]])


MAKERS = (_smooth, _blocky, _sphere, _soup)  #: the ways in which other programs make a mesh


SEATS_FOR_ONE = ("chair", "armchair", "office chair", "stool")


def other_shapes(
    objects: tuple[SceneObject, ...],
    furniture: tuple[Furniture, ...],
    share: float,
    make: Callable[[Furniture, np.random.Generator], Mesh],
    rngs: Sequence[np.random.Generator],
) -> tuple[SceneObject, ...]:
    """A share of the meshes replaced by what is made of the furniture that they show."""
    out: list[SceneObject] = []
    for thing, known, rng in zip(objects, furniture, rngs, strict=True):
        swap, mesh = float(rng.uniform()) < share, make(known, rng)
        out.append(replace(thing, mesh=mesh) if swap else thing)
    return tuple(out)


def other_design(known: Furniture, rng: np.random.Generator) -> Mesh:
    """Another design of the class that fills the same box."""
    new = another(known, rng)
    ratio = torch.tensor(known.size) / torch.tensor(new.size)
    return Mesh(new.mesh.verts * ratio, new.mesh.faces)


def noisy_bodies(room: KnownRoom, noise: NoiseConfig, rng: np.random.Generator) -> Bodies:
    """Bodies as a network would see them, skinned again from wrong pose parameters."""
    pose, keep = noisy_pose(room, noise, rng)
    verts, joints = open_body().posed(pose)
    whole = replace(room.bodies, verts=verts, joints=joints, pose=pose)
    return rounded_bodies(rows_of(whole, keep))


def noisy_pose(
    room: KnownRoom, noise: NoiseConfig, rng: np.random.Generator
) -> tuple[BodyPose, Tensor]:
    """Wrong pose parameters of all bodies (float64), and the rows that are not missing."""
    bodies = room.bodies
    assert bodies.pose is not None, "a known room has parameters"
    pose = map_tensors(lambda x: x.double(), bodies.pose)
    count = len(bodies.frame)
    people = bodies.person.numpy()
    assert bodies.fps is not None, "a known room is a video"
    when = bodies.frame.numpy(), people
    error = slow(rng, when, (22, 3), bodies.fps * noise.pose_seconds) * np.radians(noise.pose)
    if noise.pose_bias:
        stays = rng.normal(size=(int(people.max()) + 1, 22, 3)) * np.radians(noise.pose_bias)
        error = error + stays[people]
    hidden = hidden_rows(room) if noise.pose_hidden != 1 else np.zeros(count, dtype=bool)
    error = error * np.where(hidden, noise.pose_hidden, 1.0)[:, None, None]
    pose = _turned(pose, error)
    bias = 1 + noise.depth_bias * rng.uniform(-1, 1, int(people.max()) + 1)[people]
    drift = noise.depth_drift * slow(rng, when, (1,), bodies.fps)[:, 0]
    pelvis = open_body().joints_in(pose)[:, 0]
    shift = pelvis * torch.from_numpy(bias + drift - 1)[:, None]
    if noise.mean_bodies:
        pose, shift = _of_mean_shape(pose, pelvis, shift)
    shift = shift + torch.from_numpy(noise.jitter * rng.normal(size=(count, 3)))
    pose = replace(pose, transl=pose.transl + shift)
    keep = torch.from_numpy(np.flatnonzero(rng.uniform(size=count) >= noise.dropped))
    return pose, keep


def _of_mean_shape(pose: BodyPose, pelvis: Tensor, shift: Tensor) -> tuple[BodyPose, Tensor]:
    """Bodies of the mean shape, as large in the picture as they are, and shifted as much."""
    model = open_body()
    mean = replace(pose, betas=torch.zeros_like(pose.betas))

    def heights(some: BodyPose) -> Tensor:
        names = ("body_pose", "transl", "global_orient")
        upright = replace(some, **{name: torch.zeros_like(getattr(some, name)) for name in names})
        rest = model.posed(upright)[0][..., 1]
        return rest.amax(-1) - rest.amin(-1)

    share = (heights(mean) / heights(pose))[:, None]
    return mean, pelvis - model.posed(mean)[1][:, 0] + pelvis * (share - 1) + shift * share


def slow(
    rng: np.random.Generator,
    when: tuple[np.ndarray, np.ndarray],
    shape: tuple[int, ...],
    memory: float,
) -> np.ndarray:
    """Noise (rows, *shape) of variance one that forgets (Ornstein-Uhlenbeck).

    `when` is the frame and the person of each row, `memory` in frames.
    """
    fresh, each = rng.normal(size=(len(when[0]), *shape)), np.exp(-1 / memory)
    last: dict[int, int] = {}
    for row, (frame, person) in enumerate(zip(*when, strict=True)):  # builds on the one before
        before = last.get(int(person))
        if before is not None:
            kept = each ** float(frame - when[0][before])
            fresh[row] = kept * fresh[before] + np.sqrt(1 - kept**2) * fresh[row]
        last[int(person)] = row
    return fresh


def hidden_rows(room: KnownRoom) -> Bool[np.ndarray, " bodies"]:
    """Bodies of which less than half is seen, behind furniture or outside the image."""
    people = room.capture.people
    assert people is not None, "a known room has masks"
    seen = [int(decode(people.masks, row).sum()) for row in range(len(people.frame))]
    return np.array(seen) < 0.5 * room.whole.clamp_min(1).numpy()


def _turned(pose: BodyPose, error: Float[np.ndarray, "bodies 22 3"]) -> BodyPose:
    """Each joint's rotation followed by an error, as an axis-angle vector [rad]."""
    count = len(error)
    root = pose.global_orient.reshape(count, 1, 3)
    local = torch.cat([root, pose.body_pose.reshape(count, 21, 3)], 1).numpy()
    wrong = torch.from_numpy(to_vector(from_vector(local) @ from_vector(error)))
    return replace(pose, global_orient=wrong[:, 0], body_pose=wrong[:, 1:].reshape(count, -1))


# What a real camera makes of a reference picture: clutter whose lines are not the room's, a lens
# that bends lines, grain, and a JPEG's traces.


LENGTH = (0.03, 0.15)  # of the picture's width: longer side of what lies about
FLAT = (0.1, 0.6)  # its shorter side over the longer one
BLUR = 0.8  # [px]
QUALITY = 80  # of a JPEG


def worn_picture(capture: Capture, noise: NoiseConfig, rng: np.random.Generator) -> Capture:
    """The capture with clutter, a lens that bends lines, grain and JPEG in its picture."""
    if capture.reference is None or not (noise.things or noise.distortion or noise.grain):
        return capture
    import cv2
    from PIL import Image

    picture = (255 * capture.reference.double().numpy()).round()
    height, width = picture.shape[:2]
    for _ in range(noise.things):  # rectangles of any direction and colour
        middle = rng.uniform([0, 0], [width, height])
        angle, long = rng.uniform(0, np.pi), rng.uniform(*LENGTH) * width
        u = np.array([np.cos(angle), np.sin(angle)]) * long / 2
        v = np.array([-u[1], u[0]]) * rng.uniform(*FLAT)
        corners = np.array([middle - u - v, middle + u - v, middle + u + v, middle - u + v])
        colour = rng.uniform(40, 220, 3).tolist()
        cv2.fillConvexPoly(picture, corners.round().astype(np.int32), colour)
    k1, K = float(rng.normal(0, noise.distortion)), capture.scene.camera.K.double().numpy()
    if k1:
        bend = np.array([k1, 0.0, 0.0, 0.0])
        maps = cv2.initUndistortRectifyMap(K, bend, np.eye(3), K, (width, height), cv2.CV_32FC1)
        bent = cv2.remap(picture, *maps, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        picture = np.asarray(bent, np.float64)
    if noise.grain:
        soft = cv2.GaussianBlur(picture, (0, 0), BLUR)
        soft = soft + rng.normal(0, 255 * noise.grain, picture.shape)
        file = io.BytesIO()
        Image.fromarray(soft.clip(0, 255).astype(np.uint8)).save(file, "jpeg", quality=QUALITY)
        picture = np.asarray(Image.open(file), np.float64)
    return replace(capture, reference=torch.from_numpy(picture / 255).float())


@one_thread()
def add_noise(room: KnownRoom, noise: NoiseConfig, seed: int) -> Capture:
    """What upstream tools would estimate of a room; the same for the same seed on every machine.

    The guess of the camera is wrong, so the objects are given in a wrong world: they keep their
    box centres in the camera frame, and their fronts are projected onto its horizontal plane.
    """

    def stream(number: int) -> np.random.Generator:
        return np.random.default_rng([seed, number])

    camera, rng = _noisy_camera(room.truth.camera, noise, stream(0)), stream(1)
    objects = tuple(
        _noisy_object(thing, room.truth.camera, camera, noise, rng) for thing in room.truth.objects
    )
    kinds, count = room.furniture, len(objects)
    rngs = [stream(2)] * count
    objects = other_shapes(objects, kinds, noise.other_shapes, other_design, rngs)
    if noise.foreign:  # of which each has a stream of its own

        def foreign(known: Furniture, rng: np.random.Generator) -> Mesh:
            return foreign_mesh(known, noise.warp, rng)

        rngs = [np.random.default_rng([seed, 10, index]) for index in range(count)]
        objects = other_shapes(objects, kinds, noise.foreign, foreign, rngs)
    detections = room.capture.detections
    if noise.mask_head or noise.mask_box or noise.amodal:
        detections = masks.headed(detections, room.truth, noise, stream(11))
    detections = masks.noisy_detections(detections, noise.object_masks, stream(3))
    shown = room.capture.people
    people = masks.noisy_people(shown, noise.person_masks, noise.missed_masks, stream(5))
    capture = replace(
        room.capture, scene=Scene(camera, None, objects),
        bodies=noisy_bodies(room, noise, stream(4)),
        people=masks.wobbling(people, noise.wobble, stream(12)),
        detections=masks.leaking(detections, noise.leaks, stream(7)),
        furniture=masks.noisy_people(room.capture.furniture, noise.object_masks, 0.0, stream(14)),
    )  # fmt: skip
    assert room.truth.ground is not None, "a known room has a floor"
    capture = masks.noisy_finds(capture, room.truth.ground, noise, [seed, 9])
    capture = worn_picture(capture, noise, stream(15))
    return wrong_lens(capture, noise.lens, stream(13))


def without_seat(capture: Capture, room: KnownRoom) -> Capture:
    """The capture without the seat that is used most.

    A seat for one person, whose middle its sitter gives, goes before sofas, benches and beds.
    """
    resting = torch.tensor([action in ("sit", "lean", "lie") for action in room.actions])
    used = [int((room.touched[resting] == k).any(1).sum()) for k in range(len(room.furniture))]
    seats = [k for k, n in enumerate(used) if n and room.furniture[k].category in SEATS]
    single = [k for k in seats if room.furniture[k].category in SEATS_FOR_ONE]
    if not seats:
        return capture
    lost = room.truth.objects[max(single or seats, key=lambda k: used[k])]
    return masks.without(capture, {lost.annotation})


def wrong_lens(capture: Capture, mean: float, rng: np.random.Generator) -> Capture:
    """A capture made under another lens: widths are kept, depths are off, as the picture stays."""
    zoom = 1 + mean * float(rng.uniform(6 / 11, 16 / 11) * rng.choice([-1.0, 1.0]))
    if zoom == 1:
        return capture
    capture = replace(through_lens(capture, zoom), focal_spread=mean)
    return replace(capture, bodies=capture.bodies and rounded_bodies(capture.bodies))


def _noisy_camera(camera: Camera, noise: NoiseConfig, rng: np.random.Generator) -> Camera:
    pitch, roll = pitch_roll(camera.R_cam_world.double())
    error = np.radians(noise.camera) * rng.uniform(2 / 3, 4 / 3, 2) * rng.choice([-1.0, 1.0], 2)
    R = tilted(pitch + float(error[0]), roll + float(error[1])).float()
    return Camera(camera.K, R, camera.width, camera.height)


def _noisy_object(
    thing: SceneObject, true: Camera, wrong: Camera, noise: NoiseConfig, rng: np.random.Generator
) -> SceneObject:
    """The object in the world of the wrong camera, moved, rotated and stretched."""
    turn = wrong.R_cam_world.double().mT @ true.R_cam_world.double()
    low, high = thing.mesh.verts.amin(0).double(), thing.mesh.verts.amax(0).double()
    middle = (low + high) / 2 * thing.scale.double()
    yaw = thing.yaw.double()
    centre = turn @ (rot_y(yaw) @ middle + thing.t_world_object.double())
    front = turn @ torch.stack([yaw.sin(), torch.zeros_like(yaw), yaw.cos()])
    far = 1 + noise.along_ray * float(rng.uniform(-1, 1)) / float(centre.norm())
    aside = torch.from_numpy(noise.sideways * rng.uniform(-1, 1, 3))
    size = thing.scale.double() * far * torch.from_numpy(1 + noise.scale * rng.uniform(-1, 1, 3))
    off = np.radians(noise.yaw) * float(rng.uniform(-1, 1))
    quarter = float(rng.integers(1, 4)) if float(rng.uniform()) < noise.flips else 0.0
    angle = torch.atan2(front[0], front[2]) + off + quarter * np.pi / 2
    angle = torch.atan2(angle.sin(), angle.cos())
    t = centre * far + aside - rot_y(angle) @ ((low + high) / 2 * size)
    return replace(thing, t_world_object=t.float(), yaw=angle.float(), scale=size.float())
