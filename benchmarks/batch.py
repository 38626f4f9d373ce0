"""What a batch costs beside the captures themselves.

    python benchmarks/batch.py --engines local ray slurm

Each capture is an empty command (Python without its imports, which writes the two files of a
result), so that what is left is the engine: processes, locks, records, the summary. Printed per
engine: seconds of the whole batch, seconds per capture beyond the command itself, and seconds to
find that all is finished when the same batch is started again. Ray's time holds its start; --repeat
tells it apart. `slurm` needs a machine with SLURM's commands.
"""

import argparse
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from mover.app.batch import BatchPlan, captures_in, run_batch
from mover.app.batch.engines import EngineOptions, SlurmOptions

EMPTY = """
import sys
from pathlib import Path
out = Path(sys.argv[2])
(out / "run.json").write_text('{"warnings": [], "stages": []}')
(out / "scene.json").write_text("{}")
"""


def captures(folder: Path, count: int) -> tuple[Path, ...]:
    """Folders that stand for captures."""
    for index in range(count):
        (folder / "captures" / f"{index:04d}").mkdir(parents=True)
    return captures_in(folder / "captures")


def bare(command: tuple[str, ...], folder: Path) -> float:
    """Seconds of the empty command by itself."""
    words = [word.format(capture=folder, out=folder) for word in command]
    begin = time.perf_counter()
    for _ in range(10):
        subprocess.run(words, check=True)
    return (time.perf_counter() - begin) / 10


def measure(engine: str, plan: BatchPlan, workers: int) -> tuple[float, float]:
    """Seconds of a batch, and of the same batch when all is finished."""
    options = EngineOptions(engine, workers, slurm=SlurmOptions(minutes=5))
    begin = time.perf_counter()
    states = {outcome.state for outcome in run_batch(plan, options, quiet=True)}
    middle = time.perf_counter()
    assert states == {"done"}
    run_batch(plan, EngineOptions("local", workers), quiet=True)
    return middle - begin, time.perf_counter() - middle


def main() -> None:
    """Print a line per engine."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--engines", nargs="+", default=["local"])
    parser.add_argument("--captures", type=int, default=40)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--repeat", type=int, default=2)
    args = parser.parse_args()
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        (folder / "empty.py").write_text(EMPTY)
        known = captures(folder, args.captures)
        command = (sys.executable, "-S", "-E", str(folder / "empty.py"), "{capture}", "{out}")
        alone = bare(command, folder)
        print(f"the empty command: {alone:.3f} s", flush=True)
        for engine in args.engines:
            for turn in range(args.repeat):
                plan = BatchPlan(known, folder / f"{engine}_{turn}", command, "settings")
                whole, again = measure(engine, plan, args.workers)
                each = (whole - alone * args.captures / args.workers) / args.captures
                print(f"{engine} {turn}: {whole:.2f} s, {each:.3f} s per capture, "
                      f"again {again:.2f} s", flush=True)  # fmt: skip


if __name__ == "__main__":
    main()
