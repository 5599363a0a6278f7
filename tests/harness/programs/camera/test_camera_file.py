"""The numbers of a camera file and of a certificate, from measurements that are stated."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from harness.programs.camera import camera_file, certificate, measure
from harness.programs.camera.camera_file import (
    Stated,
    _empirical,
    _field,
    _gain,
    _of_unit,
    _refitted,
    _text,
    camera_of_size,
    with_lens,
)
from harness.programs.camera.certificate import level_of_detection_mm, of_surfaces, spacings_mm
from harness.programs.camera.tables import FLAT_SURFACES
from harness.stills.statistics import Reading
from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import MM, Lens
from scenes.closed_form import Plane
from scenes.sensor.camera import load_camera


def known() -> Any:
    return load_camera("azure_kinect_nfov")


def a_face(temporal_mm: float = 1.0, **changes: Any) -> measure.SurfaceFigures:
    facts: dict[str, Any] = {
        "capture": "c",
        "number": 1,
        "distance_m": 1.0,
        "angle_deg": 0.0,
        "temporal": Reading(temporal_mm),
        "frame_rms_mm": 2.0,
        "average_rms_mm": 3.0,
        "form95_mm": 4.0,
        "form997_mm": 5.0,
        "fill_rate": 0.9,
        **changes,
    }
    return measure.SurfaceFigures(**facts)


# ---- the gain


def fitted(
    monkeypatch: pytest.MonkeyPatch, noise_of_gain: Callable[[float], list[float]]
) -> tuple[float, list[float]]:
    """The gain of a camera whose surfaces have 2 and 4 mm of noise, and the gains that were tried,
    as multiples of the known camera's."""
    start = known().photons.signal_electrons.value
    tried: list[float] = []

    def simulated(camera: Any, *_: Any) -> list[Any]:
        tried.append(camera.photons.signal_electrons.value / start)
        return [noise_of_gain(tried[-1])]

    def surfaces_of(noises_mm: list[float]) -> list[measure.SurfaceFigures]:
        return [a_face(noise_mm, number=k + 1) for k, noise_mm in enumerate(noises_mm)]

    monkeypatch.setattr(camera_file, "simulated", simulated)
    monkeypatch.setattr(measure, "surfaces_of", surfaces_of)
    measured: Any = SimpleNamespace(surfaces=surfaces_of([2.0, 4.0]))
    camera, gain = _gain(known(), measured, 0.8)
    assert camera.photons.signal_electrons.value == pytest.approx(gain)
    return gain / start, tried


@pytest.mark.parametrize(("power", "gain"), [(-0.5, 9.0), (-0.5, 0.2), (-1.0, 3.0), (-0.3, 4.0)])
def test_the_gain_that_gives_the_noise_is_found_by_secants(
    monkeypatch: pytest.MonkeyPatch, power: float, gain: float
) -> None:
    """Noise that is a power of the light is met at the third trial: the first step takes a power
    of -0.6, the second that of the first two."""

    def noise_mm(tried: float) -> list[float]:
        return [2.0 * (tried / gain) ** power, 4.0 * (tried / gain) ** power]

    found, tried = fitted(monkeypatch, noise_mm)
    first_step = gain ** (power / -0.6)
    assert tried == pytest.approx([1.0, first_step, gain])
    assert found == pytest.approx(gain)


def test_a_gain_is_right_if_the_mean_of_the_logarithms_is_within_a_per_cent(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    right = 1.1
    for error, trials in ((1.009, 1), (1 / 1.009, 1), (1.011, 2)):
        noises_mm = iter([[2.0 * right * error, 4.0 / right * error], [2.0, 4.0]])
        _, tried = fitted(monkeypatch, lambda _, noises_mm=noises_mm: next(noises_mm))
        assert len(tried) == trials


def test_light_that_shows_no_surface_is_raised_within_limits(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Without a surface the noise counts as e times too large: a step of exp(1 / 0.6), then of
    exp(1 / 0.2) each, up to a factor of 100."""
    found, tried = fitted(monkeypatch, lambda _: [])
    first = np.exp(1 / 0.6)
    assert tried == pytest.approx([1.0, first, 100.0, 100.0, 100.0])
    assert found == pytest.approx(100.0)


# ---- the numbers of a file


def test_numbers_are_written_with_five_digits() -> None:
    assert _text(3) == "3"
    assert _text(0.123456789) == "0.12346"
    assert _text((1.0, np.array([2.5, 1e-7]))) == "[1.0, [2.5, 1e-07]]"


def measurements(**changes: Any) -> Any:
    lens = Lens(320, 288, 250.0, 251.0, 160.0, 144.0)
    facts: dict[str, Any] = {
        "captures": [SimpleNamespace(lens=lens, step_m=2.0 * MM)],
        "frames": 50,
        "jumps_m": np.array([10.0, 14.0]) * MM,
        "jitter_m": 0.3 * MM,
        "has_amplitude": True,
        "law": measure.RangeLaw(
            np.array([1.0, 2.0]),
            np.array([1.0, 3.0]) * MM,
            np.array([1.4, 0.5]),
            np.array([0.1, np.nan]),
            250.0,
        ),
        "pattern": None,
        "pattern_correlation": None,
        "dropouts": measure.Dropouts(
            np.array([10.0, 100.0]), np.array([0.4, 0.1]), np.array([500, 700])
        ),
        "edge": None,
        "correlation": np.array([[1.0, 0.0], [1.0, 0.0]]),
        **changes,
    }
    return SimpleNamespace(**facts)


def values(facts: Any) -> dict[str, Stated]:
    return {f"{fact.section}.{fact.key}": fact for fact in facts}


def test_the_numbers_of_a_unit() -> None:
    facts = values(_of_unit(measurements(), "s"))
    assert [facts[f"lens.{key}_px"].value for key in ("width", "height", "fx", "fy", "cx", "cy")] == [
        320, 288, 250.0, 251.0, 160.0, 144.0,
    ]  # fmt: skip
    assert facts["lens.distortion"].value == ()
    assert facts["unit.jump_rate"].value == pytest.approx(2 / 50)
    assert facts["unit.jump_mm"].value == pytest.approx(12.0)
    assert facts["unit.jitter_mm"].value == pytest.approx(0.3)
    assert facts["engine.output_step_mm"].value == pytest.approx(2.0)
    smooth = measurements(jumps_m=np.zeros(0))
    smooth.captures[0].step_m = 0.0
    facts = values(_of_unit(smooth, "s"))
    assert facts["unit.jump_mm"].value == facts["unit.jump_rate"].value == 0.0
    assert facts["engine.output_step_mm"].value == 0.001


def test_the_numbers_of_an_empirical_camera() -> None:
    facts = values(_empirical(measurements(), 0.7, "s"))
    assert facts["light.amplitude_at_1m"].value == 250.0
    assert facts["light.albedo"].value == 0.7
    assert facts["noise.range_mm"].value == pytest.approx([1000.0, 2000.0])
    assert facts["noise.sigma_mm"].value == pytest.approx([1.0, 3.0])
    assert (facts["noise.range_exponent"].value, facts["noise.range_exponent"].tag) == (1.4, "O")
    assert facts["noise.brightness_exponent"].value == 0.5
    assert facts["noise.brightness_exponent"].tag == "M"
    assert facts["dropouts.amplitude"].value.tolist() == [10.0, 100.0]
    assert facts["dropouts.share"].value.tolist() == [0.4, 0.1]
    assert facts["dropouts.share"].source == "of 1200 pixels on surfaces; s"
    assert facts["fixed_pattern.deviation_mm"].value == 0.0
    assert (facts["edge.gap_px"].value, facts["edge.blur_px"].value) == (0.0, 0.0)
    assert facts["edge.gap_px"].tag == "M"
    for key in ("unit.offset_mm", "unit.drift_mm", "unit.drift_ramp", "engine.min_range_mm"):
        assert (facts[key].value, facts[key].tag) == (0.0, "M")
    assert facts["unit.drift_min"].value == facts["edge.least_step_mm"].value == 20.0
    assert facts["engine.max_range_mm"].value == 20_000.0
    assert facts[".wavelength_nm"].value == 850.0
    facts = values(_empirical(measurements(has_amplitude=False), 0.7, "s"))
    assert (facts["light.amplitude_at_1m"].value, facts["light.amplitude_at_1m"].tag) == (1.0, "M")


@pytest.mark.parametrize(("flying_px", "blur_px"), [(0.04, 0.0), (0.06, 4.06 / 2.56)])
def test_an_edge_is_blurred_if_pixels_fly(flying_px: float, blur_px: float) -> None:
    """From 10 to 90 % a Gaussian's edge is 2.56 of its deviations wide."""
    edge = measure.EdgeFigures(lines=40, gap_px=4.0, flying_px=flying_px, step_m=0.2)
    facts = values(_empirical(measurements(edge=edge), 0.7, "s"))
    assert facts["edge.gap_px"].value == 4.0
    assert facts["edge.blur_px"].value == pytest.approx(blur_px)
    assert facts["edge.blur_px"].source.startswith("40 lines")


def test_correlations_become_taps_along_their_axes() -> None:
    """A correlation of 0.5 at the first lag is that of two equal taps."""
    along_x = np.array([1.0, 0.5, 0.0, 0.0])
    along_y = np.array([1.0, 0.0, 0.0, 0.0])
    field = SimpleNamespace(rms_m=0.4 * MM, warnings=("w",))
    measured = measurements(
        correlation=np.stack([along_x, along_y]),
        pattern=SimpleNamespace(field=field),
        pattern_correlation=np.stack([along_y, along_x]),
    )
    facts = values(_empirical(measured, 0.7, "s"))
    assert facts["fixed_pattern.deviation_mm"].value == pytest.approx(0.4)
    assert facts["fixed_pattern.rows"].source == "s; w"

    def correlation(key: str) -> float:
        taps = np.asarray(facts[key].value, float)
        return float((taps[1:] * taps[:-1]).sum() / (taps**2).sum())

    assert correlation("noise.columns") == pytest.approx(0.5, abs=0.03)
    assert correlation("noise.rows") == pytest.approx(0.0, abs=1e-6)
    assert correlation("fixed_pattern.columns") == pytest.approx(0.0, abs=1e-6)
    assert correlation("fixed_pattern.rows") == pytest.approx(0.5, abs=0.03)


def test_the_emitter_covers_every_pixel_with_a_return() -> None:
    """The lit polygon and the cone are widened to the rays in at least half of the frames."""
    camera = known()
    full_deg = camera.emitter.full_half_angle_deg.value
    cutoff_deg = camera.emitter.cutoff_half_angle_deg.value
    wide = float(np.tan(np.radians(cutoff_deg + 2.0)))
    slopes = np.array([[[0.0, 0.0], [wide, 0.0], [2 * wide, 0.0]]])
    z_m = np.ones((4, 1, 3))
    z_m[2:, 0, 1] = np.nan
    z_m[1:, 0, 2] = np.nan
    measured: Any = SimpleNamespace(captures=[SimpleNamespace(z_m=z_m, slopes=slopes)])
    fields = dict(_field(camera, measured))
    expected_deg = cutoff_deg + 2.0 + cutoff_deg - full_deg
    assert fields["cutoff_half_angle_deg"] == pytest.approx(expected_deg)
    assert max(x for x, _ in fields["mask_slopes"]) == pytest.approx(wide, abs=1e-3)
    z_m[1:, 0, 1] = np.nan
    assert "cutoff_half_angle_deg" not in dict(_field(camera, measured))


@pytest.mark.parametrize(
    ("share", "faint"),
    [
        # half way between shares of 0.6 and 0.1, on a logarithmic scale: a fifth of the way
        ([0.9, 0.6, 0.1], 20.0 * 2**0.2),
        ([0.5, 0.3, 0.1], 10.0),
        ([0.49, 0.3, 0.1], None),
        ([0.9, 0.6, 0.5], None),
    ],
)
def test_faint_pixels_are_gated_where_half_of_them_are_lost(
    monkeypatch: pytest.MonkeyPatch, share: list[float], faint: float | None
) -> None:
    """In the units of the known camera, whose amplitudes are half of the recorded ones."""
    lens = known().nominal_lens

    def capture(amplitude: float) -> Any:
        return SimpleNamespace(
            lens=lens,
            step_m=MM,
            z_m=np.ones((4, 1, 3)),
            slopes=np.zeros((1, 3, 2)),
            amplitude=np.array([[amplitude, amplitude, 1e6]]),
            steady=np.array([[True, True, False]]),
        )

    monkeypatch.setattr(camera_file, "_gain", lambda camera, *_: (camera, 700.0))
    monkeypatch.setattr(camera_file, "simulated", lambda *_: [capture(30.0)])

    def field(rms_m: float) -> Any:
        return SimpleNamespace(field=SimpleNamespace(rms_m=rms_m, warnings=()))

    of_simulated = SimpleNamespace(pattern=field(0.2 * MM))
    monkeypatch.setattr(measure, "characteristics", lambda stacks: of_simulated)
    levels = np.array([10.0, 20.0, 40.0])
    measured = measurements(
        captures=[capture(60.0)],
        surfaces=["a surface"],
        pattern=field(0.5 * MM),
        dropouts=measure.Dropouts(levels, np.array(share), np.ones(3)),
    )
    facts = values(_refitted("azure_kinect_nfov", measured, 0.8, "s"))
    assert facts["photons.signal_electrons"].value == 700.0
    nominal_mm = known().fixed_pattern.smooth_mm.value
    assert facts["fixed_pattern.smooth_mm"].value == pytest.approx(2.5 * nominal_mm)
    gate = facts.get("engine.min_amplitude_units")
    assert (gate is None) == (faint is None)
    if gate is not None and faint is not None:
        assert gate.value == pytest.approx(faint / 2.0)


def test_a_camera_is_known_by_its_size(monkeypatch: pytest.MonkeyPatch) -> None:
    lens = known().nominal_lens
    assert camera_of_size(load_camera("pmd_flexx2").nominal_lens) == "pmd_flexx2"
    of_kinect = load_camera("kinect_v2").nominal_lens
    with pytest.raises(UserError, match="several cameras have 512 x 424 pixels"):
        camera_of_size(of_kinect)

    def is_guessed(camera: Any) -> bool:
        return camera.name != "kinect_v2"

    monkeypatch.setattr(camera_file, "guessed_precision", is_guessed)
    assert camera_of_size(of_kinect) == "kinect_v2"
    with pytest.raises(UserError, match="several cameras have 224 x 172 pixels"):
        camera_of_size(load_camera("pmd_flexx2").nominal_lens)
    assert with_lens("azure_kinect_nfov", lens).nominal_lens.fx == pytest.approx(lens.fx)
    with pytest.raises(UserError, match="no simulated camera has 7 x 5 pixels"):
        camera_of_size(Lens(7, 5, 9.0, 9.0, 3.0, 2.0))
    with pytest.raises(UserError, match="the capture has 7 x 5 pixels"):
        with_lens("azure_kinect_nfov", Lens(7, 5, 9.0, 9.0, 3.0, 2.0))


# ---- the certificate


@pytest.mark.parametrize(("frames", "variance"), [(1, 4.0), (10, 0.4), (50, 0.08)])
def test_the_level_of_detection(frames: int, variance: float) -> None:
    """1.96 deviations of 2 mm of noise over the frames; with 0.5 mm of fixed pattern beside it, and
    with what coarse rounding leaves: q / sqrt(12) without noise."""
    measured: Any = SimpleNamespace(captures=[SimpleNamespace(step_m=0.0)], pattern=None)
    alone = level_of_detection_mm(measured, (2.0 * MM) ** 2, frames)
    assert alone == pytest.approx(1.96 * np.sqrt(variance))
    measured.pattern = SimpleNamespace(field=SimpleNamespace(rms_m=0.5 * MM))
    beside = level_of_detection_mm(measured, (2.0 * MM) ** 2, frames)
    assert beside == pytest.approx(1.96 * np.sqrt(variance + 0.25))
    measured.captures[0].step_m = 6.0 * MM
    rounded = level_of_detection_mm(measured, (1e-3 * MM) ** 2, frames)
    assert rounded == pytest.approx(1.96 * np.sqrt(0.25 + 36 / 12), rel=1e-2)


def test_the_rows_of_surfaces_have_the_tables_columns() -> None:
    measured: Any = SimpleNamespace(
        captures=[SimpleNamespace(step_m=0.0)], pattern=None, surfaces=[a_face(2.0)]
    )
    (row,) = of_surfaces(measured)
    assert row["lod95_1_mm"] == pytest.approx(1.96 * 2.0)
    assert row["lod95_10_mm"] == pytest.approx(1.96 * 2.0 / np.sqrt(10))
    assert row["lod95_50_mm"] == pytest.approx(1.96 * 2.0 / np.sqrt(50))
    (data,) = FLAT_SURFACES.data([row])
    assert row.items() >= data.items() or set(data) == set(row)


def test_spacings_are_errors_along_the_normal() -> None:
    """Two captures of a plane at 45 degrees: the second's lies 2 mm too far along the axis."""
    plane = Plane(1.0, 1.0)
    pose = np.eye(4)
    pose[:3, 3] = [0.1, 0.0, -0.2]
    # in the second camera's frame, the plane z = 1 + x is z' = 1.3 + x'
    again = Plane(1.3 + 2.0 * MM, 1.0)
    captures = [SimpleNamespace(planes=[(each, None)]) for each in (plane, again)]
    measured: Any = SimpleNamespace(captures=captures)
    (error_mm,) = spacings_mm(measured, [np.eye(4), pose])
    assert error_mm == pytest.approx(2.0 / np.sqrt(2.0))


def test_the_answer_of_a_certificate_is_that_of_its_first_surface() -> None:
    capture = SimpleNamespace(name="c", kept=np.arange(60) != 3, step_m=0.0)
    measured: Any = SimpleNamespace(captures=[capture], pattern=None, surfaces=[a_face(2.0)])
    assert certificate._noise_sentence(measured) == (
        "A pixel's noise is 2 mm at 1.00 m; the mean of 50 recorded frames reveals a change of "
        "0.554 mm (LoD95)."
    )
    capture.kept = np.arange(12) != 3
    assert "the mean of 11 recorded frames reveals" in certificate._noise_sentence(measured)
