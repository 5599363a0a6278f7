"""How deep a small hole looks through the beam: closed form, for the sensitivity to the beam's
width."""

from __future__ import annotations

import numpy as np
from scipy import stats

from harness.vocabulary.geometry import SPEED_OF_LIGHT_AIR
from scenes.optics import FWHM_PER_DEVIATION
from scenes.sensor.lidar.facts import MRAD, ScannedLidar
from scenes.sensor.lidar.kernels import strongest_peaks
from scenes.sensor.lidar.scanner import smear_weights


def share_in_disc(camera: ScannedLidar, diameter_m: float, distance_m: float) -> float:
    """Share of the light of a beam, aimed at the centre of a disc that faces it, that lands on the
    disc.

    A round Gaussian, smeared along the sweep by the integration. From an aim d deviations off
    centre a disc of radius r deviations gets the non-central chi-square distribution of d^2 with
    two degrees of freedom at r^2.
    """
    deviation_m = camera.beam.fwhm_mrad.value * MRAD / FWHM_PER_DEVIATION * distance_m
    weights = smear_weights(camera.integration_points)
    aims_m = (np.arange(len(weights)) - len(weights) // 2) * distance_m / camera.nominal_lens.fy
    radius = diameter_m / 2 / deviation_m
    return float(weights @ stats.ncx2.cdf(radius**2, 2, (aims_m / deviation_m) ** 2))


def hole_depth_seen_m(
    camera: ScannedLidar, diameter_m: float, depth_m: float, distance_m: float
) -> float:
    """Depth that the centre of a blind hole shows in a face at ``distance_m``, before the device's
    smoothing.

    The strongest peak of the correlation of both returns, which a beam's footprint mixes. Left
    out: the hole's wall, the shadow that its rim throws on its floor for the receiver, and the
    light between wall and floor.
    """
    share = share_in_disc(camera, diameter_m, distance_m)
    wave = 2 * np.pi * np.array(camera.optics.frequencies_hz) / SPEED_OF_LIGHT_AIR
    floor_m = distance_m + depth_m
    mixed = (1 - share) * np.exp(2j * wave * distance_m) + share * (
        distance_m / floor_m
    ) ** 2 * np.exp(2j * wave * floor_m)
    delay = strongest_peaks(mixed[:, None], camera.weights).delay[0, 0]
    return float(delay * camera.unambiguous_m - distance_m)
