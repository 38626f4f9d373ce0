"""Make a set of rooms: in parallel, resumable, with a manifest that can be compared.

Hashes of held-out rooms are part of the package (rooms/hashes): a room that another machine or
another version makes differently is found by `--check`, which also names those without a hash.
The hashes are the same on every machine: numbers are counted in tenths of a millimetre (or of a
milliradian), so that the last bits of another processor do not show. What the masks hold is not
hashed: a pixel centre may lie on an outline. Their number of pixels is kept instead and compared
with `SLACK`.
"""

import hashlib
import json
import platform
import shutil
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mover import __version__
from mover.app.batch import write_tree
from mover.app.results import write_truth
from mover.core.errors import InputError
from mover.core.files import replacing
from mover.core.observe import Observer, silent
from mover.core.records import plain
from mover.core.run import Run
from mover.core.types import Bodies, Capture, Masks, Scene
from mover.geometry.rle import area
from mover.io.capture.folder import write_capture
from mover_bench.rooms.known import KnownRoom
from mover_bench.studies.args import MakeArgs
from mover_bench.studies.job import DONE, Job, Seed, key_of, make_truth, spoilt
from mover_bench.studies.measures import Traits
from mover_bench.studies.queue import Launch, failure_of, finish, has_results, is_finished, start
from mover_bench.studies.run import parse_seeds
from mover_bench.studies.sets import SETS
from mover_bench.studies.tables import CUT, HIDDEN

THIS = "mover_bench.studies.make"
LICENCE = "CC0-1.0"  # of the rooms; the program is Apache-2.0
HASHES = Path(__file__).parents[1] / "rooms" / "hashes"
KEPT = ("truth", "capture", "pixels")  # what is compared


@dataclass(frozen=True)
class Made:
    """What came of it."""

    manifest: Path
    rows: Mapping[str, Mapping[str, Any]]
    """What is in each room, by its seed."""
    failed: Mapping[str, str]
    """Why a room could not be made, by its seed."""
    changed: Mapping[str, Sequence[str]]
    """Rooms that are not as the package knows them, and in what; empty without `check`."""
    unknown: tuple[str, ...]
    """Rooms that the package does not know; empty without `check`."""


def make_set(args: MakeArgs, observe: Observer = silent, launch: Launch | None = None) -> Made:
    """Make all rooms that are not there, then write OUT/SET/manifest.json and hashes.json.

    Raises:
        InputError: If the set or a seed is none.
    """
    if args.set not in SETS:
        raise InputError(f"SET: {args.set!r} is none of {', '.join(SETS)}")
    seeds = parse_seeds(args.seeds or SETS[args.set].seeds)
    jobs = [Job(args.set, seed, MADE, args.out) for seed in seeds]
    todo = [job for job in jobs if not is_made(job, args.captures, args.keep)]
    more = ["captures"] if args.captures else []
    finish(jobs, todo, args.workers, (observe, launch or (lambda job: start(job, THIS, *more))))
    rows = {str(job.seed): _row(job) for job in jobs if has_results(job)}
    failed = {str(job.seed): failure_of(job) for job in jobs if not has_results(job)}
    manifest = _write_manifests(args, rows, failed)
    known = known_hashes(args.set) if args.check else {}
    wrong = {seed: differences(rows[seed], known[seed]) for seed in rows if seed in known}
    return Made(
        manifest,
        rows,
        failed,
        {seed: names for seed, names in wrong.items() if names},
        tuple(seed for seed in rows if args.check and seed not in known),
    )


def known_hashes(name: str) -> dict[str, dict[str, Any]]:
    """The hashes of a set's held-out rooms that are part of the package, by seed.

    Raises:
        InputError: If the package has none for this version of the set.
    """
    path = HASHES / f"{name}.json"
    tree = json.loads(path.read_text()) if path.exists() else {}
    if tree.get("version") != SETS[name].version:
        raise InputError(f"--check: the package has no hashes of {name} {SETS[name].version}")
    return tree["rooms"]


def told(made: Made, check: bool) -> str:
    """What came of it, in words."""
    rows = list(made.rows.values())
    lines = [f"{len(rows)} rooms: {made.manifest}"]
    if rows:
        names = ("pieces", "people", "seconds", "touched", "stays", "hidden", "truncated")
        lines.append(
            "mean: " + ", ".join(f"{n} {_mean([row[n] for row in rows]):.3g}" for n in names)
        )
    lines += [f"room {seed} failed: {why}" for seed, why in made.failed.items()]
    lines += [f"room {seed} differs in {', '.join(n)}" for seed, n in made.changed.items()]
    lines += [f"room {seed}: the package does not know it" for seed in made.unknown]
    if check and not made.changed:
        lines.append(f"{len(rows) - len(made.unknown)} rooms are as the package knows them")
    return "\n".join(lines)


def _row(job: Job) -> dict[str, Any]:
    row = json.loads((job.folder / DONE).read_text())
    return {name: value for name, value in row.items() if name != "key"}


def _write_manifests(
    args: MakeArgs, rows: Mapping[str, Mapping[str, Any]], failed: Mapping[str, str]
) -> Path:
    """The whole manifest, and the hashes alone as the package holds them; returns the former."""
    rooms, folder = SETS[args.set], args.out / args.set
    about = {"format": "mover-rooms", "set": args.set, "version": rooms.version}
    means = {n: _mean([row[n] for row in rows.values()]) for n in _numbers(rows)}
    tree = {
        **about,
        "about": rooms.about,
        "licence": LICENCE,
        "held_out": rooms.seeds,
        "development": rooms.development,
        "room": plain(rooms.room),
        "noise": plain(rooms.noise),
        "made_by": {
            "mover": __version__,
            "python": platform.python_version(),
            "torch": torch.__version__,
            "machine": f"{platform.system()} {platform.machine()}",
        },
        "mean": means,
        "rooms": rows,
        "failed": failed,
    }
    hashes = {**about, "rooms": {s: {n: row[n] for n in KEPT} for s, row in rows.items()}}
    for name, content in (("manifest.json", tree), ("hashes.json", hashes)):
        with replacing(folder / name) as part:
            part.write_text(json.dumps(content, indent=1) + "\n")
    return folder / "manifest.json"


def _numbers(rows: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Names of what has a mean."""
    first = next(iter(rows.values()), {})
    return [n for n, v in first.items() if isinstance(v, int | float)]


STEP = 1e-4  # [m], [rad]
SHIFT = 0.318  # of the counts: round figures lie far from where a count changes
SLACK = 1e-3  # share of the pixels of masks by which machines may differ


def truth_hash(room: KnownRoom) -> str:
    """Of the true scene, the true people, and what they do."""
    return _hash([*_scene(room.truth), list(room.actions), *_bodies(room.bodies)])


def capture_hash(capture: Capture) -> str:
    """Of what a method is given: scene, detections, people."""
    found = [[d.id, d.category, d.score] for d in capture.detections]
    boxes = [d.box for d in capture.detections]
    bodies = [] if capture.bodies is None else _bodies(capture.bodies)
    people = capture.people
    rows = [] if people is None else [people.frame.tolist(), people.person.tolist()]
    return _hash([*_scene(capture.scene), found, *boxes, *bodies, *rows])


def mask_pixels(capture: Capture) -> list[int]:
    """Pixels of all masks of objects, and of all masks of people."""
    objects = [_count(d.mask) for d in capture.detections if d.mask is not None]
    return [sum(objects), 0 if capture.people is None else _count(capture.people.masks)]


def differences(found: Mapping[str, Any], expected: Mapping[str, Any]) -> list[str]:
    """In which of `truth`, `capture` and `pixels` a room is another than it should be."""
    wrong = [name for name in ("truth", "capture") if found[name] != expected[name]]
    pixels = zip(found["pixels"], expected["pixels"], strict=True)
    return wrong + ["pixels"] * any(abs(a - b) > SLACK * max(a, b) for a, b in pixels)


def _scene(scene: Scene) -> list[Any]:
    camera = scene.camera
    parts: list[Any] = [camera.width, camera.height, camera.K, camera.R_cam_world, scene.ground]
    for piece in scene.objects:
        parts += [piece.id, piece.category, piece.support, piece.annotation, piece.t_world_object,
                  piece.yaw, piece.scale, piece.mesh.verts, piece.mesh.faces]  # fmt: skip
    return parts


def _bodies(bodies: Bodies) -> list[Any]:
    assert bodies.pose is not None, "bodies of known rooms have parameters"
    pose = bodies.pose
    return [bodies.fps, bodies.frame, bodies.person, pose.betas, pose.global_orient,
            pose.body_pose, pose.transl]  # fmt: skip


def _count(masks: Masks) -> int:
    return sum(area(masks, row) for row in range(len(masks.counts)))


def _hash(parts: Sequence[Any]) -> str:
    digest = hashlib.sha256()
    for part in parts:
        value: Any = part
        if isinstance(part, Tensor):
            value = part.detach().cpu().numpy()
        elif isinstance(part, float):
            value = np.array(part)
        if isinstance(value, np.ndarray):
            if value.dtype.kind == "f":
                value = np.floor(value.astype(np.float64) / STEP + SHIFT)
            digest.update(f"{value.shape}".encode())
            digest.update(np.ascontiguousarray(value.astype("<i8")).tobytes())
        else:
            digest.update(json.dumps(value).encode())
    return digest.hexdigest()[:16]


# One room: a process of its own with one thread, `make SET SEED made FOLDER [captures]`.


MADE = "made"  # the job that makes a room of a set; its results are the room's row of the manifest
CAPTURE = "capture"  # folder of the files for other tools; its `truth` holds the truth


def is_made(job: Job, captures: bool, keep: bool) -> bool:
    """Whether a room is there, of this version unless others are taken as well."""
    there = not captures or (job.home / CAPTURE / "truth" / "scene.json").exists()
    return there and is_finished(job, keep)


def make_one(job: Job, captures: bool) -> None:
    """Make a room and write its row and, where asked for, its files."""
    rooms = SETS[job.rooms]
    room = Run(job.truths).stage(make_truth, Seed(job.seed), rooms.room)
    trial = spoilt(room, job.seed, rooms)
    if captures:
        folder = job.home / CAPTURE
        shutil.rmtree(folder, ignore_errors=True)
        write_capture(trial.capture, folder)
        write_truth(room.truth, room.bodies, folder / "truth")
    row = {"key": key_of(job), "version": __version__, **row_of(room, trial.capture, trial.traits)}
    write_tree(job.folder / DONE, row)


def row_of(room: KnownRoom, capture: Capture, traits: Sequence[Traits]) -> dict[str, Any]:
    """The hashes of a room, and what is in it."""
    true = {piece.id for piece in room.truth.objects}
    given = {piece.id for piece in capture.scene.objects}
    frames = int(room.bodies.frame.max()) + 1
    counts = {
        "pieces": len(true),
        "people": len(room.bodies.person.unique()),
        "frames": frames,
        "seconds": frames / (room.bodies.fps or 1.0),
        "touched": sum(t.touched for t in traits),
        "stays": sum(t.stays for t in traits),
        "hidden": sum(t.hidden >= HIDDEN for t in traits),
        "truncated": sum(t.truncated >= CUT for t in traits),
        "flipped": sum(t.flipped for t in traits),
        "missed": len(true - given),
        "false": len(given - true),
    }
    shares = {
        "mean_hidden": _mean([t.hidden for t in traits]),
        "mean_truncated": _mean([t.truncated for t in traits]),
        "bodies_behind_furniture": _mean(room.passing.tolist()),
        "bodies_touching_furniture": _mean((room.touched >= 0).any(1).tolist()),
    }
    hashes = {"truth": truth_hash(room), "capture": capture_hash(capture)}
    return {
        **hashes,
        "pixels": mask_pixels(capture),
        **counts,
        **shares,
        "refused": list(room.refused),
    }


def _mean(values: Sequence[float]) -> float:
    return round(sum(values) / max(1, len(values)), 4)


def main(arguments: Sequence[str]) -> None:
    """Make the room that is named on the command line."""
    rooms, seed, name, out, *rest = arguments
    torch.set_num_threads(1)
    make_one(Job(rooms, int(seed), name, Path(out)), captures=rest == ["captures"])


if __name__ == "__main__":
    main(sys.argv[1:])
