"""Batches of jobs on an engine: carried out, with their values, renders and pictures."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from typing import Any

from harness.runs.jobs import Ended, Failure, Job, JobEngine, Outcome
from harness.runs.plan import RenderJob
from harness.runs.processes import render_into_cache
from scenes.render.cache import read_view


def carried_out(jobs: Iterable[Job], engine: JobEngine) -> Iterator[tuple[Job, Ended]]:
    """Run jobs; yield each with its end, in the order in which they end.

    The first jobs start with this call, not when the iterator is first used.
    """
    waiting = deque(jobs)

    def started() -> int:
        """Start the jobs for which there is room, and return their number."""
        count = len(waiting)
        while waiting and engine.room(waiting[0].stage) > 0:
            engine.submit(waiting.popleft())
        return count - len(waiting)

    def ends(under_way: int) -> Iterator[tuple[Job, Ended]]:
        while waiting or under_way:
            for job, ended in engine.ended():
                under_way -= 1
                yield job, ended
            under_way += started()

    return ends(started())


def values_of(
    function: Callable[..., Any], arguments: Iterable[tuple[Any, ...]], engine: JobEngine
) -> list[Any]:
    """Return the values of a function of each of several arguments, None for a user's mistake.

    A bug is raised."""
    jobs = []
    for number, job_arguments in enumerate(arguments):
        jobs.append(Job(str(number), "trials", function, job_arguments))
    ends = {job.name: ended for job, ended in carried_out(jobs, engine)}
    for ended in ends.values():
        if ended.is_bug and ended.why:
            raise RuntimeError(ended.why)
    return [ends[job.name].value for job in jobs]


def render_job(render: RenderJob) -> Job:
    """Return the job that renders a view into the cache, named after its file."""
    arguments = (
        render.target.to_data(),
        render.camera.to_data(),
        render.config.to_data(),
        str(render.folder),
    )
    return Job(render.path.name, "renders", render_into_cache, arguments)


def render_missing(renders: Iterable[RenderJob], engine: JobEngine) -> list[Failure]:
    """Render views that the cache lacks or holds damaged.

    Returns a failure for each view that could not be rendered."""
    by_path = {render.path: render for render in renders}
    missing = [render for render in by_path.values() if read_view(render.path) is None]
    failures = []
    for job, ended in carried_out(map(render_job, missing), engine):
        if ended.state != "done":
            failures.append(failure_of(lost_view(job.name), ended))
    return failures


def pictures_from(jobs: Sequence[Job], engine: JobEngine, outcome: Outcome) -> Iterator[Any]:
    """Start jobs that draw pictures again; return an iterator over all pictures in the order of
    the jobs. While it is used, jobs that failed are added to the outcome."""
    ends = carried_out(jobs, engine)

    def pictures() -> Iterator[Any]:
        by_name = {job.name: ended for job, ended in ends}
        for job in jobs:
            ended = by_name[job.name]
            if ended.state == "done":
                yield from ended.value
            else:
                outcome.failures.append(failure_of(job.name, ended))

    return pictures()


def lost_view(file_name: str) -> str:
    """Return the label of the failure of a view that a picture needs."""
    return f"view {file_name} for a picture"


def failure_of(label: str, ended: Ended) -> Failure:
    """Return the failure that reports how a job ended."""
    return Failure(label, ended.why, ended.is_bug, ended.state)
