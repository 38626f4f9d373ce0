"""OpenUSD's Python modules, which fill themselves when they are imported."""

from importlib import import_module
from importlib.util import find_spec
from typing import Any

from ..records import InputError


def pxr(name: str) -> Any:  # noqa: ANN401
    """The module `pxr.<name>`.

    Raises:
        InputError: If usd-core is not installed.
    """
    if find_spec("pxr") is None:
        raise InputError(
            "--to usd: usd-core is not installed; pip install '.[usd]' in mover's folder"
        )
    return import_module(f"pxr.{name}")
