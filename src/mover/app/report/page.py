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
from mover.app.report.scene_view import ReportScene, pack_view
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
from mover.geometry.warp_start import beside, mapped


@dataclass(frozen=True)
class ReportContent:
    """Everything that a report can show; what is missing is left out of the page."""

    title: str
    image: Float[Tensor, "h w 3"] | None  #: the reference image, in [0, 1]
    initial: Scene
    result: Scene
    truth: Scene | None = None
    initial_bodies: Bodies | None = None  #: people in the world of `initial`
    bodies: Bodies | None = None  #: people in the world of `result`
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
        return any(b is not None and len(b.verts) > 0 for b in (self.initial_bodies, self.bodies))


QUALITY = 87  # of a JPEG
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
    scenes, worlds = (content.initial, content.result), (content.initial_bodies, content.bodies)
    extent = extent_of(*scenes, *worlds, content.truth)
    scores = [(content.metrics or {}).get(key) or {} for key in ("initial", "result")]
    metrics = [(key, metric_of(key)) for key in TILES if key in scores[1]]
    view, (before, after) = beside(
        lambda: _view(content), lambda: mapped(lambda s: _overlay(content, s), scenes)
    )
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
            (name, draw_top(scene, content.truth, people, extent=extent))
            for name, scene, people in zip(("Before", "After"), scenes, worlds, strict=True)
        ],
        tables=(
            ("How far from the truth", metrics_table(content.metrics or {})),
            (
                "Objects",
                objects_table(content.initial, content.result, content.objects, content.metrics),
            ),
        ),
        longest=max([float(s.get("seconds") or 0) for s in content.stages], default=0.0) or 1.0,
        settings=settings_of(content.config),
        view=view,
    )


def lead(content: ReportContent) -> str:
    """What the run was given, in a sentence, and what it did, in another."""
    parts = [_count(len(content.result.objects), "object", "objects")]
    if content.bodies is not None:
        parts.append(_count(len(content.bodies.person.unique()), "person", "people"))
        parts.append(_count(len(content.bodies.frame.unique()), "frame", "frames"))
    changes = sorted(c.moved for c in find_changes(content.initial, content.result).values())
    did = [f"furniture moved {100 * changes[len(changes) // 2]:.0f} cm (median)"] if changes else []
    scenes = (content.initial, content.result)
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


def _view(content: ReportContent) -> ReportScene:
    """The 3D view's data."""
    scenes = {"initial": content.initial, "result": content.result, "truth": content.truth}
    people = {"initial": content.initial_bodies, "result": content.bodies}
    return pack_view(
        {name: scene for name, scene in scenes.items() if scene is not None},
        {name: bodies for name, bodies in people.items() if bodies is not None},
    )


def _overlay(content: ReportContent, scene: Scene) -> str:
    """The image with the furniture drawn over it, as a JPEG that stands in the page itself."""
    image, file = draw_overlay(canvas(content.image, scene), scene), io.BytesIO()
    Image.fromarray(pixels(image)).save(file, "JPEG", quality=QUALITY, subsampling=0)
    return "data:image/jpeg;base64," + base64.b64encode(file.getvalue()).decode()
