"""Run an experiment: rooms beside each other, finished ones are files and are not done again."""

from importlib.util import find_spec
from pathlib import Path

from mover.core.errors import InputError
from mover.core.observe import Observer, Step, silent
from mover_bench.experiment.args import ExperimentArgs
from mover_bench.experiment.job import is_finished
from mover_bench.experiment.pool import LOG, Pool, run_each
from mover_bench.experiment.sets import parse_seeds, set_named
from mover_bench.experiment.tables import read_finished, write_tables
from mover_bench.experiment.variants import names_in


def run_experiment(args: ExperimentArgs, observe: Observer = silent, pool: Pool = run_each) -> Path:
    """Do all that is not finished, then write the tables.

    Returns:
        The summary, OUT/SET/summary.md.

    Raises:
        InputError: If a seed, a variant or a set is none, or pandas is not installed.
    """
    if find_spec("pandas") is None:
        raise InputError("pandas is not installed; pip install '.[bench]' in mover's folder")
    seeds, names = parse_seeds(args.seeds), names_in(args.variants)
    set_named(args.set)
    open_seeds = [
        seed
        for seed in seeds
        if not all(is_finished(args.out, args.set, seed, n, keep=args.keep) for n in names)
    ]
    keep = "keep" if args.keep else "new"
    jobs = [
        ((args.set, str(seed), str(args.out), keep, *names), args.out / args.set / str(seed) / LOG)
        for seed in open_seeds
    ]
    ended = pool("mover_bench.experiment.job", jobs, args.workers)
    for done, index in enumerate(ended, len(seeds) - len(jobs)):
        observe(Step(f"{args.set} {open_seeds[index]}", done, len(seeds)))
    found = read_finished(args.out, args.set, seeds, names)
    return write_tables(args, names, found)
