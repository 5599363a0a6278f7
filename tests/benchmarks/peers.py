"""Peers of the frame loop and of the detector, in turns with ours on the same data, and how far they agree."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import Any
from unittest.mock import patch

import cv2
import numpy as np
from clocks import Times, in_turns
from numpy_camera import NumpyCamera
from peer_fits import CLUSTERS, FITS, Points, robust_sigma, same_partition

from detectors import load_detector
from detectors.average import AverageConfig, prefix_averages
from detectors.clusters import euclidean_clusters
from detectors.crop import crop
from harness.engine.trial import TrialTask
from harness.vocabulary.geometry import MM
from harness.vocabulary.seeds import random_stream
from scenes.sensor.amcw import ranging
from scenes.sensor.amcw.imager import AmcwImager
from scenes.sensor.normals import standard_normals
from scenes.sensor.source import SimulatedUnit

SAME_FRAME_M = 1e-4 * MM
"""Root mean square within which two frames are the same: at 0.8 m a float32 counts in steps of 0.6e-4 mm."""
OTHER_CODE = 1e-5
"""Of a unit phasor: rounding of the arithmetic is 2e-7, a sample with another code moves it by 1e-4 and more."""


@dataclass(frozen=True)
class Rival:
    """One line of a table: ``agreement`` in words."""

    name: str
    times: Times
    agreement: str


# ---------------------------------------------------------------- frames


def frame_loops(unit: SimulatedUnit, frames: int, runs: int) -> list[Rival]:
    """Captures of so many frames and their mean: times of a frame. Raises RuntimeError where the frames differ."""
    model = unit.model
    assert isinstance(model, AmcwImager)
    loop = NumpyCamera(model, unit.exposure)
    agreement = same_frames(unit, loop)
    capture = unit.capture(frames, 1)
    rng = np.random.default_rng(1)
    times = in_turns(
        {
            "tofpod": lambda: prefix_averages(capture, [frames], AverageConfig()),
            "plain NumPy": lambda: loop.mean(frames, rng),
        },
        runs,
        frames,
    )
    words = {"tofpod": "(and judges frames, counts reasons, keeps amplitudes and variances)", "plain NumPy": agreement}
    return [Rival(name, each, words[name]) for name, each in times.items()]


def same_frames(unit: SimulatedUnit, loop: NumpyCamera, frames: int = 5) -> str:
    """Both loops on the same normals, before rounding. Raises RuntimeError beyond `SAME_FRAME_M` or where the reasons
    of more than one pixel in ten thousand differ.

    A few samples in a million lie so near to the middle between two codes of the converter that the last bit decides:
    pixels whose window holds one are counted, not compared.
    """
    model, shape = unit.model, unit.exposure.shape
    assert isinstance(model, AmcwImager)
    squares, reasons, codes, flips, count = [], 0, 0, 0, 0
    for number in range(frames):
        normals = standard_normals(random_stream(number), unit.exposure.means.shape)
        z_m, reason = loop.frame(normals)
        with patch.object(ranging, "round_valid", lambda *_: None):
            ours = model.frame(unit.exposure, random_stream(number))
        rounded = model.frame(unit.exposure, random_stream(number)).z_m.ravel()
        apart = loop.phasors(normals)[0] - model.phasors(unit.exposure, random_stream(number))[0]
        other = (np.abs(apart) > OTHER_CODE).any(axis=(0, 1))
        touched = cv2.dilate(other.reshape(shape).astype(np.uint8), np.ones(loop.window.shape, np.uint8)).ravel() > 0
        both = (reason == 0) & (ours.reason.ravel() == 0)
        squares.append(np.mean((z_m - ours.z_m.ravel())[both & ~touched].astype(float) ** 2))
        reasons += int((reason != ours.reason.ravel()).sum())
        codes += int(other.sum())
        flips += int((np.abs(loop.rounded(z_m, reason) - rounded)[both] > unit.camera.z_step_m / 2).sum())
        count += reason.size
    rms_m = float(np.sqrt(np.mean(squares)))
    if rms_m > SAME_FRAME_M or reasons > count / 10_000:
        raise RuntimeError(f"the NumPy loop's frames differ: {rms_m / MM:.1e} mm, {reasons} of {count} reasons")
    return (
        f"same normals: rms {rms_m / MM:.1e} mm before rounding; of {count:,} pixels {reasons} have another reason,"
        f" {codes} another code, {flips} another rounded z"
    )


# ---------------------------------------------------------------- surface and clusters


@dataclass(frozen=True)
class Judged:
    """One averaged cloud as the detector sees it: cropped points, the threshold (in robust deviations), the distance
    that joins points."""

    points: Points
    threshold: float
    distance_m: float

    @classmethod
    def of(cls, unit: SimulatedUnit, task: TrialTask) -> Judged:
        """Of the damaged board of a trial."""
        import json

        (asked,) = task.points
        cloud = prefix_averages(unit.capture(asked.frames, 1), [asked.frames], asked.average)[asked.frames]
        settings: Any = load_detector(asked.detector, json.loads(asked.settings_json)).settings  # type: ignore[attr-defined]
        assert asked.threshold is not None
        points = Points.of(cloud.points_m[crop(cloud, settings.crop)])
        return cls(points, asked.threshold, settings.cluster_distance_mm * MM)

    def flagged(self, surface_z_m: np.ndarray, threshold: float) -> np.ndarray:
        """(n,) bool: points farther off a surface than the threshold times their own robust deviation about it."""
        off = np.abs(self.points.xyz_m[:, 2] - surface_z_m)
        return np.asarray(off > threshold * robust_sigma(off))


def surfaces(judged: Judged, runs: int) -> list[Rival]:
    """Robust surfaces through the same points: times, distance to ours, and the clusters that come of each."""
    fits: dict[str, Callable[[], np.ndarray]] = {name: partial(fit, judged.points) for name, (fit, _) in FITS.items()}
    with warnings.catch_warnings():
        # a fit that stops at its last iteration says so; its distance to ours is in the table
        warnings.simplefilter("ignore")
        times = in_turns(fits, runs)
        found = {name: fit() for name, fit in fits.items()}
    mine = {kind: found[f"tofpod {kind}"] for kind in ("LAR", "bisquare")}
    rivals = []
    for name, (_, kind) in FITS.items():
        rms_mm = float(np.sqrt(np.mean((found[name] - mine[kind]) ** 2))) / MM
        beside = "" if name.startswith("tofpod") else f"rms {rms_mm:.4f} mm from our {kind}; "
        rivals.append(Rival(name, times[name], beside + _findings(judged, found[name], mine[kind])))
    return rivals


def _findings(judged: Judged, surface_z_m: np.ndarray, ours_z_m: np.ndarray) -> str:
    """Clusters off a surface, and whether each shares points with exactly one of those off our surface."""
    theirs, ours = (
        np.where(kept := judged.flagged(z_m, judged.threshold), _spread(judged, kept), -1)
        for z_m in (surface_z_m, ours_z_m)
    )
    both = (theirs >= 0) & (ours >= 0)
    pairs = np.unique(np.stack([theirs[both], ours[both]]), axis=1).shape[1]
    same = pairs == theirs.max() + 1 == ours.max() + 1
    return f"{theirs.max() + 1} clusters of {(theirs >= 0).sum()} points, {'the same' if same else 'NOT the same'}"


def _spread(judged: Judged, kept: np.ndarray) -> np.ndarray:
    """(n,) the cluster of each kept point, anything elsewhere."""
    labels = np.zeros(kept.size, int)
    labels[kept] = euclidean_clusters(judged.points.xyz_m[kept], judged.distance_m)
    return labels


def clusters(judged: Judged, runs: int, threshold: float) -> tuple[int, list[Rival]]:
    """Points farther off our surface than a threshold, clustered: how many; times, and whether the groups are ours."""
    surface = FITS["tofpod LAR"][0](judged.points)
    points = np.ascontiguousarray(judged.points.xyz_m[judged.flagged(surface, threshold)])
    rivals = {name: partial(cluster, points, judged.distance_m) for name, cluster in CLUSTERS.items()}
    times = in_turns(rivals, runs)
    ours = rivals["tofpod"]()
    words = {
        name: f"{len(np.unique(labels))} clusters, {'the same' if same_partition(ours, labels) else 'NOT the same'}"
        for name, labels in ((name, rival()) for name, rival in rivals.items())
    }
    return len(points), [Rival(name, times[name], words[name]) for name in rivals]
