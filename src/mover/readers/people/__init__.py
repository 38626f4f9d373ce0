"""People from today's tools: a tool is a file and a row in a table."""

from collections.abc import Callable
from pathlib import Path

from ...types import Keypoints
from .finish import Imported, finish
from .found import Found
from .gvhmr import read_gvhmr
from .joint_lists import reader_of
from .keypoints_file import read_keypoints, write_keypoints
from .known import Known
from .layouts import as_openpose
from .multihmr import read_multihmr
from .openpose import read_openpose
from .pare import read_pare
from .phalp import read_phalp
from .prompthmr import read_prompthmr
from .sam3d import read_sam3d
from .slahmr import read_slahmr
from .smplify import read_mover, read_prox, read_smplifyx
from .tram import read_tram
from .upright import attitude, camera_from, in_world
from .wham import read_wham

__all__ = [
    "BODIES_FROM", "KEYPOINTS_FROM", "Imported", "Known", "as_openpose", "attitude", "bodies_from",
    "camera_from", "in_world", "keypoints_from", "read_keypoints", "write_keypoints",
]  # fmt: skip

BODIES_FROM: dict[str, Callable[[Path, Known], Found]] = {
    "4dhumans": read_phalp,
    "gem": read_gvhmr,
    "gvhmr": read_gvhmr,
    "mover": read_mover,
    "multihmr": read_multihmr,
    "pare": read_pare,
    "phalp": read_phalp,
    "prompthmr": read_prompthmr,
    "prox": read_prox,
    "sam3dbody": read_sam3d,
    "slahmr": read_slahmr,
    "smplifyx": read_smplifyx,
    "tram": read_tram,
    "wham": read_wham,
}
"""How to read the bodies of each tool."""

KEYPOINTS_FROM: dict[str, Callable[[Path, Known], Keypoints]] = {
    "coco17": reader_of("coco17"),
    "halpe26": reader_of("halpe26"),
    "openpose": read_openpose,
    "wholebody": reader_of("wholebody133"),
}
"""How to read the keypoints of each detector."""


def bodies_from(tool: str, path: Path, known: Known | None = None) -> Imported:
    """Bodies that another tool found, in the camera frame.

    Raises:
        ValueError: If the tool is not known.
        InputError: If its files are not as the tool writes them, or a body model is missing.
    """
    if tool not in BODIES_FROM:
        raise ValueError(f"tool is {tool!r}, choose one of {', '.join(BODIES_FROM)}")
    known = known or Known()
    return finish(BODIES_FROM[tool](Path(path), known), known, Path(path).name)


def keypoints_from(tool: str, path: Path, known: Known | None = None) -> Keypoints:
    """Keypoints that a detector found.

    Raises:
        ValueError: If the detector is not known.
        InputError: If its files are not as the detector writes them.
    """
    if tool not in KEYPOINTS_FROM:
        raise ValueError(f"tool is {tool!r}, choose one of {', '.join(KEYPOINTS_FROM)}")
    return KEYPOINTS_FROM[tool](Path(path), known or Known())
