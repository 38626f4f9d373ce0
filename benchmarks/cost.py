"""What a run costs as it grows: processor seconds by stage and peak memory, each in a process.

    python benchmarks/cost.py                          # demo, frames x 4, objects, picture x 2
    python benchmarks/cost.py --cases demo picture --capture ROOM

Copies of objects that would lie outside the picture are left out: 28 for the demo's eight.
"""

import argparse
import json
import math
import resource
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import torch

from mover.app.demo import write_demo
from mover.core.run import Run
from mover.core.types import Capture, Detection, Masks, SceneObject
from mover.geometry.rle import decode, encode, tight_box
from mover.geometry.rotations import rot_y
from mover.io.capture.folder import read_capture
from mover.pipeline.presets import PRESETS
from mover.pipeline.reconstruct import reconstruct

TIMES = 4
STAGES = 9  # of the dearest ones a line each


@dataclass(frozen=True)
class Timed(Run):
    """Counts the processor seconds of each stage."""

    seconds: dict[str, float] = field(default_factory=lambda: defaultdict[str, float](float))

    def stage(self, fn: Any, inputs: Any, config: Any) -> Any:  # noqa: ANN401
        """As `Run.stage`."""
        start = time.process_time()
        found = super().stage(fn, inputs, config)
        self.seconds[getattr(fn, "__name__", "stage")] += time.process_time() - start
        return found


def more_frames(capture: Capture) -> Capture:
    """Four frames for each, in which people are on their way to the next."""
    bodies, people = capture.bodies, capture.people
    assert bodies is not None, "people move"
    rows = torch.arange(len(bodies.frame)).repeat_interleave(TIMES)
    step = torch.arange(TIMES).repeat(len(bodies.frame))
    follows = (rows + 1).clamp_max(len(bodies.frame) - 1)
    same = (bodies.person[follows] == bodies.person[rows]) & (
        bodies.frame[follows] == bodies.frame[rows] + 1
    )
    share = (step / TIMES * same)[:, None, None]

    def between(x: torch.Tensor) -> torch.Tensor:
        return (1 - share) * x[rows] + share * x[follows]

    verts = between(bodies.verts)
    joints = None if bodies.joints is None else between(bodies.joints)
    fps = None if bodies.fps is None else TIMES * bodies.fps
    found = replace(bodies, verts=verts, joints=joints, frame=TIMES * bodies.frame[rows] + step,
                    person=bodies.person[rows], pose=None, fps=fps)  # fmt: skip
    if people is None:
        return replace(capture, bodies=found)
    seen = torch.arange(len(people.frame)).repeat_interleave(TIMES)
    codes = tuple(people.masks.counts[row] for row in seen.tolist())
    frame = TIMES * people.frame[seen] + torch.arange(TIMES).repeat(len(people.frame))
    masks = replace(people.masks, counts=codes)
    shown = replace(people, masks=masks, frame=frame, person=people.person[seen])
    return replace(capture, bodies=found, people=shown)


def more_objects(capture: Capture) -> Capture:
    """Each object three times more, turned to the sides about the camera with its mask."""
    camera, known = capture.scene.camera, {d.id: d for d in capture.detections}
    pieces, found = list(capture.scene.objects), list(capture.detections)
    for number in range(1, TIMES):
        aside = camera.width // TIMES * (1 if number % 2 else -1) * ((number + 1) // 2)
        turn = -math.atan2(aside, float(camera.K[0, 0]))
        for one in capture.scene.objects:
            seen = None if one.annotation is None else known.get(one.annotation)
            shown = None if seen is None else moved(seen, aside, len(found) + 1000)
            if shown is not None:
                found.append(shown)
                pieces.append(moved_object(one, turn, number, shown.id))
    scene = replace(capture.scene, objects=tuple(pieces))
    return replace(capture, scene=scene, detections=tuple(found))


def moved(seen: Detection, aside: int, name: int) -> Detection | None:
    """A detection shifted to the right [px]; None: out of the picture."""
    if seen.mask is None:
        return None
    old = decode(seen.mask, 0)
    mask = torch.zeros_like(old)
    low, high = max(0, aside), min(old.shape[1], old.shape[1] + aside)
    mask[:, low:high] = old[:, low - aside : high - aside]
    if int(mask.sum()) < 100:
        return None
    code = replace(seen.mask, counts=(encode(mask),))
    return replace(seen, id=name, mask=code, box=tight_box(mask).to(seen.box))


def moved_object(one: SceneObject, turn: float, number: int, annotation: int) -> SceneObject:
    """An object turned about the vertical through the camera."""
    place = rot_y(torch.tensor(turn)).to(one.t_world_object) @ one.t_world_object
    name = f"{one.id}_{number}"
    return replace(one, id=name, annotation=annotation, t_world_object=place, yaw=one.yaw + turn)


def larger_picture(capture: Capture) -> Capture:
    """A picture with twice the side."""
    camera = capture.scene.camera
    K = camera.K * torch.tensor([[2.0], [2.0], [1.0]])
    camera = replace(camera, K=K, width=2 * camera.width, height=2 * camera.height)

    def larger(masks: Masks) -> Masks:
        def twice(row: int) -> bytes:
            return encode(decode(masks, row).repeat_interleave(2, 0).repeat_interleave(2, 1))

        codes = tuple(twice(row) for row in range(len(masks.counts)))
        return Masks(2 * masks.height, 2 * masks.width, codes)

    found = tuple(replace(d, box=2 * d.box, mask=d.mask and larger(d.mask))
                  for d in capture.detections)  # fmt: skip
    picture, people = capture.reference, capture.people
    if picture is not None:
        picture = picture.repeat_interleave(2, 0).repeat_interleave(2, 1)
    return replace(
        capture, scene=replace(capture.scene, camera=camera), detections=found, reference=picture,
        reference_people=capture.reference_people and larger(capture.reference_people),
        people=people and replace(people, masks=larger(people.masks)), furniture=None,
    )  # fmt: skip


CASES: dict[str, Callable[[Capture], Capture]] = {
    "demo": lambda capture: capture,
    "frames": more_frames,
    "objects": more_objects,
    "picture": larger_picture,
}


def cost(capture: Capture) -> dict[str, Any]:
    """Processor seconds by stage, in all, and peak memory [MB]."""
    start = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        run = Timed(Path(folder))
        reconstruct(capture, PRESETS["robust"], run)
    total = time.process_time() - start
    stages = {**run.seconds, "between stages": total - sum(run.seconds.values())}
    memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    return {"seconds": total, "memory": memory, "stages": stages,
            "objects": len(capture.scene.objects)}  # fmt: skip


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--cases", nargs="*", default=list(CASES), choices=list(CASES))
    parser.add_argument("--capture", type=Path, help="instead of the demo's")
    parser.add_argument("--one", choices=list(CASES), help="one case, in this process")
    args = parser.parse_args()
    if args.one:
        torch.set_num_threads(1)
        print(json.dumps(cost(CASES[args.one](read_capture(args.capture)))))
        return
    found: dict[str, dict[str, Any]] = {}
    with tempfile.TemporaryDirectory() as folder:
        capture = args.capture or Path(folder) / "demo"
        if args.capture is None:
            write_demo(capture)
        for case in args.cases:
            words = [sys.executable, __file__, "--one", case, "--capture", str(capture)]
            done = subprocess.run(words, check=True, capture_output=True, text=True)
            found[case] = json.loads(done.stdout.splitlines()[-1])
    print(f"{'':<26}" + "".join(f"{case:>10}" for case in found))
    first = next(iter(found.values()))
    dearest = sorted(first["stages"], key=lambda name: -first["stages"][name])[:STAGES]
    for name in dearest:
        row = [one["stages"].get(name, 0.0) for one in found.values()]
        print(f"{name:<26}" + "".join(f"{seconds:>10.1f}" for seconds in row))
    for label, key in (("processor seconds", "seconds"), ("peak memory [MB]", "memory"),
                       ("objects", "objects")):  # fmt: skip
        print(f"{label:<26}" + "".join(f"{one[key]:>10.1f}" for one in found.values()))


if __name__ == "__main__":
    main()
