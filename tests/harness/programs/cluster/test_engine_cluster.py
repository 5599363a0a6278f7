"""Sweeps on a cluster: a scheduler and workers as processes of their own, faults included."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterable, Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest

from harness.experiment.load import load_experiment
from harness.programs.cluster.engine import ClusterEngine
from harness.runs.engines import code_of
from harness.runs.jobs import Ended, Job, JobEngine, Limits
from harness.runs.journal import Journal
from harness.runs.plan import plan_of
from harness.runs.processes import SerialEngine, render_into_cache
from harness.runs.run import examples_of, run_plan
from harness.vocabulary.errors import UserError
from scenes.render.cache import read_view
from tests.support.cluster_processes import (
    HOLD,
    ROOT,
    Processes,
    eat,
    hang,
    hold_the_interpreter,
    kill_own_process,
    loaded,
    note_node_and_sleep,
    pid_after,
    probes_of,
    processes,
    raises,
    slow_square,
    square,
    threads,
    until,
)
from tests.support.serial_run import records_of, run_serially, trial_keys
from tests.support.tiny_sweep import TINY

pytestmark = pytest.mark.skipif(find_spec("distributed") is None, reason="needs dask.distributed")
# which this module does not import: most processes that collect its tests do not run them


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Nodes that start on a busy machine need more than a user's minute."""
    monkeypatch.setattr("harness.programs.cluster.engine.WAIT_FOR_NODES_S", HOLD)


@pytest.fixture(scope="module")
def cluster(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Processes]:
    """Two nodes of one process each, with nannies, which replace a node that dies."""
    with processes(tmp_path_factory.mktemp("cluster")) as started:
        started.worker("--nworkers", "2", "--memory-limit", "1GB")
        yield started


def run(engine: JobEngine, jobs: Iterable[Job]) -> dict[str, Ended]:
    """Each job's end, by name."""
    waiting = list(jobs)[::-1]
    under_way = 0
    ended = {}
    while waiting or under_way:
        while waiting and engine.room(waiting[-1].stage) > 0:
            engine.submit(waiting.pop())
            under_way += 1
        for job, options in engine.ended():
            assert job.name not in ended, "a job ended twice"
            ended[job.name] = options
            under_way -= 1
    return ended


def squares(count: int, name: str = "square") -> list[Job]:
    return [Job(f"{name} {n}", "trials", square, (n,)) for n in range(count)]


NO_LIMITS = Limits()
CODE = code_of(["thesis"])


def engine_at(cluster: Processes, limits: Limits = NO_LIMITS) -> ClusterEngine:
    return ClusterEngine(cluster.address, limits, 2, CODE, cluster.folder)


def test_results_are_those_of_this_process(cluster):
    jobs = [*squares(300), Job("bad", "trials", raises, (7,))]
    with SerialEngine() as serial:
        local = run(serial, jobs)
    with engine_at(cluster) as engine:
        remote = run(engine, jobs)
    assert {
        name: (options.state, options.value, options.is_bug) for name, options in remote.items()
    } == {name: (options.state, options.value, options.is_bug) for name, options in local.items()}
    assert "ValueError: no such number: 7" in remote["bad"].why
    assert {options.worker.partition(":")[0] for options in remote.values()} == {"127.0.0.1"}
    assert len({options.worker for options in remote.values()}) == 2


def test_the_queue_stays_short_whatever_the_plan(cluster):
    with engine_at(cluster) as engine:
        taken = 0
        while engine.room("trials") > 0:
            engine.submit(Job(f"slow {taken}", "trials", slow_square, (taken, 0.3)))
            taken += 1
        assert taken < 20
        ended = []
        while len(ended) < taken:
            ended += engine.ended()


@pytest.mark.slow  # a campaign; test_engine_processes has the same faults without a cluster
def test_every_fault_costs_its_own_job_only(cluster):
    """One job kills its process, one hangs, one stops its whole process in C, one wants too much
    memory."""
    faults = {"killer": kill_own_process, "endless": hang, "stuck": hold_the_interpreter}
    jobs = [
        *squares(60, "before"),
        *(Job(name, "trials", fault, ()) for name, fault in faults.items()),
    ]
    jobs += [Job("hungry", "trials", eat, (3000,)), *squares(60, "after")]
    with engine_at(cluster, Limits(seconds=10.0, memory_mb=600)) as engine:
        ended = run(engine, jobs)
        again = run(engine, squares(30))
    bad = {name: ended.pop(name) for name in (*faults, "hungry")}
    assert [options.state for options in bad.values()] == [
        "crashed",
        "timed out",
        "timed out",
        "failed",
    ]
    assert "SIGKILL" in bad["killer"].why
    assert "in hang" in bad["endless"].why and "--time-limit" in bad["endless"].why
    assert "in hold_the_interpreter" in bad["stuck"].why
    assert "out of memory" in bad["hungry"].why and "--memory-limit" in bad["hungry"].why
    assert all(
        options.state == "done" and options.value == int(name.split()[1]) ** 2
        for name, options in ended.items()
    )
    assert {options.state for options in again.values()} == {"done"} and len(ended) == 120


@pytest.mark.slow  # test_engine_processes has deaths without a cluster
def test_a_node_killed_from_outside_costs_nothing(cluster, tmp_path):
    """SIGKILL to a dask worker in the middle of its jobs: they run on the other, and the nanny
    starts a new one."""
    jobs = [
        Job(f"slow {n}", "trials", note_node_and_sleep, (str(tmp_path / f"{n}"), 0.4))
        for n in range(12)
    ]
    with engine_at(cluster) as engine:
        killed: list[int] = []

        def kill() -> None:
            until(lambda: list(tmp_path.iterdir()) and next(tmp_path.iterdir()).read_text())
            killed.append(int(next(tmp_path.iterdir()).read_text()))
            os.kill(killed[0], signal.SIGKILL)

        killing = threading.Thread(target=kill)
        killing.start()
        ended = run(engine, jobs)
        killing.join()
    assert {options.state for options in ended.values()} == {"done"} and len(ended) == 12 and killed


@pytest.mark.slow  # a node of its own
def test_a_node_of_several_processes_uses_them_all_each_in_one_thread_whatever_its_environment(
    tmp_path,
):
    with processes(tmp_path / "cluster") as bare:
        bare.worker("--nthreads", "2", "--no-nanny")  # a nanny would set the environment
        with engine_at(bare) as engine:
            ended = run(engine, [Job(f"pid {n}", "trials", pid_after, (0.3,)) for n in range(12)])
            used = run(engine, [Job("threads", "trials", threads, ())])["threads"].value
    assert len({options.value for options in ended.values()}) == 2
    assert len({options.worker for options in ended.values()}) == 1
    assert len(used) > 1 and set(used.values()) == {1}, used


@pytest.mark.slow
def test_the_scheduler_gone_is_a_clear_message(tmp_path):
    with processes(tmp_path / "mortal") as mortal:
        mortal.worker("--no-nanny")
        with pytest.raises(UserError, match="is gone") as message, engine_at(mortal) as engine:
            engine.submit(Job("slow", "trials", slow_square, (1, 1.0)))
            engine.submit(Job("slower", "trials", slow_square, (1, HOLD)))
            assert [job.name for job, _ in engine.ended()] == ["slow"]
            mortal.scheduler.kill()
            engine.ended()
        assert "finished trials are kept" in str(message.value.fix)


@pytest.mark.parametrize(
    ("scheduler", "message"),
    [
        ("tcp://127.0.0.1:1", "does not answer"),
        ("localhost:8786", "neither an address nor a kind"),
        ("jobqueue:cloud", "neither an address nor a kind"),
        ("jobqueue:slurm", "could not start a cluster of kind slurm"),
    ],
)
def test_what_cannot_be_reached(scheduler, message, tmp_path):
    with (
        pytest.raises(UserError, match=message),
        ClusterEngine(scheduler, Limits(), 2, CODE, tmp_path),
    ):
        pass


def test_a_worker_with_other_code_is_refused(tmp_path):
    second_folder = tmp_path / "other"
    for room in ("harness", "scenes", "detectors"):
        shutil.copytree(
            ROOT / room, second_folder / room, ignore=shutil.ignore_patterns("__pycache__")
        )
    with open(second_folder / "detectors" / "averages" / "average.py", "a") as changed:
        changed.write("\n# another version\n")
    with processes(tmp_path / "cluster") as old:
        old.worker("--no-nanny", search=second_folder)
        with pytest.raises(UserError, match="another version of tofpod"), engine_at(old):
            pass


@pytest.mark.slow
def test_a_cluster_of_dask_jobqueue(tmp_path):
    pytest.importorskip("dask_jobqueue")
    local = {"cores": 1, "processes": 1, "memory": "1GB", "python": sys.executable}
    (tmp_path / "jobqueue.yaml").write_text(json.dumps({"jobqueue": {"local": local}}))
    code = (
        "from pathlib import Path\n"
        "from cluster_processes import square\n"
        "from harness.programs.cluster.engine import ClusterEngine\n"
        "from harness.runs.jobs import Job, Limits\n"
        "if __name__ == '__main__':\n"
        "    with ClusterEngine('jobqueue:local', Limits(), 1, {}, Path()) as engine:\n"
        "        engine.submit(Job('one', 'trials', square, (12,)))\n"
        "        print(engine.ended()[0][1].value)\n"
    )
    search = os.pathsep.join([str(ROOT), str(ROOT / "tests")])
    environment = {**os.environ, "DASK_CONFIG": str(tmp_path), "PYTHONPATH": search}
    (tmp_path / "one.py").write_text(code)
    done = subprocess.run(
        [sys.executable, "one.py"],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        timeout=HOLD,
    )
    assert done.stdout.split() == ["144"], done.stderr


# ---------------------------------------------------------------- renders, and whole sweeps


@pytest.fixture(scope="module")
def experiment(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("experiment") / "tiny.yaml"
    path.write_text(TINY)
    return path


def renders_and_set_ups(experiment: Path, cache: Path) -> tuple[list[Job], list[Job]]:
    plan = plan_of(load_experiment(experiment), cache)
    renders = [
        Job(
            job.path.name,
            "renders",
            render_into_cache,
            (job.target.to_data(), job.camera.to_data(), job.config.to_data(), str(job.folder)),
        )
        for job in plan.renders
    ]
    batches = [batch for group in plan.groups for batch in group.batches]
    loads = [
        Job(f"load {n} {again}", "trials", probes_of, (batch.views[0],))
        for n, batch in enumerate(batches)
        for again in range(4)
    ]
    return renders, loads


def test_renders_are_made_elsewhere_and_reach_the_cache(cluster, experiment, tiny_out, tmp_path):
    cache = tmp_path / "cache"
    shutil.copytree(tiny_out / ".cache" / "renders", cache)
    renders, loads = renders_and_set_ups(experiment, cache)
    (cache / renders[0].name).unlink()
    with engine_at(cluster, Limits(seconds=HOLD)) as engine:
        rendered = run(engine, renders[:1])
        again = run(engine, renders[:1])
        ended = run(engine, loads)
        looks = run(engine, [Job(f"look {n}", "trials", loaded, ()) for n in range(40)])
    # a node that does not answer in time is asked again, and may find the view that it has
    # rendered
    assert [options.state for options in rendered.values()] == ["done"], rendered
    assert again[renders[0].name].value[0] is True
    assert all(read_view(cache / job.name) is not None for job in renders)
    assert {options.state for options in ended.values()} == {"done"}, ended
    assert len({look.worker for look in looks.values()}) == 2
    assert all(look.value == [] for look in looks.values()), "a worker loaded Mitsuba"
    assert {path.name for path in cache.glob(".*")} <= {
        ".lock",
        ".rendering",
    }  # locks, and no leftovers


@pytest.mark.slow
def test_a_render_that_fails_or_kills_its_process_costs_itself(cluster, tmp_path):
    jobs = [
        Job("dies.npz", "renders", kill_own_process, (str(tmp_path),)),
        Job("fails.npz", "renders", raises, (str(tmp_path),)),
        *squares(20),
    ]
    jobs[0] = Job("dies.npz", "renders", die_in, (str(tmp_path),))
    with engine_at(cluster) as engine:
        ended = run(engine, jobs)
        again = run(engine, squares(20))
    assert ended["dies.npz"].state == "crashed" and "SIGKILL" in ended["dies.npz"].why
    assert ended["fails.npz"].state == "failed" and "no such number" in ended["fails.npz"].why
    assert {options.state for name, options in ended.items() if "npz" not in name} == {"done"}
    assert {options.state for options in again.values()} == {"done"}


def die_in(folder: str) -> None:
    kill_own_process()


def sweep_command(experiment: Path, out: str, *arguments: str) -> list[str]:
    return [sys.executable, "-m", "harness.sweep", str(experiment), "--out", out, *arguments]


def test_a_plan_gives_the_same_records_on_a_cluster(cluster, experiment, tiny_out, tmp_path):
    shutil.copytree(tiny_out / ".cache" / "renders", tmp_path / "cache")
    declared = load_experiment(experiment)
    here_at = tmp_path / "journal here"
    there_at = tmp_path / "journal there"
    with engine_at(cluster) as engine:
        remote = run_plan(
            plan_of(declared, tmp_path / "cache"), Journal(there_at), engine, lambda _: None
        )
        pictures = examples_of(plan_of(declared, tmp_path / "cache"), remote, engine)
    local = run_serially(plan_of(declared, tmp_path / "cache"), here_at)
    assert not remote.failures
    assert len(pictures) == 2
    assert remote.finished == local.finished and len(local.finished) == 4
    assert without_seconds(records_of(here_at, local)) == without_seconds(
        records_of(there_at, remote)
    )


def without_seconds(value: object) -> object:
    """What trials found, timings apart."""
    if isinstance(value, dict):
        return {
            key: without_seconds(element)
            for key, element in value.items()
            if not str(key).startswith("seconds")
        }
    return [without_seconds(element) for element in value] if isinstance(value, list) else value


@pytest.mark.slow  # test_engine has Ctrl-C without a cluster
def test_ctrl_c_leaves_and_says_how_to_go_on(cluster, experiment, tiny_out, tmp_path):
    shutil.copytree(tiny_out / ".cache", tmp_path / "out" / ".cache")
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    additional = ("--set", "repeats=400", "--scheduler", cluster.address)
    command = sweep_command(experiment, "out", *additional)
    process = subprocess.Popen(
        command, cwd=tmp_path, env=environment, stderr=subprocess.PIPE, text=True
    )

    def ended() -> list[str]:
        journals = [Journal(folder) for folder in tmp_path.glob("out/tiny/[0-9a-f]*/journal")]
        return [
            key for journal in journals for key in trial_keys(journal) if key.startswith("damaged")
        ]

    until(lambda: len(ended()) > 2 or process.poll() is not None, 2 * HOLD)
    process.send_signal(signal.SIGINT)
    began = time.monotonic()
    _, printed = process.communicate(timeout=HOLD)
    print(f"left after {time.monotonic() - began:.2f} s")
    assert process.returncode == 130, printed
    assert "Traceback" not in printed and "--scheduler" in printed
    assert len(ended()) > 2
