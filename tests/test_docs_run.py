"""The commands in the README and the docs run: block by block, in order, on small inputs.

Flags are added that make a command fast (few steps, coarse volumes) or that name a network's
folder; SWAPS names the files that stand for a page's words. What cannot be run here is in
ELSEWHERE, with the reason.
"""

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

pytestmark = [pytest.mark.long, pytest.mark.filterwarnings("default")]  # transformers warns
for needed in ("transformers", "av", "viser", "mujoco", "pxr"):
    pytest.importorskip(needed)

ELSEWHERE = {
    "--ray.address auto": "a running Ray cluster",
    "--device cuda": "an NVIDIA GPU",
    "mover experiment --": "hours: many known rooms",
    "mover demo": "minutes: `make demo`",
    "mover video": "weights of networks",
}
RUN = [
    "--place.method.steps", "3", "--layout.method.steps", "3", "--gather.cells", "32",
    "--prepare.cells", "24", "--prepare.faces", "200", "--prepare.samples", "100",
    "--image.size", "48",
]  # fmt: skip
QUICK = {
    "run": RUN,
    "batch": RUN,
    "layout": ["--shapes", "2", "--keep", "2", "--turns", "2", "--screen.method.steps", "10"],
    "export": ["--body", "skin"],
}
SWAPS = {
    "mover import total3d SOURCE --out CAPTURE": {"CAPTURE": "NEW"},
    "mover import total3d FOLDER --out C": {"FOLDER": "SOURCE", "C": "NEW"},
    "mover import sam3d FOLDER --out C --image I.jpg --fov 60 --objects-masks MASKS": {
        "FOLDER": "sam3d", "C": "NEW", "MASKS": "MASKS.json",
    },
    "mover import holisticmesh FOLDER --out C": {"FOLDER": "holisticmesh", "C": "NEW"},
    "mover import glb SCENE.glb --out C [--camera K] [--up z]": {
        "C": "NEW", "[--camera": "--camera", "K]": "CAPTURE/camera.json", "[--up": "", "z]": "",
    },
    "mover import boxes BOXES.json --out C --image I.jpg": {"C": "NEW"},
    "mover import masks MASKS --out C": {"MASKS": "MASKS.json", "C": "NEW"},
    "mover import release SEQUENCE --out C": {"C": "NEW"},
    "mover import prox ROOT --recording MPH8_00034_01 --out C [--boxes bbox3d.json]": {
        "ROOT": "PROX", "C": "NEW", "[--boxes": "--boxes", "bbox3d.json]": "MPH8/bbox3d.json",
    },
    "mover import pigraphs ROOT --recording NAME --out C [--image I.png]": {
        "ROOT": "PIGRAPHS", "NAME": "a_b_c", "C": "NEW", "[--image": "", "I.png]": "",
    },
    "mover layout C": {},
    "mover layout C --depth depth.npz": {},
    "mover layout C --meshes FOLDER": {"FOLDER": "shapes"},
    "mover refine OUT": {},
    "mover contacts posa bodies.npz --weights contact.pt --mesh-folder mesh_ds"
    " --camera camera.json": {},
    "mover contacts files bodies.npz --source deco.npz": {},
    "mover run CAPTURE --out OUT --place.weights.depth 0": {},
    "mover run CAPTURE --out OUT --preset paper --place.weights.depth 80": {},
    "mover run DIR --format total3d": {"DIR": "SOURCE"},
}  # fmt: skip
"""Commands of sentences and tables, with the words that stand for something there."""


def sequences() -> Iterator[tuple[str, list[str]]]:
    """The commands of each block of code, in order."""
    for page in PAGES:
        text = page.read_text()
        fenced = [code for kind, code in FENCE.findall(text) if kind in ("", "bash", "sh")]
        for code in [*fenced, *indented(text)]:
            lines = [line.strip() for line in code.replace("\\\n", " ").splitlines()]
            lines = [line for line in lines if line.startswith("mover ")]
            if lines:
                yield page.stem, lines


BLOCKS = [pytest.param(lines, id=f"{page}-{i}") for i, (page, lines) in enumerate(sequences())]


@pytest.fixture(scope="module")
def full_desk(tmp_path_factory, small_room) -> Path:
    desk = write_desk(tmp_path_factory.mktemp("docs") / "desk", small_room)
    here = Path.cwd()
    os.chdir(desk)
    try:
        assert run_command("run", ["CAPTURE", "--out", "OUT", *RUN]) == 0
    finally:
        os.chdir(here)
    return desk


@pytest.fixture(autouse=True)
def _ctrl_c() -> Iterator[None]:
    """Programs that are started here end by Ctrl-C, even if the tests run in the background."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture
def desk(full_desk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A copy, in which the command runs."""
    mine = tmp_path / "desk"
    shutil.copytree(full_desk, mine, symlinks=True)
    monkeypatch.chdir(mine)
    monkeypatch.setenv("MOVER_BODY_MODELS", str(mine / "models"))
    yield mine
    monkeypatch.undo()
    shutil.rmtree(mine)


def start(words: list[str]) -> subprocess.Popen[str]:
    """The program as a user starts it."""
    source = Path(__file__).parents[1] / "src"
    return subprocess.Popen(
        [sys.executable, "-m", "mover", *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        text=True, env={**os.environ, "PYTHONPATH": str(source), "OMP_NUM_THREADS": "1"},
    )  # fmt: skip


def look_and_leave(words: list[str]) -> None:
    """Open the viewer's page once, then press Ctrl-C."""
    server = start([*words, "--port", "18080"])
    assert server.stdout is not None
    said = server.stdout.readline()
    assert said.startswith("http://127.0.0.1:"), said + server.communicate()[1]
    with urllib.request.urlopen(said.split()[0], timeout=60) as page:
        assert b"<html" in page.read(2000).lower()
    server.send_signal(signal.SIGINT)
    _, trouble = server.communicate(timeout=120)
    assert server.returncode in (0, 130), trouble
    assert "Traceback" not in trouble


def do(line: str, desk: Path) -> None:
    """Run one line of the docs, with its flags that make it fast."""
    name, *rest = words_of(line)
    swaps = SWAPS.get(line.split("  #")[0].strip(), {})
    words = [w for w in (swaps.get(word, word) for word in rest) if w]
    words += [word.format(desk=desk) for word in QUICK.get(name, [])]
    if name == "view":
        look_and_leave([name, *words])
    elif name == "batch":  # tyro marks what is missing by a value that no type check lets by
        ended = start([name, *words])
        _, trouble = ended.communicate(timeout=600)
        assert ended.returncode == 0, trouble
    else:
        assert run_command(name, words) == 0, line


def elsewhere(line: str) -> bool:
    return any(key in line for key in ELSEWHERE)


@pytest.mark.parametrize("lines", BLOCKS)
def test_the_commands_of_a_block_run_one_after_the_other(lines: list[str], desk: Path):
    for line in lines:
        if not elsewhere(line):
            do(line, desk)


@pytest.mark.parametrize("line", SWAPS)
def test_a_command_of_a_sentence_or_a_table_runs(line: str, desk: Path):
    text = " ".join(" ".join(page.read_text().split()) for page in PAGES)
    assert line in text
    do(line, desk)


def test_what_is_not_run_is_still_in_the_docs():
    """Else the reason is stale."""
    text = "\n".join(page.read_text() for page in PAGES)
    assert all(re.search(re.escape(key), text) for key in ELSEWHERE)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_benchmarks_that_a_page_names_have_these_options(page: Path):
    root = Path(__file__).parents[1]
    found = re.findall(r"python ((?:benchmarks|examples)/\w+\.py)([^`\n]*)", page.read_text())
    for script, rest in dict.fromkeys(found):
        assert (root / script).is_file()
        if script.startswith("benchmarks"):
            text = subprocess.run(
                [sys.executable, str(root / script), "--help"], check=True, text=True,
                capture_output=True, env={**os.environ, "PYTHONPATH": str(root / "src")},
            ).stdout  # fmt: skip
            assert all(flag in text for flag in re.findall(r"--[a-z-]+", rest)), (script, rest)
