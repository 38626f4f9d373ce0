"""All tables of the experiments in the documentation, by one command.

    python benchmarks/tables.py --out experiments --write

rebuilds the held-out rooms as each study needs them (finished jobs are kept in `--out`), prints how
long each study took, and with `--write` copies the pages into `docs/tables`. `--look` runs nothing
and writes the studies from what is finished.
"""

import argparse
import shutil
import time
from dataclasses import replace
from pathlib import Path

from calibrate import finished, tables

from mover.app.cli.progress import Bar
from mover.evaluate.calibration import calibration_of
from mover_bench.studies.args import ExperimentArgs, StudyArgs
from mover_bench.studies.run import parse_seeds, run_experiment
from mover_bench.studies.study import run_study

DOCS = Path(__file__).parents[1] / "docs" / "tables"
ROBUST = ("robust",)
STUDIES = (
    StudyArgs("sets", "wrong-shape", "1000-1011", ROBUST),
    StudyArgs("sets", "detected", "1000-1011", ROBUST),
    StudyArgs("sets", "clutter", "1000-1011", ROBUST),
    StudyArgs("ablation", "", "1000-1013"),
    StudyArgs("sets", "rooms", "1000-1029"),
    StudyArgs("camera", "", "1000-1013"),
    StudyArgs("video-length", "", "1000-1001"),
    StudyArgs("interactions", "", "1000-1001"),
    StudyArgs("sensitivity", "", "1000-1003"),
    StudyArgs("sensitivity", "", "1000-1029", errors=("scale",)),
    StudyArgs("bodies", "", "1000-1007"),
    StudyArgs("time", "", "1000-1003", workers=1),
    StudyArgs("sets", "two", "1000-1003", ROBUST),
    StudyArgs("sets", "free", "1000-1003", ROBUST),
)
"""What is shown: studies, sets, and as many held-out rooms as two cores do in some hours."""
PAGES = (
    ExperimentArgs("1000-1029"),
    ExperimentArgs("1000-1029", ROBUST, set="wrong-shape"),
)
"""The same jobs object by object, with the worst as pictures."""
DOUBTS = ExperimentArgs("1000-1029", ROBUST)
"""Rooms on which the stated doubts are tested, with true meshes and with wrong ones."""


def main() -> None:
    """Run the studies one after the other."""
    parser = argparse.ArgumentParser(description="Make the tables of the documentation.")
    parser.add_argument("--out", type=Path, default=Path("experiments"))
    parser.add_argument("--look", action="store_true", help="run nothing")
    parser.add_argument("--keep", action="store_true", help="take what other versions finished")
    parser.add_argument("--write", action="store_true", help="copy them into the docs")
    args = parser.parse_args()
    for study in STUDIES:
        begun = time.monotonic()
        with Bar() as bar:
            run = replace(study, out=args.out, look=args.look, keep=args.keep)
            pages = run_study(run, bar)
        told(pages, begun, args.write)
    if not args.look:
        for asked in PAGES:
            begun = time.monotonic()
            with Bar() as bar:
                page = run_experiment(replace(asked, out=args.out, keep=args.keep), bar)
            told([page], begun, args.write)
        begun = time.monotonic()
        told([doubts(replace(DOUBTS, out=args.out, keep=args.keep))], begun, args.write)


def doubts(asked: ExperimentArgs) -> Path:
    """Write the page that says how true the stated doubts are."""
    groups = finished(parse_seeds(asked.seeds), asked)
    command = f'python benchmarks/calibrate.py --learn "" --check {asked.seeds}'
    about = f"# Stated doubts\n\n    {command}\n\nWidths in metres, radians and shares of a size."
    page = asked.out / "studies" / "doubts" / "summary.md"
    page.parent.mkdir(parents=True, exist_ok=True)
    page.write_text(f"{about}\n\n{tables(groups, [calibration_of('robust')] * len(groups))}\n")
    return page


def told(pages: list[Path], begun: float, write: bool) -> None:
    """Say how long some pages took, and put them where the documentation shows them."""
    for page in pages:
        print(f"{time.monotonic() - begun:6.0f} s  {page}", flush=True)
        if not write:
            continue
        folder = DOCS / page.parent.name
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        for path in page.parent.iterdir():
            if path.is_file() and path.suffix in (".md", ".svg", ".png"):
                shutil.copy(path, folder / path.name)


if __name__ == "__main__":
    main()
