"""How much wrong input costs: one kind of error after the other, in growing sizes."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass

from mover.core.errors import InputError
from mover_bench.studies.compare import Interval, interval, markdown, paired
from mover_bench.studies.finished import Finished, Frame, Source, by_room
from mover_bench.studies.sets import CHANGES, EXACT, Change, changed_set
from mover_bench.studies.study_page import Line, Panel, draw_panels
from mover_bench.studies.study_rows import Ask, Page, Plan
from mover_bench.tables import published

METHODS = {
    "robust": ("scale", *(k for k in CHANGES if k != "scale")),
    "relaxed-scale": ("scale",),
}
"""Kinds of errors that each variant is tried on."""


@dataclass(frozen=True)
class Level:
    """What an error of one size does."""

    level: float
    value: Interval
    cost: Interval
    """Share of IoU3D that is lost against no error of this kind."""


ERRORS: Mapping[str, Collection[str]] = {"sensitivity": CHANGES, "paper": EXACT}
"""The errors of the input that a study tries, by its name."""


def check_errors(study: str, kinds: Sequence[str]) -> None:
    """They must be kinds that are known, and asked of a study that tries them."""
    if kinds and study not in ERRORS:
        raise InputError(f"--errors: the study {study} tries none, expected {' or '.join(ERRORS)}")
    for kind in kinds:
        if kind not in ERRORS[study]:
            raise InputError(f"--errors: {kind!r} is none of {', '.join(ERRORS[study])}")


def plan(ask: Ask) -> Plan:
    """The same rooms with changed noise."""
    jobs = [
        (changed_set(ask.rooms, kind, level), name)
        for name, kinds in METHODS.items()
        for kind in kinds
        if kind in ask.errors
        for level in CHANGES[kind].levels
    ]
    return list(dict.fromkeys(jobs))


def page(ask: Ask, finished: Finished) -> Page:
    """A table and a panel for each kind of error."""
    sections, panels = list[str](), list[Panel]()
    for kind in ask.errors:
        change = CHANGES[kind]
        found = {
            name: levels_of(ask, finished, name, kind)
            for name, kinds in METHODS.items()
            if kind in kinds
        }
        sections.append(_section(kind, change, found))
        panels.append(_panel(change, found))
    return Page((), sections, {"sensitivity": draw_panels(panels)})


def levels_of(ask: Ask, finished: Finished, name: str, kind: str) -> list[Level]:
    """IoU3D under each size of an error, over the rooms that have all sizes."""
    from pandas import DataFrame

    sources = {x: Source(changed_set(ask.rooms, kind, x), (name,)) for x in CHANGES[kind].levels}
    rows = {x: by_room(finished, s, "iou3d", ask.seeds[ask.rooms]) for x, s in sources.items()}
    whole: Frame = DataFrame(rows).dropna().sort_index()
    if not len(whole):
        return []
    first = whole.iloc[:, 0]
    scale = 1 / first.mean() if first.any() else 0.0
    return [
        Level(level, interval(list(v)), paired(list(scale * first), list(scale * v)))
        for level, v in whole.items()
    ]


def _section(kind: str, change: Change, found: dict[str, list[Level]]) -> str:
    head = [f"{change.title} [{change.unit}]"]
    quoted = published.NOISE.get(kind, {})
    for name in found:
        head += [f"{name}: IoU3D ↑", "cost [%] ↓"]
    rows: list[list[str]] = []
    for k, level in enumerate(change.levels):
        row = [f"{change.shown * level:g}"]
        for levels in found.values():
            row += _cells(levels[k]) if levels else ["-", "-"]
        rows.append(row + ([f"{quoted[level]:.3f}" if level in quoted else "-"] if quoted else []))
    head += ["*MOVER* (paper)"] if quoted else []
    rooms = next((levels[0].value.rooms for levels in found.values() if levels), 0)
    return f"## Error in the {change.title}\n\n{markdown(head, rows)}\n\n{rooms} rooms."


def _cells(found: Level) -> list[str]:
    cost = found.cost
    span = f" [{100 * cost.low:.1f}, {100 * cost.high:.1f}]"
    return [f"{found.value.mean:.3f}", f"{100 * cost.mean:.1f}{span}"]


def _panel(change: Change, found: dict[str, list[Level]]) -> Panel:
    lines = [
        Line(
            name,
            tuple((change.shown * x.level, x.value.mean) for x in levels),
            tuple((x.value.low, x.value.high) for x in levels),
        )
        for name, levels in found.items()
    ]
    return Panel(change.title, change.unit, "IoU3D", tuple(lines))
