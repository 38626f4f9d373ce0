"""Clips and terrain for tools that carry people's motion over to humanoid robots."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any
from xml.etree.ElementTree import Element, SubElement, indent, tostring

import numpy as np
import torch
from numpy.typing import NDArray

from mover.bodies.skeleton import BODY, JOINTS
from mover.core.errors import InputError
from mover.core.files import replacing
from mover.core.run import Run
from mover.core.types import Mesh
from mover.io.export.clips import RATE, PosedClip, clips_of, posed_clips_of
from mover.io.export.finished import Exported, Finished
from mover.io.export.solids import Solid, mesh_bytes, numbers, solids_of
from mover.io.files.npz import write_npz

MOCAP_STEPS = 4  # Holosoma reads every fourth row of a climb's .npy, which has 120 a second
FINGERS = ("Thumb", "Index", "Middle", "Ring", "Pinky")


def _mocap_joints() -> tuple[str, ...]:
    """Our joint for each of the 53 of Holosoma's `mocap` layout, in its order."""
    names = ["pelvis", "spine1", "spine2", "neck", "head"]
    for side in ("left", "right"):
        names += [f"{side}_{part}" for part in ("collar", "shoulder", "elbow", "wrist")]
        names += [f"{side}_{finger.lower()}{k}" for finger in FINGERS for k in (1, 2, 3)]
    for side in ("left", "right"):
        names += [f"{side}_{part}" for part in ("hip", "knee", "ankle", "foot")]
    return (*names, "left_foot", "right_foot")


MOCAP = _mocap_joints()


def export_gmr(finished: Finished, folder: Path) -> Exported:
    """Write `gmr/<person>.npz`, as GMR reads SMPL-X motions.

    Raises:
        InputError: If the parameters of the bodies are not known.
    """
    clips, files = _posed(finished, "gmr"), list[Path]()
    for posed in clips:
        files.append(folder / "gmr" / f"{posed.clip.name}.npz")
        write_npz(_smplx(posed), files[-1])
    return Exported(tuple(files), _notes(clips))


def export_amass(finished: Finished, folder: Path) -> Exported:
    """Write `amass/<person>_stageii.npz` with all keys of AMASS' SMPL-X files but the markers'.

    Raises:
        InputError: If the parameters of the bodies are not known.
    """
    clips, files = _posed(finished, "amass"), list[Path]()
    for posed in clips:
        whole = posed.angles.reshape(len(posed.angles), -1).float().numpy()
        arrays = {
            **_smplx(posed),
            "surface_model_type": np.array("smplx"),
            "mocap_time_length": np.array(len(whole) / RATE),
            "poses": whole,
            "num_betas": np.array(len(posed.betas)),
            "pose_hand": whole[:, 75:],
            "pose_jaw": whole[:, 66:69],
            "pose_eye": whole[:, 69:75],
        }
        files.append(folder / "amass" / f"{posed.clip.name}_stageii.npz")
        write_npz(arrays, files[-1])
    return Exported(tuple(files), _notes(clips))


def _posed(finished: Finished, name: str) -> tuple[PosedClip, ...]:
    clips = posed_clips_of(finished)
    if isinstance(clips, str):
        raise InputError(f"--to {name}: {clips}")
    return clips


def _smplx(posed: PosedClip) -> dict[str, NDArray[Any]]:
    return {
        "gender": np.array(posed.gender),
        "mocap_frame_rate": np.array(RATE),
        "trans": posed.trans.float().numpy(),
        "root_orient": posed.angles[:, 0].float().numpy(),
        "pose_body": posed.angles[:, 1:22].reshape(len(posed.angles), 63).float().numpy(),
        "betas": posed.betas.float().numpy(),
    }


def _notes(clips: Sequence[PosedClip]) -> tuple[str, ...]:
    notes = [f"{RATE:g} frames a second, +z is up and the floor is at 0"]
    if not all(posed.exact for posed in clips):
        notes.append(
            "the bodies are not SMPL-X's: angles, pelvis and height agree, the shape is its mean"
        )
    return tuple(notes)


def export_holosoma(finished: Finished, folder: Path) -> Exported:
    """Write `holosoma/`: a clip of 22 joints for each person, and a climb over the furniture.

    `<person>.npz` is for `--task-type robot_only --data_format smplx`; the folder `<person>` is for
    `--task-type climbing`: 53 joints 120 times a second, and the furniture as convex pieces.

    Raises:
        InputError: If the joints of the bodies are not known.
    """
    clips = clips_of(finished)
    if isinstance(clips, str):
        raise InputError(f"--to holosoma: {clips}")
    solids, files = solids_of(finished.scene, Run(finished.out)), list[Path]()
    terrain = _terrain(solids)
    for clip in clips:
        home = folder / "holosoma"
        files.append(home / f"{clip.name}.npz")
        joints = clip.joints[:, : len(BODY)].float().numpy()
        arrays = {"global_joint_positions": joints, "height": np.array(clip.height)}
        write_npz(arrays, files[-1])
        files.append(home / clip.name / f"{clip.name}.npy")
        with replacing(files[-1]) as part, part.open("wb") as stream:
            np.save(stream, _as_mocap(clip.joints))
        for name, content in terrain.items():
            with replacing(home / clip.name / name) as part:
                part.write_bytes(content)
    note = f"{RATE:g} frames a second (a climb {MOCAP_STEPS * RATE:g}), +z is up, the floor is at 0"
    scene = (
        "a climb also needs the robot's own scene file with box_assets.xml and box_body.xml in it"
    )
    return Exported(tuple(files), (note, scene))


def _as_mocap(joints: torch.Tensor) -> NDArray[np.float32]:
    """The 53 joints at 120 a second; fingers that are not known lie in the wrist."""
    places = joints[:, [JOINTS.index(name) for name in MOCAP]].clone()
    for k, name in enumerate(MOCAP):
        if bool(places[:, k].isnan().any()):
            side = name.partition("_")[0]
            places[:, k] = joints[:, JOINTS.index(f"{side}_wrist")]
    rows = places.reshape(len(places), -1).numpy()
    steps = np.arange(MOCAP_STEPS * (len(rows) - 1) + 1) / MOCAP_STEPS
    lines = [np.interp(steps, np.arange(len(rows)), column) for column in rows.T]
    return np.stack(lines, -1).reshape(len(steps), -1, 3).astype(np.float32)


def _terrain(solids: Sequence[Solid]) -> dict[str, bytes]:
    """The furniture as Holosoma has terrain: one convex piece a mesh, a link and a geom."""
    pieces = [_placed(hull, solid) for solid in solids for hull in solid.hulls]
    files = {f"box_models/box{k}.obj": mesh_bytes(p, "obj") for k, p in enumerate(pieces, 1)}
    files["multi_boxes.obj"] = mesh_bytes(_joined(pieces), "obj")
    robot = Element("robot", name="multi_boxes")
    SubElement(robot, "link", name="world")
    assets, bodies = Element("mujocoinclude"), Element("mujocoinclude")
    for k in range(1, len(pieces) + 1):
        _add_link(robot, k)
        mesh = {"name": f"box{k}", "file": f"box_models/box{k}.obj", "scale": "1 1 1"}
        SubElement(assets, "mesh", mesh)
        body = SubElement(bodies, "body", name=f"multi_boxes_box{k}_link", pos="0 0 0")
        geom = {"name": f"multi_boxes_link_{k}", "type": "mesh", "mesh": f"box{k}"}
        SubElement(body, "geom", geom, contype="1", conaffinity="1")
    trees = {"multi_boxes.urdf": robot, "box_assets.xml": assets, "box_body.xml": bodies}
    for name, tree in trees.items():
        indent(tree)
        files[name] = tostring(tree, encoding="utf-8") + b"\n"
    return files


def _add_link(robot: Element, k: int) -> None:
    link = SubElement(robot, "link", name=f"multi_boxes_link_{k}")
    for kind in ("visual", "collision"):
        shape = SubElement(SubElement(link, kind), "geometry")
        SubElement(shape, "mesh", filename=f"box_models/box{k}.obj", scale="1 1 1")
    inertial = SubElement(link, "inertial")
    SubElement(inertial, "mass", value="1")
    moments = {"ixx": "1", "iyy": "1", "izz": "1", "ixy": "0", "ixz": "0", "iyz": "0"}
    SubElement(inertial, "inertia", moments)
    joint = SubElement(robot, "joint", name=f"multi_boxes_joint_{k}", type="fixed")
    SubElement(joint, "parent", link="world")
    SubElement(joint, "child", link=f"multi_boxes_link_{k}")
    SubElement(joint, "origin", xyz=numbers((0, 0, 0)), rpy=numbers((0, 0, 0)))


def _placed(hull: Mesh, solid: Solid) -> Mesh:
    """A piece in the room."""
    yaw = torch.tensor(solid.yaw, dtype=torch.float64)
    c, s = float(yaw.cos()), float(yaw.sin())
    turn = torch.tensor([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    return Mesh(hull.verts @ turn.mT + solid.place, hull.faces)


def _joined(pieces: Sequence[Mesh]) -> Mesh:
    if not pieces:
        return Mesh(torch.zeros(0, 3, dtype=torch.float64), torch.zeros(0, 3, dtype=torch.long))
    counts = [0, *np.cumsum([len(piece.verts) for piece in pieces]).tolist()]
    faces = [piece.faces + start for piece, start in zip(pieces, counts[:-1], strict=True)]
    return Mesh(torch.cat([piece.verts for piece in pieces]), torch.cat(faces))
