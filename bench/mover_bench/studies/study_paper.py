"""Why people help or harm under `paper`: true inputs, and terms one by one.

The rooms of a set are given with all errors, with one of camera, bodies, contacts and masks as it
truly is, with camera and bodies true, and with all four. Under each, every term of the people is
tried alone beside the whole of Eq. 1, and objects that people touch are told from the others.
"""

from collections.abc import Sequence

from mover_bench.studies.compare import Row, Table, markdown, shown
from mover_bench.studies.finished import Finished, Source, by_room
from mover_bench.studies.sets import EXACT
from mover_bench.studies.study_page import gain_text
from mover_bench.studies.study_rows import Ask, labelled, quoted_rows
from mover_bench.studies.variants import HUMAN, NO_TERM
from mover_bench.tables import published

PRESETS = ("paper",)
COLUMNS = ("iou3d", "p2s", "iou2d", "non_collision", "contact", "iou3d_touched", "iou3d_untouched")
ADDED = {"nothing": NO_TERM, **{name: name for name in HUMAN}}
"""What the second stage adds to the first, by its heading."""
QUOTED = {
    name: values
    for name, values in published.SCENE.items()
    if name.partition(",")[0] in ("Total3D", "MOVER") and "P" not in name.partition(",")[2]
}
"""The paper's rows with annotated boxes and masks on PROX."""
NOTE = (
    "*Stage 1*: the image alone under the camera of this row's people; *+ nothing*: the same for as"
    " many steps more as the terms of the people have. Rows are compared with Stage 1: ▲ says that"
    " people help, ▼ that they harm."
)


def truths(ask: Ask) -> dict[str, tuple[str, ...]]:
    """What is true in each part of the study, of `EXACT`: nothing, one thing, all that is asked."""
    words = tuple(word for word in EXACT if word in ask.errors)
    both = tuple(word for word in ("camera", "bodies") if word in words)
    groups = ((), *((word,) for word in words), both, words)
    return {f"true {', '.join(group)}" if group else "all errors": group for group in groups}


def set_of(rooms: str, exact: Sequence[str]) -> str:
    """Name of a set in which some things are true."""
    return f"{rooms}+exact={','.join(exact)}" if exact else rooms


def tables(ask: Ask) -> Sequence[Table]:
    """Each preset, and each of its terms alone, under each choice of what is true."""
    return [_table(ask, preset, label) for preset in _presets(ask) for label in truths(ask)]


def gains(ask: Ask, finished: Finished) -> Sequence[str]:
    """What people add under each choice, in the mean and object by object."""
    return [_gains(ask, finished), _pieces(ask, finished)]


def _presets(ask: Ask) -> list[str]:
    return [name for name in PRESETS if name in ask.presets]


def _names(ask: Ask, preset: str) -> dict[str, str]:
    """The jobs of a preset by what they add to Stage 1; `full`, all of it, is the last."""
    few = ask.few_steps
    added = {f"+ {head}": f"{preset}-{name}{few}" for head, name in ADDED.items()}
    return {**added, "full": f"{preset}{few}"}


def _table(ask: Ask, preset: str, label: str) -> Table:
    rooms, names = set_of(ask.rooms, truths(ask)[label]), _names(ask, preset)
    image = Source(rooms, (names["full"],), "image")
    quoted = [] if "+" in rooms else quoted_rows(published.SCENE_COLUMNS, QUOTED)
    rows = (
        Row("initial scene", Source(rooms, (names["full"],), "initial"), tested=False),
        Row("Stage 1", image),
        *labelled(rooms, names),
        *quoted,
    )
    return Table(f"{preset}, {label}", COLUMNS, rows, image, note=NOTE)


def _gains(ask: Ask, finished: Finished) -> str:
    """What each term adds to Stage 1, one line for each choice of what is true."""
    rows: list[list[str]] = []
    seeds = ask.seeds[ask.rooms]
    heads: list[str] = []
    for preset in _presets(ask):
        names = _names(ask, preset)
        heads = list(names)
        for label, exact in truths(ask).items():
            rooms = set_of(ask.rooms, exact)
            image = by_room(finished, Source(rooms, (names["full"],), "image"), "iou3d", seeds)
            found = [by_room(finished, Source(rooms, (n,)), "iou3d", seeds) for n in names.values()]
            cells = [gain_text("iou3d", values, image) for values in found]
            rows.append([f"{preset}, {label}", *cells])
    table = markdown(["", *heads], rows)
    return f"## What people add to IoU3D\n\nDifference from Stage 1.\n\n{table}"


def _pieces(ask: Ask, finished: Finished) -> str:
    """Each object of each room: the way of its overlap."""
    tables: list[str] = []
    for preset in _presets(ask):
        names = _names(ask, preset)
        for label, exact in truths(ask).items():
            rows = [
                row
                for seed in ask.seeds[ask.rooms]
                for row in _rows_of(finished, set_of(ask.rooms, exact), seed, (*names.values(),))
            ]
            if rows:
                head = ["", "touched", "initial", "Stage 1", *names]
                tables.append(f"### {preset}, {label}\n\n{markdown(head, rows)}")
    return "## Object by object\n\nIoU3D.\n\n" + "\n\n".join(tables)


def _rows_of(finished: Finished, rooms: str, seed: int, names: Sequence[str]) -> list[list[str]]:
    """A line for each object of a room; the last of the names is the whole preset."""
    every = finished.objects
    here = every[(every["set"] == rooms) & (every["seed"] == seed)]
    overlap = {
        (str(row["name"]), str(row["stage"]), str(row["object"])): float(row["iou3d"])
        for _, row in here.iterrows()
    }
    whole = here[(here["name"] == names[-1]) & (here["stage"] == "full")]
    columns = [(names[-1], "initial"), (names[-1], "image"), *((n, "full") for n in names)]
    return [
        [
            f"{seed} {row['object']}",
            "✓" if row["touched"] else "",
            *(shown("iou3d", overlap.get((*column, str(row["object"])))) for column in columns),
        ]
        for _, row in whole.iterrows()
    ]
