"""Bodies that a tool found: with faces, under the true lens, upright, without failed rows."""

import dataclasses
from pathlib import Path

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from mover.bodies import BodyModel, load_model
from mover.bodies.smpl_model import FLAT, HAND_POSES, Hands, SmplBody
from mover.core.errors import InputError
from mover.core.records import record
from mover.core.types import Bodies, BodyPose, Camera, Mesh
from mover.geometry.camera import pitch_roll
from mover.io.capture.pose_file import into_camera, run_model
from mover.io.files.fields import LARGEST, At, listed
from mover.io.files.meshes import read_mesh
from mover.io.formats import chosen as format_of
from mover.io.people.found import Found, Known, chosen
from mover.io.people.lens import TURNED, differs, level, mean_up, refocused

SAME = 0.01  # [m], parameters that miss the tool's own vertices by more are left out


@record
class ImportedBodies:
    """Bodies as another tool found them, in the camera frame, or upright where it has none."""

    bodies: Bodies
    K: Float[Tensor, "3 3"] | None
    """The lens under which they stand: the user's, else the one that the tool assumed [px]."""
    up: Float[Tensor, "3"] | None
    """Away from the ground, in camera axes, where the tool knows gravity."""
    warnings: tuple[str, ...]


def bodies_from(tool: str, path: Path, known: Known | None = None) -> ImportedBodies:
    """Bodies that another tool found: with meshes, under the true lens, without failed rows.

    Raises:
        InputError: If the tool is not known, its files are not as it writes them, or a body model
            is missing.
    """
    known = known or Known()
    return finish(format_of("tool", tool, "people")(Path(path), known), known, Path(path).name)


def finish(found: Found, known: Known, file: str) -> ImportedBodies:
    """Bodies of the rows that are bodies.

    Raises:
        InputError: If no row is left, a person is twice in a frame, or a needed file of a body
            model is not there.
    """
    warnings = [f"{file}: {w}" for w in found.warnings]
    found = _in_order(_sound(found, file, warnings), file)
    model = _model_of(found, known)
    found = _under_lens(_with_verts(found, model, file, warnings), known)
    assert found.verts is not None
    if not (found.verts.abs() <= LARGEST).all():
        raise InputError(f"{file}: has bodies at positions that are not finite under this lens")
    up, spread = (None, 0.0) if found.up is None else mean_up(found.up)
    if spread > TURNED:
        warnings.append(f"{file}: its gravity turns by {spread:.2f} rad: does the camera move?")
    bodies = Bodies(
        verts=found.verts,
        faces=_faces(found, model, known),
        joints=found.joints,
        joint_names=() if found.joints is None or model is None else model.joint_names,
        frame=found.frame,
        person=found.person,
        fps=known.fps or found.fps,
        space=found.space,
        pose=found.pose,
    )
    used = None if found.K is None else found.K.median(0).values
    K = used if known.camera is None else known.camera.K
    return ImportedBodies(bodies, None if K is None else K.float(), up, tuple(warnings))


def _sound(found: Found, file: str, warnings: list[str]) -> Found:
    """Without the rows in which the tool failed."""
    for key, value in (("frames", found.frame), ("tracks", found.person)):
        if (value < 0).any():
            raise InputError(f"{file}: {key} are numbered from {int(value.min())}, expected from 0")
    fine = _finite(found)
    if not fine.any():
        what = "only rows with NaN" if len(fine) else "no people"
        raise InputError(f"{file}: has {what}, expected at least one body")
    if found.K is not None and (found.K[fine][:, [0, 1], [0, 1]] <= 0).any():
        raise InputError(f"{file}: has a focal length that is not above 0")
    if not fine.all():
        bad = found.frame[~fine].tolist()
        warnings.append(f"{file}: left out NaN in {listed('frame', bad)}")
    return chosen(found, fine.nonzero()[:, 0])


def _finite(found: Found) -> Bool[Tensor, " bodies"]:
    """Rows whose numbers are finite; a translation that no row has is not needed."""
    pose = found.pose
    values = [found.verts, found.K]
    if pose is not None:
        values += [pose.betas, pose.global_orient, pose.body_pose, *pose.extra.values()]
        values += [] if pose.transl.isnan().all() else [pose.transl]
    fine = torch.ones(len(found.frame), dtype=torch.bool)
    for value in values:
        if value is not None:
            fine &= (value.flatten(1).abs() <= LARGEST).all(1)  # false for NaN as well
    return fine


def _in_order(found: Found, file: str) -> Found:
    """Sorted by frame, then by person, who may be in a frame once."""
    order = torch.argsort(found.person, stable=True)
    order = order[torch.argsort(found.frame[order], stable=True)]
    pairs = torch.stack([found.frame, found.person], 1)[order]
    twice = (pairs[1:] == pairs[:-1]).all(1)
    if twice.any():
        frame, person = pairs[1:][twice][0].tolist()
        raise InputError(f"{file}: has person {person} twice in frame {frame}, expected once")
    return chosen(found, order)


def _model_of(found: Found, known: Known) -> BodyModel | None:
    """The body model; None where the meshes and their triangles are enough without it."""
    gender = known.gender or (found.pose.gender if found.pose else "neutral")
    try:
        return None if found.pose is None else load_model(found.model, gender)
    except InputError:
        if found.verts is None or known.faces is None:
            raise
        return None


def _from_mean_hands(pose: BodyPose, hands: Hands) -> BodyPose:
    """Hands whose angles count from flat ones, counted from the mean hand as smplx does."""
    if FLAT not in pose.extra:
        return pose
    extra = {key: value for key, value in pose.extra.items() if key != FLAT}
    for side, name in enumerate(HAND_POSES):
        if name in extra:
            extra[name] = extra[name] - hands.mean[side].to(extra[name])
    return dataclasses.replace(pose, extra=extra)


def _with_verts(found: Found, model: BodyModel | None, file: str, warnings: list[str]) -> Found:
    """With the meshes of the model where the tool gives none, and only parameters that fit.

    Tools differ in what their meshes are centred about: a constant shift belongs to `transl`.
    """
    pose = found.pose
    if pose is None:
        return found
    if model is None:
        if pose.transl.isfinite().all():
            return found
        warnings.append(f"{file}: without the model '{found.model}' the parameters are left out")
        return dataclasses.replace(found, pose=None)
    if isinstance(model, SmplBody) and model.hands is not None:
        pose = _from_mean_hands(pose, model.hands)
    placed = dataclasses.replace(pose, transl=pose.transl.nan_to_num(0))
    verts, joints = run_model(model, placed)
    if found.verts is None:
        return dataclasses.replace(found, verts=verts, joints=joints)
    if verts.shape != found.verts.shape:
        n, m = found.verts.shape[1], verts.shape[1]
        raise InputError(f"{file}: has {n} vertices, the model '{found.model}' has {m}")
    shift = (found.verts - verts).mean(1)
    worst = float((verts + shift[:, None] - found.verts).norm(dim=-1).max())
    if worst <= SAME:
        placed = dataclasses.replace(placed, transl=placed.transl + shift)
        return dataclasses.replace(found, pose=placed, joints=joints + shift[:, None])
    warnings.append(
        f"{file}: the parameters miss the vertices by up to {worst:.3g} m and are left out"
    )
    return dataclasses.replace(found, pose=None)


def _under_lens(found: Found, known: Known) -> Found:
    """Moved so that each body keeps its pixels under the true lens."""
    if known.camera is None or found.K is None or found.verts is None:
        return found
    K = known.camera.K.double()
    if not differs(found.K.double(), K):
        return found
    shift = refocused(found.verts.mean(1).double(), found.K.double(), K).float()
    pose, joints = found.pose, found.joints
    if pose is not None:
        pose = dataclasses.replace(pose, transl=pose.transl + shift)
    if joints is not None:
        joints = joints + shift[:, None]
    return dataclasses.replace(found, pose=pose, joints=joints, verts=found.verts + shift[:, None])


def _faces(found: Found, model: BodyModel | None, known: Known) -> Int[Tensor, "faces 3"]:
    """Triangles of the user's file, else of the model."""
    assert found.verts is not None
    count = found.verts.shape[1]
    if known.faces is not None:
        mesh = mesh_file(known.faces)
        faces, size, where = mesh.faces, len(mesh.verts), str(known.faces)
    elif found.model == "mhr":
        raise InputError(
            f"these files have {count} vertices and no triangles: --faces names a mesh file of "
            "MHR with as many vertices"
        )
    else:
        model = model or load_model(found.model, known.gender or "neutral")
        faces, where = model.faces, f"the model '{found.model}'"
        size = int(faces.max()) + 1
    if size != count:
        raise InputError(f"{where}: has {size} vertices, the bodies have {count}")
    return faces


def mesh_file(path: Path) -> Mesh:
    """The mesh that gives the triangles."""
    if not path.is_file():
        raise InputError(f"--faces: there is no file {path}")
    return read_mesh(At(path.name, str(path)), path.parent)[0]


def attitude(up: Float[Tensor, "3"]) -> tuple[float, float]:
    """Pitch and roll of the camera that sees this as up [rad]."""
    pitch, roll = pitch_roll(level(up))
    return float(pitch), float(roll)


def in_world(found: ImportedBodies, file: str) -> Bodies:
    """The bodies in the world without heading, +y up, the camera at its origin.

    Raises:
        InputError: If the tool has no gravity.
    """
    if found.bodies.space == "world":
        return found.bodies
    if found.up is None:
        raise InputError(f"{file}: has no gravity, expected --space camera")
    R = level(found.up)
    given = dataclasses.replace(found.bodies, space="world")
    return dataclasses.replace(into_camera(given, R.mT), space="world")


def camera_from(found: ImportedBodies, known: Known) -> Camera:
    """The camera: the user's lens, else the tool's, with pitch and roll by the tool's gravity.

    Raises:
        InputError: If no lens is known.
    """
    if found.K is None:
        raise InputError("--write-camera: the tool has no lens, expected --camera as well")
    R = torch.diag(torch.tensor([1.0, -1.0, -1.0])) if found.up is None else level(found.up)
    if known.camera is not None:
        return dataclasses.replace(known.camera, R_cam_world=R)
    width, height = (round(2 * float(v)) for v in found.K[:2, 2])
    return Camera(found.K, R, width, height)
