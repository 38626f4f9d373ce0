"""The paper's first table on known rooms: initial, Stage 1 and full, preset by preset.

Every seed and preset is a process of its own; finished ones are files and are not done again.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from mover.app.pictures.overlay import canvas, draw_overlay
from mover.core.errors import InputError
from mover.core.files import replacing
from mover.core.observe import Observer, silent
from mover.core.records import load, map_tensors
from mover.core.types import Scene, SceneObject
from mover.evaluate.scene import image_box
from mover.geometry.boxes import box_of, corners
from mover_bench.studies.args import ExperimentArgs
from mover_bench.studies.finished import Frame, Source, read_finished
from mover_bench.studies.job import ROOM, Job, Rebuilt, noisy_room
from mover_bench.studies.measures import Trial
from mover_bench.studies.queue import Launch, failure_of, finish, has_results, open_jobs, start
from mover_bench.studies.sets import set_named
from mover_bench.studies.study_page import command_of
from mover_bench.studies.tables import Experiment, cell_of, need_bench, write_tables
from mover_bench.studies.variants import choices, is_variant


def run_experiment(
    args: ExperimentArgs, observe: Observer = silent, launch: Launch | None = None
) -> Path:
    """Do all jobs that are not finished, then write tables and pictures.

    Returns:
        The summary, OUT/SET/summary.md.

    Raises:
        InputError: If a seed, a preset or a set is none.
    """
    seeds = parse_seeds(args.seeds)
    _check(args)
    need_bench()
    rooms = [Job(args.set, seed, ROOM, args.out) for seed in seeds]
    presets = tuple(dict.fromkeys(args.presets))
    rebuilt = [Job(args.set, s, name, args.out) for name in presets for s in seeds]
    jobs = rooms + rebuilt
    waiting = open_jobs(by_room(jobs), args.keep)
    finish(jobs, waiting, args.workers, (observe, launch or start))
    failures = {job: failure_of(job) for job in jobs if not has_results(job)}
    found = read_finished(rebuilt)
    command = command_of(Source(args.set, args.presets), args.seeds)
    experiment = Experiment(command, args.set, presets, seeds, found, failures)
    folder = args.out / args.set
    pictures = draw_worst(experiment, args.set, args.out, args.worst)
    return write_tables(experiment, pictures, folder)


def parse_seeds(text: str) -> tuple[int, ...]:
    """Read `0-9` or `0,3,5-7`.

    Raises:
        InputError: If it is anything else.
    """
    seeds: set[int] = set()
    for part in text.split(","):
        first, dash, last = part.strip().partition("-")
        ends = [first, last if dash else first]
        if not all(end.isascii() and end.isdigit() for end in ends) or int(ends[1]) < int(ends[0]):
            raise InputError(f"--seeds: {text!r}, expected numbers and ranges like 0,3,5-7")
        seeds.update(range(int(ends[0]), int(ends[1]) + 1))
    return tuple(sorted(seeds))


def by_room(jobs: Sequence[Job]) -> list[Job]:
    """The jobs of a room one after the other, rooms in the order in which they first appear."""
    rooms = {key: place for place, key in enumerate(dict.fromkeys((j.rooms, j.seed) for j in jobs))}
    return sorted(jobs, key=lambda job: rooms[(job.rooms, job.seed)])


def _check(args: ExperimentArgs) -> None:
    set_named(args.set)
    for name in args.presets:
        if not is_variant(name):
            raise InputError(f"--presets: {name!r} is none of {choices()}")


# Pictures of the objects that came out worst: in the image and from above.


SIDE = 4.2  # [inch] of a panel
WIDEST = 1600  # [px] of a whole overlay
MARGIN = 0.3  # around an object, as a share of its size in the image
CLEARANCE = 0.8  # [m] around it in the plan
COLOURS = {"before": "#7878be", "truth": "#1e783c", "after": "#c83c32"}
BASE = (0, 4, 5, 1)  # corners of a box around its bottom, the last two at its front


def worst_objects(experiment: Experiment, count: int) -> Frame:
    """The given objects of the last preset with the lowest IoU3D after the full method.

    None where the preset is one that measures something else of them.
    """
    found = experiment.finished.objects
    if not {"iou3d", "center_error"} <= set(found):
        return found[:0]
    rows = found[(found.name == experiment.presets[-1]) & (found.stage == "full")]
    rows = rows.dropna(subset=["center_error"])  # what was not given cannot be drawn
    return rows.sort_values(["iou3d", "seed", "object"])[:count]


def draw_worst(experiment: Experiment, rooms: str, out: Path, count: int) -> list[str]:
    """Draw worst_1.png, ... into OUT/ROOMS; returns their names.

    Each shows the object before, after and in truth in the image, and all three from above.
    """
    names: list[str] = []
    trials: dict[Job, Trial] = {}
    for place, worst in enumerate(worst_objects(experiment, count).itertuples(), 1):
        job = Job(rooms, worst.seed, worst.name, out)
        if job not in trials:
            trials[job] = map_tensors(_plain, _trial(job))
        rebuilt = map_tensors(_plain, load(Rebuilt, job.folder / "scenes"))
        names.append(f"worst_{place}.png")
        with replacing(out / rooms / names[-1]) as part:
            found = experiment.finished.objects
            stages = found[(found.seed == worst.seed) & (found.object == worst.object)]
            stages = stages[stages.name == worst.name].set_index("stage")
            figure = draw_object(stages, trials[job], rebuilt)
            figure.savefig(part, format="png", metadata={"Software": None})
    return names


def draw_object(stages: Frame, trial: Trial, rebuilt: Rebuilt) -> Any:  # noqa: ANN401
    """Overlays of the initial, the rebuilt and the true scene around an object, and a plan."""
    from matplotlib.figure import Figure

    before, after = (stages.loc[stage].to_dict() for stage in ("initial", "full"))
    name = after["object"]
    scenes = {"before": trial.capture.scene, "after": rebuilt.full, "truth": trial.truth}
    found = {key: _piece(scene, name) for key, scene in scenes.items()}
    region = _region([(scenes[k], p) for k, p in found.items() if p is not None and k != "before"])
    titles = {
        "before": _numbers(before),
        "after": _numbers(after),
        "truth": _traits(after),
    }
    figure = Figure((4 * SIDE, SIDE + 0.4), layout="constrained")
    *views, plan = figure.subplots(1, 4)
    for axes, (key, title) in zip(views, titles.items(), strict=True):
        overlay = draw_overlay(canvas(trial.capture.reference, scenes[key], WIDEST), scenes[key])
        left, top, right, bottom = (region * torch.tensor([*overlay.shape[1::-1]] * 2)).tolist()
        axes.imshow(overlay.clamp(0, 1).numpy())
        axes.set(xlim=(left, right), ylim=(bottom, top), facecolor="black")
        axes.set_title(f"{key}: {title}", loc="left", fontsize=9)
    _plan(plan, trial.truth, found)
    for axes in (*views, plan):
        axes.set(xticks=[], yticks=[])
    return figure


def _trial(job: Job) -> Trial:
    """The room of a job; studies do not keep theirs, so that it may have to be made again."""
    if job.room.with_suffix(".json").exists():
        return load(Trial, job.room)
    return noisy_room(job.seed, set_named(job.rooms))


def _plain(tensor: Tensor) -> Tensor:
    return tensor.float() if tensor.is_floating_point() else tensor


def _numbers(values: Mapping[str, Any]) -> str:
    centre, yaw = cell_of("center_error", values), cell_of("yaw_error", values)
    return f"IoU3D {cell_of('iou3d', values)}, centre {centre} cm, yaw {yaw}°"


def _traits(item: Mapping[str, Any]) -> str:
    about = f"{item['name']}, seed {item['seed']}, {item['object']}"
    use = "touched" if item["touched"] else "untouched"
    return f"{about}, {use}, {item['hidden']:.0%} hidden"


def _piece(scene: Scene, name: str) -> SceneObject | None:
    return next((piece for piece in scene.objects if piece.id == name), None)


def _region(seen: Sequence[tuple[Scene, SceneObject]]) -> Float[Tensor, "4"]:
    """A square around all of them, inside the image where it fits, as shares of its sides."""
    boxes = [image_box(piece, scene.camera) for scene, piece in seen]
    shown_boxes = [box for box in boxes if box is not None]
    if not shown_boxes:
        return torch.tensor([0.0, 0.0, 1.0, 1.0])
    stack = torch.stack(shown_boxes)
    low, high = stack[:, :2].amin(0), stack[:, 2:].amax(0)
    camera = seen[0][0].camera
    size = torch.tensor([camera.width, camera.height]).to(low)
    half = ((high - low) * size).max() * (0.5 + MARGIN) / size
    middle = (low + high) / 2
    inside = torch.minimum(torch.maximum(middle, half), 1 - half)
    middle = torch.where(half < 0.5, inside, 0.5)
    return torch.cat([middle - half, middle + half])


def _plan(axes: Any, truth: Scene, found: Mapping[str, SceneObject | None]) -> None:  # noqa: ANN401
    """Footprints from above, away from the camera upwards; a thick edge is the front."""
    bases = {key: _base(piece) for key, piece in found.items() if piece is not None}
    everything = torch.cat(list(bases.values()))
    low, high = everything.amin(0) - CLEARANCE, everything.amax(0) + CLEARANCE
    middle, half = (low + high) / 2, float((high - low).max()) / 2
    (left, far), (right, near) = (middle - half).tolist(), (middle + half).tolist()
    for piece in truth.objects:
        axes.fill(*_base(piece).T.numpy(), fill=False, edgecolor="#cdcdcd")
    for key, colour in COLOURS.items():
        if key in bases:
            corner = bases[key].numpy()
            axes.fill(*corner.T, fill=False, edgecolor=colour, linewidth=1.5)
            axes.plot(*corner[2:].T, color=colour, linewidth=4)
    axes.plot([left + 0.05, left + 0.55], [near - 0.1] * 2, color="black")
    axes.text(left + 0.05, near - 0.15, "0.5 m", fontsize=9)
    axes.set(xlim=(left, right), ylim=(near, far), aspect="equal")
    axes.set_title("above: before blue, after red, truth green", loc="left", fontsize=9)


def _base(piece: SceneObject) -> Float[Tensor, "4 2"]:
    """Footprint (x, z) [m]; its last two corners are at the front."""
    return corners(box_of(piece))[list(BASE)][:, [0, 2]]
