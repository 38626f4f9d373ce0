"""Why people help or harm under `paper` and `release`: true inputs, and terms one by one.

The rooms of a set are given with all errors, with one of camera, bodies, contacts and masks as it
truly is, with camera and bodies true, and with all four. Under each, every term of the people is
tried alone beside the whole of Eq. 1, and objects that people touch are told from the others.
"""

from collections.abc import Mapping, Sequence

from mover_bench.studies.compare import (
    Row,
    Table,
    fill_tables,
    markdown,
    paired_rooms,
    shown,
)
from mover_bench.studies.finished import Finished, Source, by_room
from mover_bench.studies.sets import EXACT
from mover_bench.studies.study_page import difference_text
from mover_bench.studies.study_rows import Ask, Page, Plan, quoted_rows
from mover_bench.studies.variants import HUMAN
from mover_bench.tables import published

PRESETS = ("paper", "release")
COLUMNS = ("iou3d", "p2s", "iou2d", "non_collision", "contact", "iou3d_touched", "iou3d_untouched")
TRUE: Mapping[str, tuple[str, ...]] = {
    "all errors": (),
    **{f"true {word}": (word,) for word in EXACT},
    "true camera, bodies": ("camera", "bodies"),
    "true camera, bodies, contacts, masks": tuple(EXACT),
}
"""What is true in each part of the study, of `EXACT`."""
QUOTED = {
    name: values
    for name, values in published.SCENE.items()
    if name.partition(",")[0] in ("Total3D", "MOVER") and "P" not in name.partition(",")[2]
}
"""The paper's rows with annotated boxes and masks on PROX."""
NOTE = (
    "*Stage 1*: the image alone under the camera of this row's people. Rows are compared with it:"
    " ▲ says that people help, ▼ that they harm."
)


def set_of(rooms: str, exact: Sequence[str]) -> str:
    """Name of a set in which some things are true."""
    return f"{rooms}+exact={','.join(exact)}" if exact else rooms


def plan(ask: Ask) -> Plan:
    """Each preset, and each of its terms alone, under each choice of what is true."""
    names = [n for p in _presets(ask) for n in (p, *(f"{p}-{term}" for term in HUMAN))]
    return [(set_of(ask.rooms, exact), name) for exact in TRUE.values() for name in names]


def page(ask: Ask, finished: Finished) -> Page:
    """A table for each choice of what is true, and what people add under each."""
    asks = {set_of(ask.rooms, exact): ask.seeds[ask.rooms] for exact in TRUE.values()}
    tables = [
        _table(preset, label, set_of(ask.rooms, exact))
        for preset in _presets(ask)
        for label, exact in TRUE.items()
    ]
    filled = fill_tables(tables, finished, asks)
    return Page(filled, [_gains(ask, finished), _pieces(ask, finished)])


def _presets(ask: Ask) -> list[str]:
    return [name for name in PRESETS if name in ask.presets]


def _table(preset: str, label: str, rooms: str) -> Table:
    image = Source(rooms, (preset,), "image")
    quoted = [] if "+" in rooms else quoted_rows(published.SCENE_COLUMNS, QUOTED)
    rows = (
        Row("initial scene", Source(rooms, (preset,), "initial"), tested=False),
        Row("Stage 1", image),
        *(Row(f"+ {term}", Source(rooms, (f"{preset}-{term}",))) for term in HUMAN),
        Row("full", Source(rooms, (preset,))),
        *quoted,
    )
    return Table(f"{preset}, {label}", COLUMNS, rows, image, note=NOTE)


def _gains(ask: Ask, finished: Finished) -> str:
    """What each term adds to Stage 1, one line for each choice of what is true."""
    rows: list[list[str]] = []
    seeds = ask.seeds[ask.rooms]
    for preset in _presets(ask):
        for label, exact in TRUE.items():
            rooms = set_of(ask.rooms, exact)
            image = by_room(finished, Source(rooms, (preset,), "image"), "iou3d", seeds)
            cells: list[str] = []
            for name in (*(f"{preset}-{term}" for term in HUMAN), preset):
                values = by_room(finished, Source(rooms, (name,)), "iou3d", seeds)
                gain = paired_rooms(values, image)
                told = gain and difference_text("iou3d", gain.mean, gain.low, gain.high)
                cells.append(told or "-")
            rows.append([f"{preset}, {label}", *cells])
    head = ["", *(f"+ {term}" for term in HUMAN), "full"]
    return f"## What people add to IoU3D\n\nDifference from Stage 1.\n\n{markdown(head, rows)}"


def _pieces(ask: Ask, finished: Finished) -> str:
    """Each object of each room: the way of its overlap."""
    tables: list[str] = []
    for preset in _presets(ask):
        names = [f"{preset}-{term}" for term in HUMAN]
        head = ["", "touched", "initial", "Stage 1", *(f"+ {t}" for t in HUMAN), "full"]
        for label, exact in TRUE.items():
            rooms = set_of(ask.rooms, exact)
            rows = [
                row
                for seed in ask.seeds[ask.rooms]
                for row in _rows_of(finished, rooms, seed, (preset, *names))
            ]
            if rows:
                tables.append(f"### {preset}, {label}\n\n{markdown(head, rows)}")
    return "## Object by object\n\nIoU3D.\n\n" + "\n\n".join(tables)


def _rows_of(finished: Finished, rooms: str, seed: int, names: Sequence[str]) -> list[list[str]]:
    """A line for each object of a room; the first of the names is the whole preset."""
    every = finished.objects
    here = every[(every["set"] == rooms) & (every["seed"] == seed)]
    overlap = {
        (str(row["name"]), str(row["stage"]), str(row["object"])): float(row["iou3d"])
        for _, row in here.iterrows()
    }
    whole = here[(here["name"] == names[0]) & (here["stage"] == "full")]
    columns = [(names[0], "initial"), (names[0], "image"), *((n, "full") for n in names[1:])]
    columns.append((names[0], "full"))
    return [
        [
            f"{seed} {row['object']}",
            "✓" if row["touched"] else "",
            *(shown("iou3d", overlap.get((*column, str(row["object"])))) for column in columns),
        ]
        for _, row in whole.iterrows()
    ]
