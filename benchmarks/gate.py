"""Whether results are what they were: the demo and development rooms of three sets.

    make gate                           # placements and bodies to the bit, the demo's seconds
    python benchmarks/gate.py --means   # where a step changes results: means of six rooms a set
    python benchmarks/gate.py --write   # store what is found (with --means: of six rooms a set)

Bits are those of one kind of processor and one version of torch: on another machine, store them
with an unchanged version of the program first.
"""

import argparse
import hashlib
import json
import sys
import tempfile
import time
from collections.abc import Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from mover.app.demo import write_demo
from mover.core.run import Run
from mover.evaluate.evaluation import EvaluateConfig, EvaluatedBodies, evaluate
from mover.io.capture.bodies_file import read_bodies
from mover.io.capture.folder import read_capture
from mover.io.capture.scene_file import read_scene
from mover.pipeline.presets import PRESETS
from mover.pipeline.reconstruct import reconstruct
from mover_bench.experiment.job import Trial, noisy_room
from mover_bench.rooms.config import SETS

STORED = Path(__file__).with_name("gate.json")
DEMO = ("demo", 0)
ROOMS = ("rooms", "wrong-shape", "upstream")
FEW, MORE = range(100, 103), range(100, 106)
MEANS = {"iou3d": 0.005, "pje": 0.002}
"""Metrics whose means are held, and how far these may be off: IoU3D, PJE [m]."""
Case = tuple[str, int]
"""Set and seed."""


def trial_of(case: Case) -> Trial:
    """The input and the truth of a case."""
    if case != DEMO:
        return noisy_room(case[1], SETS[case[0]])
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place) / "demo"
        write_demo(folder)
        truth = read_scene(folder / "truth" / "scene.json", None)
        people = read_bodies(folder / "truth" / "bodies.npz")
        return Trial(read_capture(folder), truth, people, ())


def digest(tensors: Iterable[Tensor]) -> str:
    """Of the bits of some tensors."""
    found = hashlib.sha256()
    for tensor in tensors:
        found.update(tensor.contiguous().numpy().tobytes())
    return found.hexdigest()[:16]


def solved(case: Case) -> dict[str, Any]:
    """Reconstruct a case: digests, metrics, and processor seconds without making the room."""
    torch.set_num_threads(1)
    trial = trial_of(case)
    begin = time.process_time()
    with tempfile.TemporaryDirectory() as folder:
        room = reconstruct(trial.capture, PRESETS["robust"], Run(Path(folder)))
    seconds = time.process_time() - begin
    assert room.bodies is not None
    camera = room.scene.camera
    placed = [(x.t_world_object, x.yaw, x.scale) for x in room.scene.objects]
    people = EvaluatedBodies(None, room.bodies, trial.bodies)
    scenes = trial.capture.scene, room.scene, trial.truth
    metrics = evaluate(*scenes, people, EvaluateConfig(by_place=False), ("result",))["result"]
    return {
        "objects": digest([camera.K, camera.R_cam_world, *(x for row in placed for x in row)]),
        "bodies": digest([room.bodies.verts]),
        "seconds": round(seconds, 1),
        **{name: round(metrics[name], 5) for name in MEANS},
    }


def means_of(found: dict[str, Any]) -> dict[str, dict[str, float]]:
    """Means of the metrics over the rooms of each set."""
    means: dict[str, dict[str, float]] = {}
    for rooms in ROOMS:
        some = [one for name, one in found.items() if name.startswith(f"{rooms} ")]
        means[rooms] = {name: sum(one[name] for one in some) / len(some) for name in MEANS}
    return means


def changes_in_bits(found: dict[str, Any], known: dict[str, Any]) -> list[str]:
    """Cases whose placements or bodies are not as stored."""
    lines: list[str] = []
    for name, one in found.items():
        old = known.get(name, {})
        other = [what for what in ("objects", "bodies") if one[what] != old.get(what)]
        if other:
            gap = one["iou3d"] - old.get("iou3d", float("nan"))
            lines.append(f"{name}: other {' and '.join(other)}, IoU3D {gap:+.4f}")
    return lines


def changes_in_means(found: dict[str, Any], known: dict[str, Any]) -> list[str]:
    """Sets whose means are farther off than allowed."""
    lines: list[str] = []
    for rooms, means in means_of(found).items():
        old = means_of({name: known[name] for name in found})[rooms]
        for name, allowed in MEANS.items():
            gap = means[name] - old[name]
            print(f"{rooms}: {name} {old[name]:.4f} -> {means[name]:.4f}")
            if not abs(gap) <= allowed:
                lines.append(f"{rooms}: {name} is off by {gap:+.4f}, allowed {allowed}")
    return lines


def main(arguments: Sequence[str]) -> int:
    """Solve all cases, compare, print; the exit code."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--means", action="store_true", help="six rooms a set, means only")
    parser.add_argument("--write", action="store_true", help="store what is found")
    parser.add_argument("--workers", type=int, default=2, help="rooms beside each other")
    asked = parser.parse_args(arguments)
    cases = [DEMO, *((rooms, k) for rooms in ROOMS for k in (MORE if asked.means else FEW))]
    with ProcessPoolExecutor(asked.workers, get_context("spawn")) as pool:
        answers = zip(cases, pool.map(solved, cases), strict=True)
        found = {f"{rooms} {seed}": one for (rooms, seed), one in answers}
    known: dict[str, Any] = json.loads(STORED.read_text()) if STORED.exists() else {}
    demo = found["demo 0"]["seconds"]
    print(f"demo: {demo} s of processor, stored {known.get('demo 0', {}).get('seconds', '-')}")
    if asked.write:
        STORED.write_text(json.dumps(known | found, indent=1) + "\n")
        return 0
    lines = (changes_in_means if asked.means else changes_in_bits)(found, known)
    print("\n".join(lines) or "as stored")
    return bool(lines)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
