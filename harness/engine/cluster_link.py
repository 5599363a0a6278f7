"""The connection to a dask scheduler: events come in through one queue, bundles go out to a worker by name."""

from __future__ import annotations

import asyncio
import contextlib
import importlib
import logging
import queue
import re
import sys
import threading
import warnings
from collections import OrderedDict
from collections.abc import Callable, Coroutine, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from harness.engine import cluster_worker
from harness.engine.cluster_worker import Bundle, Carried, Worker
from harness.engine.work import Job
from harness.vocabulary.errors import UserError

ANSWERS_S = 5
"""A scheduler that is there answers a connection in milliseconds."""
CLOSES_S = 1.0
ENDS_S = 10.0
"""What a nanny gives a worker to end by itself before it is killed."""
HELD_VIEWS = 32
"""Contents of stored views kept on the cluster for the next trials, beside those of bundles under way."""
KINDS = {
    "slurm": "SLURMCluster",
    "pbs": "PBSCluster",
    "lsf": "LSFCluster",
    "sge": "SGECluster",
    "htcondor": "HTCondorCluster",
    "oar": "OARCluster",
    "moab": "MoabCluster",
    "local": "LocalCluster",
}
"""Classes of dask-jobqueue, each in a module of the kind's name; "local" starts its jobs on this machine."""
LEGAL = "tcp://host:8786, tls://host:8786, or jobqueue: followed by one of " + ", ".join(KINDS)


@dataclass(frozen=True)
class Joined:
    """A worker is there; what it says of itself, or why it cannot."""

    address: str
    said: Worker | BaseException


@dataclass(frozen=True)
class Left:
    """A worker is gone. ``memory_mb``: what it took where its nanny ended it for that."""

    address: str
    memory_mb: float | None


@dataclass(eq=False)
class Parcel:
    """A bundle with a worker. ``is_void``: nobody waits for its answer any more."""

    jobs: tuple[Job, ...]
    address: str
    future: Any = None
    views: tuple[Any, ...] = ()
    is_void: bool = False


@dataclass(frozen=True)
class Answer:
    """What came of a parcel."""

    parcel: Parcel
    said: Carried | BaseException


Event = Joined | Left | Answer


@dataclass
class Link:
    """One connection. ``events`` is filled by dask's own thread; everything else is called by one other thread.

    A bundle is submitted for one worker by its address. dask would choose as well, but how many it sends to a worker
    that is busy hangs on settings of the scheduler (``worker-saturation``, ``allowed-failures``) and on what it takes
    for a root task; a worker that dies is then blamed on jobs that it never began.
    """

    client: Any
    cluster: Any = None
    events: queue.SimpleQueue[Event] = field(default_factory=queue.SimpleQueue)
    _views: OrderedDict[Path, Any] = field(default_factory=OrderedDict)
    _memory_mb: dict[str, float] = field(default_factory=dict)
    _sent: int = 0
    _known: set[str] = field(default_factory=set)
    """Addresses of workers that are there, looked at or about to be."""

    @property
    def is_alive(self) -> bool:
        """Whether the scheduler is there. One that was away has forgotten its jobs."""
        return bool(self.client.status == "running")

    @property
    def addresses(self) -> frozenset[str]:
        """Of the workers that are there."""
        return frozenset(self._known)

    def watch(self, probe: Callable[[], str | None]) -> None:
        """Tell of all workers, those that are there and those to come. ``probe``: the file they are to look for."""

        def look_at(address: str) -> None:
            if address not in self._known:
                self._known.add(address)
                self._later(self._look_at(address, probe))

        def heard(event: tuple[float, Any]) -> None:
            said = event[1]
            if not isinstance(said, dict):
                return
            if said.get("action") == "add-worker":
                look_at(said["worker"])
            elif said.get("action") == "remove-worker":
                self._known.discard(said["worker"])
                self.events.put(Left(said["worker"], self._memory_mb.pop(said["worker"], None)))

        def too_big(event: tuple[float, Any]) -> None:
            self._memory_mb[event[1]["worker"]] = event[1]["rss"] / 1e6

        self.client.subscribe_topic("worker-restart-memory", too_big)
        self.client.subscribe_topic("all", heard)
        for address in self.client.scheduler_info(n_workers=-1)["workers"]:
            self.client.loop.add_callback(look_at, address)

    async def _look_at(self, address: str, probe: Callable[[], str | None]) -> None:
        said: Any = None
        for pause_s in (0.0, 0.2, 1.0, 3.0):
            # the scheduler tells of a worker shortly before it knows the way to it
            await asyncio.sleep(pause_s)
            try:
                answers = await self._run(cluster_worker.examine, probe(), address=address)
                said = answers.get(address)
            except Exception as error:
                said = error
            if isinstance(said, Worker | ImportError | AttributeError) or address not in self._known:
                break
        if address not in self._known:
            return  # that it left is told already
        self.events.put(Joined(address, said if said is not None else OSError("no answer")))

    def sees(self, addresses: Iterable[str], probe: str) -> dict[str, str | None]:
        """What stands in a file, as each worker sees it; a worker that does not answer sees nothing."""
        return dict(self.client.run(cluster_worker.seen, probe, workers=list(addresses), on_error="ignore"))

    def send(self, parcel: Parcel, bundle: Bundle, needs: Iterable[Path]) -> None:
        """Hand a bundle to its worker, with the stored views that it ``needs`` sent."""
        held = {path.name: future for path in needs if (future := self._held(path)) is not None}
        self._sent += 1
        parcel.views = tuple(held.values())
        parcel.future = self.client.submit(
            cluster_worker.carry_out,
            bundle,
            tuple(held),
            *parcel.views,
            key=f"tofpod-{self.client.id}-{self._sent}",
            workers=[parcel.address],
            allow_other_workers=False,
            retries=0,
            pure=False,
        )
        self._later(self._answered(parcel))

    async def _answered(self, parcel: Parcel) -> None:
        said: Any
        try:
            said = await self.client.gather(parcel.future, asynchronous=True)
        except (Exception, asyncio.CancelledError) as error:
            said = error
        if not parcel.is_void:
            self.events.put(Answer(parcel, said))

    def void(self, parcel: Parcel) -> None:
        """Wait for this parcel no longer."""
        parcel.is_void = True
        if parcel.future is not None:
            parcel.future.cancel()

    def forget(self, parcel: Parcel) -> None:
        """Send a parcel's views anew when they are needed again: a worker that held them may have died."""
        for path, future in list(self._views.items()):
            if future in parcel.views:
                del self._views[path]

    def _held(self, path: Path) -> Any:
        """A view's file on the cluster; None where it cannot be read here, which the trial itself will tell."""
        if path not in self._views:
            try:
                content = path.read_bytes()
            except OSError:
                return None
            self._views[path] = self.client.scatter(content, hash=False)
        self._views.move_to_end(path)
        while len(self._views) > HELD_VIEWS:
            self._views.popitem(last=False)
        return self._views.get(path)

    def dismiss(self, address: str) -> None:
        """Have a worker end its process."""
        self._later(self._quietly(self._run(cluster_worker.leave, address=address)))

    def kill(self, address: str) -> None:
        """Have its nanny end a worker that no longer answers; without a nanny nothing can."""

        def restart() -> None:
            with contextlib.suppress(Exception):
                self.client.restart_workers([address], timeout=ENDS_S, raise_for_error=False)

        threading.Thread(target=restart, daemon=True).start()

    def close(self) -> None:
        """Drop what is under way and go; a cluster that was given stays."""
        with contextlib.suppress(Exception):
            self.client.close(timeout=CLOSES_S)
        if self.cluster is not None:
            with contextlib.suppress(Exception):
                self.cluster.close(timeout=CLOSES_S)

    async def _run(self, function: Callable[..., Any], *arguments: Any, address: str) -> dict[str, Any]:
        said = self.client.run(function, *arguments, workers=[address], on_error="return", asynchronous=True)
        return dict(await said)

    async def _quietly(self, doing: Coroutine[Any, Any, Any]) -> None:
        with contextlib.suppress(Exception):
            await doing

    def _later(self, doing: Coroutine[Any, Any, Any]) -> None:
        asyncio.run_coroutine_threadsafe(doing, self.client.loop.asyncio_loop)


@contextlib.contextmanager
def linked(scheduler: str, workers_wanted: int) -> Iterator[Link]:
    """Connect to a scheduler by its address, or start the user's own dask-jobqueue cluster.

    Raises UserError where it is none of both, not installed, not configured, or does not answer.
    """
    is_address = re.fullmatch(r"(tcp|tls)://.+:\d+", scheduler) is not None
    kind = scheduler.removeprefix("jobqueue:")
    if not is_address and (kind == scheduler or kind not in KINDS):
        raise UserError(f"--scheduler {scheduler}: is neither an address nor a kind of job queue", legal=LEGAL)
    try:
        import dask
        from distributed import Client
    except ImportError as error:
        raise UserError("--scheduler needs dask.distributed", fix='pip install "tofpod[cluster]"') from error
    with contextlib.ExitStack() as stack:
        stack.enter_context(dask.config.set({"distributed.comm.timeouts.connect": f"{ANSWERS_S}s"}))
        stack.enter_context(_quiet())
        cluster = None if is_address else _cluster_of(kind, workers_wanted)
        try:
            client = Client(cluster or scheduler, timeout=ANSWERS_S, set_as_default=False)
        except (OSError, ValueError) as error:
            if cluster is not None:
                cluster.close(timeout=CLOSES_S)
            raise UserError(
                f"the scheduler at {scheduler} does not answer within {ANSWERS_S} s: {error}",
                fix="start one with `dask scheduler`, and workers with `dask worker`; docs/scale.md says how",
            ) from error
        link = Link(client, cluster)
        stack.callback(link.close)
        yield link


def _cluster_of(kind: str, workers_wanted: int) -> Any:
    """A cluster of dask-jobqueue as the user's own configuration of dask says, asked for so many jobs."""
    try:
        module = importlib.import_module(f"dask_jobqueue.{kind}")
    except ImportError as error:
        raise UserError("jobqueue: needs dask-jobqueue", fix='pip install "tofpod[cluster]"') from error
    try:
        cluster = getattr(module, KINDS[kind])()
        cluster.scale(jobs=workers_wanted)
    except (ValueError, TypeError, OSError, RuntimeError) as error:
        raise UserError(
            f"dask-jobqueue could not start a cluster of kind {kind}: {error}",
            fix=f"describe it in ~/.config/dask/jobqueue.yaml under jobqueue.{kind}: cores: 1, processes: 1, memory",
        ) from error
    return cluster


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """What dask logs of workers that come and go is told by how jobs end; its warnings on versions are checked here."""
    import distributed  # noqa: F401 (sets the levels when it is imported)

    names = [name for name in logging.root.manager.loggerDict if name.split(".")[0] in ("distributed", "tornado")]
    levels = {name: logging.getLogger(name).level for name in names}
    for name in names:
        logging.getLogger(name).setLevel(logging.CRITICAL + 1)
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            yield
    finally:
        for name, level in levels.items():
            logging.getLogger(name).setLevel(level)


def tell(message: str) -> None:
    """One line to the user, beside the progress."""
    print(message, file=sys.stderr, flush=True)


def bare(address: str) -> str:
    """host:port."""
    return address.rpartition("://")[2]
