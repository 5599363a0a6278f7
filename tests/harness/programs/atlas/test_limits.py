"""The law of signals, and limits by it: against a law that is known, counts and other fits, and
verdicts and refusals by hand."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy import special

from harness.programs.atlas import fitting
from harness.programs.atlas.fitting import Sites, fitted
from harness.programs.atlas.limits import (
    Answer,
    Conditions,
    FailedSetUp,
    LimitSurface,
    Outside,
)
from tests.support.made_up_atlas import (
    BETWEEN_SET_UPS,
    SCATTER,
    law_mm,
    noise_mm,
    noise_table,
    shard,
)

BETWEEN = [
    Conditions(0.5, 0.3, 10, 4.0),
    Conditions(1.4, 0.6, 5, 6.0),
    Conditions(2.2, 0.2, 25, 5.0),
]


def surface(kind: str = "through", seed: int = 1, camera: str = "sharp") -> LimitSurface:
    return shard(camera, seed).surfaces(kind)[0]


def test_intervals_hold_the_law_between_set_ups():
    """At other distances, albedos, frames and depths than those that were computed."""
    covered = []
    widths = []
    errors = []
    scatters = []
    for seed in range(4):
        for kind, depth_mm in (("through", 30.0), ("blind", None), ("slot", None)):
            between = surface(kind, seed)
            errors.append(between.law.error)
            scatters.append(between.law.scatter)
            for conditions in BETWEEN:
                conditions = replace(conditions, depth_mm=depth_mm or conditions.depth_mm)
                answer = between.at(conditions)
                assert (answer.half > 1.96 * between.law.error).all()
                covered.append(answer.low_mm <= law_mm("sharp", kind, conditions) <= answer.high_mm)
                widths.append(answer.high_mm / max(answer.low_mm, answer.sizes_mm[0]))
    assert np.mean(covered) > 0.93 and np.median(widths) < 1.6
    assert np.mean(scatters) == pytest.approx(SCATTER, rel=0.1)
    assert BETWEEN_SET_UPS < np.mean(errors) < 3 * BETWEEN_SET_UPS


@pytest.mark.parametrize("camera", ["sharp", "dim"])
def test_the_noise_between_its_nodes(camera: str):
    table = noise_table(camera)
    for conditions in (*BETWEEN, Conditions(0.3, 0.9, 50, 1.0), Conditions(2.7, 0.1, 1, 1.0)):
        noise, fixed_share = table.at(conditions)
        assert noise == pytest.approx(noise_mm(camera, conditions), rel=0.01)
        assert fixed_share == pytest.approx((0.4 / noise) ** 2, rel=0.02)


def test_no_depth_is_no_answer():
    dark = surface()
    frame_mm = dark.noise.frame_mm.copy()
    frame_mm[-1, 0] = np.nan  # the darkest target at the farthest distance
    dark = replace(dark, noise=replace(dark.noise, frame_mm=frame_mm))
    with pytest.raises(Outside, match="gives no depth there or nearby"):
        dark.at(Conditions(2.0, 0.2, 1, 20.0))
    assert dark.at(Conditions(0.5, 0.6, 10, 20.0)).high_mm > 0


@pytest.mark.parametrize(
    ("conditions", "message"),
    [
        (Conditions(2.8, 0.3, 1, 20.0), "distance 2.8 m: the atlas has 0.3 to 2.7 m"),
        (Conditions(0.29, 0.3, 1, 20.0), "distance 0.29 m"),
        (Conditions(1.0, 0.3, 51, 20.0), "frames 51: the atlas has 1 to 50"),
        (Conditions(1.0, 0.05, 1, 20.0), "albedo 0.05: the atlas has 0.1 to 0.9"),
        (Conditions(1.0, 0.3, 1, 70.0), "backing 70 mm: the atlas has 15 to 60 mm"),
    ],
)
def test_nothing_is_extrapolated(conditions: Conditions, message: str):
    with pytest.raises(Outside, match=message):
        surface().at(conditions)
    with pytest.raises(Outside, match="depth 11 mm: the atlas has 1 to 10 mm"):
        surface("blind").at(Conditions(1.0, 0.3, 1, 11.0))


def test_neither_is_the_noise_over_the_depth():
    """A law of little noise says nothing of much."""
    blind_holes = surface("blind")
    lowest, highest = blind_holes.law.ranges["x"]
    ranges = {**blind_holes.law.ranges, "x": (lowest, highest - 2.0)}
    with pytest.raises(Outside, match="of the depth: the atlas has"):
        replace(blind_holes, law=replace(blind_holes.law, ranges=ranges)).at(
            Conditions(2.6, 0.1, 1, 1.0)
        )


def test_beyond_a_set_up_that_failed_nothing_is_known():
    """Farther, darker or with fewer frames than boards that the camera did not see."""
    with_failed = replace(surface(), failed=(FailedSetUp(1.5, 0.4, 5),))
    for hard in (Conditions(1.5, 0.4, 5, 20.0), Conditions(2.0, 0.2, 1, 20.0)):
        with pytest.raises(Outside, match=r"at 1\.5 m, albedo 0\.4, frames 5, which is no harder"):
            with_failed.at(hard)
    for easier in (
        Conditions(1.4, 0.4, 5, 20.0),
        Conditions(1.5, 0.5, 5, 20.0),
        Conditions(1.5, 0.4, 6, 20.0),
    ):
        assert len(with_failed.at(easier).sizes_mm)


def test_a_law_of_unknown_error_answers_nothing():
    known_error = surface()
    with pytest.raises(Outside, match="of 288 such damages were found in all set-ups, too few"):
        replace(known_error, law=replace(known_error.law, error=math.nan)).at(
            Conditions(0.5, 0.3, 10, 20.0)
        )


def sites(stream: np.random.Generator, offsets: np.ndarray) -> Sites:
    """Damages in set-ups that depart from a straight law by offsets."""
    count = 60
    part = np.repeat(np.arange(len(offsets)), count)
    log_size = stream.uniform(0, 2.5, len(part))
    x = stream.uniform(-3, 0, len(part))
    log_signal = 1.1 * log_size - 0.8 * x - 3.0 + offsets[part]
    log_signal += stream.normal(0, 0.25, len(part))
    zeros = np.zeros(len(part))
    return Sites(
        log_size_px=log_size,
        x=x,
        log_pixel_mm=0.1 * part,
        fixed_share=zeros,
        log_albedo=zeros,
        log_signal=log_signal,
        log_threshold=zeros,
        is_found=log_signal >= 0,
        part=part,
        frames=np.ones(len(part), int),
    )


def test_an_error_is_never_below_what_its_departures_can_tell():
    """Departures all but equal to the law leave their own chance, by the scatter of a variance."""
    law, departures = fitted(sites(np.random.default_rng(5), np.zeros(12)), {})
    between = np.array([departure.deviation for departure in departures[1:-1]])
    excess = np.array([departure.log_signal for departure in departures[1:-1]]) ** 2 - between**2
    least = (between**2).mean() * np.sqrt(2 / len(between))
    assert excess.mean() < 0
    assert law.error == pytest.approx(np.sqrt(least))


def test_the_error_is_that_of_distances_left_out():
    """Set-ups that depart by nothing but chance have none; others what they depart by."""
    stream = np.random.default_rng(3)
    even, _ = fitted(sites(stream, np.zeros(12)), {})
    assert even.error < 0.08 and even.scatter == pytest.approx(0.25, rel=0.1)
    offsets = np.tile([-0.3, 0.3], 8)
    uneven, departures = fitted(sites(stream, offsets), {})
    assert uneven.error == pytest.approx(0.3, rel=0.25) and uneven.degrees == 14
    departed = [departure.log_signal for departure in departures]
    assert departed == pytest.approx(offsets, abs=0.2)
    assert sum(departure.expected for departure in departures) == pytest.approx(
        sum(departure.hits for departure in departures), rel=0.05
    )


def test_the_gradient_of_the_fit():
    """Against differences of the loss, with misses, hits, and hits above what counts."""
    damages = sites(np.random.default_rng(5), np.zeros(4))
    ends = (0.0, 2.5)
    design = fitting._design(damages, ends)
    values = np.append(fitting.PRIOR_MEANS + 0.1, -1.0)
    assert np.any(damages.log_signal > np.log(fitting.SATURATED)) and not damages.is_found.all()
    gradient = fitting._loss(values, design, damages)[1]
    for index, step in enumerate(1e-5 * np.eye(len(values))):
        above = fitting._loss(values + step, design, damages)[0]
        below = fitting._loss(values - step, design, damages)[0]
        assert gradient[index] == pytest.approx((above - below) / 2e-5, rel=1e-5, abs=1e-5)


def test_the_density_of_a_signal():
    """A miss is below its own threshold, a hit above it; in between, a signal is itself."""
    damages = sites(np.random.default_rng(5), np.zeros(1)).chosen(np.arange(3))
    damages = replace(
        damages,
        log_signal=np.array([0.2, 0.5, 9.0]),
        log_threshold=np.array([0.3, 0.3, 0.3]),
        is_found=np.array([False, True, True]),
    )
    density, _, _ = fitting._log_densities(np.full(3, 0.4), 0.5, damages)
    log_saturated = np.log(fitting.SATURATED)
    assert density[0] == pytest.approx(np.log(special.ndtr((0.3 - 0.4) / 0.5)))
    assert density[1] == pytest.approx(np.log(np.exp(-0.5 * 0.2**2) / np.sqrt(2 * np.pi) / 0.5))
    assert density[2] == pytest.approx(np.log(special.ndtr((0.4 - log_saturated) / 0.5)))


def answer_of(middle: list[float], half: float, *, grows: bool = True) -> Answer:
    """The answer of a law at 1, 2, 4, 8 mm."""
    values = np.array(middle)
    return Answer(
        sizes_mm=np.array([1.0, 2.0, 4.0, 8.0]),
        middle=values,
        half=np.full(4, half),
        grows=grows,
        error=half / 2,
    )


@pytest.mark.parametrize(
    ("middle", "limit", "verdicts"),
    [
        # (low, a90, high), and verdicts on 0.5, 1.5, 2, 5, 9 mm
        ([-2, -1, 1, 2], (2.0 * 2**0.25, 2.83, 2.0 * 2**0.75), "no no no yes yes"),
        ([-3, -3, -2, -1], (math.inf, math.nan, math.inf), "no no no no undecided"),
        ([1, 2, 3, 4], (math.exp(-1.5), math.nan, 1.0), "undecided yes yes yes yes"),
        ([-2, -1, 0.2, 0.3], (2.67, 3.56, math.inf), "no no no undecided undecided"),
    ],
)
def test_a_limit_and_its_verdicts(
    middle: list[float], limit: tuple[float, float, float], verdicts: str
):
    answer = answer_of(middle, 0.5)
    ends = (answer.low_mm, answer.a90_mm, answer.high_mm)
    assert ends == pytest.approx(limit, rel=0.02, nan_ok=True)
    stated_verdicts = [answer.verdict(size_mm) for size_mm in (0.5, 1.5, 2.0, 5.0, 9.0)]
    assert stated_verdicts == verdicts.split()


def test_what_is_much_smaller_than_inspected_is_not_found():
    """At half of the size that the lower end is, and just above it."""
    answer = answer_of([1, 2, 3, 4], 0.5)
    assert answer.verdict(0.5 * answer.low_mm) == "no"
    assert answer.verdict(1.01 * answer.low_mm) == "undecided"


def test_a_wide_dent_is_harder_again():
    answer = answer_of([-1, 1, 1, -1], 0.4, grows=False)
    assert [answer.verdict(size) for size in (1.0, 3.0, 7.9, 9.0)] == [
        "no",
        "yes",
        "no",
        "undecided",
    ]
    assert answer.lost_mm == 8.0 and answer_of([-1, 1, 1, 1], 0.4, grows=False).lost_mm == 8.0
    assert math.isnan(answer_of([-1, 1, 1, -1], 0.4).lost_mm)


def test_the_error_in_terms_of_size():
    """The law's error over its slope in ln of the size, here 2 in a doubling."""
    answer = answer_of([-3, -1, 1, 3], 0.5)
    assert answer.size_error == pytest.approx(0.25 / (2 / np.log(2)))
    assert math.isnan(answer_of([-3, -3, -3, -3], 0.5).size_error)
