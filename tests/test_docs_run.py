"""The commands in the README and the docs run: block by block, in order, on small inputs.

Flags are added that make a command fast (few steps, coarse volumes). What cannot be run here is in
ELSEWHERE, with the reason. Commands of sentences and tables are parsed by test_docs_commands.py,
and each reader is run by its own tests.
"""

import importlib.util
import os
import re
import shutil
import signal
import subprocess
import sys
import urllib.request
from collections.abc import Iterator
from pathlib import Path

import pytest
from docs_desk import write_desk
from test_docs_commands import FENCE, PAGES, indented, words_of

from mover.app.cli import run_command

pytestmark = pytest.mark.long
ROOT = Path(__file__).parents[1]
ELSEWHERE = {
    "--ray.address auto": "a running Ray cluster",
    "--device cuda": "an NVIDIA GPU",
    "mover experiment --": "hours: many known rooms",
    "mover demo": "minutes: `make demo`",
    "mover video": "weights of networks",
    "MPH8": "recordings of PROX: tests/test_prox_tables.py",
    "paper-table": "recordings of PROX: tests/test_prox_tables.py",
}
NEEDS = {"view": "viser", "render": "av", "usd": "pxr", "mjcf": "mujoco"}
RUN = [
    "--place.method.steps", "3", "--layout.method.steps", "3", "--gather.cells", "32",
    "--prepare.cells", "24", "--prepare.faces", "200", "--prepare.samples", "100",
    "--image.size", "48",
]  # fmt: skip
QUICK = {"run": RUN, "batch": RUN, "export": ["--body", "skin"]}


def sequences() -> Iterator[tuple[str, list[str]]]:
    """The commands of each block of code that can run here, in order."""
    for page in PAGES:
        text = page.read_text()
        fenced = [code for kind, code in FENCE.findall(text) if kind in ("", "bash", "sh")]
        for code in [*fenced, *indented(text)]:
            lines = [line.strip() for line in code.replace("\\\n", " ").splitlines()]
            lines = [line for line in lines if line.startswith("mover ")]
            lines = [line for line in lines if not any(key in line for key in ELSEWHERE)]
            if lines:
                yield page.stem, lines


BLOCKS = [pytest.param(lines, id=f"{page}-{i}") for i, (page, lines) in enumerate(sequences())]


@pytest.fixture(scope="module")
def full_desk(tmp_path_factory, small_room, small_capture) -> Path:
    desk = write_desk(tmp_path_factory.mktemp("docs") / "desk", small_room, small_capture)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(desk)
        assert run_command("run", ["CAPTURE", "--out", "OUT", *RUN]) == 0
    return desk


@pytest.fixture
def desk(full_desk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A copy, in which the command runs; programs started here end by Ctrl-C."""
    mine = tmp_path / "desk"
    shutil.copytree(full_desk, mine, symlinks=True)
    monkeypatch.chdir(mine)
    monkeypatch.setenv("MOVER_BODY_MODELS", str(mine / "models"))
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield mine
    signal.signal(signal.SIGINT, before)


def start(words: list[str]) -> subprocess.Popen[str]:
    """The program as a user starts it."""
    return subprocess.Popen(
        [sys.executable, "-m", "mover", *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        text=True, env={**os.environ, "OMP_NUM_THREADS": "1"},
    )  # fmt: skip


def look_and_leave(words: list[str]) -> None:
    """Open the viewer's page once, then press Ctrl-C."""
    server = start([*words, "--port", "18080"])
    said = server.stdout.readline()
    assert said.startswith("http://127.0.0.1:"), said + server.communicate()[1]
    with urllib.request.urlopen(said.split()[0], timeout=60) as page:
        assert b"<html" in page.read(2000).lower()
    server.send_signal(signal.SIGINT)
    _, trouble = server.communicate(timeout=120)
    assert server.returncode in (0, 130), trouble
    assert "Traceback" not in trouble


def do(line: str) -> None:
    """Run one line of the docs, with its flags that make it fast."""
    name, *words = words_of(line.replace("$one", "CAPTURE"))
    if any(
        key in (name, *words) and importlib.util.find_spec(package) is None
        for key, package in NEEDS.items()
    ):
        return
    words += QUICK.get(name, [])
    if name == "view":
        look_and_leave([name, *words])
    elif name == "batch":  # tyro marks what is missing by a value that no type check lets by
        ended = start([name, *words])
        _, trouble = ended.communicate(timeout=600)
        assert ended.returncode == 0, trouble
    else:
        assert run_command(name, words) == 0, line


@pytest.mark.usefixtures("desk")
@pytest.mark.parametrize("lines", BLOCKS)
def test_the_commands_of_a_block_run_one_after_the_other(lines: list[str]):
    for line in lines:
        do(line)


def test_what_is_not_run_is_still_in_the_docs():
    """Else the reason is stale."""
    text = "\n".join(page.read_text() for page in PAGES)
    assert all(key in text for key in ELSEWHERE)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_benchmarks_that_a_page_names_have_these_options(page: Path):
    found = re.findall(r"python ((?:benchmarks|examples)/\w+\.py)([^`\n]*)", page.read_text())
    for script, rest in dict.fromkeys(found):
        assert (ROOT / script).is_file()
        if script.startswith("benchmarks"):
            words = [sys.executable, str(ROOT / script), "--help"]
            text = subprocess.run(words, check=True, text=True, capture_output=True).stdout
            assert all(flag in text for flag in re.findall(r"--[a-z-]+", rest)), (script, rest)
