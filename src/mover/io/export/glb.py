"""scene.glb with one animation: people on the bones of their model or by shapes, moved objects."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from mover.core.colours import person_colour
from mover.core.types import Bodies, SceneObject
from mover.geometry.mesh import vertex_normals
from mover.io.export.finished import BodyForm, Exported, Finished, Track, keyframes, tracks_of
from mover.io.export.posed import Skinned, all_angles, bones_for, rest_of
from mover.io.export.scene_glb import linear, losses_of, placement_of, write_glb

TOLERANCE = 0.005  # [m], of the straight lines between two shapes
MOST = 60  # shapes of one person
FAR_OFF = 0.01  # [m], of the lines between so many shapes; it is said
INFLUENCES = 4  # joints that move a vertex: what every viewer draws
STILL = 1e-6  # [rad], [m]; what moves less is not animated
KINDS = {"float32": 5126, "uint32": 5125, "uint8": 5121}
SHAPES = {(): "SCALAR", (3,): "VEC3", (4,): "VEC4", (4, 4): "MAT4"}


def export_glb(finished: Finished, folder: Path, body: BodyForm = "auto") -> Exported:
    """Write the room with moving people as `scene.glb`.

    People move on the bones of their model (skin: small, a copy within 2 cm), by shapes of chosen
    frames (morph: those are exact), or not at all (none); auto: on bones where these are known.

    Raises:
        InputError: If bones are asked for and there are none.
    """
    scene, bodies = finished.scene, None if body == "none" else finished.bodies
    moved = [item for item in scene.objects if item.segments]
    skin = bones_for(finished, body, INFLUENCES)
    first, fps = finished.clock
    notes = losses_of(scene)
    if bodies is not None or moved:
        notes.append(f"frame {first} of the video is at 0 s, each next one {1 / fps:g} s later")
    for item in moved:
        held = any(segment.mover is not None for segment in item.segments)
        way = "moves with the person who moves it, a step a frame"
        notes.append(f"{item.id} {way if held else 'jumps where it is moved'}")
    if bodies is None:
        notes.append("no people")
    elif isinstance(skin, Skinned):
        notes.append(f"people move on bones, at most {1e3 * skin.miss:.0f} mm off the result")
    elif body != "morph":
        notes.append(f"people move by shapes, not on bones: {skin}")

    def append(blocks: dict[Any, bytes], tree: dict[str, Any]) -> None:
        file = Gltf(blocks, tree)
        for item in moved:
            _add_stays(file, item, first, 1 / fps)
        if bodies is not None:
            notes.extend(_add_people(file, bodies, skin))
        if file.channels:
            motion = {"name": "motion", "channels": file.channels, "samplers": file.samplers}
            tree["animations"] = [motion]

    return Exported((write_glb(scene, None, folder / "scene.glb", append),), tuple(notes))


def _add_people(file: "Gltf", bodies: Bodies, skin: Skinned | str) -> list[str]:
    """Append all people; what there is to say about them."""
    notes: list[str] = []
    for track in tracks_of(bodies):
        if isinstance(skin, Skinned):
            _add_skinned(file, skin, track)
        elif (miss := _add_morphing(file, bodies, track)) > FAR_OFF:
            notes.append(f"person {track.person}: up to {100 * miss:.1f} cm off between shapes")
    return notes


class Gltf:
    """A glTF tree and its blocks of bytes, to which nodes, arrays and one animation are added."""

    def __init__(self, blocks: dict[Any, bytes], tree: dict[str, Any]) -> None:
        self.blocks, self.tree = blocks, tree
        self.channels, self.samplers = list[dict[str, Any]](), list[dict[str, Any]]()

    def add(self, key: str, value: Mapping[str, Any]) -> int:
        """Append to a list of the tree; the index."""
        found = self.tree.setdefault(key, [])
        found.append(dict(value))
        return len(found) - 1

    def add_root(self, node: Mapping[str, Any]) -> int:
        """A node at the top of the scene."""
        index = self.add("nodes", node)
        self.tree["scenes"][0]["nodes"].append(index)
        return index

    def add_array(self, array: NDArray[Any]) -> int:
        """Append an accessor of one item a row, matrices by columns; the index."""
        raw, key = np.ascontiguousarray(array).tobytes(), f"moving_{len(self.blocks)}"
        self.blocks[key] = raw + bytes(-len(raw) % 4)
        accessor: dict[str, Any] = {
            "bufferView": len(self.blocks) - 1, "componentType": KINDS[str(array.dtype)],
            "count": len(array), "type": SHAPES[array.shape[1:]],
        }  # fmt: skip
        if array.ndim < 3:
            flat = array.reshape(len(array), -1)
            accessor |= {"min": flat.min(0).tolist(), "max": flat.max(0).tolist()}
        self.tree["accessors"][key] = accessor
        return len(self.tree["accessors"]) - 1

    def add_mesh(
        self,
        name: str,
        person: int,
        arrays: Mapping[str, Tensor],
        faces: Tensor,
        targets: Sequence[Mapping[str, int]] = (),
    ) -> int:
        """Append a mesh of attributes in the colour of a person, with shapes that it morphs to."""
        surface: dict[str, Any] = {"metallicFactor": 0.0, "roughnessFactor": 0.9}
        surface["baseColorFactor"] = [*linear(person_colour(person)), 1.0]
        primitive: dict[str, Any] = {
            "attributes": {key: self.add_array(array.numpy()) for key, array in arrays.items()},
            "indices": self.add_array(faces.cpu().numpy().astype(np.uint32).reshape(-1)),
            "material": self.add("materials", {"name": name, "pbrMetallicRoughness": surface}),
        }
        mesh: dict[str, Any] = {"name": name, "primitives": [primitive]}
        if targets:
            primitive["targets"], mesh["weights"] = targets, [0.0] * len(targets)
        return self.add("meshes", mesh)

    def animate(
        self, node: int, path: str, times: int, values: NDArray[Any], way: str = "LINEAR"
    ) -> None:
        """Let a property of a node have these values at the times of an accessor."""
        output = self.add_array(np.asarray(values, np.float32))
        self.samplers.append({"input": times, "output": output, "interpolation": way})
        target = {"node": node, "path": path}
        self.channels.append({"sampler": len(self.samplers) - 1, "target": target})


def _add_presence(file: Gltf, node: int, track: Track) -> None:
    """Hide a person who is not visible: a node of size zero is not drawn (glTF, Sec. 3.6)."""
    events: dict[float, float] = {0.0: 0.0}
    step = float(track.time.diff().min()) if len(track.time) > 1 else 0.2
    for start, end in track.spans():
        events[start] = 1.0
        if end < track.last - 1e-6:
            events[end + step] = 0.0
    if set(events.values()) != {1.0}:
        when = sorted(events)
        times = file.add_array(np.array(when, np.float32))
        file.animate(node, "scale", times, np.array([[events[t]] * 3 for t in when]), "STEP")


def _add_stays(file: Gltf, item: SceneObject, first: int, step: float) -> None:
    """Let an object jump from segment to segment; frame `first` is at 0 s, a frame lasts `step`."""
    wanted = placement_of(item).T.reshape(-1)
    node = next(
        index for index, node in enumerate(file.tree["nodes"])
        if node.get("name", "").rstrip("_") == item.id.rstrip("_")
        and np.allclose(node.get("matrix", np.eye(4).reshape(-1)), wanted, atol=1e-6)
    )  # fmt: skip
    stays = {max(0.0, (s.frame - first) * step): s for s in item.segments}
    times = file.add_array(np.array(list(stays), np.float32))
    half = np.array([float(yaw) / 2 for yaw in (item.yaw, *(s.yaw for s in stays.values()))])
    turns = np.stack([0 * half, np.sin(half), 0 * half, np.cos(half)], 1)
    file.tree["nodes"][node].pop("matrix", None)
    file.tree["nodes"][node] |= {
        "translation": item.t_world_object.tolist(), "scale": item.scale.tolist(),
        "rotation": turns[0].tolist(),
    }  # fmt: skip
    positions = np.array([s.t_world_object.tolist() for s in stays.values()])
    file.animate(node, "translation", times, positions, "STEP")
    file.animate(node, "rotation", times, turns[1:], "STEP")


def _add_morphing(file: Gltf, bodies: Bodies, track: Track) -> float:
    """Append a person who moves by shapes; how far those between key frames are off [m]."""
    verts = bodies.verts[track.rows].detach().cpu().float()
    keys, miss = keyframes(verts, track.time, TOLERANCE, MOST)
    shapes, name = verts[keys], f"person_{track.person}"
    normals = vertex_normals(shapes, bodies.faces.cpu())
    up = torch.tensor([0.0, 1.0, 0.0])  # at vertices that no face uses
    normals = torch.where(normals.norm(dim=-1, keepdim=True) > 0.5, normals, up)
    first = {"POSITION": shapes[0], "NORMAL": normals[0]}
    targets = [
        {
            "POSITION": file.add_array((shapes[k] - shapes[0]).numpy()),
            "NORMAL": file.add_array((normals[k] - normals[0]).numpy()),
        }
        for k in range(1, len(keys))
    ]
    mesh = file.add_mesh(name, track.person, first, bodies.faces, targets)
    body = file.add("nodes", {"name": f"{name}_body", "mesh": mesh})
    _add_presence(file, file.add_root({"name": name, "children": [body]}), track)
    if targets:
        times = file.add_array(track.time[keys].numpy().astype(np.float32))
        file.animate(body, "weights", times, np.eye(len(keys))[:, 1:].reshape(-1))
    return miss


def _add_skinned(file: Gltf, skin: Skinned, track: Track) -> None:
    """Append a person: mesh, bones and their motion."""
    model, name = skin.model, f"person_{track.person}"
    rest, joints = rest_of(skin, int(track.rows[0]))
    first = len(file.tree["nodes"])
    for joint, parent in enumerate(model.parents):
        bone: dict[str, Any] = {"name": model.joint_names[joint]}
        if below := [first + k for k, p in enumerate(model.parents) if p == joint]:
            bone["children"] = below
        if parent >= 0:
            bone["translation"] = (model.tpose[parent] @ (joints[joint] - joints[parent])).tolist()
        file.add("nodes", bone)
    top = file.add_root({"name": name, "children": [first]})
    share, joint = model.weights.topk(INFLUENCES, dim=1)
    arrays = {
        "POSITION": rest, "NORMAL": vertex_normals(rest, model.faces),
        "JOINTS_0": torch.where(share > 0, joint, 0).to(torch.uint8), "WEIGHTS_0": share,
    }  # fmt: skip
    mesh = file.add_mesh(name, track.person, arrays, model.faces)
    inverse = torch.eye(4).repeat(len(joints), 1, 1)  # from the rest shape to each joint's axes
    inverse[:, :3, :3] = model.tpose
    inverse[:, :3, 3] = -(model.tpose @ joints[..., None])[..., 0]
    bind = {
        "name": name,
        "joints": list(range(first, first + len(model.parents))),
        "inverseBindMatrices": file.add_array(inverse.mT.contiguous().numpy()),
    }
    file.add_root({"name": f"{name}_body", "mesh": mesh, "skin": file.add("skins", bind)})
    _add_presence(file, top, track)
    times = file.add_array(track.time.numpy().astype(np.float32))
    position = (skin.motion.pose.transl[track.rows] + joints[0]).numpy()
    size = skin.motion.size[track.rows, None].expand(-1, 3).numpy()
    turns = quaternions(all_angles(skin.motion.pose)[track.rows])
    moving = [(first, "translation", position), (first, "scale", size)]
    moving += [(first + k, "rotation", turns[:, k]) for k in range(len(model.parents))]
    for node, path, values in moving:
        if np.ptp(values, axis=0).max() < STILL:
            file.tree["nodes"][node][path] = values[0].tolist()
        else:
            file.animate(node, path, times, values)


def quaternions(vectors: Float[Tensor, "frames joints 3"]) -> NDArray[np.float32]:
    """Rotations (x, y, z, w) of axis-angle vectors; neighbours in time are on one side."""
    from scipy.spatial.transform import Rotation

    flat = vectors.double().reshape(-1, 3).numpy()
    found = Rotation.from_rotvec(flat).as_quat().reshape(*vectors.shape[:2], 4)
    dots = (found[1:] * found[:-1]).sum(-1, keepdims=True)
    found[1:] *= np.where(dots < 0, -1.0, 1.0).cumprod(0)
    return found.astype(np.float32)
