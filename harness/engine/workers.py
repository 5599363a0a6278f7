"""Processes: one that renders (it alone loads Mitsuba), and some that run trials."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from typing import Any

ONE_THREAD = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS")
"""One thread a worker: sums are then in one order on every machine, and workers do not fight for cores."""


LOOKS_S = 1.0
"""Between looks whether the driver is still there."""


@contextmanager
def pool(workers: int) -> Iterator[ProcessPoolExecutor]:
    """Workers that start afresh (no fork of a process with threads), leave Ctrl-C to the driver, and end at once when
    the driver leaves early, within `LOOKS_S` even where it was killed."""
    before = {name: os.environ.get(name) for name in ONE_THREAD}
    os.environ.update(dict.fromkeys(ONE_THREAD, "1"))
    context = multiprocessing.get_context("spawn")
    executor = ProcessPoolExecutor(workers, mp_context=context, initializer=_serve_the_driver)
    finished = False
    try:
        yield executor
        finished = True
    finally:
        for name, value in before.items():
            os.environ.pop(name, None) if value is None else os.environ.update({name: value})
        processes = list((executor._processes or {}).values())
        executor.shutdown(wait=finished, cancel_futures=True)
        if not finished:
            for process in processes:
                process.kill()


def _serve_the_driver() -> None:
    """Of a worker: Ctrl-C is the driver's to hear, and without a driver there is nothing to do."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with, args=(os.getppid(),), daemon=True).start()


def _end_with(driver: int) -> None:
    """End this process soon after its parent is another than ``driver``: a killed driver cannot tell its workers."""
    while os.getppid() == driver:
        time.sleep(LOOKS_S)
    os._exit(1)


def render(
    target_data: dict[str, Any], camera_data: dict[str, Any], render_data: dict[str, Any], folder: str
) -> tuple[bool, float]:
    """Render a view into the cache, in a process of its own. Returns whether it was there, and its seconds."""
    from pathlib import Path

    from scenes.render.cache import cached_view
    from scenes.render.settings import RenderConfig
    from scenes.sensor.camera import CameraConfig, camera_of
    from scenes.target.custom import TargetConfig

    target, optics = TargetConfig.from_data(target_data), camera_of(CameraConfig.from_data(camera_data)).optics
    view, found = cached_view(target, optics, RenderConfig.from_data(render_data), Path(folder))
    return found, view.seconds
