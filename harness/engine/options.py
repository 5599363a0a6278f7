"""The options of every program that runs an experiment, and the engine that they ask for."""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from dataclasses import dataclass

from harness.engine.shard import WHOLE, Shard
from harness.engine.work import Code, JobEngine, Limits, Stage
from harness.vocabulary.errors import UserError

DEFAULT_TIME_LIMIT_S = 900.0
"""A trial takes seconds at most; a hang should not take a night."""
DEFAULT_MEMORY_MB = 4000
"""A trial takes some 300 MB, maps of many views up to 2 GB."""
DEFAULT_LIMITS = Limits(DEFAULT_TIME_LIMIT_S, DEFAULT_MEMORY_MB)
DEFAULT_CACHE_GB = 20.0
LEAST_MEMORY_GB = 0.5
"""A process that has loaded what trials need holds 0.2 GB."""


@dataclass(frozen=True)
class EngineOptions:
    """``jobs``: processes, or workers that a cluster is asked for. ``scheduler``: address of one, or jobqueue:slurm and
    the like; None: this machine. ``serial``: in this process."""

    jobs: int = 2
    limits: Limits = DEFAULT_LIMITS
    scheduler: str | None = None
    serial: bool = False
    shard: Shard = WHOLE
    retry_failed: bool = False
    cache_limit_gb: float | None = None


def engine_of(options: EngineOptions, detectors: Iterable[str] = ()) -> JobEngine:
    """The engine, not yet begun, for trials of these ``detectors``.

    Raises UserError where it is not installed or does not answer.
    """
    from harness.engine.processes import LocalEngine, SerialEngine

    if options.serial:
        return SerialEngine()
    code = code_of(detectors)
    if options.scheduler is not None:
        from harness.engine.cluster import ClusterEngine

        return ClusterEngine(options.scheduler, options.limits, options.jobs, code)
    return LocalEngine(options.jobs, options.limits, code)


def code_of(detectors: Iterable[str]) -> dict[Stage, Code]:
    """The code that decides the numbers of each stage, for trials of these ``detectors``."""
    from harness.engine.plan import PACKAGES, trial_code
    from scenes.render import cache

    modules = {module for detector in detectors for module in trial_code(detector)}
    return {"trials": (tuple(sorted(modules)), PACKAGES), "renders": (cache.CODE, cache.PACKAGES)}


def add_engine_options(parser: argparse.ArgumentParser) -> None:
    """Add them, in a group of their own."""
    add = parser.add_argument_group("how it is run").add_argument
    add("--jobs", type=_whole_number, default=2, metavar="N", help="processes, or workers of a cluster (default: 2)")
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
        type=_positive,
        default=DEFAULT_TIME_LIMIT_S,
        metavar="SECONDS",
        help=f"that one trial or render may take (default: {DEFAULT_TIME_LIMIT_S:g})",
    )
    add(
        "--memory-limit",
        type=_positive,
        default=DEFAULT_MEMORY_MB / 1000,
        metavar="GB",
        help=f"that a trial's process may take, on a cluster too (default: {DEFAULT_MEMORY_MB / 1000:g})",
    )
    add(
        "--cache-limit",
        type=_positive,
        default=DEFAULT_CACHE_GB,
        metavar="GB",
        help=f"of stored renders; the longest unused go first (default: {DEFAULT_CACHE_GB:g})",
    )


def engine_options(options: argparse.Namespace) -> EngineOptions:
    """Return the options that were given. Raises UserError where they make no sense."""
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


def _whole_number(text: str) -> int:
    """Parse a whole number from 1 to 4096, for argparse."""
    if not text.isdigit() or not 1 <= int(text) <= 4096:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number from 1 to 4096")
    return int(text)


def _positive(text: str) -> float:
    """Parse a number above 0, for argparse."""
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < 1e9:
        raise argparse.ArgumentTypeError(f"{text!r} is not a number above 0")
    return value
