"""Parts of an animation that bodies of both kinds share."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..export import linear
from ..report_colours import Colour
from .gltf import Document
from .people import Track, seen_from_to

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


def add_material(document: Document, tint: Colour, name: str) -> int:
    """A rough, opaque material of one colour."""
    surface: dict[str, Any] = {
        "baseColorFactor": [*linear(tint), 1.0],
        "metallicFactor": 0.0,
        "roughnessFactor": 0.9,
    }
    return document.add("materials", {"name": name, "pbrMetallicRoughness": surface})
