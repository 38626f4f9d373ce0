"""One page that shows what a run did: pictures, plans, a 3D view, curves and numbers.

The page is one file without any address outside it: it opens from disk, today and in ten years.
"""

from html import escape
from pathlib import Path

from torch import Tensor

from .records import map_tensors, replacing
from .report_content import ReportContent
from .report_overlay import draw_overlay
from .report_pictures import bitmap, canvas
from .report_plan import draw_top
from .report_sections import WIDEST, all_sections, asset, data, fill, lead, tiles
from .types import Capture

__all__ = ["ReportContent", "draw_overlay", "draw_top", "save_overlay", "write_report"]


def write_report(out: Path, content: ReportContent) -> Path:
    """Write the page, all at once, and return where it is.

    Args:
        out: The file, or the folder that gets `report.html`.
        content: What to show.
    """
    content = map_tensors(_plain, content)
    path = out if out.suffix == ".html" else out / "report.html"
    page = fill(
        "report.html",
        title=escape(content.title),
        version=escape(content.version),
        style=asset("report.css"),
        script=asset("page.js") + asset("viewer.js"),
        lead=lead(content),
        tiles=tiles(content),
        sections="\n".join(s for s in all_sections(content) if s),
        data=data(content),
        footer=f"Made by mover {escape(content.version)}.",
    )
    with replacing(path) as part:
        part.write_text(page, encoding="utf-8")
    return path


def save_overlay(capture: Capture, path: Path) -> Path:
    """Draw the initial scene over the reference image into the file `path` (.png, .jpg, ...)."""
    scene, image = map_tensors(_plain, (capture.scene, capture.reference))
    picture = bitmap(draw_overlay(canvas(image, scene, WIDEST), scene))
    with replacing(path) as part:
        picture.save(part)
    return path


def _plain(tensor: Tensor) -> Tensor:
    """On the CPU, in single precision, without a history."""
    there = tensor.detach().cpu()
    return there.float() if there.is_floating_point() else there
