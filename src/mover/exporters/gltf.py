"""Binary glTF files: read the two chunks, append arrays and nodes, write them again."""

import json
import struct
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..records import replacing

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
