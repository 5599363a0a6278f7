"""A cluster's workers by way of dask.distributed: any number of machines, workers that come, go and die.

Trials go in bundles that take about `BUNDLE_S`, two with each worker, so that it never waits for the network. A worker
that dies leaves its bundles' jobs as suspects; each runs once more alone on a worker, and one that dies alone crashed.
"""

from __future__ import annotations

import contextlib
import platform
import queue
import secrets
import time
import traceback
from collections import Counter, deque
from dataclasses import dataclass, field
from pathlib import Path

from harness.engine.cluster_link import Answer, Event, Joined, Left, Link, Parcel, bare, linked, tell
from harness.engine.cluster_worker import Bundle, Carried, Worker
from harness.engine.work import TRACEBACK_CHARACTERS, Ended, Job, Limits, Stage
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import write_bytes, write_text
from harness.vocabulary.sources import source_digest

BUNDLE_S = 0.25
"""dask takes some 15 ms from one task to the next and 2 ms of the driver's processor for each."""
MOST_IN_BUNDLE = 32
WITH_WORKER = 2
"""Bundles: one that runs and one that waits."""
LOOKS_S = 1.0
"""Between looks whether all is well."""
GRACE_S = 30.0
"""Beyond the time limits of all that a worker has: then its process does not answer, as its own clock should have."""
WAIT_FOR_WORKERS_S = 60.0
"""For workers that are started by hand. A batch system's queue may take hours: there a line is told now and then."""
TELL_AGAIN_S = 300.0
TRIES = 3
"""Of a job that never began, as what it needs was lost on the way."""


@dataclass
class _Place:
    """A worker that takes jobs. ``shares``: it sees the driver's cache of renders."""

    address: str
    can_render: bool
    offers_render: bool
    shares: bool
    parcels: list[Parcel] = field(default_factory=list)
    is_alone: bool = False
    """What it has is a job that runs alone: a render, or a suspect."""
    is_hung: bool = False
    since: float = field(default_factory=time.monotonic)


class ClusterEngine:
    """Jobs on the workers of ``scheduler``: tcp://host:8786, or jobqueue:slurm and the like, asked for
    ``workers_wanted``. ``limits`` are a trial's; renders have its limit of time only."""

    def __init__(self, scheduler: str, limits: Limits, workers_wanted: int) -> None:
        self._scheduler, self._limits, self._wanted = scheduler, limits, workers_wanted
        self._link: Link
        self._places: dict[str, _Place] = {}
        self._waiting: dict[Stage, deque[Job]] = {"renders": deque(), "trials": deque()}
        self._suspects: deque[Job] = deque()
        self._done: list[tuple[Job, Ended]] = []
        self._out: Counter[Stage] = Counter()
        self._tries: Counter[str] = Counter()
        self._mean_s = BUNDLE_S
        """Of a trial; at first as if each were worth a bundle of its own."""
        self._looked = time.monotonic()
        self._lacking = ""
        """Workers that could do what waits, since then; told last at ``_lack_told``."""
        self._lacking_since = self._lack_told = time.monotonic()
        self._probe: Path | None = None
        self._nonce = secrets.token_hex(16)
        self._told: set[str] = set()
        self._refused: dict[str, UserError] = {}
        """Workers that would give other numbers than this machine, by address: left out while others are there."""
        self._stack = contextlib.ExitStack()

    def __enter__(self) -> ClusterEngine:
        with contextlib.ExitStack() as stack:
            self._link = stack.enter_context(linked(self._scheduler, self._wanted))
            self._link.watch(lambda: None if self._probe is None else str(self._probe))
            while not self._places:
                self._step()
            self._stack = stack.pop_all()
        return self

    def __exit__(self, *error: object) -> None:
        if self._probe is not None:
            with contextlib.suppress(OSError):
                self._probe.unlink(missing_ok=True)
        self._stack.close()

    @property
    def worker_count(self) -> int:
        """Workers that take jobs; as of the last look."""
        with contextlib.suppress(queue.Empty):
            while True:
                self._heed(self._link.events.get_nowait())
        return len(self._places)

    def room(self, stage: Stage) -> int:
        """As much as keeps all workers busy, and the next bundles ready."""
        each = 1 if stage == "renders" else WITH_WORKER * self._bundle_size() + 1
        return max(1, each * len(self._places)) + 1 - self._out[stage]

    def submit(self, job: Job) -> None:
        """Take a job."""
        folder = Path(job.arguments[-1]) if job.stage == "renders" else next((path.parent for path in job.needs), None)
        if folder is not None and self._probe is None:
            self._place_probe(folder)
        self._out[job.stage] += 1
        self._waiting[job.stage].append(job)

    def ended(self) -> list[tuple[Job, Ended]]:
        """Wait for jobs to end. Raises UserError where the scheduler is gone, or for long no worker is left that could
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
        return max(1, min(MOST_IN_BUNDLE, round(BUNDLE_S / max(self._mean_s, 1e-4))))

    def _hand_out(self) -> None:
        """First a bundle for every worker, then a second one; while suspects wait for a free worker, no second one."""
        for most in range(1 if self._suspects else WITH_WORKER):
            if self._suspects or any(self._waiting.values()):
                for place in list(self._places.values()):
                    if len(place.parcels) == most and not (place.is_alone or place.is_hung):
                        self._hand_to(place)

    def _hand_to(self, place: _Place) -> None:
        renders, trials = self._waiting["renders"], self._waiting["trials"]
        is_free = not place.parcels
        may_render = place.can_render and (place.offers_render or not self._some_offer())
        if is_free and self._suspects and (may_render or self._suspects[0].stage == "trials"):
            self._send(place, (self._suspects.popleft(),), alone=True)
        elif renders and may_render and (place.offers_render or not trials):
            # trials first, as renders make more of them; where workers are set aside for renders, these first there
            if is_free and not self._found_here(renders[0], place):
                self._send(place, (renders.popleft(),), alone=True)
        elif trials:
            share = -(-len(trials) // (WITH_WORKER * len(self._places)))
            count = min(self._bundle_size(), share)
            self._send(place, tuple(trials.popleft() for _ in range(count)))

    def _some_offer(self) -> bool:
        return any(place.offers_render and place.can_render for place in self._places.values())

    def _found_here(self, job: Job, place: _Place) -> bool:
        """Whether this machine's cache holds a render that a worker could not find there; then it is done."""
        if place.shares:
            return False
        from scenes.render.cache import read_view

        found = read_view(Path(job.arguments[-1]) / job.name)
        if found is not None:
            self._waiting["renders"].popleft()
            self._over(job, Ended("done", (True, found.seconds), worker="this process"))
        return found is not None

    def _send(self, place: _Place, jobs: tuple[Job, ...], *, alone: bool = False) -> None:
        parcel = Parcel(jobs, place.address)
        needs = () if place.shares else dict.fromkeys(path for job in jobs for path in job.needs)
        limits = self._limits if jobs[0].stage == "trials" else Limits(self._limits.seconds, None)
        if not place.parcels:
            place.since = time.monotonic()
        place.parcels.append(parcel)
        place.is_alone = alone
        try:
            self._link.send(parcel, Bundle(jobs, limits, place.shares), needs)
        except (OSError, RuntimeError):
            # no way to the scheduler, or no worker left that could take a view
            self._look_for_scheduler()
            place.parcels.remove(parcel)
            place.is_alone = False
            self._return(jobs)

    # ---------------------------------------------------------------- what comes in

    def _step(self) -> None:
        """Take what has happened, waiting for it at most `LOOKS_S`."""
        with contextlib.suppress(queue.Empty):
            self._heed(self._link.events.get(timeout=LOOKS_S))
            while not self._link.events.empty():
                self._heed(self._link.events.get())
        if time.monotonic() - self._looked >= LOOKS_S:
            self._looked = time.monotonic()
            self._look_for_scheduler()
            self._look_for_workers()
            self._look_for_overdue()

    def _heed(self, event: Event) -> None:
        if isinstance(event, Joined):
            self._joined(event)
        elif isinstance(event, Left):
            self._left(event)
        elif not event.parcel.is_void:
            self._answered(event)

    def _joined(self, event: Joined) -> None:
        if event.address in self._places:
            return  # it came again before its first look ended: what it has stays with it
        if isinstance(event.said, BaseException) and not isinstance(event.said, ImportError | AttributeError):
            # it died meanwhile, or the network failed: no sign of another installation
            said = f"{type(event.said).__name__}: {event.said}"
            return self._tell_once(
                f"the worker at {bare(event.address)} did not say what it is ({said}); it is not used"
            )
        try:
            self._places[event.address] = self._place_of(event.address, event.said)
        except UserError as mistake:
            self._refused[event.address] = mistake
            self._tell_once(f"{mistake.message}; it is not used")

    def _place_of(self, address: str, said: Worker | BaseException) -> _Place:
        """Raises UserError where a worker would give other numbers than this machine, or none."""
        from harness.engine import plan
        from scenes.render import cache

        where = f"the worker at {bare(address)}"
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
        if said.trials != source_digest(plan.BUILT_IN_CODE, plan.PACKAGES):
            raise UserError(
                f"{where} runs another version of tofpod, numpy, scipy, numba or OpenCV than this machine",
                fix="install the same there, and start its workers again: they keep the code that they began with",
            )
        if said.threads > 1:
            self._tell_once(f"{where} has {said.threads} threads, of which one is used; start it with --nthreads 1")
        can_render = said.renders == source_digest(cache.CODE, cache.PACKAGES)
        shares = said.sees == self._nonce
        if self._probe is not None and not shares:
            # it may have been looked at before there was anything to see
            shares = self._link.sees([address], str(self._probe)).get(address) == self._nonce
        return _Place(address, can_render, said.offers_render, shares)

    def _left(self, event: Left) -> None:
        self._refused.pop(event.address, None)
        place = self._places.pop(event.address, None)
        if place is None:
            return
        if event.memory_mb is not None:
            why = f"its worker was ended by its nanny, as it took {event.memory_mb:.0f} MB (dask worker --memory-limit)"
        else:
            why = "its worker died: by hand, by the batch system, or by the system as memory ran out"
        for parcel in place.parcels:
            self._link.void(parcel)
            self._suspect(parcel, place, Ended("crashed", why=why, worker=bare(place.address)))

    def _suspect(self, parcel: Parcel, place: _Place, ended: Ended) -> None:
        """Alone, a job is to blame for what happened to its worker; among others it runs once more."""
        if place.is_alone:
            self._over(parcel.jobs[0], ended)
        else:
            self._suspects += parcel.jobs

    def _answered(self, event: Answer) -> None:
        parcel, said = event.parcel, event.said
        place = self._places.get(parcel.address)
        if place is None or parcel not in place.parcels:
            return
        place.parcels.remove(parcel)
        place.since = time.monotonic()
        was_alone, place.is_alone = place.is_alone, False
        if isinstance(said, Carried):
            self._carried(parcel, place, said)
        else:
            self._not_carried(parcel, said, was_alone)

    def _carried(self, parcel: Parcel, place: _Place, said: Carried) -> None:
        for name, content in said.rendered.items():
            write_bytes(Path(parcel.jobs[0].arguments[-1]) / name, content)
        for job, ended in zip(parcel.jobs, said.ended, strict=False):
            if job.stage == "trials":
                self._mean_s += 0.1 * (ended.seconds - self._mean_s)
            self._over(job, ended)
        self._return(parcel.jobs[len(said.ended) :])
        if said.is_hung:
            place.is_hung = True
            if not place.parcels:
                self._link.dismiss(place.address)

    def _not_carried(self, parcel: Parcel, error: BaseException, was_alone: bool) -> None:
        """No answer: its worker is about to be gone, what it needs was lost, or it could not be sent."""
        from distributed import KilledWorker

        if isinstance(error, KilledWorker):
            # the scheduler's allowed-failures is 0; that the worker left is told as well
            why = "its worker died: by hand, by the batch system, or by the system as memory ran out"
            if was_alone:
                self._over(parcel.jobs[0], Ended("crashed", why=why, worker=bare(parcel.address)))
            else:
                self._suspects += parcel.jobs
            return
        self._look_for_scheduler()
        self._link.forget(parcel)
        why = "".join(traceback.format_exception(error))[-TRACEBACK_CHARACTERS:]
        for job in parcel.jobs:
            self._tries[job.name] += 1
            if self._tries[job.name] >= TRIES:
                self._over(job, Ended("failed", why=why, is_bug=True, worker=bare(parcel.address)))
            else:
                self._suspects.append(job)

    def _return(self, jobs: tuple[Job, ...]) -> None:
        """To the front of the queue: jobs that were not begun."""
        for job in reversed(jobs):
            self._waiting[job.stage].appendleft(job)

    def _over(self, job: Job, ended: Ended) -> None:
        self._out[job.stage] -= 1
        self._tries.pop(job.name, None)
        self._done.append((job, ended))

    # ---------------------------------------------------------------- whether all is well

    def _look_for_scheduler(self) -> None:
        if not self._link.is_alive:
            raise UserError(
                f"the scheduler at {self._scheduler} is gone",
                fix="start it again; finished trials are kept, and the same command goes on",
            )

    def _look_for_workers(self) -> None:
        """A batch system's queue is waited for as long as it takes; its jobs are alike, so not for one that renders."""
        renders_wait = self._waiting["renders"] or any(job.stage == "renders" for job in self._suspects)
        lacking, fix = "", ""
        if not self._places and self._refused and self._link.addresses <= self._refused.keys():
            raise next(iter(self._refused.values()))
        if not self._places:
            lacking, fix = "worker", "start some with `dask worker ADDRESS --nthreads 1`"
        elif renders_wait and not any(place.can_render for place in self._places.values()):
            lacking = "worker that can render (with Mitsuba, Dr.Jit and trimesh as here)"
            fix = f"install tofpod on the workers just as here; {len(self._places)} that cannot render are there"
        now = time.monotonic()
        if lacking != self._lacking:
            self._lacking, self._lacking_since, self._lack_told = lacking, now, now
        spent_s = now - self._lacking_since
        if lacking == "worker" and self._scheduler.startswith("jobqueue:"):
            self._tell_once(f"waiting for workers of {self._scheduler}, as long as its queue takes")
            if now - self._lack_told >= TELL_AGAIN_S:
                self._lack_told = now
                tell(f"no worker of {self._scheduler} after {spent_s / 60:.0f} minutes: look into its queue")
        elif lacking:
            self._tell_once(f"waiting for a {lacking} at {self._scheduler}, at most {WAIT_FOR_WORKERS_S:.0f} s")
            if spent_s > WAIT_FOR_WORKERS_S:
                raise UserError(f"no {lacking} came to {self._scheduler} within {WAIT_FOR_WORKERS_S:.0f} s", fix=fix)

    def _look_for_overdue(self) -> None:
        """A worker whose own clock stands still, as a job keeps its interpreter, is ended by its nanny."""
        for place in list(self._places.values()):
            limit_s = self._limits.seconds
            if limit_s is None or not place.parcels:
                continue
            spent_s = time.monotonic() - place.since
            if spent_s > limit_s * len(place.parcels[0].jobs) + GRACE_S:
                del self._places[place.address]
                self._link.kill(place.address)
                why = f"not done after {spent_s:.0f} s (--time-limit); its worker does not answer"
                for parcel in place.parcels:
                    self._link.void(parcel)
                    self._suspect(parcel, place, Ended("timed out", why=why, worker=bare(place.address)))

    # ---------------------------------------------------------------- the cache

    def _place_probe(self, folder: Path) -> None:
        """A file that tells whether a worker sees the driver's cache of renders; to `scenes.render.cache` a leftover,
        where this process is killed."""
        self._probe = folder / f".{self._nonce[:16]}.seen.part.npz"
        write_text(self._probe, self._nonce)
        seen = self._link.sees(self._places, str(self._probe))
        for place in self._places.values():
            place.shares = seen.get(place.address) == self._nonce
        apart = sum(not place.shares for place in self._places.values())
        if apart:
            self._tell_once(
                f"{apart} of {len(self._places)} workers do not see {folder}: renders are sent over the network"
            )

    def _tell_once(self, message: str) -> None:
        if message not in self._told:
            self._told.add(message)
            tell(message)
