"""The verdict's classes, flags, terms, areas and sentence, by hand."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from detectors.interface import Detection, Evidence, Measurement, MissingReturns
from harness.inspection import verdict
from harness.inspection.verdict import (
    _plan_areas_m2,
    counted_text,
    extent_of,
    flags_of,
    least_floor_mm,
    pitch_mm,
    term_of,
    verdict_of,
    with_remarks,
)
from harness.report.findings import Finding, Judged
from harness.vocabulary.geometry import Cloud, Region
from tests.support.plain_clouds import cloud_of_points

NULL = {"threshold": 5.0, "expected": 1.0, "low": 0.0, "high": 4.0}
PITCH_M = 0.002
Z_M = 1.0


def finding(**fields: object) -> Finding:
    """A sure round hole of 20 mm, 8 mm deep, but for ``fields``."""
    plain = Finding(
        id=1,
        kind="hole",
        u_px=10.0,
        v_px=10.0,
        x_mm=0.0,
        y_mm=0.0,
        z_mm=1000.0,
        diameter_mm=20.0,
        diameter_se_mm=0.1,
        depth_mm=8.0,
        depth_se_mm=0.1,
        sight_depth_mm=8.0,
        volume_mm3=1.0,
        points=50,
        score=20.0,
        length_mm=17.0,
        width_mm=17.0,
        angle_deg=0.0,
        shape="disc",
        size_from="model",
        depth_from="model",
    )
    return replace(plain, **fields)  # type: ignore[arg-type]


def plane_cloud(slope: float = 0.0, projection: str = "central") -> Cloud:
    """A plane of 40 x 60 pixels at 1 m, whose z grows by ``slope`` a metre in x."""
    v, u = np.mgrid[:40, :60]
    across = (u - 29.5) * PITCH_M
    down = (v - 19.5) * PITCH_M
    if projection == "central":
        z = Z_M / (1 - slope * across / Z_M)
        points = np.stack([across * z / Z_M, down * z / Z_M, z], axis=-1)
    else:
        points = np.stack([across, down, Z_M + slope * across], axis=-1)
    return cloud_of_points(points, projection=projection)


def evidence_of(cloud: Cloud, **fields: object) -> Evidence:
    """No deviation on all pixels."""
    flat = np.zeros(cloud.valid.shape)
    plain = Evidence(flat, flat, cloud.points_m[..., 2], 1e-3, notes={"own_null": NULL})
    return replace(plain, **fields)  # type: ignore[arg-type]


def judged_of(*scores: float, rows: tuple[int, ...] = ()) -> Judged:
    """Findings with these scores: squares of 10 x 10 pixels, 20 mm wide and 8 mm deep, whose first
    row is 15, or that of ``rows``."""
    cloud = plane_cloud()
    detections = []
    measurements = []
    for number, score in enumerate(scores):
        row = rows[number] if rows else 15
        v, u = np.mgrid[row : row + 10, 5 + 12 * number : 15 + 12 * number]
        pixels = (v * 60 + u).ravel()
        centre = np.array([0.0, 0.0, Z_M])
        detections.append(Detection(score, pixels, centre))
        measured = Measurement(10, 20, 100, score, 0.02, centre)
        modelled = replace(measured, model_diameter_m=0.02, model_depth_m=0.008)
        measurements.append(
            replace(modelled, model_diameter_se_m=1e-4, length_m=0.017, width_m=0.017)
        )
    return Judged(cloud, evidence_of(cloud), tuple(detections), tuple(measurements))


# ---- classes and flags


def test_findings_with_unknown_odds_are_faint_up_to_one_and_a_half_times_the_threshold() -> None:
    result = with_remarks(judged_of(8.9, 9.0), 6.0)
    assert [remarked.certainty for remarked in result.findings] == ["doubtful", "sure"]
    assert [remarked.flags for remarked in result.findings] == ["faint", ""]


@pytest.mark.parametrize(("odds", "certainty"), [(0.049, "sure"), (0.05, "doubtful")])
def test_known_odds_decide_whatever_the_score(odds: float, certainty: str) -> None:
    for score in (1.0, 99.0):
        judged_finding = finding(noise_probability=odds, score=score)
        flags = flags_of(judged_finding, is_cut=False, least_score=50.0)
        assert verdict.class_of(judged_finding, flags) == certainty


def test_what_noise_may_explain_at_the_rim_is_doubtful() -> None:
    faint = finding(noise_probability=0.4)
    flags = flags_of(faint, is_cut=True, least_score=5.0)
    assert flags == ("faint", "at_rim")
    assert verdict.class_of(faint, flags) == "doubtful"


def test_a_finding_at_the_rim_is_of_its_own_class() -> None:
    """The first row of the picture is the rim, the second is not."""
    result = with_remarks(judged_of(20.0, 20.0, rows=(0, 1)), 5.0)
    assert [remarked.flags for remarked in result.findings] == ["at_rim", ""]
    assert [remarked.certainty for remarked in result.findings] == ["rim or blind", "sure"]


def test_blur_carries_a_finding_to_the_rim_by_half_of_its_width() -> None:
    """The fourth row is 4 pixels deep, the fifth 5."""
    plain = judged_of(20.0, 20.0, rows=(3, 4))
    native = with_remarks(plain, 5.0)
    assert [remarked.flags for remarked in native.findings] == ["", ""]
    blurred = replace(plain, cloud=replace(plain.cloud, noise_reach_px=8.0))
    assert [remarked.flags for remarked in with_remarks(blurred, 5.0).findings] == ["at_rim", ""]
    sides_px = np.full((2, 1, 1), 8.0, np.float32)
    sides_px[1] = 10.0
    wider = replace(plain.cloud, noise_reach_px=8.0, noise_sides_px=sides_px)
    flags = [remarked.flags for remarked in with_remarks(replace(plain, cloud=wider), 5.0).findings]
    assert flags == ["at_rim", "at_rim"]


def flags(**fields: object) -> tuple[str, ...]:
    """The flags of a finding inside the rim, but for ``fields`` the sure round hole."""
    return flags_of(finding(**fields), is_cut=False, least_score=5.0)


def test_a_plain_finding_has_no_flag() -> None:
    assert flags() == ()


def test_flags_say_how_size_and_depth_were_measured() -> None:
    assert flags(size_from="contour") == ("size_from_contour",)
    by_points = flags(size_from="extent", depth_from="extreme residual")
    assert by_points == ("size_from_extent", "depth_from_extreme")
    assert flags(depth_is_least=True) == ("depth_at_least",)


def test_a_hole_is_open_behind_beyond_75_mm() -> None:
    assert flags(depth_mm=75.0) == ()
    assert flags(depth_mm=75.1) == ("open_behind",)


@pytest.mark.parametrize(("kind", "depth_mm"), [("hole", 3.0), ("bump", -3.0)])
def test_a_depth_is_open_if_its_error_is_more_than_a_third_of_it(
    kind: str, depth_mm: float
) -> None:
    assert flags(kind=kind, depth_mm=depth_mm, depth_se_mm=0.9) == ()
    assert flags(kind=kind, depth_mm=depth_mm, depth_se_mm=1.1) == ("depth_open",)


def test_what_returns_no_light_is_open_behind_and_no_noise() -> None:
    """A score below that of faint findings makes it none of these."""
    blind = finding(kind="no return", depth_mm=math.nan, score=1.0)
    assert flags_of(blind, is_cut=False, least_score=5.0) == ("open_behind",)
    assert verdict.class_of(blind, ("open_behind",)) == "rim or blind"


# ---- terms


@pytest.mark.parametrize(
    ("fields", "term"),
    [
        ({}, "hole"),
        ({"depth_mm": 5.1}, "hole"),
        ({"depth_mm": 4.9}, "dent"),
        ({"depth_mm": 2.0, "diameter_mm": 11.9}, "hole or dent"),
        ({"depth_mm": 2.0, "diameter_mm": 12.1}, "dent"),
        ({"length_mm": 40.0}, "hole"),
        ({"length_mm": 40.0, "shape": ""}, "slot"),
        ({"shape": "slot"}, "slot"),
        ({"kind": "bump", "depth_mm": -3.0, "length_mm": 40.0}, "bump"),
        ({"kind": "no return", "depth_mm": math.nan}, "no return"),
        ({"diameter_mm": math.nan}, "hole"),
    ],
)
def test_a_dent_is_less_deep_than_a_quarter_of_its_width_and_shows_its_floor(
    fields: dict[str, object], term: str
) -> None:
    assert term_of(finding(**fields), floor_mm=12.0) == term


def test_a_floor_is_seen_from_three_widths_of_the_filter() -> None:
    """Pixels of 2 mm: three times the lens' blur of 2 pixels, or of a filter of 5 pixels."""
    cloud = plane_cloud()
    evidence = evidence_of(cloud)
    assert least_floor_mm(cloud, evidence) == pytest.approx(12.0)
    assert least_floor_mm(replace(cloud, noise_reach_px=5.0), evidence) == pytest.approx(30.0)
    assert least_floor_mm(replace(cloud, organised=False), evidence) == 0.0


def test_a_wall_behind_the_part_does_not_change_the_size_of_its_pixels() -> None:
    cloud = plane_cloud()
    behind = cloud.points_m.copy()
    behind[:, 20:] *= 3.0
    residual = np.zeros((40, 60))
    residual[:, 20:] = np.nan
    evidence = evidence_of(cloud, residual_m=residual)
    assert pitch_mm(replace(cloud, points_m=behind), evidence) == pytest.approx(2.0)


# ---- areas


@pytest.mark.parametrize("projection", ["central", "parallel"])
def test_the_area_of_a_plane_counts_its_slope(projection: str) -> None:
    """A plane through the axis with slope 0.5 is sqrt(1.25) times as large as its plan view."""
    cloud = plane_cloud(0.5, projection)
    extent = extent_of(Judged(cloud, evidence_of(cloud), (), ()), None)
    x_m = cloud.points_m[..., 0]
    if projection == "parallel":
        plan_m2 = 2400 * PITCH_M**2
    else:
        # rows of a central view are spaced by z times the pixel's angle
        z_m = cloud.points_m[0, :, 2]
        plan_m2 = 40 * PITCH_M / Z_M * float(np.sum(z_m * np.gradient(x_m[0])))
    assert extent.judged_m2 == pytest.approx(plan_m2 * math.sqrt(1.25), rel=2e-3)


def test_the_area_is_that_of_the_surface_and_not_of_what_lies_behind_it() -> None:
    """A hole that shows what lies three times as far away has the area of its mouth."""
    cloud = plane_cloud()
    deep = cloud.points_m.copy()
    deep[10:20, 10:20] *= 3.0
    evidence = evidence_of(cloud)
    extent = extent_of(Judged(replace(cloud, points_m=deep), evidence, (), ()), None)
    assert extent.judged_m2 == pytest.approx(2400 * PITCH_M**2, rel=1e-6)


def test_the_share_is_that_of_the_outline_and_the_blind_area_that_of_its_pixels() -> None:
    cloud = plane_cloud()
    residual = np.zeros((40, 60))
    residual[:, :15] = np.nan
    outline = np.zeros((40, 60), bool)
    outline[:, :45] = True
    missing = MissingReturns(outline, np.zeros((40, 60)), 0.1, 0.0, 9, 0.0, ())
    judged = Judged(cloud, evidence_of(cloud, residual_m=residual), (), (), missing)
    for target in (outline, None):
        extent = extent_of(judged, target)
        assert extent.judged_share == pytest.approx(30 / 45)
        assert extent.judged_m2 == pytest.approx(40 * 45 * PITCH_M**2)
        assert extent.blind_m2 == pytest.approx(0.1 * 40 * 45 * PITCH_M**2)


def test_the_area_of_a_cloud_without_a_grid_is_that_of_its_plan_view() -> None:
    plan = np.random.default_rng(0).uniform([-0.2, -0.1], [0.2, 0.1], (20_000, 2))
    points = np.column_stack([plan, np.full(20_000, 0.7)])[None]
    cloud = replace(
        plane_cloud(),
        points_m=points,
        organised=False,
        region=Region(0, 1, 0, 20_000),
    )
    flat = np.zeros((1, 20_000))
    evidence = Evidence(flat, flat, points[..., 2], 1e-3)
    extent = extent_of(Judged(cloud, evidence, (), ()), None)
    assert extent.judged_m2 == pytest.approx(0.08, rel=0.05)


def test_the_area_in_plan_by_hand() -> None:
    """Twelve points fill four squares of 3 mm2; eleven are too few to tell."""
    y_m, x_m = np.mgrid[:3, :4] * 1e-3
    points_m = np.stack([x_m, y_m, np.ones((3, 4))], axis=-1)
    assert _plan_areas_m2(points_m) == pytest.approx(np.full((3, 4), 1e-6))
    points_m[0, 0] = np.nan
    assert np.isnan(_plan_areas_m2(points_m)).all()


# ---- the sentence


def test_the_sentence_counts_what_is_sure_and_names_the_rest() -> None:
    result = with_remarks(judged_of(20.0, 20.0, 5.1, 20.0, rows=(15, 15, 15, 0)), 5.0)
    verdict = verdict_of(result, 5.0)
    assert verdict.sentence == (
        "Two holes found on 96 cm2 of the part; one further place is doubtful;"
        " one place is cut by the rim; 1.0 false calls expected (0 to 4)."
    )
    assert verdict.counts == {"sure": 2, "doubtful": 1, "rim or blind": 1}
    assert verdict.facts["sure"] == {"hole": 2}
    assert verdict.facts["judged_area_m2"] == pytest.approx(0.0096)


def test_with_odds_the_sentence_says_how_many_of_the_sure_are_false() -> None:
    """0.01 + 0.02 of the sure ones; the doubtful one does not count."""
    judged = replace(judged_of(20.0, 9.0, 8.0), noise_probabilities=(0.01, 0.02, 0.3))
    verdict = verdict_of(with_remarks(judged, 5.0), 5.0)
    assert verdict.sentence == (
        "Two holes found on 96 cm2 of the part; one further place is doubtful;"
        " 1.0 false calls expected (0 to 4), 0.03 of them among the sure ones."
    )
    assert verdict.expected_false_sure == pytest.approx(0.03)
    assert verdict.facts["expected_false_calls"] == 1.0
    assert verdict.facts["fewest_false_calls"] == 0.0
    assert verdict.facts["most_false_calls"] == 4.0


def test_the_sentence_of_nothing_and_of_nothing_sure() -> None:
    nothing = verdict_of(with_remarks(judged_of(), 5.0), 5.0).sentence
    assert nothing == "No damage found on 96 cm2 of the part; 1.0 false calls expected (0 to 4)."
    unknown = verdict_of(with_remarks(judged_of(), 6.0), 6.0).sentence
    assert unknown.endswith("; the number of false calls is unknown.")
    doubtful = verdict_of(with_remarks(judged_of(5.1, 5.2), 5.0), 5.0).sentence
    assert doubtful.startswith("No damage is sure on 96 cm2 of the part; two places are doubtful;")


def test_the_sentence_says_which_share_of_the_part_was_judged() -> None:
    judged = judged_of(20.0)
    outline = np.ones((40, 60), bool)
    residual_m = np.zeros((40, 60))
    residual_m[:, 45:] = np.nan
    judged = replace(judged, evidence=replace(judged.evidence, residual_m=residual_m))
    sentence = verdict_of(with_remarks(judged, 5.0), 5.0, outline).sentence
    assert sentence.startswith("One hole found on 72 cm2, 75 % of the part; ")


@pytest.mark.parametrize(
    ("count", "clause"),
    [
        (0, "; 1.0 false calls"),
        (1, "; one place departs no more than the profile is uncertain at its steps; 1.0"),
        (14, "; 14 places depart no more than the profile is uncertain at its steps; 1.0"),
    ],
)
def test_the_sentence_says_how_many_places_steps_explain(count: int, clause: str) -> None:
    judged = judged_of(20.0)
    notes = {"own_null": NULL, "at_steps": count}
    judged = replace(judged, evidence=replace(judged.evidence, notes=notes))
    sentence = verdict_of(with_remarks(judged, 5.0), 5.0).sentence
    assert sentence.startswith(f"One hole found on 96 cm2 of the part{clause}")


@pytest.mark.parametrize(
    ("differing", "clause"),
    [
        (0, "6 joints of 76 x 9 mm in rows, all alike;"),
        (1, "7 joints of 76 x 9 mm in rows, one differs;"),
        (2, "8 joints of 76 x 9 mm in rows, two differ;"),
    ],
)
def test_joints_are_a_feature_and_no_damage(differing: int, clause: str) -> None:
    judged = judged_of(20.0, 20.0, 5.1)
    features = replace(judged.detections[0], count=6)
    facts = {"count": 6, "differing": differing, "length_mm": 76.0, "width_mm": 9.0}
    notes = {"own_null": NULL, "joints": [facts]}
    only = replace(
        judged,
        evidence=replace(judged.evidence, notes=notes),
        detections=(features,),
        measurements=judged.measurements[:1],
    )
    verdict = verdict_of(with_remarks(only, 5.0), 5.0)
    assert verdict.sentence.startswith(f"No damage found on 96 cm2 of the part; {clause}")
    assert verdict.counts == {"sure": 0, "doubtful": 0, "rim or blind": 0, "feature": 1}
    assert verdict.sure_terms == {}
    beside = replace(
        only,
        detections=(features, *judged.detections[1:]),
        measurements=judged.measurements,
    )
    verdict = verdict_of(with_remarks(beside, 5.0), 5.0)
    assert verdict.sentence.startswith("One hole found on 96 cm2 of the part; one further place")
    assert verdict.counts == {"sure": 1, "doubtful": 1, "rim or blind": 0, "feature": 1}


def test_numbers_are_words_up_to_twelve_and_terms_have_plurals() -> None:
    assert counted_text(1, "hole or dent") == "one small hole or dent"
    assert counted_text(12, "hole or dent") == "twelve small holes or dents"
    assert counted_text(13, "bump") == "13 bumps"
    assert verdict.joined_words(["a", "b", "c"]) == "a, b and c"
    assert verdict.area_text(0.1234) == "0.12 m2" and verdict.area_text(0.0096) == "96 cm2"
    assert verdict.calls_text(0.3) == "0.3" and verdict.calls_text(0.004) == "0.004"
