"""The capture of `mover demo`: a known room with realistic noise, and its truth.

`data/` holds files of the capture format, and the people as parameters of the open body.
The bench's module `rooms.demo_data` makes them again.
"""

import shutil
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from mover.bodies.skinning import open_body
from mover.core.records import map_tensors
from mover.core.types import Bodies, BodyPose
from mover.io.capture.bodies_file import write_bodies
from mover.io.capture.pose_file import NEEDED

DATA = Path(__file__).parent / "data"


def write_demo(folder: Path) -> None:
    """Write the capture, and its truth into `truth/`; the folder is whole or not there."""
    part = folder.with_name(f".{folder.name}.part")
    shutil.rmtree(part, ignore_errors=True)
    shutil.copytree(DATA / "capture", part)
    for people, where in (("capture", part), ("truth", part / "truth")):
        write_bodies(read_people(DATA / f"{people}.npz"), where / "bodies.npz")
    part.rename(folder)


def read_people(path: Path) -> Bodies:
    """The people of a file of parameters (float64), in the camera's axes."""
    with np.load(path) as arrays:
        tensors = {name: torch.from_numpy(arrays[name]) for name in NEEDED}
        frame, fps = torch.from_numpy(arrays["frame"]), float(arrays["fps"])
    pose = BodyPose(model="makehuman", gender="neutral", extra={}, **tensors)
    model = open_body()
    verts, joints = model.posed(pose)
    return Bodies(
        verts=rounded(verts),
        faces=model.faces,
        joints=rounded(joints),
        joint_names=model.joint_names,
        frame=frame,
        person=torch.zeros_like(frame),
        fps=fps,
        space="camera",
        pose=map_tensors(rounded, pose),
    )


def rounded(value: Tensor) -> Tensor:
    """To 10 micrometres, so that the last bits of other machines do not show."""
    return value.mul(1e5).round().div(1e5).float()
