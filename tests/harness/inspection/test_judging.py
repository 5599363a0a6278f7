"""What a judged cloud says of noise: the law of its own null, and what stays unknown."""

import argparse
import math
from dataclasses import replace
from typing import cast

import numpy as np
import pytest

from detectors import load_detector
from detectors.findings.beside_joints import TouchingDamage
from detectors.findings.joints import Joints
from detectors.findings.null import OwnThreshold, own_threshold
from detectors.interface import Detection, Detector, Measurement
from harness.inspection import judging
from harness.inspection.judging import judged, null_facts, threshold_of
from harness.report.findings import Judged
from harness.vocabulary.files import plain_json
from tests.harness.inspection.test_verdict import judged_of
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
