"""What captures far larger than the demo's cost: `mover run` to the end, stage by stage.

    PYTHONPATH=src python benchmarks/large.py --cases demo foreign fine 4k objects people frames

The demo's capture with other meshes (`foreign`: eight of 50,000 faces, open and unclean as in
`prepare.py`, never the same ones, so that no cache knows them; `fine`: one of 500,000), or grown in
one direction: its pictures and masks at 3840 x 2160, five copies of its
objects (40), twelve copies of its person, each a step aside, its frames again and again up to
5,000. Copies are moved by centimetres, and their masks by pixels. Printed for each case: the
seconds of every stage that took one or more, seconds and processor time of the whole run with
reading and writing, and its largest memory (the process alone, as the system counts it). A run
that needs more than `--most` gigabytes is ended by the system's own limit on memory.
"""

import argparse
import json
import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch
from prepare import unclean

from mover.core.types import (
    Bodies,
    BodyPose,
    Capture,
    Detection,
    Masks,
    Mesh,
    People,
    SceneObject,
)
from mover.furniture.library import PIECES
from mover.geometry.mesh import box
from mover.geometry.rle import decode, encode
from mover.io.capture.folder import write_capture
from mover_bench.rooms.config import NoiseConfig
from mover_bench.rooms.noise import add_noise
from mover_bench.rooms.room import demo_room

WIDTH, HEIGHT = 3840, 2160
OBJECTS, PEOPLE, FRAMES = 40, 12, 5000
STEP = 0.02  # [m] between a copy and the next
GIGABYTE = 1 << 30


def large_pictures(capture: Capture) -> Capture:
    """At 4K."""
    camera = capture.scene.camera
    down, right = HEIGHT / camera.height, WIDTH / camera.width
    K = torch.tensor([right, down, 1.0]).diag().to(camera.K) @ camera.K
    rows = (torch.arange(HEIGHT) / down).long()
    columns = (torch.arange(WIDTH) / right).long()

    def grown(masks: Masks) -> Masks:
        shown = (decode(masks, k)[rows][:, columns] for k in range(len(masks.counts)))
        return Masks(HEIGHT, WIDTH, tuple(encode(mask) for mask in shown))

    def seen(one: Detection) -> Detection:
        box = one.box * torch.tensor([right, down, right, down])
        return replace(one, box=box, mask=None if one.mask is None else grown(one.mask))

    assert capture.reference is not None
    assert capture.people is not None
    lens = replace(camera, K=K, height=HEIGHT, width=WIDTH)
    return replace(
        capture,
        scene=replace(capture.scene, camera=lens),
        detections=tuple(seen(one) for one in capture.detections),
        reference=capture.reference[rows][:, columns],
        people=replace(capture.people, masks=grown(capture.people.masks)),
    )


def many_objects(capture: Capture) -> Capture:
    """Copies of each object, with a detection of its own, a few pixels aside."""
    pieces: list[SceneObject] = []
    found: list[Detection] = []
    own = {one.id: one for one in capture.detections}
    for k in range(OBJECTS):
        piece = capture.scene.objects[k % len(capture.scene.objects)]
        copy = k // len(capture.scene.objects)
        assert piece.annotation is not None
        seen = own[piece.annotation]
        assert seen.mask is not None
        mask = decode(seen.mask, 0).roll(copy, 1)
        code = Masks(seen.mask.height, seen.mask.width, (encode(mask),))
        place = piece.t_world_object + torch.tensor([STEP * copy, 0.0, 0.0])
        found.append(replace(seen, id=k + 1, mask=code))
        name = f"{piece.id}_{copy}"
        pieces.append(replace(piece, id=name, annotation=k + 1, t_world_object=place))
    return replace(
        capture, scene=replace(capture.scene, objects=tuple(pieces)), detections=tuple(found)
    )


def _repeated(rows: torch.Tensor, times: int, most: int) -> torch.Tensor:
    return rows.repeat(times, *[1] * (rows.ndim - 1))[:most]


def copied(capture: Capture, times: int, most: int, aside: bool) -> Capture:
    """Its rows of bodies and masks again and again: further people, or further frames."""
    bodies, people = capture.bodies, capture.people
    assert bodies is not None
    assert people is not None
    length = int(bodies.frame.max()) + 1
    count = len(bodies.frame)
    copy = torch.arange(times).repeat_interleave(count)[:most]
    step = torch.zeros(len(copy), 3)
    step[:, 0] = STEP * copy if aside else 0.0
    frame = _repeated(bodies.frame, times, most)
    person = _repeated(bodies.person, times, most)
    pose = None if bodies.pose is None else _poses(bodies.pose, times, most, step)
    joints = None
    if bodies.joints is not None:
        joints = _repeated(bodies.joints, times, most) + step[:, None]
    grown = Bodies(
        verts=_repeated(bodies.verts, times, most) + step[:, None],
        faces=bodies.faces,
        joints=joints,
        joint_names=bodies.joint_names,
        frame=frame if aside else frame + length * copy,
        person=copy if aside else person,
        fps=bodies.fps,
        space=bodies.space,
        pose=pose,
    )
    rows = len(people.frame)
    number = torch.arange(times).repeat_interleave(rows)
    codes = people.masks.counts * times
    seen = _repeated(people.frame, times, rows * times)
    masks = People(
        Masks(people.masks.height, people.masks.width, codes),
        seen if aside else seen + length * number,
        number if aside else _repeated(people.person, times, rows * times),
        {},
    )
    return replace(capture, bodies=grown, people=masks, touch=None)


def _poses(pose: BodyPose, times: int, most: int, step: torch.Tensor) -> BodyPose:
    def rows(value: torch.Tensor) -> torch.Tensor:
        return _repeated(value, times, most)

    return BodyPose(
        pose.model, pose.gender, rows(pose.betas), rows(pose.global_orient),
        rows(pose.body_pose), rows(pose.transl) + step.to(pose.transl),
        {name: rows(value) for name, value in pose.extra.items()},
    )  # fmt: skip


def many_people(capture: Capture) -> Capture:
    """Twelve in every frame."""
    return copied(capture, PEOPLE, 1 << 62, aside=True)


def many_frames(capture: Capture) -> Capture:
    """So many bodies one after the other."""
    assert capture.bodies is not None
    return copied(capture, -(-FRAMES // len(capture.bodies.frame)), FRAMES, aside=False)


def other_meshes(capture: Capture, faces: int, most: int) -> Capture:
    """The first objects with pieces of their class as tools leave them, as large as their own."""
    seed = int.from_bytes(os.urandom(4))
    given = capture.scene.objects
    names = [p.category if p.category in PIECES else f"double {p.category}" for p in given[:most]]
    pieces = [
        replace(piece, mesh=_as_large(unclean(name, faces, seed), piece.mesh))
        for piece, name in zip(given, names, strict=False)
    ]
    scene = replace(capture.scene, objects=(*pieces, *given[most:]))
    return replace(capture, scene=scene)


def _as_large(mesh: Mesh, own: Mesh) -> Mesh:
    (low, high), (start, end) = box(mesh.verts), box(own.verts)
    return Mesh(start + (mesh.verts - low) * ((end - start) / (high - low)), mesh.faces)


CASES: dict[str, Callable[[Capture], Capture]] = {
    "demo": lambda capture: capture,
    "foreign": lambda capture: other_meshes(capture, 50_000, len(capture.scene.objects)),
    "fine": lambda capture: other_meshes(capture, 500_000, 1),
    "4k": large_pictures,
    "objects": many_objects,
    "people": many_people,
    "frames": many_frames,
}


def measured(folder: Path, out: Path, most: float) -> str:
    """A run in a process of its own, in one line."""

    def bounded() -> None:
        limit = int(most * GIGABYTE)
        resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))

    words = [sys.executable, "-m", "mover", "run", str(folder), "--out", str(out)]
    begin = time.perf_counter()
    with subprocess.Popen(words, stdout=subprocess.DEVNULL, preexec_fn=bounded) as process:
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    seconds, busy = time.perf_counter() - begin, used.ru_utime + used.ru_stime
    line = f"{seconds:.0f} s, {busy:.0f} s of processor, {used.ru_maxrss / 1e6:.2f} GB"
    if process.returncode:
        return f"{line}: ended with {process.returncode}"
    stages: dict[str, float] = {}
    for stage in json.loads((out / "run.json").read_text())["stages"]:
        name = stage["name"]
        stages[name] = stages.get(name, 0.0) + float(stage["seconds"])
    told = ", ".join(f"{name} {value:.1f}" for name, value in stages.items() if value >= 1)
    return f"{line} ({told})"


def main() -> None:
    """Print a line a case."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cases", nargs="+", choices=list(CASES), default=list(CASES))
    parser.add_argument("--most", type=float, default=6.0, help="gigabytes of memory")
    args = parser.parse_args()
    capture = add_noise(demo_room(), NoiseConfig(), 0)
    with tempfile.TemporaryDirectory() as place:
        for name in args.cases:
            folder = Path(place) / name
            write_capture(CASES[name](capture), folder)
            print(f"{name}: {measured(folder, Path(place) / f'{name}-out', args.most)}", flush=True)


if __name__ == "__main__":
    main()
