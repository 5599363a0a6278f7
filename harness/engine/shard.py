"""One part of a sweep: `--shard 3/10` runs the third tenth, with no other process to talk to; and who may work in a
folder of results at the same time."""

from __future__ import annotations

import contextlib
import os
import re
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from harness.vocabulary.errors import UserError
from harness.vocabulary.locks import lock, opened_lock

T = TypeVar("T")
MOST = 100_000
LOCK = ".lock"


@dataclass(frozen=True)
class Shard:
    """Part ``number`` of ``count``, from 1.

    A shard runs a contiguous part of a plan's judged trials, so that few set-ups are touched by many shards. Every
    shard needs the hole-free trials that set its thresholds: it runs those that are not in its journal, beginning at a
    place of its own, so that shards with a common folder share them.
    """

    number: int = 1
    count: int = 1

    @classmethod
    def of(cls, text: str) -> Shard:
        """Parse text such as ``3/10``. Raises UserError."""
        found = re.fullmatch(r"([0-9]{1,6})/([0-9]{1,6})", text)
        shard = cls(int(found[1]), int(found[2])) if found else None
        if shard is None or not 1 <= shard.number <= shard.count <= MOST:
            raise UserError(f"--shard {text!r}: is no part of a whole", legal=f"1/10 to 10/10, for up to {MOST} parts")
        return shard

    @property
    def is_whole(self) -> bool:
        """Return whether there is no other part."""
        return self.count == 1

    def __str__(self) -> str:
        return f"{self.number}/{self.count}"

    def part(self, total: int) -> range:
        """The part of ``total`` things in a row that is this shard's; the parts of all shards are all, each once."""
        return range((self.number - 1) * total // self.count, self.number * total // self.count)

    def rotated(self, things: Sequence[T]) -> list[T]:
        """All things, beginning at this shard's own place."""
        start = (self.number - 1) * len(things) // self.count
        return [*things[start:], *things[:start]]


WHOLE = Shard()
"""All of a sweep."""


@contextlib.contextmanager
def locked(folder: Path, shard: Shard = WHOLE) -> Iterator[None]:
    """Hold a folder that exists. A whole sweep holds it alone; shards share it, but each part is run once at a time.

    Raises UserError where another process holds it. On systems without such locks (Windows, some network file systems)
    nothing is held, and a line on stderr says so.
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
            file.seek(0)
            said = file.read(20).strip()
            who = f" (process {said})" if said.isdigit() else ""
            raise UserError(
                f"{path.parent}: another sweep is at work in this folder{who}",
                fix="wait for it, or name another folder with --out",
            )
        if answer == "no locks":
            print(f"{path.parent}: cannot be locked on this system: start no second sweep in it", file=sys.stderr)
        file.truncate(0)
        if not shared:
            file.write(f"{os.getpid()}\n")
            file.flush()
        yield
        file.truncate(0)
