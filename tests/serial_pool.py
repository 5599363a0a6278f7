"""The engine without processes: work is done as it is submitted, here and in order."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import contextmanager
from typing import Any


class SerialPool:
    """What the engine asks of its pools."""

    def submit(self, work: Callable[..., Any], *arguments: Any) -> Future[Any]:
        future: Future[Any] = Future()
        try:
            future.set_result(work(*arguments))
        except Exception as error:
            future.set_exception(error)
        return future


@contextmanager
def serial_pool(_count: int) -> Iterator[SerialPool]:
    """To put in the place of `harness.engine.workers.pool`."""
    yield SerialPool()
