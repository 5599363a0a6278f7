"""Lens blur and noise by an infrared image: on images of known blur and noise, and on a real one."""

from __future__ import annotations

import numpy as np
import pytest

from detectors.recordings.opening import open_capture
from scenes.sensor.amcw.imager import scattered
from scenes.sensor.camera import camera_of, load_camera
from scenes.sensor.common.config import CameraConfig
from tests.validation.infrared import (
    HALF_LENGTH_PX,
    HALF_WIDTH_PX,
    LEVELS,
    SHARPEST,
    edge_pieces,
    electrons,
    fitted_piece,
    photon_transfer,
)

FINE = 40
"""Points along each side of a pixel, by which a sharp edge is averaged."""


def sharp_edge(height: int, width: int, slope: float) -> np.ndarray:
    """Return pixels (h, w) of 100 and 400 units at both sides of a sharp edge through the middle,
    which moves by ``slope`` pixels from row to row."""
    positions = (np.arange(FINE) + 0.5) / FINE - 0.5
    light = np.zeros((height, width))
    v, u = np.mgrid[:height, :width]
    for up in positions:
        for aside in positions:
            edge = width / 2 + slope * (v + up - height / 2)
            light += u + aside > edge
    return 100 + 300 * light / FINE**2


@pytest.mark.parametrize("slope", [0.03, 0.1, -0.3])
@pytest.mark.parametrize("blur_px", [0.3, 0.45, 0.6])
def test_the_blur_of_the_model_is_the_one_that_an_edge_shows(blur_px, slope):
    camera = camera_of(CameraConfig(numbers={"scatter.blur_px": blur_px}))
    height = 2 * HALF_LENGTH_PX + 11
    width = 2 * HALF_WIDTH_PX + 21
    image = scattered(sharp_edge(height, width, slope), camera.scatter)
    piece = fitted_piece(image, height // 2, width // 2)
    assert piece is not None
    # pixels know a blur of less than half a pixel from a few mixed pixels only
    assert piece.blur_px == pytest.approx(blur_px, abs=0.07)
    assert piece.dark_units == pytest.approx(100, abs=6)
    assert piece.bright_units == pytest.approx(400, abs=6)


def test_photon_transfer_gives_gain_and_read_noise_back():
    per_unit = 1.4
    read_noise = 3.2
    rng = np.random.default_rng(1)
    contrasts = (0.87, 0.88, 0.96)
    image = np.empty((1000, 100 * (len(LEVELS) - 1)))
    for number, level in enumerate(LEVELS[:-1]):
        # both wells' electrons, of which each of three frequencies has an amplitude
        both_wells = level * 1.1 / 0.9697 * per_unit / sum(contrasts)
        total = np.zeros((1000, 100))
        for contrast in contrasts:
            shot = rng.standard_normal((1000, 100, 3)) * np.sqrt(both_wells + 2 * read_noise**2)
            phases = 2 * np.pi * np.arange(3) / 3
            samples = (contrast * both_wells * np.cos(phases) + shot) / per_unit
            real = (samples * np.cos(phases)).sum(axis=-1)
            imaginary = (samples * np.sin(phases)).sum(axis=-1)
            total += 2 / 3 * np.hypot(real, imaginary)
        image[:, 100 * number : 100 * number + 100] = 0.9697 * total
    terms = photon_transfer(image)
    gain, noise = electrons(terms, sum(contrasts))
    assert gain == pytest.approx(per_unit, rel=0.1)
    assert noise == pytest.approx(read_noise, rel=0.15)


def test_the_camera_file_agrees_with_the_recording(shared_data):
    """The file's blur lies below what the sharpest edges show, and its range ends at what most of
    them show; its read noise is that of the image."""
    (frame,) = open_capture([shared_data / "azure_mkv" / "recording.mkv"]).frames()
    image = frame.amplitude.astype(float)
    camera = load_camera("azure_kinect_nfov")
    pieces = edge_pieces(np.ascontiguousarray(image[470:530, 285:555].T))
    blurs_px = np.sort([piece.blur_px for piece in pieces])
    sharpest_px = blurs_px[:SHARPEST].mean()
    assert sharpest_px == pytest.approx(0.49, abs=0.01)
    assert np.median(blurs_px) == pytest.approx(0.63, abs=0.03)
    blur = camera.scatter.blur_px
    assert blur.range[0] < blur.value < sharpest_px < blur.range[1] < np.median(blurs_px)
    per_unit, read_noise = electrons(photon_transfer(image), sum(camera.modulation.contrast.value))
    assert per_unit == pytest.approx(1.08, abs=0.02)
    assert read_noise == pytest.approx(3.8, abs=0.1)
    least, greatest = camera.photons.read_noise_electrons.range
    assert least < read_noise < greatest
