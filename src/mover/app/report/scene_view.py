"""What the 3D view of the report shows, packed into one text and one block of bytes."""

import base64
import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from mover.core.colours import colour, css, person_colour
from mover.core.types import Bodies, Mesh, Scene
from mover.geometry.mesh import chosen_vertices, simplifying
from mover.geometry.placement import place_object

GRAIN = 1e-4  # share of the longest side within which vertices are the same
FACES_OBJECT, FACES_BODY = 3000, 1600  # at most
MOMENTS, ROWS = 120, 240  # at most so many frames, and so many bodies in them
STEPS = 32767  # half of the range of a 16-bit coordinate
EYE_HEIGHT = 1.5  # [m], of a camera above an unknown floor


@dataclass(frozen=True)
class Thinning:
    """A choice of vertices that stands for all, and triangles between them."""

    kept: Int[Tensor, " kept"]  #: indices into the original vertices
    faces: Int[Tensor, "faces 3"]  #: indices into `kept`


def thin(mesh: Mesh, count: int) -> Mesh:
    """The mesh with at most about `count` faces; soups are welded first."""
    import trimesh
    from fast_simplification import simplify

    verts = mesh.verts.detach().cpu().double().numpy()
    shape = trimesh.Trimesh(verts, mesh.faces.cpu().long().numpy(), process=False)
    grain = GRAIN * max(float(np.ptp(verts[np.unique(shape.faces)], axis=0).max()), 1e-9)
    shape.merge_vertices(merge_tex=True, merge_norm=True, digits_vertex=round(-np.log10(grain)))
    faces = shape.faces[(shape.faces != np.roll(shape.faces, 1, axis=1)).all(1)]
    faces = faces[np.sort(np.unique(np.sort(faces, axis=1), axis=0, return_index=True)[1])]
    verts = np.asarray(shape.vertices)
    if len(faces) > count:
        with simplifying:
            verts, faces, *_ = simplify(verts, faces.astype(np.int32), target_count=count)
    if not len(faces):
        return mesh
    return Mesh(torch.from_numpy(verts).float(), torch.from_numpy(faces.astype(np.int64)))


def thin_choice(
    verts: Float[Tensor, "verts 3"], faces: Int[Tensor, "faces 3"], count: int
) -> Thinning:
    """Choose vertices of one pose so that all other poses can be drawn with them as well."""
    used, ends = faces.cpu().long().unique(return_inverse=True)
    ends = ends.reshape(-1, 3)
    few = None if len(faces) <= count else chosen_vertices(verts.detach().cpu()[used], ends, count)
    return Thinning(used, ends) if few is None else Thinning(used[few[0]], few[1])


def pack_view(scenes: Mapping[str, Scene], bodies: Mapping[str, Bodies]) -> tuple[str, str]:
    """Pack the scenes (`initial`, `result`, `truth`) and the bodies in the world of each.

    Returns:
        JSON with placements, cameras, and where each array lies in a block; and the block, base64:
        little-endian arrays, 16-bit vertices in steps from a middle, and faces.
    """
    block, meshes, packed = bytearray(), list[Mesh](), list[dict[str, Any]]()

    def index_of(mesh: Mesh) -> int:
        """A mesh that several scenes hold is packed once."""
        for index, other in enumerate(meshes):
            if other is mesh or (other.faces.equal(mesh.faces) and other.verts.equal(mesh.verts)):
                return index
        meshes.append(mesh)
        few = thin(mesh, FACES_OBJECT)
        wide = len(few.verts) >= 2**16
        packed.append(
            _packed_points(few.verts, block)
            | _packed_faces(few.faces, wide, block)
            | {"top": round(float(few.verts[:, 1].max()), 6)}
        )
        return len(packed) - 1

    tree: dict[str, Any] = {"scenes": {}, "meshes": packed}
    for name, scene in scenes.items():
        K = scene.camera.K.tolist()
        tree["scenes"][name] = {
            "camera": {
                "R": _numbers(scene.camera.R_cam_world.reshape(-1)),
                "f": [K[0][0], K[1][1]],
                "c": [K[0][2], K[1][2]],
                "size": [scene.camera.width, scene.camera.height],
            },
            "floor": floor_of(scene, bodies.get(name)),
            "pieces": [
                {
                    "id": item.id, "category": item.category, "colour": css(colour(index)),
                    "mesh": index_of(item.mesh), "t": _numbers(item.t_world_object),
                    "yaw": round(float(item.yaw), 6), "scale": _numbers(item.scale),
                }
                for index, item in enumerate(scene.objects)
            ],
        }  # fmt: skip
    tree["people"] = _packed_people(bodies, block)
    name = "result" if "result" in scenes else next(iter(scenes))
    tree["room"] = _room(scenes[name], bodies.get(name))
    text = json.dumps(tree, separators=(",", ":")).replace("<", "\\u003c")
    return text, base64.b64encode(bytes(block)).decode()


def _added(array: Tensor, block: bytearray) -> int:
    """Where an array starts in the block [bytes]: each at a multiple of four."""
    start = len(block)
    block += array.contiguous().numpy().tobytes()
    block += bytes(-len(block) % 4)
    return start


def _packed_points(points: Float[Tensor, "*any 3"], block: bytearray) -> dict[str, Any]:
    """Middle [m], step [m] and where the points are, in steps from the middle."""
    points = points.detach().cpu().double()
    low, high = points.reshape(-1, 3).amin(0), points.reshape(-1, 3).amax(0)
    middle, step = (low + high) / 2, max(float((high - low).amax()) / 2 / STEPS, 1e-9)
    whole = ((points - middle) / step).round().to(torch.int16)
    return {
        "verts": _added(whole, block), "n_verts": points.shape[-2], "middle": _numbers(middle),
        "step": step,
    }  # fmt: skip


def _packed_faces(faces: Int[Tensor, "faces 3"], wide: bool, block: bytearray) -> dict[str, Any]:
    start = _added(faces.to(torch.int32 if wide else torch.uint16), block)
    return {"faces": start, "n_faces": len(faces), "wide": wide}


def _numbers(values: Tensor) -> list[float]:
    return [round(v, 6) for v in values.detach().tolist()]


def floor_of(scene: Scene, bodies: Bodies | None = None) -> float:
    """Height of the floor, or of the lowest point where no floor is known [m]."""
    if scene.ground is not None:
        return scene.ground
    lows = [place_object(o).verts[o.mesh.faces.unique(), 1].amin() for o in scene.objects]
    if bodies is not None and len(bodies.verts):
        lows.append(bodies.verts[..., 1].amin())
    return float(torch.stack(lows).amin()) if lows else -EYE_HEIGHT


def _room(scene: Scene, bodies: Bodies | None) -> dict[str, Any]:
    """Middle and radius of all that is shown, above the floor [m]."""
    points = [place_object(o).verts.detach().reshape(-1, 3).double() for o in scene.objects]
    if bodies is not None and len(bodies.verts):
        points.append(bodies.verts[:, ::17].detach().reshape(-1, 3).double())
    if not points:
        return {"middle": [0.0, 0.6, -3.0], "radius": 4.0}
    both = torch.cat(points) - torch.tensor([0.0, floor_of(scene, bodies), 0.0]).double()
    low, high = both.amin(0), both.amax(0)
    radius = max(1.0, float((high - low).norm()) / 2)
    return {"middle": _numbers((low + high) / 2), "radius": radius}


def _packed_people(bodies: Mapping[str, Bodies], block: bytearray) -> dict[str, Any] | None:
    """Evenly chosen frames of all people, in each world, with one thinned topology."""
    bodies = {name: b for name, b in bodies.items() if len(b.verts)}
    if not bodies:
        return None
    main = bodies.get("result", next(iter(bodies.values())))
    people, frames = main.person.unique().tolist(), main.frame.unique()
    count = min(len(frames), max(1, min(MOMENTS, ROWS // len(people))))
    moments = frames[torch.linspace(0, len(frames) - 1, count).round().long().unique()].tolist()
    few = thin_choice(main.verts[len(main.verts) // 2], main.faces, FACES_BODY)
    rows = [r for r in range(len(main.verts)) if int(main.frame[r]) in set(moments)]
    tops = [main.verts[main.frame == f, :, 1].amax(-1).amin() for f in moments]
    return {
        **_packed_faces(few.faces, False, block),
        "n_verts": len(few.kept),
        "fps": main.fps,
        "frames": moments,
        "colours": {str(p): css(person_colour(p)) for p in people},
        "rows": [[int(main.frame[r]), int(main.person[r])] for r in rows],
        "worlds": {
            name: _packed_points(b.verts[:, few.kept][rows], block)
            for name, b in bodies.items()
            if b.verts.shape == main.verts.shape
        },
        "opening": int(torch.stack(tops).argmin()),  # where a body is lowest: seated or lying
    }
