"""Separates damage from the joint that it touches, with which it was found as one, and finds the
fragments of joints.

The joints of a feature are alike, so what lies outside the largest outline of the others is damage.
It is measured there: within the outline, the depths of both add up. Not modelled: damage within a
joint's own outline, which remains a joint that differs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np

from detectors.findings.joints import DEEPEST, Joints, plane_along, rim_of
from detectors.interface import Detection, Evidence, Measurement
from detectors.pixels.masks import grown
from harness.vocabulary.geometry import Cloud

FEWEST_OUTSIDE = 9  # pixels outside a joint's outline that are damage
MARGIN_PX = 1  # by which a joint is cut out around its pixels


@dataclass(frozen=True)
class TouchingDamage:
    """Damage that touches a joint."""

    joint: int
    """Number of the joint's detection."""
    detection: Detection
    """The damage."""
    evidence: Evidence
    """The evidence without the joint, in which the damage is measured."""


def damage_beside(
    cloud: Cloud,
    evidence: Evidence,
    detections: Sequence[Detection],
    measurements: Sequence[Measurement],
    feature: Joints,
) -> tuple[TouchingDamage, ...]:
    """Return the damage that the differing joints of a feature touch."""
    points_m = cloud.points_m.reshape(-1, 3)
    plane, half_m = _outline(cloud, evidence, detections, measurements, feature)
    touching = []
    for number in feature.differing:
        joint = detections[number]
        places_m = points_m[joint.pixels] @ plane
        offsets_m = places_m - _middle(places_m, half_m)
        is_outside = (np.abs(offsets_m) > half_m).any(axis=1)
        pixels = _largest_part(cloud, joint.pixels[is_outside])
        if len(pixels) < FEWEST_OUTSIDE:
            continue
        damage = replace(
            joint,
            score=float(evidence.score.reshape(-1)[pixels].max()),
            pixels=pixels,
            centre_m=points_m[pixels].mean(axis=0),
        )
        without_joint = _without_joint(evidence, joint, damage)
        touching.append(TouchingDamage(number, damage, without_joint))
    return tuple(touching)


def fragments_of(
    cloud: Cloud,
    evidence: Evidence,
    detections: Sequence[Detection],
    measurements: Sequence[Measurement],
    feature: Joints,
) -> tuple[int, ...]:
    """Return the numbers of findings that fit into the largest outline of a feature's joints
    together with one of them, on the same side of the surface, and depart from it less than that
    joint: its ends, where the rim or another joint parts them from it."""
    points_m = cloud.points_m.reshape(-1, 3)
    residual_m = evidence.residual_m.reshape(-1)
    plane, half_m = _outline(cloud, evidence, detections, measurements, feature)
    places_m = [points_m[detection.pixels] @ plane for detection in detections]
    low_m = np.array([place_m.min(axis=0) for place_m in places_m])
    high_m = np.array([place_m.max(axis=0) for place_m in places_m])
    deepest_m = np.array([_deepest_m(residual_m[detection.pixels]) for detection in detections])
    joints = np.array(feature.members + feature.differing)
    fragments = []
    for number, detection in enumerate(detections):
        if number in joints or detection.kind != "depth":
            continue
        first_m = np.minimum(low_m[joints], low_m[number])
        last_m = np.maximum(high_m[joints], high_m[number])
        fits = (last_m - first_m <= 2.0 * half_m).all(axis=1)
        share = deepest_m[number] / deepest_m[joints]
        if (fits & (share > 0.0) & (share < 1.0)).any():
            fragments.append(number)
    return tuple(fragments)


def _deepest_m(residuals_m: np.ndarray) -> float:
    """Return the residual at the quantile `DEEPEST` of the sizes, with the sign of their sum."""
    sizes_m = np.abs(residuals_m)
    return math.copysign(float(np.quantile(sizes_m, DEEPEST)), float(residuals_m.sum()))


def _outline(
    cloud: Cloud,
    evidence: Evidence,
    detections: Sequence[Detection],
    measurements: Sequence[Measurement],
    feature: Joints,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the directions (3, 2) along and across the joints of a feature, and half the extent
    (2,) of the largest outline of those that are alike, metres: of whole ones, if the rim does not
    cut all, as pixels at the rim may lengthen what it cuts."""
    points_m = cloud.points_m.reshape(-1, 3)
    strongest = feature.members[0]
    plane = plane_along(measurements[strongest].along, detections[strongest].centre_m)
    rim = rim_of(evidence).ravel()
    whole = [number for number in feature.members if not rim[detections[number].pixels].any()]
    half_m = np.zeros(2)
    for number in whole or feature.members:
        places_m = points_m[detections[number].pixels] @ plane
        middle_m = 0.5 * (places_m.min(axis=0) + places_m.max(axis=0))
        half_m = np.maximum(half_m, np.abs(places_m - middle_m).max(axis=0))
    return plane, half_m


def without_damage(feature: Joints, touching: Sequence[TouchingDamage]) -> Joints:
    """Return the feature, of which the joints that damage touches are members: without it they do
    not differ."""
    numbers = {damage.joint for damage in touching}
    touched = tuple(number for number in feature.differing if number in numbers)
    differing = tuple(number for number in feature.differing if number not in numbers)
    return Joints(feature.members + touched, differing)


def _middle(places_m: np.ndarray, half_m: np.ndarray) -> np.ndarray:
    """Return the middle (2,) of a joint among places (n, 2) that damage lengthens or widens.
    ``half_m`` (2,): half the joint's extent."""
    along_m, across_m = places_m.T
    return np.array([_middle_along(along_m, half_m[0]), _middle_across(across_m, half_m[1])])


def _middle_along(places_m: np.ndarray, half_m: float) -> float:
    """Return the middle of a joint along it. What is longer ends with damage on one side, where it
    is wider than a joint: the joint is the part from the other end, which holds fewer places."""
    low_m = float(places_m.min())
    high_m = float(places_m.max())
    if high_m - low_m <= 2.0 * half_m:
        return 0.5 * (low_m + high_m)
    from_low = (places_m <= low_m + 2.0 * half_m).sum()
    from_high = (places_m >= high_m - 2.0 * half_m).sum()
    return low_m + half_m if from_low < from_high else high_m - half_m


def _middle_across(places_m: np.ndarray, half_m: float) -> float:
    """Return the middle of a joint across it: that of the extent that holds the most places."""
    ordered_m = np.sort(places_m)
    ends = np.searchsorted(ordered_m, ordered_m + 2.0 * half_m, side="right")
    counts = ends - np.arange(len(ordered_m))
    first = int(counts.argmax())
    last = int(ends[first]) - 1
    return 0.5 * float(ordered_m[first] + ordered_m[last])


def _without_joint(evidence: Evidence, joint: Detection, damage: Detection) -> Evidence:
    """Return the evidence in which the pixels of a joint and its margin are not judged, but those
    of the damage are."""
    cut_out = np.zeros(evidence.residual_m.shape, bool)
    cut_out.reshape(-1)[joint.pixels] = True
    cut_out = grown(cut_out, MARGIN_PX)
    cut_out.reshape(-1)[damage.pixels] = False
    return replace(evidence, residual_m=np.where(cut_out, np.nan, evidence.residual_m))


def _largest_part(cloud: Cloud, pixels: np.ndarray) -> np.ndarray:
    """Return the largest connected part of pixels (n,), and the parts whose centres lie within
    twice its extent of its own: a joint parts damage that it crosses."""
    mask = np.zeros(cloud.valid.shape, np.uint8)
    mask.reshape(-1)[pixels] = 1
    _, labels, stats, centres = cv2.connectedComponentsWithStats(mask, connectivity=8)
    if len(stats) < 2:
        return pixels[:0]
    largest = 1 + int(stats[1:, cv2.CC_STAT_AREA].argmax())
    extent_px = float(max(stats[largest, [cv2.CC_STAT_WIDTH, cv2.CC_STAT_HEIGHT]]))
    offsets_px = centres - centres[largest]
    distances_px = np.hypot(offsets_px[:, 0], offsets_px[:, 1])
    belongs = distances_px <= 2.0 * extent_px
    belongs[0] = False  # the background
    label_of_pixel = labels.reshape(-1)[pixels]
    return pixels[belongs[label_of_pixel]]
