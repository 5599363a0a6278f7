"""The rendered edge beside planes in closed form, which have the same direct light."""

from __future__ import annotations

import numpy as np
import pytest

from harness.programs.scorecard.bench import FULL, Bench
from harness.programs.scorecard.quantities import SLANT
from harness.programs.scorecard.shadows import rendered_step
from scenes.closed_form import Plane, layered_view


@pytest.mark.parametrize(("axis", "sign"), [(0, 1.0), (0, -1.0), (1, 1.0)])
def test_direct_light_and_shadow_are_those_of_planes(axis: int, sign: float) -> None:
    bench = Bench("azure_kinect_nfov", FULL)
    camera = bench.camera
    lens = camera.nominal_lens
    region = bench.patch(24, 64) if axis == 0 else bench.patch(64, 24)
    rendered = rendered_step(
        camera,
        region,
        axis=axis,
        sign=sign,
        slant=SLANT,
        distance_m=0.6,
        step_mm=900.0,
        front_mm=500.0,
        front_albedo=0.4,
        wall_albedo=0.4,
        floor_below_m=1.0,
    )

    def covers(slopes: np.ndarray) -> np.ndarray:
        px = slopes * np.array([lens.fx, lens.fy])
        return np.asarray(sign * (px[..., axis] - SLANT * px[..., 1 - axis]) < 0)

    planes = layered_view(camera, region, Plane(0.6), Plane(1.5), covers, 0.4)
    direct = np.abs(rendered.phasor_direct[0])
    expected = np.abs(planes.phasor[0])
    bright = expected > 0.1 * expected.max()
    assert direct[bright] == pytest.approx(expected[bright], rel=0.05)
    dark = expected == 0
    assert (direct[dark] < 0.01 * expected.max()).all()
    if axis == 0 and sign > 0:
        # light by way of several surfaces reaches the shadow
        assert dark.any()
        assert np.abs(rendered.phasor[0])[dark].mean() > 1e-4 * expected.max()
