"""What simulators ask for: furniture that stays under gravity, people who do not slide or float."""

from collections.abc import Sequence

from mover_bench.studies.compare import Row, Table, fill_tables, markdown
from mover_bench.studies.finished import Finished, Frame, Source
from mover_bench.studies.study_rows import Ask, Page, Plan
from mover_bench.studies.variants import STANDS

STAGES = {"initial": "initial scene", "image": "image alone", "full": "robust",
          "nudged": "robust, nudged"}  # fmt: skip
STAYS = ("stands", "toppled", "moved", "turned")
MOVES = ("foot_skate", "float_height", "sink_depth", "penetration_depth", "jerk",
         "acceleration_error", "pje")  # fmt: skip


def stability_plan(ask: Ask) -> Plan:
    """One job a room."""
    return [(ask.rooms, name) for name in STANDS]


def stability(ask: Ask, finished: Finished) -> Page:
    """Means over rooms, the share of all pieces, and each piece that does not stay."""
    names = tuple(STANDS)
    rows = [Row(label, Source(ask.rooms, names, stage)) for stage, label in STAGES.items()]
    truth = Row("the truth itself", Source(ask.rooms, names, "truth"), tested=False)
    table = Table(
        "Does the furniture stay", STAYS, (truth, *rows), Source(ask.rooms, names, "full"),
        note="Two seconds of gravity, and again with the weight of who sits on a piece: it stays"
        " if it moves by less than 1 cm and turns by less than 1°. Means over rooms.",
    )  # fmt: skip
    return Page(fill_tables([table], finished, ask.seeds), [_share(finished), _fallen(finished)])


def _pieces(finished: Finished, stage: str) -> Frame:
    """All pieces of a scene that were simulated."""
    columns = ("seed", "object", "stands", "moved", "stuck", "nudge")
    pieces = finished.objects[finished.objects.stage == stage].reindex(columns=columns)
    return pieces[pieces.stands.notna()]


def _share(finished: Finished) -> str:
    """How many of all pieces stay."""
    rows: list[Sequence[str]] = []
    for stage, label in STAGES.items():
        pieces = _pieces(finished, stage)
        count, stay = len(pieces), int(pieces.stands.sum())
        share = f"{100 * stay / count:.1f}" if count else "-"
        rows.append([label, f"{stay} / {count}", share])
    table = markdown(["", "stay", "%"], [list(row) for row in rows])
    return f"## All pieces\n\n{table}"


def _fallen(finished: Finished) -> str:
    """Pieces of the result that do not stay, and what was done about them."""
    pieces = _pieces(finished, "full")
    rows: list[list[str]] = []
    for piece in pieces[pieces.stands < 1].itertuples():
        moved = f"{1000 * piece.moved:.0f}"
        stuck = f"{1000 * piece.stuck:.0f}"
        rows.append([f"{piece.seed} {piece.object}", moved, stuck, piece.nudge])
    if not rows:
        return "All pieces of the result stay."
    table = markdown(["piece", "moved [mm]", "stuck [mm]", "nudge"], rows)
    return f"## What does not stay\n\n{table}"


PEOPLE = {
    "the truth itself": "people-true",
    "in the room that was found": "people-in-room",
    "refined": "people-order",
}


def motion_plan(ask: Ask) -> Plan:
    """The people as they are, and refined."""
    return [(ask.rooms, name) for name in PEOPLE.values()]


def motion(ask: Ask, finished: Finished) -> Page:
    """How people slide, float, sink and jerk before and after their refinement."""
    rows = [Row(label, Source(ask.rooms, (name,))) for label, name in PEOPLE.items()]
    table = Table(
        "How people move", MOVES, tuple(rows), Source(ask.rooms, ("people-in-room",)),
        note="Float: height of the lower sole over the floor; who sits with hanging feet floats in"
        " truth, too. Sink: depth of the lowest vertex under it.",
    )  # fmt: skip
    return Page(fill_tables([table], finished, ask.seeds))
