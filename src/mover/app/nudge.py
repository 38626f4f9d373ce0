"""Move pieces that would fall to where they stand, as far as their stated uncertainty allows.

A piece that floats comes down to what carries it, one that is stuck goes where it is pushed, one
that stands half beside its support goes on to it: gravity says where. A place counts only if it is
within the range that the result states (scene.json, `uncertainty`), upright, and if the piece and
all that stood before stay there.
"""

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import torch

from mover.app.simulate import (
    SimulatedObject,
    SimulationConfig,
    result_loads,
    settled,
    simulate,
)
from mover.app.sitters import Load
from mover.core.files import replacing
from mover.core.run import Run
from mover.core.types import Scene, SceneObject
from mover.geometry.rotations import wrap
from mover.io.capture.scene_file import read_scene
from mover.io.export.finished import STABLE
from mover.io.export.solids import AXES, floor_height
from mover.io.files.fields import read_json

ROUNDS = 3
LEVEL = math.radians(2)  # [rad], a piece that ends more tilted has toppled on to something
KEYS = ("x", "y", "z", "yaw")
Ranges = dict[str, dict[str, tuple[float, float]]]
"""Lowest and highest place [m] and yaw [rad] of objects by id, where they are stated."""


@dataclass(frozen=True)
class Nudge:
    """What became of a piece that did not stay."""

    id: str
    moved: float
    """How far it was moved, or would have to be [m]."""
    turned: float
    """... and turned about the vertical [rad]."""
    done: bool
    reason: str
    """Why not, or empty."""


def ranges_of(file: Path) -> Ranges:
    """What scene.json states of its objects."""
    return ranges_in({item["id"]: item for item in read_json(file).value["objects"]})


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
) -> tuple[Scene, tuple[SimulatedObject, ...], tuple[Nudge, ...]]:
    """The scene with pieces nudged, how it stands, and what was done to each that did not stay.

    Args:
        scene: A result.
        run: Its folder keeps the convex pieces.
        ranges: What is stated of each place; a piece without stays where it is.
        config: How long gravity acts.
        loads: Who sits where.
    """
    config = config or SimulationConfig()
    rows = simulate(scene, run, config, loads)
    told: dict[str, Nudge] = {}
    for _ in range(ROUNDS):
        loose = [row for row in rows if not row.stays and not row.fixed]
        if not loose:
            break
        tried, asked = _where_it_ends(scene, run, config, ranges, {row.id for row in loose})
        told |= asked
        if tried is scene:
            break
        after = simulate(tried, run, config, loads)
        stay = {row.id for row in after if row.stays}
        if {row.id for row in rows if row.stays} - stay or not stay & {r.id for r in loose}:
            told |= {
                n: replace(a, done=False, reason="others would fall")
                for n, a in asked.items()
                if a.done
            }
            break
        scene, rows = tried, after
    return scene, rows, tuple(told.values())


def _where_it_ends(
    scene: Scene, run: Run, config: SimulationConfig, ranges: Ranges, loose: set[str]
) -> tuple[Scene, dict[str, Nudge]]:
    """The scene with each loose piece where gravity leaves it, if its range holds that place."""
    ends = settled(scene, run, config.seconds)
    floor = torch.tensor([0.0, floor_height(scene), 0.0], dtype=torch.float64)
    pieces, told = list(scene.objects), dict[str, Nudge]()
    for k, piece in enumerate(scene.objects):
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
        why = "it falls over" if tilt > LEVEL else _outside(piece, now, ranges.get(piece.id, {}))
        if not why:
            pieces[k] = now
        moved = float((now.t_world_object - piece.t_world_object).norm())
        turned = float(wrap(now.yaw - piece.yaw).abs())
        told[piece.id] = Nudge(piece.id, moved, turned, not why, why)
    changed = any(a is not b for a, b in zip(pieces, scene.objects, strict=True))
    return (replace(scene, objects=tuple(pieces)) if changed else scene), told


def _outside(
    before: SceneObject, after: SceneObject, ranges: dict[str, tuple[float, float]]
) -> str:
    """Why a place is beyond what is stated of it; empty: it is not."""
    if not ranges:
        return "its uncertainty is not stated"
    away = [*(after.t_world_object - before.t_world_object).tolist()]
    away.append(float(wrap(after.yaw - before.yaw)))
    here = [*before.t_world_object.tolist(), float(before.yaw)]
    for key, step, place in zip(KEYS, away, here, strict=True):
        low, high = ranges.get(key, (place, place))
        if not low - place - 1e-6 <= step <= high - place + 1e-6:
            unit = "rad" if key == "yaw" else "m"
            stated = f"stated are {low - place:+.3f} to {high - place:+.3f}"
            return f"{key} would change by {step:+.3f} {unit}, {stated}"
    return ""


def nudge_folder(out: Path, config: SimulationConfig) -> str:
    """Nudge the pieces of a result and write OUT/stable.json; what was done, in words."""
    file = out / "scene.json"
    scene = read_scene(file)
    loads = result_loads(out, scene)
    steady, rows, nudges = nudged(scene, Run(out), ranges_of(file), config, loads)
    write_nudged(out, steady, nudges)
    loose = [row for row in rows if not row.fixed]
    stay = f"stable: {sum(row.stays for row in loose)} of {len(loose)} stay; {out / STABLE}"
    return "\n".join([*filter(None, [nudge_lines(nudges)]), stay])


def write_nudged(out: Path, scene: Scene, nudges: tuple[Nudge, ...]) -> None:
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
    with replacing(out / STABLE) as part:
        part.write_text(json.dumps(tree, indent=1))


def nudge_lines(nudges: tuple[Nudge, ...]) -> str:
    """A sentence for each piece."""
    lines: list[str] = []
    for nudge in nudges:
        way = f"{1e3 * nudge.moved:.0f} mm, {math.degrees(nudge.turned):.1f} deg"
        lines.append(
            f"{nudge.id}: " + (f"nudged by {way}" if nudge.done else f"left: {nudge.reason}")
        )
    return "\n".join(lines)
