"""The paper's tables for a user's own copy of PROX and PiGraphs, beside the published rows."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from mover.core.errors import InputError
from mover.evaluate.evaluation import evaluate_folder
from mover.io.datasets import pigraphs, prox_files
from mover_bench.tables import published

Row = tuple[str, Sequence[float | None]]


@dataclass(frozen=True)
class PaperTable:
    """One table of the paper."""

    title: str
    expected: str
    """On what the paper measures."""
    count: int
    """Recordings of it."""
    columns: tuple[str, ...]
    """Keys of metrics.json."""
    factor: float
    """On the overlaps: the paper prints some in percent."""
    published: tuple[Row, ...]


SCENE = ("iou3d", "p2s", "iou2d", "non_collision", "contact")
CAMERA = ("pitch_error", "roll_error", "mean_tilt",
          "ground_penetration_frequency", "ground_penetration_distance")  # fmt: skip
BODY = ("pje", "v2v", "p_pje", "p_v2v")
MILLIMETRES = 1000.0
NOTHING: tuple[None, ...] = (None,) * 5

TABLES: dict[str, PaperTable] = {
    "prox": PaperTable(
        "PROX qualitative",
        f"{prox_files.VIDEOS} videos of {len(prox_files.SCENES)} scenes, without the two booths",
        prox_files.VIDEOS,
        (*SCENE, *CAMERA),
        1.0,
        (
            ("Total3D", (*published.SCENE["Total3D"], *published.CAMERA["Total3D"])),
            ("HolisticMesh", (*published.SCENE["HolisticMesh"], *NOTHING)),
            ("MOVER", (*published.SCENE["MOVER"], *published.CAMERA["MOVER"])),
        ),
    ),
    "prox-quantitative": PaperTable(
        "PROX quantitative",
        f"{prox_files.SHOTS} frames of one scene; errors of bodies in millimetres",
        1,
        (*SCENE, *BODY),
        1.0,
        (
            ("Total3D", (0.063, 0.409, 0.342, 0.940, 0.436, None, None, None, None)),
            ("HolisticMesh", (0.239, 0.133, 0.533, 0.948, 0.951, 190.78, 192.21, 72.72, 61.01)),
            ("MOVER baseline", (*NOTHING, 219.62, 222.50, 75.92, 68.34)),
            ("MOVER", (0.390, 0.095, 0.862, 0.972, 0.934, 174.37, 178.31, 73.60, 67.89)),
        ),
    ),
    "pigraphs": PaperTable(
        "PiGraphs",
        f"{pigraphs.VIDEOS} videos of {pigraphs.ROOMS} scenes; overlaps in percent",
        pigraphs.VIDEOS,
        ("iou2d", "iou3d"),
        100.0,
        (
            ("Cooperative", (68.6, 21.4)),
            ("Holistic++", (75.1, 24.9)),
            ("HolisticMesh", (75.6, 26.3)),
            ("MOVER", (79.2, 27.8)),
        ),
    ),
}
"""The tables by name."""


def paper_table(name: str, captures: Path, results: Path) -> str:
    """The table of the paper with the user's rows first.

    Every folder of `captures` that has truth/ and a result of the same name in `results` counts
    once. The distance to the surface is measured against what the scan has inside the boxes
    (truth_scan/), everything else against the boxes, as the paper labels them.

    Args:
        name: A key of `TABLES`.
        captures: Folder of captures that `mover import` made.
        results: Folder of results of `mover run` or `mover batch`, by the captures' names.

    Raises:
        ValueError: If there is no such table.
        InputError: If no capture has both a truth and a result, or a file is wrong.
    """
    if name not in TABLES:
        raise ValueError(f"table is {name!r}, choose one of {', '.join(TABLES)}")
    table = TABLES[name]
    names = sorted(p.parent.parent.name for p in captures.glob("*/truth/scene.json"))
    done = [n for n in names if (results / n / "scene.json").is_file() and _belongs(n, name)]
    if not done:
        where = f"{captures}/<name>/truth and {results}/<name>"
        raise InputError(f"{captures}: has no capture with truth and result, expected {where}")
    metrics = [_measured(captures / n, results / n) for n in done]
    rows: list[Row] = [
        (title, [_mean([m[key] for m in metrics], c, table.factor) for c in table.columns])
        for title, key in (("your copy, initial", "initial"), ("your copy, mover", "result"))
    ]
    head = f"{table.title}: the paper has {table.expected}; here {len(done)} of {table.count}"
    lacking = [n for n in names if n not in done and _belongs(n, name)]
    tail = [f"without a result: {', '.join(lacking)}"] if lacking else []
    return "\n".join([head, _laid_out(table, [*rows, *table.published]), *tail])


def _belongs(name: str, table: str) -> bool:
    """Whether a recording is one of those on which the paper measures."""
    scene = name.split("_")[0]
    if table == "prox":
        return scene in prox_files.SCENES
    return (scene == prox_files.QUANTITATIVE) == (table == "prox-quantitative")


def _measured(capture: Path, result: Path) -> Mapping[str, Any]:
    """The metrics of one recording, before and after."""
    surface = None
    if (capture / "truth_scan" / "scene.json").is_file():
        surface = evaluate_folder(result, capture / "truth_scan")
    found = evaluate_folder(result, capture / "truth")
    return {key: _whole(found[key], surface and surface[key]) for key in ("initial", "result")}


def _whole(values: Mapping[str, float], surface: Mapping[str, float] | None) -> dict[str, float]:
    """The metrics with the distance to the scan, the mean tilt, and bodies in millimetres."""
    out = dict(values)
    out.pop("p2s", None)  # of boxes: their walls are no furniture
    if surface is not None and "p2s" in surface:
        out["p2s"] = surface["p2s"]
    if "pitch_error" in out and "roll_error" in out:
        out["mean_tilt"] = (out["pitch_error"] + out["roll_error"]) / 2
    return out | {key: out[key] * MILLIMETRES for key in BODY if key in out}


def _mean(rows: Sequence[Mapping[str, float]], key: str, factor: float) -> float | None:
    """Over those recordings that have the metric."""
    values = [row[key] for row in rows if key in row and math.isfinite(row[key])]
    scale = factor if key.startswith("iou") else 1.0
    return scale * sum(values) / len(values) if values else None


SHORT = {
    "iou3d": "IoU3D", "p2s": "P2S", "iou2d": "IoU2D", "non_collision": "NonCol",
    "contact": "Cont.", "pitch_error": "pitch", "roll_error": "roll", "mean_tilt": "mean",
    "ground_penetration_frequency": "Freq.", "ground_penetration_distance": "Dist.",
    "pje": "PJE", "v2v": "V2V", "p_pje": "p.PJE", "p_v2v": "p.V2V",
}  # fmt: skip


def _laid_out(table: PaperTable, rows: Sequence[Row]) -> str:
    """Rows as plain text."""
    lines = [f"{'':20}" + "".join(f"{SHORT[c]:>9}" for c in table.columns)]
    for title, values in rows:
        cells = "".join(_cell(v) for v in values)
        lines.append(f"{title:20}{cells}")
    return "\n".join(lines)


def _cell(value: float | None) -> str:
    if value is None:
        return f"{'-':>9}"
    return f"{value:9.3f}" if abs(value) < 10 else f"{value:9.1f}"
