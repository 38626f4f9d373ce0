"""One page that shows what a run did: pictures, plans, a 3D view and numbers.

The page is one file without any address outside it: it opens from disk, today and in ten years.
"""

import base64
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from jaxtyping import Float
from PIL import Image
from torch import Tensor

from mover import __version__
from mover.app.pictures.film import pixels
from mover.app.pictures.overlay import canvas, draw_overlay, on_cpu
from mover.app.report import asset, fill
from mover.app.report.plan import draw_top, extent_of
from mover.app.report.scene_view import pack_view
from mover.app.report.tables import (
    find_changes,
    metric_of,
    metrics_table,
    objects_table,
    settings_of,
    shown,
)
from mover.core.files import replacing
from mover.core.records import map_tensors
from mover.core.types import Bodies, Scene
from mover.geometry.camera import pitch_roll


@dataclass(frozen=True)
class ReportContent:
    """Everything that a report can show; what is missing is left out of the page."""

    title: str
    image: Float[Tensor, "h w 3"] | None  #: the reference image, in [0, 1]
    scenes: Mapping[str, Scene]  #: `initial` and `result`, and the `truth` where it is known
    bodies: Mapping[str, Bodies] = field(default_factory=lambda: {})
    """People in the worlds of `initial` and `result`."""
    metrics: Mapping[str, Any] | None = None  #: what metrics.json holds
    warnings: tuple[str, ...] = ()
    stages: Sequence[Mapping[str, Any]] = ()
    """`name`, `seconds`, `memory` or `peak_memory` [MB] and `kept` of each stage."""
    config: Mapping[str, Any] = field(default_factory=lambda: {})
    objects: Sequence[Mapping[str, Any]] = ()
    """Rows of the table of objects, found by `id`; other keys become columns."""
    command: str = ""  #: what the user typed
    version: str = __version__
    estimates: tuple[str, ...] = ()
    """Lens and scale with their spreads, and what would narrow them."""

    @property
    def peopled(self) -> bool:
        """Whether there are people to show."""
        return any(len(bodies.verts) > 0 for bodies in self.bodies.values())


QUALITY = 87  # of a JPEG
SIDES = {"Before": "initial", "After": "result"}
TILES = ("iou3d", "center_error", "contact_f1", "pitch_error")


def write_report(out: Path, content: ReportContent) -> Path:
    """Write the page, all at once, into a file or as `report.html` of a folder; where it is."""
    content = map_tensors(on_cpu, content)
    path = out if out.suffix == ".html" else out / "report.html"
    with replacing(path) as part:
        part.write_text(_page(content), encoding="utf-8")
    return path


def _page(content: ReportContent) -> str:
    """The whole text."""
    scenes, people, sides = content.scenes, content.bodies, list(SIDES.values())
    extent = extent_of(*scenes.values(), *people.values())
    scores = [(content.metrics or {}).get(side) or {} for side in sides]
    metrics = [(key, metric_of(key)) for key in TILES if key in scores[1]]
    text, block = pack_view(scenes, people)
    before, after = (_overlay(content.image, scenes[side]) for side in sides)
    return fill(
        "page.html",
        content=content,
        style=asset("report.css"),
        script=asset("page.js") + asset("viewer.js"),
        lead=lead(content),
        tiles=[
            (m.label, shown(m.unit, scores[0].get(key)), shown(m.unit, scores[1][key], named=True))
            for key, m in metrics
        ],
        before=before,
        after=after,
        plans=[
            (name, draw_top(scenes[side], scenes.get("truth"), people.get(side), extent=extent))
            for name, side in SIDES.items()
        ],
        tables=(
            ("How far from the truth", metrics_table(content.metrics or {})),
            ("Objects", objects_table(scenes, content.objects, content.metrics)),
        ),
        longest=max([float(s.get("seconds") or 0) for s in content.stages], default=0.0) or 1.0,
        settings=settings_of(content.config),
        text=text,
        block=block,
    )


def lead(content: ReportContent) -> str:
    """What the run was given, in a sentence, and what it did, in another."""
    scenes = [content.scenes[side] for side in SIDES.values()]
    parts = [_count(len(scenes[1].objects), "object", "objects")]
    if (people := content.bodies.get("result")) is not None:
        parts.append(_count(len(people.person.unique()), "person", "people"))
        parts.append(_count(len(people.frame.unique()), "frame", "frames"))
    changes = sorted(c.moved for c in find_changes(*scenes).values())
    did = [f"furniture moved {100 * changes[len(changes) // 2]:.0f} cm (median)"] if changes else []
    tilts = [math.degrees(float(pitch_roll(s.camera.R_cam_world)[0])) for s in scenes]
    texts = [f"{round(t, 1) + 0.0:.1f}".replace("-", "\N{MINUS SIGN}") for t in tilts]
    camera = f"camera pitch {_from_to(texts)}°"
    heights = [f"{-s.ground:.2f}" for s in scenes if s.ground is not None]
    did.append(f"{camera}, height {_from_to(heights)} m" if heights else camera)
    text = "; ".join(did)
    return f"{', '.join(parts)}. {text[0].upper()}{text[1:]}."


def _from_to(values: list[str]) -> str:
    """The first and the last value; one alone where they are the same."""
    return " → ".join(dict.fromkeys((values[0], values[-1])))


def _count(number: int, one: str, many: str) -> str:
    return f"{number:,} {one if number == 1 else many}"


def _overlay(image: Float[Tensor, "h w 3"] | None, scene: Scene) -> str:
    """The image with the furniture drawn over it, as a JPEG that stands in the page itself."""
    drawn, file = draw_overlay(canvas(image, scene), scene), io.BytesIO()
    Image.fromarray(pixels(drawn)).save(file, "JPEG", quality=QUALITY, subsampling=0)
    return "data:image/jpeg;base64," + base64.b64encode(file.getvalue()).decode()
