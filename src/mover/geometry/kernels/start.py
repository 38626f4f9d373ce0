"""Starts Warp without a word and compiles the kernels once."""

import logging
import os
from collections.abc import Generator
from contextlib import contextmanager
from functools import cache
from importlib import import_module
from threading import Lock
from types import ModuleType

log = logging.getLogger(__name__)
_lock = Lock()


@cache
def started() -> ModuleType:
    """Warp, ready for use."""
    import warp as wp

    with _quiet(wp):
        wp.init()
    return wp


def kernels(name: str, device: str) -> ModuleType:
    """The module of that name in this package, compiled for the device.

    The first call on a machine compiles (seconds, told by one line of the log); the result stays
    in Warp's cache, and later runs load it.
    """
    with _lock:
        return _loaded(name, device)


@cache
def _loaded(name: str, device: str) -> ModuleType:
    wp = started()
    module = import_module(f"{__package__}.{name}")
    log.info("loading kernels for %s; the first time on a machine they are compiled", device)
    with _quiet(wp):
        wp.load_module(module, device=device)
    return module


@contextmanager
def _quiet(wp: ModuleType) -> Generator[None, None, None]:
    """Keep back Warp's greeting, its progress and its remark that there is no driver."""
    level = wp.config.log_level
    wp.config.log_level = wp.LOG_WARNING
    keep, sink = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(sink, 2)
        yield
    finally:
        os.dup2(keep, 2)
        os.close(keep)
        os.close(sink)
        wp.config.log_level = level
