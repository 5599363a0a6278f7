"""One part of a sweep: `--shard 3/10` runs the third tenth, with no other process to talk to."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

from harness.vocabulary.errors import UserError

T = TypeVar("T")
MOST = 100_000


@dataclass(frozen=True)
class Shard:
    """Part ``number`` of ``count``, from 1.

    Of the judged trials of a plan, in its order, it runs a contiguous part, so that few set-ups are touched by many
    shards. Hole-free trials that set a threshold are needed by every shard that judges by it: each runs those that are
    not in its journal, beginning at a place of its own, so that shards with a common folder share them.
    """

    number: int = 1
    count: int = 1

    @classmethod
    def of(cls, text: str) -> Shard:
        """From text such as ``3/10``. Raises UserError."""
        found = re.fullmatch(r"([0-9]{1,6})/([0-9]{1,6})", text)
        shard = cls(int(found[1]), int(found[2])) if found else None
        if shard is None or not 1 <= shard.number <= shard.count <= MOST:
            raise UserError(f"--shard {text!r}: is no part of a whole", legal=f"1/10 to 10/10, for up to {MOST} parts")
        return shard

    @property
    def is_whole(self) -> bool:
        """Whether there is no other part."""
        return self.count == 1

    def __str__(self) -> str:
        return f"{self.number}/{self.count}"

    def part(self, total: int) -> range:
        """Which of ``total`` things in a row are this shard's; the parts of all shards are all, each once."""
        return range((self.number - 1) * total // self.count, self.number * total // self.count)

    def rotated(self, things: Sequence[T]) -> list[T]:
        """All things, beginning at this shard's own place."""
        start = (self.number - 1) * len(things) // self.count
        return [*things[start:], *things[:start]]


WHOLE = Shard()
"""All of a sweep."""
