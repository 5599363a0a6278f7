"""The matched detector: whitening against dense algebra, learning, heavy tails, holes that leave
one finding each, and sizes under correlated noise."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from detectors.findings.templates import (
    SLOTS_DEG,
    bank,
    halved,
    responses,
    spectra,
    transformed,
    worths,
)
from detectors.findings.whitening import (
    GRID,
    LONGEST_LAG_PX,
    grid_of,
)
from detectors.interface import Detection, Evidence
from detectors.methods import local as local_methods
from detectors.methods.deviations import RIM_PX, in_deviations, without_rim
from detectors.methods.local import LocalDetector
from detectors.methods.matched import (
    CLIP_SIGMAS,
    MatchedDetector,
    _cores,
    _fill_discs,
    _side_lobes,
    _tamed,
)
from detectors.methods.scatter import WIDE_PX
from detectors.pixels.masks import grown, outline_depth_px
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


def detections_in(cloud: Cloud, threshold: float) -> tuple[Detection, ...]:
    return DETECTOR.find(cloud, DETECTOR.analyse(cloud), threshold)


def test_a_deep_hole_is_one_finding_and_two_that_touch_are_two() -> None:
    deep = hole(40, 45, 3.0, 0.03) + 3e-4 * blurred(5)
    assert len(detections_in(cloud_of(deep), 5.5)) == 1
    touching = hole(40, 45, 3.0, 0.03) + hole(50, 45, 3.0, 0.03) + 3e-4 * blurred(6)
    assert len(detections_in(cloud_of(touching), 5.5)) == 2


def test_a_slot_is_found_at_a_lower_depth_than_discs_find_it() -> None:
    """A slot 2 pixels wide and 20 long under white noise, at an angle that no template has: found
    at a score of 5.5 at a depth at which the best disc or dent would have less."""
    finer = 4
    height, width = SHAPE
    v, u = (np.indices((height * finer, width * finer)) + 0.5) / finer - 0.5
    along = (u - 60.4 + 1j * (v - 45.2)) * np.exp(-1j * np.radians(50.0))
    inside = (np.abs(along.real) < 10.0) & (np.abs(along.imag) < 1.0)
    slot = inside.reshape(height, finer, width, finer).mean(axis=(1, 3))
    grid = grid_of(SHAPE)
    fine = transformed(slot, grid)
    coarse = halved(fine)
    scores: dict[bool, list[float]] = {False: [], True: []}
    energies = [worth.energy for worth in worths(np.ones((GRID, GRID // 2 + 1), np.float32), 1)]
    for pair, numbers in spectra(grid, 1):
        fields = responses(coarse if bank(1)[numbers[0]].coarse else fine, pair)
        for channel, number in enumerate(numbers):
            score = float(fields[..., channel].max()) / energies[number] ** 0.5
            scores[bank(1)[number].slot is not None].append(score)
    depth = 7.5 / max(scores[True])
    assert depth * max(scores[False]) < 5.5
    for seed in (20, 21, 22):
        noise = np.random.default_rng(seed).standard_normal(SHAPE)
        (detection,) = detections_in(cloud_of(3e-4 * (noise + depth * slot)), 5.5)
        rows, columns = np.unravel_index(detection.pixels, SHAPE)
        assert np.hypot(rows.mean() - 45.2, columns.mean() - 60.4) < 2.0


def test_the_error_of_a_hole_contains_what_the_model_does_not_explain() -> None:
    """A mouth as sharp as no camera with the assumed window shows it, beside the same through that
    window."""
    rows, columns = np.indices(SHAPE)
    sharp = 0.01 * (np.hypot(columns - 60, rows - 45) < 4.0)
    errors_m = []
    for image in (sharp, hole(60, 45, 4.0, 0.01)):
        cloud = cloud_of(image + 1e-4 * blurred(17))
        evidence = DETECTOR.analyse(cloud)
        detection = DETECTOR.find(cloud, evidence, 6.0)[0]
        measured = DETECTOR.measure(cloud, evidence, detection)
        assert not measured.model_note
        errors_m.append(measured.model_diameter_se_m)
    assert errors_m[0] > 1.5 * errors_m[1]


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

    def is_found(cloud: Cloud, threshold: float) -> bool:
        detections = detections_in(cloud, threshold)
        return any(np.isin(detection.pixels, shown).any() for detection in detections)

    without_channel = LocalDetector.analyse(DETECTOR, with_depth).score.ravel()[shown]
    assert np.nanmax(without_channel) < 4.2
    assert is_found(with_depth, 4.5)
    assert not is_found(alone, 4.2)
    scattered = without(noise, np.random.default_rng(16).random(SHAPE) < 0.01)
    depth_only = np.nanmax(LocalDetector.analyse(DETECTOR, scattered).score)
    highest = DETECTOR.quiet_threshold(scattered, DETECTOR.analyse(scattered))
    assert highest == pytest.approx(depth_only, abs=0.3)


def test_pixels_of_one_cell_share_a_score_where_some_are_missing() -> None:
    """Noise that reaches over 15 pixels: cells of 3 x 3 pixels, whose missing ones add to the
    score of the whole cell; so a threshold parts no cell."""
    gone = np.random.default_rng(5).random(SHAPE) < 0.03
    cloud = replace(without(cloud_of(3e-4 * blurred(15)), gone), noise_reach_px=15.0)
    evidence = DETECTOR.analyse(cloud)
    is_scored = evidence.cell >= 0
    cells = evidence.cell[is_scored]
    assert len(np.unique(cells)) < 0.2 * len(cells)
    scores = np.abs(evidence.signed.ravel()[cells])
    np.testing.assert_array_equal(evidence.score[is_scored], scores)
    assert DETECTOR.find(cloud, evidence, 0.5)


def test_light_along_the_rim_is_no_finding() -> None:
    """The outer three rows stand three deviations before the surface, as where a floor's light
    comes back."""
    rim = np.where(np.arange(SHAPE[0])[:, None] >= SHAPE[0] - 3, -9e-4, 0.0) + 3e-4 * blurred(7)
    assert not detections_in(cloud_of(rim), 5.5)


def test_the_learned_covariance_is_that_of_the_noise_and_is_used() -> None:
    """On a cloud too small to measure its own."""
    clouds = [cloud_of(3e-4 * blurred(seed)) for seed in range(8, 12)]
    learned = dict(DETECTOR.calibrate(clouds))
    covariance = learned["covariance"]
    middle_row = covariance[LONGEST_LAG_PX, LONGEST_LAG_PX:]
    np.testing.assert_allclose(
        middle_row[1:4] / covariance.max(),
        [0.8, 0.6, 0.4],
        atol=0.08,
    )
    # in squared deviations
    assert covariance.max() == pytest.approx(1.0, abs=0.1)
    cloud = cloud_of(3e-4 * blurred(13) + hole(60, 45, 2.0, 0.002))
    taught = DETECTOR.calibrated(learned)
    assert (taught.name, taught.version) == (DETECTOR.name, DETECTOR.version)
    by_itself = DETECTOR.analyse(cloud).score
    by_learning = taught.analyse(cloud).score
    assert not np.array_equal(by_itself, by_learning)
    assert abs(np.log(np.nanmax(by_learning) / np.nanmax(by_itself))) < 0.2
    assert not DETECTOR.calibrate([])


def test_heavy_tails_raise_single_pixels_no_farther_than_they_reach() -> None:
    """One pixel in 300 has five times the noise: the narrow templates' scores are scaled by their
    own tail, so that the highest (5.4 without) is little above that of Gaussian noise (4.7), and a
    hole of many pixels is found beside."""
    random = np.random.default_rng(14)
    sizes = np.where(random.random(SHAPE) < 1 / 300, 5.0, 1.0)
    noise_m = 3e-4 * sizes * random.standard_normal(SHAPE)
    cloud = cloud_of(noise_m)
    quiet = DETECTOR.quiet_threshold(cloud, DETECTOR.analyse(cloud))
    assert quiet < 5.0
    assert len(detections_in(cloud_of(noise_m + hole(60, 45, 4.0, 0.0015)), quiet + 1.0)) == 1


@pytest.mark.parametrize(("lone", "is_found"), [(0, True), (1, True), (2, False)])
def test_a_hole_of_one_pixel_is_found_if_no_pixel_stands_out_without_damage(
    lone: int, is_found: bool
) -> None:
    clouds = []
    for seed in range(50, 54):
        noise_m = 3e-4 * np.random.default_rng(seed).standard_normal(SHAPE)
        if len(clouds) < lone:
            noise_m[45, 60] += 0.005
        clouds.append(cloud_of(noise_m))
    learned = DETECTOR.calibrate(clouds)
    assert learned["lone"] == lone
    depth_m = 3e-4 * np.random.default_rng(54).standard_normal(SHAPE)
    depth_m[45, 60] += 0.005
    cloud = cloud_of(depth_m)
    detector = DETECTOR.calibrated(learned)
    assert (len(detector.find(cloud, detector.analyse(cloud), 6.0)) == 1) == is_found
    assert not detections_in(cloud, 6.0)


# ---- the parts of a score


def test_a_hole_in_correlated_noise_leaves_no_score_of_the_other_sign_beside_it() -> None:
    """Whitening makes rings of the other sign round a hole, of 4 deviations round this one: they
    are lobes, up to half of its score. A bump as strong as a hole is none."""
    evidence = DETECTOR.analyse(cloud_of(hole(60, 45, 1.5, 0.006) + 3e-4 * blurred(5)))
    rows, columns = np.indices(SHAPE)
    around = np.hypot(columns - 60, rows - 45) < 9.0
    score = np.where(evidence.behind, evidence.score, -evidence.score)[around]
    assert score.max() > 8.0
    assert score.min() > -1.0
    hole_and_bump = hole(60, 45, 3.0, 0.006) - hole(68, 45, 3.0, 0.006) + 3e-4 * blurred(5)
    assert len(detections_in(cloud_of(hole_and_bump), 6.0)) == 2


@pytest.mark.parametrize(
    ("score", "is_lobe"),
    [
        (-4.9, True),
        (-5.1, False),
        (1.0, False),
    ],
)
def test_a_side_lobe_is_weaker_than_half_of_a_score_of_the_other_sign(score, is_lobe) -> None:
    for sign in (1.0, -1.0):
        for offset, is_near in ((RIM_PX, True), (RIM_PX + 1, False)):
            signed = np.zeros((30, 30))
            signed[15, 10] = sign * 10.0
            signed[15, 10 + offset] = sign * score
            assert _side_lobes(signed)[15, 10 + offset] == (is_lobe and is_near)
            assert not _side_lobes(signed)[15, 10]


def test_a_pixel_is_clipped_to_its_neighbours_but_not_below_the_limit() -> None:
    values = np.zeros((9, 9), np.float32)
    values[4, 4] = 40.0
    values[1, 1:3] = (-30.0, -20.0)
    tamed = _tamed(values)
    assert tamed[4, 4] == CLIP_SIGMAS
    assert tamed[1, 1:3].tolist() == [-20.0, -20.0]
    weak = np.full((9, 9), 4.9, np.float32)
    np.testing.assert_array_equal(_tamed(weak), weak)


def test_residuals_are_in_units_of_the_noise_and_weights() -> None:
    """White noise of 0.3 mm, weights of 4 on one half: there a residual counts twice."""
    noise_m = 3e-4 * np.random.default_rng(1).standard_normal(SHAPE)
    weights = np.ones(SHAPE, np.float32)
    result = in_deviations(noise_m, weights, (0.0, 0.0))
    assert result.values[10:-10, 10:-10].std() == pytest.approx(1.0, abs=0.05)
    assert np.median(result.unit_m) == pytest.approx(3e-4, rel=0.06)
    # the wave is wider than a filter's window: the unit stays that of the noise
    wave_m = 2e-3 * np.sin(np.arange(SHAPE[1]) / 12.0)
    waved = in_deviations(noise_m + wave_m, weights, (0.0, 0.0))
    ratio = np.median(waved.unit_m) / np.median(result.unit_m)
    size = np.median(np.abs(noise_m + wave_m)) / np.median(np.abs(noise_m))
    assert ratio == pytest.approx(size, rel=0.15)
    # rounding sets the least unit
    rounded = in_deviations(noise_m, weights, (4e-6, 5e-6))
    np.testing.assert_allclose(rounded.unit_m, 3e-3)
    weights[::3, ::3] = 4.0
    weighed = in_deviations(noise_m, weights, (0.0, 0.0))
    gain = weighed.values[20:60:3, 21:90:3] / result.values[20:60:3, 21:90:3]
    assert np.median(weighed.values[21:60:3, 21:90:3] / result.values[21:60:3, 21:90:3]) > 1.7
    assert np.median(gain) < 1.0


def test_what_the_rim_shares_is_taken_out_at_each_distance() -> None:
    noise = np.random.default_rng(2).standard_normal((100, 140)).astype(np.float32)
    depth_px = np.full(noise.shape, 20.0, np.float32)
    for distance in range(1, 2 * RIM_PX + 1):
        depth_px[:, distance - 1] = distance
    shared = np.zeros_like(noise)
    shared[:, 0] = 1.5
    shared[:, 3] = -1.2
    result = without_rim(noise + shared, depth_px)
    remainder = result.mean(axis=0)
    # half of what the fourth of six pixels share is left
    remainder[3] += 0.6
    # what those next to the rim share too stays
    level = without_rim(noise + shared + np.float32(0.8), depth_px).mean(axis=0)
    level[3] += 0.6
    np.testing.assert_allclose(level[:RIM_PX], 0.8, atol=0.5)
    # 100 pixels, of which some 65 count at each
    assert np.abs(remainder[:RIM_PX]).max() < 0.35
    np.testing.assert_array_equal(result[:, RIM_PX:], noise[:, RIM_PX:])


def stepped(seed: int) -> np.ndarray:
    """Errors of an edge on the outermost three pixels, alike over nine pixels along it, as where
    an edge crosses the rows of pixels at a small angle."""
    rows, columns = np.indices(SHAPE)
    runs = (
        np.random.default_rng(seed).uniform(-1.0, 1.0, (4, max(SHAPE) // 9 + 1)).repeat(9, axis=1)
    )
    depths = (rows, SHAPE[0] - 1 - rows, columns, SHAPE[1] - 1 - columns)
    along = (columns, columns, rows, rows)
    errors = np.zeros(SHAPE)
    for depth, start, run in zip(depths, along, runs, strict=True):
        errors += np.select([depth == 0, depth == 1, depth == 2], [2.0, 0.8, 0.3], 0.0) * run[start]
    return errors


def smooth(seed: int) -> np.ndarray:
    """Noise of deviation 1 with Gaussian weights of 3 pixels, as a scanned lidar's."""
    white = np.random.default_rng(seed).standard_normal(SHAPE)
    noise = cv2.GaussianBlur(white, (0, 0), 3.0)
    return np.asarray(noise / noise.std())


def rim_peak(evidence: Evidence) -> float:
    """The highest score of the outermost six pixels."""
    return float(evidence.score[outline_depth_px(np.ones(SHAPE, bool)) <= RIM_PX].max())


@pytest.mark.parametrize("learns", [True, False])
def test_the_errors_of_an_edge_are_no_damage(learns: bool) -> None:
    """The same noise with and without them: the rim's highest score grows by a deviation at most;
    if they count as noise of the inside, by two and more. A hole at the rim is found beside them.
    """
    clouds = [cloud_of(3e-4 * (smooth(seed) + stepped(seed))) for seed in range(30, 38)]
    detector = DETECTOR
    if learns:
        learned = DETECTOR.calibrate(clouds[4:])
        assert learned["rim"].shape == (6,)
        detector = DETECTOR.calibrated(learned)
    unaware = DETECTOR.calibrated({**DETECTOR.calibrate(clouds[4:]), "rim": np.zeros(6)})
    plain = [rim_peak(detector.analyse(cloud_of(3e-4 * smooth(seed)))) for seed in range(30, 34)]
    aware = [rim_peak(detector.analyse(cloud)) for cloud in clouds[:4]]
    misled = [rim_peak(unaware.analyse(cloud)) for cloud in clouds[:4]]
    assert np.mean(aware) < np.mean(plain) + 1.0
    assert np.mean(misled) > np.mean(plain) + 2.0
    deep = hole(5, 45, 3.0, 0.004) + 3e-4 * (smooth(30) + stepped(30))
    detections = detector.find(cloud_of(deep), detector.analyse(cloud_of(deep)), 6.0)
    centres = [np.unravel_index(detection.pixels[0], SHAPE) for detection in detections]
    assert any(np.hypot(row - 45, column - 5) < 8.0 for row, column in centres)


def test_local_means_count_the_errors_of_an_edge_as_noise(monkeypatch) -> None:
    local = LocalDetector(LocalDetector.settings_type.from_data({"crop": {"kind": "none"}}))
    seeds = range(30, 34)
    bare = [cloud_of(3e-4 * smooth(seed)) for seed in seeds]
    clouds = [cloud_of(3e-4 * (smooth(seed) + 2.0 * stepped(seed))) for seed in seeds]
    plain = [rim_peak(local.analyse(cloud)) for cloud in bare]
    aware = [rim_peak(local.analyse(cloud)) for cloud in clouds]
    monkeypatch.setattr(local_methods, "_rim_variances", lambda noise, seen, reach_px: 0.0 * noise)
    misled = [rim_peak(local.analyse(cloud)) for cloud in clouds]
    assert np.mean(aware) < np.mean(plain) + 0.5
    assert np.mean(misled) > np.mean(aware) + 1.0


def test_wide_templates_fill_their_discs() -> None:
    signed = np.zeros((40, 50))
    signed[20, 25] = -8.0
    signed[20, 22] = -7.0
    radius_px = np.full(signed.shape, WIDE_PX)
    _fill_discs(signed, radius_px)
    inside = np.hypot(*(np.indices(signed.shape) - np.array([20, 25])[:, None, None])) <= WIDE_PX
    least = -8.0 * 0.75 * 1.01
    assert (signed[inside] <= least).all()
    assert signed[20, 25] == -8.0
    assert signed[20, 22] == -7.0
    assert not signed[~inside].any()
    # a narrow one does not
    narrow = np.zeros((40, 50))
    narrow[20, 25] = 8.0
    _fill_discs(narrow, radius_px - 0.1)
    assert np.count_nonzero(narrow) == 1


def disc_at(row: int, column: int, shape: tuple[int, int] = (40, 50)) -> np.ndarray:
    rows, columns = np.indices(shape)
    return np.asarray(np.hypot(rows - row, columns - column) < 4.5)


def test_the_core_of_a_strong_finding_is_what_is_loud_in_its_disc() -> None:
    inside = disc_at(20, 25)
    values = 9.0 * inside.astype(np.float32)
    values[20, 25] = 0.5
    scores = 20.0 * inside.astype(np.float32)
    is_known = np.ones(values.shape, bool)
    (core,) = _cores(scores, np.full(values.shape, 4.5), values, is_known)
    expected = np.zeros(values.shape)
    expected[core.cut][core.inside] = core.signed
    assert (expected[inside] > 0.3 * 20.0).all()
    assert not expected[~grown(inside, 1)].any()
    assert expected.max() == pytest.approx(20.0)
    assert inside[core.peak]
    # loud pixels that fill less than half of the template's disc are not its finding
    assert not _cores(scores, np.full(values.shape, 9.0), values, is_known)


@pytest.mark.parametrize(("beside", "count"), [(20.0, 2), (16.0, 2), (14.0, 1), (-20.0, 1)])
def test_a_loud_part_is_judged_by_its_own_score(beside: float, count: int) -> None:
    """A template that peaks between two holes hides neither. A part waits whose score is less than
    three quarters of one nearby, or of the other sign than its values."""
    first = disc_at(20, 15)
    second = disc_at(20, 27)
    values = (9.0 * (first | second)).astype(np.float32)
    scores = (20.0 * first + beside * second).astype(np.float32)
    scores[20, 21] = 40.0
    is_known = np.ones(values.shape, bool)
    assert len(_cores(scores, np.full(values.shape, 3.2), values, is_known)) == count


@pytest.mark.parametrize(("weak", "count"), [(7.0, 1), (9.9, 1), (10.1, 2)])
def test_a_part_much_weaker_than_the_strongest_waits(weak: float, count: int) -> None:
    """Errors of the whitening are a share of the picture's strongest score, wherever that is."""
    first = disc_at(20, 10)
    second = disc_at(20, 40)
    values = (9.0 * (first | second)).astype(np.float32)
    scores = (1000.0 * first + weak * second).astype(np.float32)
    is_known = np.ones(values.shape, bool)
    cores = _cores(scores, np.full(values.shape, 3.2), values, is_known)
    assert len(cores) == count
    assert first[cores[0].peak]


def test_less_noise_finds_no_fewer_of_holes_that_stand_close() -> None:
    """Templates peak between holes that stand close, the higher, the less noise there is: these
    peaks must not hide the holes, which would then pass for scatter of the scores."""
    disc = hole(60, 45, 1.2, 0.03)[35:56, 50:71]
    depth_m = np.zeros(SHAPE)
    for row in range(20, 70, 9):
        for column in range(20, 100, 9):
            depth_m[row - 10 : row + 11, column - 10 : column + 11] += disc
    hole_free = [cloud_of(3e-4 * blurred(seed)) for seed in range(40, 44)]
    detector = DETECTOR.calibrated(DETECTOR.calibrate(hole_free))
    for noise_m in (5e-4, 2e-4, 1e-4):
        cloud = cloud_of(depth_m + noise_m * blurred(7))
        assert len(detector.find(cloud, detector.analyse(cloud), 5.5)) == 54


@pytest.mark.parametrize("angle_deg", [0.0, 33.75, 45.0])
def test_a_slot_has_a_higher_score_than_discs_and_dents_give_it(angle_deg: float) -> None:
    """A slot of the bank's own length and width under white noise: the best disc or dent would
    give it two thirds of its energy's root, and the slot itself gives more."""
    slots = [template.image for template in bank(1) if template.slot]
    slot = slots[len(SLOTS_DEG) + SLOTS_DEG.index(angle_deg)]
    half = len(slot) // 2
    depth = np.zeros(SHAPE)
    depth[45 - half : 46 + half, 60 - half : 61 + half] = 25.0 * slot / np.sqrt((slot**2).sum())
    by_others = 0.0
    for template in bank(1):
        if not template.slot:
            correlation = cv2.filter2D(depth, -1, template.image).max()
            by_others = max(by_others, correlation / np.sqrt((template.image**2).sum()))
    assert by_others < 0.7 * 25.0
    noise = np.random.default_rng(23).standard_normal(SHAPE)
    evidence = DETECTOR.analyse(cloud_of(3e-4 * (noise + depth)))
    score = np.nanmax(evidence.score[40:51, 55:66])
    assert 1.1 * by_others < score < 1.05 * 25.0
