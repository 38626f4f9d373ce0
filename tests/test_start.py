"""Starting: Warp is initialised once, kernels are compiled once, and both are told."""

import io
import logging
import os
import subprocess
import sys

import pytest

from mover.app.cli import say
from mover.app.cli.progress import Bar
from mover.app.cli.waiting import WAITING
from mover.core.observe import Step
from mover.geometry import warp_start

pytest.importorskip("warp")

RACE = """
import threading, time, warp
begun, init = [], warp.init
def slow():
    begun.append(1); time.sleep(0.2); init()
warp.init = slow
from mover.geometry.warp_start import started
folder = []
ask = lambda: folder.append(started().config.kernel_cache_dir)
threads = [threading.Thread(target=ask) for _ in range(4)]
for t in threads: t.start()
for t in threads: t.join()
assert begun == [1], begun
assert len(set(folder)) == 1, folder
"""
COMPILE = """
from mover.geometry.warp_start import kernels
from mover.energy.minimize import Step
from mover.app.cli import say
from mover.app.cli.progress import Bar
from mover.app.cli.waiting import WAITING
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


def test_threads_that_start_at_once_initialise_warp_once_and_say_nothing():
    assert said(RACE) == ""


@pytest.mark.slow
def test_the_progress_tells_that_kernels_are_compiled_and_only_the_first_time(tmp_path):
    first, second = (said(COMPILE, WARP_CACHE_PATH=str(tmp_path)) for _ in range(2))
    assert "compiling kernels, once on this machine: lookup for cpu" in first
    assert second.strip() == "gather ..."


@pytest.mark.slow
def test_what_is_not_compiled_yet_is_compiled_by_a_process_beside(tmp_path):
    code = """
from mover.app.cli import warm
from mover.geometry.warp_start import is_compiled
warm.cores = lambda: 2
warm.KERNELS = warm.KERNELS[-1:]
warm.compile_beside()
warm.compile_beside()
assert len(warm._beside) == 1
assert warm._beside[0].wait() == 0
assert is_compiled("farthest", "cpu")
warm._beside.clear()
warm.compile_beside()
assert not warm._beside
"""
    assert said(code, WARP_CACHE_PATH=str(tmp_path)) == ""


def test_kernels_in_the_cache_are_loaded_without_a_word(caplog):
    warp_start.kernels("lookup", "cpu")  # the first on this machine may tell
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


class Screen(io.StringIO):
    def isatty(self):
        return True


def test_a_terminal_shows_a_moving_line_before_anything_heavy_is_imported():
    code = """
import io, sys
class Screen(io.StringIO):
    def isatty(self):
        return True
sys.stderr = Screen()
from mover.app.cli.run import parse_run
from mover.app.cli.waiting import WAITING
parse_run(["capture"])
import time
time.sleep(0.3)
WAITING.hide()
lines = sys.stderr.getvalue().split("\\r")
assert "torch" not in sys.modules
assert lines[1] != lines[2], lines
print([line for line in lines if "mover run" in line][0][:13].encode(), lines[-1].encode())
"""
    assert said(code).strip() == r"b'\x1b[2Kmover run' b'\x1b[2K'"


def test_the_moving_line_makes_room_for_lines_of_text_and_for_a_bar(monkeypatch):
    screen = Screen()
    monkeypatch.setattr(sys, "stderr", screen)
    for write in (
        lambda: say("text", screen),
        lambda: Bar().__enter__().__exit__(None, None, None),
    ):
        WAITING.show("reading")
        write()
        assert WAITING._thread is None


def test_the_moving_line_is_silent_where_there_is_no_terminal(capsys):
    WAITING.show("reading")
    WAITING.hide()
    assert capsys.readouterr().err == ""
