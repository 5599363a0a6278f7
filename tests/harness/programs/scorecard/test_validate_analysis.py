"""The scorecard's measurements on data whose truth is known."""

from __future__ import annotations

import numpy as np
import pytest

from harness.programs.scorecard.bench import Bench, Effort
from harness.programs.scorecard.quantities import QUANTITIES
from harness.vocabulary.geometry import Region
from scenes.closed_form import Plane, layered_view, plane_view
from scenes.sensor.camera import camera_of
from scenes.sensor.common.config import CameraConfig

AZURE = "azure_kinect_nfov"
QUICK = Effort(noise_frames=20, few_frames=4, whole_frames=80, units=4)
PINHOLE = camera_of(
    CameraConfig(name=AZURE, numbers={"lens.distortion": [0.0] * 8, "lens.cx_px": 320.0})
)
"""An Azure Kinect whose pixels are evenly spaced, so that widths can be worked out by hand."""


# ---- views of steps
# ------------------------------------------------------------------------------------------------

REGION = Region(300, 330, 280, 360)


def half(edge_slope: float, sign: float = 1.0):  # type: ignore[no-untyped-def]
    return lambda slopes: sign * (slopes[..., 0] - edge_slope) < 0


def test_a_front_that_is_everywhere_or_nowhere_is_a_plane():
    """Averaging over the footprint turns the light by what z bends within a pixel: far below
    1e-4."""
    front = Plane(0.8, 0.1)
    back = Plane(1.1)
    for covers, plane in (
        (lambda s: np.ones(s.shape[:-1], bool), front),
        (lambda s: s[..., 0] > 9, back),
    ):
        view = layered_view(PINHOLE, REGION, front, back, covers, 0.6)
        alone = plane_view(PINHOLE, REGION, plane.distance_m, 0.6, plane.slope_x)
        assert np.abs(view.phasor / alone.phasor - 1).max() < 1e-4
        assert (view.coverage == 1).all()
        assert view.range_m == pytest.approx(alone.range_m, abs=1e-12)


def test_an_edge_within_a_pixel_mixes_phasors_by_area():
    """The edge a quarter into column 320: a quarter of the front's light and three of the back's,
    to 1/12 pixel."""
    edge = (320 - 0.25 - 320.0) / PINHOLE.nominal_lens.fx
    front = Plane(0.75)
    back = Plane(0.95)
    view = layered_view(PINHOLE, REGION, front, back, half(edge, sign=-1.0), 0.6)
    alone = [plane_view(PINHOLE, REGION, plane.distance_m, 0.6).phasor for plane in (front, back)]
    column = 320 - REGION.col0
    mixed = 0.75 * alone[0][:, :, column] + 0.25 * alone[1][:, :, column]
    assert np.abs(view.phasor[:, :, column] / mixed - 1).max() < 0.05
    assert view.coverage[:, column] == pytest.approx(0.75, abs=1 / 12)
    assert (view.surface[:, : column - 1] == 1).all()
    assert (view.surface[:, column:] == 0).all()


def test_the_shadow_is_as_wide_as_the_emitter_says():
    """The line from the emitter by the edge ends the shadow on the back; on the other side of the
    front is none.

    The edge lies between two columns, so that no pixel is partly front; sub-rays tell the shadow's
    end to 1/12 pixel.
    """
    front = Plane(0.75)
    back = Plane(0.95)
    lit = plane_view(PINHOLE, REGION, 0.95, 0.6).intensity
    lens = PINHOLE.nominal_lens
    e_x, _, e_z = PINHOLE.optics.emitter_m
    edge = 0.5 / lens.fx
    x_edge = edge * 0.75
    x_end = x_edge + (x_edge - e_x) * 0.2 / (0.75 - e_z)
    for sign, wanted in ((1.0, (x_end / 0.95 - edge) * lens.fx), (-1.0, 0.0)):
        view = layered_view(PINHOLE, REGION, front, back, half(edge, sign), 0.6)
        assert (view.coverage == 1).all()
        dark = np.where(view.surface == 1, 1 - view.intensity / lit, 0)
        assert dark.sum(axis=1) == pytest.approx(wanted, abs=1 / 12)
    assert x_end / 0.95 * lens.fx > 2.4


# ---- the bench
# ------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def bench() -> Bench:
    return Bench(AZURE, QUICK)


def value(bench: Bench, name: str, **conditions: object) -> float:
    quantity = QUANTITIES[name]
    return quantity.measure(bench, quantity.conditions.from_data(conditions)).value


def test_the_calibration_point_comes_out(bench):
    assert value(bench, "temporal_sigma_mm") == pytest.approx(0.89, abs=0.06)


def test_noise_grows_with_distance_angle_and_darkness(bench):
    assert value(bench, "temporal_sigma_mm", distance_m=3.0) > 1.5 * value(
        bench, "temporal_sigma_mm"
    )
    assert value(bench, "temporal_sigma_mm", angle_deg=60) > 1.2 * value(bench, "temporal_sigma_mm")
    assert value(bench, "temporal_sigma_mm", albedo=0.1) > 2 * value(bench, "temporal_sigma_mm")


def test_what_the_camera_does_not_see_has_no_number(bench):
    # noise alone passes all gates in one of some thousand pixels
    assert value(bench, "valid_fraction", distance_m=15.0, albedo=0.05) < 0.001
    assert np.isnan(value(bench, "temporal_sigma_mm", distance_m=15.0, albedo=0.05))


def test_a_shadow_is_a_gap_of_its_width(bench):
    """80 mm aside, a step of 500 mm at 0.75 m: 32 mm at 1.25 m, 15.6 px; the filter takes up to
    two on each side, the lens's blur half of one."""
    v2 = Bench("kinect_v2", bench.effort)
    lit = value(v2, "edge_gap_px", step_mm=500, shadow=False)
    shadowed = value(v2, "edge_gap_px", step_mm=500, shadow=True)
    assert lit < 0.5
    assert 10.6 < shadowed < 15.6
    assert value(bench, "edge_gap_px", step_mm=20) == 0
