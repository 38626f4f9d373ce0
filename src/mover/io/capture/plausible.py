"""Whether a capture can be true: sizes, distances and places that no room has, each with its field.

What cannot be is refused, so that nothing that grows with a number grows without a bound; what is
odd is a warning. All of a capture is checked here before any work, by `check` as by `run`.
"""

import math
from collections import defaultdict
from collections.abc import Iterator

import torch

from mover.core.errors import InputError
from mover.core.types import Bodies, Camera, Capture, Detection, People, SceneObject
from mover.furniture.library import canonical
from mover.geometry.boxes import box_of
from mover.geometry.camera import to_camera
from mover.io.capture.parts import UNKNOWN
from mover.io.files.fields import Warn, listed

LARGEST, SMALLEST = 30.0, 0.01  # [m], longest side of an object
FARTHEST = 100.0  # [m] from the camera
FAR = 30.0  # [m], odd for a room
TURNS = 4 * math.pi  # [rad], a yaw beyond is odd: degrees?
MOST_TURNS = 1e3  # [rad], a yaw beyond has lost its digits
OFF = 8.0  # factor between the size of an object and what its box implies, from which it is odd
NEAREST = 0.05  # [m] before the camera, from where on a box implies a size
SHORTEST, LONGEST = 0.05, 10.0  # [m] across, of the usual body
TALLEST = 3.5  # [m] across, of any body
NEAR_LENS, FAR_LENS = 0.05, 100.0  # focal lengths, in sides of the picture
OFF_AXIS = 10.0  # sides of the picture from its corner to the axis of the lens
SQUARE = 1.5  # factor between the focal lengths along both sides, odd from there on
ASIDE = 0.1  # shares of the picture between its border and the axis of the lens
STRETCH = 50.0  # factor between the scales of an object along its axes, odd from there on
JOINTS_OFF = 0.5  # [m] from the box of a mesh to its joints
UNITS = {"millimetres": 1000.0, "centimetres": 100.0, "inches": 39.37}
SCENE, BODIES = "scene.json", "bodies.npz"


def check_plausible(capture: Capture, warn: Warn) -> None:
    """Look at everything that a capture says.

    Raises:
        InputError: If something cannot be: file, field, found, expected.
    """
    known = {d.id: d for d in capture.detections}
    camera = capture.scene.camera
    _check_lens(camera, warn)
    for name, piece in _pieces(capture):
        seen = None if piece.annotation is None else known.get(piece.annotation)
        _check_place(name, piece, camera, seen, warn)
        _check_size(name, piece, camera, seen, warn)
    _check_pairs(capture, known, warn)
    if capture.bodies is not None:
        check_bodies(capture.bodies, BODIES, warn)
        if capture.people is not None:
            _check_heights(capture.people, capture.bodies, warn)


def _pieces(capture: Capture) -> Iterator[tuple[str, SceneObject]]:
    """All objects, with how messages call them."""
    for i, piece in enumerate(capture.scene.objects):
        yield f"{SCENE}: field 'objects[{i}].{{}}' of {piece.id}", piece
    for piece in capture.hypotheses:
        yield f"hypotheses.json: '{{}}' of a place of {piece.id}", piece


def _check_lens(camera: Camera, warn: Warn) -> None:
    """Pixels are square and the axis of the lens is near the middle, as cameras have it."""
    K = camera.K
    sides = (("x", camera.width), ("y", camera.height))
    for axis, (name, side) in enumerate(sides):
        focal, centre = float(K[axis, axis]), float(K[axis, 2])
        if not NEAR_LENS * side <= focal <= FAR_LENS * side:
            bounds = f"{NEAR_LENS * side:g} to {FAR_LENS * side:g} px for {side} px"
            raise InputError(f"camera.json: field 'fl_{name}' has {focal:g}, expected {bounds}")
        if not abs(centre) <= OFF_AXIS * side:
            bounds = f"{-OFF_AXIS * side:g} to {OFF_AXIS * side:g} px for {side} px"
            raise InputError(f"camera.json: field 'c{name}' has {centre:g}, expected {bounds}")
    if not 1 / SQUARE < float(K[0, 0] / K[1, 1]) < SQUARE:
        warn(f"camera.json: fl_x {float(K[0, 0]):g} and fl_y {float(K[1, 1]):g} differ much")
    middle = float(K[0, 2]) / camera.width, float(K[1, 2]) / camera.height
    if not all(ASIDE < share < 1 - ASIDE for share in middle):
        place = f"({float(K[0, 2]):g}, {float(K[1, 2]):g})"
        warn(f"camera.json: cx, cy {place} are far from the middle; is it a part of a picture?")


def _check_place(
    name: str, piece: SceneObject, camera: Camera, seen: Detection | None, warn: Warn
) -> None:
    """Objects are near, before the camera that sees them, and not turned beyond measure."""
    away, yaw = float(piece.t_world_object.norm()), float(piece.yaw)
    if not away <= FARTHEST:
        place = name.format("translation")
        raise InputError(f"{place} is {away:.3g} m away, expected at most {FARTHEST:g} m")
    if not abs(yaw) <= MOST_TURNS:
        raise InputError(
            f"{name.format('yaw')} has {yaw:.3g} rad, expected {-MOST_TURNS:g} to {MOST_TURNS:g}"
        )
    if abs(yaw) > TURNS:
        warn(f"{name.format('yaw')} has {yaw:.3g}; is it in radians?")
    if away > FAR:
        warn(f"{name.format('translation')} is {away:.3g} m away; is it in metres?")
    depth = float(to_camera(box_of(piece).center[None], camera.R_cam_world)[0, 2])
    if seen is not None and depth <= 0:
        warn(f"{name.format('translation')} puts it {-depth:.2g} m behind the camera that sees it")


def _check_size(
    name: str, piece: SceneObject, camera: Camera, seen: Detection | None, warn: Warn
) -> None:
    """Objects have the size of furniture, and nearly that which box and distance imply."""
    size = float(box_of(piece).size.max())
    implied = None if seen is None else _implied(piece, camera, seen)
    ratio = 1.0 if implied is None else size / implied
    advice = "" if implied is None else f", as its box at its distance implies about {implied:.2g}"
    if implied is not None and not 1 / OFF < ratio < OFF:
        advice += f": {_factor(ratio)}"
    found = f"{name.format('scale')} makes it {size:.3g} m large"
    if not SMALLEST <= size <= LARGEST:
        raise InputError(f"{found}, expected {SMALLEST:g} to {LARGEST:g} m{advice}")
    if not 1 / OFF < ratio < OFF:
        warn(f"{found}{advice}")
    if float(piece.scale.max() / piece.scale.min()) > STRETCH:
        warn(f"{name.format('scale')} has {[round(float(x), 9) for x in piece.scale]}: is it flat?")


def _implied(piece: SceneObject, camera: Camera, seen: Detection) -> float | None:
    """The size that an object's box has at the distance of its origin [m]; None: behind."""
    depth = float(to_camera(piece.t_world_object[None], camera.R_cam_world)[0, 2])
    if not depth > NEAREST:
        return None
    wide, high = (seen.box[2:] - seen.box[:2]) / camera.K.diagonal()[:2]
    return max(float(wide), float(high)) * depth


def _factor(ratio: float) -> str:
    """What a wrong size may come from, and its cure."""
    unit = min(UNITS, key=lambda name: abs(math.log(UNITS[name] / ratio)))
    if 1 / 3 < UNITS[unit] / ratio < 3:
        return f"is its mesh in {unit}? Multiply 'scale' by {1 / UNITS[unit]:.4g}"
    return f"multiply 'scale' by {1 / ratio:.2g}, or move it"


def _check_pairs(capture: Capture, known: dict[int, Detection], warn: Warn) -> None:
    """Each annotation has its own mask, and the category of its object."""
    same: dict[bytes, list[str]] = defaultdict(list)
    for piece in capture.scene.objects:
        seen = None if piece.annotation is None else known.get(piece.annotation)
        if seen is None:
            continue
        if seen.mask is not None:
            same[seen.mask.counts[0]].append(piece.id)
        kinds = {canonical(piece.category), canonical(seen.category)}
        if len(kinds) > 1 and UNKNOWN not in kinds:
            warn(
                f"{SCENE}: {piece.id} is a {piece.category}, its annotation {seen.id} a"
                f" {seen.category}"
            )
    for ids in same.values():
        if len(ids) > 1:
            warn(f"objects.json: {listed('object', ids)} have one and the same mask")


def check_bodies(bodies: Bodies, file: str, warn: Warn) -> None:
    """Bodies have the size of people, are near, before the camera, and around their joints.

    Args:
        bodies: In camera axes, or in the world.
        file: How messages call their file.
        warn: Takes what is odd but may be.

    Raises:
        InputError: If they cannot be people whom this camera sees.
    """
    low, high = bodies.verts.amin(1), bodies.verts.amax(1)
    extent = (high - low).norm(dim=-1)
    middle = float(extent.median())
    if not SHORTEST <= middle <= LONGEST:
        units = [name for name, per_metre in UNITS.items() if 0.5 < middle / per_metre < 3]
        unit = f", so {units[0]}?" if units else ""
        raise InputError(
            f"{file}: field 'vertices' has bodies that measure {middle:.3g} across{unit}; are they"
            f" in metres, expected {SHORTEST:g} to {LONGEST:g} m?"
        )
    far = torch.maximum(low.abs(), high.abs()).amax(-1)
    if not bool((far <= FARTHEST).all()):
        row = int(far.argmax())
        raise InputError(
            f"{file}: field 'vertices' reaches {float(far[row]):.3g} m away in row {row}, expected"
            f" at most {FARTHEST:g} m"
        )
    if bodies.space == "camera" and float(bodies.verts[..., 2].median()) <= 0:
        raise InputError(
            f"{file}: field 'vertices' has most of the bodies behind the camera, expected z above 0"
            " (the camera frame is x right, y down, z forward)"
        )
    if odd := int((extent > 2 * TALLEST).sum()):
        warn(f"{file}: {odd} of {len(extent)} bodies measure more than {2 * TALLEST:g} m across")
    if bodies.joints is not None:
        below, above = low[:, None] - bodies.joints, bodies.joints - high[:, None]
        off = torch.maximum(below, above).clamp_min(0).norm(dim=-1).amax(-1).median()
        if not float(off) <= JOINTS_OFF:
            warn(f"{file}: field 'joints' is {float(off):.2g} m off the meshes")


def _check_heights(people: People, bodies: Bodies, warn: Warn) -> None:
    """Known heights are of people who are there."""
    tracks = set(people.person.tolist()) | set(bodies.person.tolist())
    if lost := [name for name in people.heights if int(name) not in tracks]:
        warn(f"people.json: field 'info.heights' has the height of {listed('unknown track', lost)}")
