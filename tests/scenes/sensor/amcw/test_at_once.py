"""Averages drawn at once against averages of single frames, in distribution: every number of a
capture's cloud.

Captures are independent, so each statistic of a capture (a mean over a group of pixels of z, of
its square, of products with neighbours, of what lies beyond some deviations, of the count) is
compared between many captures of either kind by the two-sample t test; 5 standard errors is one
false alarm in 2 million.
"""

from __future__ import annotations

import warnings
from functools import lru_cache

import numpy as np
import pytest
from scipy import ndimage, stats

from detectors.averages.average import AverageConfig, prefix_averages
from detectors.crop import NoCrop
from detectors.methods.thesis import ThesisConfig, ThesisDetector
from harness.trials import averages
from harness.trials.averages import averages_of
from harness.vocabulary.geometry import MM, Cloud, Region
from harness.vocabulary.seeds import random_stream
from scenes.closed_form import Plane, layered_view, plane_view
from scenes.sensor.amcw import at_once as sums_of_frames
from scenes.sensor.amcw import kernels
from scenes.sensor.amcw.facts import AmcwCamera, ExposuresFacts
from scenes.sensor.amcw.imager import AmcwImager
from scenes.sensor.amcw.kernels import LANES
from scenes.sensor.amcw.light import light_of_samples
from scenes.sensor.amcw.linear_frames import BEND, SCALE, UNEVEN
from scenes.sensor.camera import camera_of
from scenes.sensor.common.config import CameraConfig, EffectsConfig
from scenes.sensor.source import SimulatedUnit
from tests.support.sensor_frames import z_of as stacked_z

REGIONS = {
    "azure_kinect_nfov": Region(306, 338, 296, 352),
    "kinect_v2_libfreenect2": Region(196, 228, 226, 282),
}
STILL = EffectsConfig(frame_jumps=False)
FRONT = Plane(0.7, 0.08, 0.05)
NOTHING_BEHIND_M = 8.0
"""So far behind that what comes back is less than the noise."""
PLAIN = AverageConfig()
BRIGHT_ELECTRONS = 9000.0
"""At which the plate would fill the Azure Kinect's wells, and a plane 200 mm behind it would not."""
FEWEST_FRAMES = 6
"""For these tests; as many as `averages.FEWEST_FRAMES` would only take longer."""
CAPTURES = 60
FRAMES = 8
FEWEST_PIXELS = 12  # of a group, for statistics of their z
SURE = 5.0
SURE_OF_FLOOR = 6.0
"""Far behind a hole the light is dim, and means drawn at once scatter some 7 % less than those of
frames: 13 to 15 % of the variance of eight frames, measured with 60 captures of either kind, whose
standard error is 3 %."""


def test_noise_from_bytes_has_the_variance_and_kurtosis_of_a_normal() -> None:
    v = (np.arange(-128, 128) + 0.5) / 128
    u = SCALE * v * (1 + BEND * v**2)
    assert (u**2).mean() == pytest.approx(1.0, abs=1e-12)
    assert (u**4).mean() == pytest.approx(3.0, abs=1e-12)


@pytest.fixture(autouse=True)
def few_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(averages, "FEWEST_FRAMES", FEWEST_FRAMES)
    # a limit of cost: with nothing behind the holes 31 % of these small pictures are simulated one
    # by one
    monkeypatch.setattr(sums_of_frames, "MOST_LISTED", 0.4)


def numbers_of(name: str) -> dict[str, float]:
    """A Kinect v2 with a finer converter: by its own, dark pixels' noise hides no steps and frames
    are drawn singly."""
    return (
        {"photons.electrons_per_unit": 3.0, "scatter.blur_px": 0.0}
        if name.startswith("kinect")
        else {}
    )


@lru_cache
def unit_before_hole(
    name: str,
    behind_mm: float,
    jump_rate: float | None = None,
    exposures: ExposuresFacts | None = None,
) -> SimulatedUnit:
    """A unit before a plate with a round hole of 24 mm, one of 8 mm and a straight edge, and a
    plane behind it. With ``exposures``, the light is so bright that the plate's are shortened."""
    numbers = numbers_of(name)
    if exposures is not None:
        numbers["photons.signal_electrons"] = BRIGHT_ELECTRONS
    effects = STILL
    if jump_rate is not None:
        numbers["unit.jump_rate"] = jump_rate
        effects = EffectsConfig()
    config = CameraConfig(name=name, effects=effects, numbers=numbers)
    camera = camera_of(config)
    assert isinstance(camera, AmcwCamera)
    camera = camera.model_copy(update={"exposures": exposures})
    outer = REGIONS[name].grown(
        camera.optics.margin_px, camera.nominal_lens.height, camera.nominal_lens.width
    )
    slopes = camera.nominal_lens.region_slopes(REGIONS[name])
    middle = slopes.reshape(-1, 2).mean(axis=0)
    reach = np.ptp(slopes[..., 0]) / 2

    def covers(slopes: np.ndarray) -> np.ndarray:
        x = slopes[..., 0] - middle[0]
        y = slopes[..., 1] - middle[1]
        large_hole = np.hypot(x + 0.3 * reach, y) < 0.017
        small_hole = np.hypot(x - 0.3 * reach, y) < 0.0057
        return np.isfinite(x) & ~large_hole & ~small_hole & (x < 0.8 * reach)

    back = Plane(FRONT.distance_m + behind_mm * MM, FRONT.slope_x, FRONT.slope_y)
    return SimulatedUnit(
        camera,
        config,
        layered_view(
            camera,
            outer,
            FRONT,
            back,
            covers,
            0.6,
        ),
    )


def test_windows_that_reach_beyond_the_image_have_no_moves_there() -> None:
    """A tilted plane behind a straight edge in the corner of the sensor: what lies outside has no
    noise, and changes nothing."""
    name = "kinect_v2_libfreenect2"
    config = CameraConfig(name=name, effects=STILL, numbers=numbers_of(name))
    camera = camera_of(config)
    region = Region(0, 24, 0, 40)
    slopes = camera.nominal_lens.region_slopes(region)
    middle = float(np.median(slopes[..., 0]))
    back = Plane(FRONT.distance_m + 30.0 * MM, FRONT.slope_x, FRONT.slope_y)

    def covers(slopes: np.ndarray) -> np.ndarray:
        return np.isfinite(slopes[..., 0]) & (slopes[..., 0] < middle)

    unit = SimulatedUnit(camera, config, layered_view(camera, region, FRONT, back, covers, 0.6))
    summer = unit.at_once
    assert summer is not None
    linear = summer.linear
    assert np.isfinite(linear.moves).all()
    height, width = summer.shape
    uneven = np.flatnonzero(linear.kind == UNEVEN)
    rows, columns = np.divmod(uneven, width)
    side = round(np.sqrt(linear.moves.shape[1]))
    windows = linear.moves[linear.row[uneven]].reshape(-1, side, side)
    beyond = np.arange(side) - side // 2
    outside_rows = (rows[:, None] + beyond < 0) | (rows[:, None] + beyond >= height)
    outside_columns = (columns[:, None] + beyond < 0) | (columns[:, None] + beyond >= width)
    outside = outside_rows[:, :, None] | outside_columns[:, None, :]
    assert (windows[outside] == 0.0).all()
    assert np.abs(windows).sum(axis=(1, 2)).min() > 0.0
    assert (rows < 2).any() or (columns < 2).any()


@lru_cache
def clouds_of(name: str, behind_mm: float) -> tuple[list[Cloud], list[Cloud]]:
    """Averages of `FRAMES` frames, one by one and at once."""
    return clouds_before(unit_before_hole(name, behind_mm))


def clouds_before(unit: SimulatedUnit) -> tuple[list[Cloud], list[Cloud]]:
    """The same of any unit."""
    exact = []
    at_once = []
    for number in range(CAPTURES):
        capture = unit.capture(FRAMES, 1, number)
        exact.append(averages_of(capture, [FRAMES], PLAIN, exact=True)[FRAMES])
        at_once.append(averages_of(capture, [FRAMES], PLAIN, exact=False)[FRAMES])
    return exact, at_once


def groups_of(unit: SimulatedUnit) -> dict[str, np.ndarray]:
    """Pixels (h, w) bool of the face, the floor (or what is behind) and the rims between them,
    those that there are."""
    face = (unit.view.surface == 0)[unit.cut]
    square = np.ones((7, 7), bool)
    inner = ndimage.binary_erosion(face, square, border_value=1)
    outer = ndimage.binary_dilation(face, square)
    floor = ~face & ~ndimage.binary_dilation(face, np.ones((5, 5)))
    groups = {"face": inner, "rim": outer & ~inner, "floor": floor}
    return {name: pixels for name, pixels in groups.items() if pixels.any()}


def statistics_of(
    z_m: np.ndarray, count: np.ndarray, group: np.ndarray, all_z_m: np.ndarray
) -> dict[str, np.ndarray]:
    """(captures,) each: statistics over a group's pixels (h, w); ``z_m`` and ``count`` (captures,
    h, w). ``all_z_m`` (captures', h, w): z of all captures, which gives the common mean and
    deviation."""
    statistics = {"count": count[:, group].mean(axis=1)}
    measured = group & (np.isfinite(all_z_m).mean(axis=0) > 0.5)
    if measured.sum() < FEWEST_PIXELS:
        return statistics
    statistics["empty"] = (count[:, group] == 0).mean(axis=1)
    standard = standardised(z_m, all_z_m)
    standard = np.where(measured & np.isfinite(standard), standard, 0.0)
    statistics["mean"] = standard[:, measured].mean(axis=1)
    statistics["variance"] = (standard[:, measured] ** 2).mean(axis=1)
    for limit in (2, 3):
        beyond = np.abs(standard[:, measured]) > limit
        statistics[f"beyond {limit}"] = beyond.mean(axis=1)
    for lag in (1, 2, 3, 4):
        pairs = measured[:, lag:] & measured[:, :-lag]
        if pairs.sum() >= FEWEST_PIXELS:
            products = standard[:, :, lag:] * standard[:, :, :-lag]
            statistics[f"lag {lag} x"] = products[:, pairs].mean(axis=1)
        pairs = measured[lag:] & measured[:-lag]
        if pairs.sum() >= FEWEST_PIXELS:
            products = standard[:, lag:] * standard[:, :-lag]
            statistics[f"lag {lag} y"] = products[:, pairs].mean(axis=1)
    return statistics


def standardised(z_m: np.ndarray, all_z_m: np.ndarray) -> np.ndarray:
    """z (captures, h, w) minus the mean of each pixel, over its deviation."""
    with np.errstate(invalid="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # pixels without any range
        deviation_m = np.maximum(np.nanstd(all_z_m, axis=0), 1e-7)
        return (z_m - np.nanmean(all_z_m, axis=0)) / deviation_m


def compared(first: np.ndarray, second: np.ndarray) -> float:
    """Difference of two samples' means in standard errors; 0 where both are the same constant."""
    first_error2 = first.var(ddof=1) / len(first)
    second_error2 = second.var(ddof=1) / len(second)
    error = np.sqrt(first_error2 + second_error2)
    difference = first.mean() - second.mean()
    if error == 0:
        return 0.0 if difference == 0 else np.inf
    return float(difference / error)


@pytest.mark.parametrize(
    "behind_mm",
    [
        200.0,
        *(
            pytest.param(far, marks=pytest.mark.slow)
            for far in (2.0, 9.5, 20.0, NOTHING_BEHIND_M / MM)
        ),
    ],
)
@pytest.mark.parametrize("name", REGIONS)
def test_averages_drawn_at_once_have_the_distribution_of_those_of_frames(
    name: str, behind_mm: float
):
    """Dents and blind holes (2 and 9.5 mm), and through-holes with a backing near, far and none."""
    assert_alike(unit_before_hole(name, behind_mm), *clouds_of(name, behind_mm))


@pytest.mark.parametrize("chosen_for", ["frame", "pixel"])
def test_so_have_those_of_shortened_exposures(chosen_for: str):
    """One time for all pixels, or a quarter for those of the plate and the longest for those 200
    mm behind it."""

    def fact(value: object) -> dict[str, object]:
        return {"value": value, "tag": "M", "source": "test"}

    exposures = ExposuresFacts.from_data(
        {
            "shares": fact([1.0, 0.25]),
            "continuous": fact(chosen_for == "frame"),
            "chosen_for": fact(chosen_for),
            "fill": fact(0.9),
            "bright_share": fact(0.01) if chosen_for == "frame" else None,
        }
    )
    unit = unit_before_hole("azure_kinect_nfov", 200.0, exposures=exposures)
    shares = unit.exposure.time_share.reshape(unit.exposure.shape)[unit.cut]
    groups = groups_of(unit)
    assert shares[groups["face"]].max() < 0.8
    assert (shares[groups["floor"]] == 1).all() == (chosen_for == "pixel")
    assert unit.at_once is not None
    assert_alike(unit, *clouds_before(unit))


@pytest.mark.parametrize(
    "name", ["azure_kinect_nfov", pytest.param("kinect_v2_libfreenect2", marks=pytest.mark.slow)]
)
def test_so_have_those_of_a_dim_and_distant_face(name: str):
    """Phase noise of 0.06 to 0.1 rad in the noisiest frequency: there the filter's weights hang on
    the noise."""
    config = CameraConfig(name=name, effects=STILL, numbers=numbers_of(name))
    camera = camera_of(config)
    assert isinstance(camera, AmcwCamera)
    outer = REGIONS[name].grown(
        camera.optics.margin_px, camera.nominal_lens.height, camera.nominal_lens.width
    )
    albedo = 0.25 if name == "azure_kinect_nfov" else 0.2
    unit = SimulatedUnit(
        camera,
        config,
        plane_view(
            camera,
            outer,
            1.6,
            albedo,
            0.05,
            0.02,
        ),
    )
    assert unit.at_once is not None
    knee = float(camera.converter.knee_units.value)
    light = light_of_samples(unit.exposure, knee, np.ones(len(camera.frequencies_hz)))
    assert 0.055 < np.median(light.phase_noise.max(axis=0)) < 0.13
    assert_alike(unit, *clouds_before(unit))


def z_of(clouds: list[Cloud]) -> np.ndarray:
    return np.stack([cloud.points_m[..., 2] for cloud in clouds])


def count_of(clouds: list[Cloud]) -> np.ndarray:
    return np.stack([cloud.count for cloud in clouds])


def assert_alike(unit: SimulatedUnit, exact: list[Cloud], at_once: list[Cloud]) -> None:
    """By every statistic of every group of pixels."""
    both_kinds = (exact, at_once)
    all_z_m = z_of(exact + at_once)
    all_variances = np.stack([cloud.variance_m2 for cloud in exact + at_once])
    assert not np.array_equal(z_of(exact), z_of(at_once), equal_nan=True)
    for group, pixels in groups_of(unit).items():
        repeated = pixels & np.isfinite(all_variances).all(axis=0)
        statistics = []
        for clouds in both_kinds:
            values = statistics_of(z_of(clouds), count_of(clouds), pixels, all_z_m)
            if repeated.any():
                variances = np.stack([cloud.variance_m2 for cloud in clouds])
                values["variance_m2"] = variances[:, repeated].mean(axis=1)
                amplitudes = np.stack([cloud.amplitude for cloud in clouds])
                values["amplitude"] = amplitudes[:, repeated].mean(axis=1)
            statistics.append(values)
        off = {}
        for key, value in statistics[0].items():
            off[key] = compared(value, statistics[1][key])
        limit = SURE_OF_FLOOR if group == "floor" else SURE
        assert max(map(abs, off.values())) < limit, (group, off)
    never = (count_of(exact + at_once) == 0).all(axis=0)
    commonest = []
    for clouds in both_kinds:
        reasons = np.stack([cloud.reason for cloud in clouds])[:, never]
        commonest.append(stats.mode(reasons).mode)
    # which of two gates stops a pixel first may be decided frame by frame, where the commonest of
    # ten may be either
    assert (commonest[0] != commonest[1]).sum() <= 0.02 * never.sum()


def differences(exact: np.ndarray, at_once: np.ndarray, least_error: float) -> np.ndarray:
    """(n,): difference of the means over captures (captures, n), in standard errors."""
    variance = exact.var(axis=0, ddof=1) + at_once.var(axis=0, ddof=1)
    error = np.maximum(np.sqrt(variance / CAPTURES), least_error)
    return (exact.mean(axis=0) - at_once.mean(axis=0)) / error


@pytest.mark.parametrize("name", REGIONS)
def test_single_pixels_agree_in_mean_and_in_how_often_they_have_a_range(name: str):
    """At a hole before 200 mm: mean z and count of every pixel that is not certain; the largest of
    thousands."""
    exact, at_once = clouds_of(name, 200.0)
    exact_count = count_of(exact).astype(float)
    count = count_of(at_once).astype(float)
    mixed = np.minimum(exact_count.var(axis=0), count.var(axis=0)) > 0.1
    assert mixed.sum() > 30
    assert np.abs(differences(exact_count[:, mixed], count[:, mixed], 0.0)).max() < SURE
    always = np.isfinite(z_of(exact + at_once)).all(axis=0)
    off = differences(z_of(exact)[:, always], z_of(at_once)[:, always], 1e-7)
    assert np.abs(off).max() < SURE


def test_the_pixels_that_are_simulated_one_by_one_are_those_that_frames_lose():
    """Every pixel that some frame loses and another does not is on the list; few others, and no
    even face."""
    unit = unit_before_hole("azure_kinect_nfov", 200.0)
    z_m = stacked_z(unit, 100, 7)
    valid = np.isfinite(z_m).mean(axis=0)
    summer = unit.at_once
    assert summer is not None
    listed = np.zeros(summer.shape, bool)
    listed.ravel()[summer.listed] = True
    on_list = listed[unit.cut]
    assert on_list[(valid > 0) & (valid < 1)].all()
    assert not on_list[groups_of(unit)["face"]].any()
    assert on_list.mean() < 0.25


def test_prefixes_nest_and_do_not_hang_on_what_else_is_asked_for():
    unit = unit_before_hole("azure_kinect_nfov", 200.0)
    face = groups_of(unit)["face"]
    z_by_count: dict[int, list[np.ndarray]] = {20: [], 40: [], 80: []}
    for number in range(30):
        capture = unit.capture(80, 3, number)
        together = averages_of(capture, [1, 20, 40, 80], PLAIN, exact=False)
        for n in (1, 80):
            alone = averages_of(capture, [n], PLAIN, exact=False)[n]
            assert np.array_equal(together[n].points_m, alone.points_m, equal_nan=True)
            assert np.array_equal(together[n].variance_m2, alone.variance_m2, equal_nan=True)
        for n, values in z_by_count.items():
            values.append(together[n].points_m[..., 2][face])
    noise = {}
    for n, values in z_by_count.items():
        z_m = np.array(values)
        noise[n] = z_m - z_m.mean(axis=0)
    # a mean of 40 contains half of the first twenty's noise: cov(20, 40) = var(40), and so on
    for fewer, more_frames in ((20, 40), (40, 80)):
        products = (noise[fewer] * noise[more_frames]).mean(axis=1)
        squares = (noise[more_frames] ** 2).mean(axis=1)
        assert abs(compared(products, squares)) < SURE
        assert (noise[more_frames] ** 2).mean() < 0.6 * (noise[fewer] ** 2).mean()


def test_frames_that_jump_are_left_out_as_frames_are():
    """The same captures, whose frames are displaced alike: 20 of 30 frames of which some jump by
    17 mm."""
    unit = unit_before_hole("azure_kinect_nfov", 9.5, jump_rate=0.12)
    left_out = 0
    drawn_at_once = 0
    for number in range(20):
        capture = unit.capture(30, 5, number)
        exact = averages_of(capture, [20, 30], PLAIN, exact=True)
        at_once = averages_of(capture, [20, 30], PLAIN, exact=False)
        drawn_at_once += not np.array_equal(
            at_once[30].points_m, exact[30].points_m, equal_nan=True
        )
        for n in (20, 30):
            assert at_once[n].n_frames == exact[n].n_frames
            for frame, exact_frame in zip(at_once[n].left_out, exact[n].left_out, strict=True):
                assert frame.name == exact_frame.name
                # but for the displacement itself
                assert frame.why.split(" mm")[1:] == exact_frame.why.split(" mm")[1:]
            left_out += len(exact[n].left_out)
        off_m = at_once[30].points_m[..., 2] - exact[30].points_m[..., 2]
        assert np.nanmedian(off_m) == pytest.approx(0, abs=0.2 * MM)
    assert left_out > 40
    assert drawn_at_once > 15


def trial(
    unit: SimulatedUnit,
    number: int,
    hole: np.ndarray,
    exact: bool,
    detector: ThesisDetector,
):
    """The highest scores in the hole and anywhere else."""
    capture = unit.capture(FRAMES, 11, number, int(exact))
    cloud = averages_of(capture, [FRAMES], PLAIN, exact=exact)[FRAMES]
    score = detector.analyse(cloud).score
    return np.nanmax(score[hole]), np.nanmax(np.where(hole, np.nan, score))


@pytest.mark.slow
def test_a_detector_finds_as_often_and_calls_as_often_falsely():
    """A shallow hole near the limit, 200 trials each way: detection at a threshold that half the
    trials pass, the quiet threshold's distribution (Kolmogorov and Smirnov), and false calls at
    the threshold that one in five passes."""
    name = "azure_kinect_nfov"
    camera = camera_of(CameraConfig(name=name))
    outer = REGIONS[name].grown(
        camera.optics.margin_px, camera.nominal_lens.height, camera.nominal_lens.width
    )
    middle = camera.nominal_lens.region_slopes(REGIONS[name]).reshape(-1, 2).mean(axis=0)

    def covers(slopes: np.ndarray) -> np.ndarray:
        x = slopes[..., 0] - middle[0]
        y = slopes[..., 1] - middle[1]
        return np.hypot(x, y) > 0.0046

    back = Plane(FRONT.distance_m + 1.3 * MM, FRONT.slope_x, FRONT.slope_y)
    unit = SimulatedUnit(
        camera,
        CameraConfig(name=name),
        layered_view(
            camera,
            outer,
            FRONT,
            back,
            covers,
            0.6,
        ),
    )
    floor = (unit.view.surface == 1)[unit.cut]
    hole = ndimage.binary_dilation(floor, np.ones((7, 7)))
    detector = ThesisDetector(ThesisConfig(crop=NoCrop()))
    trials = range(200)
    exact = np.array(
        [
            trial(
                unit,
                number,
                hole,
                True,
                detector,
            )
            for number in trials
        ],
        float,
    )
    at_once = np.array(
        [
            trial(
                unit,
                number,
                hole,
                False,
                detector,
            )
            for number in trials
        ],
        float,
    )
    assert stats.ks_2samp(exact[:, 1], at_once[:, 1]).pvalue > 1e-4
    for column, share in ((0, 0.5), (1, 0.8)):
        limit = np.quantile(exact[:, column], share)
        assert abs(compared(exact[:, column] > limit, at_once[:, column] > limit)) < 4


def test_listed_pixels_go_through_the_same_chain_as_frames():
    """The filter on a list against the filter on the picture, from the same phasors."""
    unit = unit_before_hole("kinect_v2_libfreenect2", 200.0)
    summer = unit.at_once
    imager = unit.model
    assert summer is not None
    assert isinstance(imager, AmcwImager)
    light = summer.light
    halo = summer.list.halo
    ranges = summer.list.range
    shape = (len(halo), 3, LANES)
    words = random_stream(1).integers(2**32, size=shape, dtype=np.uint32)
    n_rows = len(halo) // kernels.BESIDE + 2
    planes = np.empty((n_rows, 3, 3, kernels.STRIDE), np.float32)
    noise = np.empty((len(halo), LANES), np.float32)
    kernels.noisy_phasors(
        light.phasor,
        light.amplitude,
        light.phase_noise,
        light.relative_noise,
        summer.shares,
        words,
        planes,
        noise,
    )
    filtered = np.empty((3, 3, len(ranges), LANES), np.float32)
    edge = np.empty((3, len(ranges), LANES), np.float32)
    kernels.filter_listed(
        planes,
        summer.list.window,
        imager.filter_settings,
        filtered,
        edge,
    )
    rows = planes.reshape(
        -1,
        3,
        3,
        kernels.BESIDE,
        LANES,
    ).transpose(
        0,
        3,
        1,
        2,
        4,
    )
    drawn = rows.reshape(-1, 3, 3, LANES)[: len(halo)]
    for lane in (0, LANES - 1):
        shape = unit.exposure.shape
        phasors = np.zeros((2, 3, np.prod(shape)), np.float32)
        amplitude = np.full((3, np.prod(shape)), -1, np.float32)
        phasors[:, :, halo] = drawn[:, :, :2, lane].transpose(2, 1, 0)
        amplitude[:, halo] = drawn[:, :, 2, lane].T
        of_picture, edge_of_picture = imager.filter(phasors, amplitude, shape)
        wanted = of_picture.reshape(3, 3, -1)[:, :, ranges]
        wanted_edge = edge_of_picture.reshape(3, -1)[:, ranges]
        tolerance = np.maximum(1e-4 * np.abs(wanted), 1e-2)
        assert (np.abs(filtered[..., lane] - wanted) <= tolerance).all()
        np.testing.assert_allclose(edge[..., lane], wanted_edge, rtol=0, atol=1e-4)


@pytest.mark.parametrize("method", ["median", "clipped"])
def test_other_means_and_exact_captures_are_drawn_frame_by_frame(method: str):
    capture = unit_before_hole("azure_kinect_nfov", 9.5).capture(8, 1)
    for config, exact in ((AverageConfig(method=method), False), (PLAIN, True)):
        ours = averages_of(capture, [8], config, exact=exact)[8]
        frames = prefix_averages(capture, [8], config)[8]
        assert np.array_equal(ours.points_m, frames.points_m, equal_nan=True)
    too_few = FEWEST_FRAMES - 1
    cloud = averages_of(capture, [too_few], PLAIN, exact=False)[too_few]
    frames = prefix_averages(capture, [too_few], PLAIN)[too_few]
    assert np.array_equal(cloud.points_m, frames.points_m, equal_nan=True)


def test_what_no_model_can_draw_at_once_is_drawn_frame_by_frame():
    """A lidar; a camera without noise, whose rounding nothing dithers; one whose samples may
    saturate or may not."""
    lidar = camera_of(CameraConfig(name="realsense_l515"))
    azure = camera_of(CameraConfig())
    quiet = CameraConfig(effects=EffectsConfig(noise=False))
    narrow = CameraConfig(numbers={"converter.full_scale_units": 820})
    region = Region(300, 330, 300, 330)
    lidar_view = plane_view(lidar, region, 0.7, 0.6)
    azure_view = plane_view(azure, region, 0.7, 0.6)
    units = (
        SimulatedUnit(lidar, CameraConfig(name="realsense_l515"), lidar_view),
        SimulatedUnit(azure, quiet, azure_view),
        SimulatedUnit(camera_of(narrow), narrow, azure_view),
    )
    for unit in units:
        assert unit.at_once is None
        capture = unit.capture(FEWEST_FRAMES, 1)
        ours = averages_of(capture, [FEWEST_FRAMES], PLAIN, exact=False)[FEWEST_FRAMES]
        frames = prefix_averages(capture, [FEWEST_FRAMES], PLAIN)[FEWEST_FRAMES]
        assert np.array_equal(ours.points_m, frames.points_m, equal_nan=True)
