"""Makes `mhr_parts.npz`: parts and rings of MHR's topology, from a few meshes of people.

    python tools/body_parts/build.py FACES.npz MESH.npz ... --out src/mover/bodies/assets

FACES.npz has `faces`; each MESH.npz has `vertices` or `pred_vertices` (SAM 3D Body's output). What
most of the meshes give a vertex is its part. No geometry of MHR is kept.
"""

import argparse
from pathlib import Path

import numpy as np

from mover.bodies.match_mesh import match
from mover.bodies.parts import digest_of


def main() -> None:
    """Match the meshes, and write the lists."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("faces", type=Path)
    parser.add_argument("meshes", type=Path, nargs="+")
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    with np.load(args.faces) as data:
        faces = data["faces"].astype(np.int64)
    meshes: list[np.ndarray] = []
    for path in args.meshes:
        with np.load(path) as data:
            verts = data["vertices" if "vertices" in data.files else "pred_vertices"]
            meshes += list(verts.reshape(-1, *verts.shape[-2:]).astype(np.float64))
    found = match(np.stack(meshes), faces)
    if found is None:
        raise SystemExit("these are no whole people")
    np.savez_compressed(
        args.out / "mhr_parts.npz",
        part_of=found.part.astype(np.int8),
        rings=found.rings.astype(np.int32),
        digest=digest_of(faces),
    )


if __name__ == "__main__":
    main()
