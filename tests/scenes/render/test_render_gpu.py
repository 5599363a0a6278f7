"""The render on a GPU gives what it gives on the processor. Skipped without an NVIDIA GPU."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from harness.vocabulary.system import has_nvidia_driver
from scenes.render.cache import read_view

ROOT = Path(__file__).resolve().parents[3]
SCRIPT = """
import sys
from pathlib import Path
from scenes.render.scene import _point_to_llvm
_point_to_llvm()
import mitsuba
mitsuba.set_variant(sys.argv[1])
from harness.runs.plan import plan_of
from harness.experiment.load import load_experiment
from scenes.render.cache import cached_view
from scenes.sensor.camera import camera_of
changes = [
    "source.render.bounces=1",
    "source.render.face_samples=64",
    "source.render.hole_samples=16",
]
experiment = load_experiment(Path("experiments/smoke.yaml"), changes)
job = plan_of(experiment, Path(sys.argv[2])).groups[0].damaged.renders[0]
cached_view(job.target, camera_of(job.camera).optics, job.config, job.folder)
"""


@pytest.mark.skipif(not has_nvidia_driver(), reason="no NVIDIA GPU")
def test_a_gpu_renders_the_same_view(tmp_path):
    views = []
    for variant in ("cuda_ad_mono", "llvm_ad_mono"):
        folder = tmp_path / variant
        done = subprocess.run(
            [sys.executable, "-c", SCRIPT, variant, str(folder)],
            cwd=ROOT,
            capture_output=True,
            text=True,
        )
        assert done.returncode == 0, done.stderr
        (path,) = folder.glob("*.npz")
        view = read_view(path)
        assert view is not None and view.variant == variant
        views.append(view)
    difference = np.abs(views[0].phasor - views[1].phasor) / np.abs(views[1].phasor).max()
    assert np.median(difference) < 1e-6
    # a ray that grazes an edge may hit it in one variant only: one of 256 or more sub-rays, or one
    # path, of few pixels
    assert np.mean(difference > 1e-4) < 0.01
    assert difference.max() < 0.05
