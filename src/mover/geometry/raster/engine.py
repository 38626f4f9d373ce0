"""What draws in place of the kernels: a reference in plain code, for tests and comparisons."""

from collections.abc import Generator
from contextlib import contextmanager
from contextvars import ContextVar
from types import ModuleType
from typing import Literal

_reference: ContextVar[ModuleType | None] = ContextVar("reference", default=None)


def engine() -> Literal["torch", "warp"]:
    """Who draws and sums: "torch" inside `drawn_by`, else "warp"."""
    return "torch" if reference() else "warp"


def reference() -> ModuleType | None:
    """The module of `drawn_by`, if there is one."""
    return _reference.get()


@contextmanager
def drawn_by(module: ModuleType) -> Generator[None, None, None]:
    """Let a module with `look`, `depths`, `layers` and `first_hit` draw inside the block."""
    token = _reference.set(module)
    try:
        yield
    finally:
        _reference.reset(token)
