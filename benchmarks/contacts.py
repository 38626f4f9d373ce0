"""How good the geometric contact prior is, on known rooms at truth and with realistic noise.

    PYTHONPATH=src python benchmarks/contacts.py --seeds 200 201 202 203 204

A part touches in a frame if a vertex of it does. True contact is skin within 1 cm of furniture or
floor, so the prior, which marks what could press on a cushion, is also judged vertex by vertex
against skin within 5 cm, the reach of POSA's own labels.
"""

import argparse
import sys
from collections import defaultdict

import torch
from torch import Tensor

from mover.bodies.corrected import in_world
from mover.bodies.parts import members, parts_of
from mover.bodies.posture import touching
from mover.core.types import Mesh
from mover.evaluate.bodies import shared_rows
from mover.evaluate.contact import nearness
from mover.geometry.placement import place_object
from mover.geometry.watertight import close_mesh
from mover_bench.rooms.config import NoiseConfig
from mover_bench.rooms.noise import add_noise
from mover_bench.rooms.room import make_room

PARTS = {
    "soles": ("left_sole", "right_sole"),
    "seat": ("seat", "left_thigh", "right_thigh"),
    "back": ("back",),
    "hands": ("left_palm", "right_palm"),
}
REACH = 0.05  # [m], POSA's labels
Counts = dict[tuple[str, str], Tensor]


def add(counts: Counts, seed: int) -> None:
    """Count what is found and what is true in one room."""
    room = make_room(seed)
    assert room.truth.ground is not None
    noisy = add_noise(room, NoiseConfig(), seed + 1000).bodies
    assert noisy is not None
    true_world = in_world(room.bodies, room.truth.camera)
    furniture = [place_object(p) for p in room.truth.objects]
    closed = [close_mesh(Mesh(f.verts, f.faces)) for f in furniture]
    close = nearness(true_world.verts, closed, REACH).surface
    close = torch.minimum(close, (true_world.verts[..., 1] - room.truth.ground).abs()) <= REACH
    for name, given in (("truth", room.bodies), ("noise", noisy)):
        bodies = in_world(given, room.truth.camera)
        parts = parts_of(bodies)
        rows, true_rows = shared_rows(bodies, room.bodies)
        found = touching(bodies, parts, room.truth.ground)[rows] > 0.5
        true, near = room.touching[true_rows], close[true_rows]
        walks = torch.tensor([room.actions[k] == "walk" for k in true_rows.tolist()])
        for part, names in PARTS.items():
            own = members(parts, *names)
            f, t, n = found[:, own], true[:, own], near[:, own]
            frames = _counts(f.any(1), t.any(1))
            false = f.any(1) & ~t.any(1) & walks
            walk = torch.tensor([int(false.sum()), int(walks.sum())])
            counts[name, part] += torch.cat([frames, _counts(f, n), walk])


def _counts(found: Tensor, true: Tensor) -> Tensor:
    return torch.tensor([int((found & true).sum()), int(found.sum() + true.sum())])


def main() -> None:
    """Add the rooms up and print F1 by part."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[200, 201, 202, 203, 204])
    args = parser.parse_args()
    torch.set_num_threads(1)
    counts: Counts = defaultdict(lambda: torch.zeros(6, dtype=torch.long))
    for seed in args.seeds:
        add(counts, seed)
    _say(f"{'bodies':8}{'part':8}{'F1 frames':>12}{'F1 skin 5 cm':>14}{'false, walking':>16}")
    for (name, part), (tp, both, vtp, vboth, false, walks) in counts.items():
        values = 2 * tp / both.clamp_min(1), 2 * vtp / vboth.clamp_min(1), false / walks
        _say(f"{name:8}{part:8}{values[0]:12.2f}{values[1]:14.2f}{values[2]:16.3f}")


def _say(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
