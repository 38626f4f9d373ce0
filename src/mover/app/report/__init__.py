"""One page that shows what a run did. Its templates and assets are files beside the code."""

from functools import cache
from importlib.resources import files
from typing import Any


@cache
def _environment() -> Any:  # noqa: ANN401
    """Everything that is filled in is escaped, and what is missing is an error."""
    from jinja2 import Environment, PackageLoader, StrictUndefined

    return Environment(
        autoescape=True,
        loader=PackageLoader("mover.app.report"),
        lstrip_blocks=True,
        trim_blocks=True,
        undefined=StrictUndefined,
    )


def fill(name: str, **parts: Any) -> str:  # noqa: ANN401
    """The text of a template with `parts` in it, which other templates do not escape again."""
    from markupsafe import Markup

    return Markup(_environment().get_template(name).render(parts))


def asset(name: str) -> str:
    """Text of a file that stands in the page as it is."""
    from markupsafe import Markup

    return Markup(files("mover.app.report").joinpath("assets", name).read_text(encoding="utf-8"))
