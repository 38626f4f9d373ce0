"""One page that shows what a run did: pictures, plans, a 3D view, curves and numbers.

The page is one file without any address outside it: it opens from disk, today and in ten years.
"""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from html import escape
from importlib.resources import files
from pathlib import Path
from typing import Any

from jaxtyping import Float
from torch import Tensor

from . import __version__
from .geometry.camera import pitch_roll
from .records import replacing
from .report_curves import draw_curves
from .report_overlay import draw_overlay
from .report_pictures import data_url, draw_comparison, shrink
from .report_plan import draw_top, extent_of
from .report_tables import (
    QUANTITIES,
    config_list,
    find_changes,
    metrics_table,
    objects_table,
    stage_bars,
    warnings_box,
    write_quantity,
)
from .report_view import pack_view
from .types import Bodies, Scene

__all__ = ["ReportContent", "draw_overlay", "draw_top", "write_report"]

WIDEST = 1280  # [px], of a picture in the page
TILES = ("iou3d", "center_error", "contact_f1", "pitch_error")


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
    """`name`, `seconds`, `memory` [MB] and `kept` of each stage."""
    config: Mapping[str, Any] = field(default_factory=lambda: {})
    objects: Sequence[Mapping[str, Any]] = ()
    """Rows of the table of objects, found by `id`; other keys become columns."""
    command: str = ""
    """What the user typed."""
    version: str = __version__


def write_report(out: Path, content: ReportContent) -> Path:
    """Write the page, all at once, and return where it is.

    Args:
        out: The file, or the folder that gets `report.html`.
        content: What to show.
    """
    path = out if out.suffix == ".html" else out / "report.html"
    page = _fill(
        "report.html",
        title=escape(content.title),
        version=escape(content.version),
        style=_asset("report.css"),
        script=_asset("page.js") + _asset("viewer.js"),
        lead=_lead(content),
        tiles=_tiles(content),
        sections="\n".join(s for s in _sections(content) if s),
        data=_data(content),
        footer=f"Made by mover {escape(content.version)}.",
    )
    with replacing(path) as part:
        part.write_text(page, encoding="utf-8")
    return path


def _asset(name: str) -> str:
    return files("mover").joinpath("assets", name).read_text(encoding="utf-8")


def _fill(name: str, **parts: str) -> str:
    """Put `parts` in the places of an asset that are marked {{so}}."""
    return re.sub(r"\{\{(\w+)\}\}", lambda found: parts[found[1]], _asset(name))


def _sections(content: ReportContent) -> list[str]:
    return [
        warnings_box(content.warnings),
        _overlays(content),
        _stage(content),
        _plans(content),
        _section("How far from the truth", metrics_table(content.metrics or {})),
        _section(
            "Objects",
            objects_table(content.initial, content.result, content.objects, content.metrics),
        ),
        _running(content),
    ]


def _section(title: str, body: str) -> str:
    return f"<section><h2>{title}</h2>{body}</section>" if body else ""


def _lead(content: ReportContent) -> str:
    """What the run saw, in a sentence, and what it did, in another."""
    parts = [_count(len(content.result.pieces), "object")]
    if content.bodies is not None:
        parts.append(_count(len(content.bodies.person.unique()), "person", "people"))
        parts.append(_count(len(content.bodies.frame.unique()), "frame"))
    old, new = (_tilt(s) for s in (content.initial, content.result))
    changes = sorted(c.moved for c in find_changes(content.initial, content.result).values())
    moved = (
        f" The furniture moved by {100 * changes[len(changes) // 2]:.0f} cm (median)"
        if changes
        else ""
    )
    return f"{', '.join(parts)}.{moved}{'; the' if moved else ' The'} camera's pitch went from {old} to {new}."


def _count(number: int, one: str, many: str = "") -> str:
    return f"{number:,} {one if number == 1 else many or one + 's'}"


def _tilt(scene: Scene) -> str:
    return f"{math.degrees(float(pitch_roll(scene.camera.R_cam_world)[0])):.1f}°".replace("-", "−")


def _tiles(content: ReportContent) -> str:
    """The few numbers that matter most, before and after."""
    before, after = ((content.metrics or {}).get(k) or {} for k in ("initial", "result"))
    tiles = [
        f"<div><dt>{escape(QUANTITIES[k].label)}</dt><dd><small>{write_quantity(k, before.get(k), False)} →</small> "
        f"{write_quantity(k, after.get(k))}</dd></div>"
        for k in TILES
        if k in after
    ]
    return f'<dl class="tiles">{"".join(tiles)}</dl>' if tiles else ""


def _overlays(content: ReportContent) -> str:
    image = None if content.image is None else shrink(content.image, WIDEST)
    return _section("On the image", draw_comparison(image, content.initial, content.result, WIDEST))


def _stage(content: ReportContent) -> str:
    """The frame around the 3D view: what can be switched on in it."""
    checks = {
        "people": _anybody(content),
        "truth": content.truth is not None,
        "photo": content.image is not None,
        "labels": True,
    }
    names = {"people": "People", "truth": "Truth", "photo": "Photo", "labels": "Names"}
    boxes = "".join(
        f'<label><input type="checkbox" data-show="{key}"{"" if key == "truth" else " checked"}> {names[key]}</label>'
        for key, there in checks.items()
        if there
    )
    worlds = (
        '<div class="choice" role="group" aria-label="Which scene">'
        '<button type="button" data-world="initial">Before</button>'
        '<button type="button" data-world="result">After</button></div>'
    )
    time = _fill("report_time.html") if _anybody(content) else ""
    return _fill("report_stage.html", worlds=worlds, checks=boxes, time=time)


def _anybody(content: ReportContent) -> bool:
    return any(b is not None and len(b.verts) > 0 for b in (content.bodies, content.initial_bodies))


def _data(content: ReportContent) -> str:
    """The 3D view's data, and the clean image for its camera."""
    scenes = {"initial": content.initial, "result": content.result, "truth": content.truth}
    people = {"initial": content.initial_bodies, "result": content.bodies}
    view = pack_view(
        {name: scene for name, scene in scenes.items() if scene is not None},
        {name: bodies for name, bodies in people.items() if bodies is not None},
    )
    photo = ""
    if content.image is not None:
        photo = f'<img id="photo" hidden alt="" src="{data_url(shrink(content.image, WIDEST))}">'
    return (
        f'{photo}<script type="application/json" id="view-data">{view.text}</script>'
        f'<script type="text/plain" id="view-block">{view.block}</script>'
    )


def _plans(content: ReportContent) -> str:
    extent = extent_of(content.initial, content.result, content.truth)
    sides = (
        ("Before", content.initial, content.initial_bodies),
        ("After", content.result, content.bodies),
    )
    figures = "".join(
        f"<figure><figcaption>{name}</figcaption>{draw_top(s, content.truth, b, extent=extent)}</figure>"
        for name, s, b in sides
    )
    return _section("From above", f'<div class="plans">{figures}</div>{_key(content)}')


def _key(content: ReportContent) -> str:
    """What the signs of the plans mean."""
    signs = ['<path d="M8 9L13 4L18 9"/></svg>front of an object']
    if content.truth is not None:
        signs.append('<path stroke-dasharray="4 4" d="M0 6H26"/></svg>truth')
    if _anybody(content):
        signs.append(
            '<path stroke="var(--person)" stroke-width="5" d="M4 6h0M13 6h0M22 6h0"/></svg>hips of people'
        )
        signs.append(
            '<path stroke="var(--person)" stroke-width="3" d="M4 6h0M13 6h0M22 6h0"/></svg>their feet'
        )
    form = '<svg viewBox="0 0 26 12" fill="none" stroke="currentColor" stroke-width="1.5" stroke-linecap="round" aria-hidden="true">'
    return f'<p class="key">{"".join(f"<span>{form}{sign}</span>" for sign in signs)}</p>'


def _running(content: ReportContent) -> str:
    """How the result was made: curves, stages, settings and the command."""
    curves, bars, settings = (
        draw_curves(content.traces),
        stage_bars(content.stages),
        config_list(content.config),
    )
    parts = [
        f"<h3>Energies</h3>{curves}" if curves else "",
        f"<h3>Stages</h3>{bars}" if bars else "",
        f'<h3>Command</h3><pre class="command">{escape(content.command)}</pre>'
        if content.command
        else "",
        f"<details><summary>Settings</summary>{settings}</details>" if settings else "",
    ]
    return (
        f'<section class="run"><h2>How it was made</h2>{"".join(parts)}</section>'
        if any(parts)
        else ""
    )
