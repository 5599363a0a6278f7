"""The doubt about faint findings, by its formula."""

from dataclasses import dataclass, field
from types import SimpleNamespace
from typing import Any

from harness.inspection.judging import with_faint_warning

NULL = {"threshold": 5.0, "high": 1.0, "peaks": 100, "floor": 3.0, "expected": 1.0}


@dataclass(frozen=True)
class NullEvidence:
    notes: dict[str, Any] = field(default_factory=lambda: {"own_null": NULL})
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class TwoFindings:
    findings: tuple[SimpleNamespace, ...]
    evidence: NullEvidence = field(default_factory=NullEvidence)


def two_findings(score: float) -> Any:
    return TwoFindings(tuple(SimpleNamespace(id=n, kind="hole", score=score) for n in (1, 2)))


def test_findings_are_faint_up_to_the_score_of_a_twentieth_of_a_false_call():
    """ln(200) / (25 - 9) = 0.331 a unit of squared score: sqrt(25 + ln(20) / 0.331) = 5.835."""
    (warning,) = with_faint_warning(two_findings(5.82), 5.0).evidence.warnings
    assert warning.startswith("2 of 2 findings (1, 2) are so faint that noise explains them")
    assert with_faint_warning(two_findings(5.85), 5.0).evidence.warnings == ()
