"""Chooses the engine that runs the jobs of a run: this process, processes of this machine, or a
cluster.

Engines are named here and imported when they are chosen, so that only a run on a cluster imports
Dask."""

from collections.abc import Iterable, Sequence
from importlib import import_module
from pathlib import Path

from harness.runs.jobs import Code, JobEngine, Stage
from harness.runs.options import EngineOptions

CLUSTER = "harness.programs.cluster.engine:ClusterEngine"
"""The engine behind ``--scheduler``, as module:class. It is named and not imported, because it has
a room of its own."""


def engine_of(
    options: EngineOptions,
    detectors: Iterable[str] = (),
    folder: Path = Path(),
    *,
    renders: bool = True,
    further: Sequence[str] = (),
) -> JobEngine:
    """Return the engine, not yet started, for trials of ``detectors``. ``folder``: of renders;
    ``renders``: whether any are to be expected; ``further``: modules that other jobs need. Raises
    UserError."""
    from harness.runs.processes import LocalEngine, SerialEngine

    if options.serial:
        return SerialEngine()
    if options.scheduler is None:
        code = code_of(detectors)
        return LocalEngine(options.jobs, options.limits, code, renders=renders, further=further)
    module_name, _, class_name = CLUSTER.partition(":")
    cluster_engine = getattr(import_module(module_name), class_name)
    engine: JobEngine = cluster_engine(
        options.scheduler, options.limits, options.jobs, code_of(detectors), folder
    )
    return engine


def code_of(detectors: Iterable[str]) -> dict[Stage, Code]:
    """Return the code that determines the results of each stage, for trials of these
    ``detectors``."""
    from harness.runs.plan import PACKAGES, trial_code
    from scenes.render import cache

    modules = {module for detector in detectors for module in trial_code(detector)}
    return {"trials": (tuple(sorted(modules)), PACKAGES), "renders": (cache.CODE, cache.PACKAGES)}
