"""The paper's table of human poses on known rooms: what the room gives back to the bodies.

    PYTHONPATH=src python benchmarks/bodies.py --seeds 200 202 203

The bodies have the errors of `NoiseConfig`: pose and depth errors that last. Every row is refined
by the same terms of smoothness and of staying near; only what it knows of the room differs. The
rows named `masks` know the outlines of people's masks too, which the paper's refinement does not.
With `--estimated` layout, camera, floor and the people's depth are those that `robust` finds; the
row `as found` is its result before refinement, and what follows begins there.
"""

import argparse
import dataclasses
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import torch

from mover.core.records import rows_of
from mover.core.run import Run
from mover.core.types import Bodies, Capture, Room, Scene
from mover.evaluate.bodies import gather_twins, p_pje, p_v2v, pje, v2v
from mover.geometry.watertight import close_mesh
from mover.pipeline.outcome import to_world
from mover.pipeline.presets import PRESETS
from mover.pipeline.reconstruct import reconstruct
from mover.stages.config import RefineBodiesConfig
from mover.stages.people.refine_bodies import ABLATION, refine_bodies
from mover_bench.rooms.config import NoiseConfig
from mover_bench.rooms.noise import add_noise
from mover_bench.rooms.room import make_room

METRICS = (pje, v2v, p_pje, p_v2v)
GIVEN, FOUND = "as given", "as found"


def rooms_of(seed: int, place: float) -> tuple[Capture, Bodies, Room, Room]:
    """A noisy capture, the true bodies, the room under the guessed and under the true camera.

    Args:
        seed: Of the room; its noise is drawn from another one.
        place: Error of the furniture's place along x and z, drawn evenly [m].
    """
    known = make_room(seed)
    capture = add_noise(known, NoiseConfig(), seed + 1000)
    draw = torch.Generator().manual_seed(seed)
    pieces = tuple(
        dataclasses.replace(p, t_world_object=p.t_world_object + place * _flat(draw))
        for p in known.truth.objects
    )
    proxies = tuple(close_mesh(p.mesh) for p in pieces)
    assert capture.bodies is not None
    found: list[Room] = []
    for camera in (capture.scene.camera, known.truth.camera):
        scene = Scene(camera, known.truth.ground, pieces)
        found.append(
            Room(scene, capture.scene, scene, to_world(capture.bodies, camera), None, proxies, (),
                 None, {}, ())
        )  # fmt: skip
    return capture, to_world(known.bodies, known.truth.camera), found[0], found[1]


def _flat(draw: torch.Generator) -> torch.Tensor:
    both = 2 * torch.rand(3, generator=draw) - 1
    return both * torch.tensor([1.0, 0.0, 1.0])


def found_room(capture: Capture) -> Room:
    """The room that the preset `robust` finds."""
    with tempfile.TemporaryDirectory() as work:
        return reconstruct(capture, PRESETS["robust"], Run(Path(work)))


def first_bodies(room: Room, most: int) -> Room:
    """The room with its first rows of bodies only."""
    bodies = room.bodies
    assert bodies is not None
    rows = torch.arange(min(most, len(bodies.frame)))
    return dataclasses.replace(room, bodies=rows_of(bodies, rows))


def scores(bodies: Bodies, truth: Bodies) -> list[float]:
    """PJE, V2V and both after Procrustes [mm]."""
    twins = gather_twins(bodies, truth)
    assert twins is not None
    return [1000 * float(metric(twins) or 0) for metric in METRICS]


def main() -> None:
    """Refine each room with each row of the table, and print the means."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, nargs="+", default=[200, 202, 203])
    parser.add_argument("--rows", nargs="+", default=list(ABLATION))
    parser.add_argument("--place", type=float, default=0.0)
    parser.add_argument("--most", type=int, default=100_000, help="bodies of each room, the first")
    parser.add_argument("--estimated", action="store_true", help="rooms that `robust` finds")
    args = parser.parse_args()
    torch.set_num_threads(1)
    table: dict[str, list[list[float]]] = {}
    for seed in args.seeds:
        capture, truth, guessed, known = rooms_of(seed, args.place)
        known = found_room(capture) if args.estimated else known
        guessed, known = (first_bodies(r, args.most) for r in (guessed, known))
        assert guessed.bodies is not None
        table.setdefault(GIVEN, []).append(scores(guessed.bodies, truth))
        if args.estimated and known.bodies is not None:
            table.setdefault(FOUND, []).append(scores(known.bodies, truth))
        for name in args.rows:
            room, begin = guessed if name == "baseline" else known, time.perf_counter()
            config = RefineBodiesConfig(weights=ABLATION[name])
            found = refine_bodies(room, capture, config)
            table.setdefault(name, []).append(scores(found.bodies, truth))
            _say(f"{seed} {_line(name, table[name][-1:])} {time.perf_counter() - begin:6.0f} s")
    _say(
        f"\n{'row':24}{'PJE':>8}{'V2V':>8}{'p.PJE':>8}{'p.V2V':>8}   [mm], {len(args.seeds)} rooms"
    )
    for name, rows in table.items():
        _say(_line(name, rows))


def _line(name: str, rows: Sequence[Sequence[float]]) -> str:
    means = [sum(column) / len(rows) for column in zip(*rows, strict=True)]
    return f"{name:24}" + "".join(f"{value:8.1f}" for value in means)


def _say(text: str) -> None:
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    main()
