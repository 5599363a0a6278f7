"""Noise from a table, pixel by pixel in plain Python; that for torch on a stand-in of NumPy."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from scenes.sensor.common.tabled import DepthNoise, TorchDepthNoise, filtered

f4 = np.float32
SHAPE = (6, 7)


def table(**changes: Any) -> dict[str, np.ndarray]:
    """Levels of light from 2^-3 in half octaves."""
    x, y = np.meshgrid(np.linspace(-0.5, 0.6, SHAPE[1]), np.linspace(-0.3, 0.4, SHAPE[0]))
    facts = {
        "slopes": np.stack([x, y], axis=-1).astype(f4),
        "falloff": np.linspace(0.5, 1.5, 42).reshape(SHAPE).astype(f4),
        "sigma_m": f4([9e-3, 7e-3, 5e-3, 4e-3, 3e-3, 2e-3]),
        "seen": f4([0.2, 0.5, 0.7, 0.8, 0.9, 0.95]),
        "first": f4(-3.0),
        "per_octave": f4(2.0),
        "rows": f4([0.8, 0.6]),
        "columns": f4([0.6, 0.64, 0.48]),
        "pattern_m": f4(2e-3),
        "pattern_rows": f4([0.6, 0.8]),
        "pattern_columns": f4([1.0]),
        "nearest_m": f4(0.6),
        "farthest_m": f4(4.0),
        "step_m": f4(1e-3),
        **changes,
    }
    return {name: np.asarray(values) for name, values in facts.items()}


def blurred(image: np.ndarray, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
    """Each pixel's weighted sum over those above it and to its left, around the edges."""
    down = sum(tap * np.roll(image, k, axis=0) for k, tap in enumerate(rows))
    return np.asarray(sum(tap * np.roll(down, k, axis=1) for k, tap in enumerate(columns)))


def scene() -> tuple[np.ndarray, np.ndarray]:
    """Distances and intensities of which some are out of reach or dark."""
    rng = np.random.default_rng(5)
    z_m = rng.uniform(0.4, 4.2, SHAPE)
    intensity = 2.0 ** rng.uniform(-5.0, 3.0, SHAPE)
    intensity[0, :3] = [0.0, -1.0, np.nan]
    return z_m, intensity


def expected(
    facts: dict[str, np.ndarray],
    falloff: np.ndarray,
    pattern_m: np.ndarray,
    white: np.ndarray,
    chance: np.ndarray,
    least: float,
) -> np.ndarray:
    """The frame, pixel by pixel. Light from ``least`` of a step below the first level on has the
    nearest level's noise."""
    z_m, intensity = scene()
    noise = blurred(white, facts["rows"], facts["columns"])
    frame = np.full(SHAPE, np.nan)
    for v in range(SHAPE[0]):
        for u in range(SHAPE[1]):
            x, y = facts["slopes"][v, u]
            stretch = math.sqrt(1 + x**2 + y**2)
            range_m = z_m[v, u] * stretch
            light = falloff[v, u] * intensity[v, u] / range_m**2
            if not light > 0 or not facts["nearest_m"] < range_m < facts["farthest_m"]:
                continue
            step = (math.log2(light) - facts["first"]) * facts["per_octave"]
            if step < least:
                continue
            level = min(math.floor(step + 0.5), len(facts["sigma_m"]) - 1)
            if chance[v, u] < facts["seen"][level]:
                noisy_m = range_m + facts["sigma_m"][level] * noise[v, u] + pattern_m[v, u]
                frame[v, u] = round(noisy_m / stretch / facts["step_m"]) * facts["step_m"]
    return frame


def test_filters_are_causal_and_wrap_around() -> None:
    image = np.random.default_rng(1).standard_normal(SHAPE).astype(f4)
    rows = f4([0.5, 0.3, 0.2])
    columns = f4([0.9, -0.4])
    assert filtered(image, rows, columns) == pytest.approx(blurred(image, rows, columns), abs=1e-6)
    assert filtered(image, f4([1.0]), f4([1.0])) == pytest.approx(image)


@pytest.mark.parametrize("as_file", [False, True])
def test_a_frame_is_that_of_its_table(as_file: bool, tmp_path: Path) -> None:
    facts = table()
    stored: Any = facts
    if as_file:
        stored = tmp_path / "noise.npz"
        np.savez(stored, **facts)
    noise = DepthNoise(stored, seed=4)
    standard = np.random.default_rng(4).standard_normal(SHAPE, dtype=f4)
    pattern_m = 2e-3 * blurred(standard, facts["pattern_rows"], facts["pattern_columns"])
    assert noise.pattern_m == pytest.approx(pattern_m, abs=1e-8)
    assert noise.shape == SHAPE
    assert noise.cosine == pytest.approx(1 / noise.stretch)
    finite_count = 0
    for frame in range(20):
        same = np.random.default_rng(frame)
        white = same.standard_normal(SHAPE, dtype=f4)
        chance = same.random(SHAPE, dtype=f4)
        drawn = noise(*scene(), np.random.default_rng(frame))
        wanted = expected(facts, facts["falloff"], pattern_m, white, chance, -0.5)
        assert drawn.dtype == f4
        # a number of steps may differ by one where it is near a half
        off = np.abs(drawn - wanted) / 1e-3
        assert np.array_equal(np.isnan(drawn), np.isnan(wanted))
        assert np.nanmax(off) < 1.01
        assert np.nanmean(off > 0.5) < 0.1
        finite_count += np.isfinite(drawn).sum()
    assert finite_count > 150


def test_other_rays_have_no_falloff_and_numbers_may_be_unrounded() -> None:
    facts = table(step_m=f4(0.0))
    noise = DepthNoise(facts, slopes=facts["slopes"][::-1], seed=4)
    same = np.random.default_rng(8)
    white = same.standard_normal(SHAPE, dtype=f4)
    chance = same.random(SHAPE, dtype=f4)
    drawn = noise(*scene(), np.random.default_rng(8))
    turned = {**facts, "slopes": facts["slopes"][::-1], "step_m": f4(1e-9)}
    wanted = expected(turned, np.ones(SHAPE), noise.pattern_m, white, chance, -0.5)
    assert np.array_equal(np.isnan(drawn), np.isnan(wanted))
    assert drawn == pytest.approx(wanted, abs=2e-6, nan_ok=True)


# ---- for torch


class Tensor(np.ndarray):
    """An array with the methods of a tensor that the noise uses."""

    device = "cpu"

    def sqrt(self) -> Tensor:
        return np.sqrt(self)  # type: ignore[return-value]

    def clamp(self, low: float, high: float) -> Tensor:
        return np.clip(self, low, high)  # type: ignore[return-value]

    def long(self) -> Tensor:
        return self.astype(np.int64)  # type: ignore[return-value]


def tensor(values: Any) -> Tensor:
    return np.asarray(values).view(Tensor)


class Generator:
    def __init__(self, device: str = "cpu") -> None:
        self.rng = np.random.default_rng(0)

    def manual_seed(self, seed: int) -> Generator:
        self.rng = np.random.default_rng(seed)
        return self


TORCH = SimpleNamespace(
    as_tensor=lambda values, device: tensor(values),
    Generator=Generator,
    randn=lambda shape, generator, device: tensor(generator.rng.standard_normal(shape, dtype=f4)),
    rand=lambda shape, generator, device: tensor(generator.rng.random(shape, dtype=f4)),
    log2=np.log2,
    nan_to_num=lambda values, nan, posinf, neginf: np.nan_to_num(
        values, nan=nan, posinf=posinf, neginf=neginf
    ),
    where=np.where,
    zeros_like=np.zeros_like,
    full_like=np.full_like,
    round=np.round,
    roll=np.roll,
)


@pytest.mark.filterwarnings("ignore:invalid value", "ignore:divide by zero")
def test_a_batch_for_torch_has_frames_of_the_same_table(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "torch", TORCH)  # type: ignore[arg-type]
    facts = table()
    noise = TorchDepthNoise(facts, seed=4)
    standard = np.random.default_rng(4).standard_normal(SHAPE, dtype=f4)
    pattern_m = 2e-3 * blurred(standard, facts["pattern_rows"], facts["pattern_columns"])
    assert np.asarray(noise.pattern_m) == pytest.approx(pattern_m, abs=1e-8)
    z_m, intensity = scene()
    for seed in range(8):
        same = np.random.default_rng(seed)
        white = same.standard_normal((2, *SHAPE), dtype=f4)
        chance = same.random((2, *SHAPE), dtype=f4)
        batch = (tensor(np.stack([z_m, z_m])), tensor(np.stack([intensity, intensity])))
        frames = np.asarray(noise(*batch, Generator().manual_seed(seed)))
        for frame in range(2):
            wanted = expected(facts, facts["falloff"], pattern_m, white[frame], chance[frame], 0.0)
            assert np.array_equal(np.isnan(frames[frame]), np.isnan(wanted))
            off = np.abs(frames[frame] - wanted) / 1e-3
            assert np.nanmax(off) < 1.01
            assert np.nanmean(off > 0.5) < 0.1
    unrounded = TorchDepthNoise(table(step_m=f4(0.0)), seed=4)
    frame = np.asarray(unrounded(tensor(z_m), tensor(intensity), Generator().manual_seed(1)))
    steps = frame[np.isfinite(frame)] / 1e-3
    assert np.abs(steps - np.round(steps)).max() > 0.2
