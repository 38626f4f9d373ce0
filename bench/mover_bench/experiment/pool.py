"""Processes beside each other, one thread each, so that numbers depend on nothing else."""

import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from pathlib import Path

from mover.core.errors import InputError

LOG = "log.txt"
Jobs = Sequence[tuple[Sequence[str], Path]]
"""The words of each, and the file of what it says."""
Pool = Callable[[str, Jobs, int], Iterator[int]]
"""`run_each`, or what does the same another way."""
THREADS = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


def run_each(module: str, jobs: Jobs, workers: int) -> Iterator[int]:
    """Run `python -m MODULE WORDS` for each job; yield its index when it has ended.

    Args:
        module: Where `main` is.
        jobs: What is done.
        workers: How many run at once; 0: as many as there are cores.

    Raises:
        InputError: If the number of workers is negative.
    """
    if workers < 0:
        raise InputError(f"--workers: {workers}, expected 0 or more")

    running: list[subprocess.Popen[bytes]] = []

    def work(index: int) -> int:
        words, log = jobs[index]
        log.parent.mkdir(parents=True, exist_ok=True)
        with log.open("w") as file:
            command = [sys.executable, "-m", module, *words]
            job = subprocess.Popen(command, stdout=file, stderr=file, env=os.environ | THREADS)
            running.append(job)
            job.wait()
        return index

    with ThreadPoolExecutor(workers or os.cpu_count() or 1) as pool:
        futures = [pool.submit(work, index) for index in range(len(jobs))]
        try:
            for future in as_completed(futures):
                yield future.result()
        finally:  # where the user stops, what waits is not started and what runs is ended
            pool.shutdown(wait=False, cancel_futures=True)
            for job in running:
                job.terminate()


def last_line(log: Path) -> str:
    """What a process said last."""
    lines = log.read_text(errors="replace").split("\n") if log.is_file() else []
    return next((line.strip() for line in reversed(lines) if line.strip()), "it said nothing")
