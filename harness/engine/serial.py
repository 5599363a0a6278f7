"""Everything in this process, in order, for debuggers and tests; a job that hangs or kills it is not survived."""

from __future__ import annotations

import contextlib
from collections import deque

from harness.engine.processes import one_thread
from harness.engine.work import Ended, Job, Stage, attempt


class SerialEngine:
    """One job at a time, here. No limits of time and memory hold."""

    def __init__(self) -> None:
        self._jobs: deque[Job] = deque()
        self._pinned = contextlib.ExitStack()

    def __enter__(self) -> SerialEngine:
        import cv2
        from threadpoolctl import threadpool_limits

        # libraries that are loaded later read the environment, those that are loaded by now are asked
        self._pinned.enter_context(one_thread())
        self._pinned.enter_context(threadpool_limits(1))
        threads = cv2.getNumThreads()
        cv2.setNumThreads(1)
        self._pinned.callback(cv2.setNumThreads, threads)
        return self

    def __exit__(self, *error: object) -> None:
        self._jobs.clear()
        self._pinned.close()

    def room(self, stage: Stage) -> int:
        """One job at a time."""
        return 1 - len(self._jobs)

    def submit(self, job: Job) -> None:
        """Take a job; it runs in `ended`."""
        self._jobs.append(job)

    def ended(self) -> list[tuple[Job, Ended]]:
        """Run the next job."""
        job = self._jobs.popleft()
        if job.stage == "renders":
            # Mitsuba must be loaded before Open3D in one process (`scenes.render.variant`)
            from scenes.render.variant import load_mitsuba

            load_mitsuba()
        return [(job, attempt(job, "this process"))]
