"""Starts Warp without a word, compiles the kernels once, and shares their work among threads."""

import logging
import os
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from functools import cache
from importlib import import_module
from pathlib import Path
from tempfile import mkdtemp
from threading import RLock
from types import ModuleType
from typing import Any, TypeVar

import torch
from torch import Tensor

A = TypeVar("A")
B = TypeVar("B")
KERNELS = "mover.geometry.kernels"
log = logging.getLogger(KERNELS)
_lock = RLock()  # of all that is done once; `cache` alone lets two threads do it


def started() -> ModuleType:
    """Warp, ready for use."""
    with _lock:
        return _started()


@cache
def _started() -> ModuleType:
    import warp as wp

    with _quiet(wp):
        try:
            wp.init()
        except OSError:
            _keep_kernels_elsewhere(wp)
            wp.init()
    return wp


def _keep_kernels_elsewhere(wp: ModuleType) -> None:
    """Kernels of this run go into a temporary folder: the cache folder cannot be written."""
    before, folder = wp.config.kernel_cache_dir or "the cache folder", mkdtemp(prefix="mover-")
    log.warning("%s cannot be written: kernels are compiled in each run, in %s", before, folder)
    wp.config.kernel_cache_dir = folder


def kernels(name: str, device: str, package: str = KERNELS) -> ModuleType:
    """The module of that name in a package of kernels, compiled for the device.

    The first call on a machine compiles (seconds, announced by a line of the log, which the
    commands show); the result stays in Warp's cache, and later runs load it.
    """
    with _lock:
        return _loaded(package, name, device)


@cache
def _loaded(package: str, name: str, device: str) -> ModuleType:
    wp = started()
    module = import_module(f"{package}.{name}")
    threads = 1 if device == "cpu" else None  # of a block; it is a part of the name
    folder = wp.get_module(module.__name__).get_module_identifier(threads)
    if not (Path(wp.config.kernel_cache_dir) / folder).is_dir():
        if not os.access(wp.config.kernel_cache_dir, os.W_OK):
            _keep_kernels_elsewhere(wp)
        log.info("compiling kernels, once on this machine: %s for %s ...", name, device)
    with _quiet(wp):
        wp.load_module(module, device=device)
    return module


def name_of(device: torch.device) -> str:
    """What Warp calls a device of torch."""
    return str(started().device_from_torch(device))


def launch(
    kernel: Any,  # noqa: ANN401
    dim: int | tuple[int, ...],
    inputs: list[Any],
    device: torch.device,
) -> None:
    """Launch a kernel where torch works now: on a GPU in its stream."""
    stream = _stream(torch.cuda.current_stream(device)) if device.type == "cuda" else None
    started().launch(kernel, dim, inputs, device=name_of(device), stream=stream)


@cache  # torch's streams live as long as the process
def _stream(stream: Any) -> Any:  # noqa: ANN401
    return started().stream_from_torch(stream)


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


def filled(kind: Any, **fields: Any) -> Any:  # noqa: ANN401
    """A struct of the kernels; tensors become arrays of the declared kind without a copy."""
    made = kind()
    for name, value in fields.items():
        if isinstance(value, Tensor):
            value = started().from_torch(value.detach(), dtype=kind.vars[name].type.dtype)
        setattr(made, name, value)
    return made


def threads() -> int:
    """Threads that draw on a CPU: of OMP_NUM_THREADS, else one a core.

    They never wait for one another within an item, so that, unlike torch's, they pay for small
    work too.
    """
    asked = os.environ.get("OMP_NUM_THREADS", "")
    return int(asked) if asked.isdigit() and int(asked) else _cores()


@cache
def _cores() -> int:
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity else os.cpu_count() or 1


def share(work: Callable[[int], object], n: int) -> None:
    """Do the work for 0 ... n - 1 on as many threads as are wanted, this one among them."""
    todo = iter(range(n))

    def run() -> None:
        for item in todo:
            work(item)

    others = [_pool().submit(run) for _ in range(min(threads(), n) - 1)]
    run()
    for other in others:
        if not other.cancel():
            other.result()


def mapped(work: Callable[[A], B], items: Sequence[A]) -> list[B]:
    """What the work gives for each item, in their order, on as many threads as are wanted."""
    found: dict[int, B] = {}

    def one(k: int) -> None:
        found[k] = work(items[k])

    share(one, len(items))
    return [found[k] for k in range(len(items))]


@cache
def _pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(thread_name_prefix="mover-draw")
