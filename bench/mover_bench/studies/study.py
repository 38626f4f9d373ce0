"""Run the paper's experiments on known rooms, each a study of its own: jobs, then tables."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from mover.core.errors import InputError
from mover.core.files import replacing
from mover.core.observe import Observer, silent
from mover.pipeline.presets import PRESETS
from mover_bench.studies import study_noise, study_paper, study_rows, study_video
from mover_bench.studies.args import StudyArgs
from mover_bench.studies.compare import Table, fill_tables
from mover_bench.studies.finished import Finished, Source, read_finished
from mover_bench.studies.job import ROOM, Job
from mover_bench.studies.queue import Launch, finish, open_jobs, start
from mover_bench.studies.run import parse_seeds
from mover_bench.studies.sets import CHANGES, SETS, set_named
from mover_bench.studies.study_page import command_of as row_command
from mover_bench.studies.study_page import commands_of, missing_of, table_of, write_numbers
from mover_bench.studies.study_rows import Ask, Page, Plan, jobs_in
from mover_bench.studies.tables import made_by, need_bench

ALL = "all"
SCALE = (
    "Rows in italics are quoted from the paper; they were measured on PROX or PiGraphs and are not"
    " comparable with numbers on known rooms."
)


@dataclass(frozen=True)
class Study:
    """An experiment of the paper."""

    about: str
    rooms: str
    """The set that it is made on; empty: all of them."""
    plan: Callable[[Ask], Plan]
    page: Callable[[Ask, Finished], Page]


def _nothing(_: Ask, __: Finished) -> Sequence[str]:
    return ()


def tabled(
    about: str,
    rooms: str,
    tables: Callable[[Ask], Sequence[Table]],
    more: Callable[[Ask, Finished], Sequence[str]] = _nothing,
) -> Study:
    """A study that is tables: its jobs are those of their rows; `more` writes further sections."""

    def page(ask: Ask, finished: Finished) -> Page:
        asked = tables(ask)
        seeds = {row.source.rooms: ask.seeds_of(row.source.rooms)
                 for table in asked for row in table.rows if row.source}  # fmt: skip
        return Page(fill_tables(asked, finished, seeds), more(ask, finished))

    return Study(about, rooms, lambda ask: jobs_in(tables(ask)), page)


STUDIES: dict[str, Study] = {
    "ablation": tabled(
        "Which evidence and which part of the method places the furniture.",
        "rooms", study_rows.ablation,
    ),
    "camera": tabled(
        "Orientation of the camera and feet below the floor.",
        "rooms", study_rows.camera,
    ),
    "bodies": tabled(
        "What the room gives back to the people.",
        "rooms", study_rows.bodies,
    ),
    "refit": tabled(
        "What the room gives back to people who are fitted to keypoints, as the paper does it.",
        "rooms", study_rows.refit,
    ),
    "video-length": Study(
        "Accuracy against the length of the video.",
        "long", study_video.length_plan, study_video.length,
    ),
    "interactions": Study(
        "Accuracy against the number of different interactions, at a fixed length.",
        "long", study_video.length_plan, study_video.interactions,
    ),
    "time": Study(
        "Time against the number of frames.",
        "long", study_video.time_plan, study_video.time,
    ),
    "sensitivity": Study(
        "Accuracy against errors of the input.",
        "rooms", study_noise.plan, study_noise.page,
    ),
    "upstream": tabled(
        "What each error of today's tools costs: all at once, and each left out.",
        "upstream", study_rows.upstream,
    ),
    "stability": tabled(
        "Which share of the furniture stays under gravity and sitters.",
        "rooms", study_rows.stability, study_rows.fallen,
    ),
    "motion": tabled(
        "How people slide, float, sink and jerk, before and after their refinement.",
        "rooms", study_rows.motion,
    ),
    "paper": tabled(
        "Which error of the input undoes which printed term.",
        "rooms", study_paper.tables, study_paper.gains,
    ),
    "sets": tabled(
        "All presets on all sets.",
        "", study_rows.sets, study_rows.set_gains,
    ),
}  # fmt: skip
"""By name."""


def run_study(
    args: StudyArgs, observe: Observer = silent, launch: Launch | None = None
) -> list[Path]:
    """Do all jobs that are not finished, room by room, then write the tables of each study.

    Returns:
        The pages, OUT/studies/NAME/summary.md.

    Raises:
        InputError: If a study, a set, a preset or a seed is none.
    """
    _check(args)
    need_bench()
    names = list(STUDIES) if args.name == ALL else [args.name]
    asks = {name: ask_of(args, STUDIES[name]) for name in names}
    plans = {name: jobs_of(STUDIES[name].plan(ask), ask, args.out) for name, ask in asks.items()}
    jobs = in_order([job for plan in plans.values() for job in plan])
    waiting = [] if args.look else open_jobs(jobs, args.keep)
    finish(jobs, waiting, args.workers, (observe, launch or start), store=False)
    return [write_study(name, args, asks[name], plans[name]) for name in names]


def ask_of(args: StudyArgs, study: Study) -> Ask:
    """Sets and seeds of a study."""
    rooms = args.set or study.rooms
    names = [rooms] if rooms else list(SETS)
    seeds = {name: parse_seeds(args.seeds or set_named(name).seeds) for name in names}
    errors = args.errors or tuple(study_noise.ERRORS.get(args.name, CHANGES))
    return Ask(names[0], seeds, args.presets, errors, args.steps)


def jobs_of(plan: Plan, ask: Ask, out: Path) -> list[Job]:
    """The jobs of a plan with the rooms that they need; changed sets have the base's seeds."""
    jobs: list[Job] = []
    for rooms, name in plan:
        jobs += [Job(rooms, s, job, out) for s in ask.seeds_of(rooms) for job in (ROOM, name)]
    return list(dict.fromkeys(jobs))


def in_order(jobs: Sequence[Job]) -> list[Job]:
    """Each job once: by seed, then by set, so that rooms without noise are shared while kept."""
    jobs = list(dict.fromkeys(jobs))
    sets = {name: place for place, name in enumerate(dict.fromkeys(job.rooms for job in jobs))}
    return sorted(jobs, key=lambda job: (job.seed, sets[job.rooms]))


def write_study(name: str, args: StudyArgs, ask: Ask, jobs: Sequence[Job]) -> Path:
    """Write summary.md, table.csv and the plots of a study; returns the former."""
    study, finished = STUDIES[name], read_finished(jobs)
    page = study.page(ask, finished)
    folder = folder_of(name, args)
    seeds = {rooms: args.seeds or set_named(rooms).seeds for rooms in {j.rooms for j in jobs}}
    if page.tables:
        write_numbers(page.tables, seeds, folder / "table.csv")
    for title, plot in page.plots.items():
        with replacing(folder / f"{title}.svg") as part:
            part.write_text(plot)
    parts = [
        f"# {name.capitalize().replace('-', ' ')}",
        f"    {command_of(name, args)}",
        f"{study.about} {SCALE}",
        f"{_rooms(ask)} {made_by(finished.scenes.version)}",
        *missing_of(jobs),
        *(table_of(filled) for filled in page.tables),
        *page.sections,
        *(f"![{title}]({title}.svg)" for title in page.plots),
        *_commands(page, jobs, seeds),
    ]
    with replacing(folder / "summary.md") as part:
        part.write_text("\n\n".join(parts) + "\n")
    return folder / "summary.md"


def folder_of(name: str, args: StudyArgs) -> Path:
    """Where a study is written; studies on other sets or of some errors have their names, too."""
    usual = args.set in ("", STUDIES[name].rooms)
    words = [name, *([] if usual else [args.set]), *args.errors]
    return args.out / "studies" / "-".join(words)


def command_of(name: str, args: StudyArgs) -> str:
    """The command that makes the same study."""
    words = ["mover experiment study", name]
    words += ["--set", args.set] if args.set else []
    words += ["--seeds", args.seeds] if args.seeds else []
    if name in ("sets", "paper") and args.presets != StudyArgs.presets:
        words += ["--presets", *args.presets]
    words += ["--errors", *args.errors] if args.errors else []
    words += ["--steps", str(args.steps)] if args.steps else []
    return " ".join(words)


def _rooms(ask: Ask) -> str:
    """How many rooms there are of which set."""
    counts = ", ".join(f"{len(seeds)} of `{name}`" for name, seeds in ask.seeds.items())
    return f"Rooms: {counts}."


def _commands(page: Page, jobs: Sequence[Job], seeds: Mapping[str, str]) -> list[str]:
    """The command of each row, or, where rows are put together, of each set of jobs."""
    lines = commands_of(page.tables, seeds)
    if not page.tables:
        names: dict[str, list[str]] = {}
        for job in jobs:
            if job.name != ROOM and job.name not in names.setdefault(job.rooms, []):
                names[job.rooms].append(job.name)
        lines = [row_command(Source(n, tuple(found)), seeds[n]) for n, found in names.items()]
    code = "\n".join(f"    {line}" for line in lines)
    return [f"## Commands\n\nThe jobs of each row by themselves:\n\n{code}"] if lines else []


def _check(args: StudyArgs) -> None:
    if args.name not in (*STUDIES, ALL):
        raise InputError(f"study: {args.name!r} is none of {', '.join(STUDIES)}, {ALL}")
    if args.set:
        set_named(args.set)
    if args.name in ("sensitivity", "sets", "paper", ALL) and args.set and args.set not in SETS:
        raise InputError(
            f"--set: {args.set!r} is changed already, expected one of {', '.join(SETS)}"
        )
    for name in args.presets:
        if name not in PRESETS:
            raise InputError(f"--presets: {name!r} is none of {', '.join(PRESETS)}")
    study_noise.check_errors(args.name, args.errors)
    if args.steps and args.name not in ("paper", "refit"):
        raise InputError(f"--steps: the study {args.name} keeps the presets' own")
    if "robust" not in args.presets and args.name != "paper":
        raise InputError("--presets: robust is missing, with which the others are compared")
