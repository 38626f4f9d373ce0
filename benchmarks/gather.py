"""Time and memory of gathering evidence from a walking body: depth maps and the volume of bodies.

    python benchmarks/gather.py --frames 300

The body is the open one in full (13,380 vertices, 26,756 triangles), on a walk of some metres to
and fro, seen at 640x360 before ten objects; the volume has 256 cells along its longest side.
"""

import argparse
import os
import time
from pathlib import Path
from typing import get_args

import numpy as np
import torch

from mover.bodies.skinning import open_body
from mover.core.devices import Choice, device_of, finish, named
from mover.core.observe import Step
from mover.core.records import to_device
from mover.core.types import Bodies, Camera, Masks, People
from mover.stages.config import GatherConfig
from mover.stages.contacts.gather_cues import GatherInputs, gather_cues
from mover_bench.rooms.gait import duration, stations, walk
from mover_bench.rooms.poses import angles, make_person

WIDTH, HEIGHT, FOCAL = 640, 360, 500.0
OBJECTS = 10
FPS = 30.0


def walking(frames: int) -> torch.Tensor:
    """Vertices of a body that walks to and fro in front of the camera [m]."""
    corners = np.array([[-1.5, -3.0], [1.5, -3.0], [1.2, -5.5], [-1.6, -5.0]])
    path = np.concatenate([corners, corners[::-1][1:]])
    way = stations(path, 0.0, 0.0)
    times = np.arange(frames) / FPS % duration(way)
    person, model = make_person([0.0] * 10), open_body("full")
    pose = angles(person, walk(person, way, times))
    parts = []
    for begin in range(0, frames, 50):
        few = slice(begin, begin + 50)
        fields = {
            n: getattr(pose, n)[few] for n in ("betas", "global_orient", "body_pose", "transl")
        }
        block = type(pose)(pose.model, pose.gender, extra={}, **fields)
        parts.append(model.posed(block)[0].float() - torch.tensor([0.0, 1.4, 0.0]))
    return torch.cat(parts)


def scene(frames: int) -> GatherInputs:
    """Bodies, person masks (boxes of the body, run-length coded) and ten objects."""
    from pycocotools import mask as coco

    verts, model = walking(frames), open_body("full")
    K = torch.tensor([[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]])
    camera = Camera(K, torch.diag(torch.tensor([1.0, -1.0, -1.0])), WIDTH, HEIGHT)
    cam = verts @ camera.R_cam_world.T
    pixels = cam[..., :2] / cam[..., 2:] * FOCAL + torch.tensor([WIDTH / 2, HEIGHT / 2])
    counts = []
    for low, high in zip(pixels.amin(1).int().tolist(), pixels.amax(1).int().tolist(), strict=True):
        mask = np.zeros((HEIGHT, WIDTH), np.uint8, order="F")
        mask[max(low[1], 0) : max(high[1], 0), max(low[0], 0) : max(high[0], 0)] = 1
        counts.append(coco.encode(mask)["counts"])
    index, person = torch.arange(frames), torch.zeros(frames, dtype=torch.long)
    bodies = Bodies(verts, model.faces, None, (), index, person, FPS, "world", None)
    masks = torch.zeros(OBJECTS, HEIGHT, WIDTH, dtype=torch.bool)
    for k in range(OBJECTS):
        masks[k, 150 : 150 + 12 * (k + 3), 60 * k : 60 * k + 90] = True
    people = People(Masks(HEIGHT, WIDTH, tuple(counts)), index, person, {})
    return GatherInputs(bodies, people, masks, camera)


def memory() -> float:
    """Largest memory of this process since the last call [MB]; on Linux."""
    status = Path("/proc/self/status").read_text().splitlines()
    Path("/proc/self/clear_refs").write_text("5")
    return int(next(line for line in status if line.startswith("VmHWM")).split()[1]) / 1024


def main() -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("--frames", type=int, default=300)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--cells", type=int, default=256)
    parser.add_argument("--device", choices=get_args(Choice), default="cpu")
    options = parser.parse_args()
    device = device_of(options.device)
    inputs = to_device(scene(options.frames), device)
    few = slice(0, 2)
    bodies = inputs.bodies
    warm = Bodies(
        bodies.verts[few], bodies.faces, None, (), bodies.frame[few], bodies.person[few],
        FPS, "world", None,
    )  # fmt: skip
    config = GatherConfig(cells=options.cells, workers=options.workers)
    begin = time.perf_counter()
    gather_cues(GatherInputs(warm, inputs.people, inputs.masks, inputs.camera), config)
    print(f"compiling and 2 frames: {time.perf_counter() - begin:.2f} s")
    memory()
    before = memory()
    now, cpu = time.perf_counter(), time.process_time()
    spent = {}

    def note(step: Step) -> None:
        spent[step.stage] = (time.perf_counter() - now, time.process_time() - cpu)

    gather_cues(inputs, config, note)
    finish(device)
    last = (0.0, 0.0)
    for name, mark in spent.items():
        wall, busy = (1e3 * (x - y) / options.frames for x, y in zip(mark, last, strict=True))
        print(f"{name}: {wall:.2f} ms a frame, {busy:.2f} ms of processor time")
        last = mark
    print(f"{options.frames} frames in {time.perf_counter() - now:.2f} s,",
          f"{time.process_time() - cpu:.2f} s of processor time, {options.workers} workers,",
          f"{named(device)}, load {os.getloadavg()[0]:.1f}")  # fmt: skip
    print(
        f"memory: {before:.0f} MB with the bodies loaded, {memory() - before:.0f} MB more at most"
    )


if __name__ == "__main__":
    main()
