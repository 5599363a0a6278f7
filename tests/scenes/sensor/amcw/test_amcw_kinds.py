"""A further continuous-wave imager needs a file of numbers and nothing else."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
import pytest
from ruamel.yaml import YAML

from harness.vocabulary.errors import UserError
from harness.vocabulary.geometry import Reason, Region
from scenes.closed_form import plane_view
from scenes.sensor.amcw import kernels
from scenes.sensor.amcw.facts import WIDEST_PX, AmcwCamera
from scenes.sensor.camera import load_camera, read_camera
from scenes.sensor.common.config import NO_EFFECTS, CameraConfig
from scenes.sensor.source import SimulatedUnit
from tests.support.sensor_frames import first_frame, true_z_m, z_of

MIDDLE = Region(90, 150, 120, 200)


def fact(value: Any) -> dict[str, Any]:
    return {"value": value, "tag": "M", "source": "made up for a test"}


def fourth_camera(**changes: Any) -> dict[str, Any]:
    """A small imager: one frequency, four phases, a linear converter, no lens distortion, no gate
    that can be left out; ``changes`` are dotted paths (with double underscores for dots) to other
    facts, or None for none."""
    data = copy.deepcopy(load_camera("azure_kinect_nfov").to_data())
    data |= {"name": "fourth", "title": "A fourth camera"}
    optional = (
        "edge_threshold",
        "lattice_residual_turns",
        "amplitude_ratio",
        "min_reflectivity_units_mm2",
    )
    numbers: dict[str, Any] = {
        "lens__width_px": 320,
        "lens__height_px": 240,
        "lens__fx_px": 250.0,
        "lens__fy_px": 250.0,
        "lens__cx_px": 159.5,
        "lens__cy_px": 119.5,
        "lens__distortion": [],
        "modulation__frequencies_hz": [20.0e6],
        "modulation__phases": 4,
        "modulation__contrast": [0.5],
        "modulation__wiggling_residual": [0.1],
        "photons__signal_electrons": 50_000.0,
        "photons__electrons_per_unit": 0.1,
        "scatter__blur_px": 0.0,
        "converter__knee_units": 2**20,
        "converter__full_scale_units": 2**20,
        "engine__window_px": 3,
        "engine__dim_amplitude_units": 0.0,
        "engine__amplitude_gains": [1.0],
        "engine__max_range_mm": 7000.0,
        **dict.fromkeys((f"engine__{gate}" for gate in optional), None),
        "emitter__mask_slopes": None,
        **changes,
    }
    for path, value in numbers.items():
        section, key = path.split("__")
        data[section][key] = None if value is None else fact(value)
    return data


def read(data: dict[str, Any], folder) -> AmcwCamera:
    """The camera by way of its file."""
    path = folder / "fourth.yaml"
    with path.open("w") as file:
        YAML(typ="safe", pure=True).dump(data, file)
    camera = read_camera(path)
    assert isinstance(camera, AmcwCamera)
    return camera


def quiet(**effects: bool) -> CameraConfig:
    return CameraConfig(effects=NO_EFFECTS.model_copy(update=effects))


TWO = {
    "modulation__frequencies_hz": [100.0e6, 20.0e6],
    "modulation__phases": 5,
    "modulation__contrast": [0.4, 0.5],
    "modulation__wiggling_residual": [0.0, 0.0],
    "engine__amplitude_gains": [1.2, 1.0],
    "engine__fusion": "least_squares",
    "engine__spatial_sigma_px": 1.0,
    "engine__filter_on": "phasors",
    "lens__distortion": [0.05, -0.1, 0.001, 0.0],
}


@pytest.mark.parametrize("changes", [{}, TWO], ids=["one frequency", "two frequencies"])
@pytest.mark.parametrize("distance_m", [0.6, 3.1, 6.7])
def test_noise_free_range_is_exact(changes, distance_m, tmp_path):
    camera = read(fourth_camera(**changes), tmp_path)
    unit = SimulatedUnit(
        camera,
        quiet(),
        plane_view(
            camera,
            MIDDLE,
            distance_m,
            0.6,
            0.05,
            0.02,
        ),
    )
    frame = first_frame(unit)
    truth = true_z_m(unit)
    assert (frame.reason == Reason.VALID).all()
    # the output's half millimetre, the converter's rounding (1 in 3,000 at 6.7 m, 1.2 m a radian)
    # and the window
    assert np.abs(frame.z_m - truth).max() < 0.5e-3 + (0.05e-3 if distance_m < 6 else 0.2e-3)


def test_no_wrap_counts_is_no_range_though_the_camera_has_no_gate_on_the_lattice(tmp_path):
    """At the end of what two frequencies tell apart, noise carries phases beyond it."""
    camera = read(
        fourth_camera(**TWO, engine__lattice_residual_turns=None, engine__max_range_mm=20_000.0),
        tmp_path,
    )
    reach_m = 299_702_547 / (2 * 20e6)
    unit = SimulatedUnit(camera, quiet(noise=True), plane_view(camera, MIDDLE, reach_m - 0.02, 0.6))
    frame = first_frame(unit)
    assert (frame.reason == Reason.UNWRAP).mean() > 0.1
    # noise that carries both phases beyond the reach makes a short range, as in a real camera;
    # nothing lies between
    valid = frame.z_m[frame.reason == Reason.VALID]
    assert ((valid > 0.5) & (valid < reach_m - 0.2)).mean() < 0.002


def test_noise_follows_the_closed_form_for_any_number_of_phases(tmp_path):
    """sigma_z = c / 4 pi f sqrt(2/N) sqrt(Ns + 2 s^2) / (C Ns), by 3 for the box of 3x3; 60
    frames: 3 %."""
    for phases in (3, 4, 7):
        camera = read(fourth_camera(modulation__phases=phases, engine__concentration=0.0), tmp_path)
        unit = SimulatedUnit(
            camera,
            quiet(noise=True),
            plane_view(
                camera,
                MIDDLE,
                1.0,
                0.6,
                0.05,
                0.02,
            ),
        )
        z = z_of(unit, 60)
        electrons = 50_000.0 * 0.6
        noise = np.sqrt(electrons + 2 * 3.2**2)
        phase = np.sqrt(2 / phases) * noise / (0.5 * electrons)
        metres_per_radian = 299_702_547 / (4 * np.pi * 20e6)
        rounding_m = 1e-3 / np.sqrt(12)
        expected = np.hypot(metres_per_radian * phase / 3, rounding_m)
        # the lens gathers up to 3 % less beside the axis
        assert z.std(axis=0, ddof=1).mean() == pytest.approx(expected, rel=0.03)


@pytest.mark.parametrize(
    ("changes", "wanted"),
    [
        ({"modulation__frequencies_hz": [1e6, 2e6, 3e6, 4e6]}, "4 frequencies_hz"),
        (
            {"modulation__contrast": [0.5, 0.5]},
            "contrast needs one value for each of the 1 frequencies_hz",
        ),
        ({"modulation__phases": 2}, "3 or more"),
        (TWO | {"modulation__frequencies_hz": [100e6, 100e6]}, "all different"),
        ({"modulation__contrast": [0.0]}, "above 0 and at most 1"),
        ({"engine__window_px": 1001}, "an odd number from 1 to 31"),
        ({"lens__distortion": [0.0, 0.0, 0.9, 0.0]}, "distortion folds the image"),
        (
            {"emitter__mask_slopes": [[0.0, 0.0], [1.0, 1.0]]},
            "mask_slopes must be the corners of a convex polygon",
        ),
        (
            {"emitter__full_half_angle_deg": 80.0},
            "cutoff_half_angle_deg must be above full_half_angle_deg",
        ),
        (TWO | {"modulation__frequencies_hz": [100e6, 161.80339887e6]}, "share no base frequency"),
        ({"engine__amplitude_gains": [1.0, 1.0]}, "engine.amplitude_gains needs one value"),
        ({"engine__window_px": 4}, "an odd number"),
        ({"engine__fusion": "median"}, "fusion"),
        ({"engine__min_range_mm": 8000.0}, "less than max_range_mm"),
        ({"lens__width_px": 4000, "lens__cx_px": 2000.0}, "lens.width_px is 4000"),
    ],
)
def test_impossible_numbers_are_named(changes, wanted, tmp_path):
    with pytest.raises(UserError) as caught:
        read(fourth_camera(**changes), tmp_path)
    assert wanted in str(caught.value)
    assert "fourth.yaml" in str(caught.value)


def test_the_widest_row_is_the_one_that_the_filter_holds():
    assert WIDEST_PX == kernels.STRIDE
