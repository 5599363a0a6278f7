"""The error that is left in holes with the default work, against a long reference."""

from __future__ import annotations

import numpy as np
import pytest

from scenes.optics import RenderConfig
from scenes.render.scene import lit_scene, load_mitsuba
from scenes.render.view import render_view
from scenes.sensor.camera import load_camera
from scenes.target.mesh import build_target
from scenes.target.thesis import ThesisTargetConfig
from tests.validation.transport import Scene, compared, face_parts, in_holes

pytestmark = pytest.mark.slow


def test_holes_before_a_backing_are_right_within_a_fifth_of_a_millimetre():
    """Some 60 pixels in through-holes 50 mm before a backing, 16,384 paths each in the reference:
    rms error (less the reference's own) below 0.25 mm (0.2 mm over all pixels; a sample of 60
    scatters by a tenth), mean within 4 standard errors. The reported noise tells the rms within 40
    %."""
    target = build_target(
        ThesisTargetConfig.from_data({"name": "thesis", "backing_distance_mm": 50.0}).declare()
    )
    optics = load_camera("azure_kinect_nfov").optics
    view = render_view(target, optics, RenderConfig(face_samples=1024, rest_samples=8))
    scene = Scene(
        target,
        optics,
        lit_scene(load_mitsuba(), target.parts, optics),
        view,
        0.0,
        0.0,
    )
    error = compared(scene, "holes", in_holes(scene), 1 << 14, 60)
    assert error.pixels >= 60
    assert error.rms_mm < 0.25
    assert abs(error.mean_mm) < 4 * error.mean_error_mm
    assert 0.6 < error.reported_mm / error.rms_mm < 1.4


def test_the_face_is_right_within_three_micrometres():
    """Some 30 pixels of the hole-free face, away from tape: 131,072 paths each in the reference,
    itself 1.5 um."""
    target = build_target(ThesisTargetConfig.from_data({"name": "thesis"}).declare().hole_free())
    optics = load_camera("azure_kinect_nfov").optics
    view = render_view(target, optics, RenderConfig(hole_samples=64, rest_samples=8))
    scene = Scene(
        target,
        optics,
        lit_scene(load_mitsuba(), target.parts, optics),
        view,
        0.0,
        0.0,
    )
    whole_pixels, _, _ = face_parts(scene)
    error = compared(scene, "face", whole_pixels, 1 << 17, 30)
    assert np.hypot(error.rms_mm, error.reference_mm) < 0.005
    assert error.rms_mm < 0.003
