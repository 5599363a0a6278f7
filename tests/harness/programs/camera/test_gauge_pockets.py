"""Pockets of a gauge: their signals on a drawn face, and how many a camera file expects."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest
from scipy import stats

from harness.programs.camera.gauge_pockets import (
    PocketRow,
    PocketSignal,
    answer_of_pockets,
    pocket_signals,
)
from harness.records.schema import Estimate
from harness.stills.solid_gauge import SolidPocket
from harness.stills.spheres import range_image
from harness.vocabulary.geometry import MM, invert, rotate_vectors, transform_points
from tests.support.gauge_scene import LENS, exact_gauge, pose


class DrawnGauge:
    """The face of a gauge and its pockets, as sharp as pixels, by rays of the lens."""

    def __init__(self) -> None:
        self.gauge = exact_gauge()
        slopes = LENS.region_slopes(LENS.whole)
        self.image = range_image(np.ones((*slopes.shape[:2], 3)), slopes)
        normal = rotate_vectors(pose(), np.array([0.0, 0.0, 1.0]))
        self.face_m = (normal @ pose()[:3, 3]) / (self.image.rays @ normal)
        face_points_m = self.image.rays * self.face_m[..., None]
        self.on_gauge_mm = transform_points(invert(pose()), face_points_m)[..., :2] / MM
        self.depth_m = np.zeros(self.face_m.shape)
        for pocket in self.gauge.pockets:
            is_inside = self.away_mm(pocket) < pocket.diameter_mm / 2
            self.depth_m[is_inside] = pocket.depth_mm * MM

    def away_mm(self, pocket: SolidPocket) -> np.ndarray:
        """Distance (h, w) from the middle of a pocket on the face."""
        return np.linalg.norm(self.on_gauge_mm - [pocket.x_mm, pocket.y_mm], axis=-1)

    def signals(self, share: float, noise_m: np.ndarray) -> list[PocketSignal]:
        """The signals of pockets of which a share of the depth is seen."""
        seen_m = self.face_m + share * self.depth_m + noise_m
        shown = replace(self.image, range_m=seen_m)
        return list(pocket_signals(shown, self.gauge, pose(), self.face_m + self.depth_m))


@pytest.fixture(scope="module")
def drawn() -> DrawnGauge:
    return DrawnGauge()


@pytest.mark.parametrize(("blur_px", "least", "most"), [(0.0, 0.8, 1.2), (0.8, 0.5, 1.2)])
def test_signals_are_the_share_of_the_depth_and_as_certain_as_they_say(
    drawn: DrawnGauge, blur_px: float, least: float, most: float
) -> None:
    """Also if neighbours share their noise; then rather less so, by a third."""
    errors = []
    for seed in range(8):
        white = np.random.default_rng(seed).standard_normal(drawn.face_m.shape)
        noise = cv2.GaussianBlur(white, (0, 0), blur_px) if blur_px else white
        signals = drawn.signals(0.7, 0.4 * MM * noise / noise.std())
        assert len(signals) == len(drawn.gauge.pockets)
        by_name = {signal.pocket.name: signal for signal in signals}
        assert by_name["pocket 12 x 4"].is_seen
        errors += [(signal.share - 0.7) / signal.sigma for signal in signals]
    assert abs(np.mean(errors)) < 0.2
    assert least < np.std(errors) < most


def test_in_white_noise_a_signal_is_the_slope_of_a_line_and_its_standard_error(
    drawn: DrawnGauge,
) -> None:
    """As SciPy fits the range behind the face by the pocket's depth, with a level."""
    noise_m = 0.4 * MM * np.random.default_rng(0).standard_normal(drawn.face_m.shape)
    for signal in drawn.signals(0.7, noise_m):
        pocket = signal.pocket
        reach_mm = (pocket.diameter_mm / 2 + 2.5) * drawn.gauge.width_mm / 180
        near = drawn.away_mm(pocket) < reach_mm
        depth_m = drawn.depth_m[near]
        line = stats.linregress(depth_m, 0.7 * depth_m + noise_m[near])
        assert signal.share == pytest.approx(line.slope)
        assert signal.sigma == pytest.approx(line.stderr)
        assert signal.degrees == near.sum() - 2
        assert signal.ratio == pytest.approx(line.slope / line.stderr)


def test_the_answer_counts_pockets_beside_those_expected():
    pockets = exact_gauge().pockets
    rows = [PocketRow(pocket, 9.0, True, Estimate(0.5, 0.2, 0.8)) for pocket in pockets]
    # 10.5 +- (1.96 sqrt(21 / 4 (1 + 1/16)) + 0.5)
    assert answer_of_pockets(rows) == (
        "21 of 21 pockets are seen; the camera file expects 10.5 (5 to 16)."
    )
    certain = [PocketRow(pocket, 2.0, False, Estimate(1.0, 0.8, 1.0)) for pocket in pockets]
    assert answer_of_pockets(certain) == (
        "0 of 21 pockets are seen; the camera file expects 21.0 (20 to 21)."
    )
