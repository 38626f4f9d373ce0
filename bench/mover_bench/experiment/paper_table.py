"""The paper's tables for a user's own copy of PROX and PiGraphs, beside the published rows.

All rows are made by one command: jobs run beside each other, those whose stages others share
first; finished ones are files and are not done again, and what is finished so far is written as
Markdown and CSV at every call.
"""

import csv
import math
import statistics
from collections.abc import Mapping, Sequence
from pathlib import Path

from mover.app.batch import last_line, read_tree
from mover.core.errors import InputError
from mover.core.files import replacing
from mover.core.observe import Observer, Step, silent
from mover.energy.config import Adam
from mover.pipeline.presets import PRESETS
from mover_bench.cli import TableArgs
from mover_bench.datasets import prox_files
from mover_bench.experiment.job import Pool, run_each
from mover_bench.experiment.paper_job import (
    BASELINE,
    DONE,
    ERRORS,
    FITS,
    INITIAL,
    PLAIN,
    STD,
    TABLES,
    PaperTable,
    Part,
    TableJob,
    TableRow,
    fits_of,
    key_of,
    variants,
)
from mover_bench.experiment.tables import LOG, markdown

MILLIMETRES = 1000.0
SHORT = {
    "iou3d": "IoU3D", STD: "std", "p2s": "P2S", "iou2d": "IoU2D", "non_collision": "NonCol",
    "contact": "Cont.", "pitch_error": "pitch", "roll_error": "roll", "mean_tilt": "mean",
    "ground_penetration_frequency": "Freq.", "ground_penetration_distance": "Dist.",
    "pje": "PJE", "v2v": "V2V", "p_pje": "p.PJE", "p_v2v": "p.V2V",
}  # fmt: skip
FEW, JOB, STEP = 20.0, 60.0, 0.04
"""[s] of one core: a job without a descent, one but for steps of Adam, and each of these steps."""
Jobs = Mapping[TableRow, Sequence[TableJob]]


def paper_table(args: TableArgs, observe: Observer = silent, pool: Pool = run_each) -> Path:
    """Do all jobs that are not finished; write the page RESULTS/TABLE-PRESET.md and its .csv.

    Raises:
        InputError: If no capture has a truth, or the preset is none.
    """
    table, jobs = TABLES[args.table], all_jobs(args)
    every = _once(jobs)
    waiting = [] if args.look else [job for job in every if not is_finished(job)]
    for job in waiting:  # one without metrics.json has failed, and the page says so
        (job.folder / DONE).unlink(missing_ok=True)
    first = [job for job in waiting if job.name in (PLAIN, BASELINE)]  # others need their stages
    done = len(every) - len(waiting)
    for batch in (first, [job for job in waiting if job not in first]):
        words = [(job.words, job.folder / LOG) for job in batch]
        for index in pool("mover_bench.experiment.paper_job", words, args.workers):
            observe(Step(f"{batch[index].capture.name}: {batch[index].name}", done, len(every)))
            done += 1
    return write_page(table, jobs, args)


def all_jobs(args: TableArgs) -> Jobs:
    """The jobs of each row that is asked for.

    Raises:
        InputError: If no capture has a truth, or the preset is none.
    """
    if args.preset not in PRESETS:
        raise InputError(f"--preset: {args.preset!r} is none of {', '.join(PRESETS)}")
    table = TABLES[args.table]
    jobs = {row: jobs_of(row, args) for part in table.parts for row in asked(part, args)}
    if not any(jobs.values()):
        where = f"{args.captures}/<name>/truth/scene.json"
        raise InputError(f"{args.captures}: has no capture of {table.title}, expected {where}")
    return {row: found for row, found in jobs.items() if found or not row.job.startswith(FITS)}


def _once(jobs: Jobs) -> list[TableJob]:
    return list(dict.fromkeys(job for found in jobs.values() for job in found))


def planned(args: TableArgs) -> str:
    """How many jobs there are, and about how long they take: as those that have ended, if any."""
    every = _once(all_jobs(args))
    waiting = [job for job in every if not is_finished(job)]
    known = [read_tree(job.folder / DONE).get("seconds") for job in every if job not in waiting]
    times = [seconds for seconds in known if seconds is not None and seconds > FEW]
    usual = statistics.mean(times) if times else None
    hours = sum(_seconds(job, usual) for job in waiting) / 3600
    basis = f"as the {len(times)} that have ended" if times else "as on an eight-object room"
    return (
        f"{len(every)} jobs of {len({job.capture for job in every})} captures, {len(waiting)} to"
        f" do: about {hours:.1f} h of one core ({basis}); a GPU shortens Adam's steps alone"
    )


def _seconds(job: TableJob, usual: float | None) -> float:
    """About how long a job takes on one core."""
    if job.name == INITIAL or job.name.startswith(FITS):
        return FEW
    if usual is not None:
        return usual
    config = job.variant.config
    methods = (config.layout.method, config.place.method)
    return JOB + STEP * sum(m.steps for m in methods if isinstance(m, Adam))


def asked(part: Part, args: TableArgs) -> list[TableRow]:
    """Our rows of a table that are made."""
    return [
        row
        for row in part.ours
        if (args.detected is not None or not row.detected)
        and (not args.only or row.label.startswith(args.only))
    ]


def jobs_of(row: TableRow, args: TableArgs) -> list[TableJob]:
    """The jobs of a row, over all captures that belong to the table."""
    several = row.job.endswith("-")
    names = [
        n for n in variants(args.preset) if n == row.job or (several and n.startswith(row.job))
    ]
    captures = args.detected if row.detected and args.detected is not None else args.captures
    out = args.results / "detected" if row.detected else args.results
    vposer = "" if args.vposer is None else str(args.vposer)
    found = [
        TableJob(path.parent.parent, out, args.preset, name, args.steps, args.device, vposer)
        for path in sorted(captures.glob("*/truth/scene.json"))
        if belongs(path.parent.parent.name, args.table)
        for name in names
    ]
    return [job for job in found if not job.name.startswith(FITS) or fits_of(job).is_file()]


def belongs(name: str, table: str) -> bool:
    """Whether a recording is one of those on which the paper measures."""
    scene = name.split("_")[0]
    if table == "prox":
        return scene in prox_files.SCENES
    return (scene == prox_files.QUANTITATIVE) == (table == "prox-quantitative")


def is_finished(job: TableJob) -> bool:
    """Whether its results are there, of these inputs and this version."""
    return read_tree(job.folder / DONE).get("key") == key_of(job)


def write_page(table: PaperTable, jobs: Jobs, args: TableArgs) -> Path:
    """The page and the numbers of what is finished."""
    captures = {job.capture for found in jobs.values() for job in found}
    pictures = sum(1 for home in captures for _ in home.glob("frames/*"))
    have = f"here {len(captures)} of {table.count} captures, with {pictures} pictures"
    lines = [f"# {table.title}", f"The paper has {table.expected}; {have}."]
    lines += [f"At most {args.steps} steps of each descent."] if args.steps else []
    numbers: list[dict[str, str]] = []
    for part in table.parts:
        rows = [row for row in asked(part, args) if row in jobs]
        filled = [(row, _values(row, jobs[row], part, table)) for row in rows]
        if not filled:
            continue
        lines += [f"## {part.title}", _laid_out(part, filled, table)]
        lines += [part.note] if part.note else []
        notes = [f"- *{row.label}*: {row.protocol}" for row, _ in filled if row.protocol]
        lines += ["\n".join(notes)] if notes else []
        for row, values in filled:
            cells = {name: f"{value:.6g}" for name, value in values.items()}
            numbers.append({"table": part.title, "row": row.label, **cells})
    lines += _failures(jobs)
    page = args.results / f"{args.table}-{args.preset}.md"
    with replacing(page) as new:
        new.write_text("\n\n".join(lines) + "\n")
    names = dict.fromkeys(key for line in numbers for key in line)
    with replacing(page.with_suffix(".csv")) as new, new.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(names))
        writer.writeheader()
        writer.writerows(numbers)
    return page


def _scale(column: str, table: PaperTable) -> float:
    """From our units to those of the table."""
    return table.factor if column.startswith("iou") else MILLIMETRES if column in ERRORS else 1.0


def _values(
    row: TableRow, jobs: Sequence[TableJob], part: Part, table: PaperTable
) -> dict[str, float]:
    """Means over the recordings of what is finished, in the units of the table."""
    trees = {job: read_tree(job.folder / DONE) for job in jobs}
    found = [tree[row.stage] for tree in trees.values() if tree.get(row.stage)]
    for tree in found:
        if "pitch_error" in tree:
            tree.setdefault("mean_tilt", (tree["pitch_error"] + tree["roll_error"]) / 2)
    values: dict[str, float] = {"recordings": len({j.capture for j, tree in trees.items() if tree})}
    full = {job: tree for job, tree in trees.items() if "full" in tree}
    spreads = [
        statistics.stdev(known)
        for home in dict.fromkeys(job.capture for job in jobs)
        if len(known := [t["full"]["iou3d"] for j, t in full.items() if j.capture == home]) > 1
    ]
    if STD in part.columns and spreads:
        values[STD] = _scale(STD, table) * statistics.mean(spreads)
    for column in part.columns:
        known = [v for tree in found if math.isfinite(v := float(tree.get(column, math.nan)))]
        if known:
            values[column] = _scale(column, table) * math.fsum(known) / len(known)
    return values


def _laid_out(
    part: Part, filled: Sequence[tuple[TableRow, Mapping[str, float]]], table: PaperTable
) -> str:
    """Our rows, then the published ones in italics."""

    def cell(value: float | None) -> str:
        return "-" if value is None else f"{value:.{3 if abs(value) < 10 else 1}f}"

    lines = [
        [row.label, *(cell(values.get(c)) for c in part.columns), str(int(values["recordings"]))]
        for row, values in filled
    ]
    for label, printed in part.quoted.items():
        known = zip(part.columns, printed, strict=True)
        cells = [cell(None if v is None else v * _scale(c, table)) for c, v in known]
        lines.append([f"*{label}* (paper)", *cells, ""])
    return markdown(["", *(SHORT[c] for c in part.columns), "recordings"], lines)


def _failures(jobs: Jobs) -> list[str]:
    """What is not there, so that nothing is left out silently."""
    lacking = [job for job in _once(jobs) if not read_tree(job.folder / DONE)]
    failed = [job for job in lacking if (job.folder / LOG).is_file()]
    lines = [
        f"**Failed**: {job.capture.name}, {job.name}: {last_line(job.folder / LOG)}"
        for job in failed
    ]
    rest = len(lacking) - len(failed)
    return lines + ([f"**Not run**: {rest} jobs."] if rest else [])
