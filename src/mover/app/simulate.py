"""What `mover simulate` does: the scenes of a result under gravity, as settle.json and as text."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from mover.core.run import Run
from mover.evaluate.stability import (
    STAYS,
    SimulatedObject,
    SimulationConfig,
    result_loads,
    simulate,
)
from mover.io.capture.scene_file import read_scene
from mover.io.export.finished import read_finished
from mover.io.export.shell import Wall, guess_walls
from mover.io.files.fields import write_json


def result_walls(out: Path) -> tuple[Wall, ...]:
    """The walls that are guessed of a result."""
    return read_finished(out).shell()


def simulate_folder(
    out: Path,
    truth: Path | None = None,
    config: SimulationConfig | None = None,
    walls: tuple[Wall, ...] | None = None,
) -> dict[str, tuple[SimulatedObject, ...]]:
    """Simulate the initial scene, the result and, where given, the truth; writes `settle.json`.

    Args:
        out: Folder of a result.
        truth: Folder with the true scene.json.
        config: How long.
        walls: Those of the result; the other scenes get a guess of their own. None: no walls.

    Raises:
        InputError: If there is no result, or mujoco is not installed.
    """
    config, run = config or SimulationConfig(), Run(out)
    files = {"initial": out / "initial.json", "result": out / "scene.json"}
    files = {name: file for name, file in files.items() if name == "result" or file.is_file()}
    if truth is not None:
        files["truth"] = truth / "scene.json"
    read = {name: read_scene(file) for name, file in files.items()}
    loads = result_loads(out, read["result"])
    found: dict[str, tuple[SimulatedObject, ...]] = {}
    for name, scene in read.items():
        home = run if name != "truth" else Run(out / "stages" / "truth")
        shell = walls if walls is None or name == "result" else guess_walls(scene, None)
        found[name] = simulate(scene, home, config, loads, shell or ())
    tree: dict[str, Any] = {"format": "mover-settle", "version": 1, "seconds": config.seconds}
    scenes = {
        name: [{**asdict(row), "toppled": row.toppled, "stays": row.stays} for row in rows]
        for name, rows in found.items()
    }
    write_json({**tree, "scenes": scenes}, out / "settle.json")
    return found


# The settle test as text.


HEADS = ("moved", "turned", "stuck", "")
WIDTHS = (9, 9, 8, 11)


def simulation_table(found: Mapping[str, Sequence[SimulatedObject]]) -> str:
    """For each piece, how far it moved, turned and was stuck, in each scene."""
    ids = list(dict.fromkeys(row.id for rows in found.values() for row in rows))
    width = max([len("object"), *map(len, ids)])
    heads = "".join(f"   {name:<{sum(WIDTHS)}}" for name in found)
    lines = [f"{'':<{width}}{heads}", f"{'object':<{width}}{_row(HEADS) * len(found)}"]
    for name in ids:
        cells = [_cell(next((r for r in rows if r.id == name), None)) for rows in found.values()]
        lines.append(f"{name:<{width}}{''.join(cells)}")
    sums = [_summary(name, rows) for name, rows in found.items()]
    return "\n".join(line.rstrip() for line in (*lines, "", *sums))


def _row(words: Sequence[str]) -> str:
    return "   " + "".join(f"{w:<{size}}" for w, size in zip(words, WIDTHS, strict=True))


def _cell(row: SimulatedObject | None) -> str:
    if row is None or row.fixed:
        return _row(("-" if row is None else "held", "", "", ""))
    moved, stuck = f"{1e3 * row.moved:.0f} mm", f"{1e3 * row.stuck:.0f} mm"
    turned = f"{math.degrees(row.turned):.0f} deg"
    word = "stays" if row.stays else "fell over" if row.toppled else "sitter" if _only(row) else ""
    return _row((moved, turned, stuck, word))


def _only(row: SimulatedObject) -> bool:
    """Whether only the weight of who sits on it moves it."""
    return row.moved < STAYS[0] and row.turned < STAYS[1]


def _summary(name: str, rows: Sequence[SimulatedObject]) -> str:
    loose = [row for row in rows if not row.fixed]
    if not loose:
        return f"{name}: nothing that could move"
    far = sorted(row.moved for row in loose)
    over = sum(row.toppled for row in loose)
    middle, most = 1e3 * far[len(far) // 2], 1e3 * far[-1]
    stay, sat = sum(row.stays for row in loose), sum(row.load > 0 for row in loose)
    under = f", {sat} of them under sitters" if sat else ""
    return (
        f"{name}: {stay} of {len(loose)} stay{under} (< 1 cm, < 1 deg), {over} fell over; "
        f"median {middle:.0f} mm, most {most:.0f} mm"
    )
