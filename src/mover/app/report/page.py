"""One page that shows what a run did: pictures, plans, a 3D view, curves and numbers.

The page is one file without any address outside it: it opens from disk, today and in ten years.
"""

import base64
import io
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from jaxtyping import Float
from PIL import Image
from torch import Tensor

from mover import __version__
from mover.app.pictures.film import pixels
from mover.app.pictures.overlay import WIDEST, canvas, draw_overlay, on_cpu
from mover.app.report.plan import draw_top, extent_of
from mover.app.report.scene_view import ReportScene, pack_view
from mover.app.report.tables import (
    QUANTITIES,
    find_changes,
    metrics_table,
    objects_table,
    settings_of,
    write_quantity,
)
from mover.app.report.templates import asset, fill
from mover.core.files import replacing
from mover.core.records import map_tensors
from mover.core.types import Bodies, Scene
from mover.geometry.camera import pitch_roll
from mover.geometry.warp_start import beside, mapped


@dataclass(frozen=True)
class ReportContent:
    """Everything that a report can show; what is missing is left out of the page."""

    title: str
    image: Float[Tensor, "h w 3"] | None
    """The reference image, in [0, 1]."""
    initial: Scene
    result: Scene
    truth: Scene | None = None
    initial_bodies: Bodies | None = None
    """People in the world of `initial`."""
    bodies: Bodies | None = None
    """People in the world of `result`."""
    traces: Mapping[str, Sequence[float]] = field(default_factory=lambda: {})
    """Total energy before each step, by stage."""
    metrics: Mapping[str, Any] | None = None
    """What metrics.json holds."""
    warnings: tuple[str, ...] = ()
    stages: Sequence[Mapping[str, Any]] = ()
    """`name`, `seconds`, `memory` or `peak_memory` [MB] and `kept` of each stage."""
    config: Mapping[str, Any] = field(default_factory=lambda: {})
    objects: Sequence[Mapping[str, Any]] = ()
    """Rows of the table of objects, found by `id`; other keys become columns."""
    command: str = ""
    """What the user typed."""
    version: str = __version__

    @property
    def peopled(self) -> bool:
        """Whether there are people to show."""
        return any(b is not None and len(b.verts) > 0 for b in (self.initial_bodies, self.bodies))


QUALITY = 87  # of a JPEG
TILES = ("iou3d", "center_error", "contact_f1", "pitch_error")


def write_report(out: Path, content: ReportContent) -> Path:
    """Write the page, all at once, and return where it is.

    Args:
        out: The file, or the folder that gets `report.html`.
        content: What to show.
    """
    content = map_tensors(on_cpu, content)
    path = out if out.suffix == ".html" else out / "report.html"
    with replacing(path) as part:
        part.write_text(_page(content), encoding="utf-8")
    return path


def _page(content: ReportContent) -> str:
    """The whole text."""
    scenes = (content.initial, content.result)
    view, (before, after) = beside(
        lambda: _view(content), lambda: mapped(lambda s: _overlay(content, s), scenes)
    )
    objects = objects_table(content.initial, content.result, content.objects, content.metrics)
    return fill(
        "page.html",
        content=content,
        style=asset("report.css"),
        script=asset("page.js") + asset("viewer.js"),
        lead=lead(content),
        tiles=_tiles(content),
        before=before,
        after=after,
        plans=_plans(content),
        tables=(
            ("How far from the truth", metrics_table(content.metrics or {})),
            ("Objects", objects),
        ),
        curves=draw_curves(content.traces),
        longest=max([float(s.get("seconds") or 0) for s in content.stages], default=0.0) or 1.0,
        settings=settings_of(content.config),
        view=view,
    )


def lead(content: ReportContent) -> str:
    """What the run saw, in a sentence, and what it did, in another."""
    parts = [_count(len(content.result.objects), "object")]
    if content.bodies is not None:
        parts.append(_count(len(content.bodies.person.unique()), "person", "people"))
        parts.append(_count(len(content.bodies.frame.unique()), "frame"))
    changes = sorted(c.moved for c in find_changes(content.initial, content.result).values())
    moves = f"furniture moved {100 * changes[len(changes) // 2]:.0f} cm (median)" if changes else ""
    scenes = (content.initial, content.result)
    seen = f"camera pitch {_from_to([_tilt(s) for s in scenes], '°')}"
    heights = [-s.ground for s in scenes if s.ground is not None]
    above = f", height {_from_to([f'{h:.2f}' for h in heights], ' m')}" if heights else ""
    did = "; ".join(part for part in (moves, seen + above) if part)
    return f"{', '.join(parts)}. {did[0].upper()}{did[1:]}."


def _from_to(values: list[str], unit: str) -> str:
    """The first and the last value; one alone where they are the same."""
    return " → ".join(dict.fromkeys((values[0], values[-1]))) + unit


def _tilt(scene: Scene) -> str:
    degrees = math.degrees(float(pitch_roll(scene.camera.R_cam_world)[0]))
    return f"{round(degrees, 1) + 0.0:.1f}".replace("-", "\N{MINUS SIGN}")


def _count(number: int, one: str, many: str = "") -> str:
    return f"{number:,} {one if number == 1 else many or one + 's'}"


def _tiles(content: ReportContent) -> list[tuple[str, str, str]]:
    """The few numbers that matter most, before and after."""
    before, after = ((content.metrics or {}).get(k) or {} for k in ("initial", "result"))
    return [
        (
            QUANTITIES[k].label,
            write_quantity(k, before.get(k), False),
            write_quantity(k, after.get(k)),
        )
        for k in TILES
        if k in after
    ]


def _plans(content: ReportContent) -> list[tuple[str, str]]:
    """The room from above, before and after."""
    scenes = [content.initial, content.result, content.truth]
    extent = extent_of(*scenes, content.initial_bodies, content.bodies)
    sides = (
        ("Before", content.initial, content.initial_bodies),
        ("After", content.result, content.bodies),
    )
    return [
        (name, draw_top(scene, content.truth, bodies, extent=extent))
        for name, scene, bodies in sides
    ]


def _view(content: ReportContent) -> ReportScene:
    """The 3D view's data."""
    scenes = {"initial": content.initial, "result": content.result, "truth": content.truth}
    people = {"initial": content.initial_bodies, "result": content.bodies}
    return pack_view(
        {name: scene for name, scene in scenes.items() if scene is not None},
        {name: bodies for name, bodies in people.items() if bodies is not None},
    )


def _overlay(content: ReportContent, scene: Scene) -> str:
    """The image with the furniture drawn over it."""
    return _data_url(draw_overlay(canvas(content.image, scene, WIDEST), scene))


def _data_url(image: Float[Tensor, "h w 3"]) -> str:
    """The image as a JPEG that stands in the page itself."""
    file = io.BytesIO()
    Image.fromarray(pixels(image)).save(file, "JPEG", quality=QUALITY, subsampling=0)
    return "data:image/jpeg;base64," + base64.b64encode(file.getvalue()).decode()


WIDTH, HEIGHT = 420.0, 200.0  # [px] of a plot
LEFT, RIGHT, TOP, BOTTOM = 52.0, 12.0, 12.0, 28.0  # [px] around its frame
POINTS = 320  # at most so many points are drawn
DEEPEST = 1e-12  # a curve is drawn down to this share of its highest value
DECADES = 2.2  # below this many decades, 2 and 5 are ticks too


def draw_curves(traces: Mapping[str, Sequence[float]]) -> str:
    """Plot the total energy of each stage over its iterations on a logarithmic scale."""
    plots = [
        {
            "name": name,
            "curve": draw_curve(trace),
            "first": _short(_finite(trace)[0]),
            "last": _short(_finite(trace)[-1]),
            "steps": len(trace),
        }
        for name, trace in traces.items()
        if _finite(trace)
    ]
    return fill("curves.html", plots=plots) if plots else ""


def draw_curve(trace: Sequence[float]) -> str:
    """One plot; values that have no logarithm are drawn at the lower edge."""
    pairs = _thinned(trace)
    low, high = _range([v for _, v in pairs])
    last = max(1, len(trace) - 1)

    def x(step: float) -> float:
        return LEFT + (WIDTH - LEFT - RIGHT) * step / last

    def y(value: float) -> float:
        share = (math.log10(max(value, low)) - math.log10(low)) / math.log10(high / low)
        return HEIGHT - BOTTOM - (HEIGHT - TOP - BOTTOM) * share

    return fill(
        "curve.svg",
        width=f"{WIDTH:.0f}",
        height=f"{HEIGHT:.0f}",
        left=LEFT,
        right=WIDTH - RIGHT,
        floor=HEIGHT - BOTTOM,
        levels=[
            {"at": f"{y(v):.1f}", "below": f"{y(v) + 4:.1f}", "text": _short(v)}
            for v in _ticks(low, high)
        ],
        steps=[{"at": f"{x(s):.1f}", "text": s} for s in _steps(last)],
        line="L".join(f"{x(s):.1f} {y(v):.1f}" for s, v in pairs),
        start=f"{x(pairs[0][0]):.1f}",
        end=f"{x(pairs[-1][0]):.1f}",
    )


def _finite(trace: Iterable[float]) -> list[float]:
    return [v for v in trace if math.isfinite(v)]


def _thinned(trace: Sequence[float]) -> list[tuple[int, float]]:
    """(step, value) at an even stride, the last step always included."""
    stride = max(1, math.ceil(len(trace) / POINTS))
    steps = sorted({*range(0, len(trace), stride), len(trace) - 1})
    return [(s, trace[s]) for s in steps if math.isfinite(trace[s])] or [(0, _finite(trace)[0])]


def _range(values: Sequence[float]) -> tuple[float, float]:
    positive = [v for v in values if v > 0] or [1.0]
    high = max(positive)
    low = max(min(positive), high * DEEPEST)
    pad = max(1.05, (high / low) ** 0.06)
    return low / pad, high * pad


def _ticks(low: float, high: float) -> list[float]:
    span = math.log10(high / low)
    marks = (1, 2, 5) if span < DECADES else (1,)
    if span < 0.35:
        marks = (1, 1.2, 1.5, 2, 2.5, 3, 4, 5, 6, 7, 8, 9)
    decades = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    ticks = [m * 10.0**d for d in decades for m in marks if low <= m * 10.0**d <= high]
    return ticks[:: max(1, math.ceil(len(ticks) / 5))]


def _steps(last: int) -> list[int]:
    raw = last / 4
    base = 10 ** math.floor(math.log10(max(raw, 1)))
    step = next((m * base for m in (1, 2, 5, 10) if m * base >= raw), 10 * base)
    return list(range(0, last + 1, step))


def _short(value: float) -> str:
    """Three significant digits."""
    if value == 0:
        return "0"
    if 1e-3 <= abs(value) < 1e5:
        digits = max(0, 2 - math.floor(math.log10(abs(value))))
        text = f"{value:,.{digits}f}"
        return text.rstrip("0").rstrip(".") if "." in text else text
    return f"{value:.2g}".replace("e-0", "e-").replace("e+0", "e")
