import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import tiny_capture

from mover import commands
from mover.presets import PRESETS


def call(*arguments, cwd=None):
    return subprocess.run(
        [sys.executable, "-m", "mover", *arguments],
        capture_output=True, text=True, cwd=cwd, check=False,
    )  # fmt: skip


def test_help_names_every_command_and_imports_nothing_heavy():
    code = (
        "import sys; sys.argv = ['mover', '--help']; from mover.cli import main; main();"
        "heavy = {'torch', 'numpy', 'tyro', 'scipy', 'trimesh'} & set(sys.modules);"
        "assert not heavy, heavy"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    for name in ("demo", "check", "run", "evaluate", "experiment", "export", "settle", "batch"):
        assert f"  {name} " in found.stdout


def test_an_unknown_command_is_answered_with_the_known_ones():
    found = call("reconstruct")
    assert found.returncode == 2
    assert "run" in found.stdout + found.stderr


@pytest.mark.parametrize("before", [True, False])
def test_flags_change_a_preset_wherever_they_stand(before):
    flags, preset = ["--place.weights.depth", "80"], ["--preset", "paper"]
    order = [*flags, *preset] if before else [*preset, *flags]
    args, config = commands.parse_run(["capture", *order])
    assert args.source == Path("capture")
    assert config.place.weights.depth == 80
    assert config.place.method == PRESETS["paper"].place.method


def test_a_wrong_preset_is_answered_with_the_known_ones(capsys):
    assert commands.run_command("run", ["capture", "--preset", "best"]) == 2
    assert "paper, release, robust" in capsys.readouterr().err


@pytest.fixture
def folder(tmp_path):
    tiny_capture.write_capture(tmp_path / "capture")
    return tmp_path / "capture"


def check(folder):
    return commands.run_command("check", [str(folder), "--out", str(folder.parent / "check.png")])


def test_check_draws_a_picture_and_lists_every_object(folder, capsys):
    assert check(folder) == 0
    out = capsys.readouterr().out
    for item in json.loads((folder / "scene.json").read_text())["objects"]:
        assert item["id"] in out
    assert (folder.parent / "check.png").stat().st_size > 1000


def test_wrong_input_gives_one_sentence_that_names_file_and_field(folder, capsys):
    camera = json.loads((folder / "camera.json").read_text())
    (folder / "camera.json").write_text(json.dumps(camera | {"fl_x": -1.0}))
    assert check(folder) == 2
    message = capsys.readouterr().err.strip()
    assert len(message.splitlines()) == 1
    assert "fl_x" in message


def test_nan_in_the_bodies_is_named(folder, capsys):
    with np.load(folder / "bodies.npz") as arrays:
        values = dict(arrays)
    values["vertices"] = values["vertices"].copy()
    values["vertices"][0, 0, 0] = np.nan
    np.savez(folder / "bodies.npz", **values)
    assert check(folder) == 2
    assert "bodies.npz" in capsys.readouterr().err


def test_a_missing_folder_is_named(capsys):
    assert commands.run_command("run", [str(Path("nowhere"))]) == 2
    assert "nowhere" in capsys.readouterr().err
