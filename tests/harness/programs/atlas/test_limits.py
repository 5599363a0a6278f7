"""The law through limits: against a law that is known, plain least squares, and verdicts and
refusals by hand."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from harness.programs.atlas.limits import Answer, Conditions, LimitSurface, Outside, fitted
from tests.support.made_up_atlas import law_mm, noise_mm, noise_table, shard

BETWEEN = [
    Conditions(0.5, 0.3, 10),
    Conditions(1.4, 0.6, 1),
    Conditions(2.2, 0.2, 25),
]


def surface(kind: str = "through", seed: int = 1, camera: str = "sharp") -> LimitSurface:
    return shard(camera, seed).surfaces(kind)[0]


def test_intervals_hold_the_law_between_set_ups():
    """At other distances, albedos, frames and depths than those that were computed."""
    covered = []
    widths = []
    for seed in range(40):
        for kind, depth_mm in (("through", None), ("blind", 4.0)):
            fitted_law = surface(kind, seed)
            for conditions in BETWEEN:
                conditions = replace(conditions, depth_mm=depth_mm)
                answer = fitted_law.at(conditions)
                covered.append(answer.low_mm <= law_mm("sharp", conditions) <= answer.high_mm)
                widths.append(answer.high_mm / answer.low_mm)
    assert np.mean(covered) > 0.93 and np.median(widths) < 1.45


@pytest.mark.parametrize("camera", ["sharp", "dim"])
def test_the_noise_between_its_nodes(camera: str):
    table = noise_table(camera)
    for conditions in (*BETWEEN, Conditions(0.3, 0.9, 50), Conditions(2.7, 0.1, 1)):
        assert table.at(conditions) == pytest.approx(noise_mm(camera, conditions), rel=0.01)


def test_no_depth_is_no_answer():
    dark = surface()
    frame_mm = dark.noise.frame_mm.copy()
    frame_mm[-1, 0] = np.nan  # the darkest target at the farthest distance
    dark = replace(dark, noise=replace(dark.noise, frame_mm=frame_mm), set_ups=dark.set_ups[:8])
    with pytest.raises(Outside, match="gives no depth there or nearby"):
        replace(dark.noise).at(Conditions(2.0, 0.2, 1))
    assert dark.at(Conditions(0.5, 0.6, 10)).a90_mm > 0


@pytest.mark.parametrize(
    ("conditions", "message"),
    [
        (Conditions(2.8, 0.3, 1), "distance 2.8 m: the atlas has 0.3 to 2.7 m"),
        (Conditions(0.29, 0.3, 1), "distance 0.29 m"),
        (Conditions(1.0, 0.3, 51), "frames 51: the atlas has 1 to 50"),
        (Conditions(1.0, 0.05, 1), "albedo 0.05: the atlas has 0.1 to 0.9"),
    ],
)
def test_nothing_is_extrapolated(conditions: Conditions, message: str):
    with pytest.raises(Outside, match=message):
        surface().at(conditions)
    with pytest.raises(Outside, match="depth 9 mm: the atlas has 2 to 8 mm"):
        surface("blind").at(replace(conditions, distance_m=1.0, frames=1, albedo=0.3, depth_mm=9.0))


def test_beyond_set_ups_without_a_limit_only_bounds_are_known():
    """Far away nothing was found; near and with many frames, all was."""
    whole = surface()
    set_ups = []
    for set_up in whole.set_ups:
        if set_up.conditions.distance_m == 2.7:
            set_up = replace(set_up, a90_mm=math.nan, hits=0, largest_mm=30.0)
        if set_up.conditions.distance_m == 0.3:
            set_up = replace(set_up, is_at_most=True, smallest_mm=1.0)
        set_ups.append(set_up)
    cut = replace(whole, set_ups=tuple(set_ups))
    # the least noisy set-up at 2.7 m is easier than this one
    far = cut.at(Conditions(2.7, 0.5, 1))
    assert math.isnan(far.a90_mm) and far.missed_mm == 30.0
    assert (far.verdict(30.0), far.verdict(31.0)) == ("no", "undecided")
    near = cut.at(Conditions(0.3, 0.9, 10))
    assert math.isnan(near.a90_mm) and near.found_mm == 1.0
    assert (near.verdict(1.0), near.verdict(0.9)) == ("yes", "undecided")
    # between the last distance with limits and the first without, nothing is known
    assert cut.at(Conditions(1.5, 0.5, 10)) == pytest.approx(Answer(), nan_ok=True)


def test_the_error_is_that_of_set_ups_left_out():
    """Against fits without each limit in turn."""
    stream = np.random.default_rng(2)
    design = np.column_stack([np.ones(12), stream.normal(size=(12, 2))])
    variances = stream.uniform(0.5, 2.0, 12)
    log_a90 = design @ [1.0, 0.5, -0.3] + stream.normal(0, 0.1, 12)
    misses = []
    for out in range(12):
        rest = np.arange(12) != out
        weights = 1 / np.sqrt(variances[rest])
        coefficients, *_ = np.linalg.lstsq(
            design[rest] * weights[:, None], log_a90[rest] * weights, rcond=None
        )
        misses.append(log_a90[out] - design[out] @ coefficients)
    found = fitted(design, log_a90, variances)
    assert found.error == pytest.approx(np.sqrt(np.mean(np.square(misses))), rel=1e-9)
    assert found.degrees == 9


@pytest.mark.parametrize(
    ("answer", "verdict"),
    [
        (Answer(5.0, 4.0, 6.0), "undecided"),
        (Answer(4.0, 3.0, 5.0), "yes"),
        (Answer(7.0, 5.1, 9.0), "no"),
        (Answer(), "undecided"),
        (Answer(missed_mm=5.0), "no"),
        (Answer(found_mm=5.0), "yes"),
    ],
)
def test_a_verdict_on_5_mm(answer: Answer, verdict: str):
    assert answer.verdict(5.0) == verdict


def test_bounds_that_contradict_one_another_are_none():
    """Far away all of 4 mm was found, and near by, which is easier, 6 mm was missed."""
    whole = surface()
    set_ups = []
    for set_up in whole.set_ups:
        if set_up.conditions.distance_m == 0.3:
            set_up = replace(set_up, a90_mm=math.nan, hits=0, largest_mm=6.0)
        if set_up.conditions.distance_m == 2.7:
            set_up = replace(set_up, is_at_most=True, smallest_mm=4.0)
        set_ups.append(set_up)
    answer = replace(whole, set_ups=tuple(set_ups)).at(Conditions(0.9, 0.5, 10))
    assert answer == pytest.approx(Answer(), nan_ok=True)
    assert answer.verdict(5.0) == "undecided"
