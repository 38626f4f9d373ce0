"""Batches: bad captures are told apart, what is finished is never done again."""

import csv
import importlib.util
import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
from tiny_capture import write_capture

from mover.app.batch import BatchPlan, captures_in, jobs_of, names_of, run_batch, write_summary
from mover.app.batch.engines import EngineOptions, RayOptions, SlurmOptions
from mover.app.batch.job import earlier, run_job
from mover.core.errors import InputError

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
if task == "slow":
    time.sleep(600)
time.sleep(float(os.environ.get("FAKE_SECONDS", "0")))
if task != "silent":
    (out / "run.json").write_text(json.dumps({"warnings": ["a"], "stages": [{"peak_memory": 5.0}]}))
    (out / "scene.json").write_text(json.dumps({"name": capture.name, "length": len(task)}))
"""

SLURM = """#!{python} -SE
import os, subprocess, sys
from pathlib import Path
home, name = Path(__file__).parent, Path(__file__).name
options = dict(word.split("=", 1) for word in sys.argv[1:] if "=" in word)
if name == "sbatch":
    if options.get("--partition") == "none":
        sys.exit("sbatch: error: invalid partition specified: none")
    for place in range(int(options["--array"].split("-")[1].split("%")[0]) + 1):
        process = subprocess.Popen(
            ["bash", "-c", options["--wrap"]], stdin=-3, stdout=-3, stderr=-3,
            env=dict(os.environ, SLURM_ARRAY_TASK_ID=str(place)), start_new_session=True,
        )
        (home / f"{place}.pid").write_text(str(process.pid))
    print("7;here")
if name == "squeue":
    for file in home.glob("*.pid"):
        if Path("/proc", file.read_text()).is_dir():
            print(file.stem)
"""  # of SLURM's commands what a batch uses, as their manual pages tell it


def pretend_slurm(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder.mkdir()
    for name in ("sbatch", "squeue", "scancel"):
        (folder / name).write_text(SLURM.replace("{python}", sys.executable))
        (folder / name).chmod(0o755)
    monkeypatch.setenv("PATH", f"{folder}{os.pathsep}{os.environ['PATH']}")
    monkeypatch.setattr("mover.app.batch.engines.WAIT", 0.05)


def fakes(folder: Path, count: int, special: dict[int, str]) -> tuple[Path, ...]:
    (folder / "fake.py").write_text(FAKE)
    for index in range(count):
        capture = folder / "captures" / f"capture_{index:02d}"
        capture.mkdir(parents=True)
        (capture / "task.txt").write_text(special.get(index, "fine"))
    return captures_in(folder / "captures")


def plan_of(folder: Path, captures: tuple[Path, ...], limit: float = 0.0) -> BatchPlan:
    command = (sys.executable, "-S", "-E", str(folder / "fake.py"), "{capture}", "{out}")
    return BatchPlan(captures, folder / "out", command, "settings", limit)


def starts(folder: Path) -> list[str]:
    return (folder / "starts.txt").read_text().split()


def failures(folder: Path) -> dict[str, dict[str, object]]:
    files = sorted((folder / "out" / "failures").glob("*.json"))
    return {file.stem: json.loads(file.read_text()) for file in files}


def states(folder: Path) -> dict[str, str]:
    with (folder / "out" / "summary.csv").open(newline="") as stream:
        return {row["name"]: row["state"] for row in csv.DictReader(stream)}


def run_here(plan: BatchPlan, workers: int = 2, **more: object) -> list[str]:
    outcomes = run_batch(plan, EngineOptions("local", workers), quiet=True, **more)
    return [outcome.state for outcome in outcomes]


class Clock:
    """Stands still until all captures but one have ended; then the limit of the last is over."""

    def __init__(self, out: Path, others: int) -> None:
        self.out, self.others = out, others

    def monotonic(self) -> float:
        ended = [*self.out.glob("failures/*.json"), *self.out.glob("*/batch.json")]
        return 100.0 if len(ended) >= self.others else 0.0


def test_each_way_to_fail_leaves_its_own_clear_record(tmp_path: Path, monkeypatch):
    ways = {0: "refuse", 1: "crash", 2: "slow", 3: "killed", 4: "silent"}
    plan = plan_of(tmp_path, fakes(tmp_path, 7, ways), limit=1.5)
    monkeypatch.setattr("mover.app.batch.job.time", Clock(plan.out, 6))
    found = run_here(plan)
    assert found == ["failed"] * 5 + ["done"] * 2
    records = list(failures(tmp_path).values())
    assert [r["kind"] for r in records] == ["input", "exit", "time limit", "signal", "no result"]
    assert records[0]["reason"] == (
        "exit code 2: mover run: camera.json: field 'w' has 0, expected a number above 0"
    )
    assert records[1]["exit_code"] == 86
    assert records[1]["last_lines"] == ["about to die"]
    assert records[2]["reason"] == "ran longer than its limit of 1.5 s"
    assert records[3]["signal"] == "SIGSEGV"
    assert records[4]["reason"] == ("ended well without scene.json and run.json: it said nothing")
    assert list(states(tmp_path).values()) == found


def test_nothing_finished_or_failed_is_run_again_unless_it_is_asked_for(tmp_path: Path):
    plan = plan_of(tmp_path, fakes(tmp_path, 3, {1: "crash"}))
    run_here(plan)
    assert run_here(plan) == ["kept", "failed", "kept"]
    assert len(starts(tmp_path)) == 3
    (plan.captures[1] / "task.txt").write_text("mended")
    assert run_here(plan) == ["kept", "done", "kept"]
    assert failures(tmp_path) == {}
    assert len(starts(tmp_path)) == 4


def test_failures_are_run_again_when_asked(tmp_path: Path):
    plan = plan_of(tmp_path, fakes(tmp_path, 2, {1: "crash"}))
    run_here(plan)
    assert run_here(plan, retry=True) == ["kept", "failed"]
    assert starts(tmp_path).count("capture_01") == 2


def test_other_settings_or_a_changed_capture_are_other_work(tmp_path: Path):
    captures = fakes(tmp_path, 2, {})
    plan = plan_of(tmp_path, captures)
    run_here(plan)
    (captures[0] / "task.txt").write_text("longer")
    assert run_here(plan) == ["done", "kept"]
    other = BatchPlan(captures, plan.out, plan.command, "other settings")
    assert run_here(other) == ["done", "done"]


def test_a_result_that_lost_a_file_is_made_again(tmp_path: Path):
    plan = plan_of(tmp_path, fakes(tmp_path, 1, {}))
    run_here(plan)
    (plan.out / "capture_00" / "scene.json").unlink()
    assert run_here(plan) == ["done"]


BATCH = """
import sys
from pathlib import Path
from mover.app.batch import BatchPlan, captures_in, run_batch
from mover.app.batch.engines import EngineOptions
folder = Path(sys.argv[1])
command = (sys.executable, "-S", "-E", str(folder / "fake.py"), "{capture}", "{out}")
plan = BatchPlan(captures_in(folder / "captures"), folder / "out", command, "settings", 4.0)
run_batch(plan, EngineOptions("local", 4))
"""


@pytest.mark.slow
def test_forty_captures_survive_a_kill_half_way_and_three_bad_ones(tmp_path: Path):
    plan = plan_of(tmp_path, fakes(tmp_path, 40, {7: "refuse", 19: "crash", 30: "slow"}), 4.0)
    root = Path(__file__).parents[1]
    variables = {**os.environ, "PYTHONPATH": str(root / "src"), "FAKE_SECONDS": "0.2"}
    first = subprocess.Popen(
        [sys.executable, "-c", BATCH, str(tmp_path)], env=variables, stderr=subprocess.DEVNULL
    )
    while sum(1 for _ in plan.out.glob("capture_*/batch.json")) < 15:
        assert first.poll() is None
        time.sleep(0.02)
    first.send_signal(signal.SIGKILL)
    first.wait()
    before = {path.name for path in plan.out.glob("capture_*") if (path / "batch.json").is_file()}
    times = {name: (plan.out / name / "scene.json").stat().st_mtime_ns for name in before}
    tried = set(starts(tmp_path))
    assert 15 <= len(before) < 37
    found = run_here(plan, workers=4)
    assert found.count("done") + found.count("kept") == 37
    assert found.count("failed") == 3
    assert {n: r["kind"] for n, r in failures(tmp_path).items()} == {
        "capture_07": "input", "capture_19": "exit", "capture_30": "time limit",
    }  # fmt: skip
    now = {name: (plan.out / name / "scene.json").stat().st_mtime_ns for name in before}
    assert now == times
    twice = [name for name in set(starts(tmp_path)) if starts(tmp_path).count(name) > 1]
    assert set(twice) <= tried - before
    assert len(twice) <= 4  # those that ran when the batch was killed


@pytest.mark.slow
def test_a_killed_batch_takes_its_processes_along(tmp_path: Path):
    fakes(tmp_path, 1, {0: "slow"})
    root = Path(__file__).parents[1]
    variables = {**os.environ, "PYTHONPATH": str(root / "src")}
    first = subprocess.Popen([sys.executable, "-c", BATCH, str(tmp_path)], env=variables)
    while not (tmp_path / "starts.txt").exists():
        time.sleep(0.02)
    children = Path(f"/proc/{first.pid}/task")
    if not children.exists():
        pytest.skip("needs /proc")
    ids = [int(w) for f in children.glob("*/children") for w in f.read_text().split()]
    assert ids
    first.kill()
    first.wait()
    for _ in range(200):
        alive = [p for p in ids if Path(f"/proc/{p}/status").exists() and not ended(p)]
        if not alive:
            break
        time.sleep(0.02)
    assert not alive


def ended(process: int) -> bool:
    try:
        return "State:\tZ" in Path(f"/proc/{process}/status").read_text()
    except OSError:
        return True


def test_two_batches_do_not_run_one_capture_at_the_same_time(tmp_path: Path, monkeypatch):
    monkeypatch.setenv("FAKE_SECONDS", "0.3")
    job = jobs_of(plan_of(tmp_path, fakes(tmp_path, 1, {})))[0]
    found: list[str] = []
    threads = [threading.Thread(target=lambda: found.append(run_job(job).state)) for _ in range(2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(found) == ["done", "kept"]
    assert len(starts(tmp_path)) == 1


def test_a_stopped_job_leaves_no_record(tmp_path: Path):
    job = jobs_of(plan_of(tmp_path, fakes(tmp_path, 1, {0: "slow"})))[0]
    stop = threading.Event()
    threading.Timer(0.3, stop.set).start()
    assert run_job(job, stop).state == "stopped"
    assert earlier(job) is None
    assert failures(tmp_path) == {}


def test_a_command_that_does_not_exist_is_a_failure_not_an_end(tmp_path: Path):
    captures = fakes(tmp_path, 2, {})
    plan = BatchPlan(captures, tmp_path / "out", ("/no/such/program", "{capture}"), "settings")
    assert run_here(plan) == ["failed", "failed"]


def test_a_list_names_captures_relative_to_itself_with_remarks(tmp_path: Path):
    listing = tmp_path / "list.txt"
    listing.write_text("# all\na\n\nsub/b   # the other\n/abs/c\n")
    assert captures_in(listing) == (tmp_path / "a", tmp_path / "sub/b", Path("/abs/c"))


@pytest.mark.parametrize("text", ["", "# none\n", "a\n./a\n"])
def test_a_list_without_captures_or_with_one_twice_is_refused(tmp_path: Path, text: str):
    listing = tmp_path / "list.txt"
    listing.write_text(text)
    with pytest.raises(InputError, match=r"list\.txt"):
        captures_in(listing)


def test_a_capture_in_place_of_a_list_is_told_apart(tmp_path: Path):
    write_capture(tmp_path / "room")
    with pytest.raises(InputError, match="is a capture"):
        captures_in(tmp_path / "room")


def test_captures_of_one_name_get_different_folders():
    names = names_of([Path("/a/room"), Path("/b/room"), Path("/b/hall"), Path("/b/failures")])
    assert names[2] == "hall"
    assert len({name.casefold() for name in names}) == 4
    assert "failures" not in names


def test_the_summary_has_a_table_for_other_programs_where_pyarrow_is(tmp_path: Path):
    parquet = pytest.importorskip("pyarrow.parquet", reason="needs pyarrow")
    plan = plan_of(tmp_path, fakes(tmp_path, 2, {1: "crash"}))
    run_here(plan)
    assert parquet.read_table(plan.out / "summary.parquet").num_rows == 2


def test_an_empty_summary_still_has_its_head(tmp_path: Path):
    write_summary([], tmp_path)
    assert (tmp_path / "summary.csv").read_text().startswith("name,state,seconds")


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["ray", "slurm"])
def test_other_engines_give_what_the_local_one_gives(tmp_path: Path, engine: str, monkeypatch):
    if engine == "slurm":
        pretend_slurm(tmp_path / "commands", monkeypatch)
    elif importlib.util.find_spec(engine) is None:
        pytest.skip(f"needs the extra {engine}")
    count = {"ray": 40, "slurm": 6}[engine]
    captures = fakes(tmp_path, count, {1: "refuse", 2: "crash", 3: "slow"})
    here = plan_of(tmp_path, captures, 3.0)
    there = BatchPlan(captures, tmp_path / "there", here.command, "settings", 3.0)
    local = run_here(here)
    options = EngineOptions(engine, 2, RayOptions(cpus=0.5), SlurmOptions(minutes=5))
    found = run_batch(there, options, quiet=True)
    assert [outcome.state for outcome in found] == local
    for job in jobs_of(there):
        mine, theirs = (tmp_path / home / job.name / "scene.json" for home in ("out", "there"))
        assert mine.exists() == theirs.exists()
        assert not mine.exists() or mine.read_bytes() == theirs.read_bytes()
    kinds = [json.loads(f.read_text())["kind"] for f in sorted((there.out / "failures").iterdir())]
    assert kinds == [r["kind"] for r in failures(tmp_path).values()]


def test_a_job_that_slurm_has_ended_without_a_word_is_a_failure(tmp_path: Path, monkeypatch):
    pretend_slurm(tmp_path / "commands", monkeypatch)
    monkeypatch.setattr("mover.app.batch.engines.LATE", 0.2)
    monkeypatch.setattr("mover.app.batch.engines.sys.executable", "/bin/false")  # a node's own
    plan = plan_of(tmp_path, fakes(tmp_path, 2, {}))
    found = run_batch(plan, EngineOptions("slurm", 2), quiet=True)
    assert [outcome.state for outcome in found] == ["failed", "failed"]
    assert "SLURM has ended it, see" in found[0].reason
    assert failures(tmp_path)["capture_01"]["kind"] == "worker"


def test_what_slurm_says_when_it_refuses_is_passed_on(tmp_path: Path, monkeypatch):
    pretend_slurm(tmp_path / "commands", monkeypatch)
    plan = plan_of(tmp_path, fakes(tmp_path, 1, {}))
    options = EngineOptions("slurm", 2, slurm=SlurmOptions("none"))
    with pytest.raises(InputError, match=r"sbatch refuses the jobs: .* partition specified: none"):
        run_batch(plan, options, quiet=True)
    monkeypatch.setenv("PATH", "")
    with pytest.raises(InputError, match="no sbatch, expected a machine with SLURM's commands"):
        run_batch(plan, options, quiet=True)


@pytest.mark.slow
def test_a_true_capture_runs_and_a_broken_one_says_what_is_broken(tmp_path: Path):
    write_capture(tmp_path / "captures" / "good")
    write_capture(tmp_path / "captures" / "bad")
    (tmp_path / "captures" / "bad" / "camera.json").write_text("{}")
    root = Path(__file__).parents[1]
    variables = {**os.environ, "PYTHONPATH": str(root / "src"), "OMP_NUM_THREADS": "1"}
    out = tmp_path / "out"
    command = [
        sys.executable,
        "-m",
        "mover",
        "batch",
        str(tmp_path / "captures"),
        "--out",
        str(out),
    ]
    quick = ["--place.method.steps", "5", "--layout.method.steps", "5", "--workers", "2"]
    quick.append("--refine")
    for expected in ("1 done, 1 failed", "1 done (1 of them before), 1 failed"):
        ended = subprocess.run(
            [*command, *quick], env=variables, capture_output=True, text=True, check=False
        )
        assert ended.returncode == 1, ended.stderr
        assert expected in ended.stdout
    assert (out / "good" / "scene.json").is_file()
    assert json.loads((out / "good" / "run.json").read_text())["people_refined"]
    record = json.loads((out / "failures" / "bad.json").read_text())
    assert record["kind"] == "input"
    assert "camera.json" in record["reason"]
