"""Frames from the first-order model against frames of the whole chain, in distribution.

Frames are independent, so each statistic of a frame (a mean over a group of pixels of z, of its
square, of products with neighbours, of what lies beyond some deviations, of each reason, and the
same of amplitudes) is compared between many frames of either kind by the two-sample t test; 5
standard errors is one false alarm in 2 million.
"""

from __future__ import annotations

import warnings
from functools import lru_cache
from typing import NamedTuple

import numpy as np
import pytest
from scipy import ndimage, stats

from detectors.averages.average import AverageConfig, average
from detectors.crop import NoCrop
from detectors.methods.thesis import ThesisConfig, ThesisDetector
from harness.vocabulary.geometry import MM, Reason, Region
from harness.vocabulary.seeds import random_stream
from scenes.closed_form import Plane, layered_view, plane_view
from scenes.sensor.amcw import first_order, kernels
from scenes.sensor.amcw.facts import AmcwCamera, ExposuresFacts
from scenes.sensor.amcw.first_order import joined_moves
from scenes.sensor.amcw.halo import draw_light, drawn_light
from scenes.sensor.amcw.halo_reference import noisy_phasors
from scenes.sensor.amcw.imager import AmcwImager, NoisyLight
from scenes.sensor.amcw.light import light_of_samples
from scenes.sensor.amcw.listed import decoded
from scenes.sensor.camera import camera_of
from scenes.sensor.common.config import CameraConfig, EffectsConfig
from scenes.sensor.common.normals import standard_normals
from scenes.sensor.common.unit import DecodedFrame
from scenes.sensor.source import SimulatedUnit

REGIONS = {
    "azure_kinect_nfov": Region(306, 338, 296, 352),
    "kinect_v2_libfreenect2": Region(196, 228, 226, 282),
    "pmd_flexx2": Region(70, 102, 84, 140),
}
FILTERING = ["azure_kinect_nfov", "kinect_v2_libfreenect2"]
"""Cameras with a window; without one, no pixel before a hole is doubtful."""
STILL = EffectsConfig(frame_jumps=False)
FRONT = Plane(0.7, 0.08, 0.05)
NOTHING_BEHIND_M = 8.0
"""So far behind that what comes back is less than the noise."""
BRIGHT_ELECTRONS = 9000.0
"""At which the plate would fill the Azure Kinect's wells, and a plane 200 mm behind it would not."""
FRAMES = 400
FEWEST_PIXELS = 12  # of a group, for statistics of their z
SURE = 5.0
MOST_LAG = 0.08
"""Largest difference of correlations of amplitudes at rims and on floors; measured: 0.07."""


class Frames(NamedTuple):
    """k frames of a unit's region."""

    z_m: np.ndarray
    """(k, h, w): NaN without a range."""
    reason: np.ndarray
    """(k, h, w)."""
    amplitude: np.ndarray
    """(k, h, w)."""


@pytest.fixture(autouse=True)
def many_listed(monkeypatch: pytest.MonkeyPatch) -> None:
    """A limit of cost: in these small pictures, more pixels are doubtful."""
    monkeypatch.setattr(first_order, "MOST_LISTED", 0.6)


def numbers_of(name: str) -> dict[str, float]:
    """A Kinect v2 with a finer converter: by its own, dark pixels' noise hides no steps, so that
    all of them are listed."""
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
    model = unit.first_order
    assert model is not None
    linear = model.linear
    assert np.isfinite(linear.moves).all()
    height, width = model.shape
    rows, columns = np.divmod(linear.uneven, width)
    side = round(np.sqrt(linear.moves.shape[1]))
    windows = linear.moves.reshape(-1, side, side)
    beyond = np.arange(side) - side // 2
    outside_rows = (rows[:, None] + beyond < 0) | (rows[:, None] + beyond >= height)
    outside_columns = (columns[:, None] + beyond < 0) | (columns[:, None] + beyond >= width)
    outside = outside_rows[:, :, None] | outside_columns[:, None, :]
    assert (windows[outside] == 0.0).all()
    assert np.abs(windows).sum(axis=(1, 2)).min() > 0.0
    assert (rows < 2).any() or (columns < 2).any()


def frames_before(unit: SimulatedUnit) -> tuple[Frames, Frames]:
    """Frames of the whole chain, and of the first-order model."""
    model = unit.first_order
    assert model is not None
    rng = random_stream(1)
    by_chain = []
    drawn = []
    for _ in range(FRAMES):
        by_chain.append(unit.model.frame(unit.exposure, rng))
        drawn.append(model.frame(rng, 0.0))
    return stacked(unit, by_chain), stacked(unit, drawn)


def stacked(unit: SimulatedUnit, frames: list[DecodedFrame]) -> Frames:
    return Frames(
        z_m=np.stack([frame.z_m[unit.cut] for frame in frames]),
        reason=np.stack([frame.reason[unit.cut] for frame in frames]),
        amplitude=np.stack([frame.amplitude[unit.cut] for frame in frames]),
    )


@lru_cache
def frames_of(name: str, behind_mm: float) -> tuple[Frames, Frames]:
    """Those before a hole."""
    return frames_before(unit_before_hole(name, behind_mm))


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
    values: np.ndarray, group: np.ndarray, all_values: np.ndarray
) -> dict[str, np.ndarray]:
    """(k,) each: statistics over a group's pixels (h, w) of ``values`` (k, h, w).
    ``all_values`` (k', h, w), of both kinds of frames, give the common mean and deviation."""
    statistics: dict[str, np.ndarray] = {}
    measured = group & (np.isfinite(all_values).mean(axis=0) > 0.5)
    if measured.sum() < FEWEST_PIXELS:
        return statistics
    standard = standardised(values, all_values)
    standard = np.where(measured & np.isfinite(standard), standard, 0.0)
    statistics["mean"] = standard[:, measured].mean(axis=1)
    statistics["variance"] = (standard[:, measured] ** 2).mean(axis=1)
    statistics["highest"] = standard[:, measured].max(axis=1)
    statistics["lowest"] = standard[:, measured].min(axis=1)
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


def standardised(values: np.ndarray, all_values: np.ndarray) -> np.ndarray:
    """Values (k, h, w) minus the mean of each pixel, over its deviation."""
    with np.errstate(invalid="ignore"), warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # pixels without any range
        deviation = np.maximum(np.nanstd(all_values, axis=0), 1e-7)
        return (values - np.nanmean(all_values, axis=0)) / deviation


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
def test_frames_have_the_distribution_of_those_of_the_whole_chain(name: str, behind_mm: float):
    """Dents and blind holes (2 and 9.5 mm), and through-holes with a backing near, far and none."""
    assert_alike(unit_before_hole(name, behind_mm), *frames_of(name, behind_mm))


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
    assert_alike(unit, *frames_before(unit))


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
    knee = float(camera.converter.knee_units.value)
    light = light_of_samples(unit.exposure, knee, np.ones(len(camera.frequencies_hz)))
    assert 0.055 < np.median(light.phase_noise.max(axis=0)) < 0.13
    assert_alike(unit, *frames_before(unit))


def assert_alike(unit: SimulatedUnit, by_chain: Frames, drawn: Frames) -> None:
    """By every statistic of every group of pixels."""
    all_frames = Frames._make(np.concatenate(pair) for pair in zip(by_chain, drawn, strict=True))
    assert not np.array_equal(by_chain.z_m, drawn.z_m, equal_nan=True)
    assert np.array_equal(np.isfinite(drawn.z_m), drawn.reason == Reason.VALID)
    for group, pixels in groups_of(unit).items():
        statistics = []
        for frames in (by_chain, drawn):
            values = {}
            for reason in np.unique(all_frames.reason):
                values[f"reason {reason}"] = (frames.reason[:, pixels] == reason).mean(axis=1)
            for quantity in ("z_m", "amplitude"):
                of_quantity = statistics_of(
                    getattr(frames, quantity).astype(float), pixels, getattr(all_frames, quantity)
                )
                values |= {f"{quantity} {key}": value for key, value in of_quantity.items()}
            statistics.append(values)
        off = {}
        for key, value in statistics[0].items():
            off[key] = compared(value, statistics[1][key])
        if group != "face":
            # amplitudes at rims share more of their noise, and those on floors less
            for key in [key for key in off if key.startswith("amplitude lag")]:
                correlations = []
                for values in statistics:
                    variance = values["amplitude variance"].mean()
                    correlations.append(values[key].mean() / variance)
                assert correlations[1] == pytest.approx(correlations[0], abs=MOST_LAG)
                del off[key]
        wrong = {key: value for key, value in off.items() if abs(value) > SURE}
        assert not wrong, (group, wrong)


def differences(by_chain: np.ndarray, drawn: np.ndarray, least_error: float) -> np.ndarray:
    """(n,): difference of the means over frames (k, n), in standard errors."""
    variance = by_chain.var(axis=0, ddof=1) + drawn.var(axis=0, ddof=1)
    error = np.maximum(np.sqrt(variance / FRAMES), least_error)
    return (by_chain.mean(axis=0) - drawn.mean(axis=0)) / error


@pytest.mark.parametrize("name", FILTERING)
def test_single_pixels_agree_in_mean_and_in_how_often_they_have_a_range(name: str):
    """At a hole before 200 mm: the largest difference of thousands."""
    by_chain, drawn = frames_of(name, 200.0)
    valid_in_whole = np.isfinite(by_chain.z_m).astype(float)
    valid = np.isfinite(drawn.z_m).astype(float)
    mixed = np.minimum(valid_in_whole.var(axis=0), valid.var(axis=0)) > 0.02
    assert mixed.sum() > 30
    assert np.abs(differences(valid_in_whole[:, mixed], valid[:, mixed], 0.0)).max() < SURE
    always = np.isfinite(by_chain.z_m).all(axis=0) & np.isfinite(drawn.z_m).all(axis=0)
    off = differences(by_chain.z_m[:, always], drawn.z_m[:, always], 1e-7)
    assert np.abs(off).max() < SURE
    off = differences(
        by_chain.amplitude.reshape(FRAMES, -1), drawn.amplitude.reshape(FRAMES, -1), 0.0
    )
    assert np.abs(off).max() < SURE


def test_the_listed_pixels_are_those_that_frames_lose():
    """Every pixel that some frame loses and another does not is on the list; few others, and no
    even face."""
    unit = unit_before_hole("azure_kinect_nfov", 200.0)
    by_chain, _ = frames_of("azure_kinect_nfov", 200.0)
    valid = np.isfinite(by_chain.z_m).mean(axis=0)
    model = unit.first_order
    assert model is not None
    listed = np.zeros(model.shape, bool)
    listed.ravel()[model.listed.pixels] = True
    on_list = listed[unit.cut]
    assert on_list[valid < 1].all()
    assert not on_list[groups_of(unit)["face"]].any()
    assert on_list.mean() < 0.4


def test_fewer_frames_are_a_prefix_of_more():
    unit = unit_before_hole("azure_kinect_nfov", 200.0)
    few = list(unit.capture(1, 3).frames())
    many = list(unit.capture(3, 3).frames())
    for number, frame in enumerate(few):
        assert np.array_equal(frame.z_m, many[number].z_m, equal_nan=True)
    rng = random_stream(3, "frames")
    assert unit.first_order is not None
    for frame in many:
        drawn = unit.first_order.frame(rng, 0.0)
        assert np.array_equal(frame.z_m, drawn.z_m[unit.cut], equal_nan=True)
        assert np.array_equal(frame.amplitude, drawn.amplitude[unit.cut])


def test_a_displaced_frame_is_farther_by_its_displacement():
    unit = unit_before_hole("azure_kinect_nfov", 200.0)
    model = unit.first_order
    assert model is not None
    face = groups_of(unit)["face"]
    still = model.frame(random_stream(5), 0.0).z_m[unit.cut]
    displaced = model.frame(random_stream(5), 0.006).z_m[unit.cut]
    by_chain = unit.model.frame(unit.exposure, random_stream(5)).z_m[unit.cut]
    displaced_whole = unit.model.frame(unit.exposure, random_stream(5), 0.006).z_m[unit.cut]
    expected_m = np.nanmean((displaced_whole - by_chain)[face])
    assert np.nanmean((displaced - still)[face]) == pytest.approx(expected_m, abs=3e-5)
    listed = np.zeros(model.shape, bool)
    listed.ravel()[model.listed.pixels] = True
    change_m = (displaced - still)[listed[unit.cut]]
    assert np.nanmedian(change_m) == pytest.approx(expected_m, abs=1e-3)


def test_limits_of_range_allow_for_the_largest_displacement_of_a_frame():
    """A jump, the drift and six deviations of the jitter in the same direction."""
    unit = unit_before_hole("azure_kinect_nfov", 200.0)
    model = unit.first_order
    assert model is not None
    jitter_mm = unit.model.jitter_mm(unit.exposure)
    assert jitter_mm > 0.02
    assert model.farthest_error_m / MM == pytest.approx(17.0 + 2.0 + 6.0 * jitter_mm)


def trial(
    unit: SimulatedUnit,
    number: int,
    hole: np.ndarray,
    by_chain: bool,
    detector: ThesisDetector,
):
    """The highest scores in the hole and anywhere else, in the mean of eight frames."""
    capture = unit.capture(8, 11, number, int(by_chain))
    with pytest.MonkeyPatch.context() as patch:
        if by_chain:
            patch.setitem(unit.__dict__, "first_order", None)
        cloud = average(capture, AverageConfig())
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
    by_chain = np.array(
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
    drawn = np.array(
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
    assert stats.ks_2samp(by_chain[:, 1], drawn[:, 1]).pvalue > 1e-4
    for column, share in ((0, 0.5), (1, 0.8)):
        limit = np.quantile(by_chain[:, column], share)
        assert abs(compared(by_chain[:, column] > limit, drawn[:, column] > limit)) < 4


@pytest.mark.parametrize("name", FILTERING)
def test_listed_pixels_go_through_the_same_chain_as_frames(name: str):
    """A reading of the whole picture: the list's result is that of the picture, bit for bit."""
    unit = unit_before_hole(name, 200.0)
    imager = unit.model
    model = unit.first_order
    assert model is not None
    assert isinstance(imager, AmcwImager)
    listed = model.listed
    reading = imager.reading(unit.exposure, random_stream(1))
    by_chain = imager.frame(unit.exposure, random_stream(1), 0.002)
    # the last one stands for what is beyond the picture
    of_list = NoisyLight(
        unit=np.pad(reading.unit[..., listed.halo], ((0, 0), (0, 0), (0, 1))),
        amplitude=np.pad(
            reading.amplitude[:, listed.halo], ((0, 0), (0, 1)), constant_values=kernels.OUTSIDE
        ),
        saturated=np.append(reading.saturated[listed.halo], np.uint8(1)),
    )
    part = decoded(listed, imager, of_list, 0.002)
    assert len(listed.pixels) > 100
    # windows of runs in rows, and turned ones of runs in columns
    assert listed.columns.min() < listed.turned <= listed.columns.max()
    for values, of_picture in zip(part, by_chain, strict=True):
        wanted = of_picture.ravel()[listed.pixels]
        assert np.array_equal(values, wanted, equal_nan=True)


@pytest.mark.parametrize("name", FILTERING)
def test_light_around_listed_pixels_is_that_of_the_reference(name: str):
    model = unit_before_hole(name, 200.0).first_order
    assert model is not None
    halo = model.halo
    frequencies, size = halo.length.shape
    normals = standard_normals(random_stream(6), (2, model.linear.z.size))
    others = standard_normals(random_stream(7), (2, frequencies - 1, size))
    unit = np.empty((2, frequencies, size), np.float32)
    amplitude = np.empty((frequencies, size), np.float32)
    draw_light(halo, normals, others, unit, amplitude)
    phasors = noisy_phasors(halo, normals, others)
    np.testing.assert_allclose(amplitude * (unit[0] + 1j * unit[1]), phasors, rtol=1e-5, atol=1e-4)
    np.testing.assert_allclose(amplitude, np.abs(phasors), rtol=1e-5, atol=1e-4)


@pytest.mark.parametrize("name", FILTERING)
def test_light_around_listed_pixels_is_distributed_as_readings(name: str):
    """Means and variances of each frequency's noise across and along, in 400 draws."""
    unit = unit_before_hole(name, 200.0)
    imager = unit.model
    model = unit.first_order
    assert model is not None
    assert isinstance(imager, AmcwImager)
    halo = model.halo
    direction = halo.direction[0] + 1j * halo.direction[1]
    rng = random_stream(8)
    exposure = unit.exposure.part(halo.pixels)
    drawn = []
    read = []
    for _ in range(FRAMES):
        normals = standard_normals(rng, (2, model.linear.z.size))
        light = drawn_light(halo, imager, normals, rng)
        assert light.saturated[-1] == 1
        assert not light.saturated[:-1].any()
        for reading, kept in ((light, drawn), (imager.reading(exposure, rng), read)):
            amplitude = reading.amplitude[:, : halo.pixels.size]
            unit_phasors = reading.unit[0] + 1j * reading.unit[1]
            kept.append(amplitude * unit_phasors[:, : halo.pixels.size] / direction)
    for part in (np.real, np.imag):
        first = part(np.array(drawn))
        second = part(np.array(read))
        off = differences(first, second, 1e-6)
        assert np.sqrt((off**2).mean()) == pytest.approx(1.0, abs=0.05)
        ratios = first.var(axis=0) / second.var(axis=0)
        np.testing.assert_allclose(np.median(ratios, axis=-1), 1.0, atol=0.02)


@pytest.mark.parametrize("name", FILTERING)
def test_linear_pixels_share_the_noise_of_the_light_around_listed_ones(name: str):
    """Noise of the phases, each weighted by its noise in z, and of the sum of amplitudes; the
    frequencies' noise is independent."""
    unit = unit_before_hole(name, 200.0)
    model = unit.first_order
    assert model is not None
    halo = model.halo
    frequencies, size = halo.length.shape
    normals = standard_normals(random_stream(6), (2, model.linear.z.size))
    others = standard_normals(random_stream(7), (2, frequencies - 1, size))
    ratio = noisy_phasors(halo, normals, others) / (halo.direction[0] + 1j * halo.direction[1])
    across = ratio.imag / halo.across
    along = (ratio.real - halo.length) / halo.along
    light = light_of_samples(
        unit.exposure, float(unit.camera.converter.knee_units.value), unit.model.gains
    )
    noise_m = (first_order._metres_by_phase(unit.model, light) * light.phase_noise)[:, halo.pixels]
    shares = noise_m / np.sqrt((noise_m**2).sum(axis=0))
    np.testing.assert_allclose((shares * across).sum(axis=0), normals[0, halo.pixels], atol=2e-3)
    summed = (halo.along * along).sum(axis=0) / np.sqrt((halo.along**2).sum(axis=0))
    np.testing.assert_allclose(summed, normals[1, halo.pixels], atol=2e-3)
    for noise in (across, along):
        np.testing.assert_allclose(np.cov(noise), np.eye(frequencies), atol=5 / np.sqrt(size))


def test_moves_of_independent_frequencies_add_as_squares_with_the_sign_of_the_sum():
    rng = np.random.default_rng(1)
    moves = rng.standard_normal((3, 40, 25)).astype(np.float32)
    scales = np.array([0.5, 1.0, 2.0], np.float32)
    chosen = np.array([0, 7, 39])
    pulls = scales[:, None, None] * moves[:, chosen]
    expected = np.sign(pulls.sum(axis=0)) * np.sqrt((pulls**2).sum(axis=0))
    np.testing.assert_allclose(joined_moves(moves, chosen, scales), expected, rtol=1e-6)


def test_pixels_that_may_saturate_are_listed():
    """A converter that ends in the midst of the plate's samples."""
    config = CameraConfig(effects=STILL, numbers={"converter.full_scale_units": 860})
    camera = camera_of(config)
    view = plane_view(camera, Region(300, 332, 300, 356), 0.7, 0.6, 0.6, 0.2)
    unit = SimulatedUnit(camera, config, view)
    model = unit.first_order
    assert model is not None
    by_chain, drawn = frames_before(unit)
    saturated = (by_chain.reason == Reason.SATURATED).mean(axis=0)
    assert ((saturated > 0.01) & (saturated < 0.99)).sum() > 20
    assert_alike(unit, by_chain, drawn)


def test_pixels_whose_noise_hides_no_steps_of_the_converter_are_listed():
    """Those far behind a hole before a Kinect v2."""
    name = "kinect_v2_libfreenect2"
    config = CameraConfig(name=name, effects=STILL)
    unit = SimulatedUnit(camera_of(config), config, unit_before_hole(name, 200.0).view)
    model = unit.first_order
    assert model is not None
    listed = np.isin(np.arange(np.prod(model.shape)), model.listed.pixels).reshape(model.shape)
    assert listed[unit.cut][groups_of(unit)["floor"]].all()
    assert_alike(unit, *frames_before(unit))


def test_what_no_model_draws_goes_through_the_whole_chain():
    """A lidar, and a camera without noise, whose rounding nothing dithers."""
    lidar = camera_of(CameraConfig(name="realsense_l515"))
    azure = camera_of(CameraConfig())
    quiet = CameraConfig(effects=EffectsConfig(noise=False))
    region = Region(300, 330, 300, 330)
    units = (
        SimulatedUnit(
            lidar, CameraConfig(name="realsense_l515"), plane_view(lidar, region, 0.7, 0.6)
        ),
        SimulatedUnit(azure, quiet, plane_view(azure, region, 0.7, 0.6)),
    )
    for unit in units:
        assert unit.first_order is None
        assert len(list(unit.capture(2, 1).frames())) == 2
