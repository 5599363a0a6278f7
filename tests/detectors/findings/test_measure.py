"""Measurements: the blurred disc against brute force, standard errors against simulation."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
from pydantic import ValidationError

from detectors.findings.extents import extents
from detectors.findings.family import BLURS, DEPTH_ERROR
from detectors.findings.hole_patch import HolePatch
from detectors.findings.measure import (
    AMBIGUOUS,
    CONTOUR_ZOOM,
    MISFIT,
    _by_contour,
    _contour_depth,
    _modelled,
    measure_detection,
)
from detectors.findings.pictures import pictures
from detectors.findings.surroundings import (
    HoleModelConfig,
    Surroundings,
    _blurs_of,
    _tilt_m,
    blur_in_cells,
    surroundings_of,
)
from detectors.findings.viewpoints import sight
from detectors.interface import Detection, Evidence, Measurement
from harness.vocabulary.geometry import Cloud, MapViews, Region

FOCAL_PX = 504.0
HEIGHT = 60
WIDTH = 70
REGION = Region(100, 100 + HEIGHT, 200, 200 + WIDTH)
PLAIN = HoleModelConfig(lens_px=0.0, linear_depth_mm=1e5)
"""A sharp lens before a filter that weighs all pixels alike."""
MIDDLE = (250.0, 120.0)
"""Principal point (u, v) on the sensor."""


def brute_disc(
    u: float,
    v: float,
    radius: float,
    metric: np.ndarray,
    blur: int,
    over: int = 24,
) -> np.ndarray:
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
    blank = np.zeros((30, 34))
    patch = HolePatch(
        blank,
        blank == 0,
        metric,
        (float(blur), float(blur)),
        1e-4,
        np.ones((1, 8)),
    )
    image = -pictures(patch, np.array([[16.3, 14.8, radius_px * pitch, -1.0, 0.0]]))[0]
    np.testing.assert_allclose(
        image,
        brute_disc(16.3, 14.8, radius_px * pitch, metric, blur),
        atol=0.012,
    )
    area_px = np.pi * radius_px**2 * pitch**2 / np.sqrt(np.linalg.det(metric))
    assert image.sum() == pytest.approx(area_px, rel=1e-9)


class Board:
    """A tilted plane with one drilled hole, seen through the filter: truth by rays in space, not
    by the model.

    ``depth_mm`` along the optical axis, negative for a disc before the surface; ``wall``: the
    tube's length over it. A ray counts as deep as it is in the tube (or behind its end) and lit
    from the emitter.
    """

    def __init__(
        self,
        diameter_mm: float,
        depth_mm: float,
        *,
        wall: float = 1.0,
        blur: int = 5,
        at: tuple[float, float] = (0.4e-3, -0.7e-3),
        emitter_mm: tuple[float, float, float] = (0.0, 0.0, 0.0),
        middle: tuple[float, float] = MIDDLE,
    ):
        self.depth_m = depth_mm * 1e-3
        self.blur = blur
        self.middle = middle
        self.emitter = np.array(emitter_mm) * 1e-3
        # the plane z = 0.75 + 0.1 x - 0.15 y, and the hole's centre on it
        self.tilt = np.array([0.1, -0.15])
        self.normal = np.array([*-self.tilt, 1.0]) / np.sqrt(1.0 + self.tilt @ self.tilt)
        self.centre = np.array([*at, 0.75 + self.tilt @ np.array(at)])
        self.radius = diameter_mm * 5e-4
        over = 8
        v, u = np.mgrid[: HEIGHT * over, : WIDTH * over]
        fine = self.surface((u + 0.5) / over - 0.5, (v + 0.5) / over - 0.5)
        image = self.hole(fine, wall).reshape(HEIGHT, over, WIDTH, over).mean(axis=(1, 3))
        self.image = cv2.blur(image, (blur, blur))
        v, u = np.mgrid[:HEIGHT, :WIDTH]
        self.plane = self.surface(u, v)

    def hole(self, seen: np.ndarray, wall: float, steps: int = 24) -> np.ndarray:
        """Residual along z of rays that meet the plane at points (h, w, 3)."""
        mouth = ((seen - self.centre) ** 2).sum(axis=-1) < self.radius**2
        residual = np.zeros(mouth.shape)
        if self.depth_m <= 0:
            residual[mouth] = self.depth_m
            return residual
        points = seen[mouth]
        to_plane = self.normal @ self.centre
        deep = self.depth_m * to_plane / self.centre[2]
        tube = wall * deep
        total = np.zeros(len(points))
        for depth in (np.arange(steps) + 0.5) / steps * tube:
            floor_m = points * (1.0 + depth / to_plane)
            total += tube / steps * (self.passes(floor_m, 0.0, depth) & self.within(floor_m, depth))
        end = points * (1.0 + tube / to_plane)
        floor = points * (1.0 + deep / to_plane)
        lit = self.passes(floor, 0.0, deep) & self.passes(floor, tube, deep)
        total += (deep - tube) * (self.within(end, tube) & lit)
        residual[mouth] = total * points[:, 2] / to_plane
        return residual

    def within(self, points: np.ndarray, depth: float) -> np.ndarray:
        from_axis = points - self.centre - depth * self.normal
        return (from_axis**2).sum(axis=-1) < self.radius**2

    def passes(self, points: np.ndarray, rim: float, depth: float) -> np.ndarray:
        """Whether light from the emitter to points at a depth passes the circle at the depth
        ``rim``."""
        height = self.normal @ (self.centre - self.emitter)
        part = (depth - rim) / (depth + height)
        return self.within(points + part * (self.emitter - points), rim)

    def surface(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        position = np.stack([u + REGION.col0, v + REGION.row0], axis=-1)
        slopes = (position - np.array(self.middle)) / FOCAL_PX
        z = 0.75 / (1 - slopes @ self.tilt)
        return np.concatenate([slopes * z[..., None], z[..., None]], axis=-1)

    def seen(self, sigma_mm: float, seed: int) -> tuple[Cloud, Evidence]:
        white = np.random.default_rng(seed).standard_normal((HEIGHT, WIDTH))
        noise = cv2.blur(
            white,
            (self.blur, self.blur),
            borderType=cv2.BORDER_REFLECT,
        )
        residual = self.image + sigma_mm * 1e-3 * self.blur * noise
        points = self.plane * (1 + residual / self.plane[..., 2])[..., None]
        flat = np.zeros((HEIGHT, WIDTH), dtype=np.uint8)
        cloud = Cloud(
            points,
            flat,
            flat.astype(int) + 1,
            np.full(flat.shape, np.nan),
            REGION,
            0.0,
            1,
        )
        return cloud, Evidence(
            np.abs(residual) / (sigma_mm * 1e-3),
            residual,
            self.plane[..., 2],
            sigma_mm * 1e-3,
        )


def strongest(cloud: Cloud, evidence: Evidence, threshold: float) -> Detection:
    above = (np.nan_to_num(evidence.score) > threshold).astype(np.uint8)
    _, labels = cv2.connectedComponents(above)
    peak = np.nanargmax(evidence.score)
    return detection_of(
        cloud,
        float(np.nanmax(evidence.score)),
        np.flatnonzero(labels.ravel() == labels.ravel()[peak]),
    )


def detection_of(cloud: Cloud, score: float, pixels: np.ndarray) -> Detection:
    return Detection(
        score,
        pixels,
        extents(cloud.points_m.reshape(-1, 3)[pixels])[1],
    )


def measured(
    board: Board,
    sigma_mm: float,
    seed: int,
    threshold: float = 5.0,
    config: HoleModelConfig = PLAIN,
) -> Measurement:
    cloud, evidence = board.seen(sigma_mm, seed)
    return measure_detection(
        cloud,
        evidence,
        strongest(cloud, evidence, threshold),
        config,
    )


def patch_of(board: Board) -> tuple[HolePatch, np.ndarray]:
    """The whole picture as a patch, and the true hole (u, v, radius, depth, wall 0.6) in it."""
    u, v = (
        board.centre[:2] / board.centre[2] * FOCAL_PX
        + board.middle
        - np.array([REGION.col0, REGION.row0])
    )
    per_px = np.stack(
        [
            (board.surface(u + du, v + dv) - board.surface(u - du, v - dv)) / 2
            for du, dv in ((0.5, 0), (0, 0.5))
        ]
    )
    per_px *= 2
    used = np.ones((HEIGHT, WIDTH), dtype=bool)
    sights = sight(board.centre, per_px, board.emitter)[None]
    patch = HolePatch(
        board.image,
        used,
        per_px @ per_px.T,
        (float(board.blur), float(board.blur)),
        1e-4,
        sights,
    )
    return patch, np.array([u, v, board.radius, board.depth_m, 0.6])


OBLIQUE = (60.0, 200.0)
"""A principal point that puts the hole 20 degrees off the axis, as the thesis' outermost hole at
0.7 m."""


@pytest.mark.parametrize("middle", [MIDDLE, OBLIQUE])
@pytest.mark.parametrize(
    ("diameter_mm", "depth_mm"),
    [
        (6.35, 33.0),
        (19.05, 12.7),
        (25.4, 33.0),
    ],
)
def test_the_image_of_a_hole_is_that_of_rays_in_space(
    diameter_mm: float,
    depth_mm: float,
    middle: tuple[float, float],
) -> None:
    centre_m = tuple((np.array([235.2, 130.4]) - middle) / FOCAL_PX * 0.75)
    board = Board(diameter_mm, depth_mm, wall=0.6, middle=middle, at=centre_m)
    patch, hole = patch_of(board)
    # perspective over a wide disc, three points for the wall's integral
    image = pictures(patch, hole[None])[0]
    np.testing.assert_allclose(image, board.image, atol=0.03 * board.depth_m)
    assert image.sum() == pytest.approx(board.image.sum(), rel=0.025)


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("diameter_mm", [6.35, 12.7, 25.4])
def test_a_nearly_noise_free_hole_or_bump_is_measured_exactly(
    diameter_mm: float, sign: int
) -> None:
    board = Board(diameter_mm, sign * 12.7)
    m = measured(board, 0.005, 1, threshold=100.0)
    assert m.model_note == ""
    assert m.model_diameter_m == pytest.approx(diameter_mm * 1e-3, abs=0.1e-3)
    assert m.model_depth_m == pytest.approx(sign * 12.7e-3, abs=0.25e-3)
    np.testing.assert_allclose(m.model_centre_m, board.centre, atol=0.05e-3)
    u, v = board.centre[:2] / board.centre[2] * FOCAL_PX + MIDDLE
    assert (m.u_px, m.v_px) == pytest.approx((u, v), abs=0.04)
    assert m.extent_diameter_m > m.model_diameter_m + 2e-3
    # the area that faces the camera is the disc's times the cosine of the tilt; of a hole less is
    # seen
    volume = sign * np.pi * board.radius**2 * board.normal[2] * 12.7e-3
    assert (
        m.volume_m3 == pytest.approx(volume, rel=0.02)
        if sign < 0
        else 0.5 * volume < m.volume_m3 < volume
    )


@pytest.mark.parametrize("wall", [0.4, 1.0])
@pytest.mark.parametrize("diameter_mm", [12.7, 25.4])
def test_an_oblique_hole_has_the_diameter_and_the_place_of_its_mouth(
    diameter_mm: float, wall: float
) -> None:
    centre_m = tuple((np.array([235.2, 130.4]) - OBLIQUE) / FOCAL_PX * 0.75)
    board = Board(diameter_mm, 30.0, wall=wall, middle=OBLIQUE, at=centre_m)
    m = measured(board, 0.02, 1, threshold=100.0)
    floor = board.image > 0.5 * board.image.max()
    seen_m = 2 * np.sqrt(floor.sum() / np.pi * np.linalg.det(patch_of(board)[0].metric_m2) ** 0.5)
    assert seen_m < 0.93 * diameter_mm * 1e-3
    assert m.model_note == ""
    assert m.model_diameter_m == pytest.approx(diameter_mm * 1e-3, abs=0.15e-3)
    np.testing.assert_allclose(m.model_centre_m, board.centre, atol=0.15e-3)


def test_a_centre_s_error_is_that_along_one_axis() -> None:
    """The error on the surface has two axes, which share the trace of its covariance."""
    board = Board(12.7, 12.7)
    cloud, evidence = board.seen(0.2, 1)
    detection = strongest(cloud, evidence, 5.0)
    around = surroundings_of(cloud, evidence, detection, HoleModelConfig())
    assert around is not None
    size, _ = _modelled(around, HoleModelConfig())
    assert size is not None
    fit = size.best
    u_m, v_m = np.linalg.norm(around.per_px_m, axis=1)
    m = measure_detection(cloud, evidence, detection, HoleModelConfig())
    # the derivatives by u and v are nearly at right angles
    square_m2 = fit.covariance[0, 0] * u_m**2 + fit.covariance[1, 1] * v_m**2
    assert m.model_centre_se_m == pytest.approx(np.sqrt(square_m2 / 2), rel=0.02)


@pytest.mark.parametrize(
    "count",
    [
        50,
        pytest.param(200, marks=pytest.mark.slow),
    ],
)
def test_standard_errors_cover_the_truth(count: int) -> None:
    """Draws of correlated noise, over walls of every length as the prior has it. The blur hides
    whether the hole is a disc or a cap, so that the errors contain the difference: they cover
    more often than a normal error's 95 %, and sizes lie on one side of the truth."""
    boards = [Board(12.7, 5.0, wall=wall) for wall in (0.1, 0.3, 0.5, 0.7, 0.9)]
    draws = [(boards[seed % 5], measured(boards[seed % 5], 0.25, seed)) for seed in range(count)]
    assert all(m.model_note == "" for _, m in draws)
    scores = np.array(
        [
            [
                (m.model_diameter_m - 12.7e-3) / m.model_diameter_se_m,
                (m.model_depth_m - 5.0e-3) / m.model_depth_se_m,
                (m.model_centre_m - board.centre)[0] / m.model_centre_se_m,
            ]
            for board, m in draws
        ]
    )
    covered = (np.abs(scores) < 2.0).mean(axis=0)
    assert (covered >= 0.9).all()
    assert (np.abs(scores.mean(axis=0)) < 0.7).all()
    widths = np.array([m.model_diameter_se_m for _, m in draws])
    assert np.median(widths) < 0.16 * 12.7e-3


def test_the_picture_of_a_recording_decides_that_it_is_sharper_than_its_noise() -> None:
    board = Board(9.0, 9.0, wall=0.0, blur=1, emitter_mm=(0.0, 0.0, 0.0))
    board.blur = 5  # of the noise alone
    cloud, evidence = board.seen(0.2, 3)
    detection = strongest(cloud, evidence, 5.0)
    recording = replace(cloud, noise_reach_px=5.0)
    m = measure_detection(recording, evidence, detection, HoleModelConfig())
    assert 8.5e-3 < m.model_diameter_m < 10.0e-3
    # no recording: the model's own blur of 5 pixels is taken, and the hole is too narrow and deep
    m = measure_detection(cloud, evidence, detection, PLAIN)
    assert m.model_diameter_m < 8.0e-3
    assert m.model_depth_m > 3 * 9.0e-3


def test_a_smooth_dent_is_not_taken_for_waves_of_the_noise() -> None:
    board = Board(9.0, 9.0, wall=0.0)
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    # a paraboloid 48 mm wide; half of its depth lies within 34 mm
    board.image = 7e-3 * np.clip(
        1 - ((u - WIDTH / 2) ** 2 + (v - HEIGHT / 2) ** 2) / 16.0**2,
        0,
        None,
    )
    cloud, evidence = board.seen(0.05, 3)
    core = detection_of(cloud, 9.0, np.flatnonzero(board.image > 6.3e-3))
    m = measure_detection(
        cloud,
        evidence,
        core,
        HoleModelConfig(),
    )
    assert m.shape == "cap"
    assert m.model_depth_m == pytest.approx(7e-3, abs=0.3e-3)
    assert m.model_diameter_m == pytest.approx(48e-3, abs=1.5e-3)
    assert abs(m.model_diameter_m - 48e-3) < 2 * m.model_diameter_se_m


def test_a_hole_lost_in_the_blur_falls_back_and_says_so() -> None:
    m = measured(Board(2.0, 12.7, wall=0.3), 0.15, 3, threshold=4.0)
    assert m.model_note.startswith("the blur hides the difference")
    assert "half-depth contour" in m.model_note
    assert m.model_diameter_m > 2.0e-3
    # an upper limit: two standard errors reach down to 0
    assert 2 * m.model_diameter_se_m > 0.95 * m.model_diameter_m


def test_the_depth_of_a_hole_that_hides_its_floor_is_a_lower_bound() -> None:
    """Five pixels are 7.5 mm wide: the filter's square lies in a mouth of 7.5 mm to four fifths, and
    wholly in one of 10.6 mm. A bump has no floor to hide."""
    assert measured(Board(6.5, 12.7), 0.02, 1).depth_is_least
    assert not measured(Board(9.0, 12.7), 0.02, 1).depth_is_least
    assert not measured(Board(6.5, -12.7), 0.02, 1).depth_is_least
    for diameter_mm in (5.0, 19.0):
        deep = Board(diameter_mm, 200.0, wall=0.0)
        by_contour = measured(deep, 0.2, 3, config=HoleModelConfig())
        assert "contour" in by_contour.model_note
        assert by_contour.depth_is_least == (diameter_mm < 10.0)


def test_the_lens_widens_the_picture_and_not_the_noise() -> None:
    """A lens with a deviation of 0.6 pixels before a filter of 5 x 5: without it, a hole of three
    pixels looks an eighth wider."""
    board = Board(5.0, 12.7)
    board.image = cv2.GaussianBlur(board.image, (9, 9), 0.6)
    stated = HoleModelConfig(lens_px=0.6, linear_depth_mm=1e5)
    stated_blur = measured(board, 0.005, 1, config=stated)
    assert stated_blur.model_diameter_m == pytest.approx(5.0e-3, rel=0.02)
    assert measured(board, 0.005, 1).model_diameter_m > 1.06 * 5.0e-3
    cloud, evidence = board.seen(0.005, 1)
    detection = strongest(cloud, evidence, 5.0)
    around = surroundings_of(cloud, evidence, detection, stated)
    assert around is not None
    assert around.patch.noise_px == (5.0, 5.0)
    assert around.patch.blur_px == (5.0, 5.0)
    assert around.patch.lens_px == pytest.approx((1.0 / 0.64, 1.0 / 0.64))


def test_a_filter_is_stated_by_the_settings_except_that_of_a_recording() -> None:
    board = Board(12.7, 12.7)
    cloud, evidence = board.seen(0.1, 1)
    detection = strongest(cloud, evidence, 5.0)

    def patch(cloud: Cloud, config: HoleModelConfig) -> HolePatch:
        around = surroundings_of(cloud, evidence, detection, config)
        assert around is not None
        return around.patch

    plain = patch(cloud, HoleModelConfig(emitter_mm=(-80.0, 0.0, 0.0)))
    by_light = patch(cloud, HoleModelConfig(emitter_mm=(-80.0, 0.0, 0.0), by_light=True))
    assert (plain.brightness, by_light.brightness) == (0.0, 1.0)
    assert plain.half_m == pytest.approx(75e-3)
    # the emitter's beam matters to a filter by light alone
    at_lens = patch(cloud, HoleModelConfig(emitter_mm=(0.0, 0.0, 0.0), by_light=True))
    np.testing.assert_array_equal(plain.sights, at_lens.sights)
    assert abs(by_light.sights[0, 4] - at_lens.sights[0, 4]) > 10.0
    recording = patch(replace(cloud, noise_reach_px=5.0), HoleModelConfig())
    assert recording.half_m == math.inf
    assert recording.lens_px == (1.0, 1.0)


def test_a_deep_hole_falls_back_to_its_contour() -> None:
    board = Board(19.0, 200.0, wall=0.0, blur=1, emitter_mm=(0.0, 0.0, 0.0))
    m = measured(board, 0.2, 3, config=HoleModelConfig())
    assert "deeper than 75 mm" in m.model_note
    assert m.model_diameter_m == pytest.approx(19.0e-3, abs=0.4e-3)
    assert m.model_depth_m == pytest.approx(0.2, abs=1e-3)


CONE_PX = 12.0
"""Radius of a cone's rim; half-way down, it is half as wide."""


def cone(depth_m: float, blur_px: float) -> Surroundings:
    """A cone in the surroundings of a drilled hole, exact and without an offset."""
    cloud, evidence = Board(25.0, 12.7).seen(0.1, 1)
    around = surroundings_of(cloud, evidence, strongest(cloud, evidence, 5.0), PLAIN)
    assert around is not None
    height, width = around.detected.shape
    rows, columns = np.indices((height, width))
    from_middle_px = np.hypot(rows - (height - 1) / 2, columns - (width - 1) / 2)
    residual_m = depth_m * np.clip(1.0 - from_middle_px / CONE_PX, 0.0, 1.0)
    everywhere = np.ones((height, width), bool)
    patch = replace(
        around.patch, residual_m=residual_m, used=everywhere, blur_px=(blur_px, blur_px)
    )
    return replace(
        around,
        patch=patch,
        detected=from_middle_px < CONE_PX,
        invalid=~everywhere,
        offset_m=0.0,
        sign=1.0,
        peak_m=depth_m,
    )


def contoured(around: Surroundings, doubt: str, volume_m3: float = 0.0) -> Measurement:
    bare = Measurement(0.0, 0.0, 9, 9.0, 0.03, np.zeros(3), volume_m3=volume_m3)
    return _by_contour(bare, around, doubt)


def test_the_error_of_a_contours_diameter_is_half_of_its_flanks_and_what_blur_moves() -> None:
    """A cone's contours at 0.35 and 0.65 of its depth are 1.3 and 0.7 radii wide; a blur of b
    pixels moves one of diameter d by b^2 / (6 d)."""
    around = cone(10e-3, blur_px=5.0)
    pixel_m = math.sqrt(around.area_m2)
    contour = contoured(around, "the residual is no hole")
    assert contour.model_diameter_m == pytest.approx(CONE_PX * pixel_m, rel=0.01)
    flank_m = 0.3 * CONE_PX * pixel_m
    moved_m = 25.0 / (6.0 * CONE_PX) * pixel_m
    expected_m = math.hypot(flank_m, moved_m)
    assert contour.model_diameter_se_m == pytest.approx(expected_m, rel=0.01)

    # a wide blur moves it by half of its diameter at most
    blurred = contoured(cone(10e-3, blur_px=25.0), "the residual is no hole")
    half_m = 0.5 * blurred.model_diameter_m
    assert blurred.model_diameter_se_m == pytest.approx(math.hypot(flank_m, half_m), rel=0.01)

    unclear = contoured(around, AMBIGUOUS)
    assert unclear.model_diameter_se_m == pytest.approx(math.hypot(flank_m, half_m), rel=0.01)


def test_the_depth_of_a_contour_has_the_models_error_too() -> None:
    """A cone of 10 mm, whose contour holds the pixels that are deeper than 5 mm."""
    around = cone(10e-3, blur_px=5.0)
    contour = contoured(around, "the residual is no hole")
    assert contour.model_depth_m == pytest.approx(10e-3)
    residual_m = around.patch.residual_m
    median_m = float(np.median(residual_m[residual_m > 5e-3]))
    own_m = math.hypot(0.5 * (10e-3 - median_m), around.patch.noise_m)
    expected_m = math.hypot(own_m, DEPTH_ERROR * 10e-3)
    assert contour.model_depth_se_m == pytest.approx(expected_m, rel=0.03)


def test_the_depth_of_ragged_damage_is_its_volume_over_its_area() -> None:
    """The area's relative error is twice that of the diameter."""
    around = cone(10e-3, blur_px=5.0)
    area_m2 = math.pi / 4 * (CONE_PX**2) * around.area_m2
    ragged = contoured(around, MISFIT, volume_m3=4e-3 * area_m2 * around.normal_share)
    assert ragged.shape == "ragged"
    assert ragged.model_depth_m == pytest.approx(4e-3, rel=0.02)
    relative = ragged.model_diameter_se_m / ragged.model_diameter_m
    expected = math.hypot(2.0 * relative, DEPTH_ERROR)
    assert ragged.model_depth_se_m / ragged.model_depth_m == pytest.approx(expected)


def test_the_error_of_a_contours_depth_is_half_of_what_the_median_lacks_and_the_noise() -> None:
    """Three pixels lie 3, 5 and 11 mm beyond the offset; the peak of 11 mm exceeds their median by
    6 mm."""
    cloud, evidence = Board(12.7, 12.7).seen(0.1, 1)
    around = surroundings_of(cloud, evidence, strongest(cloud, evidence, 5.0), HoleModelConfig())
    assert around is not None
    residual_m = np.full(around.detected.shape, 0.9)
    residual_m[4, 4:7] = [4e-3, 6e-3, 12e-3]
    pixels = np.zeros(residual_m.shape, bool)
    pixels[4, 4:7] = True
    inside = np.kron(pixels, np.ones((CONTOUR_ZOOM, CONTOUR_ZOOM))) > 0
    patch = replace(around.patch, residual_m=residual_m, noise_m=0.4e-3)
    behind = replace(around, patch=patch, offset_m=1e-3, peak_m=11e-3, sign=1.0)
    depth_m, error_m = _contour_depth(behind, inside, residual_m)
    assert depth_m == 11e-3
    assert error_m == pytest.approx(math.hypot(3e-3, 0.4e-3))

    mirrored = replace(patch, residual_m=-residual_m)
    in_front = replace(behind, patch=mirrored, offset_m=-1e-3, sign=-1.0)
    assert _contour_depth(in_front, inside, residual_m) == (-depth_m, error_m)

    nothing_inside = np.zeros_like(inside)
    assert math.isnan(_contour_depth(behind, nothing_inside, residual_m)[1])


def test_the_mouth_of_an_oblique_deep_hole_is_measured_and_not_what_it_shows_through() -> None:
    # 26 degrees off the axis and 20 off the normal, the tube of 20 mm hides most of what lies 0.5
    # m behind
    board = Board(
        19.0,
        500.0,
        wall=0.04,
        blur=1,
        emitter_mm=(0.0, 0.0, 0.0),
        at=(0.32, 0.0),
        middle=(50.0, 120.0),
    )
    through_m = np.sqrt((board.image > 0.25).sum() / (board.image > 0).sum()) * 19.0e-3
    m = measured(board, 0.2, 3, config=HoleModelConfig())
    assert through_m < 11.0e-3
    assert "deeper than 75 mm" in m.model_note
    assert 14.0e-3 < m.model_diameter_m < 20.0e-3


def test_a_hole_without_range_inside_is_measured_by_its_contour() -> None:
    board = Board(19.0, 30.0, wall=0.0, blur=1, emitter_mm=(0.0, 0.0, 0.0))
    cloud, evidence = board.seen(0.2, 3)
    detection = strongest(cloud, evidence, 5.0)
    inside = board.image > 0.99 * board.depth_m
    cloud.points_m[inside] = np.nan
    evidence.residual_m[inside] = np.nan
    rim = np.setdiff1d(detection.pixels, np.flatnonzero(inside))
    m = measure_detection(
        cloud,
        evidence,
        detection_of(cloud, 9.0, rim),
        HoleModelConfig(),
    )
    assert "no range" in m.model_note
    assert m.model_diameter_m == pytest.approx(19.0e-3, abs=1.0e-3)
    # its rim is all that is seen
    assert m.depth_is_least
    assert 0.0 < m.model_depth_m < 30e-3
    assert abs(m.model_diameter_m - 19.0e-3) < 2 * m.model_diameter_se_m < 4e-3


def test_a_neighbour_is_masked() -> None:
    board = Board(12.7, 12.7)
    neighbour = Board(12.7, 12.7, at=(24e-3, 2e-3))
    cloud, evidence = board.seen(0.1, 3)
    alone = measure_detection(
        cloud,
        evidence,
        strongest(cloud, evidence, 5.0),
        HoleModelConfig(),
    )
    pixels = strongest(cloud, evidence, 5.0)
    evidence.residual_m[:] += neighbour.image
    m = measure_detection(cloud, evidence, pixels, HoleModelConfig())
    assert m.model_note == ""
    assert m.model_diameter_m == pytest.approx(alone.model_diameter_m, abs=0.15e-3)
    assert m.model_depth_m == pytest.approx(alone.model_depth_m, abs=0.15e-3)


def test_without_a_grid_only_extents_are_given() -> None:
    cloud, evidence = Board(12.7, 12.7).seen(0.1, 3)
    detection = strongest(cloud, evidence, 5.0)
    n = HEIGHT * WIDTH
    row = {
        "points_m": cloud.points_m.reshape(1, n, 3),
        "organised": False,
        "region": Region(0, 1, 0, n),
    }
    flat = Cloud(**{**cloud.__dict__, **row})
    m = measure_detection(flat, evidence, detection, HoleModelConfig())
    assert m.model_note == "no pixel grid: extents only"
    assert m.points == len(detection.pixels)
    assert m.extent_diameter_m > 12.7e-3
    assert np.isnan(m.model_diameter_m)
    assert np.isnan(m.u_px)


def frontal(height: int, width: int, pitch_m: float = 1e-3, **changes: object) -> Cloud:
    """A map of equal cells of a plane at z = 0."""
    v, u = np.mgrid[:height, :width] * pitch_m
    flat = np.zeros((height, width), np.uint8)
    cloud = Cloud(
        points_m=np.stack([u, v, np.zeros(u.shape)], axis=-1),
        reason=flat,
        count=flat.astype(int) + 1,
        variance_m2=np.full(u.shape, np.nan),
        region=Region(0, height, 0, width),
        z_step_m=0.0,
        n_frames=1,
        projection="parallel",
    )
    return replace(cloud, **changes)


def test_volume_and_sides_are_those_of_a_box() -> None:
    """A box of 20 x 8 mm, 3 mm deep, on a map that nothing blurs, along a diagonal too."""
    cloud = frontal(60, 70)
    v, u = np.mgrid[:60, :70]
    for turn_deg in (0.0, 30.0):
        turned = ((u - 34.5) + 1j * (v - 29.5)) * np.exp(-1j * np.radians(turn_deg))
        inside = (np.abs(turned.real) < 10) & (np.abs(turned.imag) < 4)
        residual_m = np.where(inside, -3e-3, 0.0) + 2e-4
        evidence = Evidence(np.abs(residual_m), residual_m, np.zeros((60, 70)), 1e-4)
        detection = detection_of(cloud, 9.0, np.flatnonzero(inside))
        m = measure_detection(cloud, evidence, detection, HoleModelConfig(blur_px=1))
        assert m.volume_m3 == pytest.approx(-3e-3 * inside.sum() * 1e-6, rel=1e-6)
        assert m.length_m == pytest.approx(20e-3, rel=0.03)
        assert m.width_m == pytest.approx(8e-3, rel=0.04)
        along = np.array([np.cos(np.radians(turn_deg)), np.sin(np.radians(turn_deg)), 0.0])
        assert abs(m.along @ along) == pytest.approx(1.0, abs=2e-3)


def test_sides_are_without_the_blur() -> None:
    """A filter of 5 x 5 pixels adds 25 / 12 to the second moments, which the sides leave out."""
    board = Board(25.4, -3.0, blur=5)
    blurred = measured(board, 0.005, 1, threshold=50.0)
    sharp = Board(25.4, -3.0, blur=1)
    cloud, evidence = sharp.seen(0.005, 1)
    detection = strongest(cloud, evidence, 50.0)
    plain = measure_detection(cloud, evidence, detection, HoleModelConfig(blur_px=1))
    assert blurred.length_m == pytest.approx(plain.length_m, rel=0.015)
    assert blurred.width_m == pytest.approx(plain.width_m, rel=0.015)
    assert plain.length_m == pytest.approx(np.sqrt(3) / 2 * 25.4e-3, rel=0.03)


def test_the_blur_of_a_map_counts_in_its_cells() -> None:
    """Cells of 1 mm; the views' pixels are 1.5 mm across and 0.4 mm down, so that a cell holds
    several of these."""
    views = MapViews(np.eye(4)[None], np.ones(1), pixel_m=(1.5e-3, 0.4e-3))
    cloud = frontal(8, 9, map_views=views)
    along_u, along_v = blur_in_cells(cloud, HoleModelConfig(blur_px=5))
    assert along_u == pytest.approx(1.5 * np.sqrt(27))
    assert along_v == pytest.approx(np.sqrt(0.4**2 * 27 + 1.0))
    assert blur_in_cells(frontal(8, 9), HoleModelConfig(blur_px=3)) == (3.0, 3.0)
    assert blur_in_cells(frontal(8, 9, noise_reach_px=4.0), HoleModelConfig()) == (4.0, 4.0)


def test_the_blur_of_upsampled_depth_is_that_of_the_place() -> None:
    """Two columns of parts, whose middles are columns 1.5 and 5.5 of eight."""
    sides_px = np.array([[[9.0, 21.0]], [[12.0, 14.0]]], np.float32)
    cloud = frontal(8, 8, noise_reach_px=8.0, noise_sides_px=sides_px)
    config = HoleModelConfig()
    assert blur_in_cells(cloud, config, (4.0, 0.0)) == (9.0, 12.0)
    assert blur_in_cells(cloud, config, (4.0, 3.5)) == pytest.approx((15.0, 13.0), abs=0.2)
    assert blur_in_cells(cloud, config, (4.0, 7.0)) == (21.0, 14.0)


def test_an_isolated_pixel_is_measured_without_a_crash() -> None:
    cloud, evidence = Board(12.7, 0.0).seen(0.2, 7)
    m = measure_detection(
        cloud,
        evidence,
        detection_of(cloud, 4.0, np.array([17])),
        HoleModelConfig(),
    )
    assert m.points == 1
    assert m.extent_diameter_m == 0.0
    assert m.model_note.startswith("the blur hides the difference between diameter and depth")
    assert m.model_diameter_se_m > 0.5 * m.model_diameter_m


def test_an_even_blur_is_refused() -> None:
    with pytest.raises(ValidationError, match="odd"):
        HoleModelConfig(blur_px=4)


def test_the_tilt_around_a_detection_ignores_other_damage_and_the_level() -> None:
    rows, columns = np.indices((15, 17), float)
    plane_m = 2e-3 + 1e-4 * columns - 3e-4 * rows
    ring = np.hypot(rows - 7, columns - 8) > 4
    seen_m = plane_m + np.random.default_rng(0).normal(0.0, 5e-5, plane_m.shape)
    seen_m[~ring] += 5e-3
    seen_m[2:5, 1:4] += 4e-3
    tilt_m = _tilt_m(seen_m, ring)
    assert (tilt_m - plane_m).std() < 5e-5
    assert tilt_m[ring].mean() == pytest.approx(0.0, abs=1e-9)


def test_upsampled_depth_is_blurred_at_least_as_widely_as_its_noise() -> None:
    sides_px = np.full((2, 1, 1), 9.0, np.float32)
    upsampled = frontal(8, 8, noise_reach_px=8.0, noise_sides_px=sides_px)
    assert {ratio for ratio, _, _ in _blurs_of(upsampled)} == {1.0, 1.4, 1.5}
    assert _blurs_of(frontal(8, 8, noise_reach_px=5.0)) == BLURS
    assert _blurs_of(frontal(8, 8)) == BLURS[:1]
