"""A body that moves by shapes: some frames are exact, between them vertices go straight."""

from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from numpy.typing import NDArray
from torch import Tensor

from ..geometry.mesh import vertex_normals
from ..report_colours import Colour
from ..types import Bodies
from .glb_motion import Channel, add_material, add_presence, add_sampler
from .gltf import INDICES, VERTICES, Document
from .keyframes import keyframes
from .people import Track

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
    mesh = _add_mesh(document, shapes, bodies, add_material(document, tint, name), name)
    body = document.add("nodes", {"name": f"{name}_body", "mesh": mesh})
    node = document.add("nodes", {"name": name, "children": [body]})
    document.add_root(node)
    channels = add_presence(document, animation, node, track)
    if len(keys) > 1:
        times = document.add_array(track.time[keys].numpy().astype(np.float32), bounds=True)
        weights = np.eye(len(keys), dtype=np.float32)[:, 1:].reshape(-1)
        channels.append((add_sampler(document, animation, times, weights), body, "weights"))
    return channels, miss


def _add_mesh(
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
