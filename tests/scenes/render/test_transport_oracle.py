"""mitransient's path tracer as an independent oracle: the same phasors, within its error."""

from __future__ import annotations

import warnings
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from harness.vocabulary.geometry import Lens
from scenes.optics import Optics, RenderConfig, footprint_of
from scenes.render.direct import direct_light
from scenes.render.indirect import PathWork, gather_in_pixels
from scenes.render.scene import lit_scene, load_mitsuba
from scenes.render.view import render_view
from scenes.sensor.camera import load_camera
from scenes.target.custom import TargetConfig
from scenes.target.mesh import TargetPart, build_target
from scenes.target.thesis import ThesisTargetConfig

CAMERA = load_camera("azure_kinect_nfov")
FREQUENCIES = CAMERA.frequencies_hz
BOUNCES = 6
RUNS = 8
BOTH = pytest.mark.parametrize(
    "histogram", [False, pytest.param(True, marks=pytest.mark.slow)], ids=["phasors", "histogram"]
)


def optics_of(
    width: int,
    height: int,
    focal_px: float,
) -> Optics:
    """A small lens and an emitter that shines in all directions alike, so that both programs have
    the same one."""
    lens = Lens(
        width,
        height,
        focal_px,
        focal_px,
        (width - 1) / 2,
        (height - 1) / 2,
    )
    return replace(
        CAMERA.optics,
        lens=lens,
        full_half_angle_deg=179.5,
        cutoff_half_angle_deg=180.0,
        margin_px=0,
    )


def its_phasors(lit, optics, paths, histogram):
    """(RUNS, f, h, w) from as many seeds, summed as phasors or from a time histogram."""
    pytest.importorskip("mitransient", exc_type=ImportError)
    from tests.validation.transport_oracle import BIN_M, oracle

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        starts = [-BIN_M * run / RUNS if histogram else None for run in range(RUNS)]
        tracers = [oracle(lit, optics, FREQUENCIES, histogram_from_m=start) for start in starts]
        return np.stack(
            [tracer.phasors(paths, seed, BOUNCES) for seed, tracer in enumerate(tracers)]
        )


def assert_agree(ours, theirs, here, largest_error):
    """Light over pixels, each turned back by our phase: the relative difference at each frequency,
    in strength (real) and phase (imaginary), lies within 5.4 standard errors (Student's t of 7
    degrees of freedom: alpha 1e-3 a number, 6e-3 a comparison) and 2e-5, our own noise; and the
    errors are below ``largest_error``."""
    strength = np.abs(ours[:, here])
    back = np.conj(ours[:, here]) / strength
    mean = (theirs[:, :, here] * back).mean(axis=2) / strength.mean(axis=1)
    turned = np.ascontiguousarray(mean - 1).view(float)
    error = turned.std(axis=0, ddof=1) / np.sqrt(RUNS)
    assert error.max() < largest_error
    assert (np.abs(turned.mean(axis=0)) < 5.4 * error + 2e-5).all()


@BOTH
def test_a_corner(histogram):
    def quad(name, corners, albedo):
        mesh = trimesh.Trimesh(np.array(corners, float), [[0, 1, 2], [0, 2, 3]], process=False)
        return TargetPart(name, mesh, albedo, np.full(3, 0.5))

    wall = quad("wall", [[-1, -1, 1], [1, -1, 1], [1, 0.2, 1], [-1, 0.2, 1]], 0.8)
    floor = quad("floor", [[-1, 0.2, 0], [1, 0.2, 0], [1, 0.2, 1], [-1, 0.2, 1]], 0.6)
    optics = optics_of(48, 36, 60.0)
    lit = lit_scene(load_mitsuba(), (wall, floor), optics)
    theirs = its_phasors(lit, optics, 128, histogram)
    region = optics.lens.whole
    slopes = optics.lens.region_slopes(region)
    direct = direct_light(
        lit, slopes, footprint_of(optics.lens, region, optics.beam_fwhm_rad), FREQUENCIES
    )
    light = gather_in_pixels(lit, direct.off_face, PathWork(FREQUENCIES, BOUNCES, seed=1), 512)
    ours = direct.phasor.reshape(3, -1).copy()
    ours[:, direct.off_face.pixel] += direct.off_face.share * light.mean(axis=0, dtype=complex)[:-1]
    ours = ours.reshape(3, *region.shape)
    share = np.abs(ours - direct.phasor).mean() / np.abs(ours).mean()
    assert share > 0.1
    assert_agree(ours, theirs, direct.surface == 0, 1e-3)
    assert_agree(ours, theirs, direct.surface == 1, 3e-3)


@BOTH
@pytest.mark.slow  # a long reference; the corner is the quick one
def test_inside_a_blind_hole(histogram):
    target = build_target(
        TargetConfig.from_data(
            {
                "name": "custom",
                "board": {"width_mm": 60, "height_mm": 60, "thickness_mm": 40},
                "holes": [
                    {
                        "id": 1,
                        "kind": "blind",
                        "diameter_mm": 24,
                        "depth_mm": 30,
                        "centre_mm": [0, 0],
                    }
                ],
                "pose": {"distance_m": 0.5, "tilt_x_deg": 8, "tilt_y_deg": -6},
                "backing": None,
                "room": None,
            }
        )
    )
    optics = optics_of(56, 56, 420.0)
    view = render_view(
        target,
        optics,
        RenderConfig(
            bounces=BOUNCES,
            hole_noise_mm=0.02,
            hole_samples=1024,
        ),
    )
    theirs = its_phasors(lit_scene(load_mitsuba(), target.parts, optics), optics, 160, histogram)
    theirs = theirs[:, :, view.region.row0 : view.region.row1, view.region.col0 : view.region.col1]
    inside = (view.range_m > 0.515) & (view.surface == 0)
    assert inside.sum() > 60
    assert (
        np.abs(view.phasor - view.phasor_direct)[:, inside].mean()
        > 0.1 * np.abs(view.phasor)[:, inside].mean()
    )
    assert_agree(view.phasor.astype(complex), theirs, inside, 1e-3)


@pytest.mark.slow
@BOTH
def test_the_thesis_scene(histogram):
    """The board in its room, through-holes before a backing 50 mm behind: the face, and what is
    seen in the holes.

    Without grain: at this resolution a pixel holds six texels across, of which our sub-rays meet
    four."""
    plain = {"name": "thesis", "backing_distance_mm": 50.0, "grain_contrast": 0.0}
    target = build_target(ThesisTargetConfig.from_data(plain).declare())
    optics = optics_of(192, 60, 190.0)
    config = RenderConfig(
        bounces=BOUNCES,
        face_samples=1 << 16,
        hole_noise_mm=0.03,
        hole_samples=1 << 14,
    )
    view = render_view(target, optics, config)
    theirs = its_phasors(lit_scene(load_mitsuba(), target.parts, optics), optics, 64, histogram)
    theirs = theirs[:, :, view.region.row0 : view.region.row1, view.region.col0 : view.region.col1]
    names = list(view.surface_names)
    face = (view.surface == names.index("board")) & (view.coverage == 1)
    share = (
        np.abs(view.phasor - view.phasor_direct)[:, face].mean()
        / np.abs(view.phasor[:, face]).mean()
    )
    assert share > 0.01
    assert_agree(view.phasor.astype(complex), theirs, face, 3e-4)
    middle = np.zeros(face.shape, bool)
    middle[8:-8, 8:-8] = True
    in_holes = (view.surface == names.index("backing")) & middle & (view.coverage == 1)
    assert in_holes.sum() >= 20
    assert_agree(view.phasor.astype(complex), theirs, in_holes, 3e-3)
