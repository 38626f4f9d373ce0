"""What each error of today's tools costs: all at once, then each of them left out."""

from mover_bench.studies.compare import Row, Table, fill_tables
from mover_bench.studies.finished import Finished, Source
from mover_bench.studies.sets import OFF, SWITCHES
from mover_bench.studies.study_rows import Ask, Page, Plan
from mover_bench.studies.variants import TOOLS

COLUMNS = ("iou3d", "iou3d_aligned", "p2s", "iou2d", "center_error", "yaw_error", "size_error",
           "worse_by_10cm", "worse_by_50cm", "contact_f1", "tilt")  # fmt: skip


def plan(ask: Ask) -> Plan:
    """The presets and variants on the set, and `robust` on the set without each error."""
    names = [f"{ask.rooms}+{OFF}{error}" for error in SWITCHES]
    whole = [(ask.rooms, name) for name in ("robust", "paper", *TOOLS)]
    return [*whole, *((name, "robust") for name in names)]


def page(ask: Ask, finished: Finished) -> Page:
    """One table: the differences are from all errors at once, room by room."""
    whole = Source(ask.rooms, ("robust",))
    rows = [
        Row("initial scene", Source(ask.rooms, ("robust",), "initial"), tested=False),
        Row("image alone", Source(ask.rooms, ("robust",), "image")),
        Row("paper", Source(ask.rooms, ("paper",))),
        Row("robust, all errors", whole),
        *(Row(name.replace("-", " "), Source(ask.rooms, (name,))) for name in TOOLS),
        *(
            Row(f"without errors of {error}", Source(f"{ask.rooms}+{OFF}{error}", ("robust",)))
            for error in SWITCHES
        ),
    ]
    table = Table("What each error costs", COLUMNS, tuple(rows), whole)
    sources = [row.source for row in rows if row.source is not None]
    seeds = {source.rooms: ask.seeds[ask.rooms] for source in sources}
    return Page(fill_tables([table], finished, seeds))
