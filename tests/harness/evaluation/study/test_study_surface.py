"""POD over diameter and depth: refusals, terms, notes and intervals."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy import special, stats

from harness.evaluation.intervals import percentiles
from harness.evaluation.pod.curve import HitsAndMisses, maxima
from harness.evaluation.study.boards import weights_in_blocks
from harness.evaluation.study.record import SetUpRecord
from harness.evaluation.study.surface import PodSurface, depth_varies, surface_of
from tests.support.synthetic_study import Study, study_record

Coefficients = tuple[float, float, float, float]
PLAIN = (-9.0, 4.5, 2.0, 0.0)
CROSSED = (-4.0, 1.5, -2.0, 2.0)


def drawn(b: Coefficients, boards: int = 20, repeats: int = 1, seed: int = 5) -> SetUpRecord:
    """Hits of chance expit(b0 + b1 ln a + b2 ln d + b3 ln a ln d)."""
    study = Study(boards=boards, repeats=repeats, depths_mm=(0.5, 6.0), hole_free_boards=0)
    record = study_record(study).set_ups[0]
    a = np.log(record.inspected.diameter_mm)
    d = np.log(record.inspected.depth_mm)
    chance = special.expit(b[0] + b[1] * a + b[2] * d + b[3] * a * d)
    hit = np.random.default_rng(seed).random(len(a)) < chance
    return with_columns(record, hit=hit)


def with_columns(record: SetUpRecord, **columns: object) -> SetUpRecord:
    return replace(record, inspected=replace(record.inspected, **columns))  # type: ignore[arg-type]


def fitted(record: SetUpRecord, link: str, terms: int, weights: np.ndarray) -> np.ndarray:
    """Coefficients of the likeliest surface of weighted rows, from an unscaled search."""
    inspected = record.inspected
    a = np.log(inspected.diameter_mm)
    d = np.log(inspected.depth_mm)
    design = np.stack([np.ones_like(a), a, d, a * d], axis=1)[:, :terms]
    hits = weights * inspected.hit
    data = HitsAndMisses(design, hits[None], (weights - hits)[None], link)
    return maxima(data, np.zeros(terms), 1e-9)[0]


@pytest.mark.parametrize(
    ("columns", "why"),
    [
        ({"hit": np.ones(160, bool)}, "all damages had the same outcome"),
        ({"hit": np.zeros(160, bool)}, "all damages had the same outcome"),
        ({"depth_mm": np.linspace(0.0, 4.0, 160)}, "depth does not vary: 0 to 4 mm"),
        ({"depth_mm": np.linspace(1.0, 1.19, 160)}, "depth does not vary: 1 to 1.19 mm"),
        ({"diameter_mm": np.full(160, 7.0)}, "diameter does not vary: 7 mm"),
        ({"diameter_mm": np.full(160, 7.0), "size_of": "width"}, "width does not vary: 7 mm"),
    ],
)
def test_studies_without_a_surface(columns: dict[str, object], why: str) -> None:
    surface, reason = surface_of(with_columns(drawn(PLAIN), **columns))
    assert surface is None
    assert reason.startswith(why)


def test_depth_varies_by_a_fifth() -> None:
    assert depth_varies(np.array([1.0, 1.2]))
    assert not depth_varies(np.array([1.0, 1.19]))
    assert not depth_varies(np.zeros(0))


def test_the_contour_and_its_percentiles_over_boards() -> None:
    record = drawn(PLAIN)
    surface, why = surface_of(record, draws=30)
    assert surface is not None
    assert why == ""
    inspected = record.inspected
    assert surface.depth_range_mm == (inspected.depth_mm.min(), inspected.depth_mm.max())
    assert len(surface.diameter_mm) == 25
    assert surface.diameter_mm[0] == pytest.approx(inspected.diameter_mm.min())
    assert surface.diameter_mm[-1] == pytest.approx(inspected.diameter_mm.max())
    ratios = surface.diameter_mm[1:] / surface.diameter_mm[:-1]
    assert ratios == pytest.approx(ratios[0])
    level = special.logit(0.9) if surface.link == "logit" else stats.norm.ppf(0.9)
    log_a = np.log(surface.diameter_mm)
    b0, b1, b2, b3 = surface.b
    assert b3 == 0.0
    assert surface.d90_mm == pytest.approx(np.exp((level - b0 - b1 * log_a) / b2))
    (weights,) = next(iter(weights_in_blocks(30, (inspected.board, "damaged"))))
    depths = []
    for weight in weights:
        b = fitted(record, surface.link, 3, weight)
        depth = np.exp((level - b[0] - b[1] * log_a) / b[2])
        depths.append(depth if b[2] > 0 else np.full(25, np.inf))
    for index in (0, 12, 24):
        ends = percentiles(np.array(depths)[:, index])
        assert surface.d90_low_mm[index] == pytest.approx(ends.low, rel=1e-4)
        assert surface.d90_high_mm[index] == pytest.approx(ends.high, rel=1e-4)


def test_one_board_gives_no_interval() -> None:
    record = drawn(PLAIN, boards=20)
    one_board = np.zeros(160, int)
    holes = np.arange(160).astype(str)
    surface, _ = surface_of(with_columns(record, board=one_board, hole=holes), draws=5)
    assert surface is not None
    assert np.isnan(surface.d90_low_mm).all()
    assert np.isnan(surface.d90_high_mm).all()
    assert np.isfinite(surface.d90_mm).any()


@pytest.mark.parametrize("repeats", [1, 2])
def test_the_p_value_of_an_interaction_counts_damages_once(repeats: int) -> None:
    record = drawn(PLAIN, repeats=repeats)
    surface, _ = surface_of(record, draws=5)
    assert surface is not None
    inspected = record.inspected
    ones = np.ones(len(inspected.hit))
    deviances = []
    for terms in (3, 4):
        b = fitted(record, surface.link, terms, ones)
        a = np.log(inspected.diameter_mm)
        d = np.log(inspected.depth_mm)
        columns = np.stack([np.ones_like(a), a, d, a * d], axis=1)[:, :terms]
        hits = inspected.hit.astype(float)
        value = HitsAndMisses(columns, hits, 1 - hits, surface.link).value(b)
        deviances.append(-2 * float(value))
    ratio = (deviances[0] - deviances[1]) / repeats
    assert surface.interaction_p == pytest.approx(stats.chi2.sf(ratio, 1), rel=1e-5)
    assert surface.interaction_p > 0.05
    assert surface.deviance == pytest.approx(deviances[0], rel=1e-9)
    assert surface.note == ""


def test_an_interaction_is_kept_if_pod_grows_at_all_depths() -> None:
    record = drawn(CROSSED, boards=60)
    surface, _ = surface_of(record, draws=5)
    assert surface is not None
    assert surface.interaction_p < 0.05
    assert surface.b == pytest.approx(fitted(record, surface.link, 4, np.ones(480)), rel=1e-5)
    assert surface.b[3] > 1.0
    assert surface.note == ""


def test_an_interaction_with_falling_pod_is_left_out_with_a_note() -> None:
    """At shallow depths POD falls with the diameter: b1 + b3 ln(0.5) < 0."""
    surface, _ = surface_of(drawn((-8.0, 1.0, 0.5, 2.5), boards=60), draws=5)
    assert surface is not None
    assert surface.b[3] == 0.0
    words = f"diameter and depth interact (p = {surface.interaction_p:.2g}), which the surface"
    assert surface.note == f"{words} leaves out"


def test_a_pod_that_falls_with_depth_has_no_contour() -> None:
    surface, _ = surface_of(drawn((-5.0, 4.0, -1.5, 0.0), boards=60), draws=5)
    assert surface is not None
    assert surface.note.startswith("POD falls with depth")
    assert np.isinf(surface.d90_mm).all()


def test_a_surface_by_hand() -> None:
    surface = PodSurface(
        link="logit",
        b=np.array([-3.0, 1.0, 2.0, 0.5]),
        interaction_p=0.01,
        deviance=1.0,
        diameter_mm=np.ones(1),
        d90_mm=np.ones(1),
        d90_low_mm=np.ones(1),
        d90_high_mm=np.ones(1),
        depth_range_mm=(1.0, 2.0),
    )
    pod = surface.pod(np.array([np.e]), np.array([np.e**2]))
    assert pod == pytest.approx(special.expit(-3.0 + 1.0 + 4.0 + 1.0))
