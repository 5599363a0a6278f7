"""Pockets of a gauge: their signals on a drawn face, and how many a camera file expects."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from harness.programs.camera.gauge_pockets import PocketRow, answer_of_pockets, pocket_signals
from harness.records.schema import Estimate
from harness.stills.spheres import range_image
from harness.vocabulary.geometry import MM, invert, rotate_vectors, transform_points
from tests.support.gauge_scene import LENS, exact_gauge, pose


@pytest.mark.parametrize(("blur_px", "least", "most"), [(0.0, 0.8, 1.2), (0.8, 0.5, 1.2)])
def test_signals_are_the_share_of_the_depth_and_as_certain_as_they_say(blur_px, least, most):
    """Also if neighbours share their noise; then rather less so, by a third."""
    gauge = exact_gauge()
    slopes = LENS.region_slopes(LENS.whole)
    image = range_image(np.ones((*slopes.shape[:2], 3)), slopes)
    normal = rotate_vectors(pose(), np.array([0.0, 0.0, 1.0]))
    face_m = (normal @ pose()[:3, 3]) / (image.rays @ normal)
    on_gauge_mm = transform_points(invert(pose()), image.rays * face_m[..., None]) / MM
    depth_m = np.zeros(face_m.shape)
    for pocket in gauge.pockets:
        off_mm = np.linalg.norm(on_gauge_mm[..., :2] - [pocket.x_mm, pocket.y_mm], axis=-1)
        depth_m[off_mm < pocket.diameter_mm / 2] = pocket.depth_mm * MM
    errors = []
    for seed in range(8):
        white = np.random.default_rng(seed).standard_normal(face_m.shape)
        noise = cv2.GaussianBlur(white, (0, 0), blur_px) if blur_px else white
        noise_m = 0.4 * MM * noise / noise.std()
        shown = replace(image, range_m=face_m + 0.7 * depth_m + noise_m)
        signals = list(pocket_signals(shown, gauge, pose(), face_m + depth_m))
        assert len(signals) == len(gauge.pockets)
        by_name = {signal.pocket.name: signal for signal in signals}
        assert by_name["pocket 12 x 4"].is_seen
        errors += [(signal.share - 0.7) / signal.sigma for signal in signals]
    assert abs(np.mean(errors)) < 0.2
    assert least < np.std(errors) < most


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
