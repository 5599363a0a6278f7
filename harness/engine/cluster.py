"""Jobs on a cluster by way of dask.distributed: each dask worker is a node that runs the local engine inside.

A node's processes do the jobs, enforce their limits and survive their deaths, as on this machine. The driver calls the
nodes through the scheduler, with bundles of jobs, two at a time for each: dask neither queues nor retries them. When a
node dies, its jobs go to others; a job that was aboard of `TRIES` nodes as they died counts as crashed.
"""

from __future__ import annotations

import asyncio
import contextlib
import importlib
import logging
import platform
import queue
import re
import secrets
import sys
import time
import warnings
from collections import Counter, OrderedDict, deque
from collections.abc import Coroutine, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from harness.engine import node
from harness.engine.node import Bundle, Carried, NodeFacts
from harness.engine.processes import MOST_RENDERERS
from harness.engine.work import Code, Ended, Job, Limits, Stage
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import write_bytes, write_text
from harness.vocabulary.sources import source_digest

BUNDLE_S = 0.25
"""Work in a bundle, for each process of a node: calling a node takes some 10 ms, of it 2 ms of the driver's time."""
MOST_IN_BUNDLE = 32
"""Jobs in a bundle, for each process of a node."""
WITH_NODE = 2
"""Bundles at a node: its processes work on one while the other waits."""
LOOKS_S = 1.0
"""Interval at which the driver looks which nodes are there."""
WAIT_FOR_NODES_S = 60.0
"""Wait for workers that are started by hand. A batch system's queue may take hours: a line is printed now and then."""
TELL_AGAIN_S = 300.0
TRIES = 5
ANSWERS_S = 5
"""A scheduler that is there answers a connection in milliseconds."""
EXAMINED_S = 60.0
"""Time for a node to say what it is: it reads the sources, from a network's disk perhaps."""
CLOSES_S = 1.0
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


@dataclass
class _Node:
    """A node that takes jobs. ``shares``: it sees the driver's cache of renders; otherwise ``holds`` names the views
    that were sent to it, the last ones last."""

    address: str
    processes: int
    can_render: bool
    offers_render: bool
    shares: bool
    bundles: dict[int, Bundle] = field(default_factory=dict)
    """Bundles under way, by number."""
    renders: int = 0
    """Number of renders under way."""
    holds: OrderedDict[str, None] = field(default_factory=OrderedDict)


class ClusterEngine:
    """Jobs on the workers of ``scheduler``: tcp://host:8786, or jobqueue:slurm and the like, asked for
    ``workers_wanted``. ``limits`` are a trial's; renders have its limit of time only. ``code``: as `LocalEngine`."""

    def __init__(self, scheduler: str, limits: Limits, workers_wanted: int, code: Mapping[Stage, Code]) -> None:
        self._scheduler, self._limits, self._wanted = scheduler, limits, workers_wanted
        self._code = dict(code)
        self._digests = {stage: source_digest(*which) for stage, which in self._code.items()}
        self._client: Any = None
        self._nodes: dict[str, _Node] = {}
        self._refused: dict[str, UserError] = {}
        """Nodes that would give other numbers than this machine, by address: left out while others are there."""
        self._asked: set[str] = set()
        """Addresses of nodes that were asked what they are."""
        self._waiting: dict[Stage, deque[Job]] = {"renders": deque(), "trials": deque()}
        self._done: list[tuple[Job, Ended]] = []
        self._out: Counter[Stage] = Counter()
        self._tries: Counter[str] = Counter()
        self._events: queue.SimpleQueue[tuple[str, int | None, Any]] = queue.SimpleQueue()
        """(address, number of the bundle, answer) of a node; without a number the answer is what the node is."""
        self._number = 0
        self._mean_s = BUNDLE_S
        """Mean duration of a trial; at first as if each were worth a bundle of its own."""
        self._looked = float("-inf")
        self._lacking = ""
        """Nodes that could do what waits, lacking since then; told last at ``_lack_told``."""
        self._lacking_since = self._lack_told = time.monotonic()
        self._probe: Path | None = None
        self._nonce = secrets.token_hex(16)
        """Names this driver to the nodes."""
        self._told: set[str] = set()
        self._stack = contextlib.ExitStack()

    def __enter__(self) -> ClusterEngine:
        with contextlib.ExitStack() as stack:
            self._client = stack.enter_context(_connected(self._scheduler, self._wanted))
            while not self._nodes:
                self._step()
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *error: object) -> None:
        if self._probe is not None:
            with contextlib.suppress(OSError):
                self._probe.unlink(missing_ok=True)
        busy = [one.address for one in self._nodes.values() if one.bundles]
        if busy and self._is_connected():
            with contextlib.suppress(Exception):  # a node that cannot be told ends its bundles at its own time
                dropped = self._client.run(node.drop, self._nonce, workers=busy, on_error="ignore", asynchronous=True)
                asyncio.run_coroutine_threadsafe(_awaited(dropped), self._loop).result(CLOSES_S)
        self._stack.close()

    @property
    def worker_count(self) -> int:
        """The processes of all nodes that take jobs."""
        self._step(0.0)
        return sum(one.processes for one in self._nodes.values())

    def room(self, stage: Stage) -> int:
        """Room for as much as keeps all nodes busy, and the next bundles ready."""
        each = 1 if stage == "renders" else WITH_NODE * self._bundle_size() + 1
        return max(1, each * sum(one.processes for one in self._nodes.values())) + 1 - self._out[stage]

    def submit(self, job: Job) -> None:
        """Take a job."""
        folder = Path(job.arguments[-1]) if job.stage == "renders" else next((path.parent for path in job.needs), None)
        if folder is not None and self._probe is None:
            self._place_probe(folder)
        self._out[job.stage] += 1
        self._waiting[job.stage].append(job)

    def ended(self) -> list[tuple[Job, Ended]]:
        """Wait for jobs to end. Raises UserError where the scheduler is gone, or for long no node is left that could
        do what waits."""
        while not self._done:
            self._hand_out()
            if not self._done:
                self._step()
        self._hand_out()
        done, self._done = self._done, []
        return done

    # ---------------------------------------------------------------- what goes out

    def _bundle_size(self) -> int:
        """Trials in a bundle, for each process of a node."""
        return max(1, min(MOST_IN_BUNDLE, round(BUNDLE_S / max(self._mean_s, 1e-4))))

    def _hand_out(self) -> None:
        """Send every node first a bundle of trials, then a second one, and renders where it may render."""
        renders, trials = self._waiting["renders"], self._waiting["trials"]
        some_offer = any(one.offers_render and one.can_render for one in self._nodes.values())
        for most in range(WITH_NODE):
            for to in list(self._nodes.values()):
                may_render = to.can_render and (to.offers_render or not some_offer)
                # a node of one process does one thing at a time: trials first, as renders make more of them, but
                # where nodes are set aside for renders, these first there
                may_render &= to.processes > 1 or not (to.bundles or (trials and not to.offers_render))
                if renders and may_render and to.renders < min(MOST_RENDERERS, to.processes):
                    job = renders.popleft()
                    if to.shares or not self._is_in_cache(job):
                        self._send(to, [job])
                elif trials and len(to.bundles) - to.renders <= most and not (to.processes == 1 and to.renders):
                    share = -(-len(trials) // (WITH_NODE * len(self._nodes)))
                    count = min(self._bundle_size() * to.processes, max(share, to.processes), len(trials))
                    self._send(to, [trials.popleft() for _ in range(count)])

    def _is_in_cache(self, job: Job) -> bool:
        """Return whether this machine's cache holds a render that a node cannot see; then the job is done."""
        from scenes.render.cache import read_view

        found = read_view(Path(job.arguments[-1]) / job.name)
        if found is not None:
            self._over(job, Ended("done", (True, found.seconds), worker="this process"))
        return found is not None

    def _send(self, to: _Node, jobs: list[Job]) -> None:
        self._number += 1
        number = self._number
        needs: list[str] = []
        views: dict[str, bytes] = {}
        for path in () if to.shares else dict.fromkeys(path for job in jobs for path in job.needs):
            if path.name not in to.holds:
                try:
                    views[path.name] = path.read_bytes()
                except OSError:
                    continue  # the trial itself tells that the view cannot be read
            needs.append(path.name)
            to.holds[path.name] = None
            to.holds.move_to_end(path.name)
        while len(to.holds) > node.KEPT_VIEWS:
            to.holds.popitem(last=False)
        bundle = Bundle(tuple(jobs), self._limits, to.shares, tuple(needs), views)
        to.bundles[number] = bundle
        to.renders += jobs[0].stage == "renders"
        self._call(to.address, number, node.carry_out, bundle, self._code, self._nonce)

    def _call(self, address: str, number: int | None, function: Any, *arguments: Any) -> None:
        """Have a node run a function; what it returns or raises becomes an event."""

        async def call() -> None:
            said: Any = None
            # the scheduler tells of a worker shortly before it knows the way to it
            for pause_s in (0.0,) if number is not None else (0.0, 0.2, 1.0, 3.0):
                await asyncio.sleep(pause_s)
                try:
                    calling = self._client.run(
                        function, *arguments, workers=[address], on_error="return", asynchronous=True
                    )
                    answers = await (calling if number is not None else asyncio.wait_for(calling, EXAMINED_S))
                    said = answers.get(address, OSError("no answer"))
                except Exception as error:
                    said = error
                if not isinstance(said, OSError | KeyError):
                    break
            self._events.put((address, number, said))

        asyncio.run_coroutine_threadsafe(call(), self._loop)

    @property
    def _loop(self) -> asyncio.AbstractEventLoop:
        loop: asyncio.AbstractEventLoop = self._client.loop.asyncio_loop
        return loop

    # ---------------------------------------------------------------- what comes in

    def _step(self, waits_s: float = LOOKS_S) -> None:
        """Take what has happened, waiting for it at most so long."""
        if time.monotonic() - self._looked >= LOOKS_S:
            self._look_for_nodes()
            self._looked = time.monotonic()
        with contextlib.suppress(queue.Empty):
            self._heed(*self._events.get(timeout=waits_s))
            while True:
                self._heed(*self._events.get_nowait())

    def _look_for_nodes(self) -> None:
        """Ask new nodes what they are, and give up those that are gone."""
        there = set(self._addresses())
        for address in there - self._asked:
            self._asked.add(address)
            self._call(address, None, node.examine, self._code, None if self._probe is None else str(self._probe))
        for address in self._asked - there:
            self._asked.discard(address)
            self._refused.pop(address, None)
            self._gone(address)
        self._look_for_lack()

    def _addresses(self) -> list[str]:
        """The workers that the scheduler knows. Raises UserError where it is gone."""
        if self._is_connected():
            with contextlib.suppress(OSError):
                return list(self._client.scheduler_info(n_workers=-1)["workers"])
        raise UserError(
            f"the scheduler at {self._scheduler} is gone",
            fix="start it again; finished trials are kept, and the same command goes on",
        )

    def _is_connected(self) -> bool:
        """Return whether the scheduler is there. One that was away has forgotten its workers."""
        return self._client is not None and bool(self._client.status == "running")

    def _heed(self, address: str, number: int | None, said: Any) -> None:
        if number is None:
            self._examined(address, said)
            return
        one = self._nodes.get(address)
        bundle = None if one is None else one.bundles.pop(number, None)
        if one is None or bundle is None:
            return  # the node was given up meanwhile
        one.renders -= bundle.jobs[0].stage == "renders"
        if isinstance(said, Carried):
            self._carried(one, bundle, said)
        elif isinstance(said, UserError):  # its processes run other code, or cannot start
            self._refused[address] = UserError(f"the worker at {_bare(address)}: {said.message}", fix=said.fix)
            self._tell_once(f"{self._refused[address].message}; it is not used any more")
            self._return(bundle.jobs)
            self._gone(address)
        else:
            self._look_for_nodes()
            self._lost(bundle.jobs, f"its worker did not answer ({type(said).__name__}: {said})", address)

    def _examined(self, address: str, said: NodeFacts | BaseException) -> None:
        """Use a node, or leave it out with a line that says why."""
        if address not in self._asked:
            return
        if isinstance(said, BaseException) and not isinstance(said, ImportError | AttributeError):
            # it died meanwhile, or the network failed: no sign of another installation
            why = f"did not say what it is ({type(said).__name__}: {said}); it is not used"
            self._tell_once(f"the worker at {_bare(address)} {why}")
            return
        try:
            self._nodes[address] = self._node_of(address, said)
        except UserError as mistake:
            self._refused[address] = mistake
            self._tell_once(f"{mistake.message}; it is not used")

    def _node_of(self, address: str, said: NodeFacts | BaseException) -> _Node:
        """Raise UserError where a node would give other numbers than this machine, or none."""
        where = f"the worker at {_bare(address)}"
        if isinstance(said, BaseException):
            raise UserError(
                f"{where} cannot run tofpod: {type(said).__name__}: {said}",
                fix="install the same version of tofpod there and start its workers again",
            )
        if said.python.split(".")[:2] != list(platform.python_version_tuple()[:2]):
            raise UserError(
                f"{where} runs Python {said.python}, this machine {platform.python_version()}",
                fix="use the same Python on all",
            )
        if said.digests.get("trials") != self._digests.get("trials"):
            raise UserError(
                f"{where} runs another version of tofpod, of a plug-in, or of numpy, scipy, numba or OpenCV"
                " than this machine",
                fix="install the same there, and start its workers again: they keep the code that they began with",
            )
        can_render = said.digests.get("renders") == self._digests.get("renders")
        shares = said.sees == self._nonce
        if self._probe is not None and not shares:
            # it may have been looked at before there was anything to see
            shares = self._sees([address]).get(address) == self._nonce
        return _Node(address, said.processes, can_render, said.offers_render, shares)

    def _carried(self, one: _Node, bundle: Bundle, said: Carried) -> None:
        if said.missing:  # the node has let go of views that it was thought to hold
            for name in said.missing:
                one.holds.pop(name, None)
            self._return(bundle.jobs)
            return
        for name, content in said.rendered.items():
            write_bytes(Path(bundle.jobs[0].arguments[-1]) / name, content)
            one.holds[name] = None
        for job, ended in zip(bundle.jobs, said.ended, strict=True):
            if job.stage == "trials":
                self._mean_s += 0.1 * (ended.seconds - self._mean_s)
            self._over(job, ended)

    def _gone(self, address: str) -> None:
        """Give a node up; what it had goes to others."""
        one = self._nodes.pop(address, None)
        for bundle in one.bundles.values() if one is not None else ():
            why = "its worker died: by hand, by the batch system, or by the system as memory ran out"
            self._lost(bundle.jobs, why, address)

    def _lost(self, jobs: tuple[Job, ...], why: str, address: str) -> None:
        """Jobs that were at a node as it died run again; after `TRIES` such deaths they are taken for the cause."""
        for job in jobs:
            self._tries[job.name] += 1
            if self._tries[job.name] >= TRIES:
                self._over(job, Ended("crashed", why=why, worker=_bare(address)))
        self._return(tuple(job for job in jobs if 0 < self._tries[job.name] < TRIES))

    def _return(self, jobs: tuple[Job, ...]) -> None:
        """Put jobs to the front of the queue."""
        for job in reversed(jobs):
            self._waiting[job.stage].appendleft(job)

    def _over(self, job: Job, ended: Ended) -> None:
        self._out[job.stage] -= 1
        self._tries.pop(job.name, None)
        self._done.append((job, ended))

    def _look_for_lack(self) -> None:
        """Raise UserError where for long no node could do what waits. A batch system's queue is waited for as long as
        it takes; its jobs are alike, so not for one that renders."""
        lacking, fix = "", ""
        if not self._nodes and self._refused and self._asked <= self._refused.keys():
            raise next(iter(self._refused.values()))
        if not self._nodes:
            lacking, fix = "worker", "start some with `dask worker ADDRESS --nthreads PROCESSES`"
        elif self._waiting["renders"] and not any(one.can_render for one in self._nodes.values()):
            lacking = "worker that can render (with Mitsuba, Dr.Jit and trimesh as here)"
            fix = f"install tofpod on the workers just as here; {len(self._nodes)} that cannot render are there"
        now = time.monotonic()
        if lacking != self._lacking:
            self._lacking, self._lacking_since, self._lack_told = lacking, now, now
        spent_s = now - self._lacking_since
        if lacking == "worker" and self._scheduler.startswith("jobqueue:"):
            self._tell_once(f"waiting for workers of {self._scheduler}, as long as its queue takes")
            if now - self._lack_told >= TELL_AGAIN_S:
                self._lack_told = now
                _tell(f"no worker of {self._scheduler} after {spent_s / 60:.0f} minutes: look into its queue")
        elif lacking:
            self._tell_once(f"waiting for a {lacking} at {self._scheduler}, at most {WAIT_FOR_NODES_S:.0f} s")
            if spent_s > WAIT_FOR_NODES_S:
                raise UserError(f"no {lacking} came to {self._scheduler} within {WAIT_FOR_NODES_S:.0f} s", fix=fix)

    # ---------------------------------------------------------------- the cache

    def _place_probe(self, folder: Path) -> None:
        """Write a file that tells whether a node sees the driver's cache of renders; to `scenes.render.cache` it is a
        leftover, where this process is killed."""
        self._probe = folder / f".{self._nonce[:16]}.seen.part.npz"
        write_text(self._probe, self._nonce)
        seen = self._sees(list(self._nodes))
        for one in self._nodes.values():
            one.shares = seen.get(one.address) == self._nonce
        apart = sum(not one.shares for one in self._nodes.values())
        if apart:
            self._tell_once(
                f"{apart} of {len(self._nodes)} workers do not see {folder}: renders are sent over the network"
            )

    def _sees(self, addresses: list[str]) -> dict[str, str | None]:
        """The content of the probe, as each node sees it; a node that does not answer sees nothing."""
        return dict(self._client.run(node.seen, str(self._probe), workers=addresses, on_error="ignore"))

    def _tell_once(self, message: str) -> None:
        if message not in self._told:
            self._told.add(message)
            _tell(message)


async def _awaited(doing: Coroutine[Any, Any, Any]) -> Any:
    return await doing


@contextlib.contextmanager
def _connected(scheduler: str, workers_wanted: int) -> Iterator[Any]:
    """Connect to a scheduler by its address, or start the user's own dask-jobqueue cluster. Yields dask's client.

    Raises UserError where it is neither, is not installed or configured, or does not answer.
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
        if cluster is not None:
            stack.callback(_close, cluster)
        try:
            client = Client(cluster or scheduler, timeout=ANSWERS_S, set_as_default=False)
        except (OSError, ValueError) as error:
            raise UserError(
                f"the scheduler at {scheduler} does not answer within {ANSWERS_S} s: {error}",
                fix="start one with `dask scheduler`, and workers with `dask worker`; docs/scale.md says how",
            ) from error
        stack.callback(_close, client)
        yield client


def _close(what: Any) -> None:
    with contextlib.suppress(Exception):
        what.close(timeout=CLOSES_S)


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
            fix=f"describe it in ~/.config/dask/jobqueue.yaml under jobqueue.{kind}: cores, processes: 1, memory",
        ) from error
    return cluster


@contextlib.contextmanager
def _quiet() -> Iterator[None]:
    """Silence dask: how jobs end tells of workers that come and go, and versions are checked here."""
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


def _tell(message: str) -> None:
    """Print a line to the user, beside the progress."""
    print(message, file=sys.stderr, flush=True)


def _bare(address: str) -> str:
    """host:port."""
    return address.rpartition("://")[2]
