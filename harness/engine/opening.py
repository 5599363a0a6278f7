"""Which engine runs a sweep, by what the user asks for."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from harness.engine.shard import WHOLE, Shard
from harness.engine.work import Code, Engine, Limits, Stage

DEFAULT_TIME_LIMIT_S = 900.0
"""A trial takes seconds at most; a hang should not take a night."""
DEFAULT_MEMORY_MB = 4000
"""A trial takes some 300 MB, maps of many views up to 2 GB."""
DEFAULT_LIMITS = Limits(DEFAULT_TIME_LIMIT_S, DEFAULT_MEMORY_MB)


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


def engine_of(options: EngineOptions, detectors: Iterable[str] = ()) -> Engine:
    """The engine, not yet begun, for trials of these ``detectors``.

    Raises UserError where it is not installed or does not answer.
    """
    if options.scheduler is not None:
        from harness.engine.cluster import ClusterEngine

        return ClusterEngine(options.scheduler, options.limits, options.jobs)
    if options.serial:
        from harness.engine.serial import SerialEngine

        return SerialEngine()
    from harness.engine.plan import PACKAGES, trial_code
    from harness.engine.processes import LocalEngine
    from scenes.render import cache

    modules = {module for detector in detectors for module in trial_code(detector)}
    code: dict[Stage, Code] = {
        "trials": (tuple(sorted(modules)), PACKAGES),
        "renders": (cache.CODE, cache.PACKAGES),
    }
    return LocalEngine(options.jobs, options.limits, code)
