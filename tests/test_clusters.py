"""Forty captures on clusters of two nodes on this machine, one of which dies on the way."""

import csv
import importlib.util
import json
import logging
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Generator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import pytest
from tiny_capture import write_capture

pytestmark = pytest.mark.long
log = logging.getLogger(__name__)

COUNT = 40
PATIENCE = 60.0  # [s] for a cluster to stand
SOURCES = str(Path(__file__).parents[1] / "src")
QUICK = "--place.method.steps 2 --layout.method.steps 2 --prepare.cells 16 --prepare.faces 100"


def free_ports(count: int) -> list[int]:
    with ExitStack() as stack:
        sockets = [stack.enter_context(socket.socket()) for _ in range(count)]
        for each in sockets:
            each.bind(("127.0.0.1", 0))
        return [each.getsockname()[1] for each in sockets]


@contextmanager
def running(*words: str, log: Path, env: dict[str, str]) -> Generator[subprocess.Popen[bytes]]:
    """A server that ends with the block."""
    with log.open("ab") as file:
        process = subprocess.Popen(
            words, stdout=file, stderr=file, env=env, start_new_session=True, cwd=log.parent
        )
    try:
        yield process
    finally:
        kill_group(process)


def kill_group(process: subprocess.Popen[bytes]) -> None:
    try:
        os.killpg(process.pid, signal.SIGKILL)
    except ProcessLookupError:
        return
    process.wait()


def wait_for(there: Callable[[], bool]) -> None:
    end = time.monotonic() + PATIENCE
    while not there():
        assert time.monotonic() < end, "the cluster does not stand"
        time.sleep(0.2)


def said(*words: str, env: dict[str, str]) -> str:
    return subprocess.run(words, env=env, capture_output=True, text=True, check=False).stdout


def environment(**more: str) -> dict[str, str]:
    paths = os.pathsep.join([SOURCES, *filter(None, [os.environ.get("PYTHONPATH")])])
    return {**os.environ, "PYTHONPATH": paths, "OMP_NUM_THREADS": "1", **more}


def survives(folder: Path, flags: str, env: dict[str, str], kill: Callable[[], None]) -> None:
    """Run the batch, kill a node when ten captures are done, look at all results."""
    out = folder / "out"
    write_capture(folder / "captures" / "room_00")
    for index in range(1, COUNT):
        shutil.copytree(folder / "captures" / "room_00", folder / "captures" / f"room_{index:02d}")
    words = [sys.executable, "-m", "mover", "batch", str(folder / "captures"), "--out", str(out)]
    words += [*QUICK.split(), *flags.split()]
    done: dict[str, set[int]] = {}
    alive, begin = True, time.monotonic()
    with running(*words, log=folder / "batch.txt", env=env) as batch:
        while batch.poll() is None:
            for mark in out.glob("*/batch.json"):
                done.setdefault(mark.parent.name, set()).add(mark.stat().st_mtime_ns)
            if alive and len(done) >= 10:
                kill()
                alive = False
            time.sleep(0.2)
    log.info("%d captures in %.0f s, a node lost", COUNT, time.monotonic() - begin)
    text = (folder / "batch.txt").read_text()
    assert f"{COUNT} done, 0 failed" in text, text
    assert not alive
    assert {name: len(times) for name, times in done.items()} == dict.fromkeys(done, 1)
    with (out / "summary.csv").open(newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [row["name"] for row in rows] == [f"room_{i:02d}" for i in range(COUNT)]
    assert {row["state"] for row in rows} == {"done"}
    assert all(float(row["seconds"]) > 0 for row in rows)
    scenes = [json.loads((Path(row["out"]) / "scene.json").read_text()) for row in rows]
    assert all({**scene, "name": ""} == {**scenes[0], "name": ""} for scene in scenes)
    again = subprocess.run(words, env=env, capture_output=True, text=True, check=True)
    assert f"{COUNT} done ({COUNT} of them before), 0 failed" in again.stdout


def test_a_ray_cluster_loses_a_node_and_no_capture(tmp_path: Path):
    if importlib.util.find_spec("ray") is None:
        pytest.skip("needs the extra ray")
    port = free_ports(1)[0]
    start = [sys.executable, "-m", "ray.scripts.scripts", "start", "--block", "--num-cpus=1"]
    env = environment(RAY_USAGE_STATS_ENABLED="0", RAY_DISABLE_IMPORT_WARNING="1")
    address = f"127.0.0.1:{port}"
    nodes = [
        ["--head", f"--port={port}", "--node-ip-address=127.0.0.1", "--include-dashboard=false"],
        [f"--address={address}", "--node-ip-address=127.0.0.1"],
    ]
    status = [sys.executable, "-m", "ray.scripts.scripts", "status", f"--address={address}"]
    with running(*start, *nodes[0], log=tmp_path / "first.log", env=env), ExitStack() as stack:
        wait_for(lambda: said(*status, env=env).count(" node_") == 1)
        second = stack.enter_context(
            running(*start, *nodes[1], log=tmp_path / "second.log", env=env)
        )
        wait_for(lambda: said(*status, env=env).count(" node_") == 2)
        flags = f"--engine ray --ray.address {address}"
        survives(tmp_path, flags, env, lambda: kill_group(second))
