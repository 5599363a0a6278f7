"""What the tests on hostile files share: one message, in little time, with little memory."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from detectors.open3d_library import MissingLibrary, load_open3d
from detectors.recordings import open_capture
from harness.vocabulary import system
from harness.vocabulary.errors import UserError
from tests.support import recorded_plane as plane

SPARE_BYTES = 1 << 30
SECONDS = 120.0
"""Processor time that no refusal takes: some seconds are usual, and without the refusal it would
be hours."""
BOMB = "a0: &a0 [x,x,x,x,x,x,x,x,x,x]\n" + "".join(
    f"a{i}: &a{i} [{','.join([f'*a{i - 1}'] * 10)}]\n" for i in range(1, 30)
)
"""YAML whose aliases unfold to 10^30 values."""


@contextmanager
def little_memory() -> Iterator[None]:
    """What would unpack or believe a bomb fails with MemoryError, which is no UserError."""
    with suppress(MissingLibrary):
        load_open3d()
    with system.limited_memory(SPARE_BYTES):
        yield


def refusal(act: Callable[[], object]) -> str:
    """The message of what is refused."""
    began = time.process_time()
    with pytest.raises(UserError) as caught:
        act()
    assert time.process_time() - began < SECONDS
    assert len(str(caught.value)) < 40_000, "a message is to be read"
    return str(caught.value)


def capture_refusal(path: Path) -> str:
    """The message of opening a capture and reading it to its end."""
    return refusal(lambda: list(open_capture([path], lens=plane.LENS).frames()))
