"""The functions that a cluster's driver calls in a dask worker: the worker is a node that runs the local engine inside.

The dask worker itself loads neither NumPy's users nor Mitsuba and never computes, so that it always answers.
"""

from __future__ import annotations

import asyncio
import atexit
import contextlib
import importlib.metadata
import platform
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from harness.engine.processes import Answers, LocalEngine
from harness.engine.work import Code, Ended, Job, Limits, Stage
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import write_bytes
from harness.vocabulary.sources import source_digest

KEPT_VIEWS = 32
"""Views that were sent and stay on a node's disk, 4 MB each; beside those of bundles under way."""


@dataclass(frozen=True)
class Bundle:
    """Jobs of one stage for one node. ``limits``: of each. ``shares``: the node sees the driver's cache of renders;
    otherwise ``needs`` are the names of the views that the jobs read, and ``views`` the contents of some of them."""

    jobs: tuple[Job, ...]
    limits: Limits
    shares: bool
    needs: tuple[str, ...] = ()
    views: dict[str, bytes] = field(default_factory=dict)


@dataclass(frozen=True)
class Carried:
    """The ends of a bundle's jobs, in their order. ``rendered``: files for the driver's cache, where the node does
    not see it. ``missing``: views that are not here and were not sent; then no job was begun."""

    ended: tuple[Ended, ...] = ()
    rendered: dict[str, bytes] = field(default_factory=dict)
    missing: tuple[str, ...] = ()


@dataclass(frozen=True)
class NodeFacts:
    """A node's description of itself. ``digests``: of code and packages by stage, without those that are not
    installed; ``processes``: how many jobs it does at once; ``sees``: the content of the file that it was asked for."""

    python: str
    digests: Mapping[Stage, str]
    processes: int
    offers_render: bool
    sees: str | None


_engines: dict[str, LocalEngine] = {}
"""Engines by the code that they run: one, but for drivers of unlike experiments."""
_awaited: dict[str, set[Answers]] = {}
"""Answers that each driver waits for."""
_users: dict[str, int] = {}
"""Number of bundles under way that need each view that was sent."""


def examine(code: Mapping[Stage, Code], probe: str | None, dask_worker: Any) -> NodeFacts:
    """Describe this node. Digests are taken once a process: files that change later are not what it runs."""
    digests: dict[Stage, str] = {}
    for stage, which in code.items():
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            digests[stage] = source_digest(*which)
    return NodeFacts(
        python=platform.python_version(),
        digests=digests,
        processes=dask_worker.state.nthreads,
        offers_render=dask_worker.state.total_resources.get("render", 0) > 0,
        sees=seen(probe),
    )


def seen(probe: str | None) -> str | None:
    """The content of a file; None where it is not there."""
    with contextlib.suppress(OSError):
        return None if probe is None else Path(probe).read_text()
    return None


def drop(driver: str) -> None:
    """End all jobs of a driver, which waits for them no longer."""
    for answers in _awaited.pop(driver, ()):
        for engine in _engines.values():
            engine.drop(answers)


async def carry_out(bundle: Bundle, code: Mapping[Stage, Code], driver: str, dask_worker: Any) -> Carried:
    """Do the jobs of a bundle. Raises UserError where the node's processes run other code or cannot start."""
    own = Path(dask_worker.local_directory) / "tofpod-views"
    name = dask_worker.address.rpartition("://")[2]
    engine = _engine(code, dask_worker.state.nthreads, own)
    missing = _keep(own, bundle)
    if missing:
        return Carried(missing=missing)
    answers = Answers()
    _awaited.setdefault(driver, set()).add(answers)
    for one in bundle.needs:
        _users[one] = _users.get(one, 0) + 1
    try:
        return await asyncio.to_thread(_carried, bundle, engine, answers, own, name)
    finally:
        _awaited.get(driver, set()).discard(answers)
        for one in bundle.needs:
            _users[one] -= 1


def _engine(code: Mapping[Stage, Code], processes: int, own: Path) -> LocalEngine:
    key = repr(sorted(code.items()))
    if key not in _engines:
        _engines[key] = LocalEngine(processes, Limits(), code, sent_views=own)
        _engines[key].__enter__()
        atexit.register(_engines[key].__exit__)
    return _engines[key]


def _carried(bundle: Bundle, engine: LocalEngine, answers: Answers, own: Path, name: str) -> Carried:
    ended: dict[str, Ended] = {}
    for job in bundle.jobs:
        if job.stage == "renders" and not bundle.shares:
            engine.put(replace(job, arguments=(*job.arguments[:-1], str(own))), bundle.limits, answers)
        else:
            engine.put(job, bundle.limits, answers)
    while len(ended) < len(bundle.jobs) and not answers.is_dropped:
        said = answers.ended.get()
        if isinstance(said, UserError):
            engine.drop(answers)
            raise said
        ended[said[0].name] = replace(said[1], worker=name)
    rendered: dict[str, bytes] = {}
    if bundle.jobs[0].stage == "renders" and not bundle.shares:
        there = [job.name for job in bundle.jobs if job.name in ended and ended[job.name].state == "done"]
        rendered = {one: (own / one).read_bytes() for one in there}
    return Carried(tuple(ended[job.name] for job in bundle.jobs if job.name in ended), rendered)


def _keep(own: Path, bundle: Bundle) -> tuple[str, ...]:
    """Store views that came, let go of the oldest, and return the names of those that are not here."""
    for name in bundle.needs:
        path = own / Path(name).name
        if path.exists():
            path.touch()
        elif name in bundle.views:
            write_bytes(path, bundle.views[name], durable=False)
    kept = sorted(own.glob("*.npz"), key=lambda path: path.stat().st_mtime, reverse=True)
    for path in kept[2 * KEPT_VIEWS :]:
        if path.name not in bundle.needs and not _users.get(path.name):
            path.unlink()
    return tuple(name for name in bundle.needs if not (own / Path(name).name).exists())
