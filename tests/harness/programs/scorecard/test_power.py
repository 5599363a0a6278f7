"""Which constants are moved, how far, and what notices them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from harness.programs.scorecard import power
from harness.programs.scorecard.bench import BRIEF, Bench
from harness.programs.scorecard.figures import Request, read_figures
from harness.programs.scorecard.power import (
    POWER,
    Constant,
    Moved,
    constants_of,
    power_of,
    stored_untested,
    untested,
    untested_text,
)
from harness.programs.scorecard.quantities import QUANTITIES
from harness.stills.statistics import Reading
from harness.vocabulary.declaration.yaml_source import read_yaml
from scenes.sensor.camera import camera_names, camera_of, stated_in
from scenes.sensor.common.config import CameraConfig, EffectsConfig

AZURE = "azure_kinect_nfov"
FIGURES = """
figures:
  - name: bolt
    camera: femto_bolt_nfov
    quantity: temporal_sigma_mm
    conditions: {distance_m: 1.5}
    published: {value: 1.0, tolerance: 0.1}
    source: a wall
    tag: W
    calibration: false
  - name: fitted
    camera: femto_bolt_nfov
    quantity: temporal_sigma_mm
    conditions: {distance_m: 2.0}
    published: {value: 1.0, tolerance: 0.1}
    source: a wall
    tag: W
    calibration: true
"""


def constant(value: Any, key: str = "unit.jitter_mm", **others: Any) -> Constant:
    constant = {"camera": AZURE, "tag": "M", "limits": None, **others}
    return Constant(key=key, value=value, **constant)


# ---- which constants, and how far


def test_a_number_belongs_to_the_file_that_states_it() -> None:
    owners = stated_in("femto_bolt_nfov")
    assert owners["photons.signal_electrons"] == "femto_bolt_nfov"
    assert owners["photons.read_noise_electrons"] == AZURE
    # a part that the file removes is nobody's
    assert "engine.edge_threshold" not in stated_in("vzense_ds86")
    assert set(stated_in(AZURE).values()) == {AZURE}


def test_constants_are_the_files_own_numbers_without_evidence_and_geometry() -> None:
    constants = {constant.key: constant for constant in constants_of(AZURE)}
    assert {"photons.read_noise_electrons", "unit.offset_mm", "modulation.contrast"} <= set(
        constants
    )
    for key in (
        "unit.frames_per_second",  # read in a specification
        "lens.fx_px",
        "emitter.position_mm",
        "photons.calibration_distance_m",
        "engine.filter_on",  # a choice
        "engine.edges_to_dim",
    ):
        assert key not in constants
    bolt = constants_of("femto_bolt_nfov")
    assert [constant.key for constant in bolt] == ["photons.signal_electrons"]
    assert bolt[0].limits == (584.0, 2336.0)


def test_a_constant_is_moved_by_30_percent_or_to_the_ends_of_its_range() -> None:
    assert constant(0.2).moved(upwards=True) == pytest.approx(0.26)
    assert constant(0.2).moved(upwards=False) == pytest.approx(0.14)
    ranged = constant(0.2, limits=(0.05, 0.9))
    assert ranged.moved(upwards=True) == pytest.approx(0.9)
    assert ranged.moved(upwards=False) == pytest.approx(0.05)
    assert constant(0.0).moved(upwards=True) is None
    assert constant(0.0, limits=(0.0, 0.5)).moved(upwards=True) == pytest.approx(0.5)
    assert constant(0.0, limits=(0.0, 0.5)).moved(upwards=False) is None


def test_an_illegal_move_is_halved_until_it_is_legal() -> None:
    """Contrasts 0.87, 0.88 and 0.96 would exceed 1 by 30, 15 and 7.5 %, not by 3.75 %."""
    contrast = constant((0.87, 0.88, 0.96), key="modulation.contrast")
    assert contrast.moved(upwards=True) == pytest.approx((0.902625, 0.913, 0.996))
    assert contrast.moved(upwards=False) == pytest.approx((0.609, 0.616, 0.672))
    # a window has an odd number of pixels: 6 and 8 are illegal
    assert constant(5, key="engine.window_px").moved(upwards=True) == 7
    assert constant(5, key="engine.window_px").moved(upwards=False) == 3
    assert constant(128, key="converter.knee_units").moved(upwards=True) == 166


def test_every_movable_constant_has_a_legal_value() -> None:
    for camera in ("kinect_v2", "realsense_l515"):
        moves = 0
        for row in constants_of(camera):
            for upwards in (False, True):
                value = row.moved(upwards)
                if value is None:
                    continue
                moves += 1
                assert value != row.value, row.key
                config = CameraConfig(name=camera, numbers={row.key: value})
                fact = power._fact(camera_of(config).to_data(), row.key)
                assert fact is not None, row.key
                assert power._numbers(fact["value"]) == value, row.key
        assert moves > len(constants_of(camera)), camera


# ---- what notices


def moved_with(
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
    values: dict[str, float],
    unmoved: float = 1.0,
) -> dict[str, Moved]:
    """Return the moves of the cameras where a reading is ``unmoved`` or, where a constant of
    ``values`` is replaced, that of ``values``."""
    taken: list[Request] = []

    def measured(requests: Any, effort: Any, jobs: int) -> dict[Request, Reading]:
        readings = {}
        for request in requests:
            taken.append(request)
            value = unmoved
            for key, _ in request.numbers:
                value = values.get(key, unmoved)
            readings[request] = Reading(value)
        return readings

    monkeypatch.setattr(power, "measured", measured)
    monkeypatch.setattr(power, "HINGES", ())
    path = folder / "figures.yaml"
    path.write_text(FIGURES)
    rows = power_of(read_figures(path), ["femto_bolt_nfov", AZURE], 1)
    assert {request.camera for request in taken} == {"femto_bolt_nfov"}
    assert {request.conditions.to_data()["distance_m"] for request in taken} == {1.5}
    return {f"{row.constant.camera} {row.constant.key}": row for row in rows}


def test_a_change_of_grade_is_noticed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Bands end at 10 % (the source's tolerance) and 25 %; fitted figures do not count."""
    rows = moved_with(
        tmp_path,
        monkeypatch,
        {
            "photons.signal_electrons": 1.05,
            "photons.read_noise_electrons": 1.12,
            "photons.band_nm": 1.3,
            "photons.full_well_electrons": float("nan"),
            "unit.jitter_mm": 1.3,
        },
    )
    assert rows["femto_bolt_nfov photons.signal_electrons"].verdict == "untested"
    noticed = ("photons.read_noise_electrons", "photons.band_nm", "photons.full_well_electrons")
    for key in noticed:
        row = rows[f"{AZURE} {key}"]
        assert row.names == ("bolt",), key
        assert row.noticed_lowered == row.noticed_raised == ("bolt",)
    # the file of the Femto states its own signal: the Azure's has no user among the figures
    assert rows[f"{AZURE} photons.signal_electrons"].verdict == "untested"
    assert rows[f"{AZURE} scatter.stray_share"].verdict == "not moved"
    # the temporal deviation is measured without jitter, so that it is not even asked
    assert rows[f"{AZURE} unit.jitter_mm"].verdict == "untested"
    keys = untested(list(rows.values()))
    assert "photons.band_nm" not in keys[AZURE]
    assert {"photons.signal_electrons", "scatter.stray_share"} <= set(keys[AZURE])


@pytest.mark.parametrize(
    ("key", "quantity", "acts"),
    [
        ("unit.jitter_mm", "temporal_sigma_mm", False),
        ("unit.jitter_mm", "random_error_mm", True),
        ("unit.jump_rate", "systematic_error_mm", False),
        ("unit.drift_min", "systematic_error_mm", True),
        ("fixed_pattern.pixel_mm", "edge_gap_px", False),
        ("fixed_pattern.pixel_mm", "patch_deviation_mm", True),
        ("modulation.wiggling_residual", "patch_deviation_mm", False),
        ("photons.band_nm", "temporal_sigma_mm", True),
    ],
)
def test_a_constant_acts_only_by_its_effect(key: str, quantity: str, acts: bool) -> None:
    """What is skipped would not change: with the effect off, the reading is the same."""
    assert power._acts(key, QUANTITIES[quantity]) == acts


def test_the_effects_of_a_quantity_are_those_it_is_measured_with(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Each set of effects that a measurement hands to the bench is part of the declared one."""
    for name, quantity in QUANTITIES.items():
        used: list[EffectsConfig] = []

        def taken(self: Any, view: Any, effects: EffectsConfig, *_: Any, **__: Any) -> None:
            used.append(effects)  # noqa: B023
            raise InterruptedError

        monkeypatch.setattr(Bench, "taken", taken)
        with pytest.raises(InterruptedError):
            quantity.measure(Bench(AZURE, BRIEF), quantity.conditions())
        (effects,) = used
        switched_on = {key for key, is_on in effects.to_data().items() if is_on}
        declared = {key for key, is_on in quantity.effects.to_data().items() if is_on}
        assert switched_on <= declared, name


def test_a_small_change_across_a_limit_is_not_noticed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From 1.06 across the end of the tolerance, 1.1: by 5 % or less it may be noise."""
    values = {"photons.read_noise_electrons": 1.11, "photons.band_nm": 1.12}
    rows = moved_with(tmp_path, monkeypatch, values, unmoved=1.06)
    assert rows[f"{AZURE} photons.read_noise_electrons"].verdict == "untested"
    assert rows[f"{AZURE} photons.band_nm"].verdict == "noticed"


def test_an_untested_constant_states_on_what_limits_hang(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Of the untested ones, read noise and stray light change the noise at 0.7 m by 6 and 4 %; a
    share of valid pixels counts by its difference."""

    def measured(requests: Any, effort: Any, jobs: int) -> dict[Request, Reading]:
        readings = {}
        for request in requests:
            keys = [key for key, _ in request.numbers]
            value = 1.0
            if request.conditions.to_data().get("distance_m") == 0.7:
                value = {"photons.read_noise_electrons": 1.06, "scatter.blur_px": 1.04}.get(
                    "".join(keys), 1.0
                )
            readings[request] = Reading(value)
        return readings

    monkeypatch.setattr(power, "measured", measured)
    hinges = tuple(hinge for hinge in power.HINGES if hinge.words in ("noise", "missing returns"))
    monkeypatch.setattr(power, "HINGES", hinges)
    path = tmp_path / "figures.yaml"
    path.write_text(FIGURES)
    words = untested(power_of(read_figures(path), [AZURE], 1))[AZURE]
    assert words["photons.read_noise_electrons"] == "noise, missing returns"
    assert words["scatter.blur_px"] == "none"
    assert words["scatter.stray_share"] == "not moved"


def test_the_table_states_both_moves(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = moved_with(tmp_path, monkeypatch, {"photons.band_nm": 1.3})
    (row,) = POWER.data([rows[f"{AZURE} photons.band_nm"]])
    assert row["constant"] == "photons.band_nm"
    assert (row["lowered"], row["raised"]) == (pytest.approx(14), pytest.approx(26))
    assert row["noticed_lowered"] == row["noticed_raised"] == ["bolt"]
    assert row["verdict"] == "noticed"


# ---- the file of untested constants


def test_the_file_of_untested_constants_names_constants_that_exist(tmp_path: Path) -> None:
    stored = stored_untested(camera_names())
    assert stored
    for camera, keys in stored.items():
        constants = {constant.key for constant in constants_of(camera)}
        assert set(keys) <= constants, camera
    path = tmp_path / "untested.yaml"
    path.write_text(untested_text(stored))
    assert read_yaml(path).data == stored


@pytest.mark.slow
def test_the_untested_constants_of_a_camera_are_those_on_file() -> None:
    (camera,) = ["pmd_flexx2"]
    results = power_of(read_figures(), [camera], 1)
    assert untested(results) == stored_untested([camera])
