"""Sphinx: equations become MathML, which browsers draw themselves, without scripts or fonts."""

import re
import unicodedata
from typing import Any

KINDS = {"script": "SCRIPT", "double-struck": "DOUBLE-STRUCK", "bold": "BOLD", "fraktur": "FRAKTUR"}
LETTER = re.compile(r'<mi mathvariant="([a-z-]+)">([A-Za-z])</mi>')


def mathml(latex: str, *, block: bool) -> str:
    """MathML of an equation; letters of other alphabets are characters of their own."""
    from latex2mathml.converter import convert

    return LETTER.sub(_letter, convert(latex, display="block" if block else "inline"))


def _letter(found: re.Match[str]) -> str:
    kind, letter = found.groups()
    case = "CAPITAL" if letter.isupper() else "SMALL"
    names = (
        f"MATHEMATICAL {KINDS.get(kind, kind.upper())} {case} {letter.upper()}",
        f"{KINDS.get(kind, kind.upper())} {case} {letter.upper()}",
    )
    for name in names:
        try:
            return f'<mi mathvariant="normal">{unicodedata.lookup(name)}</mi>'
        except KeyError:
            continue
    return found.group(0)


def visit_inline(writer: Any, node: Any) -> None:
    """An equation in a line."""
    from docutils import nodes

    writer.body.append(mathml(node.astext(), block=False))
    raise nodes.SkipNode


def visit_block(writer: Any, node: Any) -> None:
    """An equation of its own."""
    from docutils import nodes

    writer.body.append(f'<div class="equation">{mathml(node.astext(), block=True)}</div>')
    raise nodes.SkipNode


def setup(app: Any) -> dict[str, Any]:
    """Called by Sphinx."""
    app.add_html_math_renderer("mathml", (visit_inline, None), (visit_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
