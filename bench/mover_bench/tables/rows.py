"""The rows of the paper's tables: what each is made of, and how the paper made it."""

from collections.abc import Mapping
from dataclasses import dataclass

from mover.pipeline.presets import PRESETS
from mover_bench.experiment.variants import LENGTHS, SEGMENTS, TERMS, Cut, Variant, with_terms

PLAIN = "full"
STAGES = {"initial": "initial", "stage 1": "image", "full": "full"}
"""Scenes of one job that are rows of their own."""
LENGTH, NOISE = "length", "noise"
NOISES: Mapping[str, tuple[float, ...]] = {
    "scale": (0.25, 0.15, 0.05), "place": (0.3, 0.2, 0.1), "turn": (45.0, 30.0, 15.0),
}  # fmt: skip
"""Largest uniform errors of the initial scene: share of the size, [m], [degrees]."""


@dataclass(frozen=True)
class Disturbance:
    """Uniform noise on the initial scene, the same kind on every object."""

    kind: str
    level: float


@dataclass(frozen=True)
class TableRow:
    """A row of ours."""

    label: str
    job: str
    """Name of its job, or its first words where a row is the mean of several."""
    stage: str = "full"
    """initial, image or full."""
    protocol: str = ""
    """How the paper made it, and what is done here."""
    detected: bool = False
    """On the captures with detected boxes and masks."""


def variants(preset: str) -> dict[str, Variant]:
    """All jobs of a preset by name."""
    config = PRESETS[preset]
    people = {"baseline": "baseline", "camgp": "+CamGP", "sdf": "+CamGP+SDF",
              "contact": "+CamGP+SDF+Contact"}  # fmt: skip
    cuts = {
        f"{LENGTH}-{seconds}-{k}": Cut(seconds, (k + 0.5) / SEGMENTS)
        for seconds in LENGTHS
        for k in range(SEGMENTS)
    }
    noises = {noise_job(k, x): Variant(config) for k, levels in NOISES.items() for x in levels}
    return {
        PLAIN: Variant(config),
        **{name: with_terms(config, name) for name in TERMS},
        "contact-depth": with_terms(config, "contact", "depth"),
        **{f"people-{name}": Variant(config, row=row) for name, row in people.items()},
        **{name: Variant(config, cut=cut) for name, cut in cuts.items()},
        **noises,
    }


def noise_job(kind: str, level: float) -> str:
    """Name of a job with a disturbed initial scene."""
    return f"{NOISE}-{kind}-{level:g}"


def disturbance_of(job: str) -> Disturbance | None:
    """The noise of a job; None: it has none."""
    for kind, levels in NOISES.items():
        for level in levels:
            if job == noise_job(kind, level):
                return Disturbance(kind, level)
    return None


ABLATION = (
    TableRow("initial", PLAIN, "initial", "the first scene as it is given"),
    TableRow("Stage 1 + camera", PLAIN, "image", "the image alone, under the camera of the feet"),
    TableRow("+ contact", "contact"),
    TableRow("+ depth", "depth"),
    TableRow("+ collision", "collision"),
    TableRow("+ contact, depth", "contact-depth"),
    TableRow("full", PLAIN),
)
"""Tab. 2, its ablation and Tab. 4: one job for each way of the second stage."""
DETECTED = (
    TableRow("initial, detected", PLAIN, "initial", "boxes and masks of a detector", True),
    TableRow("full, detected", PLAIN, "full", "", True),
)
PEOPLE = (
    TableRow(
        "baseline", "people-baseline", "full",
        "the paper: batch SMPLify-X; here: the capture's bodies, which `robust` smooths in time",
    ),
    TableRow(
        "+ CamGP", "people-camgp", "full",
        "in the room that `full` has found; under `paper` fitted to the keypoints again, if any",
    ),
    TableRow("+ CamGP + SDF", "people-sdf"),
    TableRow("+ CamGP + SDF + Contact", "people-contact"),
)  # fmt: skip
"""Tab. 5: bodies of the capture, refined in the estimated room."""
LONGER = tuple(
    TableRow(f"{s} s", f"{LENGTH}-{s}-", "full", f"mean of {SEGMENTS} segments, evenly spread")
    for s in LENGTHS
)
DISTURBED = tuple(
    TableRow(f"{kind} ± {level:g}", noise_job(kind, level), "full", "uniform noise, one draw")
    for kind, levels in NOISES.items()
    for level in levels
)
"""Tab. 7: the paper disturbs one video (Werkraum_03301_01); here all that are there."""
