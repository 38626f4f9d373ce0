"""Make one room of a set: its hashes, what is in it, and the files for other tools.

A process of its own with one thread:
`python -m mover_bench.studies.made SET SEED FOLDER [captures]`.
The hashes are the same on every machine: numbers are counted in tenths of a millimetre (or of a
milliradian), so that the last bits of another processor do not show. What the masks hold is not
hashed: a pixel centre may lie on an outline. Their number of pixels is kept instead and compared
with `SLACK`.
"""

import hashlib
import json
import shutil
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from mover import __version__
from mover.app.batch.runner import read_tree, write_tree
from mover.core import records
from mover.core.run import Run, sources
from mover.core.types import Bodies, Capture, Masks, Scene
from mover.geometry.rle import decode
from mover.io.capture.bodies_file import write_bodies
from mover.io.capture.folder import write_capture
from mover.io.capture.scene_file import write_scene
from mover_bench.rooms.known import KnownRoom
from mover_bench.studies.job import DONE, Job, Seed, make_truth, spoilt
from mover_bench.studies.measures import Traits
from mover_bench.studies.sets import SETS
from mover_bench.studies.tables import CUT, HIDDEN

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
    return sum(int(decode(masks, row).sum()) for row in range(len(masks.counts)))


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


# Make one room of a set: its hashes, what is in it, and the files for other tools.
#
# A process of its own with one thread:
# `python -m mover_bench.studies.made SET SEED FOLDER [captures]`.


MADE = "made"  # the job that makes a room of a set; its results are the room's row of the manifest
CAPTURE = "capture"  # folder of the files for other tools; its `truth` holds the truth


def key_of(job: Job) -> str:
    """Digest of everything that a room depends on."""
    rooms = SETS[job.rooms]
    return records.fingerprint(
        rooms.room, rooms.noise, rooms.version, job.seed, sources("mover_bench")
    )


def is_made(job: Job, captures: bool, keep: bool) -> bool:
    """Whether a room is there, of this version unless others are taken as well."""
    found = read_tree(job.folder / DONE)
    there = not captures or (job.home / CAPTURE / "truth" / "scene.json").exists()
    return there and bool(found) and (keep or found.get("key") == key_of(job))


def make_one(job: Job, captures: bool) -> None:
    """Make a room and write its row and, where asked for, its files."""
    rooms = SETS[job.rooms]
    room = Run(job.truths).stage(make_truth, Seed(job.seed), rooms.room)
    trial = spoilt(room, job.seed, rooms)
    if captures:
        folder = job.home / CAPTURE
        shutil.rmtree(folder, ignore_errors=True)
        write_capture(trial.capture, folder)
        write_bodies(room.bodies, folder / "truth" / "bodies.npz")
        write_scene(room.truth, folder / "truth" / "scene.json")
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
    rooms, seed, out, *rest = arguments
    torch.set_num_threads(1)
    make_one(Job(rooms, int(seed), MADE, Path(out)), captures=rest == ["captures"])


if __name__ == "__main__":
    main(sys.argv[1:])
