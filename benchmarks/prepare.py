"""What foreign furniture costs before it can be placed: large, open, unclean meshes.

    python benchmarks/prepare.py --faces 50000 --objects 8
    python benchmarks/prepare.py --faces 500000 --objects 1

Each mesh is a known piece, cut finely, with a rough surface, patches missing, faces turned over and
seams that are not joined. Printed: seconds of `prepare_objects` the first time, and when the same
meshes come again (another folder, another place: what was closed is kept in the user's cache).
"""

import argparse
import os
import resource
import tempfile
import time

import numpy as np
import torch

from mover.core.types import Mesh, SceneObject
from mover.furniture.library import make_piece
from mover.geometry.mesh import box
from mover.geometry.volume import signed_distance
from mover.stages.config import PrepareConfig
from mover.stages.objects.prepare_objects import (
    Prepared,
    PrepareInputs,
    prepare_objects,
    proxy_meshes,
)

NAMES = (
    "armchair", "desk", "shelf", "wardrobe", "coffee table", "office chair", "sofa", "double bed",
)  # fmt: skip
PLACES = 60_000  # random ones, of which those inside are counted
ROUGH = 0.002  # [m]
MISSING, TURNED, LOOSE = 0.03, 0.05, 0.1  # share of the faces


def unclean(name: str, count: int, seed: int) -> Mesh:
    """A piece of about so many faces as tools leave it."""
    import fast_simplification
    import trimesh

    rng = np.random.default_rng(seed)
    mesh = make_piece(name, rng).mesh
    shape = trimesh.Trimesh(mesh.verts.numpy(), mesh.faces.numpy(), process=False)
    edge = float(np.sqrt(shape.area / count * 4 / np.sqrt(3)))
    while len(shape.faces) < count:
        finer = trimesh.remesh.subdivide_to_size(shape.vertices, shape.faces, 1.3 * edge, 20)
        shape = trimesh.Trimesh(*finer[:2])
        edge *= 0.9
    found = fast_simplification.simplify(shape.vertices, shape.faces, target_count=count)
    shape = trimesh.Trimesh(*found[:2])
    verts = np.asarray(shape.vertices) + rng.normal(0, ROUGH, shape.vertices.shape)
    faces = np.asarray(shape.faces)
    centers = verts[faces].mean(1)
    seeds = centers[rng.choice(len(faces), 40)]
    near = np.min([((centers - seed) ** 2).sum(-1) for seed in seeds], axis=0)
    faces = faces[near > np.quantile(near, MISSING)]
    turned = rng.random(len(faces)) < TURNED
    faces = np.where(turned[:, None], faces[:, ::-1], faces)
    loose = np.flatnonzero(rng.random(len(faces)) < LOOSE)
    extra = verts[faces[loose]].reshape(-1, 3)
    faces[loose] = len(verts) + np.arange(3 * len(loose)).reshape(-1, 3)
    verts = np.vstack([verts, extra])
    return Mesh(torch.from_numpy(verts).float(), torch.from_numpy(faces).long())


def scene(count: int, faces: int) -> tuple[SceneObject, ...]:
    """So many pieces of different kinds."""
    return tuple(
        SceneObject(
            f"{name}_{i}", name, unclean(name, faces, i), "", None, "ground",
            t_world_object=torch.tensor([float(i), 0.0, -3.0]), yaw=torch.tensor(0.3),
            scale=torch.ones(3),
        )
        for i in range(count)
        for name in [NAMES[i % len(NAMES)]]
    )  # fmt: skip


def likeness(pieces: tuple[SceneObject, ...], made: Prepared) -> list[float]:
    """Share of the volume that each prepared mesh has in common with the known piece."""
    found: list[float] = []
    for index, (piece, proxy) in enumerate(zip(pieces, proxy_meshes(made), strict=True)):
        true = make_piece(piece.category, np.random.default_rng(index)).mesh
        low, high = box(torch.cat([proxy.verts, true.verts]))
        draw = torch.Generator().manual_seed(0)
        places = low + torch.rand(PLACES, 3, generator=draw) * (high - low)
        one, two = (signed_distance(places, m.verts, m.faces) < 0 for m in (proxy, true))
        found.append(float((one & two).sum() / (one | two).sum()))
    return found


def main() -> None:
    """Print a line a pass."""
    parser = argparse.ArgumentParser(description="Prepare foreign furniture.")
    parser.add_argument("--faces", type=int, default=50_000)
    parser.add_argument("--objects", type=int, default=8)
    args = parser.parse_args()
    torch.set_num_threads(1)
    pieces = scene(args.objects, args.faces)
    with tempfile.TemporaryDirectory() as cache:
        prepare_objects(PrepareInputs(scene(1, 200)), PrepareConfig())  # kernels and imports
        os.environ["XDG_CACHE_HOME"] = cache
        for turn in ("first", "again"):
            begin, used = time.perf_counter(), time.process_time()
            made = prepare_objects(PrepareInputs(pieces), PrepareConfig())
            seconds, worked = time.perf_counter() - begin, time.process_time() - used
            peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
            print(
                f"{turn}: {seconds:.2f} s, {worked:.2f} s of CPU, {peak:.0f} MB, faces "
                f"{[len(p.mesh.faces) for p in pieces]} -> "
                f"{[int((f != 0).any(-1).sum()) for f in made.objects.faces]}"
            )
        alike = likeness(pieces, made)
        print(f"IoU with the known pieces: mean {np.mean(alike):.3f}, least {min(alike):.3f}")


if __name__ == "__main__":
    main()
