"""Whether a capture can be true: sizes, distances and places that no room has, each with its field.

What cannot be is refused, so that nothing that grows with a number grows without a bound; what is
odd is a warning. All of a capture is checked here before any work, by `check` as by `run`.
"""

import math
from collections import defaultdict

import torch
from jaxtyping import Float
from torch import Tensor

from mover.core.errors import InputError
from mover.core.types import Bodies, Camera, Capture, Detection, SceneObject
from mover.furniture.library import canonical, unknown_names
from mover.geometry.boxes import box_of
from mover.geometry.camera import to_camera
from mover.io.capture.parts import UNKNOWN
from mover.io.files.fields import Warn, listed

LARGEST, SMALLEST = 30.0, 0.01  # [m], longest side of an object
FARTHEST = 100.0  # [m] from the camera
FAR = 30.0  # [m], odd for a room
ROOM = 4.0  # [m], usual
TURNS = 4 * math.pi  # [rad], a yaw beyond is odd: degrees?
MOST_TURNS = 1e3  # [rad], a yaw beyond has lost its digits
OFF = 8.0  # factor between the size of an object and what its box implies, from which it is odd
NEAREST = 0.05  # [m] from the camera, from where on a box implies a size
SHORTEST, LONGEST = 0.05, 10.0  # [m] across, of the usual body
USUAL = 1.8  # [m] across, of a body
NEAR_BODY = 0.3  # [m] from the camera to the middle of the usual body
TALLEST = 3.5  # [m] across, of any body
NEAR_LENS, FAR_LENS = 0.05, 100.0  # focal lengths, in sides of the picture
OFF_AXIS = 10.0  # sides of the picture from its corner to the axis of the lens
SQUARE = 1.5  # factor between the focal lengths along both sides, odd from there on
ASIDE = 0.1  # shares of the picture between its border and the axis of the lens
STRETCH = 50.0  # factor between the scales of an object along its axes, odd from there on
WINDOW, FASTEST, FEWEST = 0.2, 3.0, 10  # [s] and [m/s] of people in a room; windows that show it
JOINTS_OFF = 0.5  # [m] from the box of a mesh to its joints
UNITS = {"millimetres": 1000.0, "centimetres": 100.0, "inches": 39.37}
SCENE = "scene.json"


def check_plausible(capture: Capture, warn: Warn) -> None:
    """Look at everything that a capture says."""
    known = {d.id: d for d in capture.detections}
    camera = capture.scene.camera
    _check_lens(camera, warn)
    if unknown := unknown_names(one.category for one in capture.scene.objects):
        warn(f"{SCENE}: {unknown}")
    named = [(f"{SCENE}: field 'objects[{i}].{{}}' of {one.id}", one)
             for i, one in enumerate(capture.scene.objects)]  # fmt: skip
    named += [(f"hypotheses.json: '{{}}' of a place of {h.id}", h) for h in capture.hypotheses]
    for name, one in named:
        detection = None if one.annotation is None else known.get(one.annotation)
        _check_place(name, one, camera, detection, warn)
        _check_size(name, one, camera, detection, warn)
    _check_pairs(capture, known, warn)
    if capture.bodies is not None:
        check_bodies(capture.bodies, "bodies.npz", warn)
    if capture.bodies is not None and capture.people is not None:
        tracks = {*capture.people.person.tolist(), *capture.bodies.person.tolist()}
        if lost := [name for name in capture.people.heights if int(name) not in tracks]:
            unknown = listed("unknown track", lost)
            warn(f"people.json: field 'info.heights' has the height of {unknown}")


def _nearest_unit(factor: float) -> tuple[float, str]:
    """How far off the nearest unit is (of the logarithm) if lengths are too large by a factor."""
    return min((abs(math.log(k) - math.log(max(factor, 1e-9))), name) for name, k in UNITS.items())


def _check_lens(camera: Camera, warn: Warn) -> None:
    """Pixels are square and the axis of the lens is near the middle, as cameras have it."""
    K, sides = camera.K, (camera.width, camera.height)
    for axis, (name, side) in enumerate(zip("xy", sides, strict=True)):
        for field, value, low, high in (
            (f"fl_{name}", float(K[axis, axis]), NEAR_LENS, FAR_LENS),
            (f"c{name}", float(K[axis, 2]), -OFF_AXIS, OFF_AXIS),
        ):
            if not low * side <= value <= high * side:
                bounds = f"{low * side:g} to {high * side:g} px for {side} px"
                raise InputError(f"camera.json: field '{field}' has {value:g}, expected {bounds}")
    if not 1 / SQUARE < float(K[0, 0] / K[1, 1]) < SQUARE:
        warn(f"camera.json: fl_x {float(K[0, 0]):g} and fl_y {float(K[1, 1]):g} differ much")
    if not all(ASIDE < float(K[i, 2]) / side < 1 - ASIDE for i, side in enumerate(sides)):
        place = f"({float(K[0, 2]):g}, {float(K[1, 2]):g})"
        warn(f"camera.json: cx, cy {place} are far from the middle; is it a part of a picture?")


def _check_place(
    name: str, one: SceneObject, camera: Camera, detection: Detection | None, warn: Warn
) -> None:
    """Objects are near, before the camera that sees them, and not turned beyond measure."""
    away, yaw = float(one.t_world_object.norm()), float(one.yaw)
    place, angle = name.format("translation"), name.format("yaw")
    if not away <= FARTHEST:
        _, unit = _nearest_unit(away / ROOM)
        raise InputError(
            f"{place} is {away:.3g} m away, expected at most {FARTHEST:g} m; is it in {unit}?"
        )
    if not abs(yaw) <= MOST_TURNS:
        raise InputError(f"{angle} has {yaw:.3g} rad, expected {-MOST_TURNS:g} to {MOST_TURNS:g}")
    if abs(yaw) > TURNS:
        warn(f"{angle} has {yaw:.3g}; is it in radians?")
    if away > FAR:
        warn(f"{place} is {away:.3g} m away; is it in metres?")
    depth = float(to_camera(box_of(one).center[None], camera.R_cam_world)[0, 2])
    if detection is not None and depth <= 0:
        warn(f"{place} puts it {-depth:.2g} m behind the camera that sees it")


def _check_size(
    name: str, one: SceneObject, camera: Camera, detection: Detection | None, warn: Warn
) -> None:
    """Objects have the size of furniture, and nearly that which box and distance imply."""
    size, ratio, advice = float(box_of(one).size.max()), 1.0, ""
    away = float(one.t_world_object.norm())  # whatever axes it has
    if detection is not None and away > NEAREST:
        wide, high = (detection.box[2:] - detection.box[:2]) / camera.K.diagonal()[:2]
        implied = max(float(wide), float(high)) * away
        ratio = size / implied
        advice = f", as its box at its distance implies about {implied:.2g}"
    is_odd = not 1 / OFF < ratio < OFF
    if is_odd:
        off, unit = _nearest_unit(ratio)
        cure = f"multiply 'scale' by {1 / ratio:.2g}, or move it"
        if off < math.log(3):
            cure = f"is its mesh in {unit}? Multiply 'scale' by {1 / UNITS[unit]:.4g}"
        advice += f": {cure}"
    found = f"{name.format('scale')} makes it {size:.3g} m large"
    if not SMALLEST <= size <= LARGEST:
        raise InputError(f"{found}, expected {SMALLEST:g} to {LARGEST:g} m{advice}")
    if is_odd:
        warn(f"{found}{advice}")
    if float(one.scale.max() / one.scale.min()) > STRETCH:
        warn(f"{name.format('scale')} has {[round(float(x), 9) for x in one.scale]}: is it flat?")


def _check_pairs(capture: Capture, known: dict[int, Detection], warn: Warn) -> None:
    """Each annotation has its own mask, and the category of its object."""
    same: dict[bytes, list[str]] = defaultdict(list)
    for one in capture.scene.objects:
        detection = None if one.annotation is None else known.get(one.annotation)
        if detection is None:
            continue
        if detection.mask is not None:
            same[detection.mask.counts[0]].append(one.id)
        kinds = {canonical(one.category), canonical(detection.category)}
        if len(kinds) > 1 and UNKNOWN not in kinds:
            other = f"its annotation {detection.id} a {detection.category}"
            warn(f"{SCENE}: {one.id} is a {one.category}, {other}")
    for ids in same.values():
        if len(ids) > 1:
            warn(f"objects.json: {listed('object', ids)} have one and the same mask")


def check_bodies(bodies: Bodies, file: str, warn: Warn) -> None:
    """Bodies have the size of people, are near, before the camera, and around their joints.

    Raises:
        InputError: If they cannot be people whom this camera sees.
    """
    low, high = bodies.verts.amin(1), bodies.verts.amax(1)
    extent = (high - low).norm(dim=-1)
    middle = float(extent.median())
    field = f"{file}: field 'vertices'"
    if not SHORTEST <= middle <= LONGEST:
        off, name = _nearest_unit(middle / USUAL)
        unit = f", as in {name}" if off < 0.5 else ""
        raise InputError(
            f"{field} has bodies that measure {middle:.4g} across{unit}; are they in metres,"
            f" expected {SHORTEST:g} to {LONGEST:g} m?"
        )
    far = torch.maximum(low.abs(), high.abs()).amax(-1)
    if not bool((far <= FARTHEST).all()):
        row = int(far.argmax())
        reach = f"reaches {float(far[row]):.3g} m away in row {row}"
        raise InputError(f"{field} {reach}, expected at most {FARTHEST:g} m")
    away = float(((low + high) / 2).norm(dim=-1).median())
    if bodies.space == "camera" and away < NEAR_BODY:
        raise InputError(
            f"{field} has bodies at the camera itself ({away:.2g} m away), expected metres before"
            " it; was the translation left out?"
        )
    if bodies.space == "camera" and float(bodies.verts[..., 2].median()) <= 0:
        raise InputError(
            f"{field} has most of the bodies behind the camera, expected z above 0 (the camera"
            " frame is x right, y down, z forward); is 'space' (camera or world) right?"
        )
    if odd := int((extent > 2 * TALLEST).sum()):
        warn(f"{file}: {odd} of {len(extent)} bodies measure more than {2 * TALLEST:g} m across")
    if bodies.fps and (speed := _usual_most(bodies, (low + high) / 2)) > FASTEST:
        rate = f"is the frame rate {bodies.fps:g} right (--fps)?"
        warn(f"{file}: people move at {speed:.0f} m/s and more in a tenth of the video; {rate}")
    if bodies.joints is not None:
        below, above = low[:, None] - bodies.joints, bodies.joints - high[:, None]
        off = torch.maximum(below, above).clamp_min(0).norm(dim=-1).amax(-1).median()
        if not float(off) <= JOINTS_OFF:
            warn(f"{file}: field 'joints' is {float(off):.2g} m off the meshes")


def _usual_most(bodies: Bodies, middle: Float[Tensor, "bodies 3"]) -> float:
    """Speed that people exceed in a tenth of the times, over `WINDOW` [m/s]; 0: too few times."""
    assert bodies.fps is not None
    wide, found = max(1, round(WINDOW * bodies.fps)), [torch.zeros(0)]
    for person in bodies.person.unique():
        rows = (bodies.person == person).nonzero()[:, 0]
        rows = rows[bodies.frame[rows].argsort()]
        frame = bodies.frame[rows]
        later = torch.searchsorted(frame, frame + wide)
        here = later < len(rows)
        a, b = rows[here], rows[later[here]]
        time = (bodies.frame[b] - bodies.frame[a]) / bodies.fps
        found.append((middle[b] - middle[a]).norm(dim=-1).cpu() / time.cpu())
    speeds = torch.cat(found)
    return float(speeds.quantile(0.9)) if len(speeds) >= FEWEST else 0.0
