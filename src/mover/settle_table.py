"""The settle test as text."""

import math
from collections.abc import Mapping, Sequence

from .settle import Settled

HEADS = ("moved", "turned", "stuck", "")
WIDTHS = (9, 9, 8, 10)


def settle_table(found: Mapping[str, Sequence[Settled]]) -> str:
    """For each piece, how far it moved, turned and was stuck, in each scene."""
    ids = list(dict.fromkeys(row.id for rows in found.values() for row in rows))
    width = max([len("object"), *map(len, ids)])
    heads = "".join(f"   {name:<{sum(WIDTHS)}}" for name in found)
    lines = [f"{'':<{width}}{heads}", f"{'object':<{width}}{_row(HEADS) * len(found)}"]
    for name in ids:
        cells = [_cell(next((r for r in rows if r.id == name), None)) for rows in found.values()]
        lines.append(f"{name:<{width}}{''.join(cells)}")
    sums = [_summary(name, rows) for name, rows in found.items()]
    return "\n".join(line.rstrip() for line in (*lines, "", *sums))


def _row(words: Sequence[str]) -> str:
    return "   " + "".join(f"{w:<{size}}" for w, size in zip(words, WIDTHS, strict=True))


def _cell(row: Settled | None) -> str:
    if row is None or row.fixed:
        return _row(("-" if row is None else "held", "", "", ""))
    moved, stuck = f"{1e3 * row.moved:.0f} mm", f"{1e3 * row.stuck:.0f} mm"
    turned = f"{math.degrees(row.turned):.0f} deg"
    return _row((moved, turned, stuck, "fell over" if row.toppled else ""))


def _summary(name: str, rows: Sequence[Settled]) -> str:
    loose = [row for row in rows if not row.fixed]
    if not loose:
        return f"{name}: nothing that could move"
    far = sorted(row.moved for row in loose)
    over = sum(row.toppled for row in loose)
    middle, most = 1e3 * far[len(far) // 2], 1e3 * far[-1]
    return f"{name}: median {middle:.0f} mm, most {most:.0f} mm, {over} of {len(loose)} fell over"
