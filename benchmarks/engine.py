"""How long the rasterisers take: PYTHONPATH=src:tests python benchmarks/engine.py.

Ten pieces of furniture in square windows are drawn (silhouette, first and last depth), and the
gradient of a price is taken back to the vertices. The price has the shape of Eq. 1: squared
differences of the silhouettes from masks, and depth beyond a bound on a part of the pixels. All
rows of the table are made in one run, in turns, so that a busy machine slows all of them.
"""

import argparse
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import get_args

import fast_simplification
import igl
import numpy as np
import torch
from reference import use_engine
from torch import Tensor

from mover.core.devices import Choice, device_of, finish, named
from mover.core.records import to_device
from mover.geometry import crops, raster
from mover.geometry.camera import tilted
from mover.geometry.raster import Crops, Topology
from mover.geometry.rotations import rot_y
from mover.geometry.topology import edges_of
from mover.geometry.warp_start import use_threads

K = torch.tensor([[353.5, 0, 317.1], [0, 353.5, 178.9], [0, 0, 1]])  # an image of 640 x 360 pixels
ROUND, CELLS = 0.02, 96
BOX = tuple[tuple[float, float, float], tuple[float, float, float]]  # centre, half sides [m]


def chair() -> list[BOX]:
    legs = [((x, 0.22, z), (0.035, 0.22, 0.035)) for x in (-0.2, 0.2) for z in (-0.2, 0.2)]
    return [((0, 0.45, 0), (0.25, 0.04, 0.25)), ((0, 0.75, -0.22), (0.25, 0.3, 0.04)), *legs]


def sofa() -> list[BOX]:
    arms = [((x, 0.3, 0.0), (0.1, 0.3, 0.4)) for x in (-0.8, 0.8)]
    return [((0, 0.2, 0), (0.9, 0.2, 0.4)), ((0, 0.5, -0.35), (0.9, 0.35, 0.1)), *arms]


def table() -> list[BOX]:
    legs = [((x, 0.35, z), (0.04, 0.35, 0.04)) for x in (-0.5, 0.5) for z in (-0.3, 0.3)]
    return [((0, 0.72, 0), (0.6, 0.04, 0.4)), *legs]


def bed() -> list[BOX]:
    return [((0, 0.2, 0), (0.8, 0.2, 1.0)), ((0, 0.5, -0.95), (0.8, 0.4, 0.05))]


@dataclass(frozen=True)
class Room:
    """Objects in camera axes, and what an image would say of them."""

    verts: Tensor
    shape: Topology
    views: Crops
    masks: Tensor
    bound: Tensor
    bounded: Tensor


def mesh(boxes: list[BOX], n_faces: int) -> tuple[Tensor, Tensor]:
    """A smooth union of rounded boxes as a closed mesh with even triangles."""
    low = np.min([np.subtract(c, h) for c, h in boxes], 0) - 0.06
    high = np.max([np.add(c, h) for c, h in boxes], 0) + 0.06
    size = np.ceil((high - low) / (high - low).max() * CELLS).astype(int) + 1
    axes = [np.linspace(low[i], high[i], size[i]) for i in range(3)]
    z, y, x = np.meshgrid(*axes[::-1], indexing="ij")
    points = np.stack([x, y, z], -1).reshape(-1, 3)
    value = np.full(len(points), np.inf)
    for centre, half in boxes:
        q = np.abs(points - centre) - half + ROUND
        outside = np.linalg.norm(np.maximum(q, 0), axis=1)
        value = np.minimum(value, outside + np.minimum(q.max(1), 0) - ROUND)
    verts, faces = igl.marching_cubes(value, points, *(int(s) for s in size), 0.0)[:2]
    if len(faces) > n_faces:
        verts, faces = fast_simplification.simplify(
            verts.astype(np.float32), faces.astype(np.int32), target_count=n_faces
        )
    points, table = torch.tensor(verts).float(), torch.tensor(faces).long()
    volume = torch.linalg.det(points[table]).sum()
    return points, table if volume > 0 else table.flip(1)


def padded(parts: list[Tensor], like_first: bool = False) -> Tensor:
    """Stack tables of different lengths."""
    longest = max(map(len, parts))
    fill = [p[:1] if like_first else torch.zeros_like(p[:1]) for p in parts]
    rows = [
        torch.cat([p, f.expand(longest - len(p), -1)]) for p, f in zip(parts, fill, strict=True)
    ]
    return torch.stack(rows)


def make_room(objects: int, n_faces: int, window: int) -> Room:
    """Objects at random places before the camera; masks are those of places a little off."""
    kinds = [mesh(k(), n_faces) for k in (chair, sofa, table, bed)]
    meshes = [kinds[i % 4] for i in range(objects)]
    shape = Topology(padded([f for _, f in meshes]), padded([edges_of(f) for _, f in meshes]))
    verts = padded([v for v, _ in meshes], like_first=True)
    r = torch.Generator().manual_seed(0)
    yaw = torch.rand(objects, generator=r) * 6.28
    place = torch.rand(objects, 3, generator=r) * torch.tensor([2.4, 0.2, 1.6])
    place = place + torch.tensor([-1.2, -1.4, -4.2])
    tilt = tilted(torch.tensor(-0.2), torch.tensor(0.0)).mT

    def put(noise: float) -> Tensor:
        off = noise * torch.randn(objects, 1, 3, generator=r)
        return (verts @ rot_y(yaw).mT + place[:, None] + off) @ tilt

    verts_cam, truth = put(0.0), put(0.04)
    uv = truth @ K.T
    uv = uv[..., :2] / uv[..., 2:]
    views = crops.crop_views(K, torch.cat([uv.amin(1), uv.amax(1)], 1), 0.3, window)
    with use_engine("torch"):
        image, seen = raster.look(truth, shape, views)
    assert seen is not None
    left = torch.arange(window) < 0.4 * window
    return Room(verts_cam, shape, views, image, seen.nearest, seen.covered & left)


def price(room: Room, verts: Tensor) -> Tensor:
    """Silhouette and depth terms."""
    image, seen = raster.look(verts, room.shape, room.views)
    assert seen is not None
    near = (room.bound - seen.nearest).clamp_min(0) * (room.bounded & seen.covered)
    return (image - room.masks).square().sum() + near.sum()


def draw(room: Room) -> None:
    """Maps only."""
    with torch.no_grad():
        raster.look(room.verts, room.shape, room.views)


def step(room: Room) -> None:
    """Maps, price and the gradient of all vertices."""
    verts = room.verts.clone().requires_grad_()
    torch.autograd.backward(price(room, verts))


def measure(work: dict[str, Callable[[], None]], rounds: int) -> dict[str, tuple[float, float]]:
    """Least wall time and least processor time [ms] of each piece of work, taken in turns."""
    best = {name: (float("inf"), float("inf")) for name in work}
    for turn in range(rounds + 1):
        for name, run in work.items():
            wall, processor = time.perf_counter(), time.process_time()
            run()
            spent = (time.perf_counter() - wall) * 1e3, (time.process_time() - processor) * 1e3
            if turn:
                best[name] = min(best[name][0], spent[0]), min(best[name][1], spent[1])
    return best


def task(name: str, threads: int, room: Room, run: Callable[[Room], None]) -> Callable[[], None]:
    """Work bound to an engine and a number of threads."""

    def work() -> None:
        torch.set_num_threads(threads if name == "torch" else 1)
        with use_engine(name), use_threads(threads):
            run(room)
        finish(room.verts.device)

    return work


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--objects", type=int, default=10)
    parser.add_argument("--faces", type=int, nargs="+", default=[2000, 10000])
    parser.add_argument("--windows", type=int, nargs="+", default=[128, 256])
    parser.add_argument("--threads", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--rounds", type=int, default=20)
    parser.add_argument("--device", choices=get_args(Choice), default="cpu")
    args = parser.parse_args()
    device = device_of(args.device)
    print(
        f"{args.objects} objects on {named(device)}; least of {args.rounds} rounds, in ms:"
        " wall (processor)"
    )
    print(
        f"{'faces':>6} {'window':>6} {'engine':>6} {'threads':>7} {'draw':>16} {'and gradient':>16}"
    )
    for n_faces in args.faces:
        for window in args.windows:
            room = to_device(make_room(args.objects, n_faces, window), device)
            rows = [(e, t) for e in ("torch", "warp") for t in args.threads]
            runs = {"draw": draw, "step": step}
            work = {f"{e} {t} {k}": task(e, t, room, f) for e, t in rows for k, f in runs.items()}
            best = measure(work, args.rounds)
            for e, t in rows:
                cells = [best[f"{e} {t} {k}"] for k in runs]
                text = " ".join(f"{f'{w:.2f} ({p:.2f})':>16}" for w, p in cells)
                print(f"{n_faces:>6} {window:>6} {e:>6} {t:>7} {text}", flush=True)


if __name__ == "__main__":
    main()
