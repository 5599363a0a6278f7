"""Missing returns: what is found, where and how large, how often chance passes for a finding, and
one damage once."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.special import ndtri
from scipy.stats import binom, norm

from detectors import load_detector
from detectors.findings.missing import (
    ALPHA,
    measure_missing,
    missing_evidence,
    missing_returns,
    one_damage_once,
)
from detectors.interface import Detection, Evidence
from harness.evaluation.study.limit import limit_of
from harness.inspection.judging import judged as judged_cloud
from harness.report.findings import write_findings
from harness.tables.limits import LIMITS, notes_of
from harness.testing.synthetic_clouds import LENS, SHAPE, plane, without
from harness.vocabulary.geometry import Cloud, Region
from tests.support.synthetic_study import study_record

V, U = np.mgrid[: SHAPE[0], : SHAPE[1]]
FIELD = (90, 120)
"""Pixels of random fields: what a face of 126 x 168 mm at 0.7 m has."""


def looked(gone: np.ndarray, tilt: float = 0.1) -> tuple[Cloud, Evidence]:
    """A plane without the pixels ``gone``, and evidence that judged all others."""
    cloud = without(plane(seed=1, tilt=tilt), gone)
    score = np.where(cloud.valid, 0.0, np.nan)
    # the plane itself, as a detector fits it: z = 0.7 + tilt x
    slopes = LENS.region_slopes(LENS.whole)
    surface = 0.7 / (1.0 - tilt * slopes[..., 0])
    return cloud, Evidence(
        score,
        score,
        np.where(cloud.valid, surface, np.nan),
        1e-3,
    )


def disc(u: float, v: float, diameter: float) -> np.ndarray:
    """Pixels within a circle."""
    return np.hypot(U - u, V - v) < diameter / 2


def scattered(random: np.random.Generator, rate: float, square: int) -> np.ndarray:
    """Dropouts at a rate where noise averaged over a square of this side is lowest."""
    z = cv2.blur(random.standard_normal((FIELD[0] + 8, FIELD[1] + 8)), (square, square)) * square
    return z[4:-4, 4:-4] < ndtri(rate)


@pytest.mark.parametrize(
    ("tilt", "width_px"),
    [
        (0.0, 4),
        (0.5, 6),
        (0.0, 10),
        (0.5, 30),
    ],
)
def test_a_hole_without_return_is_found_where_it_is_and_as_large_as_it_is(
    tilt: float, width_px: int
) -> None:
    gone = disc(70.3, 40.4, width_px)
    cloud, evidence = looked(gone, tilt)

    missing = missing_returns(cloud, evidence)

    assert missing is not None
    (detection,) = missing.detections
    assert detection.kind == "no return"
    np.testing.assert_array_equal(detection.pixels, np.flatnonzero(gone))
    assert missing.blind == pytest.approx(gone.mean())
    measured = measure_missing(cloud, evidence, detection)
    rows, columns = np.nonzero(gone)
    slope = LENS.slopes(columns.mean(), rows.mean())
    z = 0.7 / (1.0 - tilt * slope[0])
    np.testing.assert_allclose(
        measured.extent_centre_m,
        [*(slope * z), z],
        atol=2e-4,
    )
    # a pixel covers (z / f)^2 across the axis, on the tilted plane by sqrt(1 + tilt^2) / (1 - tilt
    # x/z) more
    pixel_m2 = (z / LENS.fx) ** 2 * np.sqrt(1.0 + tilt**2) / (1.0 - tilt * slope[0])
    assert measured.extent_diameter_m == pytest.approx(
        2.0 * np.sqrt(gone.sum() * pixel_m2 / np.pi), rel=0.02
    )
    assert np.isnan(measured.model_depth_m)
    assert np.isnan(measured.volume_m3)
    assert measured.points == gone.sum()


MANY = [
    pytest.param(*case, 50, marks=pytest.mark.slow)
    for case in ((0.02, 1), (0.15, 1), (0.35, 1), (0.1, 3))
]


@pytest.mark.parametrize(
    ("rate", "square", "fields"),
    [
        (0.02, 3, 8),
        (0.15, 1, 4),
        (0.05, 5, 8),
        *MANY,
    ],
)
def test_scattered_dropouts_are_no_findings(rate: float, square: int, fields: int) -> None:
    """At most ALPHA = 0.01 findings are expected in a field, so that the number of fields with a
    finding is binomial at most: alpha of each test 1e-4."""
    with_findings = 0
    for seed in range(fields):
        missing = missing_returns(*looked(scattered(np.random.default_rng(seed), rate, square)))
        assert missing is not None
        assert missing.expected <= ALPHA
        with_findings += bool(missing.detections)
    assert with_findings <= binom.isf(1e-4, fields, ALPHA)


def test_the_rate_of_dropouts_is_measured_and_a_hole_stands_out_of_them() -> None:
    gone = scattered(np.random.default_rng(7), 0.35, 1) | disc(60.2, 45.3, 16)

    missing = missing_returns(*looked(gone))

    assert missing is not None
    (detection,) = missing.detections
    assert np.isin(np.flatnonzero(disc(60.2, 45.3, 16)), detection.pixels).all()
    assert missing.dropouts == pytest.approx(0.35, abs=0.03)
    assert missing.least_points > 20


def test_blobs_of_the_size_of_a_filter_raise_the_bound() -> None:
    """A 3 x 3 filter makes nine pixels of one bad sample: at 4 % of the pixels such blobs are no
    findings."""
    random = np.random.default_rng(3)
    blobs = cv2.dilate((random.random(FIELD) < 0.0045).astype(np.uint8), np.ones((3, 3))) > 0
    single = random.random(FIELD) < 0.01

    missing = missing_returns(*looked(blobs | single))

    assert missing is not None
    assert missing.least_points > 9


def test_what_touches_the_rim_of_the_target_or_of_the_image_is_not_enclosed() -> None:
    gone = disc(0, 45, 12) | disc(60, 89, 12) | disc(100, 20, 8)

    missing = missing_returns(*looked(gone))

    assert missing is not None
    (detection,) = missing.detections
    np.testing.assert_array_equal(detection.pixels, np.flatnonzero(disc(100, 20, 8)))


def test_a_pixel_that_seldom_returns_counts_as_missing() -> None:
    hole = disc(60, 45, 10)
    cloud, evidence = looked(np.zeros(SHAPE, bool))
    for returned, expected in ((3, 1), (10, 0)):
        rare = replace(cloud, count=np.where(hole, returned, cloud.count))
        missing = missing_returns(rare, evidence)
        assert missing is not None
        assert len(missing.detections) == expected
        assert missing.blind == 0.0


def test_a_cloud_without_a_grid_does_not_tell_what_it_lacks() -> None:
    cloud, evidence = looked(np.zeros(SHAPE, bool))
    assert missing_returns(replace(cloud, organised=False), evidence) is None


def test_cells_that_no_view_saw_are_blind_on_a_map() -> None:
    """A map's cells are equal squares of x and y; the number of its samples says nothing of
    frames."""
    gone = disc(60, 45, 10)
    x = (U - 60) * 1e-3
    y = (V - 45) * 1e-3
    points = np.where(
        gone[..., None],
        np.nan,
        np.stack([x, y, np.zeros(SHAPE)], axis=-1),
    )
    flat = np.zeros(SHAPE, np.uint8)
    cloud = Cloud(
        points,
        flat,
        flat + 1,
        np.full(SHAPE, np.nan),
        Region(0, 90, 0, 120),
        0.0,
        30,
        projection="parallel",
    )
    score = np.where(cloud.valid, 0.0, np.nan)
    evidence = Evidence(score, score, score, 1e-3)

    missing = missing_returns(cloud, evidence)

    assert missing is not None
    (detection,) = missing.detections
    measured = measure_missing(cloud, evidence, detection)
    assert measured.extent_diameter_m == pytest.approx(2e-3 * np.sqrt(gone.sum() / np.pi), rel=1e-6)
    np.testing.assert_allclose(measured.extent_centre_m, [0.0, 0.0, 0.0], atol=1e-9)


def test_evidence_is_the_likelihood_ratio_of_the_number_in_a_disc() -> None:
    """Five missing pixels in a row of 40,000 others without any: a disc of radius 2.5 holds all,
    one less half a pixel counts, and the rate is that of the target and its window. The excess of
    the spread over chance does not reach the nine pixels of one bad sample."""
    shape = (200, 200)
    gone = np.zeros(shape, bool)
    gone[100, 98:103] = True
    score = np.where(gone, np.nan, 0.0)
    flat = np.zeros(shape, np.uint8)
    points_m = np.where(gone[..., None], np.nan, 1.0) * np.ones((*shape, 3))
    cloud = Cloud(points_m, flat, flat + 1, score, Region(0, 200, 0, 200), 0.0, 1)

    detection = missing_evidence(cloud, Evidence(score, score, score, 1e-3))

    assert detection is not None
    rate = (5 + 200 * 5 / 40_000) / (65**2 + 200)
    ratios = []
    for pixels, number in ((9, 3), (21, 5), (37, 5)):
        expected = pixels * rate
        counted = number - 0.5
        ratios.append(counted * np.log(counted / expected) - (counted - expected))
    assert detection[100, 100] == pytest.approx(2.0 * max(ratios) / 9.0, rel=1e-3)
    assert detection[100, 110] == 0.0
    assert (detection >= 0.0).all()


def test_missing_pixels_beside_high_scores_do_not_count_as_chance() -> None:
    """Clusters that touch a high score tell of damage: without them the rate is lower, and what
    they add is more."""
    gone = np.random.default_rng(4).random(SHAPE) < 0.01
    gone[45, 60:63] = True
    cloud, evidence = looked(gone)
    quiet = missing_evidence(cloud, evidence)
    score = evidence.score.copy()
    score[44, 61] = 3.5
    loud = missing_evidence(cloud, replace(evidence, score=score))
    assert quiet is not None
    assert loud is not None
    assert loud[45, 61] > 1.02 * quiet[45, 61]
    score[44, 61] = 2.5
    np.testing.assert_array_equal(missing_evidence(cloud, replace(evidence, score=score)), quiet)


def test_nothing_missing_and_clusters_that_may_be_findings_are_no_evidence() -> None:
    assert missing_evidence(*looked(np.zeros(SHAPE, bool))) is None
    assert missing_evidence(*looked(disc(60, 45, 8))) is None


def test_a_score_is_as_improbable_as_the_expected_number_of_clusters() -> None:
    gone = scattered(np.random.default_rng(7), 0.2, 1) | disc(60.2, 45.3, 10)
    missing = missing_returns(*looked(gone))
    assert missing is not None
    (detection,) = missing.detections
    # one cluster of the least size is expected in 1 / expected targets; each further pixel makes
    # it rarer, at least by half
    further_pixels = len(detection.pixels) - missing.least_points
    score_at_most = norm.isf(missing.expected * 0.5**further_pixels)
    score_at_least = norm.isf(missing.expected)
    assert score_at_least < detection.score
    assert detection.score < max(3.0 * score_at_most, 37.0)
    assert missing.expected <= ALPHA < 3.0 * missing.expected


def test_scores_fall_along_one_line_of_chance() -> None:
    """The logarithm of the probability of two holes' scores and of the least size lie on a line
    over their sizes."""
    gone = scattered(np.random.default_rng(7), 0.2, 1) | disc(60.2, 45.3, 9) | disc(30, 60, 7)
    missing = missing_returns(*looked(gone))
    assert missing is not None
    large, small = missing.detections
    log_large = norm.logsf(large.score)
    log_small = norm.logsf(small.score)
    fall = (log_small - log_large) / (len(large.pixels) - len(small.pixels))
    at_least = log_small + fall * (len(small.pixels) - missing.least_points)
    assert at_least == pytest.approx(np.log(missing.expected), rel=1e-6)


def depth_finding(pixels: np.ndarray, score: float = 9.0) -> Detection:
    return Detection(score, np.flatnonzero(pixels), np.zeros(3))


def test_a_hole_seen_by_depth_and_by_missing_returns_is_one_damage() -> None:
    core = disc(60, 45, 8)
    ring = disc(60, 45, 20) & ~disc(60, 45, 8)
    far = depth_finding(disc(20, 20, 5), score=6.0)
    nothing = Detection(12.0, np.flatnonzero(core), np.zeros(3), "no return")
    # a ring of valid deep pixels around a core that returned nothing: the larger ring stands for
    # the hole
    kept = one_damage_once(SHAPE, (depth_finding(ring), far), (nothing,))
    assert [finding.kind for finding in kept] == ["depth", "depth"]
    # a ring without return around a small valid floor: what it encloses counts as its own
    hollow = Detection(12.0, np.flatnonzero(ring), np.zeros(3), "no return")
    kept = one_damage_once(SHAPE, (depth_finding(core), far), (hollow,))
    assert [(finding.kind, finding.score) for finding in kept] == [
        ("no return", 12.0),
        ("depth", 6.0),
    ]
    # specks on the rim of a hole that returned nothing
    specks = (depth_finding(disc(55, 45, 2), 8.0), depth_finding(disc(65, 45, 2), 7.0))
    kept = one_damage_once(SHAPE, (*specks, far), (nothing,))
    assert [(finding.kind, finding.score) for finding in kept] == [
        ("no return", 12.0),
        ("depth", 6.0),
    ]
    # a hole most of which is deep; a part of it and of its rim returned nothing, and a speck of
    # the rim did
    hole = disc(60, 45, 12)
    gap = Detection(12.0, np.flatnonzero(hole & (U >= 62)), np.zeros(3), "no return")
    findings = (depth_finding(hole & (U < 62)), depth_finding(disc(67, 45, 4), 8.0), far)
    kept = one_damage_once(SHAPE, findings, (gap,))
    assert [finding.score for finding in kept] == [9.0, 6.0]


def test_a_hole_beside_a_place_without_return_is_damage_of_its_own() -> None:
    # their edges touch
    gone = disc(60, 45, 24)
    hole = disc(60, 62, 10)
    nothing = Detection(12.0, np.flatnonzero(gone), np.zeros(3), "no return")
    kept = one_damage_once(SHAPE, (depth_finding(hole),), (nothing,))
    assert [finding.kind for finding in kept] == ["no return", "depth"]
    # one hole, half of which returned nothing
    half = Detection(
        12.0,
        np.flatnonzero(gone & (U >= 60)),
        np.zeros(3),
        "no return",
    )
    kept = one_damage_once(SHAPE, (depth_finding(gone & (U < 60)),), (half,))
    assert len(kept) == 1


def test_findings_without_return_stand_in_the_table_and_a_map_of_blind_pixels_beside_it(
    tmp_path: Path,
) -> None:
    cloud = without(plane(seed=1), disc(30.2, 70.1, 12))
    detector = load_detector("thesis", {"crop": {"kind": "none"}})

    judged = judged_cloud(detector, cloud, detector.analyse(cloud), 8.0)
    write_findings(tmp_path, judged, {}, "a plane")

    kinds = [finding.kind for finding in judged.findings]
    assert sorted(kinds) == ["bump", "hole", "hole", "no return"]
    row = next(finding for finding in judged.findings if finding.kind == "no return")
    assert np.isnan(row.depth_mm)
    assert np.isnan(row.volume_mm3)
    assert (row.size_from, row.depth_from) == ("area", "none")
    assert (row.u_px, row.v_px) == pytest.approx((30.2, 70.1), abs=0.3)
    line = next(
        text for text in (tmp_path / "findings.csv").read_text().splitlines() if "no return" in text
    )
    assert line.split(",")[8:10] == ["", ""]
    assert cv2.imread(str(tmp_path / "blind.png")).std() > 0


def test_hits_by_missing_returns_stand_beside_those_by_depth() -> None:
    """The limit's row says both kinds; a record of hits by depth alone says no kind."""
    record = study_record().set_ups[0]
    by_depth = record.inspected.hit.copy()
    lost = np.flatnonzero(~by_depth)[:5]
    unseen = np.zeros(len(by_depth), bool)
    unseen[lost] = True
    by_both = replace(
        record.inspected,
        hit=by_depth | unseen,
        by_depth=by_depth,
        by_no_return=unseen,
    )

    limits = [limit_of(replace(record, inspected=by_both), draws=50), limit_of(record, draws=50)]
    grid = LIMITS.grid(limits)
    column = grid.heads.index("found")
    row_of_both, row_of_depth = grid.rows

    n = len(by_depth)
    hits = int(by_depth.sum())
    assert row_of_both[column].text == f"{hits + 5} of {n} ({hits} by depth, 5 by missing returns)"
    assert f"5 of {hits + 5} hits by missing returns alone" in "; ".join(notes_of(limits[0]))
    assert row_of_depth[column].text == f"{hits} of {n}"
