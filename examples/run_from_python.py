"""The reconstruction from Python: python examples/run_from_python.py [FOLDER].

The capture has no people, so only the image speaks; with `bodies=` and `people=` they take part.
"""

import dataclasses
import sys
import tempfile
from pathlib import Path

from capture_from_arrays import make_capture

import mover
from mover.core.observe import Step
from mover.energy.config import Adam


def main(folder: Path, steps: int = 60) -> mover.Room:
    """Reconstruct, and look at what came out."""
    robust = mover.PRESETS["robust"]  # settings are frozen records: change a copy
    layout = dataclasses.replace(robust.layout, method=Adam(steps, 0.03, 0.002, keep_best=True))
    config = dataclasses.replace(robust, layout=layout)

    def watch(step: Step) -> None:
        if step.energy is not None and step.index % 20 == 0:
            total = float(step.energy.total.detach())
            print(f"{step.stage} {step.index}/{step.steps}: {total:.3f}")

    run = mover.Run(folder, watch)  # finished stages are kept there: a second run takes no time
    room = mover.reconstruct(make_capture(), config, run)
    for piece, held in zip(room.scene.objects, room.evidence, strict=True):
        print(piece.id, piece.t_world_object.tolist(), float(piece.yaw), held.mask_pixels, "px")
    for stage in run.stages:
        print(f"{stage.name}: {stage.seconds:.2f} s, {'kept' if stage.kept else 'made'}")
    return room


if __name__ == "__main__":
    if len(sys.argv) > 1:
        main(Path(sys.argv[1]))
    else:
        with tempfile.TemporaryDirectory() as name:
            main(Path(name))
