"""What renders and trials take here, beside what `harness.engine.costs` tells of them: ``python
tests/validation/cost_rates.py``. Some three minutes on a quiet machine; on a busy one times say nothing.

The numbers of that module are right for the reference machine while the last column lies about 1.
"""

from __future__ import annotations

import os
import sys
import tempfile
import time
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
sys.path.insert(0, str(ROOT))
for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(name, "1")

from scenes.render.variant import load_mitsuba  # noqa: E402

load_mitsuba()  # before anything loads Open3D

from harness.engine.costs import (  # noqa: E402
    Taken,
    render_cost,
    trial_cost,
)
from harness.engine.journal import record_text  # noqa: E402
from harness.engine.plan import Batch, Group, plan_of  # noqa: E402
from harness.engine.trial import run_trial  # noqa: E402
from harness.experiment.load import load_experiment  # noqa: E402
from scenes.render.cache import cached_view  # noqa: E402
from scenes.sensor.camera import camera_of  # noqa: E402

THESIS, STUDY, MAPS = "averaging", "detection_limit", "perspectives"
ONE = ["sensitivity=null", "sweep={}"]
CASES = {
    "averaging, 6 counts": (THESIS, ["sensitivity=null"]),
    "averaging, 50 frames": (THESIS, ONE),
    "averaging, 0.5 m": (THESIS, [*ONE, "source.target.distance_m=0.5"]),
    "averaging, Kinect v2": (THESIS, [*ONE, "source.camera.name=kinect_v2", "source.target.distance_m=0.75"]),
    "averaging, L515": (THESIS, [*ONE, "source.camera.name=realsense_l515", "source.target.distance_m=0.75"]),
    "study, 1 and 50 frames": (STUDY, []),
    "study, 1 frame": (STUDY, ["sweep={}", "capture.frames=1"]),
    "study, Kinect v2": (STUDY, ["sweep={}", "source.camera.name=kinect_v2"]),
    "study, L515": (STUDY, ["sweep={}", "source.camera.name=realsense_l515"]),
    "study, 1.5 m": (STUDY, ["sweep={}", "source.target.distance_m=1.5"]),
    "perspectives, 5 views": (
        MAPS,
        ["sensitivity=null", "sweep={mapping.registration.method: [marks, icp]}", "source.views.count=5"],
    ),
}
REPEATS = 3


def main() -> None:
    """Print a table: taken, told, and their ratio, by case, role and stage."""
    sums: dict[str, Taken] = {}
    print(f"{'case':26} {'role':12} {'stage':7} {'taken':>9} {'told':>9} {'ratio':>6}")
    with tempfile.TemporaryDirectory() as folder:
        for name, (experiment, overrides) in CASES.items():
            plan = plan_of(load_experiment(ROOT / "experiments" / f"{experiment}.yaml", overrides), Path(folder))
            group = plan.groups[0]
            for batch in (group.first[0], group.then[0]):
                for stage, taken, told in measured(group, batch):
                    print(
                        f"{name:26} {batch.role:12} {stage:7} {taken:9.3g} {told:9.3g} {taken / told:6.2f}", flush=True
                    )
                    before = sums.get(stage, Taken())
                    sums[stage] = Taken(before.expected + told, before.taken + taken, before.runs + 1)
    for stage, one in sums.items():
        print(f"{'all':26} {'':12} {stage:7} {one.taken:9.3g} {one.expected:9.3g} {one.ratio:6.2f}")


def measured(group: Group, batch: Batch) -> list[tuple[str, float, float]]:
    """(stage, taken, told) of a batch: its renders, a trial whose set-up is loaded, and its record."""
    jobs = batch.renders
    views = [cached_view(job.target, camera_of(job.camera).optics, job.config, job.folder) for job in jobs]
    thresholds = {} if batch in group.first else {point.digest: 6.0 for point in group.points}
    _, task = next(iter(group.trials(batch, thresholds)))
    run_trial(task)
    seconds = []
    for _ in range(REPEATS):
        began = time.perf_counter()
        record = run_trial(task)
        seconds.append(time.perf_counter() - began)
    told = trial_cost(group, batch, 0)  # no process loads a set-up
    return [
        ("render", sum(view.seconds for view, _ in views), sum(render_cost(job).seconds for job in jobs)),
        ("trial", min(seconds), told.seconds),
        ("bytes", float(len(record_text(record))), told.size_bytes),
    ]


if __name__ == "__main__":
    main()
