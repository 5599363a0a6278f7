"""Lens blur and stray light, on views known in closed form."""

from __future__ import annotations

import numpy as np
import pytest

from harness.vocabulary.geometry import Region
from scenes.closed_form import Plane, layered_view, plane_view
from scenes.sensor.amcw.imager import WIDE_PX, blur_weights, scattered
from scenes.sensor.camera import camera_of
from scenes.sensor.common.config import NO_EFFECTS, CameraConfig
from scenes.sensor.source import SimulatedUnit

REGION = Region(250, 330, 260, 380)


def z_of(view_of, **scatter: float) -> np.ndarray:
    numbers = {f"scatter.{key}": value for key, value in scatter.items()}
    config = CameraConfig(effects=NO_EFFECTS, edge_gate=False, numbers=numbers)
    camera = camera_of(config)
    (frame,) = SimulatedUnit(camera, config, view_of(camera)).capture(1, 1, "scatter").frames()
    return frame.z_m


def test_a_point_keeps_its_light_and_gets_the_declared_width():
    numbers = {
        "scatter.blur_px": 1.5,
        "scatter.stray_share": 0.2,
        "scatter.stray_px": 8.0,
    }
    facts = camera_of(CameraConfig(numbers=numbers)).scatter
    point = np.zeros((2, 101, 121), np.complex64)
    point[0, 50, 60] = 1.0
    point[1, 40, 70] = 2.0j
    spread = scattered(point, facts)
    v, u = np.mgrid[:101, :121]
    assert spread.sum(axis=(1, 2)) == pytest.approx([1.0, 2.0j], abs=1e-5)
    for coordinate, centre in ((u, 60), (v, 50)):
        variance = (spread[0].real * (coordinate - centre) ** 2).sum()
        assert variance == pytest.approx(0.8 * 1.5**2 + 0.2 * 8.0**2, rel=0.01)


def test_a_narrow_blur_takes_and_gives_light_once():
    for blur_px in (0.15, 0.45, 0.6, 1.4):
        weights = blur_weights(blur_px)
        assert weights.min() >= 0
        assert weights.sum() == pytest.approx(1.0, abs=1e-12)
        assert (weights == weights[::-1]).all()


def test_narrow_and_wide_blurs_meet():
    just_below = blur_weights(WIDE_PX - 1e-6)
    from_centre_px = np.arange(len(just_below)) - len(just_below) // 2
    samples = np.exp(-(from_centre_px**2) / (2 * WIDE_PX**2))
    assert just_below == pytest.approx(samples / samples.sum(), abs=0.002)


def test_light_of_all_paths_spreads_as_direct_light_does():
    """Before a step in closed form, which sends direct light only."""
    means = {}
    for multipath, blur_px in ((False, 1.0), (True, 1.0), (True, 0.0)):
        config = CameraConfig(
            effects=NO_EFFECTS.model_copy(update={"multipath": multipath}),
            numbers={"scatter.blur_px": blur_px},
        )
        camera = camera_of(config)
        region = Region(280, 300, 300, 330)
        middle = np.median(camera.nominal_lens.region_slopes(region)[..., 0])
        view = layered_view(
            camera,
            region,
            Plane(0.6),
            Plane(0.7),
            lambda slopes, middle=middle: slopes[..., 0] < middle,
            0.6,
        )
        means[multipath, blur_px] = SimulatedUnit(camera, config, view).exposure.means
    assert np.array_equal(means[False, 1.0], means[True, 1.0])
    assert not np.array_equal(means[True, 1.0], means[True, 0.0])


def test_stray_light_draws_a_near_patch_towards_its_surroundings():
    """A tenth of the light from far and wide: the phasor of what is 1.5 times as near and small
    keeps nine tenths."""

    def patch(camera):
        def covers(slopes: np.ndarray) -> np.ndarray:
            return np.asarray(np.abs(slopes + 0.03).max(axis=-1) < 0.012)

        return layered_view(
            camera,
            REGION,
            Plane(0.6),
            Plane(0.7),
            covers,
            0.6,
        )

    def far(camera):
        return plane_view(camera, REGION, 0.7, 0.6)

    clean = z_of(patch, stray_share=0.0, stray_px=30.0)
    stray = z_of(patch, stray_share=0.1, stray_px=30.0)
    middle = clean < 0.605
    assert middle.sum() > 20
    drawn = np.nanmedian(stray[middle]) - np.nanmedian(clean[middle])
    # a tenth of light that is (0.6 / 0.7)^2 as strong and 0.1 m farther, by the smallest and
    # largest frequency's rule
    assert 0.002 < drawn < 0.012
    assert np.abs(z_of(far, stray_share=0.1, stray_px=30.0) - z_of(far)).max() < 0.0011
