"""The options of all programs that run experiments: how many processes, where, and within which
limits."""

import argparse
from dataclasses import dataclass
from pathlib import Path

from harness.runs.jobs import Limits
from harness.runs.shards import WHOLE, Shard
from harness.vocabulary.errors import UserError
from harness.vocabulary.program import BYTES, bytes_of, whole_number

DEFAULT_LIMITS = Limits(
    seconds=900.0, memory_mb=4000
)  # a trial needs seconds and 300 MB; maps of many views need 2 GB
LEAST_MEMORY_GB = 0.5  # a process that has loaded the code of trials needs 0.2 GB


@dataclass(frozen=True)
class EngineOptions:
    """The engine of a run: where its jobs are done, and within which limits."""

    jobs: int = 2
    """Number of processes, or of a cluster's workers."""
    limits: Limits = DEFAULT_LIMITS
    """Time and memory that a process may take."""
    scheduler: str | None = None
    """Address of a cluster's scheduler; None for this machine."""
    serial: bool = False
    """Whether jobs are done in this process."""
    shard: Shard = WHOLE
    """The share of the jobs that this run does."""
    retry_failed: bool = False
    """Whether jobs that failed before are tried again."""
    cache_limit_gb: float | None = None
    """Size of all stored renders; None for no limit."""


def add_overrides(parser: argparse.ArgumentParser, example: str) -> None:
    """Add ``--set`` to a parser, as ``overrides``."""
    parser.add_argument(
        "--set",
        dest="overrides",
        metavar="KEY=VALUE",
        action="append",
        default=[],
        help=f"change a value of the file, such as {example}; may be repeated",
    )


def add_results_folder(parser: argparse.ArgumentParser) -> None:
    """Add ``--out``, the folder of results, to a parser."""
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("results"),
        metavar="DIR",
        help="folder of results (default: results)",
    )


def add_engine_options(parser: argparse.ArgumentParser) -> None:
    """Add these options to a parser, in their own group."""
    add = parser.add_argument_group("execution").add_argument
    processes = "processes, or workers of a cluster (default: 2)"
    add("--jobs", type=whole_number(4096), default=2, metavar="N", help=processes)
    add(
        "--serial",
        action="store_true",
        help="run everything in this process, for a debugger; without limits",
    )
    help = (
        "run on a Dask cluster: tcp://host:8786, or jobqueue:slurm and the like as your Dask "
        "configuration has it"
    )
    add("--scheduler", metavar="ADDRESS", help=help)
    add(
        "--shard", metavar="K/N", help="run part K of N only, such as 3/10; tofpod merge joins them"
    )
    add(
        "--retry-failed",
        action="store_true",
        help="run again the trials that failed, crashed or timed out before",
    )
    add(
        "--time-limit",
        type=_positive,
        default=900.0,
        metavar="SECONDS",
        help="time that one trial or render may take (default: 900)",
    )
    memory = "memory that a trial's process may use, also on a cluster (Linux; default: 4GB)"
    add("--memory-limit", type=_gigabytes, default=4.0, metavar="SIZE", help=memory)
    cache = "size of all stored renders; the least recently used are removed first (default: 20GB)"
    add("--cache-limit", type=_gigabytes, default=20.0, metavar="SIZE", help=cache)


def engine_options(options: argparse.Namespace) -> EngineOptions:
    """Return the options that were given. Raises UserError if they contradict each other."""
    if options.serial and options.scheduler is not None:
        raise UserError(
            "--serial and --scheduler: ask for different engines", fix="leave one of them out"
        )
    if options.memory_limit < LEAST_MEMORY_GB:
        legal = f"{LEAST_MEMORY_GB:g} GB or more; 1 GB is enough for most trials"
        message = (
            f"--memory-limit {options.memory_limit:g}: a process needs more than that to start"
        )
        raise UserError(message, legal=legal)
    limits = Limits(options.time_limit, round(1000 * options.memory_limit))
    shard = WHOLE if options.shard is None else Shard.of(options.shard)
    return EngineOptions(
        jobs=options.jobs,
        limits=limits,
        scheduler=options.scheduler,
        serial=options.serial,
        shard=shard,
        retry_failed=options.retry_failed,
        cache_limit_gb=options.cache_limit,
    )


def _gigabytes(text: str) -> float:
    size_gb = bytes_of(text) / BYTES["GB"]
    if size_gb == 0:
        raise argparse.ArgumentTypeError(f"{text!r} is not above 0")
    return size_gb


def _positive(text: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < 1e9:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number above 0")
    return value
