"""A scanner's beam as a footprint, and many frequencies at once."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.special import ndtr

from harness.vocabulary.geometry import SPEED_OF_LIGHT_AIR, Lens, Region
from scenes.optics import FWHM_PER_DEVIATION, Beams, Optics, RenderConfig, footprint_of
from scenes.render.direct import added, comb_step, direct_light
from scenes.render.scene import lit_scene, load_mitsuba
from scenes.render.view import render_view
from scenes.target.custom import TargetConfig
from scenes.target.mesh import TargetPart, build_target

LENS = Lens(
    width=400,
    height=300,
    fx=800.0,
    fy=800.0,
    cx=199.5,
    cy=149.5,
)
DEVIATION_RAD = 1.2e-3
BEAM = DEVIATION_RAD * FWHM_PER_DEVIATION
COMB = tuple(20e6 * k for k in range(1, 33))
OPTICS = Optics(
    title="a scanner",
    lens=LENS,
    emitter_m=np.array([0.01, 0.0, 0.0]),
    full_half_angle_deg=80.0,
    cutoff_half_angle_deg=85.0,
    frequencies_hz=COMB,
    beam_fwhm_rad=BEAM,
    wavelength_nm=850.0,
    margin_px=0,
)


def part(
    name: str,
    corners: list[list[float]],
    albedo: float = 0.5,
) -> TargetPart:
    mesh = trimesh.Trimesh(np.array(corners), [[0, 1, 2], [0, 2, 3]], process=False)
    return TargetPart(name, mesh, albedo, np.full(3, 0.5))


def half_plane(angle_rad: float, edge: float) -> TargetPart:
    """At z = 1, all slopes s with s . (cos, sin) < edge."""
    along = np.array([np.cos(angle_rad), np.sin(angle_rad)])
    across = np.array([-along[1], along[0]])
    corners = [
        edge * along + a * along + b * across for a, b in ((0, -1), (0, 1), (-2, 1), (-2, -1))
    ]
    return part("plate", [[*corner, 1.0] for corner in corners])


@pytest.mark.parametrize("angle_deg", [0.0, 17.0, 45.0, 90.0, 133.0])
def test_a_knife_edge_takes_the_gaussians_cumulative_shares(angle_deg):
    """Light and coverage of beams around a plate's edge are Phi, in any direction, within 5
    sub-rays of 256."""
    angle = np.deg2rad(angle_deg)
    lit = lit_scene(load_mitsuba(), (half_plane(angle, 0.0),), OPTICS)
    region = Region(143, 157, 193, 207)
    slopes = LENS.region_slopes(region)
    light = direct_light(lit, slopes, footprint_of(LENS, region, BEAM), COMB[:3])
    distance = -(slopes @ [np.cos(angle), np.sin(angle)])
    share = ndtr(distance / DEVIATION_RAD)
    full = 0.5
    assert np.abs(light.intensity / full - share).max() < 0.02
    inside = distance > 1e-9
    assert np.abs(light.coverage[inside] - share[inside]).max() < 0.02
    assert np.abs(light.intensity / full - share).mean() < 0.004


def test_an_oblique_beam_is_round_in_angle():
    """At the field's corner: the spread of directions is the same in every direction across the
    beam."""
    region = Region(0, 2, 0, 2)
    beams = Beams(LENS, region, DEVIATION_RAD)
    slopes = beams.slopes(np.zeros(1, int), np.zeros(1, int), beams.lattice())[0]
    rays = np.column_stack([slopes, np.ones(len(slopes))])
    rays /= np.linalg.norm(
        rays,
        axis=1,
        keepdims=True,
    )
    centre = np.append(LENS.region_slopes(region)[0, 0], 1.0)
    centre /= np.linalg.norm(centre)
    off = rays - centre * (rays @ centre)[:, None]
    spread = np.sqrt(np.sort(np.linalg.eigvalsh(off.T @ off / 256))[1:])
    assert spread == pytest.approx(DEVIATION_RAD, rel=0.02)
    assert np.linalg.norm(off.mean(axis=0)) < 0.01 * DEVIATION_RAD


def test_a_step_between_two_planes_mixes_phasors_by_the_beams_shares():
    plate = half_plane(0.0, 0.0)
    far = part("far", [[-3, -3, 1.3], [3, -3, 1.3], [3, 3, 1.3], [-3, 3, 1.3]])
    centred = replace(OPTICS, emitter_m=np.zeros(3))
    region = Region(148, 152, 195, 205)
    slopes = LENS.region_slopes(region)
    whole_plate = part("n", [[-3, -3, 1], [3, -3, 1], [3, 3, 1], [-3, 3, 1]])

    def phasors(*parts: TargetPart) -> np.ndarray:
        lit = lit_scene(load_mitsuba(), parts, centred)
        return direct_light(lit, slopes, footprint_of(LENS, region, BEAM), COMB).phasor

    near_light = phasors(whole_plate)
    share = ndtr(-slopes[..., 0] / DEVIATION_RAD)
    expected = share * near_light + (1 - share) * phasors(far)
    assert np.abs(phasors(plate, far) - expected).max() < 0.02 * np.abs(near_light).max()


@settings(max_examples=20, deadline=None)
@given(st.integers(4, 40), st.floats(1e6, 5e7), st.floats(0, 2e8), st.integers(1, 40))
def test_a_comb_is_summed_as_its_lines_one_by_one(
    lines,
    step,
    offset,
    m,
):
    """In float32, whose unit roundoff is 6e-8: within the rounding of the phase, and of the
    recurrence. In each of its steps, a complex product errs by at most sqrt(5) units, and the
    step's own sine and cosine by sqrt(2)."""
    comb = tuple(offset + step * k for k in range(1, lines + 1))
    assert comb_step(comb) == pytest.approx(step, rel=1e-6)
    rng = np.random.default_rng(lines)
    mi = load_mitsuba()
    amplitude = rng.random(m).astype(np.float32)
    path = (3 + rng.random(m)).astype(np.float32)
    totals = added([mi.Float(0.0)] * (2 * lines + 1), mi.Float(amplitude), mi.Float(path), comb)
    sums = np.stack([total.numpy() for total in totals])
    phasors = sums[:-1:2] + 1j * sums[1::2]
    phase = 2 * np.pi * np.array(comb)[:, None] / SPEED_OF_LIGHT_AIR * path
    rounding = 2e-7 * (1 + np.abs(phase).max()) + lines * (np.sqrt(5) + np.sqrt(2)) * 6e-8
    assert np.abs(phasors - amplitude * np.exp(1j * phase)).max() < rounding
    assert np.array_equal(sums[-1], amplitude)


def test_uneven_frequencies_are_no_comb():
    assert comb_step((198e6, 189e6, 54e6)) is None
    assert comb_step((1e6, 2e6, 3e6, 4.1e6)) is None
    assert comb_step((1e6, 2e6, 3e6)) is None


def test_a_comb_may_be_uneven_by_a_billionth_of_its_highest_frequency():
    thirds = tuple(1e6 * k / 3 for k in range(8))
    assert comb_step(thirds) == pytest.approx(1e6 / 3)
    # of four lines, the last moved by d is 2 / 3 d off the mean step
    assert comb_step((1e6, 2e6, 3e6, 4e6 + 5.9e-3)) == pytest.approx(1e6)
    assert comb_step((1e6, 2e6, 3e6, 4e6 + 6.1e-3)) is None


@pytest.mark.slow  # a long reference
def test_a_whole_view_of_a_comb_agrees_with_its_lines_alone():
    """Indirect light by the recurrence in float32 against the same paths with separate sines: 1e-5
    of the light."""
    target = build_target(
        TargetConfig.from_data(
            {
                "name": "custom",
                "board": {"width_mm": 60, "height_mm": 50, "thickness_mm": 12},
                "holes": [
                    {
                        "id": 1,
                        "kind": "through",
                        "diameter_mm": 20,
                        "centre_mm": [0, 0],
                    }
                ],
                "backing": {"distance_mm": 20},
                "room": None,
                "pose": {"distance_m": 0.5, "tilt_x_deg": 5, "tilt_y_deg": 0},
            }
        )
    )
    config = RenderConfig(
        face_samples=64,
        hole_samples=32,
        rest_samples=16,
        bounces=4,
    )  # as many paths for both
    comb = render_view(target, OPTICS, config)
    chosen = [0, 9, 31]
    lines = render_view(
        target, replace(OPTICS, frequencies_hz=tuple(COMB[k] for k in chosen)), config
    )
    assert comb.phasor.dtype == np.complex64
    indirect = np.abs(lines.phasor - lines.phasor_direct)
    assert indirect.max() > 0.01
    assert np.abs(comb.phasor[chosen] - lines.phasor).max() < 1e-5 * lines.intensity.max()
    # light is what it is at every frequency
    assert (np.abs(comb.phasor) <= comb.intensity * (1 + 1e-4) + 1e-9).all()
