"""All formats that are read and written: a format is a file with a function, and a row here.

Listing them imports nothing; a function is imported when it is asked for.
"""

import importlib
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from mover.core.errors import InputError

if TYPE_CHECKING:
    from mover.core.types import Capture

Kind = Literal["capture", "scene", "dataset", "masks", "people", "cameras", "keypoints", "export"]
"""What a function gives: a whole capture of a path; parts of one of a path and hints (scenes, data
sets, masks); people or keypoints of a path and what is known; a camera's path; or files of a result
and a folder."""
BENCH = "mover_bench"
IMPORTED: tuple[Kind, ...] = ("scene", "dataset", "masks")
"""What `mover import` takes."""


@dataclass(frozen=True)
class Format:
    """One row."""

    kind: Kind
    name: str
    what: str
    """What the path is, or what is written, for people."""
    function: str
    """`module:function`, below mover.io or in mover_bench, which is not part of the wheel."""
    options: Mapping[str, str] = field(default_factory=dict[str, str])
    """Arguments that the function takes by name."""

    def load(self) -> Callable[..., Any]:
        """The function; its module is imported now.

        Raises:
            InputError: If it belongs to mover_bench, which is not installed.
        """
        module, _, name = self.function.partition(":")
        if module.startswith(BENCH) and find_spec(BENCH) is None:
            raise InputError(
                f"{self.name}: is read by {BENCH}, which is not part of the installed package; "
                "add the folder bench of mover's repository to PYTHONPATH"
            )
        home = "" if module.startswith(BENCH) else "mover.io."
        found = getattr(importlib.import_module(home + module), name)
        return partial(found, **self.options) if self.options else found


FORMATS = (
    Format("capture", "folder", "a capture folder", "capture.folder:read_capture"),
    Format("capture", "total3d", "a folder of Total3D or Im3D", "scenes.networks:read_total3d"),
    Format("scene", "folder", "another capture, or a part of one", "capture.folder:folder_parts"),
    Format("scene", "total3d", "a folder of Total3D or Implicit3D (input/ and output/, or one)",
           "scenes.networks:total3d_parts"),
    Format("scene", "sam3d", "a folder of SAM 3D Objects: meshes and their poses",
           "scenes.networks:sam3d_parts"),
    Format("scene", "glb", "a glTF scene: each node an object", "scenes.generic:glb_parts"),
    Format("scene", "boxes", "3D boxes (JSON); meshes come from the furniture library",
           "scenes.generic:box_parts"),
    *(
        Format("dataset", name, what, f"mover_bench.datasets.{module}:{name}_parts")
        for name, module, what in (
            ("holisticmesh", "release",
             "a folder of HolisticMesh: models/scene.ply, detections.json"),
            ("release", "release", "a sequence of the MOVER authors' release"),
            ("prox", "prox", "PROX, qualitative or quantitative: one --recording"),
            ("pigraphs", "pigraphs", "PiGraphs: one --recording"),
        )
    ),
    Format("masks", "masks", "masks alone: COCO, labelme, PNG, npz",
           "masks.instance_files:mask_parts"),
    *(
        Format("people", name, what, "people.tools:read", {"tool": name})
        for name, what in (
            ("4dhumans", "results/demo_*.pkl of 4DHumans"),
            ("amass", "motions of AMASS (.npz), a world without a camera"),
            ("gem", "smpl_params.pt of GEM"),
            ("gvhmr", "hmr4d_results.pt of GVHMR"),
            ("pare", "pare_output.pkl of PARE"),
            ("phalp", "results/demo_*.pkl of PHALP"),
            ("prompthmr", "results.pkl of PromptHMR"),
            ("prox", "results/ of PROX's fits"),
            ("sam3dbody", "a folder of SAM 3D Body"),
            ("slahmr", "*_world_results.npz of SLAHMR"),
            ("smplifyx", "results/ of SMPLify-X"),
            ("tram", "a folder of TRAM"),
            ("vibe", "vibe_output.pkl of VIBE"),
            ("wham", "wham_output.pkl of WHAM"),
        )
    ),
    Format("cameras", "colmap", "images.txt of COLMAP's text model", "people.cameras:read_colmap"),
    Format("cameras", "gvhmr", "slam_results.pt of GVHMR", "people.cameras:read_slam"),
    Format("cameras", "megasam", "*_sgd_cvd_hr.npz of MegaSaM", "people.cameras:read_megasam"),
    Format("cameras", "tum", "a trajectory in TUM's format", "people.cameras:read_tum"),
    Format("cameras", "vggt", "predictions.npz of VGGT", "people.cameras:read_vggt"),
    Format("cameras", "vipe", "a folder of ViPE", "people.cameras:read_vipe"),
    Format("cameras", "wham", "slam_results.pth of WHAM", "people.cameras:read_slam"),
    *(
        Format("keypoints", name, what, "people.keypoints:read_instances", {"layout": layout})
        for name, layout, what in (
            ("coco17", "coco17", "COCO's 17 joints: JSON"),
            ("halpe26", "halpe26", "Halpe's 26 joints: JSON"),
            ("mediapipe", "mediapipe33", "MediaPipe's 33 landmarks in pixels: JSON"),
        )
    ),
    Format("keypoints", "openpose", "a folder of OpenPose", "people.keypoints:read_openpose"),
    Format("export", "glb", "the room with moving people, one file", "export.scene_glb:export_glb"),
    Format("export", "usd", "the same as binary USD", "export.usd:export_usd"),
    Format("export", "mjcf", "a world of MuJoCo", "export.solids:export_mjcf"),
    Format("export", "ply", "each object by itself", "export.scene_glb:export_ply"),
    Format("export", "contacts", "labels of contact", "export.contacts:export_contacts"),
    Format("export", "amass", "people with the keys of AMASS", "export.posed:export_amass"),
)  # fmt: skip
"""Names are unique within `capture`, `people`, `cameras`, `keypoints`, `export`, and `IMPORTED`."""


def names(*kinds: Kind) -> list[str]:
    """Names of the formats of some kinds."""
    return [row.name for row in FORMATS if row.kind in kinds]


def listing(*kinds: Kind) -> str:
    """`  name: what it is`, one a line, for the help."""
    return "\n".join(f"  {row.name}: {row.what}" for row in FORMATS if row.kind in kinds)


def chosen(asked: str, name: str, *kinds: Kind) -> Callable[..., Any]:
    """The function of a format.

    Args:
        asked: How a message calls the option, as `--format`.
        name: What was given.
        kinds: Among which it is looked for.
    """
    row = next((row for row in FORMATS if row.name == name and row.kind in kinds), None)
    if row is None:
        raise InputError(f"{asked}: {name!r} is none of {', '.join(names(*kinds))}")
    return row.load()


def read(format: str, path: Path) -> "Capture":
    """Read a whole capture.

    Raises:
        ValueError: If there is no such format.
        InputError: If the data is wrong.
    """
    if format not in (known := names("capture")):
        raise ValueError(f"format is {format!r}, choose one of {', '.join(sorted(known))}")
    return chosen("format", format, "capture")(Path(path))
