"""The surface through limits: against a plain weighted fit, and verdicts, cells and refusals by
hand."""

from __future__ import annotations

import json

import numpy as np
import pandas as pd
import pytest
from scipy import stats

from harness.programs.atlas.limits import Answer, LimitSurface, Outside, surfaces_of

DISTANCES_M = (0.5, 1.0, 2.0)
FRAMES = (1, 10, 100)
SIGMA = 0.04
"""Standard deviation of ln a90 that the intervals state."""


def limits(scatter: float = 0.0, damage: str = "through") -> pd.DataFrame:
    """Nine set-ups of a law that is a quadratic of logarithms, with normal errors of ln a90."""
    stream = np.random.default_rng(3)
    rows = []
    for distance_m in DISTANCES_M:
        for frames in FRAMES:
            log_a90 = log_law(distance_m, frames) + scatter * stream.normal()
            rows.append(
                {
                    "source.camera.name": "kinect_v2",
                    "source.target.damage": json.dumps({"kind": damage}),
                    "source.target.distance_m": distance_m,
                    "frames": frames,
                    "detector": "matched",
                    "a90_mm": np.exp(log_a90),
                    "a90_low_mm": np.exp(log_a90 - 1.96 * SIGMA),
                    "a90_high_mm": np.exp(log_a90 + 1.96 * SIGMA),
                    "largest_mm": 40.0,
                    "is_at_most": False,
                    "hits": 50,
                }
            )
    return pd.DataFrame(rows)


def log_law(distance_m: float, frames: float) -> float:
    x, y = scaled(distance_m, frames)
    return float(2.0 + 0.7 * x - 0.4 * y + 0.1 * x**2 + 0.05 * y**2 - 0.08 * x * y)


def scaled(distance_m: float, frames: float) -> tuple[float, float]:
    """Distance and frames from -1 to 1 in their logarithms."""
    return float(np.log(distance_m) / np.log(2.0)), float(np.log10(frames) - 1.0)


def design(places: list[tuple[float, float]]) -> np.ndarray:
    rows = []
    for distance_m, frames in places:
        x, y = scaled(distance_m, frames)
        rows.append([1.0, x, y, x**2, y**2, x * y])
    return np.array(rows)


def weighted(places: list[tuple[float, float]], values: np.ndarray) -> np.ndarray:
    """Coefficients by least squares; all set-ups have the same weight."""
    return np.linalg.lstsq(design(places), values, rcond=None)[0]


def test_a_surface_goes_through_a_law_of_its_own_form() -> None:
    surface = surfaces_of(limits())[0]
    answer = surface.at(distance_m=0.7, frames=30)
    assert answer.a90_mm == pytest.approx(np.exp(log_law(0.7, 30)), rel=1e-6)
    assert surface.error == pytest.approx(0.0, abs=1e-6)
    # the interval alone: 9 set-ups less 6 terms leave 3 degrees of freedom
    rows = design([(distance_m, frames) for distance_m in DISTANCES_M for frames in FRAMES])
    row = design([(0.7, 30)])[0]
    std = SIGMA * np.sqrt(row @ np.linalg.inv(rows.T @ rows) @ row)
    half = stats.t.ppf(0.975, 3) * std
    assert np.log(answer.high_mm / answer.a90_mm) == pytest.approx(half, rel=1e-4)
    assert np.log(answer.a90_mm / answer.low_mm) == pytest.approx(half, rel=1e-4)
    assert answer.largest_mm == 40.0


def test_scatter_beyond_the_intervals_widens_the_answer() -> None:
    """Against a fit that leaves each set-up out in turn."""
    table = limits(scatter=0.3)
    surface = surfaces_of(table)[0]
    nodes = [(distance_m, frames) for distance_m in DISTANCES_M for frames in FRAMES]
    log_a90 = np.log(table["a90_mm"].to_numpy())
    errors = []
    for left_out in range(len(nodes)):
        remaining = [node for number, node in enumerate(nodes) if number != left_out]
        coefficients = weighted(remaining, np.delete(log_a90, left_out))
        errors.append(log_a90[left_out] - (design([nodes[left_out]]) @ coefficients)[0])
    rms = np.sqrt(np.mean(np.square(errors)))
    assert surface.error == pytest.approx(rms, rel=1e-6)

    coefficients = weighted(nodes, log_a90)
    residuals = log_a90 - design(nodes) @ coefficients
    row = design([(0.7, 30)])[0]
    std_of_fit = np.sqrt(
        (residuals @ residuals / 3) * (row @ np.linalg.inv(design(nodes).T @ design(nodes)) @ row)
    )
    half = stats.t.ppf(0.975, 3) * np.hypot(std_of_fit, rms)
    answer = surface.at(distance_m=0.7, frames=30)
    assert np.log(answer.a90_mm) == pytest.approx(row @ coefficients, rel=1e-9)
    assert np.log(answer.high_mm / answer.a90_mm) == pytest.approx(half, rel=1e-6)


def test_a_limit_without_an_interval_counts_little() -> None:
    """A wrong limit that states no lower end moves the surface less than one with an interval."""
    wrong = limits()
    wrong.loc[4, ["a90_mm", "a90_low_mm", "a90_high_mm"]] *= 2.0
    vague = wrong.copy()
    vague.loc[4, "a90_low_mm"] = 0.0
    truth_mm = np.exp(log_law(1.0, 10))
    moved = []
    for table in (vague, wrong):
        moved.append(np.log(surfaces_of(table)[0].at(distance_m=1.0, frames=10).a90_mm / truth_mm))
    # one ninth of the weight is 5/9 of leverage; a variance of 0.25 instead of 0.0016 leaves 0.8 %
    assert moved[1] == pytest.approx(np.log(2.0) * 5 / 9, rel=1e-3)
    weight = SIGMA**2 / 0.25
    leverage = 5 / 9
    expected = np.log(2.0) * weight * leverage / (1 - leverage + weight * leverage)
    assert moved[0] == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize(
    ("interval", "largest_mm", "size_mm", "verdict"),
    [
        ((5.0, 4.0, 6.0), 40.0, 6.0, "yes"),
        ((5.0, 4.0, 6.0), 40.0, 5.9, "undecided"),
        ((5.0, 4.0, 6.0), 40.0, 4.0, "undecided"),
        ((5.0, 4.0, 6.0), 40.0, 3.9, "no"),
        # every set-up around misses all sizes up to 40 mm
        ((np.nan, np.nan, np.nan), 40.0, 40.0, "no"),
        ((np.nan, np.nan, np.nan), 40.0, 40.1, "undecided"),
        ((np.nan, np.nan, np.nan), np.nan, 10.0, "undecided"),
    ],
)
def test_verdicts(
    interval: tuple[float, float, float], largest_mm: float, size_mm: float, verdict: str
) -> None:
    a90_mm, low_mm, high_mm = interval
    answer = Answer(a90_mm=a90_mm, low_mm=low_mm, high_mm=high_mm, largest_mm=largest_mm)
    assert answer.verdict(size_mm) == verdict


def has_limit(surface: LimitSurface, distance_m: float, frames: float) -> bool:
    return bool(np.isfinite(surface.at(distance_m=distance_m, frames=frames).a90_mm))


def test_a_set_up_without_a_limit_takes_it_from_the_cells_around_it() -> None:
    table = limits()
    corner = (table["source.target.distance_m"] == 2.0) & (table["frames"] == 1)
    table.loc[corner, "a90_mm"] = 50.0  # beyond the largest size
    table.loc[~corner, "largest_mm"] = 30.0
    surface = surfaces_of(table)[0]
    assert not has_limit(surface, 2.0, 1)
    assert not has_limit(surface, 1.5, 5)
    assert has_limit(surface, 1.0, 1)
    assert has_limit(surface, 1.5, 10)
    assert has_limit(surface, 0.7, 5)
    at_corner = surface.at(distance_m=2.0, frames=1)
    beside_it = surface.at(distance_m=1.5, frames=5)
    assert at_corner.largest_mm == 40.0  # missed there, so a size up to 40 mm is not found
    assert np.isnan(beside_it.largest_mm)  # a neighbour finds smaller damage
    assert surface.at(distance_m=0.5, frames=1).largest_mm == 30.0


def test_the_largest_size_is_the_least_of_the_set_ups_around() -> None:
    table = limits()
    table.loc[table["frames"] == 10, "largest_mm"] = 25.0
    surface = surfaces_of(table)[0]
    assert surface.at(distance_m=0.7, frames=30).largest_mm == 25.0
    assert surface.at(distance_m=0.7, frames=100).largest_mm == 40.0


def test_an_axis_that_is_not_asked_for_takes_its_first_value() -> None:
    shallow = limits(damage="blind")
    deep = limits(damage="blind")
    for table, depth_mm in ((shallow, 3.0), (deep, 6.0)):
        damage = {"kind": "blind", "depth_mm": [depth_mm - 1.0, depth_mm + 1.0]}
        table["source.target.damage"] = json.dumps(damage)
    sizes = ["a90_mm", "a90_low_mm", "a90_high_mm"]
    deep[sizes] *= 0.5
    surface = surfaces_of(pd.concat([shallow, deep], ignore_index=True))[0]
    assert surface.grid["depth_mm"] == (3.0, 6.0)
    first = surface.at(distance_m=1.0, frames=10)
    assert first == surface.at(distance_m=1.0, frames=10, depth_mm=3.0)
    assert first.a90_mm == pytest.approx(np.exp(log_law(1.0, 10)), rel=1e-6)


def test_the_ends_of_the_range_are_inside() -> None:
    surface = surfaces_of(limits())[0]
    # a value that was rounded does not lie outside
    for distance_m in (0.5 - 1e-10, 0.5, 2.0, 2.0 + 1e-10):
        assert has_limit(surface, distance_m, 1)
    for distance_m in (0.499, 2.001):
        with pytest.raises(Outside, match=r"^distance .* m: the atlas has 0\.5 to 2 m$"):
            surface.at(distance_m=distance_m, frames=1)


def test_an_axis_with_one_value_is_named_by_it() -> None:
    table = limits()
    surface = surfaces_of(table[table["frames"] == 10])[0]
    with pytest.raises(Outside, match=r"^frames 5: the atlas has 10 only$"):
        surface.at(distance_m=1.0, frames=5)


@pytest.mark.parametrize(
    ("set_ups", "terms"),
    [
        (9, [(), (0,), (1,), (0, 0), (1, 1), (0, 1)]),
        (7, [(), (0,), (1,), (0, 0), (1, 1)]),
        (6, [(), (0,), (1,), (0, 0)]),
        (5, [(), (0,), (1,)]),
        (4, None),
    ],
)
def test_few_limits_get_few_terms(set_ups: int, terms: list[tuple[int, ...]] | None) -> None:
    table = limits()
    table.loc[table.index >= set_ups, "a90_mm"] = np.nan
    surface = surfaces_of(table)[0]
    if terms is None:
        assert surface.fit is None
        assert np.isnan(surface.error)
        assert not has_limit(surface, 0.5, 1)
    else:
        assert surface.fit is not None
        assert list(surface.fit.terms) == terms
        assert surface.fit.degrees == set_ups - len(terms)


def test_an_axis_of_two_values_has_no_square() -> None:
    table = limits()
    surface = surfaces_of(table[table["frames"] != 10])[0]
    assert surface.fit is not None
    assert list(surface.fit.terms) == [(), (0,), (1,), (0, 0)]
