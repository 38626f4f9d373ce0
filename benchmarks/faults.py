"""How many of the faults that users make are found in known rooms, and how many false alarms.

    python benchmarks/faults.py CAPTURE...                 # each fault in each capture, a table
    python benchmarks/faults.py --rooms rooms:100 two:100  # rooms of mover_bench are made first
    python benchmarks/faults.py --i3db DIR                 # both starts of each scene of i3DB

Each fault is put into a whole capture that is right, which is then held against its picture. A
fault counts as found where a warning names it; a warning of the unharmed capture is a false alarm.
"""

import argparse
import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import torch
from torch import Tensor

from mover.core.run import Run
from mover.core.types import Capture, Detection, Masks, SceneObject
from mover.geometry.placement import place_object
from mover.geometry.rle import decode, encode, tight_box
from mover.geometry.rotations import rot_x, rot_z
from mover.io.capture.faults import check_against_picture
from mover.io.capture.folder import read_capture
from mover_bench.datasets.i3db import read_i3db
from mover_bench.experiment.job import room_named
from mover_bench.experiment.real import starts_of

Change = Callable[[Capture], Capture | None]
Z_UP = rot_x(torch.tensor(math.pi / 2))  # (x, y, z) of a y-up world in a z-up one: (x, -z, y)
X_UP = rot_z(torch.tensor(-math.pi / 2))
ROS = torch.tensor([[0.0, 0, -1], [-1, 0, 0], [0, 1, 0]])  # x forward, y left, z up
HALF_TURN = rot_z(torch.tensor(math.pi))


def objects(change: Callable[[SceneObject], SceneObject]) -> Change:
    """All objects changed; None: nothing of it is seen."""

    def changed(capture: Capture) -> Capture:
        some = tuple(map(change, capture.scene.objects))
        return replace(capture, scene=replace(capture.scene, objects=some))

    return changed


def mesh(verts: Callable[[SceneObject], Tensor], first: bool = False) -> Change:
    """Other vertices of the meshes, or of that of the first of several objects."""

    def changed(capture: Capture) -> Capture | None:
        if first and len(capture.scene.objects) < 2:
            return None
        some = [replace(one, mesh=replace(one.mesh, verts=verts(one))) if not (first and k) else one
                for k, one in enumerate(capture.scene.objects)]  # fmt: skip
        return replace(capture, scene=replace(capture.scene, objects=tuple(some)))

    return changed


def world(A: Tensor, sign: float = 1.0) -> Change:
    """Positions in another world."""
    return objects(lambda one: replace(one, t_world_object=A @ one.t_world_object,
                                       yaw=sign * one.yaw))  # fmt: skip


def everything(A: Tensor) -> Change:
    """Positions and meshes in another world."""

    def turned(one: SceneObject) -> SceneObject:
        verts = place_object(one).verts @ A.mT
        return replace(one, mesh=replace(one.mesh, verts=verts), t_world_object=torch.zeros(3),
                       yaw=torch.zeros(()), scale=torch.ones(3))  # fmt: skip

    return objects(turned)


def scaled(size: float, away: float) -> Change:
    """Sizes and positions times a factor."""
    return objects(lambda one: replace(one, scale=one.scale * size,
                                       t_world_object=one.t_world_object * away))  # fmt: skip


def people(change: Callable[[Tensor, Capture], Tensor]) -> Change:
    """Vertices and joints changed."""

    def changed(capture: Capture) -> Capture | None:
        bodies = capture.bodies
        if bodies is None:
            return None
        joints = None if bodies.joints is None else change(bodies.joints, capture)
        verts = change(bodies.verts, capture)
        return replace(capture, bodies=replace(bodies, verts=verts, joints=joints, pose=None))

    return changed


def frames(change: Callable[[Tensor], Tensor]) -> Change:
    """Frames of the bodies counted otherwise; None without masks that show it."""

    def changed(capture: Capture) -> Capture | None:
        if capture.bodies is None or (capture.people or capture.keypoints) is None:
            return None
        bodies = replace(capture.bodies, frame=change(capture.bodies.frame))
        return replace(capture, bodies=bodies)

    return changed


def tracks(change: Callable[[Tensor, Tensor], Tensor], least: int = 1) -> Change:
    """Tracks of the masks numbered otherwise (of persons and frames)."""

    def changed(capture: Capture) -> Capture | None:
        seen = capture.people
        if seen is None or len(seen.person.unique()) < least:
            return None
        return replace(capture, people=replace(seen, person=change(seen.person, seen.frame)))

    return changed


def other(masks: Masks) -> Masks:
    """The background."""
    codes = tuple(encode(~decode(masks, i)) for i in range(len(masks.counts)))
    return replace(masks, counts=codes)


def people_inverted(capture: Capture) -> Capture | None:
    """Masks of people."""
    seen = capture.people
    return seen and replace(capture, people=replace(seen, masks=other(seen.masks)))


def boxes_as_corners(capture: Capture) -> Capture:
    """Right and lower ends read as widths and heights."""

    def read(one: Detection) -> Detection:
        return replace(one, box=torch.cat([one.box[:2], one.box[:2] + one.box[2:]]))

    return replace(capture, detections=tuple(map(read, capture.detections)))


def furniture_inverted(some: slice) -> Change:
    """Masks of some of the furniture, and their boxes."""

    def inverted(d: Detection) -> Detection:
        assert d.mask is not None
        mask = other(d.mask)
        return replace(d, mask=mask, box=tight_box(decode(mask, 0)).to(d.box))

    def changed(capture: Capture) -> Capture | None:
        few = some.stop is not None and len(capture.detections) <= some.stop
        if few or any(d.mask is None for d in capture.detections):
            return None
        found = list(capture.detections)
        found[some] = map(inverted, found[some])
        return replace(capture, detections=tuple(found))

    return changed


def one_late(capture: Capture) -> Capture | None:
    """One person of several in later frames than the others."""
    bodies = capture.bodies
    if bodies is None or capture.people is None or len(bodies.person.unique()) < 2:
        return None
    late = bodies.frame + 5 * (bodies.person == bodies.person.min())
    return replace(capture, bodies=replace(bodies, frame=late))


def lens(zoom: float, right: float = 0.0) -> Change:
    """Another focal length, and an axis moved by a share of the width."""

    def changed(capture: Capture) -> Capture:
        camera = capture.scene.camera
        K = camera.K * torch.tensor([[zoom], [zoom], [1.0]])
        K[:2, 2] = camera.K[:2, 2]
        K[0, 2] += right * camera.width
        return replace(capture, scene=replace(capture.scene, camera=replace(camera, K=K)))

    return changed


def rolled(capture: Capture) -> Capture:
    """The camera upside down."""
    camera = capture.scene.camera
    turned = replace(camera, R_cam_world=HALF_TURN @ camera.R_cam_world)
    return replace(capture, scene=replace(capture.scene, camera=turned))


def exchanged(capture: Capture) -> Capture | None:
    """Boxes and masks of the first two objects of one class under each other's numbers."""
    some = capture.scene.objects
    pairs = [(a, b) for a in some for b in some if a.id < b.id and a.category == b.category
             and a.annotation is not None and b.annotation is not None]  # fmt: skip
    if not pairs:
        return None
    a, b = pairs[0]
    new = {a.id: b.annotation, b.id: a.annotation}
    return objects(lambda one: replace(one, annotation=new.get(one.id, one.annotation)))(capture)


def diagonal(*signs: float) -> Tensor:
    """Axes with other signs."""
    return torch.diag(torch.tensor(signs).float())


FAULTS: dict[str, tuple[str, Change]] = {
    "bodies 5 frames late": ("5 frames late", frames(lambda f: f + 5)),
    "bodies 2 frames early": ("2 frames early", frames(lambda f: f - 2)),
    "bodies 40 frames late": ("40 frames late", frames(lambda f: f + 40)),
    "bodies in reversed order": ("backwards", frames(lambda f: f.max() + f.min() - f)),
    "bodies at half the frame rate": ("frames a second", frames(
        lambda f: f.min() + (f - f.min()) // 2)),
    "bodies at 25 for 30 a second": ("frames a second", frames(lambda f: (f / 1.2).round().long())),
    "tracks 1000, 1001, ...": ("different tracks", tracks(lambda p, _: p + 1000)),
    "tracks swapped": ("different tracks", tracks(lambda p, _: p.max() - p, 2)),
    "tracks swapped to and fro": (
        "exchange tracks", tracks(lambda p, f: p.where(f // 9 % 2 == 0, p.max() - p), 2),
    ),
    "bodies from frame 1000": ("frames 1000 to", frames(lambda f: f - f.min() + 1000)),
    "bodies in milliseconds": ("of the same time", frames(lambda f: 40 * f + 7)),
    "bodies at 50 for 30 a second": ("times too many", frames(lambda f: (f * 5 / 3).long())),
    "tracks of masks in pieces": ("different tracks", tracks(lambda p, f: 10 * p + f // 40 + 3)),
    "annotations exchanged": ("exchanged", exchanged),
    "masks of people inverted": ("inverted", people_inverted),
    "masks of furniture inverted": ("inverted", furniture_inverted(slice(None))),
    "boxes as corners": ("[x1, y1, x2, y2]", boxes_as_corners),
    "one mask of furniture inverted": ("is inverted", furniture_inverted(slice(1))),
    "one person 5 frames late": ("5 frames late", one_late),
    "one object 5 times too large": ("times too large", mesh(
        lambda one: 5 * one.mesh.verts, first=True)),
    "meshes with +z up": ("side (+z is up)", mesh(lambda one: one.mesh.verts @ Z_UP.mT)),
    "meshes with +x up": ("side (+x is up)", mesh(lambda one: one.mesh.verts @ X_UP.mT)),
    "one mesh with +z up": ("is on the side", mesh(
        lambda one: one.mesh.verts @ Z_UP.mT, first=True)),
    "one placement applied twice": ("placed twice", mesh(
        lambda one: place_object(one).verts, first=True)),
    "positions with +z down": ("side (+z is down)", world(Z_UP.mT)),
    "positions of ROS": ("x is forward", world(ROS)),
    "positions with +z up": ("side (+z is up)", world(Z_UP)),
    "whole scene with +z up": ("side (+z is up)", everything(Z_UP)),
    "positions with y down": ("upside down", world(diagonal(1, -1, 1))),
    "positions with y down, z forward": ("upside down", world(diagonal(1, -1, -1), -1)),
    "whole scene with y down, z forward": ("upside down", everything(diagonal(1, -1, -1))),
    "positions with z forward": ("behind", world(diagonal(1, 1, -1), -1)),
    "positions mirrored": ("mirrored", world(diagonal(-1, 1, 1), -1)),
    "whole scene mirrored": ("mirrored", everything(diagonal(-1, 1, 1))),
    "placements applied twice": ("placed twice", mesh(lambda one: place_object(one).verts)),
    "sizes times 4": ("sizes", scaled(4, 1)),
    "sizes times 100": ("sizes are in centimetres", scaled(100, 1)),
    "positions times 100": ("positions are in centimetres", scaled(1, 100)),
    "positions times 10": ("positions are in decimetres", scaled(1, 10)),
    "scene times 3.28": ("in feet", scaled(3.28, 3.28)),
    "scene times 1000": ("in millimetres", scaled(1000, 1000)),
    "bodies times 3.28": ("in feet", people(lambda x, _: x * 3.28)),
    "bodies times 10": ("in decimetres", people(lambda x, _: x * 10)),
    "yaw in degrees": ("degrees", objects(lambda one: replace(one, yaw=one.yaw.rad2deg()))),
    "a lens of 1.6 times the focal length": ("another lens", lens(1.6)),
    "the axis a quarter aside (a crop)": ("another lens", lens(1.0, 0.25)),
    "the camera upside down": ("upside down", rolled),
    "bodies of a lens twice as long": ("another lens", people(
        lambda x, _: x * torch.tensor([0.5, 0.5, 1.0]))),
    "bodies mirrored": ("mirrored", people(lambda x, _: x * torch.tensor([-1.0, 1, 1]))),
    "bodies upside down": ("upside down", people(lambda x, _: x * torch.tensor([-1.0, -1, 1]))),
}  # fmt: skip
"""What is done to a capture, and words of the warning that is right."""


def capture_of(name: str) -> Capture:
    """The capture in a folder, or of the room SET:SEED."""
    return read_capture(Path(name)) if Path(name).is_dir() else room_named(name).capture


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("captures", nargs="*")
    parser.add_argument("--rooms", nargs="*", default=[], help="SET:SEED of mover_bench")
    parser.add_argument("--i3db", type=Path, help="the folder i3DB of amonszpart/iMapper")
    parser.add_argument("--unharmed", nargs="*", default=[], help="these: false alarms alone")
    args = parser.parse_args()
    torch.set_num_threads(1)
    named = [*args.captures, *args.rooms]
    rooms: dict[str, Callable[[], Capture]] = {name: partial(capture_of, name) for name in named}
    for folder in sorted(args.i3db.glob("Scene*")) if args.i3db else ():
        with TemporaryDirectory() as kept:
            starts = starts_of(read_i3db(folder), Run(Path(kept)))
        for start, kind in zip(starts, ("library", "true shapes"), strict=True):
            rooms[f"{folder.name}, {kind}"] = partial(replace, start)
    found: dict[str, list[bool]] = {name: [] for name in FAULTS}
    alarms: list[str] = []
    unharmed = {name: partial(capture_of, name) for name in args.unharmed}
    for name, room in (rooms | unharmed).items():
        capture = room()
        alarms += [f"{name}: {text}" for text in check_against_picture(capture).warnings]
        for fault, (words, change) in FAULTS.items() if name in rooms else ():
            harmed = change(capture)
            if harmed is not None:
                said = check_against_picture(harmed).warnings
                found[fault].append(any(words in text for text in said))
                if not found[fault][-1]:
                    print(f"missed: {fault}, {name}: {said}", flush=True)
    total = [ok for rows in found.values() for ok in rows]
    for fault, rows in found.items():
        print(f"{fault:<40} {sum(rows):>3} of {len(rows)}")
    print(
        f"found {sum(total)} of {len(total)}; {len(alarms)} warnings of"
        f" {len(rooms) + len(args.unharmed)} unharmed captures"
    )
    for alarm in alarms:
        print(f"    alarm: {alarm}")


if __name__ == "__main__":
    main()
