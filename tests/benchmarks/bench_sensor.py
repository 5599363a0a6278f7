"""Speed of the simulated imagers: ``pytest tests/benchmarks/bench_sensor.py --benchmark-only`` with one thread each.

Nothing here asserts a time. The filter stands in one group in three languages, so that the table shows their ratios:
the compiled kernel that the camera uses, the same in Dr.Jit (traced at each call, and frozen), and in NumPy.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import count
from typing import Any

import numpy as np
import pytest

from detectors.average import AverageConfig, FrameSums
from harness.engine.trial import averages_of
from harness.vocabulary.geometry import Region
from harness.vocabulary.seeds import random_stream
from scenes.closed_form import Plane, layered_view, plane_view
from scenes.sensor.amcw import kernels
from scenes.sensor.amcw.at_once import at_once
from scenes.sensor.amcw.facts import AmcwCamera
from scenes.sensor.amcw.imager import AmcwExposure, AmcwImager
from scenes.sensor.camera import CameraConfig, load_camera
from scenes.sensor.normals import standard_normals
from scenes.sensor.source import SimulatedUnit

f4 = np.float32
CAMERA = load_camera("azure_kinect_nfov")
assert isinstance(CAMERA, AmcwCamera)
BOARD = Region(258, 408, 222, 422)
"""30,000 pixels, about the board's part of a picture."""
V2_BOARD = Region(137, 287, 156, 356)
HALF = CAMERA.engine.window_px.value // 2
CONCENTRATION = f4(CAMERA.engine.concentration.value)
DIM = f4(CAMERA.engine.dim_amplitude_units.value)


@dataclass(frozen=True)
class Stages:
    """One frame's arrays at every stage."""

    imager: AmcwImager
    exposure: AmcwExposure
    unit: np.ndarray
    amplitude: np.ndarray
    saturated: np.ndarray
    filtered: np.ndarray
    edge: np.ndarray

    def filter_one(self) -> None:
        """The filter of the first frequency."""
        planes, amplitude = filter_inputs(self)
        kernels.filter_image(planes, amplitude, self.imager.filter_settings, self.filtered[0], self.edge[0])


def unit_on(region: Region, camera: AmcwCamera = CAMERA) -> SimulatedUnit:
    """A unit before a board of 0.75 m, with the margin that the filter needs."""
    lens = camera.nominal_lens
    outer = region.grown(camera.margin_px, lens.height, lens.width)
    return SimulatedUnit(camera, CameraConfig(name=camera.name), plane_view(camera, outer, 0.75, 0.6, 0.1, 0.05))


@pytest.fixture(scope="module")
def stages() -> Stages:
    view = plane_view(CAMERA, BOARD, 0.75, 0.6, 0.1, 0.05)
    imager = AmcwImager(CAMERA, CameraConfig(), BOARD, view.slopes)
    exposure = imager.expose(view)
    unit, amplitude, saturated = imager.phasors(exposure, random_stream(1))
    return Stages(imager, exposure, unit, amplitude, saturated, *imager.filter(unit, amplitude, exposure.shape))


# ---------------------------------------------------------------- whole frames


@pytest.mark.benchmark(group="whole frame")
@pytest.mark.parametrize(
    ("name", "region"),
    [("azure_kinect_nfov", BOARD), ("azure_kinect_nfov", None), ("kinect_v2", V2_BOARD), ("kinect_v2", None)],
    ids=["Azure 30,000 pixels", "Azure 640 x 576", "v2 30,000 pixels", "v2 512 x 424"],
)
def test_a_simulated_frame(benchmark: Any, name: str, region: Region | None) -> None:
    camera = load_camera(name)
    assert isinstance(camera, AmcwCamera)
    unit, rng = unit_on(region or camera.nominal_lens.whole, camera), random_stream(1)
    unit.model.frame(unit.exposure, rng)
    decoded = benchmark(unit.model.frame, unit.exposure, rng)
    assert np.isfinite(decoded.z_m).mean() > 0.3


@pytest.mark.benchmark(group="whole frame")
def test_a_simulated_frame_of_30_000_pixels_added_to_an_average(benchmark: Any) -> None:
    unit, rng = unit_on(BOARD), random_stream(1)
    capture = unit.capture(2, 1)
    frame = next(capture.frames())
    running = FrameSums(capture, [frame], AverageConfig())

    def step() -> None:
        unit.model.frame(unit.exposure, rng)
        running.take(frame)

    benchmark.pedantic(step, rounds=300, iterations=1, warmup_rounds=5)


@pytest.mark.benchmark(group="whole frame")
def test_add_30_000_pixels_to_an_average(benchmark: Any) -> None:
    capture = unit_on(BOARD).capture(2, 1)
    frame = next(capture.frames())
    running = FrameSums(capture, [frame], AverageConfig())
    benchmark.pedantic(running.take, args=(frame,), rounds=300, iterations=1, warmup_rounds=5)


# ---------------------------------------------------------------- averages drawn at once


def unit_before_far_hole() -> SimulatedUnit:
    """A unit before a board with a hole of 1 in and its own rim, 200 mm before a wall: rims to simulate one by one."""
    lens = CAMERA.nominal_lens
    outer = BOARD.grown(CAMERA.margin_px, lens.height, lens.width)
    middle = lens.region_slopes(BOARD).reshape(-1, 2).mean(axis=0)

    def covers(at: np.ndarray) -> np.ndarray:
        x, y = at[..., 0] - middle[0], at[..., 1] - middle[1]
        return (np.hypot(x, y) > 0.017) & (np.abs(x) < 0.19) & (np.abs(y) < 0.14)

    return SimulatedUnit(
        CAMERA, CameraConfig(), layered_view(CAMERA, outer, Plane(0.75, 0.1, 0.05), Plane(0.95, 0.1, 0.05), covers, 0.6)
    )


@pytest.mark.benchmark(group="averages of 50 frames, 30,000 pixels")
@pytest.mark.parametrize(
    "make", [lambda: unit_on(BOARD), unit_before_far_hole], ids=["bare board", "rims before a wall"]
)
def test_an_average_of_50_frames_drawn_at_once(benchmark: Any, make: Any) -> None:
    unit = make()
    captures = (unit.capture(50, seed) for seed in count())
    assert unit.at_once is not None
    benchmark.pedantic(
        lambda: averages_of(next(captures), [50], AverageConfig(), exact=False), rounds=30, warmup_rounds=2
    )


@pytest.mark.benchmark(group="averages of 50 frames, 30,000 pixels")
def test_an_average_of_50_frames_frame_by_frame(benchmark: Any) -> None:
    capture = unit_on(BOARD).capture(50, 1)
    benchmark.pedantic(lambda: averages_of(capture, [50], AverageConfig(), exact=True), rounds=3, warmup_rounds=1)


@pytest.mark.benchmark(group="averages of 50 frames, 30,000 pixels")
@pytest.mark.parametrize(
    "make", [lambda: unit_on(BOARD), unit_before_far_hole], ids=["bare board", "rims before a wall"]
)
def test_sort_the_pixels_of_a_view_once(benchmark: Any, make: Any) -> None:
    unit = make()
    asked = np.zeros(unit.exposure.shape, bool)
    asked[unit.cut] = True
    benchmark.pedantic(at_once, args=(unit.model, unit.exposure, asked), rounds=10, warmup_rounds=1)


# ---------------------------------------------------------------- each part, 30,000 pixels


@pytest.mark.benchmark(group="parts, 30,000 pixels")
def test_normals(benchmark: Any, stages: Stages) -> None:
    rng = random_stream(1)
    assert benchmark(standard_normals, rng, stages.exposure.means.shape).std() == pytest.approx(1, abs=0.02)


@pytest.mark.benchmark(group="parts, 30,000 pixels")
def test_normals_and_samples(benchmark: Any, stages: Stages) -> None:
    benchmark(stages.imager.phasors, stages.exposure, random_stream(1))


@pytest.mark.benchmark(group="parts, 30,000 pixels")
def test_filter_three_frequencies(benchmark: Any, stages: Stages) -> None:
    benchmark(stages.imager.filter, stages.unit, stages.amplitude, stages.exposure.shape)


@pytest.mark.benchmark(group="parts, 30,000 pixels")
def test_range_and_gates(benchmark: Any, stages: Stages) -> None:
    decoded = benchmark(stages.imager._decode, stages.filtered, stages.edge, stages.saturated, 0.0)
    assert np.isfinite(decoded.z_m).all()


# ---------------------------------------------------------------- the filter in three languages


def numpy_filter(unit: np.ndarray, amplitude: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """`kernels.filter_image` in NumPy: (filtered (3, h, w), edge (h, w)), the same formulas on shifted planes."""
    h, w = amplitude.shape
    pad = ((HALF, HALF), (HALF, HALF))
    re, im, amp, inside = (np.pad(plane, pad) for plane in (*unit, amplitude, np.ones_like(amplitude)))
    total = np.zeros((5, h, w), f4)
    bright = amplitude > DIM
    for dy in range(2 * HALF + 1):
        for dx in range(2 * HALF + 1):
            near = (slice(dy, dy + h), slice(dx, dx + w))
            cosine = unit[0] * re[near] + unit[1] * im[near]
            weight = np.where(bright, np.exp(CONCENTRATION * (cosine - f4(1))), f4(1)) * inside[near]
            total[0] += weight * re[near]
            total[1] += weight * im[near]
            total[2] += weight * amp[near]
            total[3] += weight
            total[4] += inside[near] * (f4(1) - cosine)
    return np.stack([total[0], total[1], total[2] / total[3]]), f4(0.5) * total[4]


class DrjitFilter:
    """`kernels.filter_image` in Dr.Jit: one kernel, 25 neighbours gathered from planes that stay on the device."""

    def __init__(self, unit: np.ndarray, amplitude: np.ndarray, frozen: bool) -> None:
        from scenes.render.scene import load_mitsuba

        self.mi = load_mitsuba()
        import drjit as dr

        self.dr = dr
        dr.set_thread_count(1)
        self.h, self.w = amplitude.shape
        self.row = self.w + 2 * HALF
        pad = ((HALF, HALF), (HALF, HALF))
        planes = (*unit, amplitude, np.ones_like(amplitude))
        self.planes = [self.mi.Float(np.pad(plane, pad).ravel()) for plane in planes]
        index = np.arange(self.h)[:, None] * self.row + np.arange(self.w)
        self.corner = self.mi.UInt32(index.ravel().astype(np.uint32))
        dr.eval(self.planes, self.corner)
        self._compute = dr.freeze(self._trace) if frozen else self._trace

    def _trace(self, planes: Any, corner: Any) -> Any:
        dr, mi = self.dr, self.mi
        re0, im0, amp0 = (dr.gather(mi.Float, p, corner + HALF * self.row + HALF) for p in planes[:3])
        bright = amp0 > float(DIM)
        total = [mi.Float(0.0) for _ in range(5)]
        for dy in range(2 * HALF + 1):
            for dx in range(2 * HALF + 1):
                re, im, amp, inside = (dr.gather(mi.Float, p, corner + dy * self.row + dx) for p in planes)
                cosine = re0 * re + im0 * im
                weight = dr.select(bright, dr.exp(float(CONCENTRATION) * (cosine - 1.0)), 1.0) * inside
                terms = (weight * re, weight * im, weight * amp, weight, inside * (1.0 - cosine))
                total = [a + b for a, b in zip(total, terms, strict=True)]
        return total[0], total[1], total[2] / total[3], 0.5 * total[4]

    def __call__(self) -> Any:
        """Run it to the end: (re, im, mean amplitude, edge) on the device."""
        out = self._compute(self.planes, self.corner)
        self.dr.eval(out)
        self.dr.sync_thread()
        return out

    def arrays(self) -> tuple[np.ndarray, np.ndarray]:
        """(filtered (3, h, w), edge (h, w))."""
        *filtered, edge = (np.array(plane).reshape(self.h, self.w) for plane in self())
        return np.stack(filtered), edge


def filter_inputs(stages: Stages) -> tuple[np.ndarray, np.ndarray]:
    shape = stages.exposure.shape
    return np.ascontiguousarray(stages.unit[:, 0]).reshape(2, *shape), stages.amplitude[0].reshape(shape)


def assert_same(stages: Stages, filtered: np.ndarray, edge: np.ndarray) -> None:
    """To 1e-4 of the size of the phasor's sum (25), the amplitude and the edge gate's threshold (4)."""
    ours = stages.filtered[0]
    assert np.abs(filtered[:2] - ours[:2]).max() < 25 * 1e-4
    assert filtered[2] == pytest.approx(ours[2], rel=1e-4)
    assert np.abs(edge - stages.edge[0]).max() < 4 * 1e-4


@pytest.mark.benchmark(group="filter of one frequency, 30,000 pixels")
def test_filter_numba(benchmark: Any, stages: Stages) -> None:
    benchmark(stages.filter_one)


@pytest.mark.benchmark(group="filter of one frequency, 30,000 pixels")
def test_filter_numpy(benchmark: Any, stages: Stages) -> None:
    inputs = filter_inputs(stages)
    assert_same(stages, *numpy_filter(*inputs))
    benchmark(numpy_filter, *inputs)


@pytest.mark.benchmark(group="filter of one frequency, 30,000 pixels")
@pytest.mark.parametrize("frozen", [False, True], ids=["traced", "frozen"])
def test_filter_drjit(benchmark: Any, stages: Stages, frozen: bool) -> None:
    ours = DrjitFilter(*filter_inputs(stages), frozen)
    assert_same(stages, *ours.arrays())
    benchmark(ours)
