"""What users get wrong with captures: one table of faults, each with what undoes it and its cure.

A fault is a hypothesis: a capture with it agrees clearly better with itself once it is undone.
"""

import functools
import math
import shutil
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import torch
from jaxtyping import Float
from torch import Tensor

from mover.core.errors import InputError
from mover.core.types import Camera, Capture, SceneObject
from mover.furniture.library import canonical
from mover.geometry.boxes import iou2d
from mover.geometry.camera import to_camera
from mover.geometry.placement import place_object
from mover.geometry.rle import mask_boxes
from mover.io.capture import agreement as agree
from mover.io.capture import mends
from mover.io.capture.folder import lacking, write_capture
from mover.io.files.fields import listed

MARGIN = 0.06  # a fault is named from this gain on: unharmed known rooms have none above 0.01
FITTED_MARGIN = 0.12  # the same where numbers are fitted, which fit noise, too
TIME_MARGIN = 0.02  # of times, which are sharp: unharmed rooms lose .03 by a frame
ALONE = 0.4  # the same of one object: its own overlap
WORSE = 0.1  # what a fault of all may cost the median object
SAME = 0.01  # by so much better is a fault of frames one by one than a simpler one
MOST_FAULTS = 3  # that are found one after the other
MOST_SHIFT = 120  # frames
USUAL = (5, 6, 10, 12, 15, 20, 24, 25, 30, 50, 60, 120)  # frames a second
RATES = tuple(sorted({a / b for a in USUAL for b in USUAL if b < a <= 12 * b}))
UNITS = {"feet": 3.2808, "decimetres": 10.0, "inches": 39.37, "centimetres": 100.0,
         "millimetres": 1000.0, "kilometres": 0.001, "tens of metres": 0.1}  # fmt: skip
POOR = 0.2  # mean overlap below which parts of a capture are of different pictures
POOR_OBJECTS = 0.4  # the same of objects: initial scenes of known and real rooms have .46 and more
MISSED = 0.1  # overlap below which an object is not at its annotation: those have .23 and more
FITTED_TIME = 0.35  # mean overlap that other times must reach: another video's reach .18
FITS = 0.45  # mean overlap that another lens must reach: other pictures reach .34
FEWEST = 3  # outlines that show a lens, rows that show a time
SCALES = 1.03 ** torch.arange(-55.0, 56.0)  # between lenses, or sizes


@dataclass(frozen=True)
class Fault:
    """A hypothesis of what is wrong."""

    name: str
    cure: str
    mend: mends.Mend
    """The capture without it; the same one where it cannot have it."""
    margin: float = MARGIN


@dataclass(frozen=True)
class Findings:
    """How well a capture lies on its picture."""

    agreement: agree.Agreement
    """As it is given."""
    faults: tuple[Fault, ...]
    unexplained: tuple[str, ...]
    """What does not fit, without a hypothesis that explains it."""
    by_joints: bool
    """Whether keypoints showed the people, as they have no masks."""

    @property
    def warnings(self) -> tuple[str, ...]:
        """A sentence each."""
        said = (*(f"{fault.name}; {fault.cure}" for fault in self.faults), *self.unexplained)
        if not self.by_joints:
            return said
        joints = (text.replace("people.json", "keypoints").replace("masks", "keypoints")
                  if text.startswith(("bodies", "people")) else text for text in said)  # fmt: skip
        return tuple(joints)

    @property
    def summary(self) -> tuple[str, ...]:
        """How far outlines and masks share the picture, as they are given."""
        seen = f"bodies and their {'keypoints' if self.by_joints else 'masks'}"
        known = {"objects and their annotations": self.agreement.objects,
                 seen: self.agreement.people}  # fmt: skip
        lines = [f"in the picture, {name} share {100 * mean(score):.0f} % of their boxes"
                 for name, score in known.items() if not bool(score.isnan().all())]  # fmt: skip
        if len(self.agreement.heights) and bool(self.agreement.people.isnan().all()):
            lines.append("bodies could not be held against the picture, as they have no masks or"
                         " keypoints: their times, their lens, their left and right")  # fmt: skip
        return tuple(lines)


def check_against_picture(capture: Capture) -> Findings:
    """Hold scene, bodies and masks of a capture against each other: all lie in one picture."""
    thin, by_joints = agree.thinned_capture(capture), capture.people is None
    if by_joints:
        thin = mends.same_tracks(thin)
    own = agree.agreement(thin)
    faults, mended, found = _faults(thin, own)
    if len(own.objects) and mean(found.objects) < POOR:  # no cure leads to where objects are seen
        faults = [one for one in faults if not one.name.startswith(("scene.json", "camera.json"))]
        mended = functools.reduce(lambda x, one: one.mend(x), faults, thin)
        found = agree.agreement(mended)
    return Findings(own, tuple(faults), tuple(_unexplained(mended, found)), by_joints)


def _faults(thin: Capture, found: agree.Agreement) -> tuple[list[Fault], Capture, agree.Agreement]:
    """One fault after the other, the worst first, and the capture without them."""
    faults: list[Fault] = []
    while len(faults) < MOST_FAULTS:
        best, least = None, 0.0
        for fault in hypotheses(thin, found):
            other = fault.mend(thin)
            if other is thin:
                continue
            better = agree.agreement(other, (thin, found))
            gain = _gain(found, better) - fault.margin
            if gain > least:
                best, least = (fault, other, better), gain
        if best is None:
            break
        fault, thin, found = best
        faults.append(fault)
    return faults, thin, found


def write_mended(capture: Capture, findings: Findings, source: Path, folder: Path) -> None:
    """Write a capture without its faults; what else is in its folder is copied.

    Raises:
        InputError: If there is such a folder already.
    """
    if folder.exists():
        raise InputError(f"{folder}: is there already, expected a new folder for the capture")
    if (source / "scene.json").is_file():
        none = lacking(capture)  # such as a people.json without people
        shutil.copytree(source, folder, ignore=lambda _, names: none & {*names})
    for fault in findings.faults:
        capture = fault.mend(capture)
    write_capture(capture, folder)


def mean(score: Float[Tensor, " n"]) -> float:
    """Of what can be compared; 0 where nothing can."""
    known = score[~score.isnan()]
    return float(known.mean()) if len(known) else 0.0


def _gain(own: agree.Agreement, other: agree.Agreement) -> float:
    """By how much the scores of another capture are better.

    None where masks lose their bodies, or where few objects gain what most of them lose.
    """
    before, after = (int((~one.people.isnan()).sum()) for one in (own, other))
    same = own.objects.shape == other.objects.shape and len(own.objects)
    lost = float((other.objects - own.objects).median()) if same else 0.0
    pairs = [(getattr(own, name), getattr(other, name)) for name in agree.SCORES]
    none = after < before / 2 or lost < -WORSE
    return -1.0 if none else sum(mean(b) - mean(a) for a, b in pairs)


def _unexplained(thin: Capture, found: agree.Agreement) -> Iterator[str]:
    """What fits nothing, and that nothing could be compared."""
    seen, both = ~found.people.isnan(), "(mean overlap in the picture {:.2f})"
    rows = int(seen.sum())
    if not len(found.objects) and not rows:
        yield "nothing could be held against the picture: no object or body has a box or a mask"
    known, _ = agree.annotated(thin)
    scores = zip(known, found.objects, strict=False)
    away = [one.id for one, score in scores if float(score) < MISSED]
    if len(found.objects) > 1 and mean(found.objects) < POOR_OBJECTS:
        missed = f"scene.json: the objects miss their annotations {both}".format
        yield f"{missed(mean(found.objects))}; are scene, camera and picture of one room?"
    elif away:
        yield f"scene.json: {listed('object', away)} not where the annotation is; is it its own?"
    if rows >= FEWEST and mean(found.people) < POOR:
        missed = f"bodies.npz: the bodies miss their masks {both}".format
        yield f"{missed(mean(found.people))}; are bodies, masks and camera of one video?"
        return
    person = torch.zeros(0) if thin.bodies is None or not rows else thin.bodies.person
    for one in person.unique().tolist():
        own = seen & (person == one)
        if not own.any() and thin.keypoints is not None:  # without a mask: said by the reader
            yield f"bodies.npz: no keypoints show person {one}, whom the bodies have"
        elif int(own.sum()) >= FEWEST and mean(found.people[own]) < POOR:
            missed = f"bodies.npz: the bodies of person {one} miss their masks {both}".format
            yield f"{missed(mean(found.people[own]))}; are they of this video?"


WORLDS = {
    "on the side (+z is up)": ("x z -y", 1, "+y must be up (import glb, boxes: --up z)"),
    "on the side (+z is down)": ("x -z y", 1, "+y must be up"),
    "on the side (+x is up)": ("-y x z", 1, "+y must be up"),
    "that of ROS (x is forward, +z is up)": ("-y z -x", 1, "+y must be up, -z forward"),
    "upside down (+y is down)": ("x -y -z", -1, "+y must be up (import glb, boxes: --up=-y)"),
    "upside down (only y is turned)": ("x -y z", 1, "change the sign of y"),
    "behind the camera (+z is forward)": ("x y -z", -1, "the camera looks along -z"),
    "turned round (+z is forward)": ("-x y -z", 1, "the camera looks along -z"),
    "mirrored (left and right are swapped)": ("-x y z", -1, "change the sign of x"),
    "of another handedness (y and z are swapped)": ("x z y", -1, "exchange y and z"),
}  # fmt: skip
"""Worlds in which a scene may be: its axes, the sign of yaw, and what helps."""
TWICE = "they are in the world already: translation 0, yaw 0, scale 1"
PEOPLE = {"mirrored": "-x y z", "flipped": "x -y z", "upside down": "-x -y z"}
UP = "R_cam_world maps the world (+y up) to the camera (x right, y down, z forward)"


def hypotheses(capture: Capture, found: agree.Agreement) -> Iterator[Fault]:
    """All faults that a (thinned) capture may have; of equals, the first is meant."""
    yield from _worlds()
    yield from _alone(capture, found)
    for unit, k in UNITS.items():
        cure, scale = f"multiply by {1 / k:.4g}", mends.scaled
        for what, by in (
            ("scene.json: sizes and positions", partial(mends.each, scale(1 / k, 1 / k))),
            ("scene.json: sizes", partial(mends.each, scale(1 / k, 1))),
            ("scene.json: positions", partial(mends.each, scale(1, 1 / k))),
            ("bodies.npz: vertices", partial(mends.people, torch.eye(3) / k)),
        ):
            yield Fault(f"{what} are in {unit}", cure, by)
    yaws = torch.stack([*(one.yaw for one in capture.scene.objects), torch.zeros(())])
    if float(yaws.abs().max()) > agree.FULL_TURN or bool((yaws == yaws.round()).all()):
        mend = partial(mends.each, mends.in_radians)
        yield Fault("scene.json: 'yaw' is in degrees", "give it in radians", mend)
    for what, mend in (
        ("looks up instead of down, or down instead of up", partial(mends.tilt, -1, 0.0)),
        ("is upside down", partial(mends.tilt, -1, math.pi)),
        ("is upside down, as is the scene", mends.head_up),
    ):
        yield Fault(f"camera.json: the camera {what}", UP, mend)
    yield Fault("people.json: the masks are inverted", "invert them", mends.inverted_people)
    yield Fault("objects.json: the masks are inverted", "invert them", mends.inverted_objects)
    corners = "objects.json: the boxes are [x1, y1, x2, y2]"
    yield Fault(corners, "COCO's are [x, y, w, h]", mends.boxes_of_corners)
    for name, axes in PEOPLE.items():
        cure = "the camera's axes are x right, y down, z forward"
        mend = partial(mends.people, mends.axes(axes))
        yield Fault(f"bodies.npz: the bodies are {name} in the picture", cure, mend)
    into_camera = partial(mends.people, capture.scene.camera.R_cam_world)
    yield Fault("bodies.npz: the bodies are in the world", "'space' is world", into_camera)
    tracks = "people.json: masks and bodies of one person have different tracks"
    yield Fault(tracks, "give both the same", mends.same_tracks)
    for fitted in (_times, _swaps, _annotations, _lenses):
        yield from fitted(capture, found)


def _worlds() -> Iterator[Fault]:
    """Other axes of positions, of all, and of meshes, whose front a box does not show."""
    for name, (rows, sign, cure) in WORLDS.items():
        A = mends.axes(rows)
        for what, change in (
            ("the world is", partial(mends.placed, A, sign)),
            ("world and meshes are", lambda x, A=A: mends.baked(place_object(x).verts @ A.mT, x)),
            ("the meshes are", partial(mends.remeshed, A)),
        ):
            if what != "the meshes are" or (A[1, 1] != 1 and A.det() > 0):
                yield Fault(f"scene.json: {what} {name}", cure, partial(mends.each, change))
    twice = partial(mends.each, lambda one: mends.baked(one.mesh.verts, one))
    yield Fault("scene.json: the meshes are placed twice", TWICE, twice)


def _alone(capture: Capture, found: agree.Agreement) -> Iterator[Fault]:
    """Objects that are nearly nowhere to be seen, by mesh or size, and one inverted mask."""
    known, boxes = agree.annotated(capture)
    names = {one.annotation: one.id for one in known}
    for d in capture.detections if len(capture.detections) > 1 else ():
        if d.mask is not None and not bool(agree.bounded([d.mask])[0]):
            name = f"objects.json: the mask of {names.get(d.id, f'annotation {d.id}')} is inverted"
            mend = partial(mends.inverted_objects, only=d.id)
            yield Fault(name, "invert it", mend, ALONE / len(capture.detections))
    if 1 < len(known) == len(found.objects):
        for at in found.objects.argsort(stable=True)[:MOST_FAULTS].tolist():
            if float(found.objects[at]) <= 1 - ALONE:
                margin = ALONE / len(known)
                yield from _of_one(known[at], boxes[at], capture.scene.camera, margin)


def _of_one(
    one: SceneObject, box: Float[Tensor, "4"], camera: Camera, margin: float
) -> Iterator[Fault]:
    """What its mesh or size may be instead."""
    name, (rows, *_) = next(iter(WORLDS.items()))
    factors = SCALES.square().tolist()
    ours = agree.outlines([mends.scaled(k, 1)(one) for k in factors], camera)
    k = factors[int(iou2d(agree.in_image(ours, camera), box.expand_as(ours)).argmax())]
    size = f"{1 / k:.2g} times too large" if k < 1 else f"{k:.2g} times too small"
    twice = mends.baked(one.mesh.verts, one)
    changes = [
        (f"the mesh of {one.id} is {name}", "turn it: +y must be up",
         mends.remeshed(mends.axes(rows), one)),
        (f"{one.id} is {size}", f"multiply its 'scale' by {k:.2g}", mends.scaled(k, 1)(one)),
    ]  # fmt: skip
    if bool((to_camera(place_object(twice).verts, camera.R_cam_world)[:, 2] > 0).all()):
        changes.append((f"the mesh of {one.id} is placed twice", TWICE, twice))
    for what, cure, other in changes:
        own = partial(mends.each, lambda x, other=other: other if x.id == one.id else x)
        yield Fault(f"scene.json: {what}", cure, own, margin)


# What is fitted: times, tracks, annotations and lenses.


def _times(capture: Capture, found: agree.Agreement) -> Iterator[Fault]:
    """The best of shifts, rates and reversal."""
    bodies, people = capture.bodies, capture.people
    if bodies is None or people is None or not len(people.frame):
        return
    ends = int(bodies.frame.min() + bodies.frame.max())
    changes: dict[str, tuple[float, int]] = {"": (1, 0), "the frames run backwards": (-1, ends)}
    for n in range(1, MOST_SHIFT + 1):
        count = f"{n} frames" if n > 1 else "1 frame"
        changes |= {
            f"the bodies are {count} late": (1, -n),
            f"the bodies are {count} early": (1, n),
        }
    for rate in RATES:
        changes[f"the bodies have {rate:.3g} times too few frames a second"] = (rate, 0)
        changes[f"the bodies have {rate:.3g} times too many frames a second"] = (1 / rate, 0)
    (start, end), (first, last) = (x.frame.aminmax() for x in (bodies, people))
    if start != first:
        rate = 1.0 if end == start else float((last - first) / (end - start))
        name = f"the bodies have the frames {start} to {end}, the masks {first} to {last}"
        for k in (1.0, rate):
            changes[name + (k != 1) * " of the same time"] = (k, round(float(first - k * start)))
    frames = torch.stack([mends.frames(bodies.frame, *change) for change in changes.values()])
    rows = agree.partners(frames, bodies.person.expand_as(frames), people)
    masks = mask_boxes(people.masks)[rows]
    fits = iou2d(agree.in_image(found.boxes, capture.scene.camera).expand_as(masks), masks)
    best, change, late = 0.0, "", None
    tracks = bodies.person.unique().tolist()
    for who in (None, *tracks) if len(tracks) > 1 else (None,):  # all, then one alone
        mine = torch.ones_like(rows[0]).bool() if who is None else bodies.person == who
        both = (rows >= 0).where(mine, rows[0] >= 0)
        shared, total = both.sum(1), (both * fits.where(mine, fits[0])).sum(1)
        score, own = total / shared.clamp_min(1), (both & mine).sum(1)
        score[own < max(FEWEST, int(own.max()) / 2)] = -1
        if float(score.max()) < FITTED_TIME:
            continue
        score = score * (shared / rows.shape[1]).sqrt().sqrt()  # few rows fit by chance
        if float(score.max()) > best + SAME:
            best, change, late = float(score.max()), list(changes)[int(score.argmax())], who
    if change:
        name = change if late is None else change.replace("bodies", f"bodies of track {late}")
        cure = "number the frames of bodies and masks as those of one video (--fps), from 0"
        mend = partial(mends.retimed, *changes[change], late)
        unseen = late is not None and not bool((rows[0] >= 0)[bodies.person == late].any())
        yield Fault(f"bodies.npz: {name}", cure, mend, -SAME if unseen else TIME_MARGIN)


def _swaps(capture: Capture, found: agree.Agreement) -> Iterator[Fault]:
    """People who exchange their tracks in some frames."""
    del found
    other = mends.by_masks(capture)
    if capture.bodies is None or other.bodies is None or other is capture:
        return
    frame = capture.bodies.frame[capture.bodies.person != other.bodies.person].unique().tolist()
    name = f"bodies.npz, people.json: people exchange tracks, as in {listed('frame', frame)}"
    cure = "give each person one number; mended, bodies have those of the masks they lie on"
    yield Fault(name, cure, mends.by_masks, MARGIN + SAME)


def _annotations(capture: Capture, found: agree.Agreement) -> Iterator[Fault]:
    """Annotations that objects of one class have exchanged."""
    del found
    (some, theirs), camera = agree.annotated(capture), capture.scene.camera
    kinds = [canonical(one.category) for one in some]
    ours = agree.in_image(agree.outlines(some, camera), camera)
    shared = agree.pairwise_iou2d(ours, theirs)
    shared = shared * torch.tensor([[float(a == b) for b in kinds] for a in kinds])
    pairs = agree.assigned(shared, POOR) if len(some) > 1 else []
    new = {some[i].id: some[j].annotation for i, j in pairs if i != j}
    if new and set(new.values()) == {one.annotation for one in some if one.id in new}:
        text = ", ".join(f"{name} has {number}" for name, number in new.items())
        change = partial(mends.each, lambda x: replace(x, annotation=new.get(x.id, x.annotation)))
        yield Fault(f"scene.json: annotations are exchanged (by place, {text})", "exchange them",
                    change)  # fmt: skip


def _lenses(capture: Capture, found: agree.Agreement) -> Iterator[Fault]:
    """Outlines fit boxes that are scaled and moved: another lens, another size, a crop."""
    camera, bodies, people = capture.scene.camera, capture.bodies, capture.people
    some, theirs = agree.annotated(capture)
    ours = agree.outlines(some, camera)
    k, _, _ = _fitted(ours, theirs, camera, (ours[:, :2] + ours[:, 2:]) / 2)
    what = f"{1 / k:.2g} times too large" if k < 1 else f"{k:.2g} times too small"
    mend, cure = partial(mends.each, mends.scaled(k, 1)), f"multiply 'scale' by {k:.2g}"
    yield Fault(f"scene.json: sizes are {what} for the positions", cure, mend, FITTED_MARGIN)
    seen = masks = ours[:0]
    if bodies is not None and people is not None and len(people.frame):
        rows = agree.partners(bodies.frame, bodies.person, people)
        seen, masks = found.boxes[rows >= 0], mask_boxes(people.masks)[rows[rows >= 0]]
    for file, what, boxes, others in (
        ("camera.json", "all", torch.cat([ours, seen]), torch.cat([theirs, masks])),
        ("camera.json", "the scene", ours, theirs),
        ("bodies.npz", "the bodies", seen, masks),
    ):
        scale, move, shared = _fitted(boxes, others, camera, camera.K[:2, 2])
        if shared < FITS:
            continue
        K = camera.K * torch.tensor([[scale], [scale], [1.0]])
        K[:2, 2] = camera.K[:2, 2] + move
        mend = partial(mends.seen_by, replace(camera, K=K))
        if boxes is seen:
            mend = partial(mends.people, torch.linalg.inv(camera.K) @ K)
        lens = f"fl_x {float(K[0, 0]):.4g}, cx {float(K[0, 2]):.4g}, cy {float(K[1, 2]):.4g}"
        name = f"{file}: another lens or crop of the picture fits {what} better, about {lens}"
        yield Fault(name, "give the camera of this picture (--camera)", mend, FITTED_MARGIN)


def _fitted(
    ours: Float[Tensor, "n 4"], theirs: Float[Tensor, "n 4"], camera: Camera,
    pivot: Float[Tensor, "*n 2"],
) -> tuple[float, Float[Tensor, "2"], float]:  # fmt: skip
    """Scale about points and shift in the picture [px] with which boxes share most; the share."""
    if len(ours) < FEWEST:
        return 1.0, torch.zeros(2), 0.0
    pivot = torch.cat([pivot, pivot], -1)
    grown = pivot + SCALES[:, None, None] * (ours - pivot)
    apart = theirs - agree.in_image(grown, camera)
    moves = ((apart[..., :2] + apart[..., 2:]) / 2).median(1).values
    moves = torch.cat([torch.zeros_like(moves), moves])
    boxes = agree.in_image(torch.cat([grown, grown]) + moves.repeat(1, 2)[:, None], camera)
    shared, best = iou2d(boxes, theirs.expand_as(boxes)).mean(1).max(0)
    return float(SCALES[int(best) % len(SCALES)]), moves[best], float(shared)
