"""Run an experiment: rooms beside each other, finished ones are files and are not done again."""

import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from importlib.util import find_spec
from pathlib import Path
from threading import Event, Lock

from mover.core.errors import InputError
from mover.core.observe import Observer, Step, silent
from mover_bench.cli import ExperimentArgs
from mover_bench.experiment.job import is_finished
from mover_bench.experiment.sets import parse_seeds, set_named
from mover_bench.experiment.tables import LOG, read_finished, write_tables
from mover_bench.experiment.variants import names_in

Jobs = Sequence[tuple[Sequence[str], Path]]  #: the words of each, and the file of what it says
Pool = Callable[[str, Jobs, int], Iterator[int]]  #: `run_each`, or what does the same another way
THREADS = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")


def run_each(module: str, jobs: Jobs, workers: int) -> Iterator[int]:
    """Run `python -m MODULE WORDS` for each job; yield its index when it has ended.

    So many `workers` run at once; 0: as many as there are cores.
    """
    running: list[subprocess.Popen[bytes]] = []
    lock, stopped = Lock(), Event()

    def work(index: int) -> int:
        words, log = jobs[index]
        log.parent.mkdir(parents=True, exist_ok=True)
        with log.open("w") as file:
            command = [sys.executable, "-m", module, *words]
            with lock:
                if stopped.is_set():
                    return index
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
            with lock:
                stopped.set()
                for job in running:
                    job.terminate()


def run_experiment(args: ExperimentArgs, observe: Observer = silent, pool: Pool = run_each) -> Path:
    """Do all that is not finished, then write the tables; the summary, OUT/SET/summary.md.

    Raises:
        InputError: If a seed, a variant or a set is none, or pandas is not installed.
    """
    if find_spec("pandas") is None:
        raise InputError("pandas is not installed; pip install -e '.[bench]' in mover's folder")
    seeds, names = parse_seeds(args.seeds), names_in(args.variants)
    set_named(args.set)
    open_seeds = [
        seed for seed in seeds if not all(is_finished(args.out, args.set, seed, n) for n in names)
    ]
    jobs = [
        ((args.set, str(seed), str(args.out), *names), args.out / args.set / str(seed) / LOG)
        for seed in open_seeds
    ]
    ended = pool("mover_bench.experiment.job", jobs, args.workers)
    for done, index in enumerate(ended, len(seeds) - len(jobs)):
        observe(Step(f"{args.set} {open_seeds[index]}", done, len(seeds)))
    found = read_finished(args.out, args.set, seeds, names)
    return write_tables(args, names, found)
