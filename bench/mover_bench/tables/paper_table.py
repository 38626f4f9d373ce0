"""The paper's tables for a user's own copy of PROX and PiGraphs, beside the published rows.

All rows are made by one command: jobs run beside each other, finished ones are files and are not
done again, and what is finished so far is written as Markdown and CSV at every call.
"""

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from mover.core.errors import InputError
from mover.core.files import replacing
from mover.core.observe import Observer, Step, silent
from mover.core.settings import int_in
from mover.pipeline.presets import PRESETS
from mover_bench.datasets import pigraphs, prox_files
from mover_bench.experiment.job import read_numbers
from mover_bench.experiment.pool import LOG, Pool, last_line, run_each
from mover_bench.experiment.tables import markdown
from mover_bench.tables import published, rows
from mover_bench.tables.rows import TableRow
from mover_bench.tables.table_job import DONE, TableJob, key_of

MILLIMETRES = 1000.0


@dataclass(frozen=True)
class Part:
    """One table of the paper: its columns, our rows and the published ones."""

    title: str
    columns: tuple[str, ...]
    ours: tuple[TableRow, ...]
    quoted: published.Quoted = ()
    note: str = ""


@dataclass(frozen=True)
class PaperTable:
    """The tables of one data set."""

    title: str
    expected: str
    """On what the paper measures."""
    count: int
    """Recordings of it."""
    parts: tuple[Part, ...]
    factor: float = 1.0
    """On the overlaps: the paper prints some in percent."""


SCENE, BODY = published.SCENE_COLUMNS, published.BODY_COLUMNS
CAMERA = ("pitch_error", "roll_error", "mean_tilt",
          "ground_penetration_frequency", "ground_penetration_distance")  # fmt: skip
SCAN = ("scan_non_collision", "scan_contact")
SCAN_NOTE = (
    "Scan: the same people in the scanned room, by PROX's `sdf`: non-collision and contact,"
    " where the user's copy has it. Not in the paper."
)
BOX_NOTE = (
    "IoU2D compares the 3D boxes in the image, as the truth is boxes; P2S is measured from what the"
    " scan has inside them, without the floor."
)
FEET_NOTE = (
    "Foot contacts are estimated from the bodies (the paper: POSA's); more than 1 cm below the"
    " floor counts. Angles in radians."
)


_PROX = {k: v for k, v in published.SCENE.items() if not k.endswith("PiGraphs")}
_TILT = ("pitch_error", "roll_error", "mean_tilt", *published.CAMERA_COLUMNS[3:])
_STILLS = {
    "Total3D": (0.063, 0.409, 0.342, 0.940, 0.436),
    "HolisticMesh": (0.239, 0.133, 0.533, 0.948, 0.951),
    "MOVER": (0.390, 0.095, 0.862, 0.972, 0.934),
}
_PIGRAPHS = {k.partition(",")[0]: v for k, v in published.SCENE.items() if k.endswith("PiGraphs")}
_LENGTH = {k: (v[0],) for k, v in published.LENGTH.items()}
_NOISE = {
    f"{kind} ± {level:g}": (value,)
    for kind, levels in published.NOISE.items()
    for level, value in levels.items()
}

TABLES: dict[str, PaperTable] = {
    "prox": PaperTable(
        "PROX qualitative",
        f"{prox_files.VIDEOS} videos of {len(prox_files.SCENES)} scenes, without the two booths",
        prox_files.VIDEOS,
        (
            Part("Scenes and interaction", SCENE, (*rows.ABLATION, *rows.DETECTED),
                 published.quoted(SCENE, _PROX), BOX_NOTE),
            Part("Camera and ground", CAMERA, (rows.ABLATION[0], rows.ABLATION[-1]),
                 published.quoted(_TILT, published.CAMERA), FEET_NOTE),
            Part("Length of the video", ("iou3d",), (*rows.LONGER, rows.ABLATION[-1]),
                 published.quoted(("iou3d",), _LENGTH)),
            Part("Noise on the initial scene", ("iou3d",), (*rows.DISTURBED, rows.ABLATION[-1]),
                 published.quoted(("iou3d",), _NOISE)),
        ),
    ),
    "prox-quantitative": PaperTable(
        "PROX quantitative",
        f"{prox_files.SHOTS} frames of one scene",
        1,
        (
            Part("Scenes and interaction", SCENE, rows.ABLATION,
                 published.quoted(SCENE, _STILLS), BOX_NOTE),
            Part("People [mm]", (*BODY, *SCAN), rows.PEOPLE,
                 published.quoted(published.BODY_COLUMNS, published.BODIES), SCAN_NOTE),
        ),
    ),
    "pigraphs": PaperTable(
        "PiGraphs",
        f"{pigraphs.VIDEOS} videos of {pigraphs.ROOMS} scenes; overlaps in percent",
        pigraphs.VIDEOS,
        (Part("Scenes", ("iou2d", "iou3d"), (rows.ABLATION[0], rows.ABLATION[1], rows.ABLATION[-1]),
              published.quoted(SCENE, _PIGRAPHS)),),
        100.0,
    ),
}  # fmt: skip
"""The tables by name."""


@dataclass(frozen=True)
class TableArgs:
    """What is made of which folders."""

    name: str
    captures: Path
    """Captures that `mover import` made, with truth/."""
    out: Path
    """Folder of jobs and pages."""
    detected: Path | None = None
    """The same captures with boxes and masks of a detector."""
    preset: str = "robust"
    workers: Annotated[int, int_in(0, 10_000)] = 0
    """0: as many as there are cores."""
    look: bool = False
    """Nothing is run."""
    only: tuple[str, ...] = ()
    """First words of the labels of rows; empty: all."""


def paper_table(args: TableArgs, observe: Observer = silent, pool: Pool = run_each) -> Path:
    """Do all jobs that are not finished, and write OUT/NAME-PRESET.md and .csv.

    Returns:
        The page.

    Raises:
        ValueError: If there is no such table.
        InputError: If no capture has a truth, or the preset is none.
    """
    if args.name not in TABLES:
        raise ValueError(f"table is {args.name!r}, choose one of {', '.join(TABLES)}")
    if args.preset not in PRESETS:
        raise InputError(f"--preset: {args.preset!r} is none of {', '.join(PRESETS)}")
    table = TABLES[args.name]
    jobs = {row: jobs_of(row, args) for part in table.parts for row in asked(part, args)}
    every = list(dict.fromkeys(job for found in jobs.values() for job in found))
    if not every:
        where = f"{args.captures}/<name>/truth/scene.json"
        raise InputError(f"{args.captures}: has no capture of {table.title}, expected {where}")
    waiting = [] if args.look else [job for job in every if not is_finished(job)]
    for job in waiting:  # one without metrics.json has failed, and the page says so
        (job.folder / DONE).unlink(missing_ok=True)
    asked_jobs = [
        ((str(job.capture), str(job.out), job.preset, job.name), job.folder / LOG)
        for job in waiting
    ]
    ended = pool("mover_bench.tables.table_job", asked_jobs, args.workers)
    for done, index in enumerate(ended, len(every) - len(waiting)):
        observe(Step(f"{waiting[index].capture.name}: {waiting[index].name}", done, len(every)))
    return _written(table, jobs, args)


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
    names = [n for n in rows.variants(args.preset) if n == row.job or _is_part(n, row.job)]
    captures = args.detected if row.detected and args.detected is not None else args.captures
    out = args.out / "detected" if row.detected else args.out
    return [
        TableJob(path.parent.parent, out, args.preset, name)
        for path in sorted(captures.glob("*/truth/scene.json"))
        if belongs(path.parent.parent.name, args.name)
        for name in names
    ]


def _is_part(name: str, job: str) -> bool:
    return job.endswith("-") and name.startswith(job)


def belongs(name: str, table: str) -> bool:
    """Whether a recording is one of those on which the paper measures."""
    scene = name.split("_")[0]
    if table == "prox":
        return scene in prox_files.SCENES
    return (scene == prox_files.QUANTITATIVE) == (table == "prox-quantitative")


def is_finished(job: TableJob) -> bool:
    """Whether its results are there, of these inputs and this version."""
    return read_numbers(job.folder / DONE).get("key") == key_of(job)


def _written(
    table: PaperTable, jobs: Mapping[TableRow, Sequence[TableJob]], args: TableArgs
) -> Path:
    """The page and the numbers of what is finished."""
    count = len({job.capture for found in jobs.values() for job in found})
    lines = [f"# {table.title}", f"The paper has {table.expected}; here {count} of {table.count}."]
    numbers: list[dict[str, str]] = []
    for part in table.parts:
        filled = [(row, _values(row, jobs[row], part, table)) for row in asked(part, args)]
        if not filled:
            continue
        lines += [f"## {part.title}", _laid_out(part, filled, table)]
        lines += [part.note] if part.note else []
        notes = [f"- *{row.label}*: {row.protocol}" for row, _ in filled if row.protocol]
        lines += ["\n".join(notes)] if notes else []
        numbers += [_line(part, row, values) for row, values in filled]
    lines += _failures(jobs)
    page = args.out / f"{args.name}-{args.preset}.md"
    with replacing(page) as new:
        new.write_text("\n\n".join(lines) + "\n")
    names = dict.fromkeys(key for line in numbers for key in line)
    with replacing(page.with_suffix(".csv")) as new, new.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(names))
        writer.writeheader()
        writer.writerows(numbers)
    return page


def _values(
    row: TableRow, jobs: Sequence[TableJob], part: Part, table: PaperTable
) -> dict[str, float]:
    """Means over the recordings of what is finished, in the units of the table."""
    found = [read_numbers(job.folder / DONE).get(row.stage, {}) for job in jobs]
    found = [tree for tree in found if tree]
    values: dict[str, float] = {"recordings": len({j.capture for j in jobs if _there(j)})}
    for column in part.columns:
        known = [v for tree in found if math.isfinite(v := _value(tree, column))]
        scale = table.factor if column.startswith("iou") else 1.0
        scale *= MILLIMETRES if column in BODY else 1.0
        if known:
            values[column] = scale * math.fsum(known) / len(known)
    return values


def _there(job: TableJob) -> bool:
    return bool(read_numbers(job.folder / DONE))


def _value(tree: Mapping[str, float], column: str) -> float:
    if column == "mean_tilt" and "pitch_error" in tree:
        return (tree["pitch_error"] + tree["roll_error"]) / 2
    return float(tree.get(column, math.nan))


SHORT = {
    "iou3d": "IoU3D", "p2s": "P2S", "iou2d": "IoU2D", "non_collision": "NonCol",
    "contact": "Cont.", "pitch_error": "pitch", "roll_error": "roll", "mean_tilt": "mean",
    "ground_penetration_frequency": "Freq.", "ground_penetration_distance": "Dist.",
    "scan_non_collision": "scan NonCol", "scan_contact": "scan Cont.",
    "pje": "PJE", "v2v": "V2V", "p_pje": "p.PJE", "p_v2v": "p.V2V",
}  # fmt: skip


def _laid_out(
    part: Part, filled: Sequence[tuple[TableRow, Mapping[str, float]]], table: PaperTable
) -> str:
    """Our rows, then the published ones in italics."""
    head = ["", *(SHORT[c] for c in part.columns), "recordings"]
    lines: list[list[str]] = []
    for row, values in filled:
        cells = [_cell(values.get(c)) for c in part.columns]
        lines.append([row.label, *cells, str(int(values["recordings"]))])
    for label, quoted in part.quoted:
        cells = [_cell(_in_units(quoted.get(c), c, table)) for c in part.columns]
        lines.append([f"*{label}* (paper)", *cells, ""])
    return markdown(head, lines)


def _in_units(value: float | None, column: str, table: PaperTable) -> float | None:
    if value is None:
        return None
    scale = table.factor if column.startswith("iou") else 1.0
    return value * scale * (MILLIMETRES if column in BODY else 1.0)


def _cell(value: float | None) -> str:
    if value is None:
        return "-"
    return f"{value:.3f}" if abs(value) < 10 else f"{value:.1f}"


def _line(part: Part, row: TableRow, values: Mapping[str, float]) -> dict[str, str]:
    cells = {name: f"{value:.6g}" for name, value in values.items()}
    return {"table": part.title, "row": row.label, **cells}


def _failures(jobs: Mapping[TableRow, Sequence[TableJob]]) -> list[str]:
    """What is not there, so that nothing is left out silently."""
    lacking = [j for j in dict.fromkeys(j for f in jobs.values() for j in f) if not _there(j)]
    logs = {job: job.folder / LOG for job in lacking}
    failed = {job: last_line(path) for job, path in logs.items() if path.is_file()}
    lines = [f"**Failed**: {job.capture.name}, {job.name}: {said}" for job, said in failed.items()]
    rest = len(lacking) - len(failed)
    return lines + ([f"**Not run**: {rest} jobs."] if rest else [])
