"""What a cluster's driver makes of workers that come and go: events as dask sends them, without any worker."""

from __future__ import annotations

import asyncio
import platform
import queue
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

pytest.importorskip("distributed")

from cluster_processes import square

from harness.engine import cluster as cluster_engine
from harness.engine import plan
from harness.engine.cluster import ClusterEngine
from harness.engine.cluster_link import Answer, Joined, Left, Link, Parcel
from harness.engine.cluster_worker import Carried, Worker
from harness.engine.work import Ended, Job, Limits
from harness.vocabulary.errors import UserError
from harness.vocabulary.sources import source_digest
from scenes.render import cache

FIRST, SECOND = "tcp://first:1", "tcp://second:1"


class FakeLink:
    """Keeps what is sent; nobody does it."""

    is_alive = True

    def __init__(self) -> None:
        self.events: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self.sent: list[Parcel] = []
        self.addresses = {FIRST, SECOND}

    def send(self, parcel: Parcel, bundle: object, needs: object) -> None:
        self.sent.append(parcel)

    def void(self, parcel: Parcel) -> None:
        parcel.is_void = True

    def sees(self, addresses: object, probe: str) -> dict[str, str | None]:
        return {}


def worker(*, can_render: bool) -> Worker:
    renders = source_digest(cache.CODE, cache.PACKAGES) if can_render else None
    trials = source_digest(plan.BUILT_IN_CODE, plan.PACKAGES)
    return Worker(platform.python_version(), trials, renders, threads=1, offers_render=False, sees=None)


@pytest.fixture(autouse=True)
def soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cluster_engine, "LOOKS_S", 0.02)
    monkeypatch.setattr(cluster_engine, "WAIT_FOR_WORKERS_S", 0.2)


def engine_with(*events: object, scheduler: str = "tcp://driver:1") -> tuple[ClusterEngine, FakeLink]:
    engine, link = ClusterEngine(scheduler, Limits(seconds=900.0), 1), FakeLink()
    engine._link = link  # type: ignore[assignment]
    for event in events:
        link.events.put(event)
    if events:
        engine._step()
    return engine, link


def render(folder: Path, name: str = "a.npz") -> Job:
    return Job(name, "renders", square, (str(folder),))


def answer(link: FakeLink, parcel: Parcel) -> None:
    link.events.put(Answer(parcel, Carried(tuple(Ended("done", 1) for _ in parcel.jobs))))


def test_renders_do_not_wait_for_ever_when_the_last_worker_that_renders_dies(tmp_path, capsys):
    renderer, other = Joined(FIRST, worker(can_render=True)), Joined(SECOND, worker(can_render=False))
    engine, link = engine_with(renderer, other)
    engine.submit(render(tmp_path, "a.npz"))
    engine.submit(render(tmp_path, "b.npz"))
    engine._hand_out()
    link.events.put(Left(FIRST, None))
    assert [(job.name, how.state) for job, how in engine.ended()] == [("a.npz", "crashed")]
    with pytest.raises(UserError, match="no worker that can render"):
        engine.ended()
    assert capsys.readouterr().err.count("waiting for a worker that can render") == 1


def test_a_worker_of_another_version_is_left_out_while_others_are_there(tmp_path, capsys):
    old = replace(worker(can_render=True), trials="of yesterday")
    engine, link = engine_with(Joined(FIRST, old), Joined(SECOND, worker(can_render=True)))
    engine.submit(render(tmp_path))
    engine._step()
    engine._hand_out()
    assert [parcel.address for parcel in link.sent] == [SECOND]
    assert capsys.readouterr().err.count("runs another version of tofpod") == 1
    link.addresses.discard(SECOND)
    link.events.put(Left(SECOND, None))
    with pytest.raises(UserError, match="runs another version of tofpod"):
        while True:
            engine.ended()


def test_renders_wait_for_a_worker_that_joins_after_one_that_cannot_render(tmp_path):
    engine, link = engine_with(Joined(FIRST, worker(can_render=False)))
    engine.submit(render(tmp_path))
    engine._step()
    engine._hand_out()
    assert not link.sent
    link.events.put(Joined(SECOND, worker(can_render=True)))
    engine._step()
    engine._hand_out()
    assert [parcel.address for parcel in link.sent] == [SECOND]
    answer(link, link.sent[0])
    assert [job.name for job, _ in engine.ended()] == ["a.npz"]


def test_trials_go_on_where_no_worker_can_render(tmp_path):
    engine, link = engine_with(Joined(FIRST, worker(can_render=False)))
    engine.submit(Job("one", "trials", square, (1,)))
    engine._hand_out()
    time.sleep(0.3)  # beyond the limit, which holds only where renders wait
    engine._step()
    answer(link, link.sent[0])
    assert [job.name for job, _ in engine.ended()] == ["one"]


def test_a_worker_that_joins_twice_keeps_its_jobs():
    engine, link = engine_with(Joined(FIRST, worker(can_render=True)))
    engine.submit(Job("one", "trials", square, (1,)))
    engine._hand_out()
    link.events.put(Joined(FIRST, worker(can_render=True)))
    answer(link, link.sent[0])
    engine._step()
    assert [job.name for job, _ in engine._done] == ["one"]


@pytest.mark.parametrize("leaves", [True, False])
def test_a_worker_that_leaves_while_it_is_looked_at_never_joins(leaves):
    heard: dict[str, Any] = {}

    async def run(*_: object, **__: object) -> dict[str, Worker]:
        if leaves:
            heard["all"]((0.0, {"action": "remove-worker", "worker": FIRST}))
        return {FIRST: worker(can_render=True)}

    async def events() -> list[object]:
        loop = SimpleNamespace(asyncio_loop=asyncio.get_running_loop(), add_callback=None)
        no_workers = lambda n_workers: {"workers": {}}  # noqa: E731
        client = SimpleNamespace(
            loop=loop,
            run=run,
            scheduler_info=no_workers,
            subscribe_topic=lambda topic, hear: heard.update({topic: hear}),
        )
        link = Link(client)
        link.watch(lambda: None)
        heard["all"]((0.0, {"action": "add-worker", "worker": FIRST}))
        others = asyncio.all_tasks() - {asyncio.current_task()}
        while not others:
            await asyncio.sleep(0)
            others = asyncio.all_tasks() - {asyncio.current_task()}
        await asyncio.gather(*others)
        return [link.events.get_nowait() for _ in range(link.events.qsize())]

    assert [type(event) for event in asyncio.run(events())] == ([Left] if leaves else [Joined])


def test_a_worker_that_dies_while_it_is_looked_at_is_passed_over(capsys):
    engine, link = engine_with()
    link.events.put(Joined(FIRST, OSError("Timed out trying to connect")))
    link.events.put(Joined(SECOND, worker(can_render=True)))
    engine._step()
    assert list(engine._places) == [SECOND]
    assert "first:1 did not say what it is" in capsys.readouterr().err


@pytest.mark.parametrize("error", [ModuleNotFoundError("No module named 'harness'"), AttributeError("no examine")])
def test_a_worker_without_tofpod_is_refused_at_the_start(error):
    engine, link = engine_with()
    link.events.put(Joined(FIRST, error))
    link.addresses.discard(SECOND)
    with pytest.raises(UserError, match="cannot run tofpod"):
        while not engine._places:
            engine._step()


def test_a_batch_system_is_waited_for_as_long_as_it_takes(monkeypatch, capsys):
    monkeypatch.setattr(cluster_engine, "TELL_AGAIN_S", 0.1)
    engine, _ = engine_with(scheduler="jobqueue:slurm")
    end = time.monotonic() + 60.0
    said = ""
    while said.count("look into its queue") < 3 and time.monotonic() < end:
        engine._step()
        said += capsys.readouterr().err
    assert said.count("as long as its queue takes") == 1 and said.count("look into its queue") == 3
    started_by_hand, _ = engine_with()
    with pytest.raises(UserError, match="no worker came"):
        while time.monotonic() < end:
            started_by_hand._step()


def test_what_a_killed_driver_leaves_in_the_cache_is_a_leftover(tmp_path):
    engine, _ = engine_with(Joined(FIRST, worker(can_render=True)))
    engine.submit(render(tmp_path))
    assert len(list(tmp_path.iterdir())) == 1
    assert [one.path for one in cache.leftovers(tmp_path, -60.0)] == list(tmp_path.iterdir())
    engine.__exit__()
    assert not list(tmp_path.iterdir())
