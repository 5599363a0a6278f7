"""One sweep at a time works in a folder of results."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import IO

from harness.engine.shard import WHOLE, Shard
from harness.vocabulary.errors import UserError
from harness.vocabulary.locks import lock, opened_lock

LOCK = ".lock"


@contextlib.contextmanager
def locked(folder: Path, shard: Shard = WHOLE) -> Iterator[None]:
    """Hold a folder that exists. A whole sweep holds it alone; shards share it, but each part is run once at a time.

    Raises UserError where another process holds it. On systems without such locks (Windows, some network file systems)
    nothing is held, which is told on stderr.
    """
    with contextlib.ExitStack() as held:
        if shard.is_whole:
            held.enter_context(_held(folder / LOCK, shared=False))
        else:
            held.enter_context(_held(folder / LOCK, shared=True))
            held.enter_context(_held(folder / f"{LOCK}-{shard.number}-of-{shard.count}", shared=False))
        yield


@contextlib.contextmanager
def _held(path: Path, *, shared: bool) -> Iterator[None]:
    with opened_lock(path) as file:
        answer = lock(file, shared=shared, wait=False)
        if answer == "busy":
            raise UserError(
                f"{path.parent}: another sweep is at work in this folder{_who(file)}",
                fix="wait for it, or name another folder with --out",
            )
        if answer == "no locks":
            print(f"{path.parent}: is not locked, as this system cannot: start no second sweep in it", file=sys.stderr)
        file.truncate(0)
        if not shared:
            file.write(f"{os.getpid()}\n")
            file.flush()
        yield
        file.truncate(0)


def _who(file: IO[str]) -> str:
    file.seek(0)
    said = file.read(20).strip()
    return f" (process {said})" if said.isdigit() else ""
