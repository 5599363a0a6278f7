"""Parts of a sweep (`--shard 3/10`), and the lock of a results folder."""

from __future__ import annotations

import contextlib
import re
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeVar

from harness.vocabulary import system
from harness.vocabulary.errors import UserError
from harness.vocabulary.files import opened_lock

T = TypeVar("T")
MOST = 100_000
LOCK = ".lock"


@dataclass(frozen=True)
class Shard:
    """Part ``number`` (from 1) of ``count``: a contiguous part of a plan's judged trials, and all
    hole-free trials that set its thresholds. Each shard begins these at a different place, so that
    shards in one folder share them."""

    number: int = 1
    count: int = 1

    @classmethod
    def of(cls, text: str) -> Shard:
        """Parse text such as ``3/10``. Raises UserError."""
        match = re.fullmatch(r"([0-9]{1,6})/([0-9]{1,6})", text)
        shard = cls(int(match[1]), int(match[2])) if match else None
        if shard is None or not 1 <= shard.number <= shard.count <= MOST:
            raise UserError(
                f"--shard {text!r}: is not a part", legal=f"1/10 to 10/10, for up to {MOST} parts"
            )
        return shard

    @property
    def is_whole(self) -> bool:
        """Return whether this part is the whole sweep."""
        return self.count == 1

    def __str__(self) -> str:
        return f"{self.number}/{self.count}"

    def part(self, total: int) -> range:
        """Return this shard's range of ``total`` items; the ranges of all shards cover each item
        exactly once."""
        return range((self.number - 1) * total // self.count, self.number * total // self.count)

    def rotated(self, items: Sequence[T]) -> list[T]:
        """Return all items, beginning at this shard's own starting point."""
        start = self.part(len(items)).start
        return [*items[start:], *items[:start]]


WHOLE = Shard()


@contextlib.contextmanager
def locked(folder: Path, shard: Shard = WHOLE) -> Iterator[None]:
    """Lock an existing folder: for a whole sweep exclusively, for shards together, but only once
    for each shard. Raises UserError if another process holds it. Systems without locks continue,
    with a warning on stderr."""
    with _held(folder / LOCK, shared=not shard.is_whole):
        if shard.is_whole:
            yield
        else:
            with _held(folder / f"{LOCK}-{shard.number}-of-{shard.count}", shared=False):
                yield


@contextlib.contextmanager
def _held(path: Path, *, shared: bool) -> Iterator[None]:
    with opened_lock(path) as file:
        answer = system.lock(file, shared=shared, wait=False)
        if answer == "busy":
            message = f"{path.parent}: another sweep is running in this folder"
            raise UserError(message, fix="wait for it, or name another folder with --out")
        if answer == "no locks":
            print(
                (
                    f"{path.parent}: cannot be locked on this system: do not start a second "
                    "sweep in it"
                ),
                file=sys.stderr,
            )
        yield
