"""What a cluster's workers run: a look at what they are, and bundles of jobs, one job at a time."""

from __future__ import annotations

import asyncio
import contextlib
import importlib.metadata
import os
import platform
import sys
import threading
import time
import traceback
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from harness.engine import setup
from harness.engine.processes import ONE_THREAD
from harness.engine.render_server import RenderServer
from harness.engine.work import TRACEBACK_CHARACTERS, Ended, Job, Limits, attempt
from harness.vocabulary.files import write_bytes
from harness.vocabulary.sources import source_digest

KEPT_VIEWS = 32
"""Of views that were sent, this many stay on the worker's disk, 4 MB each: as many set-ups as it keeps in memory."""
IDLE_S = 30.0
"""A process that renders takes 2 GB, and 6 s to start: so long it is kept while only trials come."""


@dataclass(frozen=True)
class Bundle:
    """Jobs of one stage for one worker. ``limits``: of each. ``shares_cache``: the worker sees the driver's cache."""

    jobs: tuple[Job, ...]
    limits: Limits
    shares_cache: bool


@dataclass(frozen=True)
class Carried:
    """How the first jobs of a bundle ended, in order; the rest was not begun, as ``is_hung``: a thread of the worker
    never ended. ``rendered``: files for the driver's cache, where the worker does not see it."""

    ended: tuple[Ended, ...]
    is_hung: bool = False
    rendered: dict[str, bytes] = field(default_factory=dict)


@dataclass(frozen=True)
class Worker:
    """What a worker says of itself. ``trials``, ``renders``: digests of code and packages, None where one is not
    installed; ``sees``: what stands in the file that it was asked for."""

    python: str
    trials: str | None
    renders: str | None
    threads: int
    offers_render: bool
    sees: str | None


_one_at_a_time = threading.Lock()
_hung = threading.Event()
_renderer: RenderServer | None = None
_pinned: Any = None
"""The limit of threads, which holds as long as the process."""


async def examine(probe: str | None, dask_worker: Any) -> Worker:
    """What this worker is; afterwards it is ready for trials, with all loaded that they need."""
    return await asyncio.to_thread(_examined, probe, dask_worker)


def _examined(probe: str | None, dask_worker: Any) -> Worker:
    global _pinned
    # read by libraries that are not loaded yet; those that are (dask loads numpy, and so does this module) are asked
    os.environ.update(dict.fromkeys(ONE_THREAD, "1"))
    import cv2
    from threadpoolctl import threadpool_limits

    import harness.engine.trial  # noqa: F401
    from harness.engine import plan
    from scenes.render import cache

    _pinned = threadpool_limits(1)
    cv2.setNumThreads(1)
    resources = dask_worker.state.total_resources
    return Worker(
        python=platform.python_version(),
        trials=_digest(plan.BUILT_IN_CODE, plan.PACKAGES),
        renders=_digest(cache.CODE, cache.PACKAGES),
        threads=dask_worker.state.nthreads,
        offers_render=resources.get("render", 0) > 0,
        sees=seen(probe),
    )


def seen(probe: str | None) -> str | None:
    """What stands in a file, None where it is not there."""
    with contextlib.suppress(OSError):
        return None if probe is None else Path(probe).read_text()
    return None


def leave() -> None:
    """End this worker's process and the thread that hangs in it; a nanny starts a new one."""
    os._exit(1)


def _digest(modules: tuple[str, ...], packages: tuple[str, ...]) -> str | None:
    """Taken once a process, when its modules are loaded: files that change later are not what it runs."""
    with contextlib.suppress(importlib.metadata.PackageNotFoundError):
        return source_digest(modules, packages)
    return None


def carry_out(bundle: Bundle, names: tuple[str, ...], *views: bytes) -> Carried:
    """Do jobs one after another. ``views``: contents of the stored views ``names``, where the cache is not seen."""
    from distributed import get_worker

    worker = get_worker()
    name = worker.address.rpartition("://")[2]
    with _one_at_a_time:
        own = Path(worker.local_directory) / "tofpod-views"
        _keep(own, dict(zip(names, views, strict=True)))
        setup.sent_views = own
        ended: list[Ended] = []
        rendered: dict[str, bytes] = {}
        for job in bundle.jobs:
            if _hung.is_set():
                break
            if job.stage == "renders":
                one, content = _rendered(job, bundle, own, name)
                rendered |= content
            else:
                _end_idle_renderer()
                one = _limited(job, bundle.limits, name)
            ended.append(one)
        return Carried(tuple(ended), _hung.is_set(), rendered)


def _keep(own: Path, views: dict[str, bytes]) -> None:
    """Store views that came, and let go of the oldest."""
    for name, content in views.items():
        path = own / Path(name).name
        if path.exists():
            path.touch()
        else:
            write_bytes(path, content)
    kept = sorted(own.glob("*.npz"), key=lambda path: path.stat().st_mtime, reverse=True)
    for path in kept[max(KEPT_VIEWS, len(views)) :]:
        path.unlink()


def _limited(job: Job, limits: Limits, name: str) -> Ended:
    """A trial in a thread that can be left alone; from then on the worker is of no use."""
    said: list[Ended] = []
    thread = threading.Thread(target=lambda: said.append(attempt(job, name)), daemon=True)
    began = time.monotonic()
    with _limited_memory(limits.memory_mb):
        thread.start()
        thread.join(limits.seconds)
    seconds = time.monotonic() - began
    if said:
        return said[0]
    if not thread.is_alive():
        return Ended("crashed", why="it asked its process to end (SystemExit)", seconds=seconds, worker=name)
    _hung.set()
    frame = sys._current_frames().get(thread.ident or 0)
    where = "".join(traceback.format_stack(frame))[-TRACEBACK_CHARACTERS:]
    why = f"not done after {seconds:.0f} s (--time-limit); it was at:\n{where}"
    return Ended("timed out", why=why, seconds=seconds, worker=name)


@contextlib.contextmanager
def _limited_memory(memory_mb: int | None) -> Iterator[None]:
    """Let allocations beyond so much private memory of this process fail (Linux); the nanny's own limit stays."""
    try:
        import resource

        before = resource.getrlimit(resource.RLIMIT_DATA)
        wanted = resource.RLIM_INFINITY if memory_mb is None else memory_mb * 1_000_000
        resource.setrlimit(resource.RLIMIT_DATA, (_lower(wanted, before[1]), before[1]))
    except (ImportError, ValueError, OSError):
        yield
        return
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, before)


def _lower(first: int, second: int) -> int:
    """Of two limits of the system, for which -1 is endless."""
    return min((limit for limit in (first, second) if limit >= 0), default=-1)


def _rendered(job: Job, bundle: Bundle, own: Path, name: str) -> tuple[Ended, dict[str, bytes]]:
    """A render in the process made for it. Its last argument is the cache's folder, its name the file's there."""
    from scenes.render.cache import read_view

    limit_s = bundle.limits.seconds
    if bundle.shares_cache:
        found = read_view(Path(job.arguments[-1]) / job.name)
        if found is not None:
            return Ended("done", (True, found.seconds), worker=name), {}
        return _server(name).ended(job, limit_s), {}
    ended = _server(name).ended(replace(job, arguments=(*job.arguments[:-1], str(own))), limit_s)
    path = own / job.name
    return ended, {job.name: path.read_bytes()} if ended.state == "done" else {}


def _server(name: str) -> RenderServer:
    global _renderer
    if _renderer is None:
        _renderer = RenderServer(name)
    return _renderer


def _end_idle_renderer() -> None:
    if _renderer is not None and _renderer.idle_s() > IDLE_S:
        _renderer.close()
