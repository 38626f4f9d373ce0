"""Binary glTF files: what trimesh writes, read again to append bones, shapes and their motion."""

import json
import math
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mover.core.colours import Colour
from mover.core.files import replacing
from mover.core.types import SceneObject
from mover.io.export.people import Track, seen_from_to
from mover.io.export.scene_glb import linear, placement_of

HEADER, CHUNK = struct.Struct("<4sII"), struct.Struct("<I4s")
KINDS = {
    "float32": 5126, "uint32": 5125, "uint16": 5123, "int16": 5122, "uint8": 5121, "int8": 5120,
}  # fmt: skip
SHAPES = {(): "SCALAR", (2,): "VEC2", (3,): "VEC3", (4,): "VEC4", (4, 4): "MAT4"}
VERTICES, INDICES = 34962, 34963


class Document:
    """A glTF tree with its block of bytes, to which arrays and nodes are appended."""

    def __init__(self, raw: bytes) -> None:
        _, _, length = HEADER.unpack_from(raw)
        place, self.tree, self.block = HEADER.size, dict[str, Any](), bytearray()
        while place < length:
            size, kind = CHUNK.unpack_from(raw, place)
            content = raw[place + CHUNK.size : place + CHUNK.size + size]
            if kind == b"JSON":
                self.tree = json.loads(content)
            elif kind == b"BIN\0":
                self.block = bytearray(content)
            place += CHUNK.size + size

    def add(self, key: str, value: dict[str, Any]) -> int:
        """Append to a list of the tree; the index."""
        found = self.tree.setdefault(key, [])
        found.append(value)
        return len(found) - 1

    def add_array(
        self, array: NDArray[Any], target: int | None = None, bounds: bool = False
    ) -> int:
        """Append an accessor of its own bytes; the index.

        Args:
            array: One item a row; matrices by columns, as glTF has them.
            target: `VERTICES` or `INDICES` where it belongs to a mesh.
            bounds: Whether the smallest and largest values are told; places and times need it.
        """
        self.block += bytes(-len(self.block) % 4)
        view: dict[str, Any] = {
            "buffer": 0, "byteOffset": len(self.block), "byteLength": array.nbytes,
        }  # fmt: skip
        if target is not None:
            view["target"] = target
        self.block += np.ascontiguousarray(array).tobytes()
        accessor: dict[str, Any] = {
            "bufferView": self.add("bufferViews", view),
            "componentType": KINDS[str(array.dtype)],
            "count": len(array),
            "type": SHAPES[array.shape[1:]],
        }
        if bounds:
            flat = array.reshape(len(array), -1)
            accessor |= {"min": flat.min(0).tolist(), "max": flat.max(0).tolist()}
        return self.add("accessors", accessor)

    def add_root(self, node: int) -> None:
        """Hang a node at the top of the scene."""
        self.tree["scenes"][self.tree.get("scene", 0)].setdefault("nodes", []).append(node)

    def write(self, path: Path) -> None:
        """Write the file all at once."""
        self.block += bytes(-len(self.block) % 4)
        self.tree["buffers"] = [{"byteLength": len(self.block)}]
        text = json.dumps(self.tree, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        length = HEADER.size + 2 * CHUNK.size + len(text) + len(self.block)
        with replacing(path) as part, part.open("wb") as stream:
            stream.write(HEADER.pack(b"glTF", 2, length))
            stream.write(CHUNK.pack(len(text), b"JSON") + text)
            stream.write(CHUNK.pack(len(self.block), b"BIN\0") + bytes(self.block))


# Parts of an animation that bodies of both kinds share.


Channel = tuple[int, int, str]
"""Sampler, node, and what of the node moves."""


def add_sampler(
    document: Document,
    animation: int,
    times: int,
    values: NDArray[np.float32],
    interpolation: str = "LINEAR",
) -> int:
    """Values at the times of an accessor; the index of the sampler."""
    samplers = document.tree["animations"][animation]["samplers"]
    samplers.append(
        {"input": times, "output": document.add_array(values), "interpolation": interpolation}
    )
    return len(samplers) - 1


def add_presence(document: Document, animation: int, node: int, track: Track) -> list[Channel]:
    """Hide a person while nobody sees them: a node of size zero is not drawn (glTF, Sec. 3.6)."""
    events: dict[float, float] = {0.0: 0.0}
    step = float(track.time.diff().min()) if len(track.time) > 1 else 0.2
    for start, end in seen_from_to(track):
        events[start] = 1.0
        if end < track.last - 1e-6:
            events[end + step] = 0.0
    if set(events.values()) == {1.0}:
        return []
    when = sorted(events)
    times = document.add_array(np.array(when, np.float32), bounds=True)
    sizes = np.array([[events[t]] * 3 for t in when], np.float32)
    return [(add_sampler(document, animation, times, sizes, "STEP"), node, "scale")]


def add_stays(
    document: Document, animation: int, piece: SceneObject, first: int, step: float
) -> list[Channel]:
    """Put an object where it stands in each of its segments; it jumps between them.

    Args:
        document: Has the object as a node of its placement.
        animation: The one that is added to.
        piece: An object with segments.
        first: The frame at 0 s.
        step: From one frame to the next [s].
    """
    wanted = placement_of(piece).T.reshape(-1)
    node = next(
        index for index, item in enumerate(document.tree["nodes"])
        if item.get("name", "").rstrip("_") == piece.id.rstrip("_")
        and np.allclose(item.pop("matrix", np.eye(4).reshape(-1)), wanted, atol=1e-6)
    )  # fmt: skip
    stays = {max(0.0, (s.frame - first) * step): s for s in piece.segments}
    times = document.add_array(np.array(list(stays), np.float32), bounds=True)
    at = np.array([s.t_world_object.tolist() for s in stays.values()], np.float32)
    half = np.array([float(s.yaw) / 2 for s in stays.values()])
    zero = np.zeros_like(half)
    turns = np.stack([zero, np.sin(half), zero, np.cos(half)], 1).astype(np.float32)
    own = float(piece.yaw) / 2
    document.tree["nodes"][node] |= {
        "translation": piece.t_world_object.tolist(), "scale": piece.scale.tolist(),
        "rotation": [0.0, math.sin(own), 0.0, math.cos(own)],
    }  # fmt: skip
    return [
        (add_sampler(document, animation, times, values, "STEP"), node, path)
        for values, path in ((at, "translation"), (turns, "rotation"))
    ]


def add_material(document: Document, tint: Colour, name: str) -> int:
    """A rough, opaque material of one colour."""
    surface: dict[str, Any] = {
        "baseColorFactor": [*linear(tint), 1.0],
        "metallicFactor": 0.0,
        "roughnessFactor": 0.9,
    }
    return document.add("materials", {"name": name, "pbrMetallicRoughness": surface})
