"""scene.glb: objects as nodes, floor, camera, and people who move on bones or by shapes."""

from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from mover.bodies.skinning import SkinnedBody
from mover.core.colours import Colour, person_colour
from mover.core.types import Bodies, SceneObject
from mover.geometry.mesh import vertex_normals
from mover.io.export.finished import BodyForm, Exported, Finished
from mover.io.export.gltf import (
    INDICES,
    VERTICES,
    Channel,
    Document,
    add_material,
    add_presence,
    add_sampler,
    add_stays,
)
from mover.io.export.people import FPS, Track, keyframes, tracks_of
from mover.io.export.posed import Skin, all_angles, bones_for, quaternions, rest_of
from mover.io.export.scene_glb import write_glb

TOLERANCE = 0.005  # [m]
MOST = 60  # shapes of one person


def add_morphing(
    document: Document, animation: int, bodies: Bodies, track: Track, tint: Colour
) -> tuple[list[Channel], float]:
    """Append a person; what moves, and how far the shapes between miss the truth [m]."""
    verts = bodies.verts[track.rows].detach().cpu().float()
    keys, miss = keyframes(verts, track.time, TOLERANCE, MOST)
    name = f"person_{track.person}"
    shapes = verts[keys]
    mesh = _add_shapes(document, shapes, bodies, add_material(document, tint, name), name)
    body = document.add("nodes", {"name": f"{name}_body", "mesh": mesh})
    node = document.add("nodes", {"name": name, "children": [body]})
    document.add_root(node)
    channels = add_presence(document, animation, node, track)
    if len(keys) > 1:
        times = document.add_array(track.time[keys].numpy().astype(np.float32), bounds=True)
        weights = np.eye(len(keys), dtype=np.float32)[:, 1:].reshape(-1)
        channels.append((add_sampler(document, animation, times, weights), body, "weights"))
    return channels, miss


def _add_shapes(
    document: Document,
    shapes: Float[Tensor, "keys verts 3"],
    bodies: Bodies,
    material: int,
    name: str,
) -> int:
    """A mesh with its first shape and the way to each of the others."""
    normals = _normals(shapes, bodies)
    faces = bodies.faces.cpu().numpy().astype(np.uint32).reshape(-1)
    targets = [
        {
            "POSITION": document.add_array(_moved(shapes, key), VERTICES, bounds=True),
            "NORMAL": document.add_array(_moved(normals, key), VERTICES),
        }
        for key in range(1, len(shapes))
    ]
    primitive: dict[str, Any] = {
        "attributes": {
            "POSITION": document.add_array(shapes[0].numpy(), VERTICES, bounds=True),
            "NORMAL": document.add_array(normals[0].numpy(), VERTICES),
        },
        "indices": document.add_array(faces, INDICES),
        "material": material,
    }
    mesh: dict[str, Any] = {"name": name, "primitives": [primitive]}
    if targets:
        primitive["targets"] = targets
        mesh["weights"] = [0.0] * len(targets)
    return document.add("meshes", mesh)


def _moved(values: Float[Tensor, "keys verts 3"], key: int) -> NDArray[np.float32]:
    return (values[key] - values[0]).numpy()


def _normals(
    shapes: Float[Tensor, "keys verts 3"], bodies: Bodies
) -> Float[Tensor, "keys verts 3"]:
    """Unit normals; up at vertices that no face uses."""
    found = vertex_normals(shapes, bodies.faces.cpu())
    up = torch.tensor([0.0, 1.0, 0.0])
    return torch.where(found.norm(dim=-1, keepdim=True) > 0.5, found, up)


# A body that moves on the bones of its model.


INFLUENCES = 4  # joints that move a vertex: what every viewer draws
STILL = 1e-6  # [rad], [m]; what moves less is not animated


def add_skinned(
    document: Document, animation: int, skin: Skin, track: Track, tint: Colour
) -> list[Channel]:
    """Append a person: mesh, bones and their motion; what moves."""
    model, name = skin.model, f"person_{track.person}"
    rest, joints = rest_of(skin, int(track.rows[0]))
    bones = _add_bones(document, model, joints)
    top = document.add("nodes", {"name": name, "children": [bones[0]]})
    document.add_root(top)
    mesh = _add_skin_mesh(document, model, rest, add_material(document, tint, name), name)
    inverse = document.add_array(_inverse_bind(model, joints))
    bind = document.add("skins", {"joints": bones, "inverseBindMatrices": inverse, "name": name})
    document.add_root(document.add("nodes", {"name": f"{name}_body", "mesh": mesh, "skin": bind}))
    channels = add_presence(document, animation, top, track)
    return channels + _move(document, animation, skin, track, (bones, joints[0]))


def _add_bones(
    document: Document, model: SkinnedBody, joints: Float[Tensor, "joints 3"]
) -> list[int]:
    """A node for each joint, at its place in its parent; the indices."""
    first = len(document.tree["nodes"])
    for joint, parent in enumerate(model.parents):
        node: dict[str, Any] = {"name": model.joint_names[joint]}
        below = [first + k for k, p in enumerate(model.parents) if p == joint]
        if below:
            node["children"] = below
        if parent >= 0:
            bone = model.tpose[parent] @ (joints[joint] - joints[parent])
            node["translation"] = bone.tolist()
        document.add("nodes", node)
    return list(range(first, first + len(model.parents)))


def _inverse_bind(model: SkinnedBody, joints: Float[Tensor, "joints 3"]) -> NDArray[np.float32]:
    """From the rest shape to the axes of each joint, by columns."""
    matrix = torch.eye(4).repeat(len(joints), 1, 1)
    matrix[:, :3, :3] = model.tpose
    matrix[:, :3, 3] = -(model.tpose @ joints[..., None])[..., 0]
    return matrix.mT.contiguous().numpy()


def _add_skin_mesh(
    document: Document,
    model: SkinnedBody,
    rest: Float[Tensor, "verts 3"],
    material: int,
    name: str,
) -> int:
    """The rest shape with its weights; joints without a share are number 0."""
    share, joint = model.weights.topk(INFLUENCES, dim=1)
    joint = torch.where(share > 0, joint, 0)
    normals = vertex_normals(rest, model.faces)
    faces = model.faces.numpy().astype(np.uint32).reshape(-1)
    attributes = {
        "POSITION": document.add_array(rest.numpy(), VERTICES, bounds=True),
        "NORMAL": document.add_array(normals.numpy(), VERTICES),
        "JOINTS_0": document.add_array(joint.numpy().astype(np.uint8), VERTICES),
        "WEIGHTS_0": document.add_array(share.numpy(), VERTICES),
    }
    primitive = {
        "attributes": attributes,
        "indices": document.add_array(faces, INDICES),
        "material": material,
    }
    return document.add("meshes", {"name": name, "primitives": [primitive]})


def _move(
    document: Document,
    animation: int,
    skin: Skin,
    track: Track,
    root: tuple[list[int], Float[Tensor, "3"]],
) -> list[Channel]:
    """Turns of all joints, and the place and size of the pelvis."""
    bones, pelvis = root
    times = document.add_array(track.time.numpy().astype(np.float32), bounds=True)
    place = (skin.motion.pose.transl[track.rows] + pelvis).numpy()
    size = skin.motion.size[track.rows, None].expand(-1, 3).contiguous().numpy()
    turns = quaternions(all_angles(skin.motion.pose)[track.rows])
    moving = [(bones[0], "translation", place), (bones[0], "scale", size)]
    moving += [(bone, "rotation", turns[:, k]) for k, bone in enumerate(bones)]
    channels: list[Channel] = []
    for node, path, values in moving:
        if np.ptp(values, axis=0).max() < STILL:
            document.tree["nodes"][node][path] = values[0].tolist()
        else:
            values = np.ascontiguousarray(values, dtype=np.float32)
            channels.append((add_sampler(document, animation, times, values), node, path))
    return channels


# The file with everything in it.


FAR_OFF = 0.01  # [m]


def export_glb(finished: Finished, folder: Path, body: BodyForm = "auto") -> Exported:
    """Write the room with moving people as one binary glTF file.

    Args:
        finished: The result.
        folder: Where `scene.glb` goes.
        body: How people move: on the bones of their model (skin: small, a copy within 2 cm), by
            shapes of chosen frames (morph: those are exact), or not at all (none); auto: on bones
            where the parameters are known.

    Raises:
        InputError: If bones are asked for and there are none.
    """
    path = write_glb(finished.scene, None, folder / "scene.glb")
    bodies = None if body == "none" else finished.bodies
    moved = [piece for piece in finished.scene.objects if piece.segments]
    if bodies is None and not moved:
        return Exported((path,), ("no people",))
    document = Document(path.read_bytes())
    animation = document.add("animations", {"name": "motion", "channels": [], "samplers": []})
    first, step = 0, 1 / FPS
    if finished.bodies is not None and len(finished.bodies.frame):
        first, step = int(finished.bodies.frame.min()), 1 / (finished.bodies.fps or FPS)
    notes = [f"frame {first} of the video is at 0 s, each next one {step:g} s later"]
    channels = [c for p in moved for c in add_stays(document, animation, p, first, step)]
    notes += [f"{piece.id} {_way(piece)}" for piece in moved]
    if bodies is None:
        notes.append("no people")
    else:
        added, said = _add_people(document, animation, finished, body)
        channels, notes = channels + added, notes + said
    _connect(document, animation, channels)
    document.write(path)
    return Exported((path,), tuple(notes))


def _way(piece: SceneObject) -> str:
    """How an object comes from one place to the next."""
    held = any(segment.mover is not None for segment in piece.segments)
    return "moves with who moves it, a step a frame" if held else "jumps where it is moved"


def _add_people(
    document: Document, animation: int, finished: Finished, body: BodyForm
) -> tuple[list[Channel], list[str]]:
    """Append everybody; what moves, and what there is to say about it.

    Raises:
        InputError: If bones are asked for and there are none.
    """
    bodies = finished.bodies
    assert bodies is not None
    skin = bones_for(finished, body, INFLUENCES)
    channels: list[Channel] = []
    notes: list[str] = []
    if isinstance(skin, str):
        notes += [] if body == "morph" else [f"people move by shapes, not on bones: {skin}"]
    else:
        notes.append(f"people move on bones, at most {1e3 * skin.miss:.0f} mm off the result")
    for track in tracks_of(bodies):
        tint = person_colour(track.person)
        if isinstance(skin, str):
            moved, miss = add_morphing(document, animation, bodies, track, tint)
            if miss > FAR_OFF:
                notes.append(f"person {track.person}: up to {100 * miss:.1f} cm off between shapes")
        else:
            moved = add_skinned(document, animation, skin, track, tint)
        channels += moved
    return channels, notes


def _connect(document: Document, animation: int, channels: list[Channel]) -> None:
    """Fill the animation: which sampler moves which property of which node."""
    animations = document.tree["animations"]
    if not channels:
        del document.tree["animations"]
        return
    animations[animation]["channels"] = [
        {"sampler": sampler, "target": {"node": node, "path": path}}
        for sampler, node, path in channels
    ]
