"""The options that every program has which runs an experiment: where, how much, and what to do about failures."""

from __future__ import annotations

import argparse

from harness.engine.opening import DEFAULT_MEMORY_MB, DEFAULT_TIME_LIMIT_S, EngineOptions
from harness.engine.shard import WHOLE, Shard
from harness.engine.work import Limits
from harness.vocabulary.errors import UserError

DEFAULT_CACHE_GB = 20.0
LEAST_MEMORY_GB = 0.5
"""A process that has loaded what trials need holds 0.2 GB."""


def add_engine_options(parser: argparse.ArgumentParser) -> None:
    """Add them, in a group of their own."""
    add = parser.add_argument_group("how it is run").add_argument
    add("--jobs", type=whole_number, default=2, metavar="N", help="processes, or workers of a cluster (default: 2)")
    add("--serial", action="store_true", help="run everything in this process, for a debugger; without limits")
    add(
        "--scheduler",
        metavar="ADDRESS",
        help="run on a Dask cluster: tcp://host:8786, or jobqueue:slurm and the like as your Dask configuration has it",
    )
    add("--shard", metavar="K/N", help="run the k-th of n parts only, such as 3/10; python -m harness.merge joins them")
    add("--retry-failed", action="store_true", help="run again what failed, crashed or timed out before")
    add(
        "--time-limit",
        type=positive,
        default=DEFAULT_TIME_LIMIT_S,
        metavar="SECONDS",
        help=f"that one trial or render may take (default: {DEFAULT_TIME_LIMIT_S:g})",
    )
    add(
        "--memory-limit",
        type=positive,
        default=DEFAULT_MEMORY_MB / 1000,
        metavar="GB",
        help=f"that a trial's process may take (default: {DEFAULT_MEMORY_MB / 1000:g}); not on a cluster",
    )
    add(
        "--cache-limit",
        type=positive,
        default=DEFAULT_CACHE_GB,
        metavar="GB",
        help=f"of stored renders; the longest unused go first (default: {DEFAULT_CACHE_GB:g})",
    )


def engine_options(options: argparse.Namespace) -> EngineOptions:
    """What was asked for. Raises UserError where it makes no sense."""
    if options.serial and options.scheduler is not None:
        raise UserError("--serial and --scheduler: ask for different engines", fix="leave one of them out")
    if options.memory_limit < LEAST_MEMORY_GB:
        raise UserError(
            f"--memory-limit {options.memory_limit:g}: a process needs more than that to begin with",
            legal=f"{LEAST_MEMORY_GB:g} GB or more; 1 GB is enough for most trials",
        )
    return EngineOptions(
        jobs=options.jobs,
        limits=Limits(options.time_limit, round(1000 * options.memory_limit)),
        scheduler=options.scheduler,
        serial=options.serial,
        shard=WHOLE if options.shard is None else Shard.of(options.shard),
        retry_failed=options.retry_failed,
        cache_limit_gb=options.cache_limit,
    )


def whole_number(text: str) -> int:
    """For argparse: 1 to 4096."""
    if not text.isdigit() or not 1 <= int(text) <= 4096:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 1 to 4096")
    return int(text)


def positive(text: str) -> float:
    """For argparse: a number above 0."""
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < 1e9:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number above 0")
    return value
