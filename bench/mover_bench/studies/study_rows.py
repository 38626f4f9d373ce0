"""Studies that are tables: scenes, cameras and bodies as in the paper, all sets, and motion."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from mover_bench.studies.compare import COLUMNS, Filled, Row, Table, head_of, markdown
from mover_bench.studies.finished import Finished, Frame, Source, by_room, recovered, truth_source
from mover_bench.studies.job import ROOM
from mover_bench.studies.sets import CHANGES, OFF, SWITCHES, set_named
from mover_bench.studies.study_page import gain_text
from mover_bench.studies.variants import PARTS, REFINED, SINGLE, STANDS, TOOLS
from mover_bench.tables import published

SCENE = ("iou3d", "p2s", "iou2d", "non_collision", "contact", "contact_f1", "worse_by_10cm",
         "worse_by_50cm")  # fmt: skip
OBJECTS = ("iou3d", "iou3d_aligned", "p2s", "iou2d", "worse_by_10cm", "worse_by_50cm", "contact_f1",
           "non_collision", "iou3d_touched", "iou3d_untouched")  # fmt: skip
PARTS_SHOWN = ("iou3d", "p2s", "iou2d", "contact_f1", "yaw_error", "tilt", "ground_error")

SCENE_NOTE = (
    "*One frame*: mean over five frames, each rebuilt alone with its people, as methods do that do"
    " not accumulate. *Camera*: the image alone under the refined camera (Stage 1); *placed again*:"
    " the same with the second stage's descents. *True room*: the true furniture with people as"
    " noisy as those that all rows above it are measured with."
)


@dataclass(frozen=True)
class Ask:
    """What a study is made of."""

    rooms: str
    """Name of the set."""
    seeds: Mapping[str, Sequence[int]]
    """The rooms of each set that takes part."""
    presets: tuple[str, ...] = ("paper", "robust")
    """Which of them the study `sets` compares."""
    errors: tuple[str, ...] = tuple(CHANGES)
    """Which of them the study `sensitivity` tries, or `paper` switches off."""
    steps: int = 0
    """Of the last descent in the studies `paper` and `refit`; 0: the presets' own."""

    def seeds_of(self, rooms: str) -> Sequence[int]:
        """The rooms of a set; changed sets have those of the set that is changed."""
        return self.seeds.get(rooms) or self.seeds[rooms.partition("+")[0]]

    @property
    def few_steps(self) -> str:
        """What names jobs with fewer steps of the last descent."""
        return f"@{self.steps}" if self.steps else ""


@dataclass(frozen=True)
class Page:
    """What a study shows."""

    tables: Sequence[Filled]
    sections: Sequence[str] = ()
    """Further Markdown."""
    plots: Mapping[str, str] = field(default_factory=dict[str, str])
    """SVG by name."""


Plan = Sequence[tuple[str, str]]
"""The jobs of a study: set and variant."""


def jobs_in(tables: Sequence[Table]) -> Plan:
    """The jobs that the rows of tables need."""
    sources = [row.source for table in tables for row in table.rows if row.source]
    jobs = [(source.rooms, name) for source in sources for name in source.names if name != ROOM]
    return list(dict.fromkeys(jobs))


def labelled(rooms: str, names: Mapping[str, str]) -> list[Row]:
    """A row for the job of each label."""
    return [Row(label, Source(rooms, (name,))) for label, name in names.items()]


def quoted_rows(names: Sequence[str], rows: Mapping[str, published.Values]) -> list[Row]:
    """Rows of the paper."""
    return [Row(label, quoted=values) for label, values in published.quoted(names, rows)]


def ablation(ask: Ask) -> Sequence[Table]:
    """The paper's table of scene reconstruction and interaction, and the parts of `robust`."""

    def of(*names: str, stage: str = "full") -> Source:
        return Source(ask.rooms, names, stage)

    full, no, yes = of("robust"), False, True
    rows = [
        Row("the truth itself", truth_source(ask.rooms), tested=False),
        Row("initial scene", of("robust", stage="initial"), (no, no, no, no), tested=False),
        Row("image only, first camera", of("nobody"), (no, no, no, no)),
        Row("one frame", of(*SINGLE), (yes, yes, yes, yes)),
        Row("camera", of("robust", stage="image"), (yes, no, no, no)),
        Row("camera, placed again", of("again-alone"), (yes, no, no, no)),
        Row("+ contact", of("contact"), (yes, yes, no, no)),
        Row("+ depth", of("depth"), (yes, no, yes, no)),
        Row("+ collision", of("collision"), (yes, no, no, yes)),
        Row("+ contact, depth", of("contact-depth"), (yes, yes, yes, no)),
        Row("+ contact, collision", of("contact-collision"), (yes, yes, no, yes)),
        Row("+ depth, collision", of("depth-collision"), (yes, no, yes, yes)),
        Row("full (robust)", full, (yes, yes, yes, yes)),
        Row("full, people refined", of(*REFINED), (yes, yes, yes, yes), tested=False),
        Row("true room, people as in full", of("robust", stage="true_room"), tested=False),
        *quoted_rows(published.SCENE_COLUMNS, published.SCENE),
    ]
    ticks = ("Cam.", "Contact", "Depth", "Colli.")
    parts = [Row(name.replace("-", " "), of(name)) for name in PARTS]
    title = "Scene reconstruction and human-scene interaction"
    return (
        Table(title, SCENE, tuple(rows), full, ticks, SCENE_NOTE),
        Table(
            "Parts of robust", PARTS_SHOWN, (Row("full (robust)", full), *parts), full,
            note="Each row lacks one part.",
        ),
    )  # fmt: skip


def camera(ask: Ask) -> Sequence[Table]:
    """The paper's table of camera orientation and ground penetration."""
    columns = (*published.CAMERA_COLUMNS, "ground_error")
    ours = Source(ask.rooms, ("robust",))
    labels = {
        "initial, floor under the furniture": "nobody",
        "feet, priced as in the paper": "paper-camera",
        "feet": "no-refined-camera",
        "feet and objects (robust)": "robust",
    }
    refined = Source(ask.rooms, tuple(REFINED))
    rows = [
        *labelled(ask.rooms, labels),
        Row("the same, people refined", refined, tested=False),
        Row("true camera, people as in robust", replace(ours, stage="true_room"), tested=False),
        *quoted_rows(published.CAMERA_COLUMNS, published.CAMERA),
    ]
    note = "The paper's angles are read as radians."
    title = "Camera orientation and ground penetration"
    return [Table(title, columns, tuple(rows), ours, note=note)]


def bodies(ask: Ask) -> Sequence[Table]:
    """The paper's table of human poses: what the room gives back to the people."""
    labels = {
        "true room, as regressed": "people-true-given",
        "true room, refined (PROX)": "people-true-room",
        "as regressed": "people-given",
        "baseline: smoothed": "people-baseline",
        "+ CamGP": "people-camgp",
        "+ CamGP + SDF": "people-sdf",
        "+ CamGP + SDF + Contact": "people-contact",
        "+ CamGP + SDF + Contact + depth order + masks": "people-order",
    }
    note = "Bodies are refined in the room that `robust` finds; the first two in the true one."
    return [_of_poses("Human pose and shape", ask, labels, "people-contact", note)]


def _of_poses(title: str, ask: Ask, labels: Mapping[str, str], against: str, note: str) -> Table:
    """A table of bodies beside the paper's."""
    quoted = quoted_rows(published.BODY_COLUMNS, published.BODIES)
    rows = (*labelled(ask.rooms, labels), *quoted)
    return Table(title, published.BODY_COLUMNS, rows, Source(ask.rooms, (against,)), note=note)


FITTED = {
    "true room, refined (PROX)": "fitted-true-room",
    "baseline: fit --preset paper": "fitted-baseline",
    "+ CamGP": "fitted-camgp",
    "+ CamGP + SDF": "fitted-sdf",
    "+ CamGP + SDF + Contact": "fitted-contact",
    "the same bodies by refine --preset robust": "fitted-robust",
}
"""The rows of the table from keypoints, each a job."""


def refit(ask: Ask) -> Sequence[Table]:
    """The paper's table of human poses as the paper makes it: keypoints, fit, room, refinement."""
    labels = {label: f"{name}{ask.few_steps}" for label, name in FITTED.items()}
    note = (
        "2D joints of the true people with noise and gaps, bodies of a regressor to start"
        " from; `fit --preset paper`, the room of `paper`, `refine --preset paper`, a third of"
        " their iterations. The prior of poses is ours where the paper has VPoser's."
    )
    against = f"fitted-camgp{ask.few_steps}"
    return [_of_poses("Human pose and shape, from keypoints", ask, labels, against, note)]


def sets(ask: Ask) -> Sequence[Table]:
    """Initial scene, image alone and the presets on every set."""
    return [_set_table(rooms, ask.presets) for rooms in ask.seeds]


def set_gains(ask: Ask, finished: Finished) -> Sequence[str]:
    """What people add on every set, and the seats that were turned round."""
    return [_gains(ask, finished), _turned(ask, finished)]


def _set_table(rooms: str, presets: Sequence[str]) -> Table:
    full = Source(rooms, ("robust",))
    rows = (
        Row("the truth itself", truth_source(rooms), tested=False),
        Row("initial scene", Source(rooms, ("robust",), "initial"), tested=False),
        Row("image only, first camera", Source(rooms, ("nobody",))),
        Row("robust, image only", Source(rooms, ("robust",), "image")),
        *labelled(rooms, {name: name for name in presets}),
    )
    return Table(f"{rooms}", OBJECTS, rows, full, note=set_named(rooms).about)


def _gains(ask: Ask, finished: Finished) -> str:
    """What people add to the image alone, set by set."""
    columns = ("iou3d_touched", "iou3d_untouched", "iou3d", "p2s")
    rows: list[list[str]] = []
    for rooms, seeds in ask.seeds.items():
        full = Source(rooms, ("robust",))
        images = {  # as it is where there are no people, and with the camera they gave
            "first camera": Source(rooms, ("nobody",)),
            "camera of the people": Source(rooms, ("robust",), "image"),
        }
        for label, image in images.items():
            cells = [
                gain_text(metric, *(by_room(finished, s, metric, seeds) for s in (full, image)))
                for metric in columns
            ]
            rows.append([f"{rooms}, {label}", *cells])
    table = markdown(["", *(head_of(name) for name in columns)], rows)
    return f"## What people add\n\n`robust` minus the image alone, 95 % interval.\n\n{table}"


def _turned(ask: Ask, finished: Finished) -> str:
    """Chairs and sofas whose guess looked the wrong way."""
    kinds = {"initial": "initial", "image only": "image", "robust": "full"}
    head = ["", *(f"{kind}, {who}" for kind in kinds for who in ("used", "all"))]
    rows: list[list[str]] = []
    for rooms, seeds in ask.seeds.items():
        cells: list[str] = []
        for stage in kinds.values():
            source = Source(rooms, ("robust",), stage)
            for used in (True, False):
                good, count = recovered(finished, source, seeds, used=used)
                cells.append(f"{good} / {count}")
        rows.append([rooms, *cells])
    note = (
        "Chairs, armchairs and sofas whose first guess is wrong by more than 60°: how many came"
        f" within 45° ({COLUMNS['yaw_error'].title}), of those that people use and of all."
    )
    return f"## Turned seats recovered\n\n{note}\n\n{markdown(head, rows)}"


# What simulators ask for: furniture that stays under gravity, people who do not slide or float.


STAGES = {"initial": "initial scene", "image": "image alone", "full": "robust"}
STAYS = ("stands", "toppled", "moved", "turned")
MOVES = ("foot_skate", "float_height", "sink_depth", "penetration_depth", "jerk",
         "acceleration_error", "pje")  # fmt: skip


def stability(ask: Ask) -> Sequence[Table]:
    """Which share of the pieces of a room stays, in the mean over rooms."""
    names = tuple(STANDS)
    rows = [Row(label, Source(ask.rooms, names, stage)) for stage, label in STAGES.items()]
    truth = Row("the truth itself", Source(ask.rooms, names, "truth"), tested=False)
    note = (
        "Two seconds of gravity, and again with the weight of who sits on a piece: it stays"
        " if it moves by less than 1 cm and turns by less than 1°. Means over rooms."
    )
    full = Source(ask.rooms, names, "full")
    return [Table("Does the furniture stay", STAYS, (truth, *rows), full, note=note)]


def fallen(_: Ask, finished: Finished) -> Sequence[str]:
    """The share of all pieces, and each piece that does not stay."""
    return [_share(finished), _fallen(finished)]


def _pieces(finished: Finished, stage: str) -> Frame:
    """All pieces of a scene that were simulated."""
    columns = ("seed", "object", "stands", "moved", "stuck")
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
        rows.append([f"{piece.seed} {piece.object}", moved, stuck])
    if not rows:
        return "All pieces of the result stay."
    table = markdown(["piece", "moved [mm]", "stuck [mm]"], rows)
    return f"## What does not stay\n\n{table}"


PEOPLE = {
    "the truth itself": "people-true",
    "in the room that was found": "people-in-room",
    "refined": "people-order",
}


def motion(ask: Ask) -> Sequence[Table]:
    """How people slide, float, sink and jerk before and after their refinement."""
    note = (
        "Float: height of the lower sole over the floor; who sits with hanging feet floats in"
        " truth, too. Sink: depth of the lowest vertex under it."
    )
    rows, against = labelled(ask.rooms, PEOPLE), Source(ask.rooms, ("people-in-room",))
    return [Table("How people move", MOVES, tuple(rows), against, note=note)]


UPSTREAM = ("iou3d", "iou3d_aligned", "p2s", "iou2d", "center_error", "yaw_error",
           "yaw_error_symmetric", "size_error", "worse_by_10cm", "worse_by_50cm", "contact_f1",
           "tilt")  # fmt: skip


def upstream(ask: Ask) -> Sequence[Table]:
    """What each error of today's tools costs: all at once, then each of them left out."""
    whole = Source(ask.rooms, ("robust",))
    rows = [
        Row("initial scene", Source(ask.rooms, ("robust",), "initial"), tested=False),
        Row("image alone", Source(ask.rooms, ("robust",), "image")),
        Row("paper", Source(ask.rooms, ("paper",))),
        Row("robust, all errors", whole),
        *labelled(ask.rooms, {name.replace("-", " "): name for name in TOOLS}),
        *(
            Row(f"without errors of {error}", Source(f"{ask.rooms}+{OFF}{error}", ("robust",)))
            for error in SWITCHES
        ),
    ]
    return [Table("What each error costs", UPSTREAM, tuple(rows), whole)]
