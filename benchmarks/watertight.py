"""Close every mesh under some folders and measure how far the surface moved.

    python benchmarks/watertight.py FOLDER ...

Printed per mesh: faces before and after, whether the result is closed, the mean distance from the
visible source to the result and back (share of the longest side), the volume in its box, how much
the volume changes when the resolution is doubled, and seconds. Walls inside walls are no surface of
a solid: source points deeper than 0.5 % do not count, but their share is printed.
"""

import argparse
import time
from pathlib import Path

import torch

from mover.geometry import mesh as m
from mover.geometry.nearest import to_surface
from mover.geometry.volume import signed_distance
from mover.geometry.watertight import close_mesh
from mover.io.files.fields import At
from mover.io.files.meshes import KINDS, read_mesh


def measure(path: Path) -> dict[str, float]:
    """One mesh."""
    source, _ = read_mesh(At(path.name, path.name), path.parent)
    begin = time.perf_counter()
    closed = close_mesh(source)
    seconds = time.perf_counter() - begin
    low, high = m.box(m.used(source).verts)
    longest = float((high - low).max())
    there, _ = m.sample_surface(source, 3000)
    back, _ = m.sample_surface(closed, 3000)
    depth = signed_distance(there, closed.verts, closed.faces)
    visible = depth > -0.005 * longest
    volume = m.signed_volume(closed)
    return {
        "faces": len(source.faces),
        "closed faces": len(closed.faces),
        "closed": m.is_closed(closed.faces),
        "there %": 100 * float(depth[visible].abs().mean()) / longest,
        "back %": 100 * float(to_surface(back, source.verts, source.faces).mean()) / longest,
        "inner %": 100 * float((~visible).float().mean()),
        "volume %": 100 * volume / float((high - low).prod()),
        "finer %": 100 * (m.signed_volume(close_mesh(source, 192)) / volume - 1),
        "seconds": seconds,
    }


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("folders", type=Path, nargs="+")
    args = parser.parse_args()
    torch.set_num_threads(1)
    rows = []
    for folder in args.folders:
        for path in sorted(p for p in folder.rglob("*") if p.suffix.lower() in KINDS):
            rows.append(measure(path))
            shown = {k: round(float(v), 3) for k, v in rows[-1].items()}
            print(f"{path.parent.name}/{path.name}", shown, flush=True)
    for key in ("there %", "back %"):
        print("worst", key, round(max(row[key] for row in rows), 3))
    print("closed", sum(bool(row["closed"]) for row in rows), "of", len(rows))


if __name__ == "__main__":
    main()
