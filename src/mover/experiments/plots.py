"""Small line plots as SVG files, a panel beside the other."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from html import escape

from ..report_colours import PALETTE, css

WIDTH, HEIGHT = 320.0, 240.0  # [px] of a panel
LEFT, RIGHT, TOP, BOTTOM = 52.0, 14.0, 30.0, 64.0  # [px] around its frame
COLUMNS = 3  # panels in a row
LETTER = 6.6  # [px] of a letter of a label
STYLE = "font:12px sans-serif;fill:#333"


@dataclass(frozen=True)
class Line:
    """A curve with intervals."""

    label: str
    points: tuple[tuple[float, float], ...]
    """(x, y), x ascending."""
    spans: tuple[tuple[float, float], ...] = ()
    """Lowest and highest y at each point; empty: not drawn."""
    dashed: bool = False
    """Quoted, not computed."""


@dataclass(frozen=True)
class Panel:
    """A plot."""

    title: str
    x: str
    y: str
    lines: tuple[Line, ...]


def draw_panels(panels: Sequence[Panel]) -> str:
    """All panels in one SVG."""
    shown = [panel for panel in panels if any(line.points for line in panel.lines)]
    columns = max(1, min(COLUMNS, len(shown)))
    rows = max(1, math.ceil(len(shown) / columns))
    body = "".join(
        f'<g transform="translate({WIDTH * (k % columns):.0f} {HEIGHT * (k // columns):.0f})">'
        f"{_panel(panel)}</g>"
        for k, panel in enumerate(shown)
    )
    size = f"{WIDTH * columns:.0f} {HEIGHT * rows:.0f}"
    return (
        f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {size}" '
        f'width="{WIDTH * columns:.0f}" height="{HEIGHT * rows:.0f}" style="{STYLE}">'
        f'<rect width="100%" height="100%" fill="white"/>{body}</svg>\n'
    )


def _panel(panel: Panel) -> str:
    xs = [x for line in panel.lines for x, _ in line.points]
    ys = [y for line in panel.lines for _, y in line.points]
    ys += [y for line in panel.lines for span in line.spans for y in span]
    (x0, x1), (y0, y1) = _range(xs, 0.0), _range(ys, 0.08)

    def at(x: float, y: float) -> tuple[float, float]:
        across = (WIDTH - LEFT - RIGHT) * (x - x0) / (x1 - x0)
        return LEFT + across, HEIGHT - BOTTOM - (HEIGHT - TOP - BOTTOM) * (y - y0) / (y1 - y0)

    grid = ""
    for y in _ticks(y0, y1):
        row = at(x0, y)[1]
        grid += f'<path stroke="#ddd" d="M{LEFT} {row:.1f}H{WIDTH - RIGHT}"/>'
        grid += f'<text x="{LEFT - 6}" y="{row + 4:.1f}" text-anchor="end">{y:g}</text>'
    for x in _ticks(x0, x1):
        column, floor = at(x, y0)
        grid += f'<text x="{column:.1f}" y="{floor + 16:.1f}" text-anchor="middle">{x:g}</text>'
    lines = "".join(_line(line, k, at) for k, line in enumerate(panel.lines) if line.points)
    lines += _labels(panel.lines)
    middle = (LEFT + WIDTH - RIGHT) / 2
    names = (
        f'<text x="{LEFT}" y="16" font-weight="bold">{escape(panel.title)}</text>'
        f'<text x="{middle:.0f}" y="{HEIGHT - 30:.0f}" text-anchor="middle">'
        f"{escape(panel.x)}</text>"
        f'<text x="{WIDTH - RIGHT:.0f}" y="16" text-anchor="end">{escape(panel.y)}</text>'
    )
    return grid + names + lines


def _line(line: Line, index: int, at: Callable[[float, float], tuple[float, float]]) -> str:
    tone = css(PALETTE[index % len(PALETTE)])
    places = [at(x, y) for x, y in line.points]
    path = "L".join(f"{x:.1f} {y:.1f}" for x, y in places)
    dash = ' stroke-dasharray="5 4"' if line.dashed else ""
    drawn = f'<path fill="none" stroke="{tone}" stroke-width="2"{dash} d="M{path}"/>'
    for (x, _), (low, high) in zip(line.points, line.spans, strict=False):
        (column, bottom), (_, top) = at(x, low), at(x, high)
        drawn += f'<path stroke="{tone}" d="M{column:.1f} {bottom:.1f}V{top:.1f}"/>'
    return drawn + "".join(
        f'<circle cx="{x:.1f}" cy="{y:.1f}" r="3" fill="{tone}"/>' for x, y in places
    )


def _labels(lines: Sequence[Line]) -> str:
    """What the colours mean, in a row below."""
    drawn, left = "", LEFT
    for index, line in enumerate(lines):
        tone = css(PALETTE[index % len(PALETTE)])
        drawn += f'<text x="{left:.0f}" y="{HEIGHT - 10:.0f}" fill="{tone}">'
        drawn += f"{escape(line.label)}</text>"
        left += LETTER * len(line.label) + 14
    return drawn


def _range(values: Sequence[float], pad: float) -> tuple[float, float]:
    """Ends of an axis, a little beyond the values; never empty."""
    low, high = min(values), max(values)
    wide = (high - low) * pad or (0.0 if high > low else max(abs(high), 1.0) * 0.1)
    return low - wide, high + wide


def _ticks(low: float, high: float) -> list[float]:
    """About four round numbers within an axis."""
    raw = (high - low) / 4
    base = 10 ** math.floor(math.log10(raw))
    step = next((m * base for m in (1, 2, 2.5, 5, 10) if m * base >= raw), 10 * base)
    first = math.ceil(low / step - 1e-9)
    return [round(k * step, 12) for k in range(first, math.floor(high / step + 1e-9) + 1)]
