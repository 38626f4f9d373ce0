"""The command line. This file imports nothing heavy: `mover --help` answers at once."""

import importlib
import logging
import os
import re
import signal
import sys
import threading
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

from mover.core.errors import InputError

if TYPE_CHECKING:
    from mover.core.observe import Step

COMMANDS = {
    "demo": ("mover.app.cli.run:demo",
        "Reconstruct a known room that comes with the package, compare it with the truth."),
    "video": ("mover.app.cli.video:video",
        "From a video or a picture to a room: pictures, bodies, first scene, room, report."),
    "weights": ("mover.app.cli.video:bring_weights",
        "Bring small networks for `mover video` into the cache folder."),
    "import": ("mover.app.cli.imports:import_",
        "Turn what other tools wrote into a capture folder."),
    "layout": ("mover.app.cli.video:layout",
        "Find a first scene of library furniture in one picture's masks or boxes."),
    "import-bodies": ("mover.app.cli.people:bodies",
        "Turn what another tool found of people into bodies.npz or keypoints.npz."),
    "fit": ("mover.app.cli.people:fit", "Fit bodies to the 2D joints of a video."),
    "check": ("mover.app.cli.results:check",
        "Validate a capture, list the evidence of each object, draw the initial overlay."),
    "run": ("mover.app.cli.run:run", "Reconstruct a room from a capture folder."),
    "refine": ("mover.app.cli.results:refine",
        "Refine the people of a result with its room: their pose, or their place."),
    "contacts": ("mover.app.cli.results:contacts",
        "Which vertices touch something, by POSA's network or from files."),
    "evaluate": ("mover.app.cli.results:evaluate", "Compare a result with the truth."),
    "paper-table": ("mover_bench.cli:show_paper_table",
        "Print the paper's table for your copy of PROX or PiGraphs."),
    "experiment": ("mover_bench.cli:experiment",
        "Reconstruct known rooms with variants of the method and compare them with the truth."),
    "export": ("mover.app.cli.results:export",
        "Write a result for other programs: GLB, USD, MJCF, PLY, AMASS, contacts."),
    "render": ("mover.app.cli.results:render",
        "Draw a result without a screen: a picture or a film."),
    "view": ("mover.app.cli.results:view", "Look at a result in the browser, and correct it."),
    "batch": ("mover.app.cli.run:batch",
        "Run thousands of captures; what is finished is not run again."),
}  # fmt: skip
"""Where a command is, and what it does."""
OWN_INTERRUPT = ("batch", "experiment", "paper-table")
"""Commands that end their own processes on Ctrl-C."""
PATIENCE = 0.8  # [s] after Ctrl-C
INTERRUPTED = 130
STOPPED = "\nmover {}: stopped; the same command goes on from here"
OUT_OF_MEMORY = r"(?i)out of memory|alloc_cpu|DefaultCPUAllocator|can't allocate"
USAGE = "usage: mover COMMAND [OPTIONS]; mover COMMAND --help says more"


def main() -> None:
    """Run the command that is named first."""
    arguments = sys.argv[1:]
    if not arguments or arguments[0] in ("-h", "--help"):
        lines = [f"  {name:<14} {text}" for name, (_, text) in COMMANDS.items()]
        say("\n".join([USAGE, "", "Rooms from the people who move in them.", "", *lines]))
        return
    if arguments[0] == "--version":
        from mover import __version__

        say(f"mover {__version__}")
        return
    if arguments[0] not in COMMANDS:
        say(f"mover: no command {arguments[0]!r}; there are {', '.join(COMMANDS)}\n{USAGE}")
        raise SystemExit(2)
    if arguments[0] not in OWN_INTERRUPT:
        signal.signal(signal.SIGINT, partial(_interrupt, arguments[0]))
    logging.basicConfig(level=logging.WARNING, format="%(message)s")
    said: set[str] = set()
    for handler in logging.getLogger().handlers:  # each message once
        handler.addFilter(lambda r: not ((m := r.getMessage()) in said or said.add(m)))
    logging.getLogger("mover.geometry.kernels").setLevel(logging.INFO)  # what is compiled, once
    code = run_command(arguments[0], arguments[1:])
    if code == INTERRUPTED:
        os._exit(code)  # work of other threads would be waited for
    raise SystemExit(code)


def run_command(name: str, arguments: Sequence[str]) -> int:
    """Parse the arguments of a command and run it; the exit code."""
    try:
        command_of(name)(arguments)
    except InputError as error:
        say(f"mover {name}: {error}", sys.stderr)
        return 2
    except BrokenPipeError:  # such as `| head`; Python must not write to it again at its end
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except OSError as error:  # a full disk, a folder that may not be written, a file as --out
        where = f"{error.filename}: " if error.filename else ""
        is_file = isinstance(error, FileExistsError | NotADirectoryError)
        why = "a file is where a folder is needed" if is_file else error.strerror or error
        say(f"mover {name}: {where}{why}; what was finished is kept", sys.stderr)
        return 2
    except (MemoryError, RuntimeError) as error:  # torch raises the second
        if isinstance(error, RuntimeError) and not re.search(OUT_OF_MEMORY, str(error)):
            raise
        say(f"mover {name}: out of memory; what was finished is kept", sys.stderr)
        return 2
    except KeyboardInterrupt:
        say(STOPPED.format(name), sys.stderr)
        return INTERRUPTED
    return 0


def _interrupt(name: str, _number: int, _frame: object) -> None:
    """Stop as Python does, but for certain within a second; a second Ctrl-C stops at once.

    Libraries swallow the exception (trimesh, around imports) or compute on; finished stages lie on
    the disk as a whole.
    """

    def leave() -> None:
        say(STOPPED.format(name), sys.stderr)
        os._exit(INTERRUPTED)

    signal.signal(signal.SIGINT, signal.SIG_DFL)
    last = threading.Timer(PATIENCE, leave)
    last.daemon = True
    last.start()
    raise KeyboardInterrupt


def command_of(name: str) -> Callable[[Sequence[str]], None]:
    """The function of a command; its module is imported now."""
    module, _, function = COMMANDS[name][0].partition(":")
    try:
        return getattr(importlib.import_module(module), function)
    except ModuleNotFoundError as error:
        if error.name != "mover_bench":
            raise
        where = "pip install --editable '.[bench]' in a copy of its repository"
        raise InputError(f"mover_bench is not in the wheel of mover; {where}") from error


def say(text: str, stream: Any = None) -> None:  # noqa: ANN401
    """Write a line to standard output, or to `stream`, in the letters that it knows."""
    where = stream or sys.stdout
    if where is None:  # it was closed
        return
    known = getattr(where, "encoding", None) or "utf-8"
    where.write(text.encode(known, "backslashreplace").decode(known) + "\n")
    where.flush()


log = logging.getLogger("mover.geometry.kernels")  # says what is compiled


class Bar:
    """An observer that draws how far the stages are."""

    def __init__(self) -> None:
        from rich.console import Console
        from rich.logging import RichHandler
        from rich.progress import (
            BarColumn,
            MofNCompleteColumn,
            Progress,
            TextColumn,
            TimeElapsedColumn,
        )

        self._stage, self._task, self._level = "", None, log.level
        self._console = console = Console(file=sys.stderr)
        self._lines = RichHandler(
            console=console, show_time=False, show_level=False, show_path=False
        )
        name = TextColumn("{task.description:<28}")
        columns = (name, BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
        self._progress = Progress(*columns, console=console, transient=True)

    def __enter__(self) -> "Bar":
        log.addHandler(self._lines)
        self._level, log.propagate = log.level, False
        log.setLevel(logging.INFO)
        if self._console.is_terminal:
            self._task = self._progress.add_task("...", total=None)
            self._progress.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._progress.stop()
        log.removeHandler(self._lines)
        log.setLevel(self._level)
        log.propagate = True

    def __call__(self, step: "Step") -> None:
        """Show how far the stage is."""
        task: Any = self._task
        if step.stage != self._stage:
            self._stage = step.stage
            if task is None:
                self._console.print(f"{step.stage} ...", highlight=False)
            else:
                self._progress.remove_task(task)
                self._task = task = self._progress.add_task(step.stage, total=step.steps)
        if task is not None:
            self._progress.update(task, completed=step.index + 1, total=step.steps)
