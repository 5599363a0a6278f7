"""Slots that repeat: which findings are one feature, and which stay damage."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from detectors.findings.beside_joints import damage_beside, fragments_of, without_damage
from detectors.findings.joints import chance_of_following, joined, joints_facts, joints_of
from detectors.interface import Detection, Evidence, Measurement
from harness.vocabulary.geometry import Cloud
from tests.detectors.test_crop import cloud_of

SHAPE = (200, 300)
PITCH_M = 0.8 / 250
CLOUD: Cloud = cloud_of(np.full(SHAPE, 0.8))
EVIDENCE = Evidence(
    score=np.zeros(SHAPE), residual_m=np.zeros(SHAPE), surface_z_m=np.full(SHAPE, 0.8), scale_m=1e-3
)
BRICKS = [(row, column) for row in range(30, 180, 30) for column in range(20 + row % 60, 280, 60)]


def slot(row: int, column: int, number: int = 0) -> tuple[Detection, Measurement]:
    """A slot along the columns, 20 x 3 pixels, 5 mm deep; its scatter is that of its number."""
    rows, columns = np.mgrid[max(row - 10, 0) : min(row + 10, SHAPE[0]), column - 1 : column + 2]
    pixels = np.sort((rows * SHAPE[1] + columns).ravel())
    centre_m = CLOUD.points_m[row, column]
    scatter = 1.0 + 0.005 * (number % 5 - 2)
    measured = Measurement(
        u_px=float(column + CLOUD.region.col0),
        v_px=float(row + CLOUD.region.row0),
        points=len(pixels),
        score=60.0 - number,
        extent_diameter_m=0.03,
        extent_centre_m=centre_m,
        model_diameter_m=0.03,
        model_diameter_se_m=5e-4,
        model_depth_m=5e-3 * scatter,
        model_depth_se_m=3e-4,
        length_m=20 * PITCH_M,
        width_m=3 * PITCH_M * scatter,
        along=np.array([0.0, 1.0, 0.0]),
        normal_share=1.0,
    )
    return Detection(60.0 - number, pixels, centre_m), measured


def wall(
    places: list[tuple[int, int]] = BRICKS,
) -> tuple[list[Detection], list[Measurement]]:
    pairs = [slot(row, column, number) for number, (row, column) in enumerate(places)]
    return [pair[0] for pair in pairs], [pair[1] for pair in pairs]


def test_head_joints_are_one_feature() -> None:
    detections, measurements = wall()
    (feature,) = joints_of(CLOUD, EVIDENCE, detections, measurements)
    assert sorted(feature.members) == list(range(len(BRICKS)))
    assert feature.differing == ()
    (finding,), (measured,) = joined(detections, measurements, [feature])
    assert finding.count == len(BRICKS)
    assert len(finding.pixels) == measured.points == 60 * len(BRICKS)
    assert finding.score == 60.0
    assert finding.centre_m == pytest.approx(detections[0].centre_m)
    (facts,) = joints_facts([feature], measurements)
    assert (facts["count"], facts["differing"]) == (len(BRICKS), 0)
    assert facts["length_mm"] == pytest.approx(64.0)
    assert facts["depth_mm"] == pytest.approx(5.0)
    assert len(facts["places_px"]) == len(BRICKS)


@pytest.mark.parametrize("field", ["model_depth_m", "width_m", "length_m", "points"])
def test_a_joint_that_differs_stays_a_finding(field: str) -> None:
    detections, measurements = wall()
    usual = getattr(measurements[7], field)
    larger = type(usual)(1.3 * usual)
    measurements[7] = replace(measurements[7], **{field: larger})
    (feature,) = joints_of(CLOUD, EVIDENCE, detections, measurements)
    assert feature.differing == (7,)
    assert 7 not in feature.members
    assert len(joined(detections, measurements, [feature])[0]) == 2


def test_a_joint_that_is_deeper_in_a_part_of_it_differs_and_an_uncertain_width_does_not() -> None:
    detections, measurements = wall()
    residual_m = np.full(SHAPE, 5e-3)
    residual_m.reshape(-1)[detections[7].pixels[:6]] = 7e-3
    evidence = replace(EVIDENCE, residual_m=residual_m)
    error_m = 50.0 * measurements[9].model_diameter_se_m
    measurements[9] = replace(measurements[9], model_diameter_se_m=error_m)
    (feature,) = joints_of(CLOUD, evidence, detections, measurements)
    assert feature.differing == (7,)


@pytest.mark.parametrize(("depth_error_m", "differs"), [(3e-4, True), (2.4e-3, False)])
def test_a_joint_whose_volume_the_blur_parts_otherwise_is_alike(
    depth_error_m: float, differs: bool
) -> None:
    """A joint that is fitted 0.6 times as wide and 1.7 times as deep."""
    detections, measurements = wall()
    measurements[7] = replace(
        measurements[7],
        width_m=0.6 * measurements[7].width_m,
        model_depth_m=1.7 * measurements[7].model_depth_m,
        model_depth_se_m=depth_error_m,
    )
    (feature,) = joints_of(CLOUD, EVIDENCE, detections, measurements)
    assert feature.differing == ((7,) if differs else ())
    assert (7 in feature.members) is not differs


def test_a_joint_that_no_slot_explains_differs_if_it_is_larger_too() -> None:
    detections, measurements = wall()
    measured = measurements[7]
    points = round(1.07 * measured.points)
    error_m = 3.0 * measured.model_diameter_se_m
    measurements[7] = replace(measured, points=points, model_diameter_se_m=error_m)
    measurements[9] = replace(measurements[9], points=points)
    (feature,) = joints_of(CLOUD, EVIDENCE, detections, measurements)
    assert feature.differing == (7,)


def test_a_trend_across_the_picture_is_no_difference_and_a_departure_from_it_is() -> None:
    """Perspective makes joints shallower by 20 % from left to right; one departs by 15 %."""
    detections, measurements = wall()
    for number, measured in enumerate(measurements):
        share = 1.0 - 0.2 * (BRICKS[number][1] - 20) / 260
        measurements[number] = replace(measured, model_depth_m=share * measured.model_depth_m)
    (feature,) = joints_of(CLOUD, EVIDENCE, detections, measurements)
    assert feature.differing == ()
    deeper_m = 1.15 * measurements[11].model_depth_m
    measurements[11] = replace(measurements[11], model_depth_m=deeper_m)
    (feature,) = joints_of(CLOUD, EVIDENCE, detections, measurements)
    assert feature.differing == (11,)


def test_a_slot_between_the_rows_stays_a_finding() -> None:
    detections, measurements = wall([*BRICKS, (45, 67)])
    (feature,) = joints_of(CLOUD, EVIDENCE, detections, measurements)
    assert len(BRICKS) not in (*feature.members, *feature.differing)


def test_a_slot_across_the_others_stays_a_finding() -> None:
    detections, measurements = wall()
    measurements[7] = replace(measurements[7], along=np.array([1.0, 0.0, 0.0]))
    (feature,) = joints_of(CLOUD, EVIDENCE, detections, measurements)
    assert 7 not in (*feature.members, *feature.differing)


def test_drilled_holes_in_a_lattice_stay_findings() -> None:
    detections, measurements = wall()
    width_m = 3 * PITCH_M
    measurements = [replace(measured, length_m=1.9 * width_m) for measured in measurements]
    assert joints_of(CLOUD, EVIDENCE, detections, measurements) == ()


def test_alike_slots_at_random_places_stay_findings() -> None:
    rng = np.random.default_rng(2)
    for _ in range(20):
        rows = rng.integers(20, 180, 8).tolist()
        columns = rng.integers(10, 290, 8).tolist()
        detections, measurements = wall(list(zip(rows, columns, strict=True)))
        assert joints_of(CLOUD, EVIDENCE, detections, measurements) == ()


def test_three_slots_stay_findings_and_a_row_of_six_is_one() -> None:
    for count, features in ((3, 0), (6, 1)):
        centres = [(100, 40 + 40 * number) for number in range(count)]
        assert len(joints_of(CLOUD, EVIDENCE, *wall(centres))) == features


def test_the_end_of_a_joint_at_the_rim_belongs_to_it() -> None:
    # the rim cuts all but the last four pixels of a joint whose middle is outside the picture
    detections, measurements = wall([*BRICKS, (2, 20)])
    last = len(BRICKS)
    rows, columns = np.mgrid[0:4, 19:22]
    pixels = np.sort((rows * SHAPE[1] + columns).ravel())
    detections[last] = replace(detections[last], pixels=pixels)
    short = replace(
        measurements[last], length_m=4 * PITCH_M, along=np.array([0.7, 0.7, 0.0]), width_m=0.008
    )
    measurements[last] = short
    (feature,) = joints_of(CLOUD, EVIDENCE, detections, measurements)
    assert last in feature.members
    # an end that the rim leaves wider than long, too: its length and width are those of the joint's
    across = replace(short, along=np.array([1.0, 0.0, 0.0]), width_m=0.0045, length_m=0.0096)
    measurements[last] = across
    (feature,) = joints_of(CLOUD, EVIDENCE, detections, measurements)
    assert last in feature.members
    measurements[last] = short
    # a hole at the same place inside the picture does not
    detections[last] = replace(detections[last], pixels=pixels + 5 * SHAPE[1])
    (feature,) = joints_of(CLOUD, EVIDENCE, detections, measurements)
    assert last not in feature.members


def test_damage_that_touches_a_joint_is_a_finding_of_its_own() -> None:
    detections, measurements = wall()
    row, column = BRICKS[7]
    rows, columns = np.mgrid[row - 4 : row + 5, column + 2 : column + 8]
    beside = np.sort((rows * SHAPE[1] + columns).ravel())
    damaged = np.union1d(detections[7].pixels, beside)
    detections[7] = replace(detections[7], pixels=damaged)
    measurements[7] = replace(measurements[7], points=len(damaged))
    score = np.zeros(SHAPE)
    score.reshape(-1)[beside] = 20.0
    evidence = replace(EVIDENCE, score=score)
    (feature,) = joints_of(CLOUD, evidence, detections, measurements)
    assert feature.differing == (7,)
    (part,) = damage_beside(CLOUD, evidence, detections, measurements, feature)
    assert part.detection.pixels.tolist() == beside.tolist()
    assert part.detection.score == 20.0
    assert part.detection.centre_m == pytest.approx(
        CLOUD.points_m.reshape(-1, 3)[beside].mean(axis=0)
    )
    without = part.evidence.residual_m
    assert np.isnan(without.reshape(-1)[detections[0].pixels]).sum() == 0
    assert np.isnan(without[row - 10 : row + 10, column - 1 : column + 2]).all()
    assert np.isfinite(without.reshape(-1)[beside]).all()
    undamaged = without_damage(feature, [part])
    assert sorted(undamaged.members) == list(range(len(BRICKS)))
    assert undamaged.differing == ()


@pytest.mark.parametrize("end", [-1, 1])
def test_damage_at_the_end_of_a_joint_is_what_lies_beyond_it(end: int) -> None:
    """It is wider than the joint, which ends within it."""
    detections, measurements = wall()
    row, column = BRICKS[7]
    first = row + 7 if end > 0 else row - 14
    rows, columns = np.mgrid[first : first + 7, column - 3 : column + 4]
    hole = (rows * SHAPE[1] + columns).ravel()
    joint = detections[7].pixels
    damaged = np.union1d(joint, hole)
    detections[7] = replace(detections[7], pixels=damaged)
    measurements[7] = replace(measurements[7], points=len(damaged), length_m=24 * PITCH_M)
    (feature,) = joints_of(CLOUD, EVIDENCE, detections, measurements)
    assert feature.differing == (7,)
    (part,) = damage_beside(CLOUD, EVIDENCE, detections, measurements, feature)
    assert part.detection.pixels.tolist() == np.setdiff1d(hole, joint).tolist()


@pytest.mark.parametrize(
    ("row_off", "deviation_m", "is_fragment"),
    [(8, 2e-3, True), (8, 6e-3, False), (8, -2e-3, False), (12, 2e-3, False)],
)
def test_the_end_of_a_joint_that_was_found_alone_is_a_fragment_of_it(
    row_off: int, deviation_m: float, is_fragment: bool
) -> None:
    """Two rows of the joint's end, 8 rows from its middle; damage is deeper, a bump or outside."""
    detections, measurements = wall()
    row, column = BRICKS[7]
    kept = detections[7].pixels[detections[7].pixels // SHAPE[1] < row + 7]
    detections[7] = replace(detections[7], pixels=kept)
    rows, columns = np.mgrid[row + row_off : row + row_off + 2, column - 1 : column + 2]
    end = np.sort((rows * SHAPE[1] + columns).ravel())
    residual_m = np.zeros(SHAPE)
    for detection in detections:
        residual_m.reshape(-1)[detection.pixels] = 5e-3
    residual_m.reshape(-1)[end] = deviation_m
    evidence = replace(EVIDENCE, residual_m=residual_m)
    centre_m = CLOUD.points_m.reshape(-1, 3)[end].mean(axis=0)
    detections.append(Detection(9.0, end, centre_m))
    measurements.append(replace(measurements[0], length_m=6e-3, width_m=6e-3, score=9.0))
    (feature,) = joints_of(CLOUD, evidence, detections, measurements)
    fragments = fragments_of(CLOUD, evidence, detections, measurements, feature)
    assert fragments == ((len(BRICKS),) if is_fragment else ())
    remaining, _ = joined(detections, measurements, [feature], fragments)
    assert len(remaining) == (1 if is_fragment else 2)


def test_a_deeper_joint_has_no_damage_beside_it() -> None:
    detections, measurements = wall()
    deeper_m = 1.3 * measurements[7].model_depth_m
    measurements[7] = replace(measurements[7], model_depth_m=deeper_m)
    (feature,) = joints_of(CLOUD, EVIDENCE, detections, measurements)
    assert damage_beside(CLOUD, EVIDENCE, detections, measurements, feature) == ()


def test_the_first_pair_of_slots_proves_nothing() -> None:
    """Of five places, one gives the move; of the four others, one or more hold a slot by chance."""
    assert chance_of_following(2, 5, 0.1) == pytest.approx(1.0 - 0.9**4)
    assert chance_of_following(5, 5, 0.1) == pytest.approx(0.1**4)
    assert chance_of_following(1, 5, 0.1) == 1.0
