"""Stated probabilities of noise against the observed share of false findings, a table: some 10
minutes on one free core.

Run ``python tests/validation/odds.py [--captures 40]``. Each capture is a plane with noise of one
kind and reach, averaged over frames with a pattern that all frames share, and with 0 to 8 holes and
bumps of random size and depth, of which many are as faint as noise. `detectors.findings.null` sets
the threshold for 3 false calls; a finding is false if none of its pixels lies within 2 pixels of a
damage. Expected is the sum of the stated probabilities; the last columns are by the stated
probability.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
from scipy import ndimage

from detectors import load_detector
from detectors.findings.null import own_threshold
from detectors.findings.odds import noise_probabilities
from detectors.interface import Detector
from harness.inspection.judging import null_facts
from harness.vocabulary.geometry import Cloud, Region

PITCH_M = 2e-3
DISTANCE_M = 0.7
SIGMA_M = 1e-3
SHAPE = (130, 170)
MARGIN_PX = 2
WANTED = 3.0
MOST_DAMAGES = 8
BUMPS = 0.1  # share of damages towards the camera, which the null takes for noise
EDGES = (0.0, 0.05, 0.2, 0.5, 0.8, 1.0)
"""Ends of the classes of stated probability."""
Noise = Callable[[np.random.Generator, tuple[int, ...]], np.ndarray]
NOISES: dict[str, Noise] = {
    "normal": lambda random, shape: random.normal(size=shape),
    "Laplace": lambda random, shape: random.laplace(size=shape) / np.sqrt(2.0),
    "Student's t": lambda random, shape: random.standard_t(4, size=shape) / np.sqrt(2.0),
}
REACHES_PX = (1, 3, 7)
"""Sides of the square over which a camera's filter blurs noise and damage."""
FRAMES = (1, 10)
DETECTORS = ("matched", "local")


@dataclass(frozen=True)
class Case:
    """One kind of capture."""

    noise: str
    """Key of `NOISES`."""
    reach_px: int
    """Side of the square over which noise is blurred."""
    frames: int
    """Number of frames in the average."""


@dataclass(frozen=True)
class Judgement:
    """The findings of one capture."""

    probability: np.ndarray
    """(n,): stated probability of being false."""
    is_false: np.ndarray
    """(n,) bool."""
    expected: float
    """False calls expected at the threshold."""


def capture(case: Case, seed: int) -> tuple[Cloud, np.ndarray]:
    """Return an average of frames and where it is damaged, (h, w) bool."""
    random = np.random.default_rng([29, seed])
    frames_m = NOISES[case.noise](random, (case.frames, *SHAPE)).mean(axis=0)
    fixed_m = 0.3 * random.normal(size=SHAPE)
    offset_m = SIGMA_M * _blurred(frames_m + fixed_m, case.reach_px) * case.reach_px
    deviation_m = float(offset_m.std())
    rows, columns = np.mgrid[: SHAPE[0], : SHAPE[1]]
    damaged = np.zeros(SHAPE, bool)
    relief_m = np.zeros(SHAPE)
    for _ in range(int(random.integers(0, MOST_DAMAGES + 1))):
        row = random.uniform(10, SHAPE[0] - 10)
        column = random.uniform(10, SHAPE[1] - 10)
        radius_px = random.uniform(1.5, 6.0)
        inside = np.hypot(rows - row, columns - column) < radius_px
        # so deep that a filter of its size scores 2 to 30
        independent = max(np.pi * radius_px**2 / case.reach_px**2, 1.0)
        depth_m = deviation_m * np.exp(random.uniform(np.log(2.0), np.log(30.0)))
        relief_m[inside] = (
            (1.0 if random.uniform() > BUMPS else -1.0) * depth_m / np.sqrt(independent)
        )
        damaged |= inside
    offset_m += _blurred(relief_m, case.reach_px)
    return plane(offset_m), ndimage.binary_dilation(damaged, iterations=MARGIN_PX)


def _blurred(image: np.ndarray, side: int) -> np.ndarray:
    return ndimage.uniform_filter(image, side, mode="wrap")


def plane(offset_m: np.ndarray) -> Cloud:
    """Return the points of a plane that stand so far behind it, (h, w)."""
    height, width = offset_m.shape
    rows, columns = np.mgrid[:height, :width].astype(float)
    x_m = (columns - width / 2) * PITCH_M
    y_m = (rows - height / 2) * PITCH_M
    empty = np.zeros((height, width), np.uint8)
    return Cloud(
        points_m=np.stack([x_m, y_m, DISTANCE_M + offset_m], axis=-1),
        reason=empty,
        count=empty + 1,
        variance_m2=np.full((height, width), np.nan),
        region=Region(0, height, 0, width),
        z_step_m=0.0,
        n_frames=1,
    )


def judgement(detector: Detector, cloud: Cloud, damaged: np.ndarray) -> Judgement | None:
    """Judge a capture; None if it cannot set its own threshold."""
    null = own_threshold(detector, cloud, detector.analyse(cloud), WANTED)
    if null.doubts:
        return None
    evidence = replace(null.evidence, notes={"own_null": null_facts(null)})
    detections = detector.find(cloud, evidence, null.threshold)
    probabilities = noise_probabilities(cloud, evidence, detections, None)
    is_damaged = damaged.reshape(-1)
    is_false = [not is_damaged[detection.pixels].any() for detection in detections]
    return Judgement(np.array(probabilities), np.array(is_false, bool), null.expected)


def judgements(name: str, case: Case, captures: int) -> Iterator[Judgement]:
    """Judge captures of one kind by a detector."""
    detector = load_detector(name, {"crop": {"kind": "none"}, "surface": {"degree": 1}})
    for seed in range(captures):
        judged = judgement(detector, *capture(case, seed))
        if judged is not None:
            yield judged


def cases() -> Iterator[Case]:
    """Return all kinds of captures."""
    for noise in NOISES:
        for reach_px in REACHES_PX:
            for frames in FRAMES:
                yield Case(noise, reach_px, frames)


def row_text(judged: list[Judgement]) -> str:
    """Return the counts of captures: false calls asked for, expected and seen, then by class."""
    probability = np.concatenate([one_capture.probability for one_capture in judged])
    is_false = np.concatenate([one_capture.is_false for one_capture in judged])
    asked = WANTED * len(judged)
    parts = [f"{asked:.0f}", f"{probability.sum():.1f}", f"{is_false.sum()}"]
    number = np.clip(np.searchsorted(EDGES, probability) - 1, 0, len(EDGES) - 2)
    for bin_number in range(len(EDGES) - 1):
        chosen = number == bin_number
        stated = float(probability[chosen].sum())
        parts.append(f"{stated:.1f} / {is_false[chosen].sum()} of {chosen.sum()}")
    return " | ".join(parts)


def main(arguments: list[str]) -> int:
    """Print the table."""
    parser = argparse.ArgumentParser(prog="python tests/validation/odds.py", description=__doc__)
    parser.add_argument("--captures", type=int, default=40, help="of each kind")
    parser.add_argument("--detectors", nargs="+", default=DETECTORS, choices=DETECTORS)
    options = parser.parse_args(arguments)
    classes = [f"{low:g} to {high:g}" for low, high in pairwise(EDGES)]
    heads = ["detector, noise, reach, frames", "asked", "stated", "false", *classes]
    print(" | ".join(heads))
    for name in options.detectors:
        total = []
        for case in cases():
            judged = list(judgements(name, case, options.captures))
            total += judged
            text = f"{name}, {case.noise}, {case.reach_px} px, {case.frames}"
            print(f"{text} | {row_text(judged)}", flush=True)
        print(f"{name}, all | {row_text(total)}", flush=True)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
