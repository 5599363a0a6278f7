"""Faults put into whole sweeps: each costs at most the trial that it hits, is told, and is mended
by running on."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import time
from pathlib import Path

import pytest

from harness.experiment.load import load_experiment
from harness.runs.journal import JOURNAL_VERSION, Journal
from harness.runs.plan import plan_of
from harness.runs.shards import locked
from harness.vocabulary.errors import UserError
from tests.support import faulty_jobs
from tests.support.serial_run import run_serially, trial_keys
from tests.support.tiny_sweep import ROOT, TINY, content, results, sweep_command

DETECTOR = '''\
from detectors.methods.thesis import ThesisDetector
from tests.support.faulty_jobs import commit_a_fault


class Clumsy(ThesisDetector):
    """The thesis' detector, which does what a test tells it to."""

    name = "clumsy"

    def analyse(self, cloud):
        commit_a_fault("any")
        return super().analyse(cloud)

    def find(self, cloud, evidence, threshold):
        commit_a_fault("judged")
        return super().find(cloud, evidence, threshold)
'''
REPEATS = "repeats=6"


pytestmark = pytest.mark.slow  # a campaign: kills, hangs, full disks, damaged files


@pytest.fixture(scope="module")
def home(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """With the experiment, a detector as a plug-in, and an undisturbed run."""
    home = tmp_path_factory.mktemp("faults")
    info = home / "plug_in" / "clumsy_detector-1.0.dist-info"
    info.mkdir(parents=True)
    (home / "plug_in" / "clumsy_detector.py").write_text(DETECTOR)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: clumsy-detector\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[tofpod.detectors]\nclumsy = clumsy_detector:Clumsy\n")
    (home / "tiny.yaml").write_text(
        TINY.replace("name: thesis\n  settings", "name: clumsy\n  settings").replace(
            "calibrate: {repeats: 2}", "calibrate: {repeats: 6}"
        )
    )
    done = run(home, "calm")
    assert done.returncode == 0, done.stderr
    return home


def environment(home: Path) -> dict[str, str]:
    return {"PYTHONPATH": os.pathsep.join([str(home / "plug_in"), str(ROOT / "tests"), str(ROOT)])}


def run(
    home: Path, out: str, *arguments: str, faults: tuple[str, ...] = ()
) -> subprocess.CompletedProcess[str]:
    """A sweep, with faults for whoever comes first."""
    folder = home / f"{out}-faults"
    folder.mkdir(exist_ok=True)
    for fault in faults:
        (folder / fault).touch()
    given = environment(home) | {faulty_jobs.FOLDER: str(folder)}
    command = sweep_command(home / "tiny.yaml", home / out, "--set", REPEATS, *arguments)
    return subprocess.run(
        command, cwd=ROOT, capture_output=True, text=True, timeout=1800, env=os.environ | given
    )


def judged_in(out: Path) -> list[str]:
    """Keys of the judged trials that are in the journal by now."""
    keys = [
        key for folder in out.glob("tiny/[0-9a-f]*/journal") for key in trial_keys(Journal(folder))
    ]
    return [key for key in keys if key.startswith("damaged")]


def with_renders(home: Path, out: str) -> Path:
    """A folder for results that has the renders already."""
    shutil.copytree(home / "calm" / ".cache", home / out / ".cache")
    return home / out


def test_faults_in_trials_are_told_and_mended(home):
    """One trial raises, one hangs, one wants too much memory, one kills its process: four of
    twelve are lost, the summary and the exit code say so; the same command leaves them,
    --retry-failed ends as if nothing had been. A fifth, which sets the threshold, kills its
    process and is tried again at once."""
    with_renders(home, "disturbed")
    limits = ("--time-limit", "120", "--memory-limit", "1.5")
    done = run(
        home,
        "disturbed",
        *limits,
        faults=("any-raise", "any-kill", "any-hang", "any-eat", "judged-kill"),
    )
    assert done.returncode == 1, done.stderr
    assert "2 failed, 1 crashed, 1 timed out" in done.stderr
    assert (
        "ValueError: a bug" in done.stderr
        and "SIGKILL" in done.stderr
        and "--retry-failed" in done.stderr
    )
    folder = results(home / "disturbed")
    printed = json.loads((folder / "provenance.json").read_text())
    assert sorted(one["state"] for one in printed["failures"]) == [
        "crashed",
        "failed",
        "failed",
        "timed out",
    ]
    # all else ran: six hole-free trials and six damaged ones, less four, whichever they were
    assert printed["trials"] == {"done": 8, "resumed": 0, "failed": 4}
    again = run(home, "disturbed", *limits)
    assert again.returncode == 1
    assert json.loads((folder / "provenance.json").read_text())["trials"] == {
        "done": 0,
        "resumed": 8,
        "failed": 4,
    }
    assert "2 failed, 1 crashed, 1 timed out" in again.stderr
    mended = run(home, "disturbed", *limits, "--retry-failed")
    assert mended.returncode == 0, mended.stderr
    assert content(folder) == content(results(home / "calm"))


def test_a_killed_driver_costs_what_was_under_way(home):
    """SIGKILL to the driver in the middle; the same command goes on and gives the same bytes."""
    out = with_renders(home, "killed")
    command = sweep_command(home / "tiny.yaml", out, "--set", REPEATS)
    process = subprocess.Popen(
        command, cwd=ROOT, env=os.environ | environment(home), stderr=subprocess.DEVNULL
    )
    deadline = time.monotonic() + 900
    while not (kept := judged_in(out)):
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.01)
    process.send_signal(signal.SIGKILL)
    process.wait()
    done = run(home, "killed")
    assert done.returncode == 0, done.stderr
    printed = json.loads((results(out) / "provenance.json").read_text())["trials"]
    assert printed["resumed"] >= 6 + len(kept) and printed["done"] + printed["resumed"] == 12
    assert content(results(out)) == content(results(home / "calm"))


def test_damaged_files_are_noticed_and_made_anew(home):
    """A render cut short, one with a flipped bit, a record half written and one with another word
    in it."""
    out = home / "damaged"
    shutil.copytree(home / "calm", out)
    first, second = sorted((out / ".cache" / "renders").glob("*.npz"))
    first.write_bytes(first.read_bytes()[: first.stat().st_size // 2])
    flipped = bytearray(second.read_bytes())
    flipped[len(flipped) // 2] ^= 1
    second.write_bytes(flipped)
    (journal,) = results(out).glob("journal/*.jsonl")
    lines = journal.read_text().splitlines()
    half = next(number for number, line in enumerate(lines) if '"key":"hole_free' in line)
    other = next(number for number, line in enumerate(lines) if '"key":"damaged' in line)
    lines[half] = lines[half][:200]
    assert '"detected":true' in lines[other]
    lines[other] = lines[other].replace('"detected":true', '"detected":false', 1)
    journal.write_text("\n".join(lines) + "\n")
    done = run(home, "damaged")
    assert done.returncode == 0, done.stderr
    printed = json.loads((results(out) / "provenance.json").read_text())
    assert printed["renders"] == {"done": 2, "cached": 0, "failed": 0}
    assert printed["trials"] == {"done": 2, "resumed": 10, "failed": 0}
    assert content(results(out)) == content(results(home / "calm"))


def test_a_second_sweep_in_the_same_folder_is_refused(home):
    folder = results(home / "calm")
    before = content(folder)
    with locked(folder):
        done = run(home, "calm")
    assert (done.returncode, "Traceback" in done.stderr) == (2, False)
    assert "another sweep is running in this folder" in done.stderr
    assert content(folder) == before
    assert run(home, "calm").returncode == 0


def test_a_full_disk_ends_with_a_message_and_keeps_what_is_finished(home, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(home / "plug_in"))
    experiment = load_experiment(home / "tiny.yaml", [REPEATS])
    plan = plan_of(experiment, home / "calm" / ".cache" / "renders")
    real = os.write
    written = []

    def write(file: int, content: bytes) -> int:
        if b'"key":"' in content:
            written.append(content)
            if len(written) == 4:  # the system takes what it has room for
                return real(file, content[:100])
        return real(file, content)

    monkeypatch.setattr(os, "write", write)
    with pytest.raises(UserError, match="the disk is full"):
        run_serially(plan, tmp_path)
    (segment,) = tmp_path.iterdir()
    assert segment.read_bytes().partition(b"\n")[2] == b"".join(written[:3]), "no torn line is left"
    monkeypatch.setattr(os, "write", real)
    outcome = run_serially(plan, tmp_path)
    assert (outcome.trials.found, outcome.trials.done, outcome.failures) == (3, 9, [])


def test_a_clock_that_jumps_changes_nothing(home, tmp_path, monkeypatch):
    """The wall clock goes back a year and forth ten at every look: no limit is reached, no
    duration is negative."""
    monkeypatch.syspath_prepend(str(home / "plug_in"))
    experiment = load_experiment(home / "tiny.yaml", [REPEATS])
    plan = plan_of(experiment, home / "calm" / ".cache" / "renders")
    year = 365 * 86400.0
    looks = iter(range(10**9))
    monkeypatch.setattr(time, "time", lambda: 1.8e9 + year * (10 if next(looks) % 2 else -1))
    outcome = run_serially(plan, tmp_path)
    assert outcome.failures == []
    entries = [Journal(tmp_path).read(key) for key in outcome.finished]
    assert all(entry is not None and 0 <= entry.seconds < 86400 for entry in entries)


def test_a_newer_journal_is_refused(home):
    out = home / "newer"
    shutil.copytree(home / "calm", out)
    (first,) = results(out).glob("journal/*.jsonl")
    newer = first.read_text().replace(
        f"journal {JOURNAL_VERSION}", f"journal {JOURNAL_VERSION + 1}", 1
    )
    first.write_text(newer)
    done = run(home, "newer")
    assert (done.returncode, "Traceback" in done.stderr) == (2, False)
    assert "was written by a newer tofpod" in done.stderr
    assert first.read_text() == newer


def test_a_lost_render_costs_what_needs_it(home, tmp_path, monkeypatch):
    """The damaged view cannot be rendered: hole-free trials end, the others are skipped, and run
    when it can be."""
    from harness.runs import job_batches

    monkeypatch.syspath_prepend(str(home / "plug_in"))
    experiment = load_experiment(home / "tiny.yaml", [REPEATS])
    plan = plan_of(experiment, home / "calm" / ".cache" / "renders")
    damaged = plan.groups[0].damaged.renders[0].target.to_data()
    real = job_batches.render_into_cache

    def refuses(target: dict, *rest: object) -> object:
        if target == damaged:
            raise UserError("no such view")
        return real(target, *rest)  # type: ignore[arg-type]

    monkeypatch.setattr(job_batches, "render_into_cache", refuses)
    outcome = run_serially(plan, tmp_path)
    assert (outcome.trials.done, outcome.trials.failed) == (6, 6)
    assert {failure.state for failure in outcome.failures} == {"failed", "skipped"}
    assert {failure.why for failure in outcome.failures} == {"no such view"}
    monkeypatch.setattr(job_batches, "render_into_cache", real)
    outcome = run_serially(plan, tmp_path)
    assert (outcome.trials.found, outcome.trials.done, outcome.failures) == (6, 6, [])
