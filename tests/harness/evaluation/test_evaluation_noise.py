"""The parts of the error recovered from tables that were made of known parts."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from harness.evaluation.intervals import bootstrap
from harness.evaluation.summary import fit_floor, noise_against_frames, noise_law
from tests.support.synthetic_tables import FRAMES, World, tables


def test_parts_are_recovered() -> None:
    """800 pixels, 50 repeats: each part within 5 of its standard errors (alpha below 1e-5)."""
    noise = noise_against_frames(tables().probes)
    frames = np.array(FRAMES)
    assert list(noise["frames"]) == list(FRAMES)
    temporal = 0.9 / np.sqrt(frames)
    np.testing.assert_allclose(noise["temporal_rms_mm"], temporal, rtol=5 / np.sqrt(2 * 800 * 49))
    np.testing.assert_allclose(
        noise["guide_mm"], noise["temporal_rms_mm"].iloc[0] / np.sqrt(frames)
    )
    assert (np.abs(noise["offset_mm"] - 0.2) < 5 * temporal / np.sqrt(50 * 800)).all()
    remaining_noise = temporal**2 / 50
    spread = np.sqrt((4 * 0.09 * remaining_noise + 2 * remaining_noise**2) / 800)
    assert (np.abs(noise["pattern_mm"] ** 2 - 0.09) < 5 * spread).all()
    np.testing.assert_allclose(
        noise["total_rms_mm"] ** 2, noise["temporal_rms_mm"] ** 2 + noise["systematic_mm"] ** 2
    )


def test_pattern_of_pure_noise_is_corrected_away() -> None:
    world = World(pattern_mm=lambda frames: 0.0, temporal_mm=lambda frames: 2.0)
    noise = noise_against_frames(tables(world, frames=(1,)).probes)
    uncorrected = 2.0 / np.sqrt(50)
    assert noise["pattern_mm"].iloc[0] < 0.5 * uncorrected


def test_three_pixels_by_hand() -> None:
    probes = pd.DataFrame(
        {
            "variant": "main",
            "frames": 4,
            "pixel": [0, 1, 2, 3],
            "mean_error_mm": [1.0, 2.0, 3.0, np.nan],
            "temporal_std_mm": [0.5, 0.5, 0.5, 0.5],
            "displacement_std_mm": [0.1, 0.1, 0.1, 0.1],
            "repeats": 5,
        }
    )
    row = noise_against_frames(probes).iloc[0]
    assert row["pixels"] == 3
    assert row["offset_mm"] == 2.0
    assert row["temporal_rms_mm"] == 0.5
    assert row["pattern_mm"] == pytest.approx(np.sqrt(1 - 0.25 / 5))
    assert row["systematic_mm"] == pytest.approx(np.sqrt(4 + 0.95))


def test_floor_fit_is_exact_on_its_own_law_and_never_negative() -> None:
    frames = np.array(FRAMES)
    assert fit_floor(frames, np.sqrt(0.81 / frames + 0.04)) == pytest.approx(0.2)
    assert fit_floor(frames, 1.0 / frames) == 0.0
    assert np.isnan(fit_floor([1, 1], [0.5, 0.5]))


def test_law_of_white_noise_and_of_drift() -> None:
    law = noise_law(tables().probes, "main")
    assert law is not None
    assert law.slope_interval.low < -0.5 < law.slope_interval.high
    assert law.slope == pytest.approx(-0.5, abs=0.005)
    assert law.systematic_ratio == pytest.approx(1, abs=0.05)
    drift = noise_law(tables(World(temporal_mm=lambda frames: 0.9 * frames**-0.3)).probes, "main")
    assert drift is not None
    assert drift.slope == pytest.approx(-0.3, abs=0.005)


def test_law_uses_only_pixels_seen_at_every_count_and_needs_two_counts() -> None:
    probes = tables(frames=(1, 50)).probes
    probes.loc[(probes["frames"] == 50) & (probes["pixel"] < 100), "mean_error_mm"] = np.nan
    law = noise_law(probes.sample(frac=1, random_state=0), "main")
    assert law is not None
    assert law.pixels == 700
    assert law.few_frames == 1
    assert law.many_frames == 50
    assert noise_law(probes[probes["frames"] == 1], "main") is None
    assert noise_law(probes, "elsewhere") is None


def test_a_law_by_hand() -> None:
    """Four pixels, each a block of its own: temporal noise falls from 2 to 1 over 16 frames."""
    shortest = pd.DataFrame(
        {
            "variant": "main",
            "frames": 1,
            "pixel": [0, 1, 2, 3],
            "mean_error_mm": [1.0, 2.0, 3.0, 6.0],
            "temporal_std_mm": [2.0, 2.0, 2.0, 2.0],
            "displacement_std_mm": 0.1,
            "repeats": 8,
        }
    )
    longest = shortest.assign(frames=16, mean_error_mm=[1.5, 2.0, 2.5, 4.0], temporal_std_mm=1.0)
    probes = pd.concat([longest, shortest])
    law = noise_law(probes, "main")
    assert law is not None
    assert law.slope == pytest.approx(-0.25)
    assert (law.slope_interval.low, law.slope_interval.high) == pytest.approx((-0.25, -0.25))
    # offset 3 and variance 14 / 3 - 4 / 8; offset 2.5 and variance 14 / 12 - 1 / 8
    first = 9 + 14 / 3 - 0.5
    last = 6.25 + 14 / 12 - 0.125
    assert law.systematic_ratio == pytest.approx(np.sqrt(last / first))
    assert law.few_frames == 1
    assert law.many_frames == 16
    assert law.pixels == 4

    def ratio(indices: np.ndarray) -> np.ndarray:
        squares = []
        for errors, remaining_noise in (
            (np.array([1.5, 2, 2.5, 4]), 0.125),
            (np.array([1.0, 2, 3, 6]), 0.5),
        ):
            drawn = errors[indices]
            offset = drawn.mean(axis=1)
            pattern = ((drawn**2).mean(axis=1) - offset**2) * 4 / 3 - remaining_noise
            squares.append(offset**2 + np.maximum(pattern, 0.0))
        return np.sqrt(squares[0] / squares[1])

    expected = bootstrap(ratio, 4)
    interval = law.systematic_ratio_interval
    assert (interval.low, interval.high) == pytest.approx((expected.low, expected.high))
    rows = noise_against_frames(probes)
    assert rows["frames"].tolist() == [1, 16]
    assert rows["guide_mm"].tolist() == [2.0, 0.5]
    assert rows["displacement_mm"].tolist() == [0.1, 0.1]
    assert rows["repeats"].tolist() == [8, 8]
    assert rows["total_rms_mm"][0] == pytest.approx(np.sqrt(4 + first))


def test_pixels_are_resampled_in_contiguous_blocks() -> None:
    """Noise that differs between halves of 80 pixels: 40 blocks of two neighbours each."""
    rng = np.random.default_rng(2)
    frames = []
    for count in (1, 4):
        std = np.repeat(rng.uniform(1.0, 3.0, 40), 2) / count
        frames.append(
            pd.DataFrame(
                {
                    "variant": "main",
                    "frames": count,
                    "pixel": np.arange(80),
                    "mean_error_mm": 0.0,
                    "temporal_std_mm": std,
                    "displacement_std_mm": 0.1,
                    "repeats": 8,
                }
            )
        )
    law = noise_law(pd.concat(frames), "main")
    first = frames[0]["temporal_std_mm"].to_numpy()[::2] ** 2
    last = frames[1]["temporal_std_mm"].to_numpy()[::2] ** 2

    def slope(indices: np.ndarray) -> np.ndarray:
        return 0.5 * np.log(last[indices].mean(axis=1) / first[indices].mean(axis=1)) / np.log(4)

    expected = bootstrap(slope, 40)
    assert law is not None
    interval = law.slope_interval
    assert (interval.low, interval.high) == pytest.approx((expected.low, expected.high))
    assert np.isnan(law.systematic_ratio)


def test_a_floor_is_weighted_for_equal_relative_error() -> None:
    """By hand: total^2 = white^2 / N + floor^2 over three numbers of frames, each divided by its
    square."""
    frames = np.array([1.0, 4.0, 100.0])
    total = np.array([2.0, 1.2, 0.5])
    design = np.column_stack([1 / frames, np.ones(3)]) / total[:, None] ** 2
    squares = np.linalg.lstsq(design, np.ones(3), rcond=None)[0]
    assert (squares > 0).all()
    assert fit_floor(frames, total) == pytest.approx(np.sqrt(squares[1]))
    unknown = fit_floor([1, 4, 100, 7], [2.0, 1.2, 0.5, np.nan])
    assert unknown == pytest.approx(np.sqrt(squares[1]))
    assert fit_floor([1, 4, 100, 7], [2.0, 1.2, 0.5, 0.0]) == pytest.approx(np.sqrt(squares[1]))


def test_pixels_without_noise_or_without_a_mean_are_out() -> None:
    probes = tables(frames=(1,)).probes
    probes.loc[probes["pixel"] < 50, "temporal_std_mm"] = np.nan
    probes.loc[probes["pixel"] >= 790, "mean_error_mm"] = np.nan
    assert noise_against_frames(probes)["pixels"].tolist() == [740]
