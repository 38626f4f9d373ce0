"""Bodies that a tool found: with faces, under the true lens, without failed rows."""

import dataclasses
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from mover.bodies import BodyModel, load_model, run_model
from mover.bodies.skinning import FLAT, HAND_POSES, SkinnedBody
from mover.core.errors import InputError
from mover.core.records import record
from mover.core.types import Bodies, BodyPose
from mover.io.capture.pose_file import NEEDED
from mover.io.capture.tracks import join_pieces, renumbered, seen_at
from mover.io.files.fields import LARGEST, At, listed
from mover.io.files.meshes import read_mesh
from mover.io.formats import chosen as format_of
from mover.io.people.cameras import refocused
from mover.io.people.found import UNTRACKED, Found, Known, followed
from mover.io.people.values import named


@record
class ImportedBodies:
    """Bodies as another tool found them, in the camera frame, or in its world without a camera."""

    bodies: Bodies
    K: Float[Tensor, "3 3"] | None
    """The lens under which they stand: the user's, else the one that the tool assumed [px]."""
    warnings: tuple[str, ...]


def bodies_from(tool: str, path: Path, known: Known | None = None) -> ImportedBodies:
    """Bodies that another tool found: with meshes, under the true lens, without failed rows.

    Raises:
        InputError: If the tool is not known, its files are not as it writes them, no row is left,
            a person is twice in a frame, or a file of a body model is missing.
    """
    known, path = known or Known(), named(Path(path))
    found: Found = format_of("tool", tool, "people")(path, known)
    file = path.name
    warnings = [f"{file}: {text}" for text in found.warnings]
    found = _tracked(_sound(found, file, warnings), known, file, warnings)
    found = _in_order(found, file)
    values, model, pose, joints = found.values, None, None, None
    verts, lens = values.get("verts"), None if known.camera is None else known.camera.K.float()
    if verts is None:
        model = load_model(found.model, found.gender)
        pose = _posed_as(model, found)
        try:
            verts, joints = run_model(model, pose)
        except InputError as error:
            raise InputError(f"{file}: {error}") from error
    if known.camera is not None and "K" in values:
        used, true = values["K"].double(), known.camera.K.double()
        shift = refocused(verts.mean(1).double(), used, true).float()
        verts, joints = verts + shift[:, None], None if joints is None else joints + shift[:, None]
        pose = pose and dataclasses.replace(pose, transl=pose.transl + shift)
    elif "K" in values:
        lens = values["K"].median(0).values
    if not (verts.abs() <= LARGEST).all():
        raise InputError(f"{file}: has bodies at positions that are not finite under this lens")
    bodies = Bodies(
        verts=verts, faces=_faces(verts.shape[1], model, known), joints=joints,
        joint_names=() if model is None else model.joint_names, frame=values["frame"],
        person=values["person"], fps=known.fps or found.fps, space=found.space, pose=pose,
    )  # fmt: skip
    return ImportedBodies(bodies, lens, tuple(warnings))


def _sound(found: Found, file: str, warnings: list[str]) -> Found:
    """Without the rows in which the tool failed."""
    for key, name in (("frames", "frame"), ("tracks", "person")):
        first = int(found.values[name].min())
        if first < (UNTRACKED if name == "person" else 0):
            raise InputError(f"{file}: {key} are numbered from {first}, expected from 0")
    fine = torch.stack(  # false for NaN as well
        [(value.flatten(1).abs() <= LARGEST).all(1) for value in found.values.values()
         if value.ndim > 1]
    ).all(0)  # fmt: skip
    if not fine.any():
        raise InputError(f"{file}: has only rows with NaN, expected at least one body")
    if "K" in found.values and (found.values["K"][fine][:, [0, 1], [0, 1]] <= 0).any():
        raise InputError(f"{file}: has a focal length that is not above 0")
    if not fine.all():
        bad = found.values["frame"][~fine].tolist()
        warnings.append(f"{file}: left out NaN in {listed('frame', bad)}")
    return found.chosen(fine.nonzero()[:, 0])


def _tracked(found: Found, known: Known, file: str, warnings: list[str]) -> Found:
    """With one track for each person: of people in pieces, and of those whom no tool follows."""
    values, person, frame = found.values, found.values["person"], found.values["frame"]
    place = values["verts"].mean(1) if "verts" in values else values["transl"]
    if (person == UNTRACKED).all() and len(frame.unique()) < len(frame):
        at = seen_at(place, found.space).numpy()
        person = torch.from_numpy(followed(frame.tolist(), at, at[:, -1]))
        warnings.append(f"{file}: has no tracks, so people are followed by their positions")
    person = renumbered(person.clamp_min(0), known.tracks)
    if found.space == "camera":
        numbers, notes = join_pieces(frame, person, place, values.get("betas"))
        person = renumbered(person, numbers)
        warnings += [f"{file}: {note}" for note in notes]
    return dataclasses.replace(found, values={**values, "person": person})


def _in_order(found: Found, file: str) -> Found:
    """Sorted by frame, then by person, who may be in a frame once."""
    frame, person = found.values["frame"], found.values["person"]
    order = torch.from_numpy(np.lexsort((person, frame)))
    pairs = torch.stack([frame, person], 1)[order]
    twice = (pairs[1:] == pairs[:-1]).all(1)
    if twice.any():
        when, who = pairs[1:][twice][0].tolist()
        raise InputError(f"{file}: has person {who} twice in frame {when}, expected once")
    return found.chosen(order)


def _posed_as(model: BodyModel, found: Found) -> BodyPose:
    """The parameters; hands whose angles count from flat ones count from the mean hand."""
    extra = dict(found.values)
    needed = {name: extra.pop(name) for name in NEEDED}
    for name in ("frame", "person", "K"):
        extra.pop(name, None)
    if isinstance(model, SkinnedBody) and model.hands is not None and FLAT in extra:
        del extra[FLAT]
        for side, name in enumerate(HAND_POSES):
            if name in extra:
                extra[name] = extra[name] - model.hands.mean[side].to(extra[name])
    return BodyPose(model=found.model, gender=found.gender, **needed, extra=extra)


def _faces(count: int, model: BodyModel | None, known: Known) -> Int[Tensor, "faces 3"]:
    """Triangles of the user's file, else of the model."""
    if known.faces is not None:
        if not known.faces.is_file():
            raise InputError(f"--faces: there is no file {known.faces}")
        mesh, _ = read_mesh(At(known.faces.name, str(known.faces)), known.faces.parent)
        if (n := len(mesh.verts)) != count:
            raise InputError(f"{known.faces}: has {n} vertices, the bodies have {count}")
        return mesh.faces
    if model is None:
        raise InputError(
            f"these files have {count} vertices and no triangles: --faces names a mesh file of "
            "MHR with as many vertices"
        )
    return model.faces
