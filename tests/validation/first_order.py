"""Frames from the first-order model against frames of the whole chain on rendered thesis boards, a
table of ratios: minutes.

Run ``python tests/validation/first_order.py --frames 1000``. For each camera and board it renders
the view, draws that many frames either way, and prints for even, uneven and listed pixels (see
`scenes.sensor.amcw.first_order`) the ratios, first order over whole chain, of the variances of z
and of the amplitude and of the share of z beyond three deviations; the correlation of z with
neighbours both ways; and the differences of means and of the share of valid samples in standard
errors, root mean square over pixels (1 where there is none) and largest.
"""

from __future__ import annotations

import argparse
import sys

import numpy as np

from harness.vocabulary.seeds import random_stream
from scenes.optics import RenderConfig
from scenes.render.view import render_view
from scenes.sensor.amcw.first_order import FirstOrder
from scenes.sensor.camera import camera_of
from scenes.sensor.common.config import CameraConfig
from scenes.sensor.source import SimulatedUnit
from scenes.target.mesh import build_target
from scenes.target.thesis import ThesisTargetConfig

RENDER = RenderConfig(bounces=2, face_samples=4096, hole_noise_mm=0.5, hole_samples=1024)
"""Light enough that a view takes seconds; both ways see the same."""
BOARDS: dict[str, dict[str, object] | None] = {
    "flat": None,
    "blind": {"hole_kind": "blind"},
    "20 mm": {"backing_distance_mm": 20.0},
    "200 mm": {"backing_distance_mm": 200.0},
    "none": {"backing_distance_mm": None},
}
LAGS = (1, 2, 3, 4)
LOOSE = 0.02  # variance of validity from which a pixel may have a range or not


def unit_before(name: str, board: str) -> SimulatedUnit:
    """Return a unit before the thesis' board with holes of a kind."""
    chosen = BOARDS[board]
    target = ThesisTargetConfig.model_validate(chosen or {}).declare()
    config = CameraConfig(name=name)
    camera = camera_of(config)
    view = render_view(
        build_target(target if chosen else target.hole_free()), camera.optics, RENDER
    )
    return SimulatedUnit(camera, config, view)


def drawn(unit: SimulatedUnit, model: FirstOrder | None, count: int) -> np.ndarray:
    """Return z and amplitudes (2, count, h, w) of frames of ``model`` or, without, of the whole
    chain."""
    rng = random_stream(1, "first order" if model else "whole chain")
    frames = []
    for _ in range(count):
        if model is None:
            frame = unit.model.frame(unit.exposure, rng, 0.0)
        else:
            frame = model.frame(rng, 0.0)
        frames.append([frame.z_m[unit.cut], frame.amplitude[unit.cut]])
    return np.array(frames).swapaxes(0, 1)


def correlations(z_m: np.ndarray, pixels: np.ndarray) -> list[float]:
    """Return the median correlation of z (k, h, w) with that of pixels `LAGS` columns away."""
    noise = z_m - z_m.mean(axis=0)
    medians = []
    for lag in LAGS:
        pairs = pixels[:, lag:] & pixels[:, :-lag]
        first = noise[:, :, lag:][:, pairs]
        second = noise[:, :, :-lag][:, pairs]
        power = np.sqrt((first**2).mean(axis=0) * (second**2).mean(axis=0))
        values = (first * second).mean(axis=0) / np.maximum(power, 1e-12)
        medians.append(float(np.median(values)) if pairs.any() else np.nan)
    return medians


def separation(first: np.ndarray, second: np.ndarray) -> str:
    """Return how far means over frames (k, n) are apart in standard errors: root mean square and
    largest."""
    variance = first.var(axis=0, ddof=1) + second.var(axis=0, ddof=1)
    error = np.sqrt(variance / len(first))
    off = (first.mean(axis=0) - second.mean(axis=0)) / np.maximum(error, 1e-12)
    if off.size == 0:
        return "-"
    return f"{np.sqrt((off**2).mean()):.2f}, {np.abs(off).max():.1f}"


def row(pixels: np.ndarray, whole: np.ndarray, first_order: np.ndarray) -> str:
    """Return a group's line of the table."""
    valid = np.isfinite(whole[0]).all(axis=0) & np.isfinite(first_order[0]).all(axis=0)
    always = pixels & valid
    if not always.any():
        return f"{pixels.sum():6d} | no pixel has a range in every frame"
    noises = []
    for frames in (whole, first_order):
        noises.append(frames[:, :, always] - frames[:, :, always].mean(axis=1, keepdims=True))
    variances = [(noise**2).mean(axis=1) for noise in noises]
    deviation = np.sqrt((variances[0][0] + variances[1][0]) / 2)
    beyond = [(np.abs(noise[0]) > 3 * deviation).mean() for noise in noises]
    ratio_of_z, ratio_of_amplitude = np.median(variances[1] / variances[0], axis=1)
    lags = []
    pairs = zip(correlations(whole[0], always), correlations(first_order[0], always), strict=True)
    for of_whole, of_first_order in pairs:
        lags.append(f"{of_whole:.2f}/{of_first_order:.2f}")
    samples = [np.isfinite(frames[0]).astype(float) for frames in (whole, first_order)]
    loose = pixels & (np.minimum(samples[0].var(axis=0), samples[1].var(axis=0)) > LOOSE)
    return (
        f"{always.sum():6d} | {ratio_of_z:.3f} | {ratio_of_amplitude:.3f} | "
        f"{beyond[1] / max(beyond[0], 1e-12):.2f} | {' '.join(lags)} | "
        f"{separation(whole[0][:, always], first_order[0][:, always])} | "
        f"{separation(samples[0][:, loose], samples[1][:, loose])}"
    )


def main(arguments: list[str]) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(
        prog="python tests/validation/first_order.py", description=__doc__
    )
    parser.add_argument("--frames", type=int, default=1000)
    parser.add_argument("--cameras", nargs="+", default=["azure_kinect_nfov", "kinect_v2"])
    parser.add_argument("--boards", nargs="+", default=list(BOARDS), choices=list(BOARDS))
    options = parser.parse_args(arguments)
    print(
        "camera, board, pixels | variance of z | of amplitude | beyond 3 | lags 1 to 4 | mean | "
        "valid"
    )
    for name in options.cameras:
        for board in options.boards:
            unit = unit_before(name, board)
            model = unit.first_order
            if model is None:
                print(f"{name}, {board}: whole frames cost less", flush=True)
                continue
            complete = drawn(unit, None, options.frames)
            first_order = drawn(unit, model, options.frames)
            is_uneven = np.zeros(model.shape, bool)
            is_uneven.ravel()[model.linear.uneven] = True
            is_linear = model.linear.is_linear.reshape(model.shape)
            groups = {
                "even": is_linear & ~is_uneven,
                "uneven": is_uneven,
                "listed": ~is_linear,
            }
            for group, pixels in groups.items():
                line = row(pixels[unit.cut], complete, first_order)
                print(f"{name}, {board}, {group} {line}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
