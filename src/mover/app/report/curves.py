"""How the energies fell: one small line plot for each stage, as inline SVG."""

import math
from collections.abc import Iterable, Mapping, Sequence

from mover.app.report.templates import fill

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
