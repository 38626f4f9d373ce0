"""Against what a user would pick instead: PYTHONPATH=src python benchmarks/peers.py.

The engine's parts beside the torch oracle, DEODR (silhouettes), Embree (depth), libigl and Open3D
(signed distance), SciPy (nearest points). Rows are measured in one run, in turns, so that a busy
machine slows all of them; each says how far its result is from ours. What is not installed is
skipped with a line. `--scaling` adds our own growth; `--gate` fails where a figure of quality is
worse than `baseline.json` allows, and only warns of times; `--write` makes a new baseline.
"""

import argparse
import json
import os
import platform
import resource
from collections.abc import Callable
from functools import cache
from importlib.util import find_spec
from pathlib import Path

import numpy as np
import torch
from engine import Room, make_room, measure, price, step
from gate import judge
from gather import scene as gather_scene
from torch import Tensor
from workload import workload

from mover.energy import SceneConfig
from mover.energy_warp import pricing
from mover.geometry import raster
from mover.geometry.nearest_warp import clouds, nearest
from mover.geometry.raster import Views
from mover.geometry.raster_engine import use_engine, use_threads
from mover.geometry.volume import BAND, SHELL, grid_around, signed_distance, union_bodies
from mover.presets import ROBUST
from mover.stages.place_objects import with_trees

BASELINE = Path(__file__).parent / "baseline.json"
FLOORS = {"silhouette": 1e-5, "depth": 1e-4, "distance": 1e-4, "nearest": 1e-6}  # tolerances
Work = dict[str, Callable[[], object]]
Figures = dict[str, float]


def silhouettes(threads: int) -> tuple[Work, Figures]:
    """Ten objects of 10,000 faces in windows of 256 pixels, and the gradient of their vertices."""
    room = make_room(10, 10000, 256)
    verts = room.verts

    def ours(name: str) -> tuple[Tensor, Tensor]:
        free = verts.clone().requires_grad_()
        with use_engine("torch" if name == "torch" else "warp"), use_threads(threads):
            image = raster.silhouettes(free, room.shape, room.views)
            (image - room.masks).square().sum().backward()
        assert free.grad is not None
        return image.detach(), free.grad

    work: Work = {f"silhouette {n}": lambda n=n: ours(n) for n in ("warp", "torch")}
    (a, slope), (b, other) = ours("warp"), ours("torch")
    figures = {
        "silhouette warp - torch": float((a - b).abs().max()),
        "silhouette gradient warp - torch, relative": float((slope - other).norm() / other.norm()),
    }
    if absent("deodr"):
        return work, figures
    work["silhouette DEODR"] = lambda: deodr(room)
    drawn = deodr(room)
    print(
        f"not comparable: DEODR draws over its outlines; mean difference {(a - drawn).mean():+.1e},"
        f" largest {(a - drawn).abs().max():.2f}; its gradient stops at the corners' pixels"
    )
    return work, figures


def deodr(room: Room) -> Tensor:
    """The same silhouettes by DEODR, and the gradient of the pixels' corners."""
    from deodr.differentiable_renderer import Scene2D

    views, images = room.views, []
    for item, verts in enumerate(room.verts):
        faces = room.shape.faces[item]
        faces = faces[(faces != 0).any(1)]
        flat = verts @ views.K[item].T
        ij = (flat[:, :2] / flat[:, 2:]).double().numpy()
        count, many = len(verts), len(faces)
        front = signed_area(ij, faces.numpy())
        flags = outline(faces.numpy(), front)
        drawn = Scene2D(
            faces.numpy().astype(np.uint32), np.zeros((many, 3), np.uint32), ij,
            verts[:, 2].double().numpy(), np.zeros(many, bool), np.zeros((1, 2)), np.zeros(count),
            np.ones((count, 1)), np.zeros(many, bool), flags, views.height, views.width, 1,
            np.zeros((0, 0, 1)), background_image=np.zeros((views.height, views.width, 1)),
            backface_culling=True, clockwise=True, integer_pixel_centers=False,
        )  # fmt: skip
        image, _ = drawn.render(1.0)
        drawn.render_backward(2 * (image - room.masks[item].double().numpy()[..., None]))
        images.append(torch.from_numpy(image[..., 0]).float())
    return torch.stack(images)


def signed_area(ij: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Whether each triangle turns one way on the screen."""
    a, b, c = (ij[faces[:, k]] for k in range(3))
    u, v = b - a, c - a
    return u[:, 0] * v[:, 1] - u[:, 1] * v[:, 0] > 0


@cache
def sides_of(table: bytes) -> np.ndarray:
    """Number of the side that each corner of each triangle begins; once for each topology."""
    faces = np.frombuffer(table, np.int64).reshape(-1, 3)
    sides = np.sort(np.stack([faces, np.roll(faces, -1, 1)], -1), -1).reshape(-1, 2)
    return np.unique(sides, axis=0, return_inverse=True)[1]


def outline(faces: np.ndarray, front: np.ndarray) -> np.ndarray:
    """For each side of each triangle, whether its two triangles turn differently."""
    index = sides_of(faces.tobytes())
    fronts = np.bincount(index.ravel(), np.repeat(front, 3))
    total = np.bincount(index.ravel())
    edge = (fronts > 0) & (fronts < total) | (total == 1)
    return edge[index.ravel()].reshape(-1, 3)


def depth(threads: int) -> tuple[Work, Figures]:
    """First surface of a body of 26,756 triangles at 640 x 360, a new pose each call."""
    given = gather_scene(2)
    cam = given.bodies.verts @ given.camera.R_cam_world.T
    faces, K = given.bodies.faces, given.camera.K
    views = Views(K[None], given.camera.height, given.camera.width)

    def ours() -> Tensor:
        with use_engine("warp"), use_threads(threads):
            return raster.layers(cam[:1], faces, views).front[0]

    work: Work = {"depth warp": ours}
    with use_engine("torch"):
        figures = compared(
            "depth warp - torch", ours(), raster.layers(cam[:1], faces, views).front[0]
        )
    if not absent("embreex"):
        work["depth Embree, tree anew"] = lambda: embree(cam[0], faces, views)
        figures |= compared("depth warp - Embree", ours(), embree(cam[0], faces, views))
    return work, figures


def compared(name: str, one: Tensor, two: Tensor) -> Figures:
    """Largest difference where both see a surface, and the share of pixels where one does."""
    both = one.isfinite() & two.isfinite()
    only = one.isfinite() ^ two.isfinite()
    return {
        name: float((one - two)[both].abs().quantile(0.99)),
        f"{name}, seen by one": float(only.sum() / both.sum()),
    }


def embree(verts: Tensor, faces: Tensor, views: Views) -> Tensor:
    """Depth of the first hit, by a tree that is built for this pose."""
    from embreex import rtcore_scene
    from embreex.mesh_construction import TriangleMesh

    scene = rtcore_scene.EmbreeScene()
    TriangleMesh(scene, verts[faces].numpy().astype(np.float32))
    y, x = torch.meshgrid(
        torch.arange(views.height) + 0.5, torch.arange(views.width) + 0.5, indexing="ij"
    )
    rays = torch.stack([x, y, torch.ones_like(x)], -1).reshape(-1, 3) @ views.K[0].inverse().T
    far = scene.run(np.zeros_like(rays.numpy()), rays.numpy(), query="DISTANCE")
    found = torch.from_numpy(np.asarray(far)).float().view(views.height, views.width)
    return torch.where(found < 1e6, found, torch.inf)


def distance(threads: int) -> tuple[Work, Figures]:
    """Signed distance to a body on a grid of 96 cells along its longest side."""
    given = gather_scene(2).bodies
    body, faces = given.verts[:1], given.faces
    grid = grid_around(body[0].amin(0), body[0].amax(0), cells=96, padding=0.1)
    axes = [
        o + grid.cell * torch.arange(n) for o, n in zip(grid.origin, grid.values.shape, strict=True)
    ]
    points = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)

    def shell() -> Tensor:
        with use_threads(threads):
            return union_bodies(body, faces, grid, threads).values.reshape(-1)

    ours, exact = shell(), signed_distance(points, body[0], faces)
    near = exact < (SHELL - 0.01) * grid.cell
    figures = {
        "distance warp - libigl": float((ours - exact)[near].abs().max()),
        "distance beyond the shell": float((ours[~near] < (SHELL - 0.02) * grid.cell).sum()),
    }
    assert float(ours.max()) <= BAND * grid.cell + 1e-6
    work: Work = {
        "distance warp, inside and shell": shell,
        "distance libigl, all places": lambda: signed_distance(points, body[0], faces),
        "distance libigl, inside and shell": lambda: signed_distance(points[near], body[0], faces),
    }
    if not absent("open3d"):
        work["distance Open3D, all places"] = lambda: open3d(points, body[0], faces)
        off = (open3d(points, body[0], faces) - exact).abs()
        print(f"Open3D - libigl: {off.quantile(0.999):.1e} m at 99.9 %, largest {off.max():.1e}")
    return work, figures


def open3d(points: Tensor, verts: Tensor, faces: Tensor) -> Tensor:
    """Signed distances by Open3D, whose sign is the parity of a ray's crossings."""
    import open3d

    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(verts.numpy(), faces.numpy().astype(np.uint32))
    return torch.from_numpy(scene.compute_signed_distance(points.numpy()).numpy())


def neighbours(threads: int) -> tuple[Work, Figures]:
    """1,200 places to 1,500 points of each of ten objects whose sizes change at every call."""
    from scipy.spatial import KDTree

    draw = torch.Generator().manual_seed(0)
    points = torch.rand(10, 1500, 3, generator=draw)
    query = torch.rand(10, 1200, 3, generator=draw) * 1.4 - 0.2
    scale = torch.rand(10, 3, generator=draw) + 0.5
    held, placed = clouds(points), (points * scale[:, None]).double().numpy()
    trees, asked = [KDTree(p) for p in placed], query.double().numpy()

    def ours() -> Tensor:
        with use_threads(threads):
            return nearest(held, query, scale)

    def apart(index: Tensor) -> Tensor:
        at = torch.from_numpy(placed).gather(1, index[..., None].expand(-1, -1, 3))
        return (query.double() - at).norm(dim=-1)

    def still() -> list[object]:
        return [t.query(q) for t, q in zip(trees, asked, strict=True)]

    exact = torch.stack(
        [torch.from_numpy(t.query(q)[0]) for t, q in zip(trees, asked, strict=True)]
    )
    work: Work = {
        "nearest warp, static trees": ours,
        "nearest SciPy, trees anew": lambda: [
            KDTree(p).query(q) for p, q in zip(placed, asked, strict=True)
        ],
        "nearest SciPy, static trees (wrong when a size changes)": still,
    }
    return work, {"nearest warp - SciPy": float((apart(ours()) - exact).abs().max())}


def scaling(rounds: int) -> None:
    """Print how our own times grow, and the largest memory."""
    print("\nsilhouettes, depths and gradient, wall (processor) [ms]")
    base = {"objects": 10, "faces": 10000, "window": 256, "threads": 2}
    grow = {
        "objects": (1, 5, 20),
        "faces": (2000, 20000),
        "window": (64, 128, 512),
        "threads": (1,),
    }
    rows = [base] + [base | {name: v} for name, values in grow.items() for v in values]
    for row in rows:
        room = make_room(row["objects"], row["faces"], row["window"])

        def run(room: Room = room, threads: int = row["threads"]) -> None:
            with use_engine("warp"), use_threads(threads):
                step(room)

        wall, processor = measure({"": run}, rounds)[""]
        print(" ".join(f"{k} {v}" for k, v in row.items()), f"{wall:.1f} ({processor:.1f})")
    print(f"peak memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB")
    print("frames: benchmarks/gather.py --frames 30, 300 (time and memory of each)")


def energies() -> Figures:
    """Energy and price that a fixed input has: a change of what is computed shows here."""
    given = with_trees(workload(4, 2000, 64))
    scene = SceneConfig(ROBUST.place.weights, ROBUST.place.form)
    with torch.no_grad():
        fast = pricing(given.objects, given.camera, given.image, given.humans, scene)
        value = float(fast(given.starts).per_item.sum())
    room = make_room(4, 2000, 64)
    with torch.no_grad(), use_engine("torch"):
        apart = float(price(room, room.verts))
    with torch.no_grad(), use_engine("warp"):
        apart = abs(float(price(room, room.verts)) / apart - 1)
    return {"energy at a fixed start": value, "price warp - torch, relative": apart}


def absent(name: str) -> bool:
    """Whether a package is not here, said in a line."""
    gone = find_spec(name) is None
    if gone:
        print(f"{name} is not installed: its rows are left out")
    return gone


def written(quality: Figures, times: dict[str, tuple[float, float]]) -> dict[str, object]:
    """A baseline of these figures."""
    held = {
        n: {"value": v, "tolerance": max(FLOORS.get(n.split()[0], 1e-3), 0.2 * abs(v)),
            "optional": "Embree" in n}
        for n, v in quality.items()
    }  # fmt: skip
    spent = {n: {"wall": round(w, 2), "processor": round(p, 2)} for n, (w, p) in times.items()}
    where = {"machine": platform.machine(), "load": round(os.getloadavg()[0], 1)}
    return {"where": where, "quality": held, "times": spent}


def main() -> None:
    """Print the tables, and judge them where asked."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--rounds", type=int, default=10)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--scaling", action="store_true")
    parser.add_argument("--gate", action="store_true")
    parser.add_argument("--write", action="store_true")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    absent("pytorch3d")
    quality, times = energies(), {}
    for compare in (silhouettes, depth, distance, neighbours):
        work, figures = compare(args.threads)
        quality |= figures
        times |= measure(work, args.rounds)
    print(f"load {os.getloadavg()[0]:.1f}, {args.threads} threads, least of {args.rounds} rounds")
    for name, (wall, processor) in times.items():
        print(f"{name:<58} {wall:9.2f} ms ({processor:.2f} of processor time)")
    for name, value in quality.items():
        print(f"{name:<58} {value:9.2e}")
    if args.write:
        BASELINE.write_text(json.dumps(written(quality, times), indent=1) + "\n")
    if args.scaling:
        scaling(args.rounds)
    if args.gate:
        verdict = judge(
            quality, {n: w for n, (w, _) in times.items()}, json.loads(BASELINE.read_text())
        )
        print(
            "\n".join(
                [f"WORSE {f}" for f in verdict.failures] + [f"slower {w}" for w in verdict.warnings]
            )
        )
        raise SystemExit(bool(verdict.failures))


if __name__ == "__main__":
    main()
