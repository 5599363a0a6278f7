"""Measurements: extents by hand, the blurred disc against brute force, standard errors against simulation."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from pydantic import ValidationError

from detectors.hole_model import blurred_disc
from detectors.interface import Detection, Evidence, Measurement
from detectors.measure import HoleModelConfig, extents, measure_detection
from harness.vocabulary.capture import Cloud
from harness.vocabulary.geometry import Region

FOCAL_PX = 504.0
HEIGHT, WIDTH = 60, 70
REGION = Region(100, 100 + HEIGHT, 200, 200 + WIDTH)
MIDDLE = (250.0, 120.0)
"""Principal point (u, v) on the sensor."""


def test_extents_of_a_hand_made_cluster() -> None:
    points = np.array([[0.0, 0.1, 1.0], [0.3, 0.1, 1.4], [0.1, 0.0, 1.0], [0.1, 0.2, 1.0], [0.15, 0.1, 1.0]])
    diameter, centre = extents(points)
    # in x: 0.3 across and 0.4 deep make 0.5; in y: 0.2
    assert diameter == pytest.approx(0.35, abs=1e-15)
    np.testing.assert_allclose(centre, [0.125, 0.1, 1.1], atol=1e-15)


def test_of_equal_extremes_the_first_counts() -> None:
    points = np.array([[0.0, 0.0, 1.0], [0.0, 0.5, 2.0], [1.0, 0.5, 1.0], [1.0, 0.0, 3.0]])
    diameter, _ = extents(points)
    west_east = np.hypot(1.0, 0.5)
    north_south = np.hypot(0.5, 1.0)
    assert diameter == pytest.approx((west_east + north_south) / 2, abs=1e-15)


def brute_disc(u: float, v: float, radius: float, metric: np.ndarray, blur: int, over: int = 24) -> np.ndarray:
    fine_v, fine_u = np.mgrid[: 30 * over, : 34 * over]
    offset = np.stack([(fine_u + 0.5) / over - 0.5 - u, (fine_v + 0.5) / over - 0.5 - v], axis=-1)
    inside = np.einsum("...i,ij,...j", offset, metric, offset) < radius**2
    pixels = inside.reshape(30, over, 34, over).mean(axis=(1, 3))
    return cv2.blur(pixels, (blur, blur))


@pytest.mark.parametrize("blur", [1, 3, 5])
@pytest.mark.parametrize("radius_px", [1.3, 4.2, 7.6])
def test_blurred_disc_equals_brute_force(blur: int, radius_px: float) -> None:
    pitch = 1.5e-3
    metric = pitch**2 * np.array([[1.0, 0.15], [0.15, 1.3]])
    image, _ = blurred_disc((30, 34), 16.3, 14.8, radius_px * pitch, metric, blur)
    np.testing.assert_allclose(image, brute_disc(16.3, 14.8, radius_px * pitch, metric, blur), atol=0.012)
    area_px = np.pi * radius_px**2 * pitch**2 / np.sqrt(np.linalg.det(metric))
    assert image.sum() == pytest.approx(area_px, rel=1e-9)


def test_derivatives_of_the_blurred_disc() -> None:
    metric = np.array([[2.2, 0.3], [0.3, 2.0]]) * 1e-6
    at = np.array([16.31, 14.77, 6.1e-3])
    _, by = blurred_disc((30, 34), *at, metric, 5)
    for k, step in enumerate((1e-4, 1e-4, 1e-7)):
        ahead, behind = at.copy(), at.copy()
        ahead[k] += step
        behind[k] -= step
        slope = (
            (blurred_disc((30, 34), *ahead, metric, 5)[0] - blurred_disc((30, 34), *behind, metric, 5)[0]) / 2 / step
        )
        np.testing.assert_allclose(by[k], slope, atol=0.02 * np.abs(by[k]).max())


class Board:
    """A tilted plane with one hole, seen through the filter; truth by counting fine samples, not by the model."""

    def __init__(
        self, diameter_mm: float, depth_mm: float, *, blur: int = 5, at: tuple[float, float] = (0.4e-3, -0.7e-3)
    ):
        self.depth_m, self.blur = depth_mm * 1e-3, blur
        # the plane z = 0.75 + 0.1 x - 0.15 y, and the hole's centre on it
        self.tilt = np.array([0.1, -0.15])
        self.centre = np.array([*at, 0.75 + self.tilt @ np.array(at)])
        over = 8
        v, u = np.mgrid[: HEIGHT * over, : WIDTH * over]
        fine = self.surface((u + 0.5) / over - 0.5, (v + 0.5) / over - 0.5)
        inside = ((fine - self.centre) ** 2).sum(axis=-1) < (diameter_mm * 5e-4) ** 2
        part = inside.reshape(HEIGHT, over, WIDTH, over).mean(axis=(1, 3))
        self.part = cv2.blur(part, (blur, blur))
        v, u = np.mgrid[:HEIGHT, :WIDTH]
        self.plane = self.surface(u, v)

    def surface(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        slopes = np.stack([u + REGION.col0 - MIDDLE[0], v + REGION.row0 - MIDDLE[1]], axis=-1) / FOCAL_PX
        z = 0.75 / (1 - slopes @ self.tilt)
        return np.concatenate([slopes * z[..., None], z[..., None]], axis=-1)

    def seen(self, sigma_mm: float, seed: int) -> tuple[Cloud, Evidence]:
        white = np.random.default_rng(seed).standard_normal((HEIGHT, WIDTH))
        noise = cv2.blur(white, (self.blur, self.blur), borderType=cv2.BORDER_REFLECT)
        residual = self.depth_m * self.part + sigma_mm * 1e-3 * self.blur * noise
        points = self.plane * (1 + residual / self.plane[..., 2])[..., None]
        flat = np.zeros((HEIGHT, WIDTH), dtype=np.uint8)
        cloud = Cloud(points, flat, flat.astype(int) + 1, np.full(flat.shape, np.nan), REGION, 0.0, 1)
        return cloud, Evidence(np.abs(residual) / (sigma_mm * 1e-3), residual, self.plane[..., 2], sigma_mm * 1e-3)


def strongest(cloud: Cloud, evidence: Evidence, threshold: float) -> Detection:
    above = (np.nan_to_num(evidence.score) > threshold).astype(np.uint8)
    _, labels = cv2.connectedComponents(above)
    peak = np.nanargmax(evidence.score)
    return Detection(float(np.nanmax(evidence.score)), np.flatnonzero(labels.ravel() == labels.ravel()[peak]))


def measured(board: Board, sigma_mm: float, seed: int, threshold: float = 5.0) -> Measurement:
    cloud, evidence = board.seen(sigma_mm, seed)
    return measure_detection(cloud, evidence, strongest(cloud, evidence, threshold), HoleModelConfig())


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("diameter_mm", [6.35, 12.7, 25.4])
def test_a_nearly_noise_free_hole_or_bump_is_measured_exactly(diameter_mm: float, sign: int) -> None:
    board = Board(diameter_mm, sign * 12.7)
    m = measured(board, 0.005, 1, threshold=100.0)
    assert m.model_note == ""
    assert m.model_diameter_m == pytest.approx(diameter_mm * 1e-3, abs=0.05e-3)
    assert m.model_depth_m == pytest.approx(sign * 12.7e-3, abs=0.15e-3)
    # a wide disc's image is a little larger on its near side: 0.03 mm for the largest
    np.testing.assert_allclose(m.model_centre_m, board.centre, atol=0.04e-3)
    u, v = board.centre[:2] / board.centre[2] * FOCAL_PX + MIDDLE
    assert (m.u_px, m.v_px) == pytest.approx((u, v), abs=0.03)
    # the area that faces the camera is the disc's times the cosine of the tilt
    disc = np.pi * (diameter_mm * 5e-4) ** 2 / np.sqrt(1 + board.tilt @ board.tilt)
    assert m.volume_m3 == pytest.approx(sign * disc * 12.7e-3, rel=0.02)
    assert m.extent_diameter_m > m.model_diameter_m + 2e-3


def test_standard_errors_cover_the_truth() -> None:
    """200 draws of correlated noise. The deviation of 200 standard scores with some 20 degrees of freedom each has a
    standard error of 0.055, so (0.82, 1.22) holds with a risk below 0.1 % for each of the three; means within
    0.25 (3.5 standard errors)."""
    board = Board(12.7, 5.0)
    draws = [measured(board, 0.25, seed) for seed in range(200)]
    assert all(m.model_note == "" for m in draws)
    scores = np.array(
        [
            [
                (m.model_diameter_m - 12.7e-3) / m.model_diameter_se_m,
                (m.model_depth_m - 5.0e-3) / m.model_depth_se_m,
                (m.model_centre_m - board.centre)[0] / m.model_centre_se_m,
            ]
            for m in draws
        ]
    )
    assert np.all(np.abs(scores.mean(axis=0)) < 0.25)
    assert np.all((scores.std(axis=0) > 0.82) & (scores.std(axis=0) < 1.22))


def test_a_hole_lost_in_the_blur_falls_back_and_says_so() -> None:
    m = measured(Board(2.5, 12.7), 0.2, 3, threshold=4.0)
    assert m.model_note.startswith("diameter and depth cannot be told apart") and "half depth" in m.model_note
    assert m.model_diameter_m > 2.5e-3 and np.isnan(m.model_diameter_se_m)


def test_a_deep_hole_falls_back_to_its_contour() -> None:
    board = Board(19.0, 200.0, blur=1)
    m = measured(board, 0.2, 3)
    assert "deeper than 50 mm" in m.model_note
    assert m.model_diameter_m == pytest.approx(19.0e-3, abs=0.4e-3)
    assert m.model_depth_m == pytest.approx(0.2, abs=1e-3)


def test_a_hole_without_range_inside_is_measured_by_its_contour() -> None:
    board = Board(19.0, 30.0, blur=1)
    cloud, evidence = board.seen(0.2, 3)
    detection = strongest(cloud, evidence, 5.0)
    inside = board.part > 0.99
    cloud.points_m[inside] = np.nan
    evidence.residual_m[inside] = np.nan
    rim = np.setdiff1d(detection.pixels, np.flatnonzero(inside))
    m = measure_detection(cloud, evidence, Detection(9.0, rim), HoleModelConfig())
    assert "no range" in m.model_note
    assert m.model_diameter_m == pytest.approx(19.0e-3, abs=1.0e-3)
    assert np.isnan(m.model_depth_m) and np.isnan(m.model_diameter_se_m)


def test_a_neighbour_is_masked() -> None:
    board, other = Board(12.7, 12.7), Board(12.7, 12.7, at=(24e-3, 2e-3))
    cloud, evidence = board.seen(0.1, 3)
    alone = measure_detection(cloud, evidence, strongest(cloud, evidence, 5.0), HoleModelConfig())
    pixels = strongest(cloud, evidence, 5.0)
    evidence.residual_m[:] += other.depth_m * other.part
    m = measure_detection(cloud, evidence, pixels, HoleModelConfig())
    assert m.model_note == ""
    assert m.model_diameter_m == pytest.approx(alone.model_diameter_m, abs=0.15e-3)
    assert m.model_depth_m == pytest.approx(alone.model_depth_m, abs=0.15e-3)


def test_without_a_grid_only_extents_are_given() -> None:
    cloud, evidence = Board(12.7, 12.7).seen(0.1, 3)
    detection = strongest(cloud, evidence, 5.0)
    n = HEIGHT * WIDTH
    row = {"points_m": cloud.points_m.reshape(1, n, 3), "organised": False, "region": Region(0, 1, 0, n)}
    flat = Cloud(**{**cloud.__dict__, **row})
    m = measure_detection(flat, evidence, detection, HoleModelConfig())
    assert m.model_note == "no pixel grid: extents only" and m.points == len(detection.pixels)
    assert m.extent_diameter_m > 12.7e-3 and np.isnan(m.model_diameter_m) and np.isnan(m.u_px)


def test_an_isolated_pixel_is_measured_without_a_crash() -> None:
    cloud, evidence = Board(12.7, 0.0).seen(0.2, 7)
    m = measure_detection(cloud, evidence, Detection(4.0, np.array([17])), HoleModelConfig())
    assert m.points == 1 and m.extent_diameter_m == 0.0 and m.model_note != ""


def test_an_even_blur_is_refused() -> None:
    with pytest.raises(ValidationError, match="odd"):
        HoleModelConfig(blur_px=4)
