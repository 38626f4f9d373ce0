"""What captures cost that are larger than the demo's: `mover run`, stage by stage.

    python benchmarks/sizes.py --cases demo frames objects picture

The demo's capture as it is, or grown in one direction: its frames four times one after the other,
four copies of its objects, its picture and masks twice as wide and high. Copies are moved by
centimetres, and their masks by pixels. Printed for each case: seconds and processor time of the
whole run with reading and writing, its largest memory, and each stage that took a second or more.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch

from mover.app.demo import write_demo
from mover.core.types import Capture, Detection, Masks, SceneObject
from mover.geometry.rle import decode, encode
from mover.io.capture.folder import read_capture, write_capture
from mover.io.capture.pose_file import joined_bodies
from mover_bench.rooms.moving import joined_people

TIMES, ZOOM = 4, 2
STEP = 0.02  # [m] between a copy and the next


def large_picture(capture: Capture) -> Capture:
    """Twice as wide and high."""
    camera, people = capture.scene.camera, capture.people
    assert capture.reference is not None
    assert people is not None

    def grown(masks: Masks) -> Masks:
        shown = (decode(masks, k) for k in range(len(masks.counts)))
        counts = tuple(
            encode(mask.repeat_interleave(ZOOM, 0).repeat_interleave(ZOOM, 1)) for mask in shown
        )
        return Masks(ZOOM * masks.height, ZOOM * masks.width, counts)

    def larger(one: Detection) -> Detection:
        return replace(one, box=ZOOM * one.box, mask=None if one.mask is None else grown(one.mask))

    K = camera.K * torch.tensor([[ZOOM], [ZOOM], [1.0]])
    lens = replace(camera, K=K, height=ZOOM * camera.height, width=ZOOM * camera.width)
    picture = capture.reference.repeat_interleave(ZOOM, 0).repeat_interleave(ZOOM, 1)
    return replace(
        capture,
        scene=replace(capture.scene, camera=lens),
        detections=tuple(larger(one) for one in capture.detections),
        reference=picture,
        people=replace(people, masks=grown(people.masks)),
    )


def many_objects(capture: Capture) -> Capture:
    """Copies of each object, with a detection of its own, a few pixels aside."""
    objects: list[SceneObject] = []
    found: list[Detection] = []
    own = {one.id: one for one in capture.detections}
    for copy in range(TIMES):
        for thing in capture.scene.objects:
            assert thing.annotation is not None
            one = own[thing.annotation]
            assert one.mask is not None
            mask = decode(one.mask, 0).roll(copy, 1)
            code = Masks(one.mask.height, one.mask.width, (encode(mask),))
            number = len(objects) + 1
            found.append(replace(one, id=number, mask=code))
            place = thing.t_world_object + torch.tensor([STEP * copy, 0.0, 0.0])
            name = f"{thing.id}_{copy}"
            objects.append(replace(thing, id=name, annotation=number, t_world_object=place))
    scene = replace(capture.scene, objects=tuple(objects))
    return replace(capture, scene=scene, detections=tuple(found))


def many_frames(capture: Capture) -> Capture:
    """All people and masks again and again."""
    bodies, people = capture.bodies, capture.people
    assert bodies is not None
    assert people is not None
    later = [(int(bodies.frame.max()) + 1) * k for k in range(TIMES)]
    every = joined_bodies([replace(bodies, frame=bodies.frame + k) for k in later])
    seen = joined_people([replace(people, frame=people.frame + k) for k in later])
    return replace(capture, bodies=every, people=seen, touch=None)


CASES: dict[str, Callable[[Capture], Capture]] = {
    "demo": lambda capture: capture,
    "frames": many_frames,
    "objects": many_objects,
    "picture": large_picture,
}


def measured(folder: Path, out: Path) -> str:
    """A run in a process of its own, in one line."""
    words = [sys.executable, "-m", "mover", "run", str(folder), "--out", str(out)]
    begin = time.perf_counter()
    with subprocess.Popen(words, stdout=subprocess.DEVNULL) as process:
        _, status, used = os.wait4(process.pid, 0)
        process.returncode = os.waitstatus_to_exitcode(status)
    seconds, busy = time.perf_counter() - begin, used.ru_utime + used.ru_stime
    line = f"{seconds:.0f} s, {busy:.0f} s of processor, {used.ru_maxrss / 1e6:.2f} GB"
    if process.returncode:
        return f"{line}: ended with {process.returncode}"
    stages: dict[str, float] = {}
    for stage in json.loads((out / "run.json").read_text())["stages"]:
        stages[stage["name"]] = stages.get(stage["name"], 0.0) + float(stage["seconds"])
    slow = ", ".join(f"{name} {value:.1f}" for name, value in stages.items() if value >= 1)
    return f"{line} ({slow})"


def main() -> None:
    """Print a line a case."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--cases", nargs="+", choices=list(CASES), default=list(CASES))
    asked = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        write_demo(Path(place) / "known")
        capture = read_capture(Path(place) / "known")
        for name in asked.cases:
            folder = Path(place) / name
            write_capture(CASES[name](capture), folder)
            print(f"{name}: {measured(folder, Path(place) / f'{name}-out')}", flush=True)


if __name__ == "__main__":
    main()
