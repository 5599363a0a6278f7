"""Averages drawn at once against averages of frames on rendered thesis boards, a table of ratios:
minutes.

Run ``python tests/validation/at_once.py --captures 400``. For each camera and board it renders the
view, draws that many averages of 50 frames either way, and prints for even, uneven and listed
pixels (see `scenes.sensor.amcw.at_once`) the ratios, at once over frame by frame, of the variance
of z between captures, of the sample variance and of the share beyond three deviations; the
correlation with neighbours both ways; and the mean's and the count's difference in standard
errors, root mean square over pixels (1 where there is none) and largest. Whole-frame errors are
off, as they are drawn the same way in both.
"""

from __future__ import annotations

import argparse
import sys

import numpy as np

from detectors.averages.average import AverageConfig
from harness.trials.averages import averages_of
from scenes.optics import RenderConfig
from scenes.render.view import render_view
from scenes.sensor.amcw.at_once import EVEN, UNEVEN, AtOnce
from scenes.sensor.camera import camera_of
from scenes.sensor.common.config import CameraConfig, EffectsConfig
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
FRAMES = 50


def unit_before(name: str, board: str) -> SimulatedUnit:
    """A unit before the thesis' board with holes of a kind."""
    chosen = BOARDS[board]
    target = ThesisTargetConfig.model_validate(chosen or {}).declare()
    camera = camera_of(CameraConfig(name=name))
    config = CameraConfig(name=name, effects=EffectsConfig(frame_jumps=False))
    view = render_view(
        build_target(target if chosen else target.hole_free()), camera.optics, RENDER
    )
    return SimulatedUnit(camera, config, view)


def drawn(
    unit: SimulatedUnit, captures: int, exact: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """z, count and sample variance (captures, h, w) of averages."""
    clouds = [
        averages_of(
            unit.capture(FRAMES, 1, number, int(exact)), [FRAMES], AverageConfig(), exact=exact
        )[FRAMES]
        for number in range(captures)
    ]
    z_m = np.stack([cloud.points_m[..., 2] for cloud in clouds])
    count = np.stack([cloud.count for cloud in clouds])
    return z_m, count, np.stack([cloud.variance_m2 for cloud in clouds])


def row(pixels: np.ndarray, frames: tuple[np.ndarray, ...], at_once: tuple[np.ndarray, ...]) -> str:
    """A group's line of the table."""
    reference = pixels & np.isfinite(frames[0]).all(axis=0) & np.isfinite(at_once[0]).all(axis=0)
    z = [one[0] - one[0].mean(axis=0) for one in (frames, at_once)]
    variances = [one[:, reference].var(axis=0, ddof=1) for one in z]
    deviation = np.sqrt(sum(variances) / 2)
    error = np.sqrt(sum(variances) / len(z[0]))
    off = (frames[0][:, reference].mean(axis=0) - at_once[0][:, reference].mean(axis=0)) / error
    beyond = [(np.abs(one[:, reference]) > 3 * deviation).mean() for one in z]
    inner = [np.nanmean(one[2][:, reference]) for one in (frames, at_once)]
    lags = []
    for lag in (1, 2, 3, 4):
        pairs = reference[:, lag:] & reference[:, :-lag]
        each = [
            np.median((one[:, :, lag:] * one[:, :, :-lag])[:, pairs].mean(axis=0)
            / np.sqrt(one[:, :, lag:][:, pairs].var(axis=0) * one[:, :, :-lag][:, pairs].var(axis=0)))
            if pairs.any() else np.nan for one in z
        ]  # fmt: skip
        lags.append("{:.2f}/{:.2f}".format(*each))
    scatter = [one[1][:, pixels].astype(float) for one in (frames, at_once)]
    loose = np.minimum(*(one.var(axis=0) for one in scatter)) > 0.5
    counts = "-"
    if loose.any():
        errors = np.sqrt(
            sum(one[:, loose].var(axis=0, ddof=1) for one in scatter) / len(scatter[0])
        )
        separation = (
            scatter[0][:, loose].mean(axis=0) - scatter[1][:, loose].mean(axis=0)
        ) / errors
        counts = f"{np.sqrt((separation**2).mean()):.2f}, {np.abs(separation).max():.1f}"
    return (
        f"{reference.sum():6d} | {np.median(variances[1] / variances[0]):.3f} | "
        f"{inner[1] / inner[0]:.3f} |"
        f" {beyond[1] / max(beyond[0], 1e-12):.2f} | {' '.join(lags)} |"
        f" {np.sqrt((off**2).mean()):.2f}, {np.abs(off).max():.1f} | {counts}"
    )


def main(arguments: list[str]) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python tests/validation/at_once.py", description=__doc__)
    parser.add_argument("--captures", type=int, default=400)
    parser.add_argument("--cameras", nargs="+", default=["azure_kinect_nfov", "kinect_v2"])
    parser.add_argument("--boards", nargs="+", default=list(BOARDS), choices=list(BOARDS))
    options = parser.parse_args(arguments)
    print(
        (
            "camera, board, pixels | variance | sample variance | beyond 3 | lags 1 to 4 | mean "
            "| count"
        )
    )
    for name in options.cameras:
        for board in options.boards:
            unit = unit_before(name, board)
            summer = unit.at_once
            assert isinstance(summer, AtOnce)
            frames = drawn(unit, options.captures, True)
            at_once = drawn(unit, options.captures, False)
            kind = summer.linear.kind.reshape(unit.exposure.shape)[unit.cut]
            for group, pixels in (
                ("even", kind == EVEN),
                ("uneven", kind == UNEVEN),
                (
                    "listed",
                    np.isin(np.arange(summer.linear.z.size), summer.listed).reshape(summer.shape)[
                        unit.cut
                    ],
                ),
            ):
                print(f"{name}, {board}, {group} {row(pixels, frames, at_once)}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
