"""One page that shows what a run did: pictures, plans, a 3D view, curves and numbers.

The page is one file without any address outside it: it opens from disk, today and in ten years.
"""

import base64
import io
import math
from pathlib import Path

from jaxtyping import Float
from PIL import Image
from torch import Tensor

from mover.app.pictures.film import pixels
from mover.app.pictures.overlay import WIDEST, canvas, draw_overlay, on_cpu, shrink
from mover.app.report.content import ReportContent
from mover.app.report.curves import draw_curves
from mover.app.report.diagnostics import draw_uncertainty, explanations_list
from mover.app.report.plan import draw_top, extent_of
from mover.app.report.scene_view import ReportScene, pack_view
from mover.app.report.tables import (
    QUANTITIES,
    find_changes,
    metrics_table,
    objects_table,
    settings_of,
    stage_bars,
    write_quantity,
)
from mover.app.report.templates import asset, fill
from mover.core.files import replacing
from mover.core.records import map_tensors
from mover.core.types import Scene
from mover.geometry.camera import pitch_roll

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
    image, scenes = content.image, (content.initial, content.result)
    before, after = (_data_url(draw_overlay(canvas(image, s, WIDEST), s)) for s in scenes)
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
            ("What holds them", explanations_list(content.explanations)),
        ),
        curves=draw_curves(content.traces),
        stages=stage_bars(content.stages),
        settings=settings_of(content.config),
        photo="" if image is None else _data_url(shrink(image, WIDEST)),
        view=_view(content),
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
        ("Before", content.initial, content.initial_bodies, ""),
        ("After", content.result, content.bodies, draw_uncertainty(content.explanations)),
    )
    return [
        (name, draw_top(scene, content.truth, bodies, extent=extent, over=over))
        for name, scene, bodies, over in sides
    ]


def _view(content: ReportContent) -> ReportScene:
    """The 3D view's data."""
    scenes = {"initial": content.initial, "result": content.result, "truth": content.truth}
    people = {"initial": content.initial_bodies, "result": content.bodies}
    return pack_view(
        {name: scene for name, scene in scenes.items() if scene is not None},
        {name: bodies for name, bodies in people.items() if bodies is not None},
    )


def _data_url(image: Float[Tensor, "h w 3"]) -> str:
    """The image as a JPEG that stands in the page itself."""
    file = io.BytesIO()
    Image.fromarray(pixels(image)).save(file, "JPEG", quality=QUALITY, subsampling=0)
    return "data:image/jpeg;base64," + base64.b64encode(file.getvalue()).decode()
