"""Open3D with one thread: sums in one order, hence the same bits whatever the number of cores."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from detectors.recordings.pointclouds import _open3d


@contextmanager
def open3d_on_one_thread() -> Iterator[Any]:
    """The module open3d, silent and on one OpenMP thread within the block. Raises MissingLibrary where it cannot start.

    On pictures of a target's size a second thread gains nothing, and loses tenfold where cores are shared.
    """
    import threadpoolctl  # type: ignore[import-untyped]

    o3d = _open3d()
    quiet = o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error)
    with threadpoolctl.threadpool_limits(1, user_api="openmp"), quiet:
        yield o3d
