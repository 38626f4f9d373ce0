"""What `mover simulate` does: a result under gravity, as settle.json and as text, and `--nudge`.

A piece that floats comes down to what carries it, one that is stuck goes where it is pushed:
gravity says where. Pieces that stand in each other come apart; what still falls is brought to its
floor, over its support or to a wall behind it (free_places.py). A place counts only if it is within
the range that the result states (scene.json, `uncertainty`), upright, and if all that stood before
still stay.
"""

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import torch

from mover.app.free_places import KEYS, Ranges, apart, held_places, outside
from mover.core.files import replacing
from mover.core.run import Run
from mover.core.types import Scene
from mover.evaluate.stability import (
    STAYS,
    Load,
    SimulatedObject,
    SimulationConfig,
    result_loads,
    settled,
    simulate,
)
from mover.geometry.rotations import wrap
from mover.io.capture.scene_file import read_scene
from mover.io.export.finished import STABLE, read_finished
from mover.io.export.shell import WALLS, Wall, guess_walls, wall_rows
from mover.io.export.solids import AXES, floor_height
from mover.io.files.fields import read_json, write_json


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


# Move pieces that would fall to where they stand, as far as their stated uncertainty allows.


ROUNDS = 3
LEVEL = math.radians(2)  # [rad], a piece that ends more tilted has toppled on to something


@dataclass(frozen=True)
class Nudge:
    """What became of a piece that did not stay, or that made room for one."""

    id: str
    moved: float
    """How far it was moved [m]."""
    turned: float
    """... and turned about the vertical [rad]."""
    done: bool
    reason: str
    """Why not, or empty."""
    to: str = ""
    """What it was brought to: the floor, the id of its support, a wall; empty: where gravity or
    the way out of others took it."""


def ranges_in(fields: Mapping[str, Mapping[str, Any]]) -> Ranges:
    """What is stated of objects: their fields of scene.json by id."""
    found: Ranges = {}
    for name, item in fields.items():
        stated = item.get("uncertainty") or {}
        rows = stated.get("ranges") or {}
        found[name] = {k: (float(rows[k][0]), float(rows[k][1])) for k in KEYS if k in rows}
    return found


def nudged(
    scene: Scene,
    run: Run,
    ranges: Ranges,
    config: SimulationConfig | None = None,
    loads: tuple[Load, ...] = (),
    walls: tuple[Wall, ...] = (),
) -> tuple[Scene, tuple[SimulatedObject, ...], tuple[Nudge, ...]]:
    """The scene with pieces nudged, how it stands, and what was done to each that did not stay.

    Args:
        scene: A result.
        run: Its folder keeps the convex pieces.
        ranges: What is stated of each place; a piece without stays where it is.
        config: How long gravity acts.
        loads: Who sits where.
        walls: Still walls.
    """
    trial = _Trial(scene, run, ranges, config or SimulationConfig(), loads, walls)
    rows = trial.simulated(scene)
    if not _loose(rows):
        return scene, rows, ()
    best = _fallen(trial, scene, rows)
    if _loose(best.rows):
        clear = apart(scene, run, ranges, _loose(rows), walls)
        if clear is not scene:
            freed = _fallen(trial, clear, trial.simulated(clear))
            if _stay(rows) <= _stay(freed.rows) and len(_stay(freed.rows)) > len(_stay(best.rows)):
                best = freed
    for name in sorted(_loose(best.rows)):
        best = _held(trial, best, name)
    made_room = dict.fromkeys(_loose(rows) & _stay(best.rows), "it stays since others made room")
    best = replace(best, refused=best.refused | made_room)
    return best.scene, best.rows, _nudges(scene, best, rows)


@dataclass(frozen=True)
class _Trial:
    """What is tried on a scene as it was given."""

    given: Scene
    run: Run
    ranges: Ranges
    config: SimulationConfig
    loads: tuple[Load, ...]
    walls: tuple[Wall, ...]

    def simulated(self, scene: Scene) -> tuple[SimulatedObject, ...]:
        """How a scene stands."""
        return simulate(scene, self.run, self.config, self.loads, self.walls)


@dataclass(frozen=True)
class _Fallen:
    """A scene and how it stands."""

    scene: Scene
    rows: tuple[SimulatedObject, ...]
    refused: dict[str, str]
    """Why pieces were not moved, by id."""
    to: dict[str, str] = field(default_factory=lambda: {})
    """What pieces were brought to, by id."""


def _stay(rows: Sequence[SimulatedObject]) -> set[str]:
    return {row.id for row in rows if row.stays}


def _loose(rows: Sequence[SimulatedObject]) -> set[str]:
    return {row.id for row in rows if not row.stays and not row.fixed}


def _fallen(trial: _Trial, scene: Scene, rows: tuple[SimulatedObject, ...]) -> _Fallen:
    """The scene with loose pieces where gravity leaves them, as long as more stay for it."""
    refused: dict[str, str] = {}
    for _ in range(ROUNDS):
        loose = _loose(rows)
        if not loose:
            break
        tried, why = _where_it_ends(trial, scene, loose)
        refused |= why
        if tried is scene:
            break
        after = trial.simulated(tried)
        if _stay(rows) - _stay(after) or not _stay(after) & loose:
            refused |= dict.fromkeys(loose - set(why), "others would fall")
            break
        scene, rows = tried, after
    return _Fallen(scene, rows, refused)


def _held(trial: _Trial, best: _Fallen, name: str) -> _Fallen:
    """The scene with a piece where something holds it, if it stays there and nothing falls."""
    k = next(k for k, piece in enumerate(best.scene.objects) if piece.id == name)
    pieces, refused = best.scene.objects, dict[str, str]()
    if name not in _loose(best.rows):
        return best
    for to, place in held_places(best.scene, trial.run, trial.walls, pieces[k]):
        why = outside(trial.given.objects[k], place, trial.ranges.get(name, {}))
        if why:
            refused.setdefault(name, why)
            continue
        there = replace(best.scene, objects=(*pieces[:k], place, *pieces[k + 1 :]))
        tried = _fallen(trial, there, trial.simulated(there))
        if _stay(best.rows) | {name} <= _stay(tried.rows):
            return replace(tried, refused=best.refused | tried.refused, to={**best.to, name: to})
    return replace(best, refused=refused | best.refused)


def _where_it_ends(trial: _Trial, scene: Scene, loose: set[str]) -> tuple[Scene, dict[str, str]]:
    """The scene with each loose piece where gravity leaves it, if its range holds that place."""
    ends = settled(scene, trial.run, trial.config.seconds, trial.walls)
    floor = torch.tensor([0.0, floor_height(scene), 0.0], dtype=torch.float64)
    pieces, refused = list(scene.objects), dict[str, str]()
    for k, (piece, given) in enumerate(zip(scene.objects, trial.given.objects, strict=True)):
        if piece.id not in loose:
            continue
        place, turn = ends[k]
        there = AXES.mT @ torch.from_numpy(place) + floor
        yaw = math.atan2(turn[1, 0] - turn[0, 1], turn[0, 0] + turn[1, 1])
        tilt = math.acos(min(1.0, max(-1.0, float(turn[2, 2]))))
        now = replace(
            piece, t_world_object=there.to(piece.t_world_object),
            yaw=torch.tensor(yaw).to(piece.yaw),
        )  # fmt: skip
        stated = trial.ranges.get(piece.id, {})
        why = "it falls over" if tilt > LEVEL else outside(given, now, stated)
        if why:
            refused[piece.id] = why
        else:
            pieces[k] = now
    changed = any(a is not b for a, b in zip(pieces, scene.objects, strict=True))
    return (replace(scene, objects=tuple(pieces)) if changed else scene), refused


def _nudges(given: Scene, best: _Fallen, rows: Sequence[SimulatedObject]) -> tuple[Nudge, ...]:
    """What was done to each piece that did not stay, or that made room."""
    found: list[Nudge] = []
    for before, after in zip(given.objects, best.scene.objects, strict=True):
        moved = float((after.t_world_object - before.t_world_object).norm())
        turned = float(wrap(after.yaw - before.yaw).abs())
        done = moved > 0 or turned > 0
        if done or before.id in _loose(rows):
            why = "" if done else best.refused.get(before.id, "nothing better was found")
            to = best.to.get(before.id, "")
            found.append(Nudge(before.id, moved, turned, done, why, to))
    return tuple(found)


def nudge_folder(out: Path, config: SimulationConfig, walls: tuple[Wall, ...] = ()) -> str:
    """Nudge the pieces of a result and write OUT/stable.json; what was done, in words."""
    file = out / "scene.json"
    scene, rows = read_scene(file), read_json(file).value["objects"]
    stated = {item["id"]: item for item in rows}
    loads = result_loads(out, scene)
    steady, rows, nudges = nudged(scene, Run(out), ranges_in(stated), config, loads, walls)
    write_nudged(out, steady, nudges, walls)
    loose = [row for row in rows if not row.fixed]
    stay = f"stable: {sum(row.stays for row in loose)} of {len(loose)} stay; {out / STABLE}"
    return "\n".join([*filter(None, [nudge_lines(nudges)]), stay])


def write_nudged(
    out: Path, scene: Scene, nudges: tuple[Nudge, ...], walls: tuple[Wall, ...] = ()
) -> None:
    """Write OUT/stable.json: scene.json with the pieces that were nudged where they stand now."""
    tree: dict[str, Any] = json.loads((out / "scene.json").read_text())
    places = {piece.id: piece for piece in scene.objects}
    said = {nudge.id: nudge for nudge in nudges}
    for item in tree["objects"]:
        nudge = said.get(item["id"])
        if nudge is None:
            continue
        item["nudge"] = asdict(nudge)
        if nudge.done:
            piece = places[item["id"]]
            item["translation"] = [round(v, 7) for v in piece.t_world_object.tolist()]
            item["yaw"] = round(float(piece.yaw), 7)
    if walls:
        tree[WALLS] = wall_rows(walls)
    with replacing(out / STABLE) as part:
        part.write_text(json.dumps(tree, indent=1))


def nudge_lines(nudges: tuple[Nudge, ...]) -> str:
    """A sentence for each piece."""
    lines: list[str] = []
    for nudge in nudges:
        way = f"{1e3 * nudge.moved:.0f} mm, {math.degrees(nudge.turned):.1f} deg"
        way += f" to {nudge.to}" if nudge.to else ""
        lines.append(
            f"{nudge.id}: " + (f"nudged by {way}" if nudge.done else f"left: {nudge.reason}")
        )
    return "\n".join(lines)
