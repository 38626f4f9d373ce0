"""All tables of the experiments in the documentation, by one command.

    python benchmarks/tables.py --out experiments --write

rebuilds the held-out rooms as each study needs them (finished jobs are kept in `--out`), prints how
long each study took, and with `--write` copies the pages into `docs/tables`. `--look` runs nothing
and takes what is finished.
"""

import argparse
import shutil
import time
from dataclasses import replace
from pathlib import Path

from mover.experiments.study import StudyArgs, run_study
from mover.progress import Bar

DOCS = Path(__file__).parents[1] / "docs" / "tables"
ROBUST = ("robust",)
STUDIES = (
    StudyArgs("sets", "wrong-shape", "1000-1011", ROBUST),
    StudyArgs("sets", "detected", "1000-1011", ROBUST),
    StudyArgs("sets", "clutter", "1000-1011", ROBUST),
    StudyArgs("ablation", "", "1000-1011"),
    StudyArgs("sets", "rooms", "1000-1011"),
    StudyArgs("video-length", "", "1000-1001"),
    StudyArgs("interactions", "", "1000-1001"),
    StudyArgs("sensitivity", "", "1000-1003"),
    StudyArgs("camera", "", "1000-1011"),
    StudyArgs("camera", "wrong-shape", "1000-1011"),
    StudyArgs("bodies", "", "1000-1003"),
    StudyArgs("time", "", "1000-1001"),
    StudyArgs("sets", "two", "1000-1005", ROBUST),
    StudyArgs("sets", "free", "1000-1005", ROBUST),
)
"""What is shown: studies, sets and the held-out rooms that fit in an afternoon on two cores."""


def main() -> None:
    """Run the studies one after the other."""
    parser = argparse.ArgumentParser(description="Make the tables of the documentation.")
    parser.add_argument("--out", type=Path, default=Path("experiments"))
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--look", action="store_true", help="run nothing")
    parser.add_argument("--keep", action="store_true", help="take what other versions finished")
    parser.add_argument("--write", action="store_true", help="copy them into the docs")
    args = parser.parse_args()
    for study in STUDIES:
        begun = time.monotonic()
        how = {"out": args.out, "workers": args.workers, "look": args.look, "keep": args.keep}
        with Bar() as bar:
            pages = run_study(replace(study, **how), bar)
        print(f"{time.monotonic() - begun:6.0f} s  {pages[0]}", flush=True)
        if args.write:
            for page in pages:
                copied(page.parent)


def copied(folder: Path) -> None:
    """Put a finished page and its plots where the documentation shows them."""
    (DOCS / folder.name).mkdir(parents=True, exist_ok=True)
    for path in folder.iterdir():
        shutil.copy(path, DOCS / folder.name / path.name)


if __name__ == "__main__":
    main()
