"""The local engine: each job comes back with how it ended, and takes no other with it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from multiprocessing.connection import Connection

import pytest

from harness.runs import processes
from harness.runs.jobs import STATES, Ended, Job, JobEngine, Limits, attempt
from harness.runs.processes import LocalEngine, SerialEngine
from harness.vocabulary import system
from harness.vocabulary.errors import UserError
from tests.support import faulty_jobs
from tests.support.tiny_sweep import ROOT


def run(engine: JobEngine, jobs: list[Job]) -> dict[str, Ended]:
    """All jobs, by name."""
    waiting = list(jobs)
    result = {}
    with engine:
        while len(result) < len(jobs):
            while waiting and engine.room(waiting[0].stage) > 0:
                engine.submit(waiting.pop(0))
            result.update({job.name: ended for job, ended in engine.ended()})
    return result


def doubles(count: int) -> list[Job]:
    return [Job(f"double {n}", "trials", faulty_jobs.double, (n,)) for n in range(count)]


def job(function: object) -> Job:
    return Job(function.__name__, "trials", function, ())  # type: ignore[attr-defined, arg-type]


def test_every_fault_costs_its_own_job_only():
    faults = [
        job(faulty_jobs.raises),
        job(faulty_jobs.refuses),
        job(faulty_jobs.kills_its_process),
        job(faulty_jobs.aborts),
        job(faulty_jobs.hangs),
    ]
    innocent = doubles(30)
    jobs = [
        job for pair in zip(faults, innocent[: len(faults)], strict=True) for job in pair
    ] + innocent[len(faults) :]
    result = run(LocalEngine(2, Limits(seconds=10.0, memory_mb=1000)), jobs)
    assert {name: ended.state for name, ended in result.items() if ended.state != "done"} == {
        "raises": "failed",
        "refuses": "failed",
        "kills_its_process": "crashed",
        "aborts": "crashed",
        "hangs": "timed out",
    }
    assert [result[job.name].value for job in innocent] == [2 * n for n in range(30)]
    assert result["raises"].is_bug and result["raises"].why.rstrip().endswith("ValueError: a bug")
    assert "Traceback" in result["raises"].why
    assert not result["refuses"].is_bug and "to do: mend it" in result["refuses"].why
    assert "SIGKILL" in result["kills_its_process"].why
    assert "SIGABRT" in result["aborts"].why and "faulty_jobs.py" in result["aborts"].why
    assert "not done after 10" in result["hangs"].why
    assert "in hangs" in result["hangs"].why or not hasattr(signal, "SIGUSR1")
    assert result["hangs"].seconds >= 10.0
    assert all(ended.state in STATES and ended.worker for ended in result.values())


@pytest.mark.skipif(not system.limits_private_memory(), reason="only Linux limits memory")
def test_a_job_that_needs_too_much_memory_fails():
    result = run(LocalEngine(1, Limits(memory_mb=1000)), [job(faulty_jobs.eats_memory)])
    ended = result["eats_memory"]
    assert ended.state == "failed" and "out of memory" in ended.why


def test_quick_jobs_are_ready_before_the_last_has_ended():
    """And those that wait for a process that dies, or hangs, are run by another."""
    remainder = doubles(40)
    jobs = [
        *remainder[:20],
        job(faulty_jobs.kills_its_process),
        *remainder[20:30],
        job(faulty_jobs.hangs),
        *remainder[30:],
    ]
    with LocalEngine(1, Limits()) as engine:
        assert engine.room("trials") == 2
        engine.submit(jobs[0])
        assert engine.room("trials") == 1
    result = run(LocalEngine(1, Limits(seconds=8.0)), jobs)
    states = {name: ended.state for name, ended in result.items() if ended.state != "done"}
    assert states == {"kills_its_process": "crashed", "hangs": "timed out"}
    assert [result[job.name].value for job in remainder] == [2 * n for n in range(40)]


def test_time_and_memory_are_told():
    ended = attempt(Job("a", "trials", faulty_jobs.double, (3,)), "somebody")
    assert (ended.state, ended.value, ended.worker) == ("done", 6, "somebody")
    assert 0 <= ended.seconds < 600
    assert 20 < ended.peak_mb < 20_000 or not system.peak_memory_bytes()


@pytest.mark.skipif(not system.peak_memory_bytes(), reason="the peak is not known")
def test_the_peak_of_memory_is_the_jobs_own():
    before = attempt(job(faulty_jobs.imported), "x").peak_mb
    import numpy as np

    large = attempt(Job("a", "trials", np.ones, (40_000_000,)), "x")
    assert large.peak_mb > before + 300
    del large
    assert attempt(job(faulty_jobs.imported), "x").peak_mb < before + 100


def test_trial_processes_load_neither_mitsuba_nor_open3d():
    assert run(LocalEngine(1, Limits()), [job(faulty_jobs.imported)])["imported"].value == []


def test_what_renders_is_loaded_only_where_a_render_is_expected(monkeypatch):
    started = []
    monkeypatch.setattr(processes, "start_server", started.append)
    for renders in (True, False):
        with LocalEngine(1, Limits(), renders=renders):
            pass
    both = ("harness.trials.trial", "scenes.render.view")
    assert started == [both, both[:1]]


def test_what_statistics_need_is_loaded_once_for_all_processes(monkeypatch):
    started = []
    monkeypatch.setattr(processes, "start_server", started.append)
    with LocalEngine(1, Limits(), renders=False, further=("pandas",)):
        pass
    assert started == [("harness.trials.trial", "pandas")]


OTHER_FOLDER = """
from harness.runs.processes import LocalEngine
from harness.runs.jobs import Job, Limits
import os, sys

os.chdir(sys.argv[1])
with LocalEngine(1, Limits()) as engine:
    engine.submit(Job("where", "trials", eval, ("__import__('sys').modules['harness.trials.trial'].__file__",)))
    print(engine.ended()[0][1])
"""


def test_processes_run_the_drivers_code_whatever_lies_in_the_folder_they_start_in(tmp_path):
    """A second `harness`, as another checkout has it, would be found first in the folder where a
    sweep is started."""
    other = tmp_path / "harness" / "trials"
    other.mkdir(parents=True)
    for path in (other.parent / "__init__.py", other / "__init__.py", other / "trial.py"):
        path.touch()
    arguments = {"cwd": ROOT, "capture_output": True, "text": True, "timeout": 900}
    done = subprocess.run([sys.executable, "-c", OTHER_FOLDER, str(tmp_path)], **arguments)
    assert str(ROOT / "harness" / "trials" / "trial.py") in done.stdout, done.stdout + done.stderr


DRIVER = """
import signal, sys, threading

from harness.runs import processes
from harness.runs.jobs import Job, Limits
from tests.support import faulty_jobs

processes.MARK = "forked"
signal.signal(signal.SIGTERM, signal.default_int_handler)
if sys.argv[1] == "another thread":
    threading.Thread(target=threading.Event().wait, daemon=True).start()
if sys.argv[1] == "open3d":
    sys.modules["open3d"] = None
with processes.LocalEngine(1, Limits()) as engine:
    engine.submit(Job("inherited", "trials", faulty_jobs.inherited, ()))
    print(engine.ended()[0][1].value)
"""


@pytest.mark.skipif(not system.can_fork(), reason="no driver is forked")
@pytest.mark.parametrize(
    ("state", "mark"),
    [("one thread", "forked"), ("another thread", "imported"), ("open3d", "imported")],
)
def test_processes_are_forks_of_a_driver_that_is_safe_to_fork(state: str, mark: str):
    """SIGTERM is the driver's to answer: its handler does not stay in the forks."""
    environment = dict(os.environ, OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1")
    command = [sys.executable, "-c", DRIVER, state]
    done = subprocess.run(
        command, cwd=ROOT, env=environment, capture_output=True, text=True, timeout=900
    )
    assert done.stdout.strip() == str((mark, True)), done.stdout + done.stderr


def test_serial_runs_here_and_in_order():
    jobs = [Job("pid", "trials", os.getpid, ()), *doubles(3), job(faulty_jobs.raises)]
    result = run(SerialEngine(), jobs)
    assert result["pid"].value == os.getpid()
    assert list(result) == [job.name for job in jobs]
    assert result["raises"].state == "failed"


def test_leaving_early_ends_processes_at_once():
    """The job that hangs would never end by itself."""
    engine = LocalEngine(2, Limits())
    with pytest.raises(KeyboardInterrupt), engine:
        engine.submit(Job("pid", "trials", os.getpid, ()))
        ((_, ended),) = engine.ended()
        engine.submit(job(faulty_jobs.hangs))
        raise KeyboardInterrupt
    with pytest.raises(ProcessLookupError):
        os.kill(ended.value, 0)


def test_processes_that_cannot_start_are_a_message(monkeypatch):
    monkeypatch.setattr("harness.runs.processes.serve", faulty_jobs.dies_at_once)
    with pytest.raises(UserError, match="3 worker processes in a row died as they started"):
        run(LocalEngine(1, Limits()), doubles(1))


def test_a_process_killed_between_jobs_costs_nothing():
    with LocalEngine(1, Limits()) as engine:
        engine.submit(Job("pid", "trials", os.getpid, ()))
        ((_, first),) = engine.ended()
        os.kill(first.value, signal.SIGKILL)
        engine._workers[0]._process.join(timeout=60.0)
        states = []
        for double in doubles(2):
            engine.submit(double)
            states += [ended.state for _, ended in engine.ended()]
    assert states == ["done", "done"]


def test_a_process_that_has_loaded_edited_code_is_refused(tmp_path, monkeypatch):
    source = tmp_path / "edited_plug_in.py"
    source.write_text("ANSWER = 1\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    code = {"trials": (("edited_plug_in",), ("numpy",))}
    result = run(LocalEngine(1, Limits(), code), doubles(2))
    assert [ended.value for ended in result.values()] == [0, 2]
    engine = LocalEngine(1, Limits(), code)
    source.write_text("ANSWER = 2\n")
    with pytest.raises(UserError, match="the code of trials was edited while this sweep ran"):
        run(engine, doubles(1))


def test_time_in_which_everything_stood_still_is_not_counted(monkeypatch):
    """As after Ctrl-Z: the wait took an hour where a second was asked for."""
    from harness.runs import processes

    clock = {"ahead_s": 0.0}
    real = time.monotonic
    real_poll = Connection.poll
    monkeypatch.setattr(processes.time, "monotonic", lambda: real() + clock["ahead_s"])

    def stopped(pipe: Connection, timeout: float = 0.0) -> bool:
        heard = real_poll(pipe, timeout)
        if not heard and clock["ahead_s"] == 0.0:
            clock["ahead_s"] = 3600.0
        return heard

    monkeypatch.setattr(Connection, "poll", stopped)
    engine = LocalEngine(1, Limits(seconds=60.0))
    result = run(engine, [Job("sleeps", "trials", time.sleep, (3.0,))])
    assert clock["ahead_s"] == 3600.0 and result["sleeps"].state == "done"


def test_a_full_disk_ends_everything(tmp_path, monkeypatch):
    assert attempt(Job("full", "trials", faulty_jobs.finds_the_disk_full, ()), "x").ends_all
    assert not attempt(job(faulty_jobs.refuses), "x").ends_all
