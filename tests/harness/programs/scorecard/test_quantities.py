"""Each quantity of the scorecard on frames whose values are planted."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from harness.programs.scorecard import quantities
from harness.programs.scorecard.bench import Bench, Effort, FrameStack
from harness.programs.scorecard.quantities import (
    QUANTITIES,
    PatchConditions,
    PlaneConditions,
    StepConditions,
    _left_of_patches,
    in_words,
    plane_stack,
    scene_of,
)
from harness.stills.statistics import NOTHING
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM, Region

EFFORT = Effort(noise_frames=80, few_frames=3, whole_frames=40, units=3)
OPTICS = SimpleNamespace(margin_px=1, nearest_m=0.2, farthest_m=5.0)
BENCH: Any = SimpleNamespace(effort=EFFORT, camera=SimpleNamespace(optics=OPTICS))


def stack_of(z_m: np.ndarray, true_z_m: np.ndarray | float = 1.0) -> FrameStack:
    rows, columns = z_m.shape[1:]
    grid = np.meshgrid(np.linspace(-0.2, 0.2, columns), np.linspace(-0.2, 0.2, rows))
    slopes = np.stack(grid, axis=-1)
    true = np.broadcast_to(true_z_m, (rows, columns))
    return FrameStack(z_m, true, slopes, Region(0, rows, 0, columns))


@pytest.fixture
def units(monkeypatch: pytest.MonkeyPatch) -> list[tuple[int, int | None]]:
    """Frames of unit u have a bias of u mm (-3 mm of unit 3), a pattern of u mm and noise of 2 mm;
    which units and how many frames were taken."""
    taken: list[tuple[int, int | None]] = []

    def frames_of(
        bench: Any,
        c: PlaneConditions,
        effects: Any = None,
        frames: int | None = None,
        unit: int = 1,
        patch: tuple[int, int] = (40, 24),
    ) -> FrameStack:
        taken.append((unit, frames))
        pattern = np.random.default_rng(unit).standard_normal(patch)
        noise = np.random.default_rng([unit, 1]).standard_normal((frames or 80, *patch))
        bias = -3.5 if unit == 3 else float(unit)
        return stack_of(1.0 + (bias + unit * pattern + 2.0 * noise) * MM)

    monkeypatch.setattr(quantities, "plane_stack", frames_of)
    return taken


def value(name: str, **conditions: Any) -> float:
    quantity = QUANTITIES[name]
    return quantity.measure(BENCH, quantity.conditions.from_data(conditions)).value


def test_patterns_are_means_over_the_units(units: list[tuple[int, int | None]]) -> None:
    """1, 2 and 3 mm; a plane takes three of the 400 degrees of freedom of a patch."""
    assert value("patch_pattern_mm", patch_px=20) == pytest.approx(2.0, rel=0.02)
    assert units == [(1, 20), (2, 20), (3, 20)]
    units.clear()
    assert value("fixed_pattern_mm") == pytest.approx(2.0, rel=0.02)
    assert units == [(1, 20), (2, 20), (3, 20)]


def test_five_units_suffice_for_a_pattern(
    units: list[tuple[int, int | None]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(BENCH, "effort", Effort(8, 3, 4, 7))
    for name in ("patch_pattern_mm", "fixed_pattern_mm"):
        units.clear()
        assert value(name) > 2.0
        assert [unit for unit, _ in units] == [1, 2, 3, 4, 5]


def test_the_systematic_error_is_the_largest_of_the_units(
    units: list[tuple[int, int | None]],
) -> None:
    assert value("systematic_error_mm") == pytest.approx(3.5, abs=0.3)
    assert units == [(1, 3), (2, 3), (3, 3)]


def test_the_error_over_range_leaves_out_what_all_ranges_share(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Errors of 11, 12, 14 and 15 mm: squares of 4, 1, 1 and 4 about 13, over three. Missing
    pixels do not count."""
    errors_mm = {1.0: 11.0, 2.0: 12.0, 3.0: 14.0, 4.0: 15.0}

    def frames_of(bench: Any, c: PlaneConditions, effects: Any) -> FrameStack:
        z_m = np.full((3, 10, 10), c.distance_m + errors_mm[c.distance_m] * MM)
        z_m[0, 0, 0] = np.nan
        return stack_of(z_m, c.distance_m)

    monkeypatch.setattr(quantities, "plane_stack", frames_of)
    deviation_mm = value("error_over_range_mm", distances_m=[1.0, 2.0, 3.0, 4.0])
    assert deviation_mm == pytest.approx(np.sqrt(10 / 3))


def test_the_deviation_of_single_pixels(units: list[tuple[int, int | None]]) -> None:
    assert value("temporal_sigma_mm") == pytest.approx(2.0, rel=0.02)
    assert value("random_error_mm") == pytest.approx(2.0, rel=0.02)
    assert units == [(1, None), (1, 40)]


def test_the_jitter_leaves_out_frames_that_jumped(monkeypatch: pytest.MonkeyPatch) -> None:
    """Means of 1, 2 and 3 mm beside 1 m, and one 20 mm off: a deviation of 1 mm."""
    offsets_mm = np.array([1.0, 2.0, 3.0, 20.0])
    z_m = 1.0 + offsets_mm[:, None, None] * MM * np.ones((4, 10, 10))
    z_m[:, 0, 0] = np.nan
    monkeypatch.setattr(quantities, "plane_stack", lambda *_, **__: stack_of(z_m))
    assert value("frame_jitter_mm") == pytest.approx(1.0)


def test_the_share_of_valid_pixels(monkeypatch: pytest.MonkeyPatch) -> None:
    """9 neighbours that a filter of one pixel mixes count as one."""
    z_m = np.ones((3, 10, 30))
    z_m[:, :, :6] = np.nan
    monkeypatch.setattr(quantities, "plane_stack", lambda *_: stack_of(z_m))
    reading = QUANTITIES["valid_fraction"].measure(BENCH, PlaneConditions())
    expected = quantities.share_of(np.isfinite(z_m), 9)
    assert reading == expected
    assert reading.value == pytest.approx(0.8)


def test_the_least_range_is_where_the_pixels_come_into_range(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """From 700 mm on all but 4 % of the pixels have a range; nearer, all but 6 %."""
    taken: list[PlaneConditions] = []

    def frames_of(bench: Bench, plane: PlaneConditions, *_: Any) -> FrameStack:
        taken.append(plane)
        z_m = np.ones((1, 10, 10))
        lost = 4 if plane.distance_m >= 0.7 else 6
        z_m[:, 0, :lost] = np.nan
        return stack_of(z_m)

    monkeypatch.setattr(quantities, "plane_stack", frames_of)
    least_mm = value("least_range_mm", albedo=0.3, ambient_uw_cm2_nm=2.0)
    assert 700.0 <= least_mm < 707.0
    assert {(plane.albedo, plane.ambient_uw_cm2_nm) for plane in taken} == {(0.3, 2.0)}


def test_a_camera_that_is_nowhere_in_range_has_no_least_range(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(
        quantities, "plane_stack", lambda *_: stack_of(np.full((1, 10, 10), np.nan))
    )
    assert np.isnan(value("least_range_mm"))


def test_patches_are_taken_without_their_planes() -> None:
    """Six patches of 4 x 4 pixels, of other tilts, and what remains of a checked pattern."""
    v, u = np.mgrid[:9, :13]
    checked = np.where((u + v) % 2 == 0, 0.5, -0.5)
    z_mm = 1000.0 + 3.0 * (u // 4) * u - 2.0 * (v // 4) * v + checked
    left_mm = _left_of_patches(z_mm * MM, 4)
    assert left_mm.shape == (6, 4, 4)
    # a checked patch of even sides has no tilt
    assert left_mm == pytest.approx(np.broadcast_to(checked[:4, :4], (6, 4, 4)), abs=1e-9)


def test_products_within_patches_by_hand(monkeypatch: pytest.MonkeyPatch) -> None:
    """Two units with stripes of 1 and 2 mm, two columns wide: beside each other, half of the
    pixels agree at a distance of one, none at two; below each other all do."""
    u = np.tile(np.arange(16), (8, 1))
    stripes = np.where(u // 2 % 2 == 0, 1.0, -1.0)
    frames = tuple(1.0 + height * stripes * MM for height in (1.0, 2.0))
    monkeypatch.setattr(quantities, "_single_frames", lambda *_: frames)
    variance, product = quantities._patch_products(BENCH, PatchConditions(patch_px=8, apart_px=2))
    edges = _left_of_patches(frames[0][:, :8], 8)[0]
    beside = (edges[:, 2:] * edges[:, :-2]).mean()
    below = (edges[2:] * edges[:-2]).mean()
    assert beside < -0.5 < 0.5 < below
    assert product == pytest.approx(np.outer([1.0, 4.0], 2 * [(beside + below) / 2]))
    assert variance == pytest.approx(np.outer([1.0, 4.0], 2 * [edges.var()]))
    deviation = value("patch_deviation_mm", patch_px=8)
    assert deviation == pytest.approx(1.5 * edges.std())
    correlation = value("patch_correlation", patch_px=8, apart_px=2)
    assert correlation == pytest.approx((beside + below) / 2 / edges.var())
    # in steps of 2.5 mm, stripes of 1 mm vanish and those of 2 mm have 2.5 mm
    coarse, _ = quantities._patch_products(BENCH, PatchConditions(patch_px=8, rounded_mm=2.5))
    assert coarse[0] == pytest.approx([0.0, 0.0], abs=1e-12)
    assert coarse[1] == pytest.approx(2 * [2.5**2 * edges.var()])


def test_a_single_frame_is_taken_of_each_unit(units: list[tuple[int, int | None]]) -> None:
    quantities._single_frames.cache_clear()
    frames = quantities._single_frames(BENCH_KEY, PlaneConditions())
    assert units == [(1, 1), (2, 1), (3, 1)]
    assert [frame.shape for frame in frames] == 3 * [(140, 180)]
    quantities._single_frames.cache_clear()


class _Hashable(SimpleNamespace):
    """A bench that can be a key of a cache."""

    __hash__ = object.__hash__


BENCH_KEY: Any = _Hashable(effort=EFFORT)


def test_a_plane_has_the_albedo_of_its_amplitude(monkeypatch: pytest.MonkeyPatch) -> None:
    """Electrons = albedo x signal x contrasts / distance^2, and an amplitude unit is so many."""
    planes = []
    monkeypatch.setattr(quantities, "plane_view", lambda *arguments: planes.append(arguments))
    monkeypatch.setattr(Bench, "taken", lambda self, *arguments, **_: arguments[2])
    bench = Bench("azure_kinect_nfov", EFFORT)
    camera: Any = bench.camera
    plane_stack.cache_clear()
    assert plane_stack(bench, PlaneConditions(distance_m=2.0, albedo=0.3, angle_deg=60.0)) == 80
    assert plane_stack(bench, PlaneConditions(distance_m=2.0, amplitude_units=500.0), frames=7) == 7
    plane_stack.cache_clear()
    first, second = planes
    region = bench.patch(40, 24)
    assert first[1:] == (region, 2.0, 0.3, pytest.approx(np.sqrt(3.0)), 0.02)
    electrons = 500.0 * camera.photons.electrons_per_unit.value
    contrasts = sum(camera.modulation.contrast.value)
    full = camera.photons.signal_electrons.value * contrasts / 2.0**2
    assert second[3] == pytest.approx(electrons / full)
    assert second[4] == 0.05
    with pytest.raises(UserError, match="does not support amplitude_units"):
        plane_stack(Bench("realsense_l515", EFFORT), PlaneConditions(amplitude_units=5.0))


def test_a_patch_lies_about_the_optical_axis() -> None:
    bench = Bench("azure_kinect_nfov", EFFORT)
    lens = bench.camera.nominal_lens
    margin = bench.camera.optics.margin_px
    region = bench.patch(40, 24)
    row = round(lens.cy)
    column = round(lens.cx)
    rows = (row - 20 - margin, row + 20 + margin)
    columns = (column - 12 - margin, column + 12 + margin)
    assert (region.row0, region.row1, region.col0, region.col1) == (*rows, *columns)


def test_without_ranges_there_is_no_number(monkeypatch: pytest.MonkeyPatch) -> None:
    z_m = np.full((3, 40, 50), np.nan)
    monkeypatch.setattr(quantities, "plane_stack", lambda *_, **__: stack_of(z_m))
    assert np.isnan(value("systematic_error_mm"))
    nothing = QUANTITIES["fixed_pattern_mm"].measure(BENCH, PlaneConditions())
    assert nothing is NOTHING


def test_the_unit_of_a_quantity_is_the_ending_of_its_name() -> None:
    units = {name: quantity.unit for name, quantity in QUANTITIES.items()}
    assert units["temporal_sigma_mm"] == units["step_height_mm"] == "mm"
    assert units["edge_gap_px"] == units["flying_pixels_px"] == "px"
    assert units["valid_fraction"] == units["noise_correlation"] == units["flying_share"] == ""


def test_conditions_in_words_and_as_scenes() -> None:
    assert in_words(PlaneConditions()) == "1.5 m, albedo 0.8"
    dim = PlaneConditions(distance_m=0.5, amplitude_units=20.0, angle_deg=30.0)
    assert in_words(dim) == "0.5 m, 30°, amplitudes 20"
    sunny = PlaneConditions(ambient_uw_cm2_nm=7.0)
    assert in_words(sunny) == "1.5 m, albedo 0.8, ambient 7 µW/(cm² nm)"
    step = StepConditions(across="y", shadow=True, front_mm=80.0, back_albedo=0.5)
    assert in_words(step) == (
        "0.75 m, step 50 mm, albedo 0.6, across y, shadowed, front 80 mm, back of albedo 0.5"
    )
    with pytest.raises(ValidationError, match="a shadow needs front_mm and back_albedo"):
        StepConditions(shadow=True, front_mm=80.0)
    with pytest.raises(ValidationError, match="belong to a shadow"):
        StepConditions(back_albedo=0.5)
    patch = PatchConditions(apart_px=2, rounded_mm=1.0)
    assert "patches of 38 px, 2 px apart, stored in steps of 1 mm" in in_words(patch)
    assert scene_of(patch) == scene_of(PlaneConditions())
    assert scene_of(step)[0] == "StepConditions"
