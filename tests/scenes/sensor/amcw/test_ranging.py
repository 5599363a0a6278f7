"""The engine after its filter: each gate at its limit, the geometry, the finished image."""

from __future__ import annotations

import numpy as np
import pytest

from scenes.sensor.amcw import ranging
from scenes.sensor.amcw.facts import unwrap_table

f4 = np.float32
GATES = ranging.Gates(
    edge=f4(2.0),
    edge_mean=f4(0),
    residual=f4(0.05),
    residual_most=f4(np.inf),
    residual_scale=f4(0),
    residual_slope=f4(0),
    ratio=f4(0.5),
    least=f4(10.0),
    total=f4(25.0),
    reflectivity=f4(4.0),
    nearest_m=f4(0.5),
    farthest_m=f4(4.0),
    axial=f4(0),
)
GOOD = {
    "edge": 1.0,
    "least": 20.0,
    "greatest": 30.0,
    "total": 50.0,
    "residual2": 0.0,
    "brightest": 30.0,
    "range_m": 1.0,
    "low_m": 1.0,
    "high_m": 1.0,
}


def code_of(gates: ranging.Gates = GATES, **values: float) -> int:
    """The code of a good pixel with other values."""
    inputs = {key: np.array([value], f4) for key, value in (GOOD | values).items()}
    return int(ranging.first_failed_each(gates, ranging.GateInputs(**inputs))[0])


@pytest.mark.parametrize(
    ("values", "code"),
    [
        ({}, ranging.VALID),
        ({"edge": 1.999}, ranging.VALID),
        ({"edge": 2.0}, ranging.EDGE),
        ({"least": 10.0, "greatest": 20.0}, ranging.VALID),
        ({"least": 9.99, "greatest": 19.0}, ranging.LOW_AMPLITUDE),
        ({"total": 25.0}, ranging.VALID),
        ({"total": 24.99}, ranging.LOW_AMPLITUDE),
        ({"least": 15.0, "greatest": 30.0}, ranging.VALID),
        ({"least": 14.9, "greatest": 30.0}, ranging.AMPLITUDE_RATIO),
        ({"residual2": 0.0499**2}, ranging.VALID),
        ({"residual2": 0.0501**2}, ranging.UNWRAP),
        ({"residual2": np.inf}, ranging.UNWRAP),
        ({"low_m": 0.5}, ranging.VALID),
        ({"low_m": 0.499}, ranging.OUT_OF_RANGE),
        ({"high_m": 4.0}, ranging.VALID),
        ({"high_m": 4.01}, ranging.OUT_OF_RANGE),
        ({"range_m": 0.3}, ranging.VALID),  # 50 x 0.09 = 4.5
        ({"range_m": 0.28}, ranging.LOW_REFLECTIVITY),  # 50 x 0.0784 = 3.92
        # the first gate that fails gives the reason
        ({"total": 1.0, "edge": 3.0}, ranging.LOW_AMPLITUDE),
        ({"edge": 3.0, "least": 11.0}, ranging.EDGE),
        ({"least": 11.0, "residual2": 1.0}, ranging.AMPLITUDE_RATIO),
        ({"residual2": 1.0, "low_m": 0.1}, ranging.UNWRAP),
        ({"low_m": 0.1, "range_m": 0.1}, ranging.OUT_OF_RANGE),
    ],
)
def test_each_gate_at_its_limit(values, code):
    assert code_of(**values) == code


def test_no_gate_passes_a_pixel_without_wrap_counts():
    assert code_of(GATES._replace(residual=f4(np.inf)), residual2=np.inf) == ranging.UNWRAP


@pytest.mark.parametrize(
    ("brightest", "limit"),
    [
        (1.0, 0.2),
        (16.0, 0.1),
        (4.0, 0.16),
        (10_000.0, 0.08),
    ],
)
def test_the_residual_of_dim_pixels_by_hand(brightest, limit):
    """0.32 A^-1/2, between 0.08 and 0.2 turns; at 16 units it is 0.08."""
    gates = GATES._replace(
        residual=f4(0.08),
        residual_most=f4(0.2),
        residual_scale=f4(0.32 if brightest != 16.0 else 0.4),
        residual_slope=f4(-0.5),
    )
    found_turns = ranging.residual_limit(gates, f4(brightest))
    assert found_turns == pytest.approx(limit, rel=1e-5)


def engine_of(emitter_m: np.ndarray, slope_x: float, **gates: float) -> ranging.DepthEngine:
    """An engine of one frequency, one pixel and gates that pass everything."""
    ray = np.array([slope_x, 0.0, 1.0])
    ray = ray / np.linalg.norm(ray)
    open_gates = GATES._replace(
        edge=f4(np.inf),
        residual=f4(np.inf),
        ratio=f4(np.inf),
        least=f4(0),
        total=f4(0),
        reflectivity=f4(0),
        **{key: f4(value) for key, value in gates.items()},
    )
    geometry = np.array([[ray @ emitter_m], [emitter_m @ emitter_m], [ray[2]]], f4)
    return ranging.DepthEngine(
        geometry=geometry,
        outside_mask=np.zeros(1, bool),
        lattice=unwrap_table((10e6,), "least_squares"),
        gates=open_gates,
        flying=None,
    )


def decoded(engine: ranging.DepthEngine, half_m: float, error_m: float = 0.0, saturated: int = 0):
    """z, code and amplitude of a pixel with light of that half path."""
    angle = 2 * np.pi * half_m / engine.lattice.unambiguous_m
    phasor = [np.cos(angle), np.sin(angle), 70.0]
    filtered = np.array(phasor, f4).reshape(1, 3, 1)
    z_m, code, total = ranging.ranges_of(
        filtered,
        np.zeros((1, 1), f4),
        np.array([saturated], np.uint8),
        engine,
        error_m,
    )
    return float(z_m[0]), int(code[0]), float(total[0])


@pytest.mark.parametrize("slope_x", [-0.6, 0.0, 0.75])
def test_range_of_half_a_path_by_the_emitter_beside_the_lens(slope_x):
    emitter_m = np.array([0.05, 0.0, 0.01])
    engine = engine_of(emitter_m, slope_x)
    point_m = 1.3 * np.array([slope_x, 0.0, 1.0])
    half_m = (np.linalg.norm(point_m) + np.linalg.norm(point_m - emitter_m)) / 2
    z_m, code, total = decoded(engine, half_m)
    assert z_m == pytest.approx(1.3, abs=2e-6)
    assert (code, total) == (ranging.VALID, 70.0)
    # a frame's displacement is one of half the path
    assert decoded(engine, half_m - 0.01, 0.01)[0] == pytest.approx(1.3, abs=2e-6)


def test_limits_along_the_ray_or_the_axis():
    """A range of 1.25 is a z of 1."""
    along_ray = engine_of(np.zeros(3), 0.75, farthest_m=1.2)
    along_axis = engine_of(np.zeros(3), 0.75, farthest_m=1.2, axial=1.0)
    assert decoded(along_ray, 1.25)[1] == ranging.OUT_OF_RANGE
    assert decoded(along_axis, 1.25)[1] == ranging.VALID


def test_saturated_and_masked_pixels_have_their_own_reasons():
    engine = engine_of(np.zeros(3), 0.0)
    assert decoded(engine, 1.0, saturated=1)[1] == ranging.SATURATED
    masked = engine._replace(outside_mask=np.ones(1, bool))
    assert decoded(masked, 1.0, saturated=1)[1] == ranging.OUTSIDE_MASK


@pytest.mark.parametrize(
    ("edge_mean", "code"),
    [
        (0, ranging.EDGE),
        (1, ranging.VALID),
    ],
)
def test_the_edge_sum_is_that_of_any_frequency_or_of_their_mean(edge_mean, code):
    engine = engine_of(np.zeros(3), 0.0)
    gates = engine.gates._replace(edge=f4(2.0), edge_mean=f4(edge_mean))
    table = unwrap_table((20e6, 10e6), "least_squares")
    engine = engine._replace(gates=gates, lattice=table)
    angles = 2 * np.pi * 1.0 / table.unambiguous_m * table.lattice
    planes = [np.cos(angles), np.sin(angles), [70.0, 50.0]]
    filtered = np.stack(planes, axis=1)[..., None]
    edge = np.array([[2.5], [1.0]], f4)
    z_m, codes, total = ranging.ranges_of(
        filtered.astype(f4),
        edge,
        np.zeros(1, np.uint8),
        engine,
        0.0,
    )
    assert codes[0] == code
    assert z_m[0] == pytest.approx(1.0, abs=2e-6)
    assert total[0] == 120.0


@pytest.mark.parametrize("turn", [0.0, 0.1, 0.125, 0.3, 0.499, 0.5, 0.7, 0.875, 0.999])
def test_turns_of_a_direction(turn):
    angle = 2 * np.pi * turn
    found_turns = float(ranging.turns(f4(np.cos(angle)), f4(np.sin(angle))))
    off = (found_turns - turn + 0.5) % 1 - 0.5
    assert abs(off) < 3e-7
    assert 0 <= found_turns < 1


GATE = ranging.FlyingGate(
    f4(0.1),
    f4(10.0),
    f4(0.05),
    f4(0.03),
    f4(0.1),
)


@pytest.mark.parametrize(
    ("nearer_m", "farther_m", "spread", "flies"),
    [
        (0.06, 0.12, 20.0, True),
        (0.12, 0.04, 20.0, True),
        (0.04, 0.12, 20.0, False),  # not 50 mm before the pixel
        (0.12, 0.02, 20.0, False),  # not 30 mm behind it
        (0.06, 0.09, 20.0, False),  # neither more than 100 mm
        (0.06, 0.12, 9.0, False),  # amplitudes of 100 + 9 and 100 - 9: 9 of 100 times sqrt(8/9)
        (0.06, 0.12, 11.0, True),
    ],
)
def test_a_flying_pixel_by_hand(nearer_m, farther_m, spread, flies):
    z_m = np.full(9, 1.0, f4)
    z_m[0] = 1.0 - nearer_m
    z_m[8] = 1.0 + farther_m
    total = np.full(9, 100.0, f4)
    total[:4] = 100.0 + spread
    total[5:] = 100.0 - spread
    neighbours = np.full((9, 9), -1, np.int32)
    neighbours[4] = np.arange(9)
    reason = np.full(9, ranging.VALID, np.uint8)

    def middle_flies() -> bool:
        flying = ranging.find_flying(z_m, total, reason, neighbours, GATE)
        assert not np.delete(flying, 4).any()
        return bool(flying[4])

    assert middle_flies() == flies
    # the amplitudes of invalid neighbours count, their distances do not
    reason[0] = ranging.UNWRAP
    assert not middle_flies()
    reason[0] = ranging.OUT_OF_RANGE
    assert middle_flies() == flies
    reason[4] = ranging.EDGE
    assert not middle_flies()


def test_amplitudes_of_dim_windows_are_compared_with_the_least_mean():
    """Deviations of 0.9 of a mean of 1, where a tenth of 10 is asked for."""
    z_m = np.array([0.9, 1.0, 1.2], f4)
    total = np.array([2.1, 1.0, 0.1], f4)
    neighbours = np.full((3, 9), -1, np.int32)
    neighbours[1, :3] = [0, 1, 2]
    reason = np.full(3, ranging.VALID, np.uint8)
    assert not ranging.find_flying(z_m, total, reason, neighbours, GATE).any()
    bold = GATE._replace(least_mean=f4(1.0))
    flying = ranging.find_flying(z_m, total, reason, neighbours, bold)
    assert flying.tolist() == [False, True, False]


def test_rounding_of_valid_pixels():
    z_m = np.array([1.2344, 1.2346, 1.0], f4)
    reason = np.array([ranging.VALID, ranging.VALID, ranging.EDGE], np.uint8)
    ranging.round_valid(z_m, reason, f4(1e-3))
    assert z_m[:2] == pytest.approx([1.234, 1.235], abs=1e-6)
    assert np.isnan(z_m[2])
