"""Missing returns: what is found, where and how large, how often chance passes for a finding, and
one damage once."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy.special import ndtri
from scipy.stats import binom, multivariate_normal, norm

from detectors import load_detector
from detectors.findings import missing as missing_module
from detectors.findings.missing import (
    ALPHA,
    LEAST_POINTS,
    RING_PX,
    _Chance,
    _fields,
    _square,
    _tail,
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
from harness.vocabulary.geometry import Cloud, Reason, Region
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


def test_what_is_seldom_seen_is_so_of_all_frames_though_no_pixel_returns_in_each() -> None:
    """Eight of 20 frames show the board; a hole in three of them is missing, and one in four of
    20 just so, as it lacks a return in 80 %."""
    cloud, evidence = looked(np.zeros(SHAPE, bool))
    hole = disc(60, 45, 10)
    for returned, expected in ((3, 1), (4, 1), (5, 0)):
        count = np.where(hole, returned, 8)
        missing = missing_returns(replace(cloud, count=count, n_frames=20), evidence)
        assert missing is not None
        assert len(missing.detections) == expected
        assert missing.unseen[0, 0] == pytest.approx(0.6)
        assert missing.unseen[45, 60] == pytest.approx(1.0 - returned / 20)


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


def embedded(cloud: Cloud, evidence: Evidence, margins: tuple) -> tuple[Cloud, Evidence]:
    """The same in a larger picture, whose other pixels are valid but not judged."""

    def padded(image: np.ndarray, value: float) -> np.ndarray:
        no_padding = ((0, 0),) * (image.ndim - 2)
        return np.pad(image, (*margins, *no_padding), constant_values=value)

    (top, bottom), (left, right) = margins
    region = cloud.region
    around = Region(
        region.row0 - top, region.row1 + bottom, region.col0 - left, region.col1 + right
    )
    larger = replace(
        cloud,
        points_m=padded(cloud.points_m, 3.0),
        reason=padded(cloud.reason, 0),
        count=padded(cloud.count, cloud.n_frames),
        variance_m2=padded(cloud.variance_m2, 1e-6),
        region=around,
    )
    score = padded(evidence.score, np.nan)
    return larger, Evidence(score, score, padded(evidence.surface_z_m, 3.0), 1e-3)


@pytest.mark.parametrize(
    "margins",
    [((2, 3), (5, 4)), ((3, 0), (0, 1)), ((0, 2), (1, 0))],
)
def test_what_lies_around_the_judged_area_changes_nothing(margins) -> None:
    gone = scattered(np.random.default_rng(7), 0.2, 1) | disc(60.2, 45.3, 12)
    gone[:20, :20] = False
    gone |= disc(9.0, 9.0, 16)
    cloud, evidence = looked(gone)
    alone = missing_returns(cloud, evidence)
    larger_cloud, larger_evidence = embedded(cloud, evidence, margins)
    larger = missing_returns(larger_cloud, larger_evidence)
    assert alone is not None
    assert larger is not None
    assert larger.facts == alone.facts
    assert larger.outline.sum() == alone.outline.sum()
    assert len(alone.detections) == len(larger.detections) >= 2
    for before, after in zip(alone.detections, larger.detections, strict=True):
        assert after.score == before.score
        np.testing.assert_array_equal(after.centre_m, before.centre_m)
        first = measure_missing(cloud, evidence, before)
        second = measure_missing(larger_cloud, larger_evidence, after)
        assert (second.u_px, second.v_px) == pytest.approx((first.u_px, first.v_px), abs=1e-9)
        assert second.extent_diameter_m == first.extent_diameter_m


def test_the_surface_at_a_hole_is_that_of_the_judged_pixels_around_it() -> None:
    """Valid pixels that the detector did not judge, pixels within the hole, and those beyond the
    ring do not count."""
    gone = disc(60, 45, 20) & ~disc(60, 45, 6)
    cloud, evidence = looked(gone, tilt=0.3)
    missing = missing_returns(cloud, evidence)
    assert missing is not None
    (detection,) = missing.detections
    expected = measure_missing(cloud, evidence, detection)
    square = np.ones((2 * RING_PX + 1, 2 * RING_PX + 1), np.uint8)
    area = disc(60, 45, 20)
    ring = (cv2.dilate(area.astype(np.uint8), square) > 0) & ~area
    unjudged = ring & (U > 68)
    score = np.where(unjudged, np.nan, evidence.score)
    surface = np.where(ring & ~unjudged, evidence.surface_z_m, 9.0)
    points_m = np.where((ring & ~unjudged)[..., None], cloud.points_m, [7.0, 8.0, 9.0])
    points_m[gone] = np.nan
    elsewhere = replace(cloud, points_m=points_m)
    second = measure_missing(
        elsewhere, replace(evidence, score=score, surface_z_m=surface), detection
    )
    np.testing.assert_allclose(second.extent_centre_m, expected.extent_centre_m, atol=2e-5)
    assert second.extent_diameter_m == pytest.approx(expected.extent_diameter_m, rel=2e-3)
    # each judged pixel of the ring counts: one that is off moves the centre
    for row, column in np.argwhere(ring & ~unjudged)[::5]:
        surface_z_m = evidence.surface_z_m.copy()
        surface_z_m[row, column] += 1.0
        moved = measure_missing(cloud, replace(evidence, surface_z_m=surface_z_m), detection)
        assert np.linalg.norm(moved.extent_centre_m - expected.extent_centre_m) > 1e-5


def test_a_hole_whose_surroundings_are_not_judged_is_no_finding() -> None:
    """Eight judged pixels do not determine a surface, nine do."""
    gone = disc(60, 45, 8)
    cloud, evidence = looked(gone)
    rows, columns = np.nonzero(~gone & disc(60, 45, 11))
    for count in (LEAST_POINTS - 1, LEAST_POINTS):
        score = np.where(disc(60, 45, 30), np.nan, evidence.score)
        score[rows[:count], columns[:count]] = 0.0
        missing = missing_returns(cloud, replace(evidence, score=score))
        assert missing is not None
        assert len(missing.detections) == (count == LEAST_POINTS)


@pytest.mark.parametrize("region", [Region(0, 90, 0, 120), Region(12, 102, 7, 127)])
def test_a_place_is_in_pixels_of_the_whole_image_and_has_the_commonest_reason(region) -> None:
    gone = disc(40.0, 51.0, 9)
    cloud, evidence = looked(gone)
    reason = cloud.reason.copy()
    reason[gone] = Reason.LOW_AMPLITUDE
    reason[gone & (U < 39)] = Reason.SATURATED
    cloud = replace(cloud, region=region, reason=reason)
    missing = missing_returns(cloud, evidence)
    assert missing is not None
    measured = measure_missing(cloud, evidence, missing.detections[0])
    assert measured.u_px == pytest.approx(40.0 + region.col0, abs=1e-9)
    assert measured.v_px == pytest.approx(51.0 + region.row0, abs=1e-9)
    assert measured.model_note == "no return: too little light came back"


def test_pixels_that_returned_in_a_fifth_of_the_frames_count_as_missing() -> None:
    hole = disc(60, 45, 10)
    cloud, evidence = looked(np.zeros(SHAPE, bool))
    for frames, returned, expected in ((20, 4, 1), (20, 5, 0), (50, 10, 1), (50, 11, 0)):
        rare = replace(
            cloud, count=np.where(hole, returned, frames).astype(np.int32), n_frames=frames
        )
        missing = missing_returns(rare, evidence)
        assert missing is not None
        assert len(missing.detections) == expected
        np.testing.assert_allclose(missing.unseen[hole], 1.0 - returned / frames)
        assert not missing.unseen[~hole].any()


def test_clusters_join_along_rows_and_columns_and_reach_the_edge_along_them() -> None:
    """Nine pixels are a finding, eight are not; pixels that touch at corners are two clusters. A
    cluster one pixel from the edge is enclosed."""
    gone = np.zeros(SHAPE, bool)
    gone[50:52, 50:54] = True
    eight = missing_returns(*looked(gone))
    assert eight is not None
    assert not eight.detections
    gone[50:52, 50:54] = False
    gone[1:4, 1:4] = True  # one pixel from both edges
    gone[20:23, 20:23] = True
    gone[23:26, 23:26] = True  # touches at a corner only
    gone[70:73, 117:120] = True  # at the right edge
    gone[87:90, 60:63] = True  # at the lower edge
    gone[0:3, 80:83] = True
    gone[40:43, 0:3] = True
    missing = missing_returns(*looked(gone))
    assert missing is not None
    firsts = [divmod(int(detection.pixels[0]), SHAPE[1]) for detection in missing.detections]
    assert firsts == [(1, 1), (20, 20), (23, 23)]
    # the outline is the judged area with gaps of up to two pixels closed
    assert missing.blind == pytest.approx((9 + 18) / missing.outline.sum())
    assert not missing.outline[70:73, 118:].any()
    assert missing.outline[1:4, 1:4].all()


def test_scattered_dropouts_alone_have_their_share_as_rate() -> None:
    gone = np.zeros(SHAPE, bool)
    gone[10:80:7, 10:110:9] = True
    missing = missing_returns(*looked(gone))
    assert missing is not None
    assert missing.dropouts == pytest.approx(gone.mean())
    assert missing.facts["expected_by_chance"] == 0.0
    assert missing.least_points == LEAST_POINTS
    assert not missing.detections


def test_the_rate_is_that_of_the_pixels_that_are_no_finding() -> None:
    """A hole's pixels count neither as dropouts nor as known; dropouts at all four edges count."""
    single = np.zeros(SHAPE, bool)
    single[0:90:89, 10:110:9] = True
    single[5:85:7, 0:120:119] = True
    single[10:80:7, 5:115:10] = True
    hole = disc(60.4, 45.2, 14)
    around = cv2.dilate(hole.astype(np.uint8), np.ones((3, 3))) > 0
    single &= ~around
    missing = missing_returns(*looked(single | hole))
    assert missing is not None
    assert len(missing.detections) == 1
    assert missing.outline.all()
    assert missing.dropouts == pytest.approx(single.sum() / (single.size - hole.sum()), rel=1e-9)


@pytest.mark.parametrize(
    ("chance", "points"),
    [
        (_Chance(0.1, 12, np.log(3.0), 0.4), 27),  # 12 + ln(300) / 0.4 = 26.3
        (_Chance(0.1, 30, np.log(0.02), 0.3), 33),  # 30 + ln(2) / 0.3 = 32.3
        (_Chance(0.1, 3, np.log(0.02), 0.3), LEAST_POINTS),
    ],
)
def test_the_least_finding_is_the_smallest_that_chance_makes_too_seldom(chance, points) -> None:
    assert chance.least_points == points
    assert chance.log_expected(points) <= np.log(ALPHA)
    assert chance.log_expected(chance.size) == pytest.approx(chance.log_number)
    fall = chance.log_expected(20) - chance.log_expected(23)
    assert fall == pytest.approx(3.0 * chance.fall)


def test_the_tail_of_simulated_clusters_falls_like_a_geometric_distribution() -> None:
    """Of 100 clusters of 1 to 12 pixels in 4 fields the largest 60 begin at 4 pixels; of those of
    4 pixels and more, the mean excess plus two standard errors gives the fall."""
    sizes = np.sort([1] * 25 + [3] * 10 + [4] * 15 + [5] * 20 + [8] * 20 + [12] * 10)
    chance = _tail(0.03, sizes, 4)
    excess = (20 * 1 + 20 * 4 + 10 * 8) / 65 * (1.0 + 2.0 / np.sqrt(65))
    assert chance.rate == 0.03
    assert chance.size == 4
    assert chance.log_number == pytest.approx(np.log(65 / 4))
    # in a geometric distribution of this mean, the share e / (1 + e) goes on
    assert np.exp(-chance.fall) == pytest.approx(excess / (1.0 + excess))
    # few clusters of one size: the slowest fall that is believed
    assert _tail(0.03, np.array([1, 1, 1]), 4).fall == pytest.approx(np.log(2.0))
    for count in (0, 1):
        small = _tail(0.03, np.full(count, 5), 8)
        assert small.size == 1
        assert small.log_expected(1) == pytest.approx(np.log(1 / 8))
        assert small.fall == pytest.approx(np.log(2.0))


@pytest.mark.parametrize("side", [1, 2, 3, 5])
def test_simulated_fields_are_means_over_squares(side: int) -> None:
    """Of unit variance, with a correlation that falls evenly to 0 at the square's side."""
    fields = np.stack(list(_fields((50, 70), side, 60)))
    assert fields.shape == (60, 50, 70)
    # 60 fields of 3500 pixels, of which side^2 share one value: four standard errors
    tolerance = 4.0 * 2.0**0.5 * side / np.sqrt(fields.size)
    assert fields.var() == pytest.approx(1.0, abs=tolerance)
    for lag in range(1, 6):
        expected = max(1.0 - lag / side, 0.0)
        down = (fields[:, lag:] * fields[:, :-lag]).mean()
        across = (fields[:, :, lag:] * fields[:, :, :-lag]).mean()
        assert (down, across) == pytest.approx((expected, expected), abs=tolerance)


@pytest.mark.parametrize(("rate", "side"), [(0.1, 1), (0.1, 2), (0.2, 3), (0.1, 4), (0.3, 5)])
def test_the_square_is_the_one_that_makes_as_many_missing_neighbours(rate, side) -> None:
    """Dropouts of a square have so many missing neighbours that no smaller square explains them,
    and the pairs of neighbours are as frequent as the bivariate normal distribution says."""
    level = ndtri(rate)
    low = np.stack([field < level for field in _fields((300, 400), side, 4)])
    is_known = np.ones(low[0].shape, bool)
    sides = [_square(image, is_known, rate) for image in low]
    turned = [_square(image.T, is_known.T, rate) for image in low]
    assert turned == sides
    # two standard errors: one field in 40 has a larger square
    assert sorted(sides)[1] == sides[0] == side
    correlation = 1.0 - 1.0 / side
    joint = multivariate_normal.cdf([level, level], cov=[[1.0, correlation], [correlation, 1.0]])
    frequent = (low[:, 1:] & low[:, :-1]).mean()
    assert frequent == pytest.approx(joint, rel=0.05)


@pytest.mark.parametrize(
    ("shape", "fields"), [((100, 120), 83), ((500, 1000), 10), ((50, 100), 100)]
)
def test_simulated_fields_hold_a_million_pixels(
    monkeypatch: pytest.MonkeyPatch, shape: tuple[int, int], fields: int
) -> None:
    """But ten fields at least, and a hundred at most."""
    counts = []

    def counted(shape: tuple[int, int], side: int, count: int) -> Iterator[np.ndarray]:
        counts.append(count)
        return _fields(shape, side, 2)

    monkeypatch.setattr(missing_module, "_fields", counted)
    dropouts = np.random.default_rng(14).random(shape) < 0.05
    everywhere = np.ones(shape, bool)
    chance = missing_module._chance_of(dropouts, everywhere, everywhere)
    assert counts == [fields]
    assert chance.rate == pytest.approx(dropouts.mean())


def test_a_larger_square_is_taken_beyond_two_standard_errors() -> None:
    """Of single pixels, the share of missing neighbours is the rate: a measured share of up to two
    of its standard errors more is chance."""
    image = np.random.default_rng(13).random((200, 300)) < 0.1
    is_known = np.ones(image.shape, bool)
    pairs = image[:-1].sum() + image[:, :-1].sum()
    neighbours = (image[:-1] & image[1:]).sum() + (image[:, :-1] & image[:, 1:]).sum()
    share = neighbours / pairs
    error = np.sqrt(share * (1.0 - share) / pairs)
    for sigmas, side in ((-1.0, 1), (1.9, 1), (2.1, 2), (3.9, 2)):
        assert _square(image, is_known, share - sigmas * error) == side


def test_neighbours_that_are_not_known_do_not_count_as_returned() -> None:
    """Pairs with missing pixels that are findings say nothing on the dropouts' square."""
    field = next(_fields((300, 400), 3, 1))
    missing = field < ndtri(0.2)
    is_known = np.ones(missing.shape, bool)
    is_known[::4] = False
    is_known[:, ::5] = False
    assert _square(missing & is_known, is_known, 0.2) == 3


@pytest.mark.parametrize(
    ("down", "across", "is_same"),
    [(2, 2, True), (0, 2, True), (2, 0, True), (3, 0, False), (0, 3, False), (2, 3, False)],
)
def test_one_damage_reaches_two_pixels(down: int, across: int, is_same: bool) -> None:
    """A small finding so far below and beside the corner of a place without return."""
    gone = (U >= 40) & (U <= 60) & (V >= 30) & (V <= 50)
    speck = np.zeros(SHAPE, bool)
    speck[50 + down, 60 + across] = True
    nothing = Detection(12.0, np.flatnonzero(gone), np.zeros(3), "no return")
    kept = one_damage_once(SHAPE, (depth_finding(speck),), (nothing,))
    assert len(kept) == (1 if is_same else 2)


@pytest.mark.parametrize(
    ("radius_px", "distance_px", "is_same"),
    [(10.0, 7, True), (10.0, 9, False), (20.0, 15, True), (20.0, 17, False), (4.0, 4, True)],
)
def test_a_finding_whose_centre_is_far_beside_is_another_damage(
    radius_px: float, distance_px: int, is_same: bool
) -> None:
    """Its centre is 0.8 of its radius, or four pixels if that is more, beside a place without
    return."""
    gone = (U >= 20) & (U <= 60) & (V >= 5) & (V <= 85)
    hole = np.hypot(U - 60 - distance_px, V - 45) <= radius_px
    nothing = Detection(12.0, np.flatnonzero(gone), np.zeros(3), "no return")
    kept = one_damage_once(SHAPE, (depth_finding(hole),), (nothing,))
    assert len(kept) == (1 if is_same else 2)
