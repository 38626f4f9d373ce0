"""The paper's tables of scenes, cameras and bodies, and the table of all sets."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

from mover_bench.studies.compare import (
    COLUMNS,
    Filled,
    Row,
    Table,
    fill_tables,
    head_of,
    markdown,
    paired_rooms,
)
from mover_bench.studies.finished import Finished, Source, by_room, recovered, truth_source
from mover_bench.studies.sets import CHANGES, set_named
from mover_bench.studies.study_page import difference_text
from mover_bench.studies.variants import PARTS, PEOPLE, REFINED, SINGLE, TERMS
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
    presets: tuple[str, ...] = ("paper", "release", "robust")
    """Which of them the study `sets` compares."""
    errors: tuple[str, ...] = tuple(CHANGES)
    """Which of them the study `sensitivity` tries, or `paper` switches off."""
    steps: int = 0
    """Of the last descent in the studies `paper` and `refit`; 0: the presets' own."""


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


def quoted_rows(names: Sequence[str], rows: Mapping[str, published.Values]) -> list[Row]:
    """Rows of the paper."""
    return [
        Row(label, quoted={n: v for n, v in zip(names, values, strict=True) if v is not None})
        for label, values in rows.items()
    ]


def ablation_plan(ask: Ask) -> Plan:
    """`robust`, its terms and its parts."""
    names = ("robust", *TERMS, *REFINED, "nobody", *SINGLE, *PARTS)
    return [(ask.rooms, name) for name in names]


def ablation(ask: Ask, finished: Finished) -> Page:
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
    tables = (
        Table(title, SCENE, tuple(rows), full, ticks, SCENE_NOTE),
        Table(
            "Parts of robust", PARTS_SHOWN, (Row("full (robust)", full), *parts), full,
            note="Each row lacks one part.",
        ),
    )  # fmt: skip
    return Page(fill_tables(tables, finished, ask.seeds))


def camera_plan(ask: Ask) -> Plan:
    """Four ways to a camera and a floor, and the people refined."""
    names = ("nobody", "paper-camera", "no-refined-camera", "robust", *REFINED)
    return [(ask.rooms, name) for name in names]


def camera(ask: Ask, finished: Finished) -> Page:
    """The paper's table of camera orientation and ground penetration."""
    columns = (*published.CAMERA_COLUMNS, "ground_error")
    ours = Source(ask.rooms, ("robust",))
    labels = {
        "initial, floor under the furniture": "nobody",
        "feet, priced as in the paper": "paper-camera",
        "feet": "no-refined-camera",
        "feet and objects (robust)": "robust",
    }
    rows = [Row(label, Source(ask.rooms, (name,))) for label, name in labels.items()]
    refined = Source(ask.rooms, tuple(REFINED))
    rows += [
        Row("the same, people refined", refined, tested=False),
        Row("true camera, people as in robust", replace(ours, stage="true_room"), tested=False),
    ]
    quoted = quoted_rows(published.CAMERA_COLUMNS, published.CAMERA)
    table = Table(
        "Camera orientation and ground penetration", columns, (*rows, *quoted), ours,
        note="The paper's angles are read as radians.",
    )  # fmt: skip
    return Page(fill_tables([table], finished, ask.seeds))


def bodies_plan(ask: Ask) -> Plan:
    """The rows of the table of bodies, each a job."""
    return [(ask.rooms, name) for name in PEOPLE]


def bodies(ask: Ask, finished: Finished) -> Page:
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
    rows = [Row(label, Source(ask.rooms, (name,))) for label, name in labels.items()]
    quoted = quoted_rows(published.BODY_COLUMNS, published.BODIES)
    table = Table(
        "Human pose and shape", published.BODY_COLUMNS, (*rows, *quoted),
        Source(ask.rooms, ("people-contact",)),
        note="Bodies are refined in the room that `robust` finds; the first two in the true one.",
    )  # fmt: skip
    return Page(fill_tables([table], finished, ask.seeds))


FITTED = {
    "true room, refined (PROX)": "fitted-true-room",
    "baseline: fit --preset paper": "fitted-baseline",
    "+ CamGP": "fitted-camgp",
    "+ CamGP + SDF": "fitted-sdf",
    "+ CamGP + SDF + Contact": "fitted-contact",
    "the same bodies by refine --preset robust": "fitted-robust",
}
"""The rows of the table from keypoints, each a job."""


def refit_plan(ask: Ask) -> Plan:
    """Keypoints, fit, room, refinement: each row a job, which share fit and room."""
    return [(ask.rooms, f"{name}{few_steps(ask)}") for name in FITTED.values()]


def refit(ask: Ask, finished: Finished) -> Page:
    """The paper's table of human poses as the paper makes it: from keypoints."""
    few = few_steps(ask)
    rows = [Row(label, Source(ask.rooms, (f"{n}{few}",))) for label, n in FITTED.items()]
    quoted = quoted_rows(published.BODY_COLUMNS, published.BODIES)
    table = Table(
        "Human pose and shape, from keypoints", published.BODY_COLUMNS, (*rows, *quoted),
        Source(ask.rooms, (f"fitted-camgp{few}",)),
        note="2D joints of the true people with noise and gaps, bodies of a regressor to start"
        " from; `fit --preset paper`, the room of `paper`, `refine --preset paper`, a third of"
        " their iterations. The prior of poses is ours where the paper has VPoser's.",
    )  # fmt: skip
    return Page(fill_tables([table], finished, ask.seeds))


def few_steps(ask: Ask) -> str:
    """What names jobs with fewer steps of the last descent."""
    return f"@{ask.steps}" if ask.steps else ""


def sets_plan(ask: Ask) -> Plan:
    """The presets on all sets that the seeds name."""
    return [(rooms, name) for rooms in ask.seeds for name in (*ask.presets, "nobody")]


def sets(ask: Ask, finished: Finished) -> Page:
    """Initial scene, image alone and the presets on every set."""
    tables = [_set_table(rooms, ask.presets) for rooms in ask.seeds]
    filled = fill_tables(tables, finished, ask.seeds)
    return Page(filled, [_gains(ask, finished), _turned(ask, finished)])


def _set_table(rooms: str, presets: Sequence[str]) -> Table:
    full = Source(rooms, ("robust",))
    others = [Row(name, Source(rooms, (name,))) for name in presets]
    rows = (
        Row("the truth itself", truth_source(rooms), tested=False),
        Row("initial scene", Source(rooms, ("robust",), "initial"), tested=False),
        Row("image only, first camera", Source(rooms, ("nobody",))),
        Row("robust, image only", Source(rooms, ("robust",), "image")),
        *others,
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
                _gain(metric, *(by_room(finished, s, metric, seeds) for s in (full, image)))
                for metric in columns
            ]
            rows.append([f"{rooms}, {label}", *cells])
    table = markdown(["", *(head_of(name) for name in columns)], rows)
    return f"## What people add\n\n`robust` minus the image alone, 95 % interval.\n\n{table}"


def _gain(metric: str, full: Mapping[int, float], image: Mapping[int, float]) -> str:
    """The first less the second, in the rooms that both have."""
    found = paired_rooms(full, image)
    return "-" if found is None else difference_text(metric, found.mean, found.low, found.high)


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
