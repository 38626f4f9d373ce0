"""The rows of the paper's tables: ours and how the paper made them, and the published numbers.

Source of the numbers: Yi et al., "Human-Aware Object Placement for Visual Environment
Reconstruction" (MOVER), CVPR 2022, its tables and its supplement: quoted, never computed here.
Measured on PROX and PiGraphs, which cannot be shared, so that they are not comparable with numbers
on known rooms. None: not printed.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

from mover.pipeline.presets import PRESETS
from mover_bench.datasets import pigraphs, prox_files
from mover_bench.experiment.sets import CHANGES
from mover_bench.experiment.variants import LENGTHS, SEGMENTS, TERMS, Cut, Variant, with_terms

PLAIN, INITIAL, BASELINE, FITS = "full", "initial", "people-baseline", "fits-"
"""Jobs: the whole method; the given scene alone; bodies without a room; names of given fits."""
NOISES = {kind: CHANGES[kind].levels[:0:-1] for kind in ("scale", "place", "turn")}
"""Largest uniform errors of the initial scene: share of the size, [m], [degrees]."""


@dataclass(frozen=True)
class TableRow:
    """A row of ours."""

    label: str
    job: str  #: name of its job, or its first words where a row is the mean of several
    stage: str = "full"  #: initial, image or full
    protocol: str = ""  #: how the paper made it, and what is done here
    detected: bool = False  #: on the captures with detected boxes and masks


def variants(preset: str) -> dict[str, Variant]:
    """All jobs of a preset by name."""
    config = PRESETS[preset]
    people = {"baseline": "baseline", "camgp": "+CamGP", "sdf": "+CamGP+SDF",
              "contact": "+CamGP+SDF+Contact"}  # fmt: skip
    cuts = {
        f"length-{seconds}-{k}": Cut(seconds, (k + 0.5) / SEGMENTS)
        for seconds in LENGTHS
        for k in range(SEGMENTS)
    }
    noises = [(kind, level) for kind, levels in NOISES.items() for level in levels]
    return {
        PLAIN: Variant(config),
        INITIAL: Variant(config),
        **{FITS + kind: Variant(config) for kind in prox_files.GIVEN_FITS},
        **{name: with_terms(config, name) for name in TERMS},
        "contact-depth": with_terms(config, "contact", "depth"),
        **{f"people-{name}": Variant(config, row=row) for name, row in people.items()},
        **{name: Variant(config, cut=cut) for name, cut in cuts.items()},
        **{f"noise-{k}-{x:g}": Variant(config, change=f"{k}={x:g}") for k, x in noises},
    }


def at_most(variant: Variant, steps: int) -> Variant:
    """The same with at most so many steps of each descent; 0: as it is."""
    config = variant.config
    stages = {"layout": config.layout, "place": config.place}
    fewer = {
        name: replace(one, method=replace(one.method, steps=min(one.method.steps, steps)))
        for name, one in stages.items()
    }
    return replace(variant, config=replace(config, **fewer)) if steps else variant


ABLATION = (
    TableRow("initial", INITIAL, "initial", "the first scene as it is given"),
    TableRow("Stage 1 + camera", PLAIN, "image", "the image alone, under the camera of the feet"),
    TableRow("+ contact", "contact"),
    TableRow("+ depth", "depth"),
    TableRow("+ collision", "collision"),
    TableRow("+ contact, depth", "contact-depth"),
    TableRow("full", PLAIN),
)
"""Tab. 2, its ablation and Tab. 4: one job for each way of the second stage."""
DETECTED = (
    TableRow("initial, detected", INITIAL, "initial", "boxes and masks of a detector", True),
    TableRow("full, detected", PLAIN, "full", "", True),
)
PEOPLE = (
    *(
        TableRow(f"{kind}, given fits", FITS + kind, "full", "the copy's own fits, in its scan")
        for kind in prox_files.GIVEN_FITS
    ),
    TableRow(
        "baseline", BASELINE, "full",
        "the paper: batch SMPLify-X; here with --vposer the same terms, else the capture's bodies,"
        " refined without a room",
    ),
    TableRow("+ CamGP", "people-camgp", "full", "in the room that is found with these bodies"),
    TableRow("+ CamGP + SDF", "people-sdf"),
    TableRow("+ CamGP + SDF + Contact", "people-contact"),
)  # fmt: skip
"""Tab. 5: bodies refined in the estimated room, below the fits that the user's copy has."""
_SPREAD = "segments of each recording, evenly spread; std: theirs, mean over recordings"
LONGER = tuple(TableRow(f"{s} s", f"length-{s}-", "full", f"{SEGMENTS} {_SPREAD}") for s in LENGTHS)
DISTURBED = tuple(
    TableRow(f"{kind} ± {level:g}", f"noise-{kind}-{level:g}", "full", "uniform noise, one draw")
    for kind, levels in NOISES.items()
    for level in levels
)
"""Tab. 7: the paper disturbs one video (Werkraum_03301_01); here all that are there."""

Quoted = Mapping[str, tuple[float | None, ...]]
"""Printed rows by their labels: the first columns of a table."""
SCENE: Quoted = {
    "HolisticMesh, PointRend": (0.211, 0.410, 0.648, 0.990, 0.369),
    "Total3D, PointRend": (0.246, 0.319, 0.522, 0.974, 0.510),
    "MOVER, PointRend": (0.309, 0.221, 0.777, 0.977, 0.612),
    "HolisticMesh": (0.267, 0.237, 0.745, 0.988, 0.491),
    "Total3D": (0.196, 0.369, 0.227, 0.963, 0.440),
    "MOVER, camera": (0.374, 0.206, 0.859, 0.979, 0.738),
    "MOVER, camera, contact": (0.381, 0.205, 0.904, 0.980, 0.773),
    "MOVER, camera, depth": (0.393, 0.194, 0.907, 0.983, 0.638),
    "MOVER, camera, collision": (0.383, 0.199, 0.903, 0.984, 0.674),
    "MOVER, camera, contact, depth": (0.389, 0.199, 0.904, 0.983, 0.697),
    "MOVER": (0.383, 0.199, 0.898, 0.986, 0.673),
}
"""PROX qualitative; annotated boxes and masks unless PointRend is named."""
STILLS: Quoted = {
    "Total3D": (0.063, 0.409, 0.342, 0.940, 0.436),
    "HolisticMesh": (0.239, 0.133, 0.533, 0.948, 0.951),
    "MOVER": (0.390, 0.095, 0.862, 0.972, 0.934),
}
GRAPHS: Quoted = {
    "Cooperative": (0.686, 0.214), "Holistic++": (0.751, 0.249), "HolisticMesh": (0.756, 0.263),
    "MOVER": (0.792, 0.278),
}  # fmt: skip
CAMERA: Quoted = {
    "Total3D": (0.059, 0.031, 0.045, 0.316, 0.167),
    "MOVER": (0.042, 0.034, 0.038, 0.100, 0.112),
}
BODIES: Quoted = {
    "RGB, scanned scene": (0.22027, 0.21806, 0.07324, 0.06080),
    "PROX, scanned scene": (0.16708, 0.16651, 0.07197, 0.06114),
    "HolisticMesh": (0.19078, 0.19221, 0.07272, 0.06101),
    "MOVER, baseline": (0.21962, 0.22250, 0.07592, 0.06834),
    "MOVER, +CamGP": (0.17641, 0.18009, 0.07341, 0.06733),
    "MOVER, +CamGP+SDF": (0.17598, 0.17998, 0.07396, 0.06829),
    "MOVER, +CamGP+SDF+Contact": (0.17437, 0.17831, 0.07360, 0.06789),
}
LENGTH: Quoted = {
    "10 s": (0.389, 0.018), "20 s": (0.395, 0.015), "30 s": (0.407, 0.010),
    "whole (51 s)": (0.424, None),
}  # fmt: skip
"""Mean and std of IoU3D over ten segments of one video of each scene."""
NOISE: Quoted = {
    "scale ± 0": (0.417,), "scale ± 0.05": (0.4105,), "scale ± 0.15": (0.3805,),
    "scale ± 0.25": (0.345,), "place ± 0": (0.417,), "place ± 0.1": (0.415,),
    "place ± 0.2": (0.416,), "place ± 0.3": (0.4175,), "turn ± 0": (0.417,),
    "turn ± 15": (0.4205,), "turn ± 30": (0.418,), "turn ± 45": (0.4205,),
}  # fmt: skip
"""One video. (The table prints 0.05 % and 10 m where 5 % and 10 cm must be meant.)"""


@dataclass(frozen=True)
class Part:
    """One table of the paper: its columns, our rows and the published ones."""

    title: str
    columns: tuple[str, ...]
    ours: tuple[TableRow, ...]
    quoted: Quoted
    note: str = ""


@dataclass(frozen=True)
class PaperTable:
    """The tables of one data set."""

    title: str
    expected: str  #: on what the paper measures
    count: int  #: recordings of it
    parts: tuple[Part, ...]
    factor: float = 1.0  #: on the overlaps: the paper prints some in percent


STD = "iou3d_std"
OVERLAPS = ("iou3d", "p2s", "iou2d", "non_collision", "contact")
ERRORS = ("pje", "v2v", "p_pje", "p_v2v")
TILTS = ("pitch_error", "roll_error", "mean_tilt",
         "ground_penetration_frequency", "ground_penetration_distance")  # fmt: skip
BOX_NOTE = (
    "IoU2D compares the 3D boxes in the image, as the truth is boxes; P2S is measured from what the"
    " scan has inside them, without the floor."
)
FEET_NOTE = (
    "Foot contacts are those of contacts.npz (POSA), else estimated from the bodies; more than 1 cm"
    " below the floor counts. Angles in radians."
)
CAPSULES = (
    "As imported, people are capsules about Kinect's joints and have no masks: no depth order, and"
    " no contact but of soles. The paper has SMPLify-X's bodies: `mover fit` the pictures first."
)
ENDS = (ABLATION[0], ABLATION[-1])
TABLES: dict[str, PaperTable] = {
    "prox": PaperTable(
        "PROX qualitative",
        f"{prox_files.VIDEOS} videos of {len(prox_files.SCENES)} scenes, without the two booths",
        prox_files.VIDEOS,
        (
            Part("Scenes and interaction", OVERLAPS, (*ABLATION, *DETECTED), SCENE, BOX_NOTE),
            Part("Camera and ground", TILTS, ENDS, CAMERA, FEET_NOTE),
            Part("Length of the video", ("iou3d", STD), (*LONGER, ABLATION[-1]), LENGTH),
            Part("Noise on the initial scene", ("iou3d",), (*DISTURBED, ABLATION[-1]), NOISE),
        ),
    ),
    "prox-quantitative": PaperTable(
        "PROX quantitative",
        f"{prox_files.SHOTS} frames of one scene",
        1,
        (
            Part("Scenes and interaction", OVERLAPS, ABLATION, STILLS, BOX_NOTE),
            Part("People [mm]", ERRORS, PEOPLE, BODIES),
        ),
    ),
    "pigraphs": PaperTable(
        "PiGraphs",
        f"{pigraphs.VIDEOS} videos of {pigraphs.ROOMS} scenes; overlaps in percent",
        pigraphs.VIDEOS,
        (Part("Scenes", ("iou2d", "iou3d"), (*ABLATION[:2], ABLATION[-1]), GRAPHS, CAPSULES),),
        100.0,
    ),
}
"""The tables by name."""
