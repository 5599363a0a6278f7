"""Jobs that end in every way that a job can end; and a detector that does so when it is told to."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import numpy as np


def double(value: float) -> float:
    return 2 * value


def raises() -> None:
    raise ValueError("a bug")


def refuses() -> None:
    from harness.vocabulary.errors import UserError

    raise UserError("a mistake", legal="none", fix="mend it")


def kills_its_process() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def hangs() -> None:
    while True:
        time.sleep(0.05)


def eats_memory() -> float:
    """More than any limit of these tests, in steps."""
    kept = [np.empty(25_000_000) for _ in range(1000)]
    return float(len(kept))


def aborts() -> None:
    os.abort()


def imported() -> list[str]:
    import sys

    return sorted(name for name in ("mitsuba", "drjit", "open3d") if name in sys.modules)


FAULTS = {
    "raise": raises,
    "kill": kills_its_process,
    "hang": hangs,
    "eat": eats_memory,
    "abort": aborts,
}
FOLDER = "TOFPOD_TEST_FAULTS"


def commit_a_fault(kind: str) -> None:
    """Take one of the files of a kind that a test has put into the folder named by the
    environment, and do as its name says; each is done once, by whoever is first."""
    folder = os.environ.get(FOLDER)
    for name, fault in FAULTS.items() if folder else ():
        for path in sorted(Path(str(folder)).glob(f"{kind}-{name}*")):
            try:
                path.unlink()
            except FileNotFoundError:
                continue
            fault()


def dies_at_once(*_arguments: object) -> None:
    """In the place of what a worker process does."""
    os._exit(7)


def finds_the_disk_full() -> None:
    from harness.vocabulary.errors import DiskFull

    raise DiskFull("x.npz: the disk is full", fix="free some space")


def works(seconds: float) -> None:
    """Keep a processor busy for as long."""
    until_s = time.process_time() + seconds
    while time.process_time() < until_s:
        pass
