"""What a judged cloud says of noise: the law of its own null, and what stays unknown."""

import argparse
import math
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest

from detectors import load_detector
from detectors.findings.beside_joints import TouchingDamage
from detectors.findings.joints import Joints
from detectors.findings.null import OwnThreshold, own_threshold
from detectors.interface import Detection, Detector, Evidence, Measurement, MissingReturns
from harness.inspection import judging
from harness.inspection.judging import _without_features, judged, null_facts, threshold_of
from harness.report.findings import Judged
from harness.vocabulary.files import plain_json
from harness.vocabulary.geometry import ExpectedSurface, Lens
from tests.harness.inspection.test_verdict import judged_of
from tests.support.plain_clouds import cloud_of_points
from tests.validation.odds import Case, capture

DETECTOR = load_detector("matched", {"crop": {"kind": "none"}, "surface": {"degree": 1}})
CLOUD, _ = capture(Case("normal", 3, 1), 11)
EVIDENCE = DETECTOR.analyse(CLOUD)


def arguments(**changed: float | None) -> argparse.Namespace:
    plain = {"threshold": None, "quiet_capture": None, "false_calls": None}
    return argparse.Namespace(**{**plain, **changed})


def never() -> tuple[float, str]:
    raise AssertionError("no quiet capture was given")


def own(false_calls: float) -> OwnThreshold:
    return own_threshold(DETECTOR, CLOUD, EVIDENCE, false_calls)


def test_findings_carry_the_odds_of_the_captures_own_null() -> None:
    threshold, origin, evidence = threshold_of(
        arguments(false_calls=3.0), DETECTOR, CLOUD, EVIDENCE, never
    )
    result = judged(DETECTOR, CLOUD, evidence, threshold)
    assert "own null: 3.0 false calls expected (0 to 9), from" in origin
    assert evidence.warnings == ()
    assert len(result.findings) >= 2
    stated = [finding.noise_probability for finding in result.findings]
    assert stated == list(result.noise_probabilities)
    assert min(stated) < 0.05
    assert max(stated) > 0.5
    # of those on one side of the surface, a stronger one is not more likely noise
    behind = [finding.noise_probability for finding in result.findings if finding.kind == "hole"]
    assert behind == sorted(behind)


def test_odds_are_unknown_where_the_threshold_is_given() -> None:
    threshold, _, evidence = threshold_of(
        arguments(threshold=4.5), DETECTOR, CLOUD, EVIDENCE, never
    )
    result = judged(DETECTOR, CLOUD, evidence, threshold)
    assert result.findings
    assert all(math.isnan(finding.noise_probability) for finding in result.findings)
    bare = replace(result, noise_probabilities=())
    assert all(math.isnan(finding.noise_probability) for finding in bare.findings)


def test_a_null_in_doubt_states_neither_calls_nor_odds() -> None:
    trusted = own(3.0)
    facts = null_facts(trusted)
    assert facts["expected"] == trusted.expected == pytest.approx(3.0)
    assert facts["tails"]["plain"]["peaks"] == facts["peaks"] == trusted.peaks
    in_doubt = null_facts(replace(trusted, doubts=("the residual is not symmetric",)))
    assert in_doubt["tails"] == {}
    for name in ("threshold", "expected", "at_marks", "low", "high"):
        assert math.isnan(in_doubt[name])
    assert in_doubt["peaks"] == trusted.peaks
    assert '"expected": null' in plain_json(in_doubt)


def test_calls_at_marks_are_stated_apart() -> None:
    noisy = replace(CLOUD, rgb=np.full((*CLOUD.valid.shape, 3), 200.0))
    noisy.rgb[30:90, 30:100] = 20.0
    _, origin, evidence = threshold_of(arguments(), DETECTOR, noisy, EVIDENCE, never)
    null = evidence.notes["own_null"]
    assert null["at_marks"] > 0.05
    assert null["expected"] == pytest.approx(1.0 + null["at_marks"], rel=1e-6)
    assert "of them at objects, print and edges, from" in origin


def threshold_by(monkeypatch: pytest.MonkeyPatch, **changed: Any) -> tuple[float, str, Evidence]:
    """The threshold of a capture whose own one is as ``changed``."""
    stated = replace(own(1.0), **changed)
    monkeypatch.setattr(judging, "own_threshold", lambda *_: stated)
    return threshold_of(arguments(), DETECTOR, CLOUD, EVIDENCE, never)


@pytest.mark.parametrize(("at_marks", "told"), [(0.049, ""), (0.05, ", 0.05 of them at objects")])
def test_calls_at_marks_are_told_from_a_twentieth(
    monkeypatch: pytest.MonkeyPatch, at_marks: float, told: str
) -> None:
    _, origin, _ = threshold_by(monkeypatch, at_marks=at_marks, expected=1.0, low=0.0, high=4.0)
    assert f"1.0 false calls expected (0 to 4){told}" in origin
    assert ("at objects" in origin) == bool(told)


@pytest.mark.parametrize(("own_k", "used"), [(3.2, 5.0), (7.5, 7.5), (math.nan, 5.0)])
def test_a_threshold_in_doubt_is_at_least_five_deviations(
    monkeypatch: pytest.MonkeyPatch, own_k: float, used: float
) -> None:
    doubts = ("only 3 peaks of noise stand out",)
    k, origin, evidence = threshold_by(monkeypatch, threshold=own_k, doubts=doubts)
    assert k == used
    assert origin.startswith(f"a fallback, {used:g} units of score: the number of false calls is")
    told = f"the capture cannot set its own threshold, {used:g} is used: {doubts[0]}"
    assert evidence.warnings[-1] == told


@pytest.mark.parametrize(("shown", "is_finding"), [(1, False), (2, True), (4, True)])
def test_missing_returns_are_findings_if_the_reference_shows_half_of_them(
    shown: int, is_finding: bool
) -> None:
    """Four pixels without a return, of which the reference shows some."""
    lens = Lens(60, 40, 500.0, 500.0, 29.5, 19.5)
    pixels = 60 * 20 + np.arange(10, 14)
    edge = (10 + shown - 0.5 - lens.cx) / lens.fx

    def z_at(rays: np.ndarray) -> np.ndarray:
        return np.where(rays[:, 0] < edge, 1.0, np.nan)

    reference = ExpectedSurface("a part", z_at, np.zeros_like, np.zeros_like)
    points = np.concatenate([lens.region_slopes(lens.whole), np.ones((40, 60, 1))], axis=-1)
    cloud = cloud_of_points(points, lens=lens, expected=reference)
    blind = Detection(6.0, pixels, np.zeros(3), kind="no return")
    everything = np.ones((40, 60), bool)
    missing = MissingReturns(everything, np.zeros((40, 60)), 0.0, 0.0, 4, 0.001, (blind,))
    kept = _without_features(cloud, missing).detections
    assert kept == ((blind,) if is_finding else ())


class Finds:
    """A detector that finds what it is told to."""

    def __init__(self, result: Judged) -> None:
        self.result = result

    def find(self, *_: object) -> tuple[Detection, ...]:
        return self.result.detections

    def measure(self, *_: object) -> Measurement:
        return self.result.measurements[0]


def test_steps_explain_nothing_that_was_parted_from_a_joint(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    result = judged_of(20.0, 19.0)
    beside = replace(result.detections[1], score=18.0)
    touching = TouchingDamage(0, beside, result.evidence)
    monkeypatch.setattr(judging, "missing_returns", lambda *_: None)
    monkeypatch.setattr(judging, "each_object_once", lambda cloud, evidence, found: found)
    monkeypatch.setattr(judging, "one_damage_once", lambda shape, found, missing: found)
    monkeypatch.setattr(judging, "joints_of", lambda *_: (Joints((0,), ()),))
    monkeypatch.setattr(judging, "fragments_of", lambda *_: ())
    monkeypatch.setattr(judging, "damage_beside", lambda *_: (touching,))
    monkeypatch.setattr(judging, "at_steps", lambda cloud, evidence, found, _: range(len(found)))
    detector = cast(Detector, Finds(result))
    left = judging.judged(detector, result.cloud, result.evidence, 5.0)
    assert [detection is beside for detection in left.detections] == [True]
    assert len(left.measurements) == 1
    assert left.evidence.notes["at_steps"] == 2
