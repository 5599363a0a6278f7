"""Runs jobs on a cluster with dask.distributed. Each dask worker is a node, which runs the local
engine.

The driver sends each node bundles of jobs through the scheduler, two at a time; dask neither
queues nor retries them. If a node dies, its jobs go to other nodes; a job that was running on
`TRIES` nodes as they died has crashed."""

from __future__ import annotations

import asyncio
import atexit
import contextlib
import importlib
import importlib.metadata
import logging
import platform
import queue
import re
import secrets
import sys
import time
import warnings
from collections import Counter, deque
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import product
from pathlib import Path
from typing import Any

from harness.runs.jobs import Code, Ended, Job, Limits, Stage
from harness.runs.processes import MOST_RENDERERS, Answers, LocalEngine
from harness.vocabulary.errors import UserError
from harness.vocabulary.extras import load_extra, require_extra
from harness.vocabulary.files import write_text
from harness.vocabulary.provenance import source_digest

BUNDLE_S = 0.25  # work in a bundle for each process of a node; a call of a node takes about 10 ms
MOST_IN_BUNDLE = 32  # most jobs in a bundle for each process of a node
WITH_NODE = 2  # bundles at a node: its processes work on one while the other waits
LOOKS_S = 1.0  # interval at which the driver checks which nodes are connected
# wait for workers that are started by hand; a batch system's queue may take hours
WAIT_FOR_NODES_S = 60.0
TRIES = 5
ANSWERS_S = 5  # time for a scheduler to answer a connection, which takes milliseconds
# time for a node to describe itself: it reads the sources, possibly from a network's disk
EXAMINED_S = 60.0
CLOSES_S = 1.0
KINDS = {
    name.lower(): f"{name}Cluster"
    for name in ["SLURM", "PBS", "LSF", "SGE", "HTCondor", "OAR", "Moab", "Local"]
}
"""Classes of dask-jobqueue, each in a module named after its kind; "local" starts jobs on this
machine."""


@dataclass(frozen=True)
class Bundle:
    """Jobs of one stage for one node."""

    jobs: tuple[Job, ...]
    limits: Limits


@dataclass(frozen=True)
class NodeFacts:
    """Facts about a node. ``digests``: of its installed code, by stage. ``sees``: content of the
    probe file there."""

    python: str
    digests: Mapping[Stage, str]
    processes: int
    offers_render: bool
    sees: str | None


@dataclass
class _Node:
    """A node that takes jobs. ``bundles``: those that it works on, by number; ``renders``: the
    number of renders."""

    address: str
    facts: NodeFacts
    can_render: bool
    bundles: dict[int, Bundle] = field(default_factory=dict)
    renders: int = 0


class ClusterEngine:
    """Runs jobs on the workers of ``scheduler``: tcp://host:8786, or jobqueue:slurm and the like,
    which starts ``workers_wanted``. ``limits``: of a trial; renders have its time limit only.
    ``code``: as in `LocalEngine`. ``folder``: where jobs read and store renders; nodes that do not
    see it are not used."""

    def __init__(
        self,
        scheduler: str,
        limits: Limits,
        workers_wanted: int,
        code: Mapping[Stage, Code],
        folder: Path,
    ) -> None:
        self._scheduler = scheduler
        self._limits = limits
        self._wanted = workers_wanted
        self._code = dict(code)
        self._digests = {stage: source_digest(*sources) for stage, sources in self._code.items()}
        self._client: Any = None
        self._nodes: dict[str, _Node] = {}
        self._refused: dict[
            str, UserError
        ] = {}  # nodes with other code: not used while there are others
        self._asked: set[str] = set()  # addresses of nodes that were asked to describe themselves
        self._waiting: dict[Stage, deque[Job]] = {"renders": deque(), "trials": deque()}
        self._done: list[tuple[Job, Ended]] = []
        self._out: Counter[Stage] = Counter()
        self._tries: Counter[str] = Counter()
        # (node's address, bundle's number, answer); without a number, the answer describes the
        # node
        self._events: queue.SimpleQueue[tuple[str, int | None, Any]] = queue.SimpleQueue()
        self._number = 0
        # mean duration of a trial; at first, each trial counts as a whole bundle
        self._mean_s = BUNDLE_S
        self._looked = float("-inf")
        self._lacking = ""  # what the waiting jobs lack
        self._lacking_since = time.monotonic()
        self._nonce = secrets.token_hex(16)  # identifies this driver to the nodes
        # a file that shows whether a node sees the folder; the cache of renders treats it as a
        # leftover
        self._probe = folder.absolute() / f".{self._nonce[:16]}.seen.part.npz"
        self._printed: set[str] = set()
        self._stack = contextlib.ExitStack()

    def __enter__(self) -> ClusterEngine:
        with contextlib.ExitStack() as stack:
            write_text(self._probe, self._nonce)
            stack.callback(self._probe.unlink, missing_ok=True)
            self._client = stack.enter_context(_connected(self._scheduler, self._wanted))
            while not self._nodes:
                self._step()
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *error: object) -> None:
        busy = [node.address for node in self._nodes.values() if node.bundles]
        if busy and self._client.status == "running":

            async def dropped() -> None:
                await self._client.run(
                    drop, self._nonce, workers=busy, on_error="ignore", asynchronous=True
                )

            with contextlib.suppress(
                Exception
            ):  # a node that cannot be reached finishes its bundles in its own time
                asyncio.run_coroutine_threadsafe(dropped(), self._client.loop.asyncio_loop).result(
                    CLOSES_S
                )
        self._stack.close()

    def room(self, stage: Stage) -> int:
        """Return the room for enough jobs to keep all nodes busy, with the next bundles ready."""
        per_process = 1 if stage == "renders" else WITH_NODE * self._bundle_size() + 1
        return (
            max(1, per_process * sum(node.facts.processes for node in self._nodes.values()))
            + 1
            - self._out[stage]
        )

    def submit(self, job: Job) -> None:
        """Take a job."""
        self._out[job.stage] += 1
        self._waiting[job.stage].append(job)

    def ended(self) -> list[tuple[Job, Ended]]:
        """Wait for jobs to end. Raises UserError if the scheduler, or every node that could run
        them, is gone."""
        while not self._done:
            self._hand_out()
            if not self._done:
                self._step()
        self._hand_out()
        done = self._done
        self._done = []
        return done

    def _bundle_size(self) -> int:
        return max(1, min(MOST_IN_BUNDLE, round(BUNDLE_S / max(self._mean_s, 1e-4))))

    def _hand_out(self) -> None:
        """Send each node a bundle of trials, then a second one, and renders where it may render."""
        renders = self._waiting["renders"]
        trials = self._waiting["trials"]
        some_offer = any(
            node.facts.offers_render and node.can_render for node in self._nodes.values()
        )
        for allowed_jobs, to in product(range(WITH_NODE), list(self._nodes.values())):
            processes = to.facts.processes
            offers = to.facts.offers_render
            # A node with one process does one thing at a time: trials first, because renders only
            # make more of them; but nodes that are set aside for renders do these first.
            may_render = to.can_render and (offers or not some_offer)
            may_render &= processes > 1 or not (to.bundles or (trials and not offers))
            if renders and may_render and to.renders < min(MOST_RENDERERS, processes):
                self._send(to, (renders.popleft(),))
            elif (
                trials
                and len(to.bundles) - to.renders <= allowed_jobs
                and not (processes == 1 and to.renders)
            ):
                share = -(-len(trials) // (WITH_NODE * len(self._nodes)))
                count = min(self._bundle_size() * processes, max(share, processes), len(trials))
                self._send(to, tuple(trials.popleft() for _ in range(count)))

    def _send(self, to: _Node, jobs: tuple[Job, ...]) -> None:
        self._number += 1
        bundle = to.bundles[self._number] = Bundle(jobs, self._limits)
        to.renders += jobs[0].stage == "renders"
        self._call(to.address, self._number, carry_out, bundle, self._code, self._nonce)

    def _call(self, address: str, number: int | None, function: Any, *arguments: Any) -> None:
        """Call a function on a node; what it returns or raises becomes an event."""

        async def call() -> None:
            answer: Any = None
            # the scheduler reports a worker shortly before it can reach it
            for pause_s in (0.0,) if number is not None else (0.0, 0.2, 1.0, 3.0):
                await asyncio.sleep(pause_s)
                try:
                    call_options = {
                        "workers": [address],
                        "on_error": "return",
                        "asynchronous": True,
                    }
                    calling = self._client.run(function, *arguments, **call_options)
                    answers = await (
                        calling if number is not None else asyncio.wait_for(calling, EXAMINED_S)
                    )
                    answer = answers.get(address, OSError("no answer"))
                except Exception as error:
                    answer = error
                if not isinstance(answer, OSError | KeyError):
                    break
            self._events.put((address, number, answer))

        asyncio.run_coroutine_threadsafe(call(), self._client.loop.asyncio_loop)

    def _step(self) -> None:
        """Process the events that have happened; wait for the first of them at most `LOOKS_S`."""
        if time.monotonic() - self._looked >= LOOKS_S:
            self._look_for_nodes()
            self._looked = time.monotonic()
        with contextlib.suppress(queue.Empty):
            self._heed(*self._events.get(timeout=LOOKS_S))
            while True:
                self._heed(*self._events.get_nowait())

    def _look_for_nodes(self) -> None:
        """Ask new nodes to describe themselves, give up those that are gone. Raises UserError
        without a scheduler."""
        present = None
        if self._client.status == "running":
            with contextlib.suppress(OSError):
                present = set(self._client.scheduler_info(n_workers=-1)["workers"])
        if present is None:
            fix = "start it again; finished trials are kept, and the same command continues"
            raise UserError(f"the scheduler at {self._scheduler} is gone", fix=fix)
        for address in present - self._asked:
            self._asked.add(address)
            self._call(address, None, examine, self._code, str(self._probe))
        for address in self._asked - present:
            self._asked.discard(address)
            self._refused.pop(address, None)
            self._gone(address)
        self._look_for_lack()

    def _heed(self, address: str, number: int | None, answer: Any) -> None:
        if number is None:
            self._examined(address, answer)
            return
        node = self._nodes.get(address)
        bundle = None if node is None else node.bundles.pop(number, None)
        if node is None or bundle is None:
            return  # the node was given up in the meantime
        node.renders -= bundle.jobs[0].stage == "renders"
        if isinstance(answer, tuple):
            for job, ended in zip(bundle.jobs, answer, strict=True):
                if job.stage == "trials":
                    self._mean_s += 0.1 * (ended.seconds - self._mean_s)
                self._over(job, ended)
        elif isinstance(answer, UserError):  # its processes run other code, or cannot start
            self._refuse(
                address,
                UserError(f"the worker at {_bare(address)}: {answer.message}", fix=answer.fix),
            )
            self._waiting[bundle.jobs[0].stage].extendleft(reversed(bundle.jobs))
            self._gone(address)
        else:
            self._look_for_nodes()
            self._lost(
                bundle.jobs,
                f"its worker did not answer ({type(answer).__name__}: {answer})",
                address,
            )

    def _examined(self, address: str, answer: NodeFacts | BaseException) -> None:
        """Use a node, or print why it is not used."""
        if address not in self._asked:
            return
        where = f"the worker at {_bare(address)}"
        if isinstance(answer, ImportError | AttributeError):
            fix = "install the same version of tofpod there and start its workers again"
            self._refuse(
                address,
                UserError(f"{where} cannot run tofpod: {type(answer).__name__}: {answer}", fix=fix),
            )
        elif isinstance(answer, BaseException):
            # it died in the meantime, or the network failed; this says nothing about its
            # installation
            self._print_once(
                f"{where} did not state its version ({type(answer).__name__}: {answer}); it "
                "is not used"
            )
        elif answer.python.split(".")[:2] != list(platform.python_version_tuple()[:2]):
            message = (
                f"{where} runs Python {answer.python}, this machine {platform.python_version()}"
            )
            self._refuse(address, UserError(message, fix="use the same Python on all"))
        elif answer.digests.get("trials") != self._digests.get("trials"):
            message = (
                f"{where} runs another version of tofpod, of a plug-in, or of numpy, scipy, "
                "numba or OpenCV"
            )
            fix = (
                "install the same there, and start its workers again: they keep the code that "
                "they loaded"
            )
            self._refuse(address, UserError(f"{message} than this machine", fix=fix))
        elif answer.sees != self._nonce:
            message = f"{where} does not see {self._probe.parent}, where this machine keeps renders"
            self._refuse(
                address, UserError(message, fix="name a folder with --out that all machines share")
            )
        else:
            self._nodes[address] = _Node(
                address, answer, answer.digests.get("renders") == self._digests.get("renders")
            )

    def _refuse(self, address: str, why: UserError) -> None:
        self._refused[address] = why
        self._print_once(f"{why.message}; it is not used")

    def _gone(self, address: str) -> None:
        """Give up a node and pass its jobs to others."""
        node = self._nodes.pop(address, None)
        for bundle in node.bundles.values() if node is not None else ():
            why = (
                "its worker died: by hand, by the batch system, or by the system as memory ran out"
            )
            self._lost(bundle.jobs, why, address)

    def _lost(self, jobs: tuple[Job, ...], why: str, address: str) -> None:
        """Queue the jobs of a node that died again; a job that was at `TRIES` such nodes counts as
        the cause."""
        self._tries.update(job.name for job in jobs)
        hopeless = [job for job in jobs if self._tries[job.name] >= TRIES]
        self._waiting[jobs[0].stage].extendleft(
            job for job in reversed(jobs) if job not in hopeless
        )
        for job in hopeless:
            self._over(job, Ended("crashed", why=why, worker=_bare(address)))

    def _over(self, job: Job, ended: Ended) -> None:
        self._out[job.stage] -= 1
        self._tries.pop(job.name, None)
        self._done.append((job, ended))

    def _look_for_lack(self) -> None:
        """Raise UserError if no node can run the waiting jobs for long; a batch system's queue may
        take any time."""
        lacking = ""
        fix = ""
        if not self._nodes and self._refused and self._asked <= self._refused.keys():
            raise next(iter(self._refused.values()))
        if not self._nodes:
            lacking = "worker"
            fix = "start some with `dask worker ADDRESS --nthreads PROCESSES`"
        elif self._waiting["renders"] and not any(node.can_render for node in self._nodes.values()):
            lacking = "worker that can render (with Mitsuba, Dr.Jit and trimesh as here)"
            fix = "install tofpod on the workers just as here"
        if lacking != self._lacking:
            self._lacking = lacking
            self._lacking_since = time.monotonic()
        if lacking == "worker" and self._scheduler.startswith("jobqueue:"):
            self._print_once(
                f"waiting for workers of {self._scheduler}, as long as its queue takes"
            )
        elif lacking:
            self._print_once(
                f"waiting for a {lacking} at {self._scheduler}, at most {WAIT_FOR_NODES_S:.0f} s"
            )
            if time.monotonic() - self._lacking_since > WAIT_FOR_NODES_S:
                raise UserError(
                    f"no {lacking} connected to {self._scheduler} within {WAIT_FOR_NODES_S:.0f} s",
                    fix=fix,
                )

    def _print_once(self, message: str) -> None:
        if message not in self._printed:
            self._printed.add(message)
            print(message, file=sys.stderr, flush=True)


@contextlib.contextmanager
def _connected(scheduler: str, workers_wanted: int) -> Iterator[Any]:
    """Connect to a scheduler by its address, or start the user's own dask-jobqueue cluster. Yields
    dask's client."""
    is_address = re.fullmatch(r"(tcp|tls)://.+:\d+", scheduler) is not None
    kind = scheduler.removeprefix("jobqueue:")
    if not is_address and (kind == scheduler or kind not in KINDS):
        legal = "tcp://host:8786, tls://host:8786, or jobqueue: followed by one of " + ", ".join(
            KINDS
        )
        raise UserError(
            f"--scheduler {scheduler}: is neither an address nor a kind of job queue", legal=legal
        )
    distributed = load_extra("distributed", "--scheduler")
    import dask

    with contextlib.ExitStack() as stack:
        stack.enter_context(dask.config.set({"distributed.comm.timeouts.connect": f"{ANSWERS_S}s"}))
        # the ends of jobs show which workers come and go, and this module checks versions
        stack.enter_context(warnings.catch_warnings())
        warnings.simplefilter("ignore")
        for name in list(logging.root.manager.loggerDict):
            if name.split(".")[0] in ("distributed", "tornado"):
                logging.getLogger(name).setLevel(logging.CRITICAL + 1)
        cluster = None
        if not is_address:  # according to the user's own dask configuration
            require_extra("dask_jobqueue", "jobqueue:")
            try:
                cluster = getattr(importlib.import_module(f"dask_jobqueue.{kind}"), KINDS[kind])()
                stack.callback(_close, cluster)
                cluster.scale(jobs=workers_wanted)
            except (ValueError, TypeError, OSError, RuntimeError) as error:
                message = f"dask-jobqueue could not start a cluster of kind {kind}: {error}"
                fix = (
                    f"describe it in ~/.config/dask/jobqueue.yaml under jobqueue.{kind}: cores, "
                    "processes: 1, memory"
                )
                raise UserError(message, fix=fix) from error
        try:
            client = distributed.Client(
                cluster or scheduler, timeout=ANSWERS_S, set_as_default=False
            )
        except (OSError, ValueError) as error:
            message = f"the scheduler at {scheduler} does not answer within {ANSWERS_S} s: {error}"
            fix = (
                "start one with `dask scheduler`, and workers with `dask worker`; docs/scale.md "
                "says how"
            )
            raise UserError(message, fix=fix) from error
        stack.callback(_close, client)
        yield client


def _close(resource: Any) -> None:
    with contextlib.suppress(Exception):
        resource.close(timeout=CLOSES_S)


def _bare(address: str) -> str:
    return address.rpartition("://")[2]


# ---------------------------------------------------------------- in a dask worker, which never
# computes itself

_engines: dict[str, LocalEngine] = {}  # by the code that they run: normally one
_awaited: dict[str, set[Answers]] = {}  # the queues that each driver waits for


def examine(code: Mapping[Stage, Code], probe: str, dask_worker: Any) -> NodeFacts:
    """Describe this node. Each process computes digests once: files that change later are not what
    it runs."""
    digests: dict[Stage, str] = {}
    for stage, sources in code.items():
        with contextlib.suppress(importlib.metadata.PackageNotFoundError):
            digests[stage] = source_digest(*sources)
    state = dask_worker.state
    offers_render = state.total_resources.get("render", 0) > 0
    sees = None
    with contextlib.suppress(OSError):
        sees = Path(probe).read_text(encoding="utf-8")
    return NodeFacts(platform.python_version(), digests, state.nthreads, offers_render, sees)


def drop(driver: str) -> None:
    """End all jobs of a driver that no longer waits for them."""
    for answers in _awaited.pop(driver, ()):
        for engine in _engines.values():
            engine.drop(answers)


async def carry_out(
    bundle: Bundle, code: Mapping[Stage, Code], driver: str, dask_worker: Any
) -> tuple[Ended, ...]:
    """Run the jobs of a bundle; return their ends. Raises UserError for other code, or if
    processes cannot start."""
    key = repr(sorted(code.items()))
    if key not in _engines:
        _engines[key] = LocalEngine(dask_worker.state.nthreads, Limits(), code)
        _engines[key].__enter__()
        atexit.register(_engines[key].__exit__)
    answers = Answers()
    _awaited.setdefault(driver, set()).add(answers)
    try:
        return await asyncio.to_thread(
            _ends_of, bundle, _engines[key], answers, _bare(dask_worker.address)
        )
    finally:
        _awaited.get(driver, set()).discard(answers)


def _ends_of(
    bundle: Bundle, engine: LocalEngine, answers: Answers, worker: str
) -> tuple[Ended, ...]:
    for job in bundle.jobs:
        engine.put(job, bundle.limits, answers)
    ended: dict[str, Ended] = {}
    while len(ended) < len(bundle.jobs) and not answers.is_dropped:
        answer = answers.ended.get()
        if isinstance(answer, UserError):
            engine.drop(answers)
            raise answer
        ended[answer[0].name] = replace(answer[1], worker=worker)
    return tuple(ended[job.name] for job in bundle.jobs if job.name in ended)
