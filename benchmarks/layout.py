"""First scenes without a 3D detector on known rooms, against noisy true ones.

    python benchmarks/layout.py --seeds 100 101 102 --out layout.json

For each known room the program gets what a detector gives (noisy masks, boxes and classes, and a
camera whose tilt is some degrees wrong) and finds a first scene from the furniture library, whose
shapes are not the room's. Reported is the mean IoU of the upright boxes with the true ones: of the
noise model's first scene (the truth, moved, turned and stretched), of ours, and of both after the
main job with the `robust` preset.
"""

import argparse
import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import torch

from mover.core.run import Run
from mover.core.types import Scene
from mover.furniture.library import catalogue
from mover.geometry.boxes import box_of, iou3d
from mover.io.files.meshes import write_mesh
from mover.perceive.config import LayoutConfig
from mover.perceive.layout import FirstScene, first_scene
from mover.pipeline.presets import PRESETS
from mover.pipeline.reconstruct import reconstruct
from mover_bench.experiment.real import picture_of
from mover_bench.rooms.config import NoiseConfig
from mover_bench.rooms.known import KnownRoom, make_room
from mover_bench.rooms.noise import add_noise


def iou(scene: Scene, truth: Scene) -> float:
    """Mean IoU3D; objects are matched by their annotation, a missing one scores 0."""
    by_note = {p.annotation: p for p in scene.objects}
    values = [
        float(iou3d(box_of(by_note[p.annotation]), box_of(p))) if p.annotation in by_note else 0.0
        for p in truth.objects
    ]
    return sum(values) / len(values)


def other_designs(room: KnownRoom, folder: Path, kinds: Mapping[str, Sequence[str]]) -> Path:
    """Shapes of classes by the name of their files, without any design that stands in the room."""
    used = {(f.category, f.style) for f in room.furniture}
    for name, classes in kinds.items():
        every = [f for kind in classes for f in catalogue(kind)]
        shapes = [f for f in every if (f.category, f.style) not in used]
        for index, shape in enumerate(shapes):
            write_mesh(shape.mesh, folder / f"{name.replace(' ', '_')}_{index}.glb")
    return folder


def trial(seed: int, args: argparse.Namespace) -> dict[str, float]:
    """One known room."""
    room = make_room(seed)
    capture = add_noise(room, NoiseConfig(), seed)
    begin = time.perf_counter()
    with TemporaryDirectory() as folder:
        kinds = {f.category: (f.category,) for f in room.furniture}
        place = Path(folder) / "meshes"
        meshes = other_designs(room, place, kinds) if args.other_designs else None
        picture = picture_of(capture.detections, capture.scene.camera)
        first = first_scene(picture, LayoutConfig(), Run(Path(folder)), meshes)
        row = {
            "seed": seed,
            "objects": len(room.truth.objects),
            "seconds": time.perf_counter() - begin,
            "noise": iou(capture.scene, room.truth),
            "layout": iou(first.scene, room.truth),
            "best hypothesis": best_hypothesis(first, room.truth),
            "height error": abs((first.scene.ground or 0) - (room.truth.ground or 0)),
        }
        ours = replace(capture, scene=replace(first.scene, ground=None))
        others = tuple(h.piece for group in first.others for h in group[1:])
        given = {"noise": capture, "alone": ours, "layout": replace(ours, hypotheses=others)}
        for name in args.job:
            run = Run(Path(folder) / name)
            found = reconstruct(given[name], PRESETS["robust"], run)
            row[f"{name} after the job"] = iou(found.scene, room.truth)
    return row


def best_hypothesis(first: FirstScene, truth: Scene) -> float:
    """Mean IoU3D if an oracle chose among the hypotheses that are kept."""
    best = {
        group[0].piece.annotation: max(
            float(iou3d(box_of(h.piece), box_of(true)))
            for h in group
            for true in truth.objects
            if true.annotation == h.piece.annotation
        )
        for group in first.others
    }
    return sum(best.get(p.annotation, 0.0) for p in truth.objects) / len(truth.objects)


def main() -> None:
    """Measure and print a table."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(100, 110)))
    parser.add_argument("--job", nargs="*", choices=("noise", "alone", "layout"),
                        default=["layout"],
                        help="from what the main job starts; alone: ours without the other "
                        "hypotheses")  # fmt: skip
    parser.add_argument("--other-designs", action="store_true",
                        help="no shape of a design that stands in the room")  # fmt: skip
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    torch.set_num_threads(1)
    rows = []
    for seed in args.seeds:
        rows.append(trial(seed, args))
        print({k: round(v, 3) for k, v in rows[-1].items()}, flush=True)
        if args.out:
            args.out.write_text(json.dumps(rows, indent=1))
    print("mean", {k: round(sum(r[k] for r in rows) / len(rows), 3) for k in rows[0]})


if __name__ == "__main__":
    main()
