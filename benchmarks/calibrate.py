"""Are stated doubts true? Learns their factors on some known rooms, and tests them on others.

    python benchmarks/calibrate.py --learn 100-111 --check 112-117 --out calibration --write

rebuilds the rooms (finished ones are kept in `--out`), prints how many true values the 90 % ranges
hold, how wide they are and whether their widths rank with the errors, and with `--write` replaces
`src/mover/assets/calibration.json`. Rooms 0-9 and from 1000 on are for results and never used.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from scipy.stats import spearmanr
from torch import Tensor

from mover import records
from mover.calibration import KIND_OF, Calibration, calibration_of, learn_factor, learn_share
from mover.experiments.run import parse_seeds
from mover.explanation import LEVEL, explain, held, offs, ways_of, width
from mover.explanation_records import Explanation, Facts
from mover.explanation_words import NORMAL
from mover.geometry.boxes import box_of
from mover.geometry.rotations import wrap
from mover.pipeline import PRESETS, Run, reconstruct
from mover.records import record
from mover.rooms import NoiseConfig, add_noise, make_room
from mover.stages.starts import MOVED, TURNED
from mover.types import Piece, Scene

ASSET = Path(__file__).parents[1] / "src" / "mover" / "assets" / "calibration.json"
USED = ("distance", "sideways", "yaw", "size")  # kinds that the table tells


@record
class Judged:
    """What was stated of the objects of a room, and what is true."""

    facts: tuple[Facts, ...]
    truth: Float[Tensor, "objects 7"]


def judged(facts: tuple[Facts, ...], result: Scene, truth: Scene) -> Judged:
    """The true unknowns beside the stated ones: each scene in its own upright world."""
    true = {piece.id: piece for piece in truth.pieces}
    rows = [_row(f, p, true[p.id]) for f, p in zip(facts, result.pieces, strict=True)]
    return Judged(facts, torch.stack(rows))


def _row(facts: Facts, ours: Piece, true: Piece) -> Float[Tensor, "7"]:
    a, b = box_of(ours), box_of(true)
    base = b.center.double()
    base[1] -= b.size[1].double() / 2
    yaw = facts.place[3] + wrap(b.yaw - a.yaw).double()
    size = facts.place[4:] + (b.size / a.size).log().double()
    return torch.cat([base, yaw[None], size])


def rebuild(seed: int, preset: str, folder: Path) -> None:
    """Rebuild one room and keep what was stated and what is true."""
    torch.set_num_threads(1)
    known = make_room(seed)
    capture = add_noise(known, NoiseConfig(), seed)
    with tempfile.TemporaryDirectory() as work:
        room = reconstruct(capture, PRESETS[preset], Run(Path(work)))
    facts = tuple(e.facts for e in room.explanations)
    records.save(judged(facts, room.scene, known.truth), folder / f"{preset}_{seed}")


def learn(rooms: list[Judged]) -> Calibration:
    """Alternatives and camera first, then one factor for each other kind of unknown."""
    pairs = [(f, t) for room in rooms for f, t in zip(room.facts, room.truth, strict=True)]
    share = learn_share([([a.rise for a in f.alternatives], _nearest(f, t)) for f, t in pairs])
    plain = explain([f for f, _ in pairs], Calibration(share=share))
    told = list(zip(plain, (t for _, t in pairs), strict=True))
    factors = {"height": learn_factor(_needed(told, "height", 0.0), LEVEL)}
    for kind in USED:
        factors[kind] = learn_factor(_needed(told, kind, factors["height"]), LEVEL)
    return Calibration(factors, share, True)


def _needed(
    told: list[tuple[Explanation, Float[Tensor, "7"]]], kind: str, camera: float
) -> list[float]:
    """For each error the least factor with which its range holds it; `camera` is settled."""
    needed: list[float] = []
    for e, truth in told:
        for way in ways_of(e.facts.place)[[k == kind for k in KIND_OF]]:
            own, tilt = (float(way @ c @ way) for c in (e.facts.covariance, e.facts.tilt))
            if kind == "height":
                own, tilt = own + tilt, 0.0
            if own > 0:
                off = min(offs(e, way, truth)) / NORMAL
                needed.append((max(0.0, off**2 - camera**2 * tilt) / own) ** 0.5)
    return needed


def _nearest(facts: Facts, truth: Float[Tensor, "7"]) -> int:
    """Which of the result (0) and its alternatives is nearest to the truth."""
    rows = torch.stack([facts.place, *(a.place for a in facts.alternatives)]) - truth
    away = rows[:, [0, 2]].norm(dim=-1) / MOVED
    return int((away.square() + (wrap(rows[:, 3]) / TURNED).square()).argmin())


def table(rooms: list[Judged], calibration: Calibration) -> str:
    """Coverage, width and rank, by kind of unknown."""
    facts = [f for room in rooms for f in room.facts]
    truth = torch.cat([room.truth for room in rooms])
    told = explain(facts, calibration)
    head = f"{'':8} {'values':>7} {'held':>7} {'width':>8} {'best constant':>14} {'Spearman':>9}"
    return "\n".join([head, *(_line(kind, told, truth) for kind in USED)])


def _line(kind: str, told: tuple[Explanation, ...], truth: Float[Tensor, "objects 7"]) -> str:
    rows = [
        (e, way, t)
        for e, t in zip(told, truth, strict=True)
        for way in ways_of(e.facts.place)[[k == kind for k in KIND_OF]]
    ]
    hold = float(np.mean([held(*row) for row in rows]))
    widths = np.array([width(e, way) for e, way, _ in rows])
    errors = np.array([offs(*row)[0] for row in rows])
    constant = 2 * learn_factor(errors.tolist(), LEVEL)
    rank = float(spearmanr(widths, errors)[0])
    return (
        f"{kind:8} {len(rows):7} {hold:7.1%} {np.median(widths):8.3f} {constant:14.3f} {rank:9.2f}"
    )


def finished(seeds: tuple[int, ...], args: argparse.Namespace) -> list[Judged]:
    """The judged rooms; those that are not in the folder are made, each by a process of its own."""
    missing = [s for s in seeds if not (args.out / f"{args.preset}_{s}.json").exists()]
    single = {**os.environ, "OMP_NUM_THREADS": "1"}

    def make(seed: int) -> None:
        command = [sys.executable, __file__, "--one", str(seed), "--preset", args.preset]
        subprocess.run([*command, "--out", str(args.out)], env=single, check=True)

    with ThreadPoolExecutor(args.workers) as pool:
        list(pool.map(make, missing))
    return [records.load(Judged, args.out / f"{args.preset}_{s}") for s in seeds]


def allowed(text: str) -> tuple[int, ...]:
    """Seeds, without those that results are reported on."""
    seeds = parse_seeds(text)
    if any(not 100 <= s < 1000 for s in seeds):
        raise SystemExit(f"seeds {text}: those below 100 and from 1000 on are for results")
    return seeds


def main() -> None:
    """Learn on some rooms and test on others."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--learn", default="100-111", help="rooms to learn on; '' takes the asset")
    parser.add_argument("--check", default="", help="rooms to test on")
    parser.add_argument("--preset", default="robust")
    parser.add_argument("--out", type=Path, default=Path("calibration"))
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--write", action="store_true", help="replace the package's factors")
    parser.add_argument("--one", type=int, help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.one is not None:
        rebuild(args.one, args.preset, args.out)
        return
    form = PRESETS[args.preset].place.form
    calibration = calibration_of(form)
    if args.learn:
        rooms = finished(allowed(args.learn), args)
        calibration = learn(rooms)
        print(f"learnt on {args.learn}: {dict(calibration.factors)}, share {calibration.share:.3f}")
        print(table(rooms, calibration))
    if args.check:
        print(f"\ntested on {args.check}")
        print(table(finished(allowed(args.check), args), calibration))
    if args.write:
        write(form, calibration, args.learn)


def write(form: str, calibration: Calibration, seeds: str) -> None:
    """Put the factors of one form of the prices into the package."""
    tree = json.loads(ASSET.read_text())
    tree["forms"][form] = {
        "factors": {kind: round(f, 4) for kind, f in calibration.factors.items()},
        "share": round(calibration.share, 4),
        "command": f"python benchmarks/calibrate.py --learn {seeds} --write",
    }
    with records.replacing(ASSET) as part:
        part.write_text(json.dumps(tree, indent=1) + "\n")


if __name__ == "__main__":
    main()
