import errno
import json
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
import tiny_capture

from mover.app import cli
from mover.app.cli import run as run_module
from mover.app.cli.run import parse_run
from mover.pipeline.presets import PRESETS


@pytest.mark.slow
def test_ctrl_c_ends_a_run_at_once_and_the_same_command_goes_on(folder, tmp_path):
    command = [sys.executable, "-m", "mover", "run", str(folder), "--out", str(tmp_path / "out")]
    command += ["--place.method.steps", "20", "--layout.method.steps", "20"]
    stages = tmp_path / "out" / "stages"
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True) as run:
        while len(list(stages.glob("*"))) < 2:
            assert run.poll() is None
            time.sleep(0.01)
        run.send_signal(signal.SIGINT)
        begin = time.monotonic()
        said = run.communicate()[1]
    assert time.monotonic() - begin < 3  # a third of a second where nothing else runs
    assert run.returncode == 130
    assert said.splitlines()[-1] == "mover run: stopped; the same command goes on from here"
    assert "Traceback" not in said
    kept = {path: path.stat().st_mtime_ns for path in stages.rglob("*.json")}
    assert subprocess.run(command, capture_output=True).returncode == 0
    assert {path: path.stat().st_mtime_ns for path in kept} == kept


AGAIN = """
import sys
from mover.app.cli import run_command

code = run_command("run", sys.argv[1:])
assert "torch" not in sys.modules
raise SystemExit(code)
"""


@pytest.mark.slow
def test_a_finished_result_is_not_made_again_until_something_changes(
    folder, tmp_path, capsys, monkeypatch
):
    out, again = tmp_path / "out", "has the result of this capture and these settings already"
    words = [str(folder), "--out", str(out), "--place.method.steps", "20"]

    def times() -> dict[Path, int]:
        return {path: path.stat().st_mtime_ns for path in out.rglob("*")}

    assert cli.run_command("run", words) == 0
    first, before = capsys.readouterr().out, times()
    found = subprocess.run([sys.executable, "-c", AGAIN, *words], capture_output=True, text=True)
    assert (found.returncode, found.stderr) == (0, "")
    assert again in found.stdout
    assert times() == before
    assert [line for line in first.splitlines() if line.startswith("warning")] == [
        line for line in found.stdout.splitlines() if line.startswith("warning")
    ]

    made: list[Path] = []

    def make(out: Path, *_: object) -> None:
        made.append(out)
        (out / "report.html").write_text("a page")

    monkeypatch.setattr(run_module, "reconstruct_into", make)
    changes = (
        lambda: os.utime(folder / "scene.json"), lambda: (out / "scene.json").write_text("{}"),
        (out / "report.html").unlink, lambda: words.extend(["--device", "auto"]),
    )  # fmt: skip
    for count, change in enumerate(changes, 1):
        change()
        for _ in range(2):
            assert cli.run_command("run", words) == 0
            assert len(made) == count
        assert again in capsys.readouterr().out


def command_that(body: str) -> list[str]:
    """`mover run` with another body, in a process of its own."""
    code = "import sys, time; from mover.app import cli\n"
    code += f"def body(_):\n    {body}\n"
    code += "cli.command_of = lambda _: body; sys.argv = ['mover', 'run']; cli.main()"
    return [sys.executable, "-c", code]


def in_shell(body: str, more: str, **env: str) -> "subprocess.CompletedProcess[str]":
    words = f"{shlex.join(command_that(body))} {more}"
    return subprocess.run(
        ["bash", "-c", words], capture_output=True, text=True, env={**os.environ, **env}
    )


def test_a_broken_pipe_ends_a_command_without_a_trace():
    found = in_shell("[cli.say('line') for _ in range(100_000)]", "| head -1")
    assert (found.stdout, found.stderr) == ("line\n", "")


def test_ctrl_c_ends_a_run_whose_library_swallows_it():
    body = "\n    ".join([
        "print('ready', flush=True)", "for _ in range(2):", "    try:", "        time.sleep(30)",
        "    except BaseException:", "        pass",
    ])  # fmt: skip
    both = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command_that(body), **both) as run:
        assert run.stdout.readline() == "ready\n"
        run.send_signal(signal.SIGINT)
        said = run.communicate(timeout=20)[1]
    assert run.returncode == 130
    assert said == "\nmover run: stopped; the same command goes on from here\n"


@pytest.mark.parametrize(("body", "said", "code"), [
    ("raise MemoryError", "mover run: out of memory; what was finished is kept\n", 2),
    (
        "raise RuntimeError('[enforce fail at alloc_cpu.cpp:127]')",
        "mover run: out of memory; what was finished is kept\n", 2,
    ),
    ("cli.say('out'), cli.say('ü', sys.stderr)", "\\xfc\n", 0),
])  # fmt: skip
def test_no_memory_a_closed_output_and_old_letters_are_no_traceback(body, said, code):
    found = in_shell(body, ">&-", PYTHONIOENCODING="ascii")
    assert (found.stderr, found.returncode) == (said, code)


@pytest.mark.parametrize("before", [True, False])
def test_flags_change_a_preset_wherever_they_stand(before):
    flags, preset = ["--place.weights.depth", "80"], ["--preset", "paper"]
    order = [*flags, *preset] if before else [*preset, *flags]
    args, config = parse_run(["capture", *order])
    assert args.source == Path("capture")
    assert config.place.weights.depth == 80
    assert config.place.method == PRESETS["paper"].place.method


def test_run_has_few_flags_and_the_first_screen_shows_those_that_people_use(capsys):
    shown = {}
    for word in ("--help", "--help-all"):
        with pytest.raises(SystemExit):
            cli.run_command("run", [word])
        shown[word] = set(re.findall(r"^[│ ]*(--[a-z_.-]+)", capsys.readouterr().out, re.M))
    assert len(shown["--help"]) <= 14
    assert len(shown["--help-all"]) <= 60
    assert {"--preset", "--out", "--edits"} <= shown["--help"] < shown["--help-all"]
    assert "--place.weights.depth" in shown["--help-all"]


@pytest.mark.parametrize(("words", "said"), [
    (["run", "capture", "--preset", "best"], "paper, robust"),
    (["run", "capture", "--format", "nope"], "--format: 'nope' is none of folder, total3d"),
    (["check", "capture", "--format", "nope"], "--format: 'nope' is none of folder, total3d"),
    (["run", "nowhere"], "nowhere"),
    (["fit", "x", "--preset", "best"], "robust, paper"),
    (["import-bodies", "nope", "x"], "TOOL: 'nope' is none of"),
    (["import", "masks", ".", "--out", "x", "--up", "z"], "--up: is for glb and boxes, not for"),
])  # fmt: skip
def test_a_wrong_name_is_answered_with_the_known_ones(words, said, capsys):
    assert cli.run_command(words[0], words[1:]) == 2
    assert said in capsys.readouterr().err


def test_an_unknown_command_is_answered_with_the_known_ones():
    words = [sys.executable, "-m", "mover", "reconstruct"]
    found = subprocess.run(words, capture_output=True, text=True)
    assert found.returncode == 2
    assert "run" in found.stdout + found.stderr


@pytest.fixture
def folder(tmp_path):
    tiny_capture.write_capture(tmp_path / "capture")
    return tmp_path / "capture"


def check(folder):
    return cli.run_command("check", [str(folder), "--out", str(folder.parent / "check.png")])


def one_line(capsys) -> str:
    """What was said on stderr, in one line."""
    (line,) = capsys.readouterr().err.strip().splitlines()
    return line


def test_check_draws_a_picture_and_lists_every_object(folder, capsys):
    assert check(folder) == 0
    out = capsys.readouterr().out
    for item in json.loads((folder / "scene.json").read_text())["objects"]:
        assert item["id"] in out
    assert (folder.parent / "check.png").stat().st_size > 1000
    scene = json.loads((folder / "scene.json").read_text())
    mesh = folder / Path(scene["objects"][0]["mesh"]).with_suffix(".obj")
    mesh.write_text("mtllib no.mtl\nusemtl oak\nv 0 0 0\nv 1 0 0\nv 0 1 1\nf 1 2 3\n")
    scene["objects"][0]["mesh"] = f"meshes/{mesh.name}"
    (folder / "scene.json").write_text(json.dumps(scene))
    assert check(folder) == 0
    assert f"warning: {mesh.name} loses the materials of no.mtl" in capsys.readouterr().out


@pytest.mark.parametrize("name", ["c3", "c3.gif"])
def test_a_picture_that_cannot_be_written_is_refused_before_the_capture_is_read(
    tmp_path, name, capsys
):
    assert cli.run_command("check", [str(tmp_path), "--out", str(tmp_path / name)]) == 2
    message = one_line(capsys)
    assert "--out: " in message
    assert repr(name) in message
    assert ".png or .jpg or .jpeg" in message


def test_wrong_input_gives_one_sentence_that_names_file_and_field(folder, capsys):
    camera = json.loads((folder / "camera.json").read_text())
    (folder / "camera.json").write_text(json.dumps(camera | {"fl_x": -1.0}))
    assert check(folder) == 2
    assert "fl_x" in one_line(capsys)


def test_a_file_as_the_folder_of_results_is_one_sentence(folder, tmp_path, capsys):
    (tmp_path / "out").write_text("mine")
    assert cli.run_command("run", [str(folder), "--out", str(tmp_path / "out")]) == 2
    found = capsys.readouterr().err.strip().splitlines()[-1]
    assert found.startswith(f"mover run: {tmp_path / 'out'}")
    assert found.endswith("what was finished is kept")
    assert (tmp_path / "out").read_text() == "mine"


def test_a_full_disk_is_one_sentence_and_loses_nothing(folder, tmp_path, capsys, monkeypatch):
    out, real, written = tmp_path / "out", os.replace, []

    def fills(source, target):
        if len(written) == 4:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(target))
        written.append(Path(target))
        real(source, target)

    monkeypatch.setattr(os, "replace", fills)
    assert cli.run_command("run", [str(folder), "--out", str(out)]) == 2
    assert "No space left on device" in capsys.readouterr().err
    assert all(path.exists() for path in written)
    assert not list(out.rglob(".*-*"))


LIGHT = """
import contextlib, io, sys
from mover.app.cli import COMMANDS, main, run_command

sys.argv = ["mover", "--help"]
with contextlib.redirect_stdout(io.StringIO()) as shown:
    main()
assert all(f"  {name} " in shown.getvalue() for name in COMMANDS)
assert {"torch", "numpy", "tyro", "scipy", "trimesh"}.isdisjoint(sys.modules)

def silent(call):
    with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()):
        try:
            call()
        except SystemExit as end:
            return end.code
    return None

for name in COMMANDS:
    assert silent(lambda: run_command(name, ["--help"])) == 0, name
    assert "torch" not in sys.modules, name
    assert silent(lambda: run_command(name, ["--no-such-flag"])) == 2, name
    assert "torch" not in sys.modules, name
for words in (["import", "nosuch", "path", "--out", "x"], ["import-bodies", "nosuch", "path"],
              ["run", "x", "--preset", "nosuch"], ["run", "x", "--format", "nosuch"],
              ["check", "x", "--format", "nosuch"], ["export", "x", "--to", "nosuch"]):
    assert (silent(lambda: run_command(words[0], words[1:])) or 2) == 2, words
    assert "torch" not in sys.modules, words
assert {"numpy", "scipy", "trimesh", "warp"}.isdisjoint(sys.modules)
"""


def test_help_and_mistyped_names_of_every_command_import_nothing_heavy():
    found = subprocess.run([sys.executable, "-c", LIGHT], capture_output=True, text=True)
    assert found.returncode == 0, found.stderr


@pytest.mark.parametrize("name", ["experiment", "paper-table"])
def test_commands_of_the_bench_say_where_it_is_if_it_is_not_installed(name, monkeypatch, capsys):
    def absent(module: str) -> None:
        top = module.partition(".")[0]
        raise ModuleNotFoundError(f"No module named {top!r}", name=top)  # as Python does

    monkeypatch.setattr(cli.importlib, "import_module", absent)
    assert cli.run_command(name, []) == 2
    said = f"mover {name}: mover_bench is not in the wheel of mover; pip install"
    assert one_line(capsys).startswith(said)
