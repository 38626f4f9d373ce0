"""The result as one glTF file: objects, floor, camera, people; single objects as PLY.

As an export it has one animation: people on the bones of their model or by shapes, moved objects.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from mover.core.colours import Colour, colour, person_colour
from mover.core.files import replacing
from mover.core.types import Bodies, Camera, Mesh, Scene, SceneObject
from mover.geometry.camera import NEAR
from mover.geometry.mesh import vertex_normals
from mover.geometry.placement import place_object
from mover.geometry.rotations import affine, rot_y
from mover.io.export.finished import BodyForm, Exported, Finished, Track, keyframes, tracks_of
from mover.io.export.posed import Skinned, all_angles, bones_for, rest_of
from mover.io.files.fields import At
from mover.io.files.meshes import load_parts, looks_lost, stretched_part

GHOSTS = 12  # at most so many bodies
FLOOR_MARGIN = 1.0  # [m] beyond the furniture
FLOOR_COLOUR = (0.86, 0.85, 0.83)
BODY_ALPHA = 0.55
Append = Callable[[dict[Any, bytes], dict[str, Any]], None]
"""Adds to a glTF file: takes its blocks of bytes and its tree."""


def write_glb(
    scene: Scene, bodies: Bodies | None, path: Path, append: Append | None = None
) -> Path:
    """Write the scene with some of its bodies as one glTF file, all at once.

    Each object is a node of its id that holds its placement; its meshes are those of the user's
    own file where it exists, textures included. `ground` is the floor, `camera` the camera of the
    video, `body_<person>_<frame>` are up to twelve bodies, evenly chosen; `append` adds what moves.
    """
    import trimesh
    from trimesh.exchange.gltf import export_glb
    from trimesh.scene.cameras import Camera as View

    out = trimesh.Scene()
    for index, item in enumerate(scene.objects):
        above = _free(out, item.id)
        out.graph.update(frame_to=above, frame_from=out.graph.base_frame, matrix=placement_of(item))
        for part, transform in parts_of(item, colour(index)):
            _add(out, f"{above}_mesh", part, parent_node_name=above, transform=transform)
    if scene.ground is not None:
        _add(out, "ground", _solid(floor_of(scene, scene.ground), (*FLOOR_COLOUR, 1.0), "ground"))
    if bodies is not None:  # evenly over the frames
        order = torch.argsort(bodies.frame, stable=True)
        steps = torch.linspace(0, len(order) - 1, min(GHOSTS, len(order))).round().long()
        for row in order[steps].unique().tolist():
            person, name = int(bodies.person[row]), f"body_{bodies.person[row]}_{bodies.frame[row]}"
            mesh = Mesh(bodies.verts[row], bodies.faces)
            body = _solid(mesh, (*person_colour(person), BODY_ALPHA), name)
            body.vertex_normals = unit_normals(body.vertex_normals)  # skin is smooth
            _add(out, name, body)
    lens = _lens(scene.camera)  # exact in the file alone: see `finish`
    across = 2 * math.atan(lens["aspectRatio"] * math.tan(lens["yfov"] / 2))
    fov, size = [math.degrees(v) for v in (across, lens["yfov"])], scene.camera
    out.camera = View(_free(out, "camera"), resolution=(size.width, size.height), fov=fov)
    out.camera_transform = view_matrix(scene.camera)

    def finish(blocks: dict[Any, bytes], tree: dict[str, Any]) -> None:
        tree["cameras"][0]["perspective"] = lens
        if append is not None:
            append(blocks, tree)

    raw = export_glb(out, buffer_postprocessor=finish)
    with replacing(path) as part:
        part.write_bytes(raw)
    return path


def _add(out: Any, name: str, part: Any, **options: Any) -> None:  # noqa: ANN401
    """A mesh in a node of this name, which is lengthened where another node has it."""
    name = _free(out, name)
    out.add_geometry(part, node_name=name, geom_name=name, **options)


def _free(out: Any, name: str) -> str:  # noqa: ANN401
    while name in out.graph.nodes:
        name += "_"
    return name


def placement_of(item: SceneObject) -> np.ndarray:
    """Matrix of scale, then rotation about +y, then translation: glTF's order."""
    turn = rot_y(item.yaw.detach().cpu().double()).numpy()
    stretched = turn * item.scale.detach().cpu().double().numpy()
    return affine(stretched, item.t_world_object.detach().cpu().numpy())


def parts_of(item: SceneObject, tint: Colour) -> list[tuple[Any, np.ndarray]]:
    """Meshes of the user's file with their transforms; without a file, the mesh that is known."""
    import trimesh

    file, found = Path(item.mesh_file), list[tuple[Any, np.ndarray]]()
    known = bool(item.mesh_file) and file.is_file()
    loaded = load_parts(At(file.name, item.id), file, process=True) if known else trimesh.Scene()
    for node in loaded.graph.nodes_geometry:
        transform, name = loaded.graph[node]
        part = loaded.geometry[name]
        if item.stretch is not None:
            part, transform = stretched_part(part, transform, item.stretch), np.eye(4)
        if isinstance(part, trimesh.Trimesh) and len(part.faces):
            found.append((_coloured(part, tint, item.id), np.asarray(transform)))
    return found or [(_solid(item.mesh, (*tint, 1.0), item.id), np.eye(4))]


def losses_of(scene: Scene) -> list[str]:
    """What to say of textures and materials that are lost, one object a line."""
    files = (Path(item.mesh_file) for item in scene.objects if item.mesh_file)
    return [lost for file in files if file.is_file() and (lost := looks_lost(file))]


def _coloured(part: Any, tint: Colour, name: str) -> Any:  # noqa: ANN401
    """The mesh with its own colours or texture, else in the object's colour.

    Normals of the file stay; without any, viewers shade each face flat, as glTF asks.
    """
    from trimesh.visual import ColorVisuals, TextureVisuals

    part = part.copy(include_cache=True)
    if isinstance(part.visual, ColorVisuals) and not part.visual.defined:
        part.visual = TextureVisuals(material=_material((*tint, 1.0), name))
    if "vertex_normals" in part._cache.cache:  # asked in public, trimesh would make some up
        part.vertex_normals = unit_normals(part.vertex_normals)
    return part


def unit_normals(normals: Float[np.ndarray, "verts 3"]) -> Float[np.ndarray, "verts 3"]:
    """Directions of length one; where triangles without area leave none, up."""
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    up = np.array([0.0, 1.0, 0.0])
    return np.where(length > 1e-6, normals / np.maximum(length, 1e-6), up)


def linear(rgb: Colour) -> Colour:
    """Amounts of light of a colour on the screen."""
    red, green, blue = (((c + 0.055) / 1.055) ** 2.4 if c > 0.04045 else c / 12.92 for c in rgb)
    return red, green, blue


def _material(rgba: tuple[float, float, float, float], name: str) -> Any:  # noqa: ANN401
    """A rough material; glTF counts light, so the colour leaves its sRGB curve here."""
    from trimesh.visual.material import PBRMaterial

    return PBRMaterial(
        name=name,
        baseColorFactor=[*(round(255 * c) for c in linear(rgba[:3])), round(255 * rgba[3])],
        metallicFactor=0.0, roughnessFactor=0.9, alphaMode="BLEND" if rgba[3] < 1 else "OPAQUE",
        doubleSided=True,
    )  # fmt: skip


def _solid(mesh: Mesh, rgba: tuple[float, float, float, float], name: str) -> Any:  # noqa: ANN401
    import trimesh
    from trimesh.visual import TextureVisuals

    return trimesh.Trimesh(
        mesh.verts.detach().cpu().double().numpy(), mesh.faces.cpu().numpy(), process=False,
        visual=TextureVisuals(material=_material(rgba, name)),
    )  # fmt: skip


def floor_of(scene: Scene, height: float) -> Mesh:
    """A rectangle under everything, front side up."""
    stands = [place_object(p).verts.detach().cpu()[:, [0, 2]].float() for p in scene.objects]
    flat = torch.cat([torch.zeros(1, 2), *stands])
    x0, z0 = (flat.amin(0) - FLOOR_MARGIN).tolist()
    x1, z1 = (flat.amax(0) + FLOOR_MARGIN).tolist()
    corners = [[x0, height, z1], [x1, height, z1], [x1, height, z0], [x0, height, z0]]
    return Mesh(torch.tensor(corners), torch.tensor([[0, 1, 2], [0, 2, 3]]))


def view_matrix(camera: Camera) -> Float[np.ndarray, "4 4"]:
    """From the axes of a camera that looks along -z, with +y up, to the world."""
    return affine(camera.R_cam_world.detach().cpu().double().numpy().T @ np.diag([1.0, -1.0, -1.0]))


def _lens(camera: Camera) -> dict[str, float]:
    """As glTF has it: the ratio of lengths, not of angles, and the image's centre on the axis."""
    wide = camera.width / float(camera.K[0, 0])
    high = camera.height / float(camera.K[1, 1])
    return {"aspectRatio": wide / high, "yfov": 2 * math.atan(high / 2), "znear": NEAR}


def export_ply(finished: Finished, folder: Path) -> Exported:
    """Write each object by itself, where it stands in the world [m], as `objects/<id>.ply`."""
    import trimesh

    files: list[Path] = []
    for index, item in enumerate(finished.scene.objects):
        placed = trimesh.Scene()
        for part, transform in parts_of(item, colour(index)):
            placed.add_geometry(part, transform=placement_of(item) @ transform)
        whole = placed.to_mesh()
        files.append(folder / "objects" / f"{item.id}.ply")
        with replacing(files[-1]) as target:
            trimesh.Trimesh(whole.vertices, whole.faces, process=False).export(target)
    return Exported(tuple(files))


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
