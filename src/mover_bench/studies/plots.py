"""Small line plots as SVG files, a panel beside the other."""

import io
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from mover.core.colours import PALETTE, css

SIZE = (4.2, 3.1)  # [inch] of a panel
COLUMNS = 3  # panels in a row
LOOK: Any = {
    "svg.hashsalt": "mover",
    "svg.fonttype": "none",
    "font.size": 9,
}  # the same bytes each time


@dataclass(frozen=True)
class Line:
    """A curve with intervals."""

    label: str
    points: tuple[tuple[float, float], ...]
    """(x, y), x ascending."""
    spans: tuple[tuple[float, float], ...] = ()
    """Lowest and highest y at each point; empty: not drawn."""


@dataclass(frozen=True)
class Panel:
    """A plot."""

    title: str
    x: str
    y: str
    lines: tuple[Line, ...]


def draw_panels(panels: Sequence[Panel]) -> str:
    """All panels in one SVG."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    drawn = [panel for panel in panels if any(line.points for line in panel.lines)]
    columns = max(1, min(COLUMNS, len(drawn)))
    rows = max(1, math.ceil(len(drawn) / columns))
    text = io.StringIO()
    with rc_context(LOOK):
        figure = Figure((SIZE[0] * columns, SIZE[1] * rows), layout="constrained")
        for place, panel in enumerate(drawn, 1):
            _draw(panel, figure.add_subplot(rows, columns, place))
        figure.savefig(text, format="svg", metadata={"Date": None})
    return text.getvalue()[text.getvalue().index("<svg") :]


def _draw(panel: Panel, axes: Any) -> None:  # noqa: ANN401
    for index, line in enumerate(panel.lines):
        if line.points:
            x, y = zip(*line.points, strict=True)
            ends = [(m - low, high - m) for m, (low, high) in zip(y, line.spans, strict=False)]
            axes.errorbar(
                x, y, list(zip(*ends, strict=True)) or None, label=line.label, marker="o",
                markersize=4, color=css(PALETTE[index % len(PALETTE)]),
            )  # fmt: skip
    axes.set_title(panel.title, loc="left", fontweight="bold")
    axes.set_xlabel(panel.x)
    axes.set_ylabel(panel.y)
    axes.grid(alpha=0.3)
    axes.legend(fontsize=8)
