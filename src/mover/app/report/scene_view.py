"""What the 3D view of the report shows, packed into one text and one block of bytes."""

import base64
import json
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from numpy.typing import NDArray
from torch import Tensor

from mover.core.colours import colour, css, person_colour
from mover.core.types import Bodies, Camera, Mesh, Scene, SceneObject
from mover.geometry.mesh import simplifying
from mover.geometry.placement import place_object
from mover.geometry.topology import distinct_rows

GRAIN = 1e-4  # share of the longest side within which vertices are the same


@dataclass(frozen=True)
class Thinning:
    """A choice of vertices that stands for all, and triangles between them."""

    kept: Int[Tensor, " kept"]
    """Indices into the original vertices."""
    faces: Int[Tensor, "faces 3"]
    """Indices into `kept`."""


def thin(mesh: Mesh, count: int) -> Mesh:
    """The mesh with at most about `count` faces; soups are welded first."""
    from fast_simplification import simplify

    verts, faces = _welded(mesh)
    if len(faces) > count:
        with simplifying:
            verts, faces, *_ = simplify(verts, faces.astype(np.int32), target_count=count)
    if not len(faces):
        return mesh
    return Mesh(torch.from_numpy(verts).float(), torch.from_numpy(faces.astype(np.int64)))


def thin_choice(
    verts: Float[Tensor, "verts 3"], faces: Int[Tensor, "faces 3"], count: int
) -> Thinning:
    """Choose vertices of one pose so that all other poses can be drawn with them as well.

    Each vertex of the simplified mesh is replaced by the nearest of those that collapsed into it.
    """
    from fast_simplification import replay_simplification, simplify

    if len(faces) <= count:
        used, ends = faces.cpu().long().unique(return_inverse=True)
        return Thinning(used, ends.reshape(-1, 3))
    points = verts.detach().cpu().double().numpy()
    triangles = faces.cpu().int().numpy()
    with simplifying:
        *_, collapses = simplify(points, triangles, target_count=count, return_collapses=True)
        fewer, kept_faces, heir = replay_simplification(points, triangles, collapses)
    used = np.unique(triangles)
    heirs = np.asarray(heir)[used]
    far = np.linalg.norm(points[used] - np.asarray(fewer)[heirs], axis=1)
    order = np.lexsort((far, heirs))
    first = np.unique(heirs[order], return_index=True)
    choice = np.zeros(len(fewer), dtype=np.int64)
    choice[first[0]] = used[order][first[1]]
    return Thinning(torch.from_numpy(choice), torch.from_numpy(np.asarray(kept_faces, np.int64)))


def _welded(mesh: Mesh) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """Vertices that share a place become one; collapsed and doubled triangles go."""
    verts = mesh.verts.detach().cpu().double().numpy()
    faces = mesh.faces.cpu().long().numpy()
    used, faces = np.unique(faces, return_inverse=True)
    verts, faces = verts[used], faces.reshape(-1, 3)
    grain = GRAIN * max(float(np.ptp(verts, axis=0).max()), 1e-9)
    first, same = distinct_rows(np.round(verts / grain).astype(np.int64))
    faces = same[faces]
    kept = (faces != np.roll(faces, 1, axis=1)).all(1)
    once, _ = distinct_rows(np.sort(faces[kept], axis=1))
    return verts[first], faces[kept][np.sort(once)]


# The text and the bytes.


FACES_OBJECT = 3000  # at most, of each object
FACES_BODY = 1600
MOMENTS = 120  # at most so many frames
ROWS = 240  # and so many bodies in them
STEPS = 32767  # half of the range of a 16-bit coordinate
EYE_HEIGHT = 1.5  # [m], of a camera above a floor that nobody knows


@dataclass(frozen=True)
class ReportScene:
    """Data of the 3D view."""

    text: str
    """JSON: placements, cameras, and where each array lies in `block`."""
    block: str
    """Little-endian arrays, base64."""


class Block:
    """Bytes that grow by arrays; each starts at a multiple of four."""

    def __init__(self) -> None:
        self.parts: list[bytes] = []
        self.size = 0

    def add(self, array: Tensor) -> int:
        """Append `array` and return where it starts [bytes]."""
        start, raw = self.size, array.contiguous().numpy().tobytes()
        raw += bytes(-len(raw) % 4)
        self.parts.append(raw)
        self.size += len(raw)
        return start


def pack_view(scenes: dict[str, Scene], bodies: dict[str, Bodies]) -> ReportScene:
    """Pack the scenes (`initial`, `result`, `truth`) and the bodies in the world of each."""
    block = Block()
    meshes: list[_Packed] = []
    packed: list[dict[str, Any]] = []
    tree: dict[str, Any] = {"scenes": {}}
    for name, scene in scenes.items():
        pieces = [
            _pack_object(p, i, _shared(p, meshes, packed, block))
            for i, p in enumerate(scene.objects)
        ]
        floor = floor_of(scene, bodies.get(name))
        tree["scenes"][name] = {
            "camera": _pack_camera(scene.camera),
            "floor": floor,
            "pieces": pieces,
        }
    tree["meshes"] = packed
    tree["people"] = _pack_people(bodies, block)
    text = json.dumps(tree, separators=(",", ":")).replace("<", "\\u003c")
    return ReportScene(text, base64.b64encode(b"".join(block.parts)).decode())


class _Packed(NamedTuple):
    """A mesh that is in the block."""

    mesh: Mesh
    thinned: Mesh
    place: int


def _shared(
    piece: SceneObject, seen: list[_Packed], packed: list[dict[str, Any]], block: Block
) -> int:
    """Index of the packed mesh; a mesh that several scenes hold is packed once."""
    mesh = piece.mesh
    for other in seen:
        if other.mesh is mesh or _alike(other.mesh, mesh):
            return other.place
    fewer = _raised(piece, seen) or thin(mesh, FACES_OBJECT)
    low, step, coarse = _coarse(fewer.verts)
    packed.append(
        {
            "verts": block.add(coarse),
            "n_verts": len(coarse),
            "faces": block.add(
                fewer.faces.to(torch.uint16 if len(coarse) < 2**16 else torch.int32)
            ),
            "n_faces": len(fewer.faces),
            "wide": len(coarse) >= 2**16,
            "middle": low,
            "step": step,
        }
    )
    seen.append(_Packed(mesh, fewer, len(packed) - 1))
    return len(packed) - 1


def _alike(one: Mesh, other: Mesh) -> bool:
    """Whether two meshes are the same, to the bit."""
    return one.faces.equal(other.faces) and one.verts.equal(other.verts)


def _raised(piece: SceneObject, seen: list[_Packed]) -> Mesh | None:
    """The thinned mesh of the given one, raised as this one was; None: it is not packed."""
    if piece.stretch is None:
        return None
    for other in seen:
        if other.mesh.faces.equal(piece.mesh.faces) and piece.mesh.verts.equal(
            piece.stretch.of(other.mesh.verts)
        ):
            return Mesh(piece.stretch.of(other.thinned.verts), other.thinned.faces)
    return None


def _coarse(points: Float[Tensor, "*any 3"]) -> tuple[list[float], float, Tensor]:
    """Middle [m], step [m] and the points in steps from the middle, as 16-bit integers."""
    flat = points.detach().cpu().double().reshape(-1, 3)
    low, high = flat.amin(0), flat.amax(0)
    middle, step = (low + high) / 2, max(float((high - low).amax()) / 2 / STEPS, 1e-9)
    whole = ((points.detach().cpu().double() - middle) / step).round().to(torch.int16)
    return [round(v, 6) for v in middle.tolist()], step, whole


def _pack_object(piece: SceneObject, index: int, mesh: int) -> dict[str, Any]:
    return {
        "id": piece.id,
        "category": piece.category,
        "colour": css(colour(index)),
        "mesh": mesh,
        "t": _numbers(piece.t_world_object),
        "yaw": round(float(piece.yaw), 6),
        "scale": _numbers(piece.scale),
    }


def _pack_camera(camera: Camera) -> dict[str, Any]:
    K = camera.K.tolist()
    return {
        "R": _numbers(camera.R_cam_world.reshape(-1)),
        "f": [K[0][0], K[1][1]],
        "c": [K[0][2], K[1][2]],
        "size": [camera.width, camera.height],
    }


def _numbers(values: Tensor) -> list[float]:
    return [round(v, 6) for v in values.detach().tolist()]


def floor_of(scene: Scene, bodies: Bodies | None = None) -> float:
    """Height of the floor, or of the lowest thing where no floor is known [m]."""
    if scene.ground is not None:
        return scene.ground
    lows = [place_object(p).verts[p.mesh.faces.unique(), 1].amin() for p in scene.objects]
    if bodies is not None and len(bodies.verts):
        lows.append(bodies.verts[..., 1].amin())
    return float(torch.stack(lows).amin()) if lows else -EYE_HEIGHT


def _pack_people(bodies: dict[str, Bodies], block: Block) -> dict[str, Any] | None:
    """Evenly chosen frames of everybody, in each world, with one thinned topology."""
    bodies = {name: b for name, b in bodies.items() if len(b.verts)}
    if not bodies:
        return None
    main = bodies.get("result", next(iter(bodies.values())))
    bodies = {n: b for n, b in bodies.items() if b.verts.shape == main.verts.shape}
    people = main.person.unique().tolist()
    frames = _moments(main, max(1, min(MOMENTS, ROWS // len(people))))
    few = thin_choice(main.verts[len(main.verts) // 2], main.faces, FACES_BODY)
    rows = [r for r in range(len(main.verts)) if int(main.frame[r]) in set(frames)]
    return {
        "faces": block.add(few.faces.to(torch.uint16)),
        "n_faces": len(few.faces),
        "n_verts": len(few.kept),
        "fps": main.fps,
        "frames": frames,
        "colours": {str(p): css(person_colour(p)) for p in people},
        "rows": [[int(main.frame[r]), int(main.person[r])] for r in rows],
        "worlds": {name: _pack_rows(b, rows, few, block) for name, b in bodies.items()},
        "opening": _opening(main, frames),
    }


def _pack_rows(bodies: Bodies, rows: list[int], few: Thinning, block: Block) -> dict[str, Any]:
    middle, step, coarse = _coarse(bodies.verts[rows][:, few.kept])
    return {"verts": block.add(coarse), "middle": middle, "step": step}


def _moments(bodies: Bodies, count: int) -> list[int]:
    """At most `count` frames, evenly chosen, the first and the last among them."""
    frames = bodies.frame.unique()
    picks = torch.linspace(0, len(frames) - 1, min(count, len(frames))).round().long()
    return frames[picks.unique()].tolist()


def _opening(bodies: Bodies, frames: list[int]) -> int:
    """The moment to open with: where somebody's body is lowest (sitting or lying)."""
    rows = [(bodies.frame == f).nonzero()[:, 0] for f in frames]
    tops = torch.stack([bodies.verts[r, :, 1].amax(-1).amin() for r in rows])
    return int(tops.argmin())
