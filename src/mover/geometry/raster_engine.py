"""Which rasteriser draws, and how many threads it may use on a CPU."""

import os
from collections.abc import Generator
from contextlib import contextmanager
from contextvars import ContextVar
from functools import cache
from importlib.util import find_spec
from typing import Literal, get_args

Engine = Literal["auto", "torch", "warp"]
CHOICES: tuple[str, ...] = get_args(Engine)
DEVICES = ["cpu", "cuda"]
"""Kinds of devices that the kernels are compiled for."""

_engine: ContextVar[Engine | None] = ContextVar("engine", default=None)
_threads: ContextVar[int | None] = ContextVar("threads", default=None)


def engine() -> Literal["torch", "warp"]:
    """The rasteriser in use: that of `use_engine`, else of MOVER_ENGINE, else "auto".

    "auto" is Warp where `warp-lang` is installed, else torch.

    Raises:
        ValueError: If MOVER_ENGINE names no engine.
    """
    name = _engine.get() or os.environ.get("MOVER_ENGINE") or "auto"
    if name not in CHOICES:
        raise ValueError(f"MOVER_ENGINE is {name!r}, expected one of {', '.join(CHOICES)}")
    if name == "auto":
        return "warp" if _has_warp() else "torch"
    return "torch" if name == "torch" else "warp"


@contextmanager
def use_engine(name: Engine) -> Generator[None, None, None]:
    """Let this rasteriser draw inside the block (or the decorated function)."""
    token = _engine.set(name)
    try:
        yield
    finally:
        _engine.reset(token)


def threads() -> int:
    """Threads that draw on a CPU: of `use_threads`, else of OMP_NUM_THREADS, else one a core.

    They never wait for one another within an item, so that, unlike torch's, they pay for small
    work too.
    """
    asked = os.environ.get("OMP_NUM_THREADS", "")
    return _threads.get() or (int(asked) if asked.isdigit() and int(asked) else _cores())


@contextmanager
def use_threads(count: int) -> Generator[None, None, None]:
    """Let so many threads draw inside the block (or the decorated function)."""
    token = _threads.set(count)
    try:
        yield
    finally:
        _threads.reset(token)


@cache
def _has_warp() -> bool:
    return find_spec("warp") is not None


@cache
def _cores() -> int:
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1
