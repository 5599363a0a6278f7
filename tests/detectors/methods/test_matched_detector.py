"""The matched detector: whitening against dense algebra, learning, heavy tails, holes that leave
one finding each, and sizes under correlated noise."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from detectors.findings.hole_model import (
    HoleFit,
    HolePatch,
    fit_hole,
    pictures,
    straight_sight,
    whitened,
)
from detectors.findings.templates import (
    bank,
    halved,
    responses,
    spectra,
    transformed,
    window_of,
    worths,
)
from detectors.findings.whitening import (
    CONVERGED,
    GRID,
    LONGEST_LAG_PX,
    covariance_factor,
    filters,
    grid_of,
    inverse_times,
    noise_covariance,
    spectrum,
)
from detectors.interface import Detection
from detectors.masks import grown
from detectors.methods.local import LocalDetector
from detectors.methods.matched import MatchedDetector
from harness.testing.synthetic_clouds import SHAPE, plane, without
from harness.vocabulary.geometry import Cloud

DETECTOR = MatchedDetector(MatchedDetector.settings_type.from_data({"crop": {"kind": "none"}}))
BLUR_PX = 5


def blurred(seed: int, shape: tuple[int, int] = SHAPE) -> np.ndarray:
    """Noise of deviation 1 that a square of 5 x 5 pixels correlates."""
    white = np.random.default_rng(seed).standard_normal((shape[0] + BLUR_PX, shape[1] + BLUR_PX))
    return np.asarray(cv2.blur(white, (BLUR_PX, BLUR_PX))[2:-3, 2:-3] * BLUR_PX)


def cloud_of(depth_m: np.ndarray) -> Cloud:
    """A frontal plane at 0.7 m with a picture of depths added."""
    flat = plane(seed=1, tilt=0.0)
    slopes = flat.points_m / flat.points_m[..., 2:]
    return replace(flat, points_m=slopes * (0.7 + depth_m)[..., None])


def hole(u: float, v: float, radius_px: float, depth_m: float) -> np.ndarray:
    """A hole as a camera sees it that averages over 5 x 5 pixels."""
    rows, columns = np.indices(SHAPE)
    disc = (np.hypot(columns - u, rows - v) < radius_px).astype(float)
    return np.asarray(depth_m * cv2.blur(disc, (BLUR_PX, BLUR_PX)))


def found(cloud: Cloud, threshold: float) -> tuple[Detection, ...]:
    return DETECTOR.find(cloud, DETECTOR.analyse(cloud), threshold)


def test_a_score_is_the_likelihoods_where_pixels_are_missing() -> None:
    """Beside the dense covariance of the known pixels alone, for each template that the picture
    holds: closely if solved to a small error, and within twice the error that `CONVERGED` states.
    """
    noise = blurred(1, (26, 30)).astype(np.float32)
    known = np.random.default_rng(2).random(noise.shape) > 0.1
    grid = grid_of(noise.shape)
    lags = noise_covariance(blurred(3).astype(np.float32), np.ones(SHAPE, bool), grid_of(SHAPE))
    power = spectrum(lags, grid)
    covariance = np.fft.irfft2(power, grid)
    places = np.argwhere(known)
    apart = places[:, None] - places
    dense = covariance[apart[..., 0], apart[..., 1]]
    assert window_of(lags) == BLUR_PX
    seen = np.where(known, noise, np.float32(0.0))
    by = filters(lags, noise.shape)
    solved = inverse_times(seen, known, by, error=0.01)
    rough = inverse_times(seen, known, by)
    for drawn, worth in zip(
        bank(BLUR_PX)[:10], worths(spectrum(lags, (GRID, GRID)), BLUR_PX), strict=False
    ):
        half = len(drawn.image) // 2
        template = np.pad(drawn.image, 20)[half + 7 : half + 33, half + 5 : half + 35]
        exact = template[known] @ np.linalg.solve(dense, noise[known])
        energy = template[known] @ np.linalg.solve(dense, template[known])
        assert (template * solved).sum() == pytest.approx(
            exact, rel=0.02, abs=0.02 * float(energy) ** 0.5
        )
        assert abs((template * rough).sum() - exact) < 2.0 * CONVERGED * energy**0.5
        assert 0.6 * worth.energy < energy < 1.02 * worth.energy


def test_a_factor_is_that_of_the_covariance_of_the_used_pixels() -> None:
    random = np.random.default_rng(4)
    used = random.random((9, 11)) > 0.2
    lags = np.abs(np.arange(-8, 9))
    correlation = np.outer(0.6**lags, 0.7**lags)
    error = np.where(used, 2e-4 * random.random(used.shape), np.nan)
    factor = covariance_factor(used, correlation, 3e-4, error)
    assert factor is not None
    apart = np.abs(np.argwhere(used)[:, None] - np.argwhere(used))
    alike = 0.6 ** apart[..., 0] * 0.7 ** apart[..., 1] * (apart <= 8).all(axis=-1)
    dense = alike * (3e-4**2 + np.outer(error[used], error[used]))
    np.testing.assert_allclose(np.tril(factor) @ np.tril(factor).T, dense, atol=1e-14 * dense.max())
    assert covariance_factor(used, None, 3e-4, error) is None
    assert covariance_factor(used, 0.0 * correlation, 3e-4, error) is None


def test_sizes_under_correlated_noise_scatter_as_the_bound_says() -> None:
    """A hundred blind holes of 10 mm and 6 mm: scatter and stated errors are those of the
    Cramér-Rao bound, where plain least squares scatter half as widely again, and the far pixels
    that are left out would add next to nothing."""
    pitch = 1.4e-3
    shape = (31, 31)
    noise_m = 4e-4
    per_px = np.array([[pitch, 0.0, 0.0], [0.0, pitch, 0.0]])
    lags = BLUR_PX - np.abs(np.arange(-LONGEST_LAG_PX, LONGEST_LAG_PX + 1))
    correlation = np.outer(np.maximum(lags, 0), np.maximum(lags, 0)) / BLUR_PX**2
    correlation[LONGEST_LAG_PX, LONGEST_LAG_PX] += 0.1
    blank = HolePatch(
        np.zeros(shape),
        np.ones(shape, bool),
        per_px @ per_px.T,
        (5.0, 5.0),
        noise_m,
        straight_sight(per_px)[None],
    )
    truth = np.array([15.2, 14.7, 5e-3, 6e-3, 0.5])
    image = pictures(blank, truth[None])[0]
    near = grown(image > 0.5 * truth[3], 7)
    fits: dict[str, list[HoleFit]] = {}
    everywhere = np.ones(shape, bool)
    for name, given, kept in (
        ("all", correlation, everywhere),
        ("thinned", correlation, near),
        ("plain", None, near),
    ):
        fits[name] = []
        for seed in range(100):
            rough = 0.3 * np.random.default_rng(100 + seed).standard_normal(shape)
            seen = image + noise_m * (blurred(seed, shape) + rough)
            patch = whitened(replace(blank, residual_m=seen), given, 0.0, kept)
            fits[name].append(fit_hole(patch, 15.0, 15.0, 4e-3, 5e-3, 0.0))
    scatter = {name: np.std([each.radius_m for each in some]) for name, some in fits.items()}
    assert scatter["thinned"] < 0.7 * scatter["plain"]
    errors = {
        name: np.sqrt([each.covariance[2, 2] for each in some]) for name, some in fits.items()
    }
    assert np.median(errors["thinned"] / errors["all"]) < 1.04
    assert 0.6 < scatter["thinned"] / np.median(errors["thinned"]) < 1.3
    assert abs(np.mean([each.radius_m for each in fits["thinned"]]) - 5e-3) < 1e-4


def test_a_deep_hole_is_one_finding_and_two_that_touch_are_two() -> None:
    deep = hole(40, 45, 3.0, 0.03) + 3e-4 * blurred(5)
    assert len(found(cloud_of(deep), 5.0)) == 1
    touching = hole(40, 45, 3.0, 0.03) + hole(50, 45, 3.0, 0.03) + 3e-4 * blurred(6)
    assert len(found(cloud_of(touching), 5.0)) == 2


def test_a_slot_is_found_at_a_lower_depth_than_discs_find_it() -> None:
    """A slot 2 pixels wide and 20 long under white noise, at an angle that no template has: found
    at a score of 5.5 at a depth at which the best disc or dent would have less."""
    finer = 4
    places = (np.indices((SHAPE[0] * finer, SHAPE[1] * finer)) + 0.5) / finer - 0.5
    along = (places[1] - 60.4 + 1j * (places[0] - 45.2)) * np.exp(-1j * np.radians(50.0))
    inside = (np.abs(along.real) < 10.0) & (np.abs(along.imag) < 1.0)
    slot = inside.reshape(SHAPE[0], finer, SHAPE[1], finer).mean(axis=(1, 3))
    grid = grid_of(SHAPE)
    views = [transformed(slot, grid)]
    views.append(halved(views[0]))
    scores: dict[bool, list[float]] = {False: [], True: []}
    energies = [worth.energy for worth in worths(np.ones((GRID, GRID // 2 + 1), np.float32), 1)]
    for pair, numbers in spectra(grid, 1):
        fields = responses(views[bank(1)[numbers[0]].coarse], pair)
        for channel, number in enumerate(numbers):
            scores[bank(1)[number].slot].append(
                float(fields[..., channel].max()) / energies[number] ** 0.5
            )
    discs = max(scores[False])
    slots = max(scores[True])
    depth = 7.5 / slots
    assert depth * discs < 5.5
    for seed in (20, 21, 22):
        noise = np.random.default_rng(seed).standard_normal(SHAPE)
        places_found = found(cloud_of(3e-4 * (noise + depth * slot)), 5.5)
        assert len(places_found) == 1
        assert (
            np.hypot(*(np.array(np.unravel_index(places_found[0].pixels[0], SHAPE)) - (45.2, 60.4)))
            < 8.0
        )


def test_a_hole_that_the_model_does_not_fit_is_measured_by_its_contour() -> None:
    """A mouth as sharp as no camera with the assumed window shows it, beside the same through that
    window."""
    rows, columns = np.indices(SHAPE)
    sharp = 0.01 * (np.hypot(columns - 60, rows - 45) < 4.0)
    notes = []
    for image in (sharp, hole(60, 45, 4.0, 0.01)):
        cloud = cloud_of(image + 1e-4 * blurred(17))
        evidence = DETECTOR.analyse(cloud)
        notes.append(
            DETECTOR.measure(cloud, evidence, DETECTOR.find(cloud, evidence, 6.0)[0]).model_note
        )
    assert "does not fit" in notes[0] and not notes[1]


def test_missing_pixels_add_to_a_faint_depth_and_alone_are_no_finding() -> None:
    """Six pixels without a return in a hole whose depth alone is not enough; scattered ones change
    the noise's highest score by less than 0.3, and six that stand alone stay below a threshold."""
    noise = cloud_of(3e-4 * blurred(15))
    gone = np.zeros(SHAPE, bool)
    gone[44:46, 59:62] = True
    faint = cloud_of(3e-4 * blurred(15) + hole(60, 44.5, 2.5, 1.1e-3))
    with_depth = without(faint, gone)
    alone = without(noise, gone)
    shown = np.flatnonzero(hole(60, 44.5, 2.5, 1.0) > 0)
    without_channel = LocalDetector.analyse(DETECTOR, with_depth).score.ravel()[shown]
    assert np.nanmax(without_channel) < 4.2
    assert any(np.isin(each.pixels, shown).any() for each in found(with_depth, 4.5))
    assert not any(np.isin(each.pixels, shown).any() for each in found(alone, 4.2))
    scattered = without(noise, np.random.default_rng(16).random(SHAPE) < 0.01)
    depth_only = np.nanmax(LocalDetector.analyse(DETECTOR, scattered).score)
    assert abs(DETECTOR.quiet_threshold(scattered, DETECTOR.analyse(scattered)) - depth_only) < 0.3


def test_light_along_the_rim_is_no_finding() -> None:
    """The outer three rows stand three deviations before the surface, as where a floor's light
    comes back."""
    rim = np.where(np.arange(SHAPE[0])[:, None] >= SHAPE[0] - 3, -9e-4, 0.0) + 3e-4 * blurred(7)
    assert not found(cloud_of(rim), 5.5)


def test_the_learned_covariance_is_that_of_the_noise_and_is_used() -> None:
    """On a cloud too small to measure its own."""
    clouds = [cloud_of(3e-4 * blurred(seed)) for seed in range(8, 12)]
    learned = dict(DETECTOR.calibrate(clouds))
    lags = (
        learned["covariance"][LONGEST_LAG_PX, LONGEST_LAG_PX : LONGEST_LAG_PX + 6]
        / learned["covariance"].max()
    )
    np.testing.assert_allclose(lags[1:4], [0.8, 0.6, 0.4], atol=0.08)
    cloud = cloud_of(3e-4 * blurred(13) + hole(60, 45, 2.0, 0.002))
    taught = DETECTOR.calibrated(learned)
    assert (taught.name, taught.version) == (DETECTOR.name, DETECTOR.version)
    own = DETECTOR.analyse(cloud).score
    by_others = taught.analyse(cloud).score
    assert not np.array_equal(own, by_others)
    assert abs(np.log(np.nanmax(by_others) / np.nanmax(own))) < 0.2
    assert not DETECTOR.calibrate([])


def test_heavy_tails_raise_single_pixels_no_farther_than_they_reach() -> None:
    """One pixel in 300 has five times the noise: the narrow templates' scores are scaled by their
    own tail, so that the highest (5.4 without) is little above that of Gaussian noise (4.7), and a
    hole of many pixels is found beside."""
    rng = np.random.default_rng(14)
    sizes = np.where(rng.random(SHAPE) < 1 / 300, 5.0, 1.0)
    noise = 3e-4 * sizes * rng.standard_normal(SHAPE)
    cloud = cloud_of(noise)
    quiet = DETECTOR.quiet_threshold(cloud, DETECTOR.analyse(cloud))
    assert quiet < 5.0
    places = found(cloud_of(noise + hole(60, 45, 4.0, 0.0015)), quiet + 1.0)
    assert len(places) == 1
