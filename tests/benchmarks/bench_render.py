"""Speed of a rendered view: ``pytest tests/benchmarks/bench_render.py --benchmark-only``, on all cores, warm kernels.

Nothing here asserts a time. What the time buys stands in ``tests/validation/transport.py``.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from harness.vocabulary.geometry import Lens
from scenes.optics import Optics, RenderConfig, footprint_of
from scenes.render.direct import direct_light
from scenes.render.scene import lit_scene, load_mitsuba
from scenes.render.view import face_triangles, render_view, target_region
from scenes.sensor.camera import load_camera
from scenes.target.mesh import Target, build_target
from scenes.target.thesis import ThesisTargetConfig

AZURE = load_camera("azure_kinect_nfov").optics
SCANNER = replace(
    AZURE,
    lens=Lens(1024, 768, 731.0, 731.0, 511.5, 383.5),
    full_half_angle_deg=50.0,
    cutoff_half_angle_deg=55.0,
    frequencies_hz=tuple(25e6 * k for k in range(1, 33)),
    beam_fwhm_rad=2e-3,
)
"""As fine as a scanner of 1024 x 768 beams, with 32 lines of a comb."""


def thesis(**facts: Any) -> Target:
    return build_target(ThesisTargetConfig.from_data({"name": "thesis", **facts}).declare())


@pytest.mark.parametrize(
    ("optics", "facts"),
    [
        (AZURE, {"hole_kind": "blind"}),
        (AZURE, {"backing_distance_mm": 20.0}),
        (AZURE, {"backing_distance_mm": 50.0}),
        (SCANNER, {"backing_distance_mm": 20.0}),
    ],
    ids=["imager blind", "imager 20 mm", "imager 50 mm", "scanner 20 mm"],
)
def test_bench_view(benchmark: Any, optics: Optics, facts: dict[str, Any]) -> None:
    """A whole view of the thesis target at 0.7 m."""
    target = thesis(**facts)
    view = benchmark.pedantic(lambda: render_view(target, optics, RenderConfig()), rounds=3, warmup_rounds=1)
    benchmark.extra_info["pixels"] = view.range_m.size
    assert np.isfinite(view.phasor).all()


@pytest.mark.parametrize("optics", [AZURE, SCANNER], ids=["imager", "scanner"])
def test_bench_direct(benchmark: Any, optics: Optics) -> None:
    """The direct part alone."""
    target = thesis()
    lit = lit_scene(load_mitsuba(), target.parts, optics, face_triangles(target))
    region = target_region(target, optics)
    slopes, footprint = optics.lens.region_slopes(region), footprint_of(optics.lens, region, optics.footprint)
    light = benchmark.pedantic(
        lambda: direct_light(lit, slopes, footprint, optics.frequencies_hz), rounds=3, warmup_rounds=1
    )
    assert np.isfinite(light.phasor).all()
