"""A cluster's driver and nodes that come and go: dask's client is in the test's hands, without any
worker."""

from __future__ import annotations

import asyncio
import platform
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from harness.programs.cluster import engine as cluster_engine
from harness.programs.cluster.engine import Bundle, ClusterEngine, NodeFacts
from harness.runs.engines import code_of
from harness.runs.jobs import Ended, Job, Limits
from harness.vocabulary.errors import UserError
from harness.vocabulary.provenance import source_digest
from tests.support.cluster_processes import square

pytestmark = pytest.mark.skipif(find_spec("distributed") is None, reason="needs dask.distributed")
FIRST = "tcp://first:1"
SECOND = "tcp://second:1"
CODE = code_of(["thesis"])
DIGESTS = {stage: source_digest(*indices) for stage, indices in CODE.items()}
SEEN = "the driver's mark"


def facts(*, can_render: bool = True, processes: int = 1) -> NodeFacts:
    digests = DIGESTS if can_render else {"trials": DIGESTS["trials"]}
    return NodeFacts(platform.python_version(), digests, processes, offers_render=False, sees=SEEN)


class FakeClient:
    """Dask's client: nodes are what they are said to be; bundles are kept until the test answers
    them."""

    status = "running"

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self.loop = SimpleNamespace(asyncio_loop=loop)
        self.nodes: dict[str, NodeFacts | BaseException] = {}
        self.sent: list[tuple[str, Bundle, asyncio.Future[Any]]] = []

    def scheduler_info(self, n_workers: int) -> dict[str, Any]:
        return {"workers": dict.fromkeys(self.nodes)}

    def run(
        self,
        function: Callable[..., Any],
        *arguments: Any,
        workers: list[str],
        asynchronous: bool = False,
        **_: Any,
    ):
        if not asynchronous:
            return {}
        (address,) = workers
        if function is cluster_engine.examine:
            return self._said(address)
        answer = self.loop.asyncio_loop.create_future()
        self.sent.append((address, arguments[0], answer))
        return answer

    async def _said(self, address: str) -> dict[str, Any]:
        return {address: self.nodes.get(address, OSError("no answer"))}

    def answer(self, number: int, said: Any = None) -> None:
        """Let a bundle be carried out, or end as the test says."""
        address, bundle, future = self.sent[number]
        said = tuple(Ended("done", 1) for _ in bundle.jobs) if said is None else said
        self.loop.asyncio_loop.call_soon_threadsafe(future.set_result, {address: said})


@pytest.fixture
def client(monkeypatch: pytest.MonkeyPatch) -> Iterator[FakeClient]:
    monkeypatch.setattr(cluster_engine, "LOOKS_S", 0.02)
    loop = asyncio.new_event_loop()
    thread = threading.Thread(target=loop.run_forever, daemon=True)
    thread.start()
    yield FakeClient(loop)
    loop.call_soon_threadsafe(loop.stop)
    thread.join()
    for task in asyncio.all_tasks(loop):
        task.cancel()
    loop.run_until_complete(asyncio.sleep(0))
    loop.close()


def engine_with(
    client: FakeClient, *, scheduler: str = "tcp://driver:1", **nodes: NodeFacts
) -> ClusterEngine:
    """An engine that knows its nodes."""
    engine = ClusterEngine(scheduler, Limits(seconds=900.0), 1, CODE, Path())
    engine._nonce = SEEN
    engine._client = client
    client.nodes |= {f"tcp://{name}:1": node for name, node in nodes.items()}
    stepped(engine, lambda: len(engine._nodes) + len(engine._refused) == len(nodes))
    return engine


def stepped(engine: ClusterEngine, holds: Callable[[], object]) -> None:
    end = time.monotonic() + 600.0
    while not holds():
        assert time.monotonic() < end, "waited too long"
        engine._step()


def render(folder: Path, name: str = "a.npz") -> Job:
    return Job(name, "renders", square, (str(folder),))


def trial(name: str) -> Job:
    return Job(name, "trials", square, (1,))


def handed_out(engine: ClusterEngine, client: FakeClient, count: int = 1) -> None:
    engine._hand_out()
    stepped(engine, lambda: len(client.sent) == count)


def test_renders_do_not_wait_for_ever_when_the_last_node_that_renders_dies(
    tmp_path, client, monkeypatch, capsys
):
    engine = engine_with(client, first=facts(), second=facts(can_render=False))
    engine.submit(render(tmp_path, "a.npz"))
    engine.submit(render(tmp_path, "b.npz"))
    handed_out(engine, client)
    del client.nodes[FIRST]
    monkeypatch.setattr(cluster_engine, "WAIT_FOR_NODES_S", 0.2)
    with pytest.raises(UserError, match="no worker that can render"):
        engine.ended()
    assert capsys.readouterr().err.count("waiting for a worker that can render") == 1


def test_a_node_of_another_version_is_left_out_while_others_are_there(tmp_path, client, capsys):
    old = replace(facts(), digests={**DIGESTS, "trials": "of yesterday"})
    engine = engine_with(client, first=old, second=facts())
    engine.submit(render(tmp_path))
    handed_out(engine, client)
    assert [address for address, _, _ in client.sent] == [SECOND]
    assert capsys.readouterr().err.count("runs another version of tofpod") == 1
    del client.nodes[SECOND]
    with pytest.raises(UserError, match="runs another version of tofpod"):
        engine.ended()


def test_a_node_that_does_not_see_the_folder_of_renders_is_left_out(client, capsys):
    engine = engine_with(client, first=replace(facts(), sees=None), second=facts())
    assert set(engine._nodes) == {SECOND}
    assert "first:1 does not see" in capsys.readouterr().err
    engine.__exit__()


def test_a_node_whose_processes_load_edited_code_is_left_out_and_loses_nothing(client, capsys):
    engine = engine_with(client, first=facts(), second=facts())
    engine.submit(trial("one"))
    handed_out(engine, client)
    address = client.sent[0][0]
    client.answer(0, UserError("the code of trials was edited while this sweep ran"))
    stepped(engine, lambda: address not in engine._nodes)
    assert "was edited while this sweep ran; it is not used" in capsys.readouterr().err
    handed_out(engine, client, 2)
    assert client.sent[1][0] != address
    client.answer(1)
    assert [job.name for job, _ in engine.ended()] == ["one"]


def test_renders_wait_for_a_node_that_joins_after_one_that_cannot_render(tmp_path, client):
    engine = engine_with(client, first=facts(can_render=False))
    engine.submit(render(tmp_path))
    engine._hand_out()
    assert not client.sent
    client.nodes[SECOND] = facts()
    stepped(engine, lambda: SECOND in engine._nodes)
    handed_out(engine, client)
    assert [address for address, _, _ in client.sent] == [SECOND]
    client.answer(0)
    assert [job.name for job, _ in engine.ended()] == ["a.npz"]


def test_trials_go_on_where_no_node_can_render(client, monkeypatch):
    engine = engine_with(client, first=facts(can_render=False))
    monkeypatch.setattr(cluster_engine, "WAIT_FOR_NODES_S", 0.2)
    engine.submit(trial("one"))
    handed_out(engine, client)
    end = time.monotonic() + 0.3  # beyond the limit, which holds only where renders wait
    while time.monotonic() < end:
        engine._step()
    client.answer(0)
    assert [job.name for job, _ in engine.ended()] == ["one"]


def test_a_node_that_dies_costs_nothing_and_jobs_that_see_many_die_are_crashed(client):
    engine = engine_with(client, first=facts())
    engine.submit(trial("one"))
    for number in range(cluster_engine.TRIES):
        handed_out(engine, client, number + 1)
        assert not engine._done
        client.answer(number, OSError("connection lost"))
        stepped(engine, lambda number=number: engine._tries["one"] == number + 1 or engine._done)
    ((job, ended),) = engine.ended()
    assert (job.name, ended.state) == ("one", "crashed") and "its worker" in ended.why


def test_a_node_that_leaves_while_it_is_looked_at_never_joins(client):
    engine = engine_with(client, second=facts())
    engine._asked.discard(FIRST)
    engine._heed(FIRST, None, facts())
    assert list(engine._nodes) == [SECOND]


def test_a_node_that_dies_while_it_is_looked_at_is_passed_over(client, capsys):
    engine = engine_with(client)
    client.nodes = {FIRST: ValueError("half an answer"), SECOND: facts()}
    stepped(engine, lambda: engine._nodes)
    stepped(engine, lambda: "first:1 did not state its version" in capsys.readouterr().err)
    assert list(engine._nodes) == [SECOND]


@pytest.mark.parametrize(
    "error", [ModuleNotFoundError("No module named 'harness'"), AttributeError("no examine")]
)
def test_a_worker_without_tofpod_is_refused_at_the_start(client, error):
    engine = engine_with(client)
    client.nodes[FIRST] = error
    with pytest.raises(UserError, match="cannot run tofpod"):
        stepped(engine, lambda: engine._nodes)


def test_a_batch_system_is_waited_for_as_long_as_it_takes(client, monkeypatch, capsys):
    engine = engine_with(client, scheduler="jobqueue:slurm")
    monkeypatch.setattr(cluster_engine, "WAIT_FOR_NODES_S", 0.2)
    end = time.monotonic() + 0.5  # beyond the limit for workers that are started by hand
    while time.monotonic() < end:
        engine._step()
    assert capsys.readouterr().err.count("as long as its queue takes") == 1
    started_by_hand = engine_with(client)
    with pytest.raises(UserError, match="no worker connected"):
        stepped(started_by_hand, lambda: False)
