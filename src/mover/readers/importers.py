"""Formats that `mover import` reads: a name, a function, a line of help."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from .box_scene import box_parts
from .gen3dsr import gen3dsr_parts
from .glb_scene import glb_parts
from .instance_files import mask_parts
from .parts import Hints, Parts, folder_parts, parts_of
from .pigraphs import pigraphs_parts
from .prox import prox_parts
from .release import release_parts
from .sam3d import sam3d_parts
from .total3d import total3d_sources


@dataclass(frozen=True)
class Importer:
    """How to read one format."""

    read: Callable[[Path, Hints], Parts]
    what: str
    """What the source is, for people."""


def _total3d(folder: Path, hints: Hints) -> Parts:
    del hints
    return parts_of(total3d_sources(folder))


def _folder(folder: Path, hints: Hints) -> Parts:
    del hints
    return folder_parts(folder)


IMPORTERS: dict[str, Importer] = {
    "folder": Importer(_folder, "another capture, or a part of one"),
    "total3d": Importer(_total3d, "a folder of Total3D or Implicit3D (input/ and output/, or one)"),
    "sam3d": Importer(sam3d_parts, "a folder of SAM 3D Objects: meshes and their poses"),
    "gen3dsr": Importer(gen3dsr_parts, "a folder of Gen3DSR: reconstruction/ and cam_params.json"),
    "glb": Importer(glb_parts, "a glTF scene: each node an object"),
    "boxes": Importer(box_parts, "3D boxes (JSON); meshes come from the furniture library"),
    "release": Importer(release_parts, "a sequence of the MOVER authors' release"),
    "prox": Importer(prox_parts, "PROX, qualitative or quantitative: one --recording"),
    "pigraphs": Importer(pigraphs_parts, "PiGraphs: one --recording"),
    "masks": Importer(mask_parts, "masks alone: COCO, detectron2, SA-V, SAM 3, PNG, npz"),
}
"""Readers of parts, by name."""
