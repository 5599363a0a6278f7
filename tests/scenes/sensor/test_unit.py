"""What a unit's frames share, and what moves them."""

from __future__ import annotations

from itertools import islice

import numpy as np
import pytest
from scipy import stats

from harness.vocabulary.geometry import Region
from scenes.closed_form import plane_view
from scenes.sensor.camera import load_camera
from scenes.sensor.common.config import NO_EFFECTS, CameraConfig, EffectsConfig
from scenes.sensor.common.facts import UnitFacts
from scenes.sensor.common.unit import frame_errors_m, light_of, rays_of, taps_of
from scenes.sensor.source import SimulatedUnit

ONLY_JUMPS = NO_EFFECTS.model_copy(update={"frame_jumps": True})
AZURE = load_camera("azure_kinect_nfov")


def unit_facts(**values: float) -> UnitFacts:
    """Facts of a unit that does nothing but what the values say."""
    numbers = {
        "frames_per_second": 30.0,
        "offset_mm": 0.0,
        "drift_mm": 0.0,
        "drift_min": 20.0,
        "drift_ramp": 0.0,
        "jump_rate": 0.0,
        "jump_mm": 0.0,
        "jitter_mm": 0.0,
        **values,
    }
    data = {key: {"value": value, "tag": "M", "source": "s"} for key, value in numbers.items()}
    return UnitFacts.from_data(data)


def errors_mm(facts: UnitFacts, count: int, effects: EffectsConfig = ONLY_JUMPS) -> np.ndarray:
    errors_m = frame_errors_m(
        facts, effects, minutes=0.0, jitter_mm=facts.jitter_mm.value, rng=np.random.default_rng(2)
    )
    return 1e3 * np.array(list(islice(errors_m, count)))


def test_frames_jump_as_often_either_way():
    """Of 4,000 frames 30 % jump, half of them away: binomial intervals of 99.9 %."""
    shift_mm = errors_mm(unit_facts(jump_rate=0.3, jump_mm=17.0), 4000)
    assert set(np.round(shift_mm, 6)) == {-17.0, 0.0, 17.0}
    jumps = int((shift_mm != 0).sum())
    farther = int((shift_mm > 0).sum())
    assert stats.binomtest(jumps, 4000, 0.3).pvalue > 0.001
    assert stats.binomtest(farther, jumps, 0.5).pvalue > 0.001


def test_jitter_moves_every_frame():
    """A deviation of 2,000 frames is known to 1.6 %."""
    shift_mm = errors_mm(unit_facts(jitter_mm=0.25), 2000)
    assert shift_mm.std() == pytest.approx(0.25, rel=0.06)
    assert abs(shift_mm.mean()) < 4 * 0.25 / np.sqrt(2000)
    # a jump comes on top
    jumping = errors_mm(unit_facts(jitter_mm=0.25, jump_rate=1.0, jump_mm=17.0), 200)
    assert (np.abs(np.abs(jumping) - 17.0) < 1.25).all()


def test_frames_that_neither_jump_nor_drift_stay():
    facts = unit_facts(jitter_mm=0.25, jump_rate=0.5, jump_mm=17.0, drift_mm=5.0)
    assert (errors_mm(facts, 20, NO_EFFECTS) == 0).all()


def test_rays_by_hand():
    """A ray of slopes (3/4, 0) has the direction (3, 0, 4) / 5."""
    slopes = np.array([0.75, 0.0]).reshape(1, 1, 2)
    along_m, cosine = rays_of(slopes, np.array([10.0, 7.0, 5.0]))
    assert along_m[0, 0] == pytest.approx(0.6 * 10 + 0.8 * 5)
    assert cosine[0, 0] == pytest.approx(0.8)


@pytest.mark.parametrize(
    "correlation",
    [
        [1.0, 0.5],
        [1.0, 2 / 3, 1 / 3],
        [1.0, 0.8, 0.6, 0.4, 0.2],
    ],
)
def test_taps_give_white_noise_their_correlation(correlation):
    taps = taps_of(np.array(correlation)).astype(float)
    assert (taps**2).sum() == pytest.approx(1, abs=1e-6)
    lags = np.correlate(taps, taps, "full")[len(taps) - 1 :]
    lags = np.append(lags, np.zeros(8))[: len(correlation) + 1]
    assert lags == pytest.approx([*correlation, 0.0], abs=0.03)
    # of minimum phase: no other filter has its energy so early
    assert np.abs(np.roots(taps)).max() < 1.01


def test_light_without_multipath_is_the_direct_light():
    view = plane_view(AZURE, Region(300, 310, 300, 310), 1.0, 0.6)
    phasor, intensity = light_of(view, NO_EFFECTS)
    assert phasor is view.phasor_direct
    longest = np.abs(view.phasor_direct).max(axis=0)
    assert intensity == pytest.approx(np.minimum(longest, view.intensity))
    dim = np.full(view.intensity.shape, 1e-3)
    object.__setattr__(view, "intensity", dim)
    assert light_of(view, NO_EFFECTS)[1] == pytest.approx(dim)
    all_phasor, all_intensity = light_of(view, EffectsConfig())
    assert all_phasor is view.phasor
    assert all_intensity is view.intensity


def test_a_unit_leaves_out_the_margin_but_at_the_sensors_border():
    """The filter's window of 5 pixels reaches 2 beyond a pixel, and the lens's blur 2 further."""
    outer = Region(0, 40, 100, 150)
    unit = SimulatedUnit(AZURE, CameraConfig(), plane_view(AZURE, outer, 1.0, 0.6))
    margin = AZURE.optics.margin_px
    assert margin == 4
    assert unit.region == Region(0, 40 - margin, 100 + margin, 150 - margin)
    corner = Region(540, 576, 600, 640)
    unit = SimulatedUnit(AZURE, CameraConfig(), plane_view(AZURE, corner, 1.0, 0.6))
    assert unit.region == Region(540 + margin, 576, 600 + margin, 640)
