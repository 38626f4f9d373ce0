"""Starting: Warp is initialised once, kernels are compiled once, and both are shown."""

import logging
import os
import subprocess
import sys

import pytest

from mover.app.cli import Bar
from mover.core.observe import Step
from mover.geometry import warp_start

pytest.importorskip("warp")

RACE = """
import threading, time, warp
calls, init = [], warp.init
def slow():
    calls.append(1); time.sleep(0.2); init()
warp.init = slow
from mover.geometry.warp_start import started
folder = []
ask = lambda: folder.append(started().config.kernel_cache_dir)
threads = [threading.Thread(target=ask) for _ in range(4)]
for t in threads: t.start()
for t in threads: t.join()
assert calls == [1], calls
assert len(set(folder)) == 1, folder
"""
COMPILE = """
from mover.geometry.warp_start import kernels
from mover.core.observe import Step
from mover.app.cli import Bar
with Bar() as bar:
    bar(Step("gather", 0, 1))
    kernels("lookup", "cpu")
"""


def said(code: str, **env: str) -> str:
    done = subprocess.run(
        [sys.executable, "-c", code], env=os.environ | env, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    return done.stdout + done.stderr


@pytest.mark.slow
def test_threads_that_start_at_once_initialise_warp_once_and_say_nothing():
    assert said(RACE) == ""


@pytest.mark.slow
def test_the_progress_says_that_kernels_are_compiled_and_only_the_first_time(tmp_path):
    first, second = (said(COMPILE, WARP_CACHE_PATH=str(tmp_path)) for _ in range(2))
    assert "compiling kernels, once on this machine: lookup for cpu" in first
    assert second.strip() == "gather ..."


def test_kernels_in_the_cache_are_loaded_without_a_word(caplog):
    warp_start.kernels("lookup", "cpu")  # the first on this machine may say so
    warp_start._loaded.cache_clear()
    caplog.clear()
    with caplog.at_level(logging.INFO):
        warp_start.kernels("lookup", "cpu")
    assert caplog.records == []


def test_a_bar_shows_what_is_compiled_and_leaves_the_log_as_it_was(capsys):
    log = logging.getLogger("mover.geometry.kernels")
    with Bar() as bar:
        bar(Step("place_objects", 0, 2))
        log.info("compiling kernels, once on this machine: %s for %s ...", "grid", "cpu")
    shown = capsys.readouterr().err
    assert shown.splitlines()[0] == "place_objects ..."
    assert "compiling kernels, once on this machine: grid for cpu" in shown
    log.warning("after")
    assert "after" not in capsys.readouterr().out
    ours = logging.getLogger("mover.geometry.kernels")
    assert (ours.handlers, ours.level, ours.propagate) == ([], logging.NOTSET, True)
