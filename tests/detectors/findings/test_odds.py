"""The probability of being a false call: against its integral, against counts, and at marks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import integrate, ndimage, stats

from detectors import load_detector
from detectors.findings.null import (
    MARKS,
    PLAIN,
    RIM,
    OwnThreshold,
    own_threshold,
)
from detectors.findings.objects import Marks, marks_of
from detectors.findings.odds import (
    LAWS,
    STEEPNESS,
    chance_laws,
    noise_probabilities,
    share_of_noise,
)
from detectors.findings.tails import Tail, counts_of
from detectors.interface import Detection, Evidence, MissingReturns
from detectors.pixels.masks import grown
from harness.inspection.judging import null_facts
from harness.vocabulary.geometry import Cloud
from tests.validation.odds import (
    DETECTORS,
    WANTED,
    Case,
    Judgement,
    capture,
    judgements,
    plane,
)

ALPHA = 1e-3
THRESHOLD = 5.0
CHECKED = [
    ("matched", Case("normal", 3, 1)),
    ("local", Case("Laplace", 3, 10)),
    ("local", Case("Student's t", 1, 1)),
]
SLOW = pytest.mark.slow  # a Monte Carlo campaign over all kinds of noise


# ---------------------------------------------------------------- one group of findings


def by_integration(scores: np.ndarray, density: np.ndarray, expected: float) -> np.ndarray:
    """Return what `share_of_noise` computes with one law, by adaptive quadrature over the number of
    real findings."""
    highest = 10.0 * (len(scores) + 1.0)
    evidence = 0.0
    sums = np.zeros(len(scores))
    for steepness in STEEPNESS:
        real = steepness / THRESHOLD * (scores / THRESHOLD) ** -(steepness + 1.0)

        def weight(log_number: float, real: np.ndarray = real) -> float:
            number = np.exp(log_number)
            prior = np.sqrt(number) / (1.0 + number)
            likelihood = np.prod(density + number * real)
            return float(prior * likelihood * np.exp(-expected - number))

        ends = (np.log(0.01), np.log(highest))
        evidence += integrate.quad(weight, *ends)[0]
        for row in range(len(scores)):

            def share(
                log_number: float, real: np.ndarray = real, row: int = row, weight=weight
            ) -> float:
                total = density[row] + np.exp(log_number) * real[row]
                return float(weight(log_number) * density[row] / total)

            sums[row] += integrate.quad(share, *ends)[0]
    return sums / evidence


def test_the_share_of_noise_is_the_posterior_mean() -> None:
    scores = np.array([9.0, 6.0, 5.3])
    density = 2.0 * scores * np.exp(-(scores**2 - THRESHOLD**2) / 2.0)
    shares = share_of_noise(scores, THRESHOLD, density[None], np.array([2.0]))
    assert shares == pytest.approx(by_integration(scores, density, 2.0), rel=0.01)
    assert shares[0] < 1e-6
    assert shares[1] < 0.2 < 0.6 < shares[2]
    # half as much noise
    fewer = share_of_noise(scores, THRESHOLD, density[None] / 2.0, np.array([1.0]))
    assert fewer == pytest.approx(by_integration(scores, density / 2.0, 1.0), rel=0.01)
    assert (fewer < 0.95 * shares).all()


def test_likely_laws_weigh_more() -> None:
    """Of two laws, one expects 1e6 calls where one was found: its share of noise does not count."""
    scores = np.array([6.0])
    likely = share_of_noise(scores, THRESHOLD, np.array([[0.2]]), np.array([0.1]))
    unlikely = np.array([[0.2], [1e6]])
    both_odds = share_of_noise(scores, THRESHOLD, unlikely, np.array([0.1, 1e6]))
    assert both_odds == pytest.approx(likely, rel=1e-9)


def test_stronger_findings_are_never_more_likely_noise() -> None:
    """A law with a bump at 8: weaker findings are as likely noise as the strongest there."""
    scores = np.array([5.2, 8.0, 6.5])
    density = np.array([[1e-3, 5.0, 1e-3]])
    shares = share_of_noise(scores, THRESHOLD, density, np.array([1.0]))
    assert shares[1] == shares[2] == shares[0] > 0.5


def counted(calls: float, real: float, captures: int, seed: int) -> Judgement:
    """Draw captures with a known law and Pareto scores of real findings; judge each alone."""
    random = np.random.default_rng([41, seed])
    probability = []
    is_false = []
    for _ in range(captures):
        uniform = random.uniform(size=random.poisson(calls))
        false_scores = np.sqrt(THRESHOLD**2 - 2.0 * np.log(uniform))
        real_scores = THRESHOLD * random.uniform(size=random.poisson(real)) ** (-1.0 / 3.0)
        scores = np.concatenate([false_scores, real_scores])
        density = calls * scores * np.exp(-(scores**2 - THRESHOLD**2) / 2.0)
        shares = share_of_noise(scores, THRESHOLD, density[None], np.array([calls]))
        probability.append(shares)
        is_false.append(np.arange(len(scores)) < len(false_scores))
    return Judgement(np.concatenate(probability), np.concatenate(is_false), calls)


@pytest.mark.parametrize(("calls", "real"), [(0.5, 1.0), (2.0, 0.5), (2.0, 30.0)])
def test_probabilities_are_shares_of_false_findings(calls: float, real: float) -> None:
    """In each class of stated probability the count of false findings is within its scatter and a
    quarter of what is stated."""
    result = counted(calls, real, captures=300, seed=int(10 * calls + real))
    for low, high in ((0.0, 0.1), (0.1, 0.5), (0.5, 0.8), (0.8, 1.0)):
        chosen = (result.probability > low) & (result.probability <= high)
        stated = result.probability[chosen]
        scatter = np.sqrt((stated * (1.0 - stated)).sum())
        surplus = result.is_false[chosen].sum() - stated.sum()
        assert abs(surplus) < 3.5 * scatter + 0.25 * stated.sum() + 1.0, (low, high)
    assert result.probability.sum() == pytest.approx(result.is_false.sum(), rel=0.2)


# ---------------------------------------------------------------- through a detector


def assert_calibrated(judged: list[Judgement], wanted: float) -> None:
    """As many false findings as stated, and at most as many as asked for, within the scatter and a
    quarter; the damage hides some places. Findings that are surely real are."""
    probability = np.concatenate([one_capture.probability for one_capture in judged])
    is_false = np.concatenate([one_capture.is_false for one_capture in judged])
    assert np.mean([one_capture.expected for one_capture in judged]) == pytest.approx(wanted)
    beyond = stats.norm.isf(ALPHA / 2)
    stated = probability.sum()
    scatter = np.sqrt((probability * (1.0 - probability)).sum())
    assert abs(is_false.sum() - stated) < beyond * scatter + 0.25 * stated
    asked = wanted * len(judged)
    assert is_false.sum() < 1.25 * asked + beyond * np.sqrt(asked)
    assert is_false.sum() > 0.45 * asked - beyond * np.sqrt(0.45 * asked)
    is_sure = probability < 0.05
    assert is_sure.sum() >= len(judged) / 2
    assert is_false[is_sure].sum() <= stats.poisson.isf(ALPHA, 0.03 * is_sure.sum())
    is_doubtful = probability > 0.8
    assert is_false[is_doubtful].mean() > 0.7


@pytest.mark.parametrize(("name", "case"), CHECKED)
def test_a_detector_states_how_many_findings_are_false(name: str, case: Case) -> None:
    assert_calibrated(list(judgements(name, case, 10)), WANTED)


@SLOW
@pytest.mark.parametrize("name", DETECTORS)
@pytest.mark.parametrize("reach_px", [1, 3, 7])
def test_all_noises_state_how_many_findings_are_false(name: str, reach_px: int) -> None:
    judged = []
    for noise in ("normal", "Laplace", "Student's t"):
        for frames in (1, 10):
            judged += judgements(name, Case(noise, reach_px, frames), 15)
    assert_calibrated(judged, WANTED)


# ---------------------------------------------------------------- marks

TAG = np.s_[25:85, 30:90]
DOT = (100, 130)
DOT_RADIUS_PX = 4.0


def printed(seed: int, loud: float = 8.0) -> tuple[Cloud, np.ndarray]:
    """Return a plane with a printed square, along whose edges smooth errors are ``loud`` deviations
    of the noise, and with a hole that the picture shows as a dark dot; and the edges (h, w) bool."""
    cloud, _ = capture(Case("normal", 3, 1), 1000 + seed)
    shape = cloud.valid.shape
    random = np.random.default_rng([43, seed])
    noise_m = 1e-3 * 3.0 * ndimage.uniform_filter(random.normal(size=shape), 3, mode="wrap")
    print_m = np.zeros(shape)
    print_m[TAG] = 1.0
    edges = ndimage.binary_dilation(np.hypot(*np.gradient(print_m)) > 0, iterations=2)
    edge_pixels = np.flatnonzero(
        edges & ndimage.binary_erosion(np.ones(shape, bool), iterations=12)
    )
    chosen = random.choice(edge_pixels, 10, replace=False)
    errors_m = np.zeros(shape)
    errors_m.ravel()[chosen] = random.choice([-1.0, 1.0], 10) * random.uniform(0.5, 1.0, 10)
    blurred_m = ndimage.uniform_filter(errors_m, 3) * 9.0
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    dot = np.hypot(rows - DOT[0], columns - DOT[1]) < DOT_RADIUS_PX
    offset_m = noise_m + loud * 1e-3 * blurred_m
    offset_m[dot] += 8e-3
    grey = np.full(shape, 180.0) + random.normal(size=shape)
    grey[TAG] = 40.0
    grey[dot] = 20.0
    rgb = np.repeat(grey[..., None], 3, axis=-1)
    return replace(plane(offset_m), rgb=rgb), edges


def own_of(cloud: Cloud, name: str = "matched") -> tuple[OwnThreshold, tuple[Detection, ...]]:
    detector = load_detector(name, {"crop": {"kind": "none"}, "surface": {"degree": 1}})
    null = own_threshold(detector, cloud, detector.analyse(cloud), 1.0)
    return null, detector.find(cloud, null.evidence, null.threshold)


def test_calls_at_print_are_expected_there() -> None:
    """Ten errors of either sign at the edges of a print: those towards the camera predict those
    behind the surface, and away from the print nothing changes."""
    expected = 0.0
    at_marks = 0
    away = 0
    captures = 6
    for seed in range(captures):
        cloud, edges = printed(seed)
        null, detections = own_of(cloud)
        marks = marks_of(cloud, null.evidence)
        beside_marks = grown(edges, marks.margin_px)
        assert null.doubts == ()
        assert null.expected - null.at_marks == pytest.approx(1.0, rel=1e-6)
        expected += null.at_marks
        for detection in detections:
            at_print = edges.reshape(-1)[detection.pixels].any()
            # noise may peak beside the print, within its margin
            is_near = beside_marks.reshape(-1)[detection.pixels].any()
            assert at_print <= marks.hold(detection) <= is_near
            at_marks += at_print
            away += not at_print
    assert expected > 4.0 * captures
    assert 0.6 < at_marks / expected < 1.5
    # the hole in each, and the call that is asked for
    assert captures <= away <= 3 * captures


def test_a_finding_at_print_is_more_likely_false() -> None:
    cloud, _ = printed(1)
    null, detections = own_of(cloud)
    evidence = replace(null.evidence, notes={"own_null": null_facts(null)})
    probabilities = noise_probabilities(cloud, evidence, detections, None)
    marks = marks_of(cloud, evidence)
    hole = int(np.ravel_multi_index(DOT, cloud.valid.shape))
    at_print = []
    for detection, probability in zip(detections, probabilities, strict=True):
        if hole in detection.pixels:
            # the dot in the picture is the hole itself
            assert marks.covered.reshape(-1)[hole]
            assert not marks.hold(detection)
            assert probability < 1e-3
        elif marks.hold(detection):
            at_print.append(probability)
    assert len(at_print) >= 5
    assert np.median(at_print) > 0.5


def test_a_wide_hole_is_its_own_mark() -> None:
    """A dark disc of 50 pixels: the finding that fills it is the hole itself, a small one at its
    edge is not."""
    rows, columns = np.mgrid[:130, :170]
    disc = np.hypot(rows - 65, columns - 80) < 25.0
    labels = disc.astype(np.int64)
    areas = np.bincount(labels.ravel())
    marks = Marks(np.zeros_like(disc), disc, labels, areas, margin_px=6)
    hole = np.flatnonzero(np.hypot(rows - 65, columns - 80) < 20.0)
    assert not marks.hold(Detection(9.0, hole, np.zeros(3)))
    beside = np.flatnonzero(np.hypot(rows - 65, columns - 108) < 3.0)
    assert marks.hold(Detection(9.0, beside, np.zeros(3)))
    distant = np.flatnonzero(np.hypot(rows - 65, columns - 120) < 3.0)
    assert not marks.hold(Detection(9.0, distant, np.zeros(3)))


def test_small_marks_are_no_less_noisy() -> None:
    """The area of the dot counts for the law of noise though its peaks do not."""
    cloud, _ = printed(2)
    null, _ = own_of(cloud)
    marks = marks_of(cloud, null.evidence)
    assert marks.count == 1
    height, width = cloud.valid.shape
    dot = ndimage.label(marks.covered)[0]
    dot_pixels = int((dot == dot[DOT]).sum())
    uncovered = int((~marks.covered).sum())
    plain = null.tails[PLAIN]
    assert plain.area_ratio == pytest.approx((uncovered + dot_pixels) / uncovered)
    bare = replace(plain, area_ratio=1.0)
    ratio = plain.expected(null.threshold) / bare.expected(null.threshold)
    assert ratio == pytest.approx(plain.area_ratio)
    assert height * width > uncovered


def test_the_interval_is_that_of_all_laws_together() -> None:
    random = np.random.default_rng(7)
    tails = {}
    for name, peaks in ((PLAIN, 60), (MARKS, 20)):
        scores = np.sqrt(9.0 + 2.0 * random.exponential(size=peaks))
        tails[name] = Tail.of(scores, 3.0)
    low, high = counts_of(tails, 3.5)
    expected = 2.0 * sum(tail.expected(3.5) for tail in tails.values())
    plain_low, plain_high = counts_of({PLAIN: tails[PLAIN]}, 3.5)
    assert plain_low < low < expected < high
    assert high > plain_high
    # the mean over the drawn laws is the expected number, and their density integrates to it
    laws = tails[PLAIN].laws(4000)
    assert laws.expected(3.5).mean() == pytest.approx(tails[PLAIN].expected(3.5), rel=0.03)
    scores = np.linspace(3.5, 12.0, 4001)
    integral = np.trapezoid(laws.densities(scores), scores, axis=1)
    difference = laws.expected(3.5) - laws.expected(12.0)
    assert integral == pytest.approx(difference, rel=1e-3)
    assert len(tails[PLAIN].laws(LAWS).numbers) == LAWS


def test_a_tail_survives_as_plain_data() -> None:
    tail = replace(Tail.of(np.array([3.2, 3.5, 4.0]), 3.0), area_ratio=1.5)
    again = Tail.from_facts(tail.facts)
    assert again.expected(4.5) == tail.expected(4.5)
    assert again.number == 4.5


# ---------------------------------------------------------------- the rim

BOARD = np.s_[12:-12, 12:-12]


def board(seed: int, loud: float, errors: int = 40) -> tuple[Cloud, np.ndarray]:
    """Return a board of smooth noise within an empty frame, with a hole in its middle and, 4 pixels
    from its outline, ``errors`` smooth errors of either sign that are up to ``loud`` deviations high; and
    the distance (h, w) to its outline in pixels."""
    random = np.random.default_rng([47, seed])
    shape = (150, 190)
    noise_m = 3e-3 * ndimage.uniform_filter(random.normal(size=shape), 3, mode="wrap")
    inside = np.zeros(shape, bool)
    inside[BOARD] = True
    depth_px = ndimage.distance_transform_cdt(inside, "chessboard")
    rows, columns = np.mgrid[: shape[0], : shape[1]]
    offset_m = noise_m + 4e-3 * (np.hypot(rows - 75, columns - 95) < 4.0)
    rim_pixels = random.choice(np.flatnonzero(depth_px == 4), errors, replace=False)
    for pixel in rim_pixels:
        row, column = np.unravel_index(pixel, shape)
        bump = np.exp(-((rows - row) ** 2 + (columns - column) ** 2) / 8.0)
        offset_m += random.choice([-1e-3, 1e-3]) * random.uniform(0.5, 1.0) * loud * bump
    offset_m[~inside] = np.nan
    return plane(offset_m), depth_px


def test_a_loud_rim_does_not_raise_the_threshold_elsewhere() -> None:
    """Errors at the rim have a law of their own, of which the search leaves few; findings keep
    their whole scores away from the rim."""
    calls = 0
    for seed in range(5):
        cloud, depth_px = board(seed, 10.0)
        quiet, _ = board(seed, 0.0)
        null, detections = own_of(cloud)
        plain, _ = own_of(quiet)
        assert null.doubts == ()
        assert null.rim_scale < 0.7
        assert plain.rim_scale == 1.0
        assert null.threshold == pytest.approx(plain.threshold, rel=0.3)
        assert null.expected == pytest.approx(1.0, rel=1e-6)
        assert null.low < 1.0 < null.high
        detector = load_detector("matched", {"crop": {"kind": "none"}, "surface": {"degree": 1}})
        unscaled = detector.analyse(cloud).score
        assert np.array_equal(null.evidence.score[depth_px > 20], unscaled[depth_px > 20])
        outermost = (depth_px == 5) & (unscaled > 0)
        ratio = null.evidence.score[outermost] / unscaled[outermost]
        assert ratio == pytest.approx(null.rim_scale, rel=1e-9)
        middle = int(np.ravel_multi_index((75, 95), cloud.valid.shape))
        assert sum(middle in detection.pixels for detection in detections) == 1
        calls += len(detections) - 1
    assert calls <= 10


def test_a_few_bumps_at_the_rim_are_no_loud_rim() -> None:
    cloud, _ = board(1, 8.0, errors=5)
    null, detections = own_of(cloud)
    assert null.rim_scale == 1.0
    assert RIM not in null.tails
    assert len(detections) >= 3


def test_calls_at_the_rim_are_weighed_by_its_law() -> None:
    cloud, depth_px = board(0, 10.0)
    null, _ = own_of(cloud)
    facts = null_facts(null)
    score = null.threshold * 1.2
    at_rim = Detection(score, np.flatnonzero(depth_px == 4)[:3], np.zeros(3))
    away = Detection(score, np.flatnonzero(depth_px == 40)[:3], np.zeros(3))

    def probabilities() -> np.ndarray:
        evidence = replace(null.evidence, notes={"own_null": facts})
        alone = [
            noise_probabilities(cloud, evidence, (detection,), None)[0]
            for detection in (at_rim, away)
        ]
        return np.array(alone)

    before = probabilities()
    facts["tails"][RIM]["area_ratio"] *= 100.0
    after = probabilities()
    assert after[0] > before[0] + 0.1
    assert before[1] == after[1]
    # the law in scores of the evidence: it integrates to the number expected
    rim = null.tails[RIM]
    assert rim.scale == null.rim_scale
    scores = np.linspace(null.threshold, 30.0 * null.threshold, 40001)
    laws = rim.laws(200)
    integral = np.trapezoid(laws.densities(scores), scores, axis=1)
    difference = laws.expected(null.threshold) - laws.expected(30.0 * null.threshold)
    assert integral == pytest.approx(difference, rel=1e-3)
    assert rim.threshold(rim.expected(null.threshold)) == pytest.approx(null.threshold)


# ---------------------------------------------------------------- what is unknown


def evidence_of(cloud: Cloud, notes: dict) -> Evidence:
    score = np.full(cloud.valid.shape, 1.0)
    return Evidence(score, 1e-3 * score, 0.7 * score, 1e-3, notes)


def test_missing_returns_have_a_law_of_their_own() -> None:
    """A deviation of 5 is as rare as 2.9e-7 calls; the weakest finding is one of 0.01."""
    cloud, _ = capture(Case("normal", 1, 1), 1)
    deviations = (5.0, 2.4)
    detections = []
    for score in deviations:
        detections.append(Detection(score, np.arange(9), np.zeros(3), "no return"))
    depth = Detection(9.0, np.arange(9), np.zeros(3))
    nothing = np.zeros(cloud.valid.shape, bool)
    missing = MissingReturns(nothing, 1.0 * nothing, 0.0, 0.0, 9, 0.01, tuple(detections))
    evidence = evidence_of(cloud, {})
    probabilities = noise_probabilities(cloud, evidence, (depth, *detections), missing)
    assert np.isnan(probabilities[0])
    threshold, laws = chance_laws(missing)
    assert threshold == pytest.approx(stats.norm.isf(0.01))
    assert laws.expected(5.0) == pytest.approx(2.867e-7, rel=1e-3)
    assert laws.densities(np.array([2.4]))[0] == pytest.approx(stats.norm.pdf(2.4))
    assert probabilities[1] < 1e-4 < 0.01 < probabilities[2] < 0.3


def test_without_a_threshold_of_its_own_the_odds_are_unknown() -> None:
    cloud, _ = capture(Case("normal", 1, 1), 1)
    depth = Detection(9.0, np.arange(9), np.zeros(3))
    for notes in ({}, {"own_null": {"tails": {}}}):
        evidence = evidence_of(cloud, notes)
        assert np.isnan(noise_probabilities(cloud, evidence, (depth,), None)).all()
    assert noise_probabilities(cloud, evidence_of(cloud, {}), (), None) == ()
