"""Batches: bad captures are told apart, what is finished is never done again."""

import csv
import dataclasses
import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from tiny_capture import write_capture

from mover.app.batch import (
    BatchJob,
    RayOptions,
    captures_in,
    earlier,
    names_of,
    run_batch,
    run_job,
)
from mover.core.errors import InputError
from mover.core.files import fingerprint_of_files

REFUSED = "mover run: camera.json: field 'w' has 0, expected a number above 0"
FAKE = """
import json, os, sys, time
from pathlib import Path
capture, out = Path(sys.argv[1]), Path(sys.argv[2])
with (capture.parent.parent / "starts.txt").open("a") as starts:
    starts.write(capture.name + "\\n")
task = (capture / "task.txt").read_text()
if task == "refuse":
    sys.stderr.write("mover run: camera.json: field 'w' has 0, expected a number above 0\\n")
    sys.exit(2)
if task == "crash":
    sys.stderr.write("about to die\\n")
    sys.stderr.flush()
    os._exit(86)
if task == "killed":
    os.kill(os.getpid(), 11)
if task == "interrupted":
    os.kill(os.getpid(), 2)
if task == "slow":
    time.sleep(600)
time.sleep(float(os.environ.get("FAKE_SECONDS", "0")))
if task != "silent":
    (out / "run.json").write_text(json.dumps({"warnings": ["a"], "stages": [{"peak_memory": 5.0}]}))
    (out / "scene.json").write_text(json.dumps({"name": capture.name, "length": len(task)}))
"""


def fakes(folder: Path, count: int, special: dict[int, str]) -> tuple[Path, ...]:
    (folder / "fake.py").write_text(FAKE)
    for index in range(count):
        capture = folder / "captures" / f"capture_{index:02d}"
        capture.mkdir(parents=True)
        (capture / "task.txt").write_text(special.get(index, "fine"))
    return captures_in(folder / "captures")


def jobs_of(
    folder: Path, limit: float = 0.0, out: str = "out", settings: str = ""
) -> list[BatchJob]:
    jobs: list[BatchJob] = []
    for capture in captures_in(folder / "captures"):
        place = str(folder / out / capture.name)
        command = (sys.executable, "-S", "-E", str(folder / "fake.py"), str(capture), place)
        mark = fingerprint_of_files(settings, capture)
        jobs.append(BatchJob(capture.name, str(capture), place, command, mark, limit))
    return jobs


def starts(folder: Path) -> list[str]:
    return (folder / "starts.txt").read_text().split()


def failures(folder: Path, out: str = "out") -> dict[str, str]:
    files = sorted((folder / out).glob("*/batch.json"))
    found = {file.parent.name: json.loads(file.read_text())["reason"] for file in files}
    return {name: reason for name, reason in found.items() if reason}


def states(folder: Path) -> dict[str, str]:
    with (folder / "out" / "summary.csv").open(newline="") as stream:
        return {row["name"]: row["state"] for row in csv.DictReader(stream)}


def run_here(folder: Path, workers: int = 2, retry: bool = False, **more: Any) -> list[str]:
    outcomes = run_batch(jobs_of(folder, **more), folder / "out", workers, retry=retry)
    return [outcome.state for outcome in outcomes]


def test_each_way_to_fail_leaves_its_own_clear_record(tmp_path: Path):
    ways = {0: "refuse", 1: "crash", 2: "slow", 3: "killed", 4: "silent"}
    fakes(tmp_path, 8, ways)
    jobs = jobs_of(tmp_path)
    jobs[2] = dataclasses.replace(jobs[2], limit=0.5)
    jobs[5] = dataclasses.replace(jobs[5], command=("/no/such/program",))
    found = [outcome.state for outcome in run_batch(jobs, tmp_path / "out", 2)]
    assert found == ["failed"] * 6 + ["done"] * 2
    assert list(failures(tmp_path).values()) == [
        f"exit code 2: {REFUSED}",
        "exit code 86: about to die",
        "ran longer than its limit of 0.5 s",
        "ended by signal 11 (Segmentation fault): it said nothing",
        "ended well without scene.json and run.json: it said nothing",
        "could not be started: [Errno 2] No such file or directory: '/no/such/program'",
    ]
    assert list(states(tmp_path).values()) == found


def test_nothing_finished_or_failed_is_run_again_unless_it_is_asked_for(tmp_path: Path):
    captures = fakes(tmp_path, 3, {1: "crash"})
    run_here(tmp_path)
    assert run_here(tmp_path) == ["kept", "failed", "kept"]
    assert len(starts(tmp_path)) == 3
    assert run_here(tmp_path, retry=True) == ["kept", "failed", "kept"]
    assert starts(tmp_path).count("capture_01") == 2
    (captures[1] / "task.txt").write_text("mended")
    assert run_here(tmp_path) == ["kept", "done", "kept"]
    assert failures(tmp_path) == {}
    assert len(starts(tmp_path)) == 5


def test_other_settings_a_changed_capture_or_a_lost_file_are_work_to_do(tmp_path: Path):
    captures = fakes(tmp_path, 2, {})
    run_here(tmp_path)
    (captures[0] / "task.txt").write_text("longer")
    assert run_here(tmp_path) == ["done", "kept"]
    assert run_here(tmp_path, settings="other") == ["done", "done"]
    (tmp_path / "out" / "capture_00" / "scene.json").unlink()
    assert run_here(tmp_path, settings="other") == ["done", "kept"]


def done(out: Path) -> set[str]:
    files = out.glob("capture_*/batch.json")
    return {file.parent.name for file in files if (file.parent / "scene.json").is_file()}


def killed_batch(folder: Path) -> "subprocess.Popen[bytes]":
    paths = os.pathsep.join([str(Path(__file__).parent), *filter(None, sys.path)])
    code = f"from test_batch import *; run_here(Path({str(folder)!r}), 4, limit=4.0)"
    env = {**os.environ, "PYTHONPATH": paths}
    return subprocess.Popen([sys.executable, "-c", code], stderr=subprocess.DEVNULL, env=env)


@pytest.mark.slow
def test_forty_captures_survive_a_kill_half_way_and_three_bad_ones(tmp_path: Path, monkeypatch):
    fakes(tmp_path, 40, {7: "refuse", 19: "crash", 30: "slow"})
    monkeypatch.setenv("FAKE_SECONDS", "0.2")
    out, first = tmp_path / "out", killed_batch(tmp_path)
    while len(done(out)) < 15:
        assert first.poll() is None
        time.sleep(0.02)
    first.send_signal(signal.SIGKILL)
    first.wait()
    before = done(out)
    times = {name: (out / name / "scene.json").stat().st_mtime_ns for name in before}
    assert 15 <= len(before) < 37
    found = run_here(tmp_path, 4, limit=4.0)
    assert found.count("done") + found.count("kept") == 37
    assert found.count("failed") == 3
    assert {name: reason.split(":")[0] for name, reason in failures(tmp_path).items()} == {
        "capture_07": "exit code 2", "capture_19": "exit code 86",
        "capture_30": "ran longer than its limit of 4 s",
    }  # fmt: skip
    now = {name: (out / name / "scene.json").stat().st_mtime_ns for name in before}
    assert now == times
    twice = [name for name in set(starts(tmp_path)) if starts(tmp_path).count(name) > 1]
    assert before.isdisjoint(twice)
    assert len(twice) <= 4  # those that ran when the batch was killed


@pytest.mark.slow
def test_a_process_that_outlives_a_killed_batch_is_waited_for(tmp_path: Path, monkeypatch):
    fakes(tmp_path, 1, {})
    monkeypatch.setenv("FAKE_SECONDS", "2")
    first = killed_batch(tmp_path)
    while not (tmp_path / "starts.txt").exists():
        time.sleep(0.02)
    first.kill()
    first.wait()
    begin = time.monotonic()
    monkeypatch.setenv("FAKE_SECONDS", "0")
    assert run_here(tmp_path) == ["done"]
    assert time.monotonic() - begin > 1
    assert (tmp_path / "out" / "capture_00" / "scene.json").is_file()


def test_two_batches_do_not_run_one_capture_at_the_same_time(tmp_path: Path, monkeypatch):
    monkeypatch.setenv("FAKE_SECONDS", "0.3")
    fakes(tmp_path, 1, {})
    (job,) = jobs_of(tmp_path)
    found: list[str] = []
    threads = [threading.Thread(target=lambda: found.append(run_job(job).state)) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(found) == ["done", "kept"]
    assert len(starts(tmp_path)) == 1


def test_an_interrupted_job_leaves_no_record(tmp_path: Path):
    fakes(tmp_path, 1, {0: "interrupted"})
    (job,) = jobs_of(tmp_path)
    assert run_here(tmp_path) == ["stopped"]
    assert earlier(job) is None
    assert failures(tmp_path) == {}
    assert states(tmp_path) == {"capture_00": "open"}


def test_a_list_names_captures_relative_to_itself_with_remarks(tmp_path: Path):
    listing = tmp_path / "list.txt"
    listing.write_text("# all\na\n\nsub/b   # the other\n/abs/c\n")
    assert captures_in(listing) == (tmp_path / "a", tmp_path / "sub/b", Path("/abs/c"))
    for text in ("", "# none\n", "a\n./a\n"):  # none, or one twice
        listing.write_text(text)
        with pytest.raises(InputError, match=r"list\.txt"):
            captures_in(listing)
    write_capture(tmp_path / "room")
    with pytest.raises(InputError, match="is a capture"):
        captures_in(tmp_path / "room")


def test_captures_of_one_name_get_different_folders():
    names = names_of([Path("/a/room"), Path("/b/room"), Path("/b/hall"), Path("/b/summary.csv")])
    assert names[2] == "hall"
    assert len({name.casefold() for name in names}) == 4
    assert "summary.csv" not in names


def test_without_ray_the_way_to_get_it_is_said_and_the_summary_has_its_head(tmp_path, monkeypatch):
    monkeypatch.setattr("mover.app.batch.find_spec", lambda _: None)
    fakes(tmp_path, 1, {})
    with pytest.raises(InputError, match=r"ray is not installed; pip install -e '\.\[ray\]'"):
        run_batch(jobs_of(tmp_path), tmp_path / "out", 1, RayOptions())
    assert states(tmp_path) == {"capture_00": "open"}
    run_batch([], tmp_path, 1)
    assert (tmp_path / "summary.csv").read_text().startswith("name,state,seconds")


@pytest.mark.slow
def test_ray_gives_what_this_machine_gives(tmp_path: Path):
    pytest.importorskip("ray", reason="needs the extra ray")
    fakes(tmp_path, 10, {1: "refuse", 2: "crash", 3: "slow"})
    local, there = run_here(tmp_path, limit=3.0), jobs_of(tmp_path, 3.0, "there")
    found = run_batch(there, tmp_path / "there", 2, RayOptions(cpus=0.5))
    assert [outcome.state for outcome in found] == local
    for job in there:
        mine, theirs = (tmp_path / home / job.name / "scene.json" for home in ("out", "there"))
        assert mine.exists() == theirs.exists()
        assert not mine.exists() or mine.read_bytes() == theirs.read_bytes()
    assert failures(tmp_path, "there") == failures(tmp_path)


@pytest.mark.slow
def test_a_true_capture_runs_and_a_broken_one_says_what_is_broken(tmp_path: Path):
    write_capture(tmp_path / "captures" / "good")
    write_capture(tmp_path / "captures" / "bad")
    (tmp_path / "captures" / "bad" / "camera.json").write_text("{}")
    root = Path(__file__).parents[1]
    variables = {**os.environ, "PYTHONPATH": str(root / "src"), "OMP_NUM_THREADS": "1"}
    out = tmp_path / "out"
    command = [sys.executable, "-m", "mover", "batch", str(tmp_path / "captures")]
    command += ["--out", str(out), "--place.method.steps", "5", "--layout.method.steps", "5"]
    command += ["--workers", "2", "--refine"]
    for expected in ("1 done, 1 failed", "1 done (1 of them before), 1 failed"):
        ended = subprocess.run(command, env=variables, capture_output=True, text=True, check=False)
        assert ended.returncode == 1, ended.stderr
        assert expected in ended.stdout
    assert (out / "good" / "scene.json").is_file()
    assert json.loads((out / "good" / "run.json").read_text())["people_refined"]
    assert failures(tmp_path)["bad"].startswith("exit code 2: mover run: camera.json")
