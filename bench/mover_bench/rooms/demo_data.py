"""Make the files of `mover demo` again: python -m mover_bench.rooms.demo_data."""

import shutil
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from mover.app.demo import DATA
from mover.app.results import write_truth
from mover.core.records import rows_of
from mover.core.types import BodyPose
from mover.io.capture.folder import write_capture
from mover.io.capture.pose_file import NEEDED
from mover_bench.rooms.config import NoiseConfig
from mover_bench.rooms.known import demo_plan, demo_room, in_camera
from mover_bench.rooms.noise import add_noise, noisy_pose

SEED = 0  # of the noise


def write_people(pose: BodyPose, frame: Tensor, fps: float, path: Path) -> None:
    """What `mover.app.demo.read_people` reads: parameters in float64, of one person."""
    tensors = {name: getattr(pose, name).numpy() for name in NEEDED}
    np.savez_compressed(path, **tensors, frame=frame.numpy(), fps=np.array(fps))


def main() -> None:
    """Write the capture, its truth, and the people of both."""
    torch.set_num_threads(1)
    room, noise = demo_room(), NoiseConfig()
    shutil.rmtree(DATA, ignore_errors=True)
    write_capture(add_noise(room, noise, SEED), DATA / "capture")
    write_truth(room.truth, room.bodies, DATA / "capture" / "truth")
    for where in ("capture", "capture/truth"):
        (DATA / where / "bodies.npz").unlink()
    plan, actor = demo_plan()
    frame, fps = room.bodies.frame, room.bodies.fps
    assert fps is not None
    true = in_camera(plan, (actor,), torch.arange(len(frame)))
    write_people(true, frame, fps, DATA / "truth.npz")
    pose, keep = noisy_pose(room, noise, np.random.default_rng([SEED, 4]))
    write_people(rows_of(pose, keep), frame[keep], fps, DATA / "capture.npz")


if __name__ == "__main__":
    main()
