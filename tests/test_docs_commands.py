"""Every command in the README and the docs is one that the program understands; Python runs."""

import contextlib
import io
import json
import re
import shlex
import subprocess
import sys
from functools import cache
from pathlib import Path
from typing import Any

import pytest
import tyro

from mover.app import results
from mover.app.cli import COMMANDS, command_of
from mover.pipeline.presets import PRESETS

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").glob("*.md"))]
FENCE = re.compile(r"^```(\w*)\n(.*?)^```", re.S | re.M)
INLINE = re.compile(r"`(mover [^`\n]*(?:\n[^`\n]+)?)`")


class ParsedError(Exception):
    """The arguments were understood."""


def indented(text: str) -> list[str]:
    """Blocks of code that are set in by four spaces."""
    return re.findall(r"(?:^    \S.*\n(?:^     .*\n)*)+", FENCE.sub("", text), re.M)


def blocks(page: Path) -> list[str]:
    """Lines of code that call the program, without remarks."""
    text, shells = page.read_text(), ("", "bash", "sh", "console")
    codes = [code for language, code in FENCE.findall(text) if language in shells]
    found = []
    for code in [*codes, *indented(text)]:
        whole = code.replace("\\\n", " ")
        lines = [line.strip().removeprefix("$ ") for line in whole.splitlines()]
        found += [line for line in lines if line.startswith("mover ")]
    return found


def words_of(line: str) -> list[str]:
    """The words after `mover`, up to a remark."""
    return shlex.split(line, comments=True)[1:]


@pytest.fixture
def _only_parse(monkeypatch: pytest.MonkeyPatch):
    """Commands stop as soon as their arguments are read; run.json need not exist."""
    real = tyro.cli

    def parse(*args: Any, **options: Any) -> Any:
        real(*args, **options)
        raise ParsedError

    monkeypatch.setattr(tyro, "cli", parse)
    monkeypatch.setattr(results, "read_config", lambda _path: PRESETS["robust"])


@pytest.mark.usefixtures("_only_parse")
@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_commands_in_blocks_are_understood(page: Path):
    for line in blocks(page):
        name, *words = words_of(line)
        assert name in COMMANDS
        if name != "batch":
            with pytest.raises(ParsedError):
                command_of(name)(words)


ELSEWHERE = """
import json, sys, tyro
from mover.app.cli import command_of
real = tyro.cli
class Parsed(Exception): pass
def parse(*args, **options):
    real(*args, **options)
    raise Parsed
tyro.cli = parse
for words in json.loads(sys.argv[1]):
    try:
        command_of("batch")(words)
    except Parsed:
        continue
    raise SystemExit(f"not parsed: {words}")
"""


def test_batches_in_blocks_are_understood():
    """In a process of its own: tyro marks what is missing by a value that no type check lets by."""
    lines = [words_of(line) for page in PAGES for line in blocks(page)]
    assert {name for name, *_ in lines} >= {"batch", "check", "run", "export", "render"}
    wanted = [words for name, *words in lines if name == "batch"]
    run = [sys.executable, "-c", ELSEWHERE, json.dumps(wanted)]
    done = subprocess.run(run, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr[-2000:]


@cache
def help_of(name: str) -> str:
    """The help, with all settings where the command has more of them."""
    text = io.StringIO()
    with contextlib.redirect_stdout(text):
        with pytest.raises(SystemExit):
            command_of(name)(["--help"])
        if "--help-all" in text.getvalue():
            with pytest.raises(SystemExit):
                command_of(name)(["--help-all"])
    return text.getvalue()


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_commands_in_sentences_have_these_options(page: Path):
    for text in INLINE.findall(FENCE.sub("", page.read_text())):
        name, *words = text.split()[1:]
        if name.startswith("-"):
            assert name in ("--help", "--version")
            continue
        assert name.rstrip(",.") in COMMANDS
        for option in (word.split("=")[0] for word in words if word.startswith("--")):
            known = help_of(name).replace("_", "-").replace(",", " ").split()
            assert option in known or option in ("--help", "--help-all"), (text, option)


@pytest.mark.usefixtures("_only_parse")
@pytest.mark.parametrize(
    "line", ["mover render OUT --too x.png", "mover run --out OUT", "mover export OUT --to fbx"]
)
def test_a_wrong_command_would_be_found(line: str):
    name, *words = words_of(line)
    with pytest.raises(SystemExit), contextlib.redirect_stderr(io.StringIO()):
        command_of(name)(words)


@pytest.mark.parametrize("page", PAGES[2:], ids=lambda page: page.stem)
def test_python_in_the_docs_runs(page: Path):
    for code in re.findall(r"^```python\n(.*?)^```", page.read_text(), re.S | re.M):
        exec(compile(code, page.name, "exec"), {})
